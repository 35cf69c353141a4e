"""Evaluation within and out of distribution: a policy and a task to a report."""

from sme_registry.evaluation.evaluate import evaluate, resolve_protocol
from sme_registry.evaluation.policies import Policy, as_policy, load_sb3
from sme_registry.evaluation.report import ChannelReport, EvaluationReport, RegionReport

__all__ = [
    "ChannelReport",
    "EvaluationReport",
    "Policy",
    "RegionReport",
    "as_policy",
    "evaluate",
    "load_sb3",
    "resolve_protocol",
]

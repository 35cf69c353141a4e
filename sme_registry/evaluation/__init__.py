"""Evaluation within and out of distribution: a policy and a task to a report."""

from sme_registry.evaluation.evaluate import evaluate, evaluate_many, resolve_protocol
from sme_registry.evaluation.policies import (
    OfflinePolicy,
    Perceptron,
    Policy,
    TeamPolicy,
    as_policy,
    interface_of,
    load_sb3,
)
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.report import (
    AgentReport,
    ChannelReport,
    EvaluationReport,
    RegionReport,
)

__all__ = [
    "AgentReport",
    "ChannelReport",
    "EvaluationReport",
    "OfflinePolicy",
    "Perceptron",
    "Policy",
    "RegionReport",
    "TeamPolicy",
    "as_policy",
    "evaluate",
    "evaluate_many",
    "interface_of",
    "load_sb3",
    "reference_policy",
    "resolve_protocol",
]

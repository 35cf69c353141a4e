"""Evaluation within and out of distribution: policies and tasks, or a stream, to a report."""

from sme_registry.evaluation.dynamic_regret import (
    dynamic_regret,
    expected_regret,
    reference_regret,
)
from sme_registry.evaluation.evaluate import (
    evaluate,
    evaluate_many,
    evaluation_observations,
    resolve_protocol,
)
from sme_registry.evaluation.models import load_sb3
from sme_registry.evaluation.networks import OfflinePolicy, Perceptron
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy, interface_of
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.regions import ObservationReport, RegionReport, SafetyReport
from sme_registry.evaluation.report import EvaluationReport
from sme_registry.evaluation.streams import (
    StreamReport,
    across_seeds,
    evaluate_stream,
)

__all__ = [
    "EvaluationReport",
    "ObservationReport",
    "OfflinePolicy",
    "Perceptron",
    "Policy",
    "RegionReport",
    "SafetyReport",
    "StreamReport",
    "TeamPolicy",
    "across_seeds",
    "as_policy",
    "dynamic_regret",
    "evaluate",
    "evaluate_many",
    "evaluate_stream",
    "evaluation_observations",
    "expected_regret",
    "interface_of",
    "load_sb3",
    "reference_policy",
    "reference_regret",
    "resolve_protocol",
]

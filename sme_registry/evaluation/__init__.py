"""Evaluation within and out of distribution: policies and tasks, or a stream, to a report."""

from sme_registry.evaluation.dynamic_regret import (
    dynamic_regret,
    expected_regret,
    reference_regret,
)
from sme_registry.evaluation.evaluate import evaluate, evaluate_many
from sme_registry.evaluation.evaluate import evaluation_observations as evaluation_observations
from sme_registry.evaluation.evaluate import resolve_protocol as resolve_protocol
from sme_registry.evaluation.models import load_sb3 as load_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.policies import Policy
from sme_registry.evaluation.policies import as_policy as as_policy
from sme_registry.evaluation.policies import interface_of as interface_of
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.report import EvaluationReport
from sme_registry.evaluation.streams import (
    StreamReport,
    across_seeds,
    evaluate_stream,
)

__all__ = [
    "EvaluationReport",
    "Perceptron",
    "Policy",
    "StreamReport",
    "across_seeds",
    "dynamic_regret",
    "evaluate",
    "evaluate_many",
    "evaluate_stream",
    "expected_regret",
    "reference_policy",
    "reference_regret",
]

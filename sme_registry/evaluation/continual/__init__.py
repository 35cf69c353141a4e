"""Continual learning: what an agent retains in a stream, what its life cost, and its plasticity."""

from sme_registry.evaluation.continual.dynamic_regret import (
    DynamicRegret,
    VisitRegret,
    dynamic_regret,
)
from sme_registry.evaluation.continual.evaluate import (
    evaluate_stream,
    fresh_per_phase,
    frozen_after_first,
)
from sme_registry.evaluation.continual.lives import expected_regret, reference_regret
from sme_registry.evaluation.continual.regret_blocks import RegretBlocks
from sme_registry.evaluation.continual.report import (
    Retention,
    StreamRegion,
    StreamReport,
    Visit,
)
from sme_registry.evaluation.continual.seeds import across_seeds

__all__ = [
    "DynamicRegret",
    "RegretBlocks",
    "Retention",
    "StreamRegion",
    "StreamReport",
    "Visit",
    "VisitRegret",
    "across_seeds",
    "dynamic_regret",
    "evaluate_stream",
    "expected_regret",
    "fresh_per_phase",
    "frozen_after_first",
    "reference_regret",
]

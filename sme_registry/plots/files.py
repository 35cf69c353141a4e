"""The figures that commands write into a folder, each as PNG and as PDF."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sme_registry.evaluation import EvaluationReport, StreamReport
from sme_registry.evaluation.streams import Visit
from sme_registry.plots.curves import Run, cost_curve, training_curve
from sme_registry.plots.maps import similarity_map
from sme_registry.plots.reports import (
    decay_curve,
    layer_probes,
    reward_against_cost,
    sensitivity_bars,
)
from sme_registry.plots.streams import (
    dynamic_regret_curve,
    performance_curve,
    plasticity_curve,
    retention_map,
)
from sme_registry.plots.style import WRITTEN, save_figure

_TRAINING, _COST, _DECAY, _MAP = "training_curve", "cost_curve", "decay_curve", "similarity_map"
_OF_STREAMS: dict[str, Callable[[StreamReport], Any]] = {
    "retention_map": retention_map,
    "performance_curve": performance_curve,
    "dynamic_regret_curve": dynamic_regret_curve,
    "plasticity_curve": plasticity_curve,
}
_OF_EXTENSIONS: dict[str, Callable[[EvaluationReport], Any]] = {
    "reward_against_cost": reward_against_cost,
    "sensitivity_bars": sensitivity_bars,
    "layer_probes": layer_probes,
}
FILES = tuple(
    f"{name}.{ending}"
    for name in (_TRAINING, _COST, _DECAY, _MAP, *_OF_EXTENSIONS, *_OF_STREAMS)
    for ending in WRITTEN
)


def write_training(
    episodes: Run, folder: Path, title: str, visits: Sequence[Visit] = (), costs: bool = False
) -> list[Path]:
    """Write the training curve and, with `costs`, the curve of costs; see `training_curve`."""
    figure = training_curve(episodes, title=title, visits=visits)
    files = save_figure(figure, folder / _TRAINING, WRITTEN)
    if costs:
        files += save_figure(cost_curve(episodes, title=title), folder / _COST, WRITTEN)
    return files


def write_stream(report: StreamReport, folder: Path) -> list[Path]:
    """Write the figures of a life in a stream for which its report has the numbers."""
    missing = {
        "dynamic_regret_curve": report.dynamic_regret is None,
        "plasticity_curve": report.regions[0].agent.fresh_normalised_regret is None,
    }
    files: list[Path] = []
    for name, draw in _OF_STREAMS.items():
        if not missing.get(name, False):
            files += save_figure(draw(report), folder / name, WRITTEN)
    return files


def write_evaluation(report: EvaluationReport, folder: Path, policy: Any = None) -> list[Path]:
    """Write the figures of an evaluation for which its report has the numbers.

    They are the decay curve, and of a policy that observes two state channels the similarity map;
    without a policy, or of a team's, there is no map.
    """
    files = save_figure(decay_curve(report), folder / _DECAY, WRITTEN)
    spec = report.spec.named(report.task)
    observation = report.observation
    known = {
        "reward_against_cost": report.safety is not None,
        "sensitivity_bars": observation is not None and bool(observation.invariance),
        "layer_probes": observation is not None and bool(observation.probes),
    }
    for name, draw in _OF_EXTENSIONS.items():
        if known[name]:
            files += save_figure(draw(report), folder / name, WRITTEN)
    alone = spec.team is None and spec.observation is None
    if policy is not None and spec.state_dim == 2 and alone:
        action_range: Any = report.action_range
        figure = similarity_map(policy, spec, action_range=action_range, name=report.policy)
        files += save_figure(figure, folder / _MAP, WRITTEN)
    return files

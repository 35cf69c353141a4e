"""The figures that commands write into a folder, each as PNG and as PDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sme_registry.evaluation import EvaluationReport
from sme_registry.plots.curves import Run, training_curve
from sme_registry.plots.decay import decay_curve
from sme_registry.plots.maps import similarity_map
from sme_registry.plots.style import WRITTEN, save_figure

_TRAINING, _DECAY, _MAP = "training_curve", "decay_curve", "similarity_map"
FILES = tuple(f"{name}.{ending}" for name in (_TRAINING, _DECAY, _MAP) for ending in WRITTEN)


def write_training(episodes: Run, folder: Path, title: str) -> list[Path]:
    """Write the training curve; see `training_curve` for arguments and errors."""
    return save_figure(training_curve(episodes, title=title), folder / _TRAINING, WRITTEN)


def write_evaluation(report: EvaluationReport, folder: Path, policy: Any = None) -> list[Path]:
    """Write the decay curve and, of a policy with two state channels, the similarity map.

    Args:
      report: of the policy.
      folder: the folder.
      policy: any policy that `evaluate` accepts; None, or a team's, draws no map.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
      OptionError: a file cannot be written.
    """
    files = save_figure(decay_curve(report), folder / _DECAY, WRITTEN)
    spec = report.spec.named(report.task)
    if policy is not None and spec.state_dim == 2 and spec.team is None:
        action_range: Any = report.action_range
        figure = similarity_map(policy, spec, action_range=action_range, name=report.policy)
        files += save_figure(figure, folder / _MAP, WRITTEN)
    return files

"""The final evaluation of a trained policy in the folder of its training, offline or online."""

from __future__ import annotations

from pathlib import Path

from sme_registry.evaluation import EvaluationReport
from sme_registry.io import is_installed

EVALUATION = "evaluation.json"
DECAY_CURVE = "decay_curve.png"


def write_evaluation(report: EvaluationReport, folder: Path) -> list[Path]:
    """Write a report, and its decay curve if matplotlib is installed; returns the figures.

    Raises:
      OptionError: a file cannot be written.
    """
    report.write(folder / EVALUATION)
    if not is_installed("matplotlib"):
        return []
    from sme_registry import plots

    return [plots.decay_curve(report, folder / DECAY_CURVE)]

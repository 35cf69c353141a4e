"""A life in a stream: when its visits end (`VisitEnds`), and the files of its models (`Snapshots`).

The policy at the end of a visit has learned from all that the learner collected in it: with TD3 and
SAC up to the update that follows its last step, with PPO up to that of the last rollout that was
over by then. So it is the policy at the first step of the next visit, before any update that
follows that step. The last visit ends with the training, since the last phase goes on: PPO finishes
its last rollout in it. `jax.run.run` has the same rule.

    initial.zip       the model before training
    visit-00.zip      at the end of visit 0, and so on; the last one is the trained model

Visits count from 0, in as many digits as the last one has, at least two.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.spec import StreamSpec

FOLDER = "snapshots"  # of a run
MODELS = "models"  # of a study


def model_of_cell(study: Path, key: str) -> Path:
    """Where a study keeps the trained model of a cell.

    Args:
      study: its folder.
      key: the cell's digest.

    Examples:
      >>> from pathlib import Path
      >>> from sme_registry.training import model_of_cell
      >>> model_of_cell(Path("study"), "66e9b7a9a266").suffix
      '.zip'
    """
    return study / MODELS / f"{key.removeprefix('sha256:')}.zip"


def folder_of_cell(study: Path, key: str) -> Path:
    """The folder for the `Snapshots` of a cell that is a life; the arguments as above."""
    return model_of_cell(study, key).with_suffix("")


class Snapshots:
    """The files of a life's models in a folder."""

    def __init__(self, folder: Path, stream: StreamSpec) -> None:
        count = stream.visits
        digits = max(2, len(str(count - 1)))
        self.initial = folder / "initial.zip"
        self.visits = [folder / f"visit-{visit:0{digits}}.zip" for visit in range(count)]

    def write_initial(self, model: Any) -> None:
        """Write a model of Stable-Baselines3 before training; OptionError if that fails."""
        write_atomically(self.initial, saved_sb3(model))

    def write(self, visit: int, model: Any) -> None:
        """Write the model at the end of a visit; OptionError if that fails."""
        write_atomically(self.visits[visit], saved_sb3(model))


class VisitEnds:
    """Calls a function at the end of each visit, while steps are counted."""

    def __init__(
        self, stream: StreamSpec, on_visit: Callable[[int], object], steps: int = 0
    ) -> None:
        *upcoming, self._last = stream.visit_ends()
        self._upcoming = [(visit, end) for visit, end in upcoming if end >= steps]
        self._on_visit = on_visit

    def after_step(self, steps: int) -> None:
        """Count a step; `steps` are all that were taken, and the learner has not learned since."""
        while self._upcoming and self._upcoming[0][1] < steps:
            self._on_visit(self._upcoming.pop(0)[0])

    def finish(self, steps: int) -> None:
        """End the visits that are over when training ends, after its last update."""
        self.after_step(steps + 1)
        visit, end = self._last
        if end <= steps:
            self._on_visit(visit)

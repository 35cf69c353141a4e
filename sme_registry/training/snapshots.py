"""`Snapshots`: the models of a life in a stream, before training and at the end of each visit.

    initial.zip       before training
    visit-00.zip      at the end of visit 0 (`visits`), and so on; the last one is the trained model

Each is written as a trained model is. Visits count from 0, in as many digits as the last one has,
at least two.
"""

from __future__ import annotations

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

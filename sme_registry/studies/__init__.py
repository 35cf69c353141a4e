"""Studies: algorithms × kinds of tasks × seeds, their results as data frames, and their report.

    from sme_registry import studies
    results, curves = studies.load("runs/ablations")      # tidy pandas frames
    results[results.region == "OOD 5"].groupby("class_name").similarity.median()

Names load on first use: running a study needs no pandas.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sme_registry.studies.engine.cell import run_cell
    from sme_registry.studies.engine.result import CellResult
    from sme_registry.studies.engine.runner import run_study
    from sme_registry.studies.engine.status import StudyStatus, study_status
    from sme_registry.studies.report.frames import StudyFrames, load
    from sme_registry.studies.report.write import write_report

__all__ = [
    "CellResult",
    "StudyFrames",
    "StudyStatus",
    "load",
    "run_cell",
    "run_study",
    "study_status",
    "write_report",
]

_LAZY = {
    "CellResult": "engine.result",
    "StudyFrames": "report.frames",
    "StudyStatus": "engine.status",
    "load": "report.frames",
    "run_cell": "engine.cell",
    "run_study": "engine.runner",
    "study_status": "engine.status",
    "write_report": "report.write",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

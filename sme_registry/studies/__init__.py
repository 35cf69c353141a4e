"""Studies: algorithms × kinds of tasks × seeds, their results as data frames, and their report.

    from sme_registry import studies
    results, curves = studies.load("runs/ablations")      # tidy pandas frames
    lives = studies.load_streams("runs/continual").lives  # of agents in streams
    results[results.region == "OOD 5"].groupby("class_name").similarity.median()

Names load on first use: running a study needs no pandas.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sme_registry.spec.study import sweep
    from sme_registry.studies.cell import run_cell
    from sme_registry.studies.ledger import CellStatus as CellStatus
    from sme_registry.studies.ledger import study_status as study_status
    from sme_registry.studies.report.frames import load, load_streams
    from sme_registry.studies.report.write import compare, write_report
    from sme_registry.studies.result import CellResult as CellResult
    from sme_registry.studies.runner import run_study

__all__ = [
    "compare",
    "load",
    "load_streams",
    "run_cell",
    "run_study",
    "sweep",
    "write_report",
]

_LAZY = {
    "CellResult": "studies.result",
    "CellStatus": "studies.ledger",
    "compare": "studies.report.write",
    "load": "studies.report.frames",
    "load_streams": "studies.report.frames",
    "run_cell": "studies.cell",
    "run_study": "studies.runner",
    "study_status": "studies.ledger",
    "sweep": "spec.study",
    "write_report": "studies.report.write",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"sme_registry.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""Studies: algorithms × kinds of tasks × seeds, their results as data frames, and their report.

    from sme_registry import studies
    results, curves = studies.load("runs/ablations")      # tidy pandas frames
    lives = studies.load_streams("runs/continual").lives  # of agents in streams
    results[results.region == "OOD 5"].groupby("class_name").similarity.median()

Running a study needs no pandas: what reports load is loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sme_registry.spec.study import sweep
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import CellStatus as CellStatus
from sme_registry.studies.ledger import study_status as study_status
from sme_registry.studies.result import CellResult as CellResult
from sme_registry.studies.runner import run_study

if TYPE_CHECKING:
    from sme_registry.studies.report.frames import load, load_streams
    from sme_registry.studies.report.write import compare, write_report

__all__ = [
    "compare",
    "load",
    "load_streams",
    "run_cell",
    "run_study",
    "sweep",
    "write_report",
]

_LAZY = {"compare": "write", "load": "frames", "load_streams": "frames", "write_report": "write"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        module = importlib.import_module(f"sme_registry.studies.report.{_LAZY[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

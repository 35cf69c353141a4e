"""Explorers of the models that a study kept, one page each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from sme_registry.diagnosis import load_cell
from sme_registry.errors import SMEError
from sme_registry.explorer import explorer_page, run_report
from sme_registry.spec import StudyFile
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.status import run_label

__all__ = ["Explorer", "explorers_of"]

_DIGITS = 16  # of a cell's key, in the name of its page


class Explorer(NamedTuple):
    """A page of one run."""

    label: str
    path: str
    content: str


def explorers_of(ledger: Ledger, file: StudyFile, models: Mapping[str, Path]) -> list[Explorer]:
    """A page for each run on a single task whose model was kept, in the plan's order."""
    pages: dict[str, Explorer] = {}
    for planned in file.plan.cells:
        key = planned.cell.digest
        if planned.in_stream or key not in models or key in pages:
            continue
        label = run_label(planned.class_name, planned.algorithm, planned.run)
        name = key.removeprefix("sha256:")[:_DIGITS]
        try:
            report = run_report(ledger.folder, key)
        except SMEError:  # of another version: the page then lacks its regions
            report = None
        try:
            content = explorer_page(load_cell(ledger.folder, key), report=report)
        except SMEError:
            continue
        pages[key] = Explorer(label, f"explorers/{name}.html", content)
    return list(pages.values())

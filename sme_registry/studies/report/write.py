"""`write_report`: a study's folder to its report.

    REPORT/index.html           the page: findings, figures and tables, nothing outside it
    REPORT/findings.json        the findings as data
    REPORT/figures/*.png .pdf   the figures, at the width of a printed page
    REPORT/tables/*.csv         every number
    REPORT/tables/*.tex         what a paper prints

The same results give the same files. Files of an earlier report that this one does not write stay.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sme_registry.errors import OptionError
from sme_registry.io import to_json, write_atomically
from sme_registry.studies.engine.ledger import REPORT, Ledger
from sme_registry.studies.report.analysis import analyse
from sme_registry.studies.report.exports import csv_tables, text_tables
from sme_registry.studies.report.figures import draw_figures
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.frames import plan_file
from sme_registry.studies.report.page import page

FORMATS = ("html", "png", "pdf", "csv", "latex")
_DRAWN = {"html": "svg", "png": "png", "pdf": "pdf"}


def write_report(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Write the report of a study from whatever of its runs has finished.

    Models that the study kept are loaded for the maps of the plane, and loading one can run code of
    whoever made it. Nothing else of the folder is more than data.

    Args:
      folder: of the study.
      out: the folder to write; None for FOLDER/report.
      formats: of `FORMATS`.

    Returns:
      The files written, the page first.

    Raises:
      OptionError: an unknown format, no study in the folder, none of its runs has finished, or the
        report cannot be written.
      SpecError: the folder's plan is no plan.
      MissingDependencyError: Matplotlib is not installed.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise OptionError(f"format={','.join(unknown)!r}: must be of {', '.join(FORMATS)}.")
    ledger = Ledger(folder)
    file = plan_file(ledger)
    keys = [planned.cell.digest for planned in file.plan.cells]
    results = ledger.results(keys)
    if not results:
        raise OptionError(
            f"folder={str(folder)!r}: none of its {len(keys)} runs has finished. Run them with "
            "`sme study run`, and look at them with `sme study status`."
        )
    failures = {key: failure.error for key, failure in ledger.failures(keys).items()}
    analysis = analyse(file, results, failures)
    tables = text_tables(analysis)
    models = {key: path for key in results if (path := ledger.model_path(key)).exists()}
    drawn = [ending for name, ending in _DRAWN.items() if name in formats]
    figures, absent = draw_figures(analysis, drawn, models) if drawn else ([], [])

    target = Path(folder) / REPORT if out is None else Path(out)
    contents: dict[str, str | bytes] = {}
    if "html" in formats:
        found = findings(analysis)
        contents["index.html"] = page(analysis, found, figures, absent, tables)
        contents["findings.json"] = to_json(found.to_dict())
    for ending in ("png", "pdf"):
        if ending in formats:
            contents |= {f"figures/{x.name}.{ending}": x.files[ending] for x in figures}
    if "csv" in formats:
        contents |= {f"tables/{name}.csv": text for name, text in csv_tables(analysis).items()}
    if "latex" in formats:
        contents |= {f"tables/{table.name}.tex": table.latex() for table in tables}
    return [write_atomically(target / name, content) for name, content in contents.items()]

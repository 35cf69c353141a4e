"""`write_report`: a study's folder to its report.

    REPORT/index.html           the page: findings, figures and tables in one file
    REPORT/findings.json        the findings as data
    REPORT/figures/*.png .pdf   the figures, at the width of a printed page
    REPORT/tables/*.csv         every number
    REPORT/tables/*.tex         the tables of a paper
    REPORT/explorers/*.html     on request, a page for each model that the study kept

The same results give the same files. Other files of an earlier report are kept.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from sme_registry.errors import OptionError
from sme_registry.io import refuse_unwritable, to_json, write_atomically
from sme_registry.studies.engine.ledger import REPORT, Ledger
from sme_registry.studies.engine.status import requested
from sme_registry.studies.report.analysis import Analysis, analyse
from sme_registry.studies.report.explorers import Explorer, explorers_of
from sme_registry.studies.report.exports import csv_tables, text_tables
from sme_registry.studies.report.figures import draw_figures
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.frames import plan_file
from sme_registry.studies.report.page import page

__all__ = ["FORMATS", "write_report"]

FORMATS = ("html", "png", "pdf", "csv", "latex")
_FIGURE_FORMATS = {"html": "svg", "png": "png", "pdf": "pdf"}


def write_report(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    formats: Sequence[str] = FORMATS,
    *,
    explorers: bool = False,
) -> list[Path]:
    """Write the report of a study's finished runs, and return its files, the page first.

    The maps of the plane and the explorers need the models that the study kept, and loading a model
    can run code of its author. All other files of the folder are read as data.

    Args:
      out: the folder to write; None for FOLDER/report.
      formats: of "html", "png", "pdf", "csv" and "latex".
      explorers: whether to write an explorer of each kept model, to which the page links.

    Examples:
      >>> from sme_registry import studies
      >>> studies.write_report("study", "report", formats=["csv"])[-1].suffix
      '.csv'
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise OptionError(f"format={','.join(unknown)!r}: must be of {', '.join(FORMATS)}.")
    ledger = Ledger(folder)
    file = plan_file(ledger)
    keys = list(dict.fromkeys(planned.cell.digest for planned in file.plan.cells))
    results = ledger.results(keys)
    if not results:
        raise OptionError(
            f"folder={str(folder)!r}: none of its {len(keys)} runs has finished. Run them with "
            "`sme study run`, and check them with `sme study status`."
        )
    target = Path(folder) / REPORT if out is None else Path(out)
    refuse_unwritable(target / "index.html")
    failures = {key: failure.error for key, failure in ledger.failures(keys).items()}
    models = {key: path for key in results if (path := ledger.model_path(key)).exists()}
    analysis = analyse(file, results, failures, requested=requested(ledger, file))
    pages = explorers_of(ledger, file, models) if explorers else []
    contents = _contents(analysis, models, formats, pages)
    return [write_atomically(target / name, content) for name, content in contents.items()]


def _contents(
    analysis: Analysis,
    models: Mapping[str, Path],
    formats: Sequence[str],
    explorers: Sequence[Explorer],
) -> dict[str, str | bytes]:
    """The contents of each file, by its name in the report."""
    tables = text_tables(analysis)
    figure_formats = [_FIGURE_FORMATS[name] for name in formats if name in _FIGURE_FORMATS]
    figures, absent = draw_figures(analysis, figure_formats, models) if figure_formats else ([], [])
    contents: dict[str, str | bytes] = {}
    if "html" in formats:
        document = findings(analysis)
        contents["index.html"] = page(analysis, document, figures, absent, tables, explorers)
        contents["findings.json"] = to_json(document.to_dict())
    for ending in ("png", "pdf"):
        if ending in formats:
            contents |= {f"figures/{x.name}.{ending}": x.files[ending] for x in figures}
    if "csv" in formats:
        contents |= {f"tables/{name}.csv": text for name, text in csv_tables(analysis).items()}
    if "latex" in formats:
        contents |= {f"tables/{table.name}.tex": table.latex() for table in tables}
    return contents | {each.path: each.content for each in explorers}

"""`sme study report`: what a study shows, as one page, figures and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from sme_registry.terminal.output import out as stdout


def report(
    folder: Annotated[Path, typer.Argument(help="Of the study.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The folder to write; by default FOLDER/report."),
    ] = None,
    formats: Annotated[
        str,
        typer.Option("--format", metavar="FORMATS", help="Of html,png,pdf,csv,latex; with commas."),
    ] = "html,png,pdf,csv,latex",
) -> None:
    """What a study shows: which property of the task breaks an algorithm, and how sure that is.

    One page, index.html, which needs nothing beside it; the figures as PNG and PDF, every number as
    CSV, and LaTeX tables. From whatever has finished: run it while the study runs, too.

    Maps of the plane need models kept by `sme study run --keep-models`. They are loaded, and
    loading a model can run code of whoever made it.

    Examples:

      sme study report runs/smoke

      sme study report runs/all --out paper/study --format pdf,latex
    """
    from sme_registry.studies import write_report

    chosen = [name.strip() for name in formats.split(",") if name.strip()]
    written = write_report(folder, out, tuple(dict.fromkeys(chosen)))
    folders = dict.fromkeys(path.parent for path in written if path.name != "index.html")
    for path in written:
        if path.name == "index.html":
            stdout().print(escape(str(path)), soft_wrap=True)
    for place in folders:
        count = sum(path.parent == place for path in written)
        stdout().print(f"{escape(str(place))}  {count} files", soft_wrap=True)

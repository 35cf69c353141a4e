"""Files that commands write: checked before, listed after."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.markup import escape

from sme_registry.errors import OptionError, SMEError
from sme_registry.io import install_command, is_installed, refuse_existing
from sme_registry.io.tables import Table
from sme_registry.io.terminal import err, out, print_json


def check_document_path(path: Path, *, force: bool) -> None:
    """Check the path of a document that a command is about to write.

    Raises:
      OptionError: it does not end in .json, or exists and `force` is false.
    """
    if path.suffix != ".json":
        raise OptionError(f"{path}: must end in .json, so that commands recognise it as a path.")
    refuse_existing(path, force=force)


def can_draw() -> bool:
    """Whether figures can be drawn; prints a warning if not."""
    if is_installed("matplotlib"):
        return True
    err().print(
        f"no figures: Matplotlib is not installed ({escape(install_command('plot'))})",
        soft_wrap=True,
    )
    return False


def write_run_explorer(folder: Path) -> list[Path]:
    """Write the explorer of a finished run on one task, where a page can show it.

    Where it cannot, that is printed: the run is complete without.
    """
    from sme_registry import explorer
    from sme_registry.diagnosis import load_run

    try:
        path, report = folder / explorer.FILE, explorer.run_report(folder)
        return [explorer.write_explorer(path, load_run(folder), report=report)]
    except SMEError as error:
        err().print(f"no explorer: {escape(str(error))}", soft_wrap=True)
        return []


def print_training(
    result: Any, folder: Path, tables: Iterable[Table] = (), *, json: bool = False
) -> None:
    """Print the record and report of a training in a folder as JSON, or its tables."""
    if json:
        record, report = result.record.to_dict(), result.report.to_dict()
        print_json({"folder": str(folder), "run": record, "evaluation": report})
        return
    print_tables([*tables, *result.report.tables()])
    out().print(f"All files are in {escape(str(folder))}{os.sep}", soft_wrap=True)


def print_tables(tables: Iterable[Table]) -> None:
    """Print tables with an empty line between them."""
    for index, table in enumerate(tables):
        if index:
            out().print()
        out().print(table)


def print_written(paths: Iterable[Path]) -> None:
    """List the files that were written, on standard error."""
    for path in paths:
        err().print(f"wrote {escape(str(path))}", soft_wrap=True)

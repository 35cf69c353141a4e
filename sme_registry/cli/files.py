"""Files that commands write: checked before, listed after."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from pathlib import Path

from rich.markup import escape

from sme_registry.errors import OptionError
from sme_registry.io import refuse_existing
from sme_registry.terminal import err


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
    if importlib.util.find_spec("matplotlib") is not None:
        return True
    err().print("no figures: matplotlib is not installed (pip install 'sme-registry\\[plot]')")
    return False


def print_written(paths: Iterable[Path]) -> None:
    """List the files that were written, on standard error."""
    for path in paths:
        err().print(f"wrote {escape(str(path))}", soft_wrap=True)

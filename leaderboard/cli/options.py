"""Arguments that several commands take."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sme_registry.spec import Suite, SuiteFile, catalogue

BoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's folder.", show_default=True)
]
SuiteName = Annotated[str, typer.Option(help="A suite's name (`sme list`), or its file's path.")]
ProtocolName = Annotated[
    str, typer.Option(help="A protocol's name (`sme list`), or its file's path.")
]
KEY_VARIABLE = "SME_LEADERBOARD_KEY"
KeyFile = Annotated[
    Path,
    typer.Option(
        "--key",
        envvar=KEY_VARIABLE,
        help="Your signing key; `keygen` makes one.",
    ),
]


def default_key() -> Path:
    """Where a submitter's key lies, if nothing else is said."""
    return Path(typer.get_app_dir("sme-leaderboard")) / "ed25519.key"


def find_suite(name: str) -> tuple[str, Suite]:
    """A suite's versioned name and the suite, by name or path.

    Raises:
      UnknownNameError, SpecError: there is none, or the file is not one.
    """
    is_path = name.endswith(".json") or (os.sep in name and os.path.isfile(name))
    file = SuiteFile.read(name) if is_path else catalogue.find(SuiteFile, name)
    return file.versioned_name, file.suite


def find_suite_file(name: str) -> SuiteFile:
    """As `find_suite`, with its envelope."""
    is_path = name.endswith(".json") or (os.sep in name and os.path.isfile(name))
    return SuiteFile.read(name) if is_path else catalogue.find(SuiteFile, name)


def is_url(board: str) -> bool:
    """Whether a board is one that is served."""
    return board.startswith(("http://", "https://"))

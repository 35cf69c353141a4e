"""Arguments that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sme_registry.spec import SuiteFile, catalogue

BoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's folder.", show_default=True)
]
BoardOrUrl = Annotated[
    str, typer.Argument(metavar="BOARD", help="A board's folder, or the URL of a served board.")
]
BundleFolder = Annotated[Path, typer.Argument(metavar="BUNDLE", help="The submission's folder.")]
SuiteName = Annotated[str, typer.Option(help="A suite's name (see `sme list`) or file.")]
ProtocolName = Annotated[str, typer.Option(help="A protocol's name (see `sme list`) or file.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
KEY_VARIABLE = "SME_LEADERBOARD_KEY"
DEFAULT_KEY = Path(typer.get_app_dir("sme-leaderboard")) / "ed25519.key"
KeyFile = Annotated[
    Path,
    typer.Option("--key", envvar=KEY_VARIABLE, help="Your signing key, as `keygen` creates it."),
]


def find_suite(name: str) -> SuiteFile:
    """A suite by its name in the catalogue or its file's path."""
    is_path = name.endswith(".json") or (os.sep in name and os.path.isfile(name))
    return SuiteFile.read(name) if is_path else catalogue.find(SuiteFile, name)


def is_url(board: str) -> bool:
    """Whether a board is given by its URL."""
    return board.startswith(("http://", "https://"))

"""Arguments that several commands share, and how their text is read."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from leaderboard.documents.board import FILE, BoardDocument, Folder, refuse_unscored
from leaderboard.documents.signed import Receiver
from leaderboard.store import Store
from leaderboard.web import client
from sme_registry.errors import OptionError
from sme_registry.io.terminal import Progress, err
from sme_registry.spec import ProtocolFile, SuiteFile, catalogue

WITH_SEASONS = find_spec("leaderboard.seasons") is not None
Board: type[Store] = Store
"""How boards are opened: with seasons, if this package has them."""

if WITH_SEASONS:
    from leaderboard.seasons.store import SeasonStore

    Board = SeasonStore

_LONG_LOG = 2000  # entries, read in two seconds or so
_HOST = re.compile(r"[A-Za-z0-9.-]+:\d+(/.*)?|localhost(/.*)?|[A-Za-z0-9-]+(\.[A-Za-z0-9-]+)+/.*")


def is_url(board: str) -> bool:
    """Whether a board is given by its URL."""
    return "://" in board


def board_folder(board: str | Path) -> Path:
    """The folder of a board on this machine.

    Raises:
      OptionError: it is a URL, a file, or nothing that exists.
    """
    name = str(board)
    if is_url(name):
        raise OptionError(
            f"{name!r}: must be a board's folder: this command reads its files. Open the URL "
            "in a browser for the ranking. `submit`, `show`, `check` and `withdraw` accept a URL."
        )
    path = Path(board)
    if path.is_file():
        raise OptionError(f"{name!r}: is a file. Give the folder that contains board.json.")
    if path.exists():
        return path
    if _HOST.fullmatch(name):
        raise OptionError(
            f"{name!r}: no such folder. For a served board, give the whole URL, such as "
            f"http://{name}"
        )
    suite = _suite_named(name)
    if suite is not None:
        raise OptionError(f"{name!r}: no such folder. {_how_to_use(suite)}")
    raise OptionError(
        f"{name!r}: no such folder. Correct it, or create a board with "
        f"`sme-leaderboard init {name}`."
    )


def open_board(board: Path) -> Store:
    """Open a board read-only; a bar shows the progress if its log is long.

    Raises:
      BoardError, TamperedError: as `Store.open`.
    """

    log = Folder(board).log
    entries = sum(1 for _ in os.scandir(log)) if log.is_dir() else 0
    with Progress(
        "reading", entries, console=err(), unit="log entries", enabled=entries > _LONG_LOG
    ) as progress:
        return Board.open(board, read_only=True, progress=progress.update)


def new_board_folder(board: str | Path) -> Path:
    """The folder of a board to create.

    Raises:
      OptionError: it is a URL, a file, or the name of a suite.
    """
    name = str(board)
    if is_url(name):
        raise OptionError(
            f"{name!r}: must be a folder on this machine. To serve a board at a URL, create "
            "it and run `sme-leaderboard serve`."
        )
    if Path(board).is_file():
        use = f" To use this suite: sme-leaderboard init board --suite {name}"
        raise OptionError(f"{name!r}: is a file. Give a new folder.{use * name.endswith('.json')}")
    suite = _suite_named(name)
    if suite is not None:
        raise OptionError(
            f"{name!r}: must be a folder. {_how_to_use(suite)}. For a folder of this "
            f"name, give .{os.sep}{name}"
        )
    return Path(board)


def board_or_url(board: str) -> str:
    """A board's folder or the URL of a served board, as it is given.

    Raises:
      OptionError: see `board_folder`.
    """
    return board if is_url(board) else str(board_folder(board))


def _suite_named(name: str) -> SuiteFile | None:
    """The suite of the catalogue with this name, with or without its version."""
    suites = catalogue.entries(SuiteFile)
    return next((file for file in suites if name in (file.name, file.versioned_name)), None)


def _how_to_use(suite: SuiteFile) -> str:
    return (
        f"{suite.name} is a suite. To create a board for it: sme-leaderboard init board "
        f"--suite {suite.name}"
    )


BoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's folder.", parser=board_folder)
]
NewBoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's new folder.", parser=new_board_folder)
]
BoardOrUrl = Annotated[
    str,
    typer.Argument(
        metavar="BOARD",
        help="A board's folder, or the URL of a served board.",
        parser=board_or_url,
    ),
]
BundleFolder = Annotated[Path, typer.Argument(metavar="BUNDLE", help="The submission's folder.")]

SuiteName = Annotated[
    str,
    typer.Option(
        help="A suite's name (see `sme list`) or file, or the board that has it.",
        autocompletion=catalogue.completion(SuiteFile),
    ),
]
complete_protocol = catalogue.completion(ProtocolFile)
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
KEY_VARIABLE = "SME_LEADERBOARD_KEY"
DEFAULT_KEY = Path(typer.get_app_dir("sme-leaderboard")) / "ed25519.key"
KeyFile = Annotated[
    Path,
    typer.Option(
        "--key",
        envvar=KEY_VARIABLE,
        help="Your signing key, as `keygen` creates it.",
        show_default="sme-leaderboard/ed25519.key in your settings folder",
    ),
]

MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        help="Name of the method: letters a–z, digits, single spaces and ._+-().",
    ),
]
SubmitterName = Annotated[
    str,
    typer.Option(
        "--submitter",
        help="Your name or your lab's; on a board it belongs to the first key that uses it.",
    ),
]
MethodVersion = Annotated[str, typer.Option(help="Version of the method.")]
Family = Annotated[
    str | None, typer.Option(help="Family such as PPO; the method's name by default.")
]
CodeLink = Annotated[str | None, typer.Option("--code", help="An https link to the code.")]
Statement = Annotated[str, typer.Option(help="A note for readers of the board.")]


def find_suite(name: str) -> SuiteFile:
    """A suite by its name in the catalogue, its file's path, or a board that has it.

    Raises:
      UnknownNameError, SpecError: there is none, it is invalid, or boards do not score it.
      BoardError: the served board cannot be reached.
    """
    if is_url(name) or os.path.isfile(os.path.join(name, FILE)):
        return board_document(name).suite_file
    is_path = name.endswith(".json") or (os.sep in name and os.path.isfile(name))
    file = SuiteFile.read(name) if is_path else catalogue.find(SuiteFile, name)
    refuse_unscored(file.suite)
    return file


def board_document(board: str) -> BoardDocument:
    """The definition of a board, by its folder or URL.

    Raises:
      BoardError: there is no board, or it cannot be reached.
    """

    return client.board_document(board) if is_url(board) else Folder(board).read()


def receiver_of(board: str) -> Receiver:
    """For whom to sign what is given to a board, by its folder or URL; errors as above."""
    return client.receiver_of(board) if is_url(board) else Receiver(Folder(board).read().key)

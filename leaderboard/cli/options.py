"""Arguments that several commands share, and how their text is read."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from leaderboard.documents.board import FILE, BoardDocument, Folder, refuse_unscored
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.store import Store
from leaderboard.web import client
from sme_registry.errors import OptionError
from sme_registry.io.terminal import Progress, err, print_note
from sme_registry.spec import ProtocolFile, SuiteFile, catalogue

WITH_SEASONS = find_spec("leaderboard.seasons") is not None
Board: type[Store] = Store
"""How boards are opened: with seasons, if this package has them."""

if WITH_SEASONS:
    from leaderboard.seasons.store import SeasonStore

    Board = SeasonStore

_LONG_LOG = 2000  # entries, read in two seconds or so


def is_url(board: str) -> bool:
    """Whether a board is given by its URL."""
    return "://" in board


def board_folder(board: str | Path) -> Path:
    """The folder of a board on this machine."""
    path = Path(board)
    if is_url(str(board)):
        raise OptionError(
            f"{str(board)!r}: must be a board's folder: this command reads its files. Open the URL "
            "in a browser for the ranking. `submit`, `show` and `withdraw` accept a URL."
        )
    if not path.is_dir():
        raise OptionError(
            f"{str(board)!r}: no such folder. Give the folder that contains board.json, or for a "
            "served board its whole URL. `sme-leaderboard init` creates a board."
        )
    return path


def open_board(board: Path) -> Store:
    """Open a board read-only; a bar shows the progress if its log is long."""

    log = Folder(board).log
    entries = sum(1 for _ in os.scandir(log)) if log.is_dir() else 0
    with Progress(
        "reading", entries, console=err(), unit="log entries", enabled=entries > _LONG_LOG
    ) as progress:
        return Board.open(board, read_only=True, progress=progress.update)


def new_board_folder(board: str | Path) -> Path:
    """The folder of a board to create, which is not the name of a suite."""
    name = str(board)
    if is_url(name) or Path(board).is_file():
        raise OptionError(
            f"{name!r}: must be a folder on this machine. To serve a board at a URL, create it and "
            "run `sme-leaderboard serve`; for a suite's file, `sme-leaderboard init board --suite "
            "FILE`."
        )
    if any(name in (file.name, file.versioned_name) for file in catalogue.entries(SuiteFile)):
        raise OptionError(
            f"{name!r}: must be a folder, and is a suite. Give `board --suite {name}`; for a "
            f"folder of this name, .{os.sep}{name}"
        )
    return Path(board)


def board_or_url(board: str) -> str:
    """A board's folder or the URL of a served board, as it is given."""
    return board if is_url(board) else str(board_folder(board))


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
SubmissionId = Annotated[
    str,
    typer.Argument(
        metavar="ID",
        help="The submission's id: in full for a URL; its first digits suffice for a folder.",
    ),
]
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
        help="Your signing key, created when you first need it.",
        show_default="sme-leaderboard/ed25519.key in your settings folder",
    ),
]

ADVANCED = "Advanced"
"""The panel of the options that few need, where a command has more than ten."""

method_name = typer.Option(
    "--method", help="Name of the method: letters a–z, digits, single spaces and ._+-()."
)
submitter_name = typer.Option(
    "--submitter",
    help="Your name or your lab's; on a board it belongs to the first key that uses it.",
)
MethodName = Annotated[str, method_name]
SubmitterName = Annotated[str, submitter_name]
MethodVersion = Annotated[
    str, typer.Option(help="Version of the method.", rich_help_panel=ADVANCED)
]
Family = Annotated[
    str | None,
    typer.Option(
        help="Family such as PPO; the method's name by default.", rich_help_panel=ADVANCED
    ),
]
CodeLink = Annotated[str | None, typer.Option("--code", help="An https link to the code.")]
Statement = Annotated[
    str, typer.Option(help="A note for readers of the board.", rich_help_panel=ADVANCED)
]


def own_key(path: Path) -> SigningKey:
    """The user's signing key, created when it is first needed."""
    if not path.exists():
        SigningKey.generate().write(path)
        print_note(
            f"Created your signing key, {escape(str(path))}. It proves who you are: keep it "
            "secret, and keep a copy."
        )
    return SigningKey.read(path)


def find_suite(name: str) -> SuiteFile:
    """A suite by its name in the catalogue, its file's path, or a board that has it."""
    if is_url(name) or os.path.isfile(os.path.join(name, FILE)):
        return board_document(name).suite_file
    is_path = name.endswith(".json") or (os.sep in name and os.path.isfile(name))
    file = SuiteFile.read(name) if is_path else catalogue.find(SuiteFile, name)
    refuse_unscored(file.suite)
    return file


def board_document(board: str) -> BoardDocument:
    """The definition of a board, by its folder or URL."""

    return client.board_document(board) if is_url(board) else Folder(board).read()


def receiver_of(board: str) -> Receiver:
    """For whom to sign what is given to a board, by its folder or URL; errors as above."""
    return client.receiver_of(board) if is_url(board) else Receiver(Folder(board).read().key)

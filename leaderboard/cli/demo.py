"""`sme-leaderboard demo`: one trained run through the whole pipeline, on a board of its task."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from leaderboard.cli import keeping, reading
from leaderboard.documents.board import Folder
from leaderboard.documents.keys import SigningKey
from leaderboard.errors import BoardError
from sme_registry.errors import OptionError
from sme_registry.spec import EvaluationProtocol, Suite, SuiteFile
from sme_registry.terminal import err, out

_FOLDERS = ("bundle", "site", "board")  # removed in this order: all are known by the board
_TITLE, _SUITE = "Demonstration", "demo"


def demo(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A folder that `sme train` or `sme demo` wrote.")
    ] = Path("runs/demo"),
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="By default RUN/leaderboard.")
    ] = None,
) -> None:
    """Submit a trained run to a board of its own task, score it, and write the board's page.

    An earlier demonstration in the same folder is replaced; anything else there is refused.

    Examples:

      sme demo

      sme-leaderboard demo runs/demo
    """
    from leaderboard import intake
    from leaderboard.bundle import make_bundle
    from leaderboard.store import Store
    from sme_registry.training import RunRecord

    record = RunRecord.read(run)
    if record is None or record.status != "finished":
        raise OptionError(f"run={str(run)!r}: holds no finished run. `sme demo` makes one.")
    folder = run / "leaderboard" if out_folder is None else out_folder
    _refuse_others(folder)
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)  # what resists is named by who writes next

    setting = record.spec.to_dict()
    seed = setting.pop("seed")
    suite = Suite.from_dict({"classes": [{"name": _SUITE, "setting": setting, "seeds": [seed]}]})
    file = SuiteFile(name=_SUITE, version=1, digest=suite.digest, suite=suite)
    protocol: EvaluationProtocol = record.protocol

    err().print("A board of this task alone, with the two reference rows; the agent is submitted.")
    with Store.create(
        folder / "board",
        title=_TITLE,
        suite_name=file.versioned_name,
        suite=suite,
        protocol_name=_name_of(protocol),
        protocol=protocol,
    ) as store:
        intake.submit_references(store)
        make_bundle(
            folder / "bundle",
            suite=file,
            key=SigningKey.generate(),
            runs=[run],
            method=record.algorithm,
            version="demo",
            family=record.algorithm,
            knowledge="generic",
            submitter="Demonstration",
        )
        intake.submit_bundle(store, folder / "bundle")
    keeping.score(folder / "board")
    reading.rank(folder / "board")
    out().print(
        "One run is listed and not ranked: a rank needs ten in each class of a suite.\n"
        f"The board, to be opened in a browser ({escape(str(folder))}):"
    )
    keeping.site(folder / "board", folder / "site")


def _refuse_others(folder: Path) -> None:
    """Refuse a folder where something stands that no demonstration has made.

    Raises:
      OptionError: with what it is.
    """
    there = [folder / name for name in sorted(_FOLDERS) if os.path.lexists(folder / name)]
    if there and not _is_demonstration(folder / "board"):
        raise OptionError(
            f"out={str(folder)!r}: {', '.join(map(str, there))}: there already, and not made by a "
            "demonstration. Nothing was removed: give another --out, or move them elsewhere."
        )


def _is_demonstration(path: Path) -> bool:
    """Whether a demonstration made this board; a link may lead to one that is meant to stay."""
    try:
        document = Folder(path).read()
    except BoardError:
        return False
    made = (_TITLE, f"{_SUITE}-v1", [_SUITE])
    classes = [member.name for member in document.suite.classes]
    return not path.is_symlink() and (document.title, document.suite_name, classes) == made


def _name_of(protocol: EvaluationProtocol) -> str:
    """The protocol's name in the catalogue; a word where it has none."""
    from sme_registry.spec import ProtocolFile, catalogue

    known = {file.digest: file.versioned_name for file in catalogue.entries(ProtocolFile)}
    return known.get(protocol.digest, "custom")

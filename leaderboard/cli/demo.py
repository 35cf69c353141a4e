"""`sme-leaderboard demo`: one trained run through the whole pipeline, on a board for its task."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from leaderboard.cli import administration, results
from leaderboard.documents.board import Folder
from leaderboard.documents.keys import SigningKey
from leaderboard.errors import BoardError
from sme_registry.errors import OptionError
from sme_registry.io.terminal import err, out
from sme_registry.spec import EvaluationProtocol, Suite, SuiteFile

if TYPE_CHECKING:
    from sme_registry.training import RunRecord

_FOLDERS = ("bundle", "site", "board")  # removed in this order: the board identifies the others
_TITLE, _SUITE = "Demonstration", "demo"


def demo(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run folder of `sme train` or `sme demo`.")
    ] = Path("runs/demo"),
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; RUN/leaderboard by default.")
    ] = None,
) -> None:
    """Submit a trained run to a board for its task, score it and write the board's pages.

    An earlier demonstration in the same folder is replaced; other files there are never touched.

    Examples:

      sme demo

      sme-leaderboard demo runs/demo
    """
    from leaderboard.artefact.isolation import isolation_for_own
    from sme_registry.training import RunRecord

    record = RunRecord.read(run)
    if record is None or record.status != "finished":
        raise OptionError(f"run={str(run)!r}: holds no finished run. Create one with `sme demo`.")
    folder = run / "leaderboard" if out_folder is None else out_folder
    _refuse_other_files(folder)
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)  # the next write reports what remains

    err().print("Creating a board with this task and two reference rows, and submitting the agent.")
    _create_board(folder, run, record)
    administration.score_waiting(folder / "board", 1, isolation_for_own())
    results.rank(folder / "board")
    out().print(
        "The run is listed without a rank, which needs ten runs in each class.\n"
        f"Open the board in a browser ({escape(str(folder))}):"
    )
    administration.site(folder / "board", folder / "site")


def _create_board(folder: Path, run: Path, record: RunRecord) -> None:
    """Create a board for a run's task, and submit the run."""
    from leaderboard import intake
    from leaderboard.bundle import make_bundle
    from leaderboard.store import Store

    setting = record.spec.to_dict()
    seed = setting.pop("seed")
    suite = Suite.from_dict({"classes": [{"name": _SUITE, "setting": setting, "seeds": [seed]}]})
    file = SuiteFile(name=_SUITE, version=1, digest=suite.digest, suite=suite)
    with Store.create(
        folder / "board",
        title=_TITLE,
        suite_name=file.versioned_name,
        suite=suite,
        protocol_name=_name_of(record.protocol),
        protocol=record.protocol,
    ) as store:
        intake.submit_references(store)
        make_bundle(
            folder / "bundle",
            suite=file,
            board=store.document.key,
            key=SigningKey.generate(),
            runs=[run],
            method=record.algorithm,
            version="demo",
            family=record.algorithm,
            knowledge="generic",
            submitter="Demonstration",
        )
        intake.submit_bundle(store, folder / "bundle")


def _refuse_other_files(folder: Path) -> None:
    """Refuse a folder with files that no demonstration created."""
    existing = [folder / name for name in sorted(_FOLDERS) if os.path.lexists(folder / name)]
    if existing and not _is_demonstration(folder / "board"):
        raise OptionError(
            f"out={str(folder)!r}: {', '.join(map(str, existing))}: already exists and is not "
            "from a demonstration. Nothing was removed: use another --out, or move the files."
        )


def _is_demonstration(path: Path) -> bool:
    """Whether a demonstration created this board; a link may lead to a board worth keeping."""
    try:
        document = Folder(path).read()
    except BoardError:
        return False
    expected = (_TITLE, f"{_SUITE}-v1", [_SUITE])
    classes = [member.name for member in document.suite.classes]
    return not path.is_symlink() and (document.title, document.suite_name, classes) == expected


def _name_of(protocol: EvaluationProtocol) -> str:
    """The protocol's name in the catalogue, or "custom"."""
    from sme_registry.spec import ProtocolFile, catalogue

    known = {file.digest: file.versioned_name for file in catalogue.entries(ProtocolFile)}
    return known.get(protocol.digest, "custom")

"""`sme-leaderboard init · score · site · serve · reindex · gc`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from leaderboard.cli.options import BoardFolder, ProtocolName, SuiteName, find_suite
from leaderboard.errors import BoardError
from sme_registry.terminal import Progress, err, out, print_json


def init(
    board: BoardFolder = Path("board"),
    suite: SuiteName = "smoke-v1",
    protocol: ProtocolName = "paper-v1",
    title: Annotated[
        str | None, typer.Option(help="The page's header; by default it names the suite.")
    ] = None,
    runs_to_rank: Annotated[
        int, typer.Option(help="Fewest runs in each class for an entry to be ranked.")
    ] = 10,
) -> None:
    """Make a board, with its key and the two reference rows waiting to be scored.

    The rows are the optimal policy and the constant ½, through the pipeline that every submission
    takes. Where they leave 0 and 1, the board shows nothing.

    Examples:

      sme-leaderboard init board --suite core

      sme-leaderboard score board
    """
    from leaderboard import intake
    from leaderboard.store import Store
    from sme_registry.evaluation import resolve_protocol

    name, document = find_suite(suite)
    with Store.create(
        board,
        title=title or f"SME leaderboard: {name}",
        suite_name=name,
        suite=document,
        protocol_name=Path(protocol).stem,
        protocol=resolve_protocol(protocol),
        runs_to_rank=runs_to_rank,
    ) as store:
        ids = intake.submit_references(store)
    out().print(f"Board {escape(str(board))}: {name}, {Path(protocol).stem}.")
    out().print(f"{len(ids)} reference rows wait: sme-leaderboard score {escape(str(board))}")


def score(
    board: BoardFolder = Path("board"),
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=1, max=256, help="Processes at once.")
    ] = 1,
) -> None:
    """Score what waits. May run several times at once, and may be killed at any point.

    Each policy runs in a process of its own, without your files and with limits on time and memory.

    Examples:

      sme-leaderboard score board --workers 2
    """
    from leaderboard.scoring.worker import run_scorers
    from leaderboard.store import Store

    with Store.open(board) as store:
        entries = store.entries()
    before = {entry.id for entry in entries if entry.status != "waiting"}
    waiting = len(entries) - len(before)
    if not waiting:
        out().print("Nothing waits to be scored.")
        return
    with Progress("scoring", waiting, console=err(), unit="submissions") as progress:
        run_scorers(board, workers, progress=progress.update_of)
    with Store.open(board, read_only=True) as store:
        now = [entry.status for entry in store.entries() if entry.id not in before]
    counts = {name: now.count(name) for name in ("scored", "rejected", "waiting", "withdrawn")}
    said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    out().print(f"{said}." + (f" Done before: {len(before)}." if before else ""))


def site(
    board: BoardFolder = Path("board"),
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="By default BOARD/site.")
    ] = None,
) -> None:
    """Write the board as pages that need no server: open index.html, or put them on any host.

    Examples:

      sme-leaderboard site board --out public
    """
    from leaderboard.store import Store
    from leaderboard.web.site import write_site

    target = board / "site" if out_folder is None else out_folder
    with Store.open(board, read_only=True) as store:
        total = len(store.entries())
        with Progress("writing", total, console=err(), unit="pages") as progress:
            index = write_site(store, target, progress=progress.update_of)
    out().print(str(index.resolve()), soft_wrap=True, markup=False)


def serve(
    board: BoardFolder = Path("board"),
    host: Annotated[str, typer.Option(help="Where to listen; this machine alone by default.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8000,
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=0, max=256, help="Scorers beside the server.")
    ] = 1,
) -> None:
    """Serve the board: the same pages, and an API that takes submissions.

    Put a server that speaks HTTPS before it where others are to reach it.

    Examples:

      sme-leaderboard serve board --port 8000 --workers 2
    """
    from leaderboard.documents.board import Folder
    from leaderboard.web.serve import serve as serve_board

    Folder(board).read()  # a wrong folder fails before anything listens
    serve_board(board, host=host, port=port, workers=workers)


def reindex(board: BoardFolder = Path("board")) -> None:
    """Make the index anew from the board's files, which are all that counts.

    Examples:

      sme-leaderboard reindex board
    """
    from leaderboard.store import Store

    with Store.open(board, reindex=True) as store:
        out().print(f"{len(store.entries()):,} entries indexed.")


def gc(
    board: BoardFolder = Path("board"),
    older_than_hours: Annotated[
        float, typer.Option(min=0.0, help="Younger ones may belong to an upload under way.")
    ] = 24.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go.")] = False,
    json: Annotated[bool, typer.Option("--json", help="The counts as JSON.")] = False,
) -> None:
    """Remove artefacts that no submission names, and what killed processes left half-written.

    Examples:

      sme-leaderboard gc board --dry-run
    """
    from leaderboard.store import Store, collect_garbage

    if older_than_hours != older_than_hours:
        raise BoardError("older_than_hours=nan: must be a number of hours, at least 0.")
    with Store.open(board) as store:
        report = collect_garbage(
            store, objects_older_than=older_than_hours * 3600.0, dry_run=dry_run
        )
    if json:
        print_json({"files": report.files, "bytes": report.bytes, "dry_run": dry_run})
        return
    verb = "would be removed" if dry_run else "removed"
    out().print(f"{report.files:,} files, {report.bytes / 2**20:,.1f} MiB {verb}.")

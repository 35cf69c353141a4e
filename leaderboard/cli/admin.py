"""`sme-leaderboard init · serve · score · site · admin · demo`: host a board."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from leaderboard import admission
from leaderboard.bundle import make_bundle
from leaderboard.cli import results
from leaderboard.cli.results import (
    WITH_SEASONS,
    Board,
    BoardFolder,
    Json,
    is_url,
    open_board,
    warn_without_sandbox,
)
from leaderboard.cli.submit import DEFAULT_KEY, KeyFile, SuiteName, find_suite, own_key
from leaderboard.documents.board import RUNS_TO_RANK, Folder
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.documents.submission import Description
from leaderboard.errors import BoardError
from leaderboard.gate.isolation import Isolation, available_isolation, isolation_for_own
from leaderboard.scoring.worker import Work, run_scorers
from leaderboard.store.log import collect_garbage
from leaderboard.web.pages import Section
from sme_registry.errors import OptionError
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import require_packages
from sme_registry.io.markup import plural
from sme_registry.io.terminal import Progress, err, out, print_json, print_line
from sme_registry.spec import EvaluationProtocol, ProtocolFile, Suite, SuiteFile, catalogue
from sme_registry.training import RunRecord


def new_board_folder(board: str | Path) -> Path:
    """The folder of a board to create, which is not the name of a suite."""
    name = str(board)
    suites = catalogue.entries(SuiteFile)
    if is_url(name) or any(name in (file.name, file.versioned_name) for file in suites):
        raise OptionError(
            f"{name!r}: must be a new folder on this machine. For a board of a suite, give `board "
            f"--suite {name}`; for a URL, create the board and run `sme-leaderboard serve`."
        )
    return Path(board)


NewBoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's new folder.", parser=new_board_folder)
]

app = typer.Typer()
admin = typer.Typer(no_args_is_help=True)
app.add_typer(admin, name="admin", help="Upkeep, which a served board mostly does by itself.")

# Its characters need no quotes in the commands that the pages show.
_PUBLIC_URL = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:]+\])(:\d{1,5})?(/[\w.~-]+)*/?", re.ASCII)

UnsafeNoSandbox = Annotated[
    bool,
    typer.Option(
        "--unsafe-no-sandbox",
        help="Score without bubblewrap: policies could read your files and use your network.",
    ),
]


@app.command()
def init(
    board: NewBoardFolder = Path("board"),
    suite: SuiteName = "smoke-v1",
    protocol: Annotated[
        str | None,
        typer.Option(
            help="A protocol's name (see `sme list`) or file; default paper-v1, for practice "
            "quick-v1.",
            autocompletion=catalogue.completion(ProtocolFile),
        ),
    ] = None,
    title: Annotated[
        str | None, typer.Option(help="Title of the pages; names the suite by default.")
    ] = None,
    runs_to_rank: Annotated[
        int | None,
        typer.Option(
            help="Runs that an entry needs in each class to be ranked; default 10, for practice "
            "one on each instance."
        ),
    ] = None,
    practice: Annotated[
        bool,
        typer.Option(
            "--practice", help="A board to try things out: few runs give a rank, as its pages say."
        ),
    ] = False,
) -> None:
    """Create a board with its key and two reference rows, which `serve` or `score` scores.

    The reference rows are the optimal policy and the constant ½. They pass through the same
    pipeline as every submission; if they score other than 0 and 1, the board shows no scores.

    Examples:

      sme-leaderboard init board --suite core

      sme-leaderboard init board --practice
    """
    file = find_suite(suite)
    protocol = protocol or ("quick-v1" if practice else "paper-v1")
    if runs_to_rank is None:
        instances = min(len(member.seeds) for member in file.suite.classes)
        runs_to_rank = min(instances, RUNS_TO_RANK - 1) if practice else RUNS_TO_RANK
    name, protocol_name = file.versioned_name, Path(protocol).stem
    with Board.create(
        board,
        title=title or f"SME leaderboard: {name}",
        suite_name=name,
        suite=file.suite,
        protocol_name=protocol_name,
        protocol=resolve_protocol(protocol),
        suite_description=file.description,
        suite_tags=file.tags,
        runs_to_rank=runs_to_rank,
    ) as store:
        admission.submit_references(store)
        document = store.document
    folder = escape(str(board))
    classes, instances = len(file.suite.classes), len(file.suite.instances)
    needed = plural(document.runs_needed, "trained policy", "trained policies")
    kind = "a practice board" if document.practice else "a board"
    out().print(f"Created {folder}: {kind} with suite {name} and protocol {protocol_name}.")
    print_line(
        f"A ranked entry needs {needed}: at least {runs_to_rank} in each class ({classes}), "
        f"equally many on each of its instances ({instances} in the suite)."
    )
    print_line(
        "Next, serve the board, which also scores its reference rows: "
        f"sme-leaderboard serve {folder}\n"
        f"Or score them without a server: sme-leaderboard score {folder}"
    )


@app.command()
def score(
    board: BoardFolder = Path("board"),
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=1, max=256, help="Number of processes.")
    ] = 1,
    unsafe_no_sandbox: UnsafeNoSandbox = False,
) -> None:
    """Score all waiting submissions.

    Several of these commands may run at once, and each may be killed at any point. Every policy
    runs in bubblewrap (apt install bubblewrap), without your files and with limits on time and
    memory; where it is not installed, the limits remain.
    Submissions that cannot be scored because of a fault of the machine keep waiting and are listed
    at the end, with exit code 1.

    Examples:

      sme-leaderboard score board --workers 2
    """
    isolation: Isolation = "process" if unsafe_no_sandbox else available_isolation()
    if not unsafe_no_sandbox:
        warn_without_sandbox()
    score_waiting(board, workers, isolation)


def score_waiting(board: Path, workers: int, isolation: Isolation) -> None:
    with Board.open(board) as store:
        entries = store.entries()
    before = {entry.id for entry in entries if entry.status != "waiting"}
    waiting = len(entries) - len(before)
    if not waiting:
        out().print("No submission is waiting.")
        return
    with Progress("scoring", waiting, console=err(), unit="submissions") as progress:
        work = Work(isolation=isolation, board=Board)
        run_scorers(board, workers, progress=progress.update, work=work)
    with Board.open(board) as store:
        entries = store.entries()
    counts = Counter(entry.status for entry in entries if entry.id not in before)
    parts = [
        f"{counts[status]} {status}"
        for status in ("scored", "rejected", "waiting", "withdrawn")
        if counts[status]
    ]
    out().print(f"{', '.join(parts)}." + (f" Done before: {len(before)}." if before else ""))
    faulty = [entry for entry in entries if entry.status == "waiting" and entry.faults]
    for entry in faulty:
        times = plural(entry.faults, "attempt")
        err().print(
            f"{entry.id} ({entry.method}) keeps waiting after {times}: {entry.fault}",
            soft_wrap=True,
            markup=False,
        )
    if faulty:
        raise typer.Exit(1)


@app.command()
def site(
    board: BoardFolder = Path("board"),
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of the pages; BOARD/site by default.")
    ] = None,
    explorers: Annotated[
        bool,
        typer.Option(
            "--explorers",
            help="Also an explorer of each policy (`sme diagnose --explore`), each in a second.",
        ),
    ] = False,
) -> None:
    """Write the board as static pages: open index.html, or copy them to any web host.

    With --explorers, the page of a submission links to a page for each of its policies, which shows
    its regret in any state. Files that an explorer does not understand show the task alone.

    Examples:

      sme-leaderboard site board --out public

      sme-leaderboard site board --explorers
    """
    sections: list[Section] = []
    if WITH_SEASONS:
        from leaderboard.seasons.web import SECTION

        sections.append(SECTION)

    from leaderboard.web import server  # which imports FastAPI

    target = board / "site" if out_folder is None else out_folder
    with open_board(board) as store:
        total = len(store.entries())
        with Progress("writing", total, console=err(), unit="pages") as progress:
            index = server.write_site(
                store, target, progress.update, explorers=explorers, sections=sections
            )
    out().print(str(index.resolve()), soft_wrap=True, markup=False)


@app.command()
def serve(
    board: BoardFolder = Path("board"),
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 for any free port.")] = 8000,
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=0, max=256, help="Number of scorer processes.")
    ] = 1,
    url: Annotated[
        str,
        typer.Option(
            help="The board's public address, for which submissions must be signed; by default "
            "where it listens."
        ),
    ] = "",
    behind_proxy: Annotated[
        bool,
        typer.Option(
            "--behind-proxy",
            help="Listen on any address: only a reverse proxy reaches it.",
        ),
    ] = False,
    season_secret: Annotated[
        list[Path] | None,
        typer.Option(
            help="File of the master of a sealed-online season, which is then stepped. Repeat it "
            "for several.",
        ),
    ] = None,
    unsafe_no_sandbox: UnsafeNoSandbox = False,
) -> None:
    """Serve the board: its pages, and an API that accepts submissions, and score them.

    Only this machine can reach it. Put an HTTPS proxy in front of it for others: the guide
    "Hosting a board" has a configuration. Scoring needs bubblewrap (apt install bubblewrap).

    Examples:

      sme-leaderboard serve board --port 8000 --workers 2

      sme-leaderboard serve board --url https://board.example
    """
    Folder(board).read()  # a wrong folder fails before anything listens
    libraries = {"fastapi": "FastAPI", "uvicorn": "uvicorn"}
    require_packages("serving a board", libraries, "leaderboard")
    from leaderboard.web import app, server

    if url and not _PUBLIC_URL.fullmatch(url):
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Give the address at which "
            "others reach the board."
        )
    if not behind_proxy and not server.is_loopback(host):
        raise OptionError(
            f"host={host!r:.80}: must be a loopback address, such as 127.0.0.1. Put a reverse "
            "proxy in front of it; if only the proxy reaches this address, add --behind-proxy."
        )
    if behind_proxy and not url:
        raise OptionError(
            "url='': must be the address at which the proxy is reached, such as "
            "https://board.example: what is sent to a board is signed for its address."
        )
    if unsafe_no_sandbox and workers and season_secret:
        raise OptionError(
            "--unsafe-no-sandbox: submitted policies could read the files of --season-secret. "
            "Install bubblewrap, or score no submissions (--workers 0)."
        )
    with server.listen(host, port) as listener:
        address = server.url_of(listener)
        served = app.create_app(
            board,
            url or address,
            score_workers=workers,
            isolation="process" if unsafe_no_sandbox else "bwrap",
            season_secrets=season_secret or (),
        )
        print_line(escape(address))
        server.run(served, listener)


@admin.command()
def key(key: KeyFile = DEFAULT_KEY) -> None:
    """Show your public key and where its private half is; create it if there is none.

    The organiser of a season with a list needs the public key.

    Examples:

      sme-leaderboard admin key

      sme-leaderboard admin key --key lab.key
    """
    print_line(f"{escape(str(key))}\npublic key {own_key(key).public}")


@admin.command()
def reindex(board: BoardFolder = Path("board")) -> None:
    """Rebuild the index from the board's log and documents.

    Examples:

      sme-leaderboard admin reindex board
    """
    with Board.open(board, reindex=True) as store:
        out().print(f"Indexed {len(store.entries()):,} entries.")


@admin.command()
def clock(
    board: BoardFolder = Path("board"),
    correct: Annotated[
        bool,
        typer.Option(
            "--correct", help="Log that all entries dated later than now were received now."
        ),
    ] = False,
) -> None:
    """Go on writing, after you have set the machine's clock right.

    A board writes nothing while the clock is more than a minute behind the log's last entry, or
    after it has jumped by more than five minutes while the board was served.

    Examples:

      sme-leaderboard admin clock board

      sme-leaderboard admin clock board --correct
    """
    with Board.open(board) as store:
        store.note_clock(anew=True)
        if correct:
            first = store.correct_clock()
            entries = f"entries {first} and later" if first else "no entry"
            out().print(f"The log dates {entries} as of now.")
        out().print(f"It is {store.time}; the board is written again.")


@admin.command()
def gc(
    board: BoardFolder = Path("board"),
    older_than_hours: Annotated[
        float, typer.Option(min=0.0, help="Keep younger artefacts: their submission may follow.")
    ] = 24.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only count the files.")] = False,
    json: Json = False,
) -> None:
    """Remove artefacts without a submission and half-written files of killed processes.

    Examples:

      sme-leaderboard admin gc board --dry-run
    """
    with Board.open(board) as store:
        garbage = collect_garbage(
            store, objects_older_than=older_than_hours * 3600.0, dry_run=dry_run
        )
    files = garbage.temporary + garbage.objects
    if json:
        print_json({"files": files, "bytes": garbage.bytes, "dry_run": dry_run})
        return
    verb = "Would remove" if dry_run else "Removed"
    out().print(f"{verb} {files:,} files, {garbage.bytes / 2**20:,.1f} MiB.")


_FOLDERS = ("bundle", "site", "board")  # removed in this order: the board identifies the others
_TITLE, _SUITE = "Demonstration", "demo"


@app.command()
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
    record = RunRecord.read(run)
    if record is None or record.status != "finished":
        raise OptionError(f"run={str(run)!r}: holds no finished run. Create one with `sme demo`.")
    folder = run / "leaderboard" if out_folder is None else out_folder
    existing = [folder / name for name in sorted(_FOLDERS) if os.path.lexists(folder / name)]
    if existing and not _is_demonstration(folder / "board"):
        raise OptionError(
            f"out={str(folder)!r}: {', '.join(map(str, existing))}: already exists and is not "
            "from a demonstration. Nothing was removed: use another --out, or move the files."
        )
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)  # the next write reports what remains

    err().print("Creating a board with this task and two reference rows, and submitting the agent.")
    _create_board(folder, run, record)
    score_waiting(folder / "board", 1, isolation_for_own())
    results.rank(folder / "board")
    out().print(
        "The run is listed without a rank, which needs ten runs in each class.\n"
        f"Open the board in a browser ({escape(str(folder))}):"
    )
    site(folder / "board", folder / "site")


def _create_board(folder: Path, run: Path, record: RunRecord) -> None:
    setting = record.spec.to_dict()
    seed = setting.pop("seed")
    suite = Suite.from_dict({"classes": [{"name": _SUITE, "setting": setting, "seeds": [seed]}]})
    file = SuiteFile(name=_SUITE, version=1, digest=suite.digest, suite=suite)
    with Board.create(
        folder / "board",
        title=_TITLE,
        suite_name=file.versioned_name,
        suite=suite,
        protocol_name=_name_of(record.protocol),
        protocol=record.protocol,
    ) as store:
        admission.submit_references(store)
        make_bundle(
            folder / "bundle",
            Description(record.algorithm, _TITLE, version="demo"),
            suite=file,
            receiver=Receiver(store.document.key),
            key=SigningKey.generate(),
            runs=[run],
        )
        admission.submit_bundle(store, folder / "bundle")


def _is_demonstration(path: Path) -> bool:
    """Whether a demonstration created this board; a link may lead to a board worth keeping."""
    try:
        document = Folder(path).read()
    except BoardError:
        return False
    named = document.title, document.suite_name
    return not path.is_symlink() and named == (_TITLE, f"{_SUITE}-v1")


def _name_of(protocol: EvaluationProtocol) -> str:
    known = {file.digest: file.versioned_name for file in catalogue.entries(ProtocolFile)}
    return known.get(protocol.digest, "custom")

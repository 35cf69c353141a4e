"""`sme-leaderboard rank · show · fetch · verify`: read a board."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import typer
from rich.markup import escape

from leaderboard.documents.board import Folder
from leaderboard.documents.result import METRICS, RANKED, EntryRow, Estimate, Metric, Result
from leaderboard.documents.submission import now
from leaderboard.errors import BoardError
from leaderboard.gate.isolation import available_isolation
from leaderboard.scoring import ranking
from leaderboard.scoring.ranking import REASONS, RankedRow
from leaderboard.scoring.verify import Findings
from leaderboard.scoring.verify import verify as verify_board
from leaderboard.store import Store
from leaderboard.web import client
from leaderboard.web.client import MOST_BYTES, PublicView, public_view
from leaderboard.web.client import fetch as fetch_board
from leaderboard.web.tables import RankingFile, steps_text
from sme_registry.errors import OptionError
from sme_registry.io.markup import Table, plural
from sme_registry.io.terminal import (
    Progress,
    err,
    fixed,
    out,
    print_json,
    print_line,
    print_note,
    print_pairs,
)

WITH_SEASONS = find_spec("leaderboard.seasons") is not None
Board: type[Store] = Store
"""How boards are opened: with seasons, if this package has them."""

if WITH_SEASONS:
    from leaderboard.seasons.publication import files_of_seasons, verify_seasons
    from leaderboard.seasons.store import SeasonStore

    Board = SeasonStore

app = typer.Typer()

_SHORTEST_ID = 4
_LONG_LOG = 2000  # entries, read in two seconds or so


def is_url(board: str) -> bool:
    """Whether a board is given by its URL."""
    return "://" in board


def board_folder(board: str | Path) -> Path:
    """The folder of a board on this machine."""
    path = Path(board)
    if is_url(str(board)):
        raise OptionError(
            f"{str(board)!r}: must be a board's folder: this command reads its files. Copy the "
            f"board with `sme-leaderboard fetch {board} FOLDER`, or open the URL in a browser for "
            "the ranking. `submit`, `show` and `withdraw` accept a URL."
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


def board_or_url(board: str) -> str:
    """A board's folder or the URL of a served board, as it is given."""
    return board if is_url(board) else str(board_folder(board))


BoardFolder = Annotated[
    Path, typer.Argument(metavar="BOARD", help="The board's folder.", parser=board_folder)
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
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def rank(
    board: BoardFolder = Path("board"),
    metric: Annotated[
        Metric,
        typer.Option(
            metavar="METRIC",
            help="wd_regret: inside the training cube. ood_regret: outside it. ood_decay: what is "
            "lost outside.",
        ),
    ] = "wd_regret",
    json: Json = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    latex: Annotated[bool, typer.Option("--latex", help="Print a LaTeX table.")] = False,
) -> None:
    """Rank the entries by a metric, with the ranks that each entry's interval allows.

    Regrets are normalised: 0 is the optimal policy and 1 the constant ½. OOD decay is the share of
    similarity that is lost outside (on boards of rules 2 the difference of the regrets), ranked
    only if the upper bound of WD regret is at most 0.5: a policy that has learned nothing
    inside the cube has nothing to lose outside it.

    Examples:

      sme-leaderboard rank board --metric ood_regret

      sme-leaderboard rank board --csv > ranking.csv
    """
    if json + csv + latex > 1:
        raise OptionError("--json, --csv, --latex: give at most one of them.")
    with open_board(Path(board)) as store:
        entries = store.entries()
        ranking.refuse_unpublishable(entries)
        rows = ranking.ranking(entries, metric)
        document, head = store.document, store.head[:2]
    file = RankingFile(rows, metric, document, head, now())
    if json:
        print_json(file.to_dict())
    elif csv or latex:
        sys.stdout.write(file.to_csv() if csv else file.to_latex())
    else:
        needed = plural(document.runs_to_rank, "run")
        notes = [f"A practice board: a rank needs {needed} in each class."] * document.practice
        out().print(ranking_table(rows, metric, f"on {document.suite_name}", notes))


def ranking_table(
    rows: list[RankedRow],
    metric: Metric,
    title: str,
    notes: Sequence[str] = (),
    more: Mapping[str, Callable[[RankedRow], str]] = MappingProxyType({}),
) -> Table:
    """The ranking of any track, with further notes below it, and further columns."""
    reasons: dict[str, None] = dict.fromkeys(row.reason for row in rows if row.reason)
    signs = dict(zip(reasons, "*†‡§¶", strict=False))
    entries = [row.entry for row in rows]
    caption = [f"{sign} not ranked: {REASONS[code]}" for code, sign in signs.items()]
    if any(entry.oracle_like and not entry.reference for entry in entries):
        caption.append("oracle-like: so close to π* that the method's code is requested")
    columns = {"rank": "number", "method": "text", "submitter": "text", "marks": "text"}
    if not any(map(_marks, entries)):
        del columns["marks"]
    columns |= {text.symbol: "number" for text in RANKED.values()}
    columns |= {"runs": "number", "steps/run": "number", "received": "name"}
    table = Table(
        f"{RANKED[metric].label} {title} (0 optimal, 1 the constant ½; 95 % intervals)",
        {**columns, **dict.fromkeys(more, "number")},
        caption="\n".join((*caption, *notes)),
    )
    for row in rows:
        entry = row.entry
        scores = {name: getattr(entry.scores, name) for name in RANKED}
        scores[metric] = row.shown(metric)
        table.add_row(
            row.ranks or signs.get(row.reason, ""),
            escape(f"{entry.method} {entry.version}".strip()),
            escape(entry.submitter),
            *([_marks(entry)] if "marks" in columns else []),
            *(
                f"[bold]{_interval(value)}[/]" if name == metric else fixed(value.value)
                for name, value in scores.items()
            ),
            str(entry.runs),
            steps_text(entry.steps_per_run),
            entry.received[:10],
            *(cell(row) for cell in more.values()),
            style="dim" if row.first is None else None,
        )
    return table


def _marks(entry: EntryRow) -> str:
    """What readers should know of an entry, in a few words; empty for most."""
    if entry.reference:
        return ""
    marks = ["oracle-like"] * entry.oracle_like
    if entry.copied_runs:
        first = entry.copy_of[0].id.removeprefix("sha256:")[:8]
        what = "copy of" if entry.is_copy else f"{entry.copied_runs} runs like"
        marks.append(f"{what} {first}")
    return ", ".join(marks)


def _interval(value: Estimate) -> str:
    if value.interval is None or value.low == value.high:  # equal where runs cannot differ
        return fixed(value.value)
    return f"{fixed(value.value)} ({fixed(value.interval[0])} to {fixed(value.interval[1])})"


@app.command()
def show(
    board: BoardOrUrl,
    id: SubmissionId,
    json: Json = False,
) -> None:
    """Show one submission: its method, submitter, runs and scores.

    While the reference rows wait, or score other than 0 and 1, scores are withheld and the reason
    is shown.

    Examples:

      sme-leaderboard show board 3f2a

      sme-leaderboard show https://board.example sha256:…
    """
    view = _public_view(board, id)
    if json:
        print_json(view.to_dict())
        return
    _print_submission(view)
    result = view.result
    if view.withheld:
        print_line(f"[yellow]scores withheld[/]: {escape(view.withheld)}")
    if result is None:
        return
    if result.status == "rejected":
        print_line(f"[red]{escape(result.code)}[/]: {escape(result.message)}")
        return
    _print_scores(result)


def _public_view(board: str, id: str) -> PublicView:
    """What a board's folder or a served board publishes about a submission."""
    if is_url(board):
        return PublicView.from_dict(client.status(board, id))
    with open_board(Path(board)) as store:
        return public_view(store, find_entry(store, id))


def _print_submission(view: PublicView) -> None:

    submission = view.content
    method, runs = submission.method, submission.runs
    total = sum(run.steps for run in runs)
    steps = sorted({run.steps for run in runs if run.artefact is not None})
    spread = "–".join(f"{one:,}" for one in dict.fromkeys((*steps[:1], *steps[-1:])))
    pairs: dict[str, object] = {
        "id": view.id,
        "received": view.received,
        "key": submission.submitter.key,
        "family, knowledge": f"{method.family}, {method.knowledge}",
        "code": submission.code or "none",
        "runs": f"{len(runs):,}, each of {spread or 0} steps, {total:,} in total",
        "training": submission.training.library or "not stated",
        "statement": submission.statement or "none",
    }
    if view.place:
        pairs["place in the queue"] = f"{view.place} of {view.queue}"
    if view.faults:
        pairs["failed attempts"] = f"{view.faults}, no verdict; the last: {view.fault}"
    if view.not_ranked not in ("", "reference"):
        pairs["not ranked"] = REASONS.get(view.not_ranked, view.not_ranked)
    for each in view.copy_of:
        pairs[f"{each.runs} of {len(runs)} runs act like"] = each.id
    if view.withdrawal is not None:
        pairs["reason for withdrawal"] = view.withdrawal.content.reason or "not stated"
    title = f"{method.name} {method.version}", submission.submitter.name, view.status
    name, submitter, status = map(escape, title)
    print_pairs(f"[bold]{name}[/] by {submitter}: {status}", pairs)


def _print_scores(result: Result) -> None:
    """Print the scores of a scored submission, and those of its classes."""
    assert result.scores is not None
    scores = Table(
        "normalised regret (0 optimal, 1 the constant ½)",
        {"": "text", "score": "number", "low": "number", "high": "number"},
    )
    rows = {text.label: getattr(result.scores, name) for name, text in METRICS.items()}
    for m, value in enumerate(result.scores.normalised_regret):
        rows[f"N in OOD {m}" if m else "N in WD"] = value
    for label, value in rows.items():
        scores.add_row(label, *(fixed(x, 4) for x in (value.value, *(value.interval or ()))))
    classes = Table("by class", {"class": "text", "runs": "number", "N₀": "number", "N̄": "number"})
    for member in result.classes:
        means = (fixed(member.wd_regret, 4), fixed(member.ood_regret, 4))
        classes.add_row(escape(member.name), str(member.runs), *means)
    out().print(scores, classes)
    if result.oracle_like:
        out().print("[yellow]oracle-like[/]: so close to π* that the method's code is required.")


def find_entry(store: Store, id: str) -> EntryRow:
    """The entry with this id, or whose id starts with these digits."""
    digits = id.removeprefix("sha256:").lower()
    matches = [
        entry for entry in store.entries() if entry.id.removeprefix("sha256:").startswith(digits)
    ]
    if len(digits) < _SHORTEST_ID or not matches:
        raise BoardError(
            f"id={id!r:.80}: no submission's id starts with this; give at least {_SHORTEST_ID} "
            "digits. `sme-leaderboard rank --json` lists the ids."
        )
    if len(matches) > 1:
        raise BoardError(f"id={id!r}: {len(matches)} submissions match. Give more digits.")
    return matches[0]


@app.command()
def fetch(
    url: Annotated[str, typer.Argument(metavar="URL", help="Of a served board.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new one, or a copy.")],
    without_data: Annotated[
        bool, typer.Option("--without-data", help="Leave out the data sets of seasons.")
    ] = False,
    most: Annotated[
        int, typer.Option(min=1, metavar="BYTES", help="Stop after so many.")
    ] = MOST_BYTES,
    json: Json = False,
) -> None:
    """Copy the public part of a served board, for `verify`.

    That is its log, documents, results, public policies and answers, and its seasons. Each part is
    checked as it comes. If it is interrupted, or the board has grown, repeat it.

    Examples:

      sme-leaderboard fetch https://board.example copy

      sme-leaderboard verify copy
    """
    with err().status("fetching") as status:
        fetched = fetch_board(
            url,
            folder,
            without_data=without_data,
            most=most,
            board=Board,
            parts=[files_of_seasons] if WITH_SEASONS else [],
            progress=lambda what: status.update(f"fetching {escape(what)}"),
        )
    if json:
        print_json(asdict(fetched))
        return
    size = f"{fetched.files:,} files, {fetched.bytes:,} bytes"
    out().print(f"{escape(str(folder))}: {fetched.entries:,} log entries; {size} new.")
    print_line(f"Next: sme-leaderboard verify {escape(str(folder))}")


@app.command()
def verify(
    board: BoardFolder = Path("board"),
    rescore: Annotated[
        str,
        typer.Option(metavar="N|all", help="Number of random submissions to score again, or all."),
    ] = "0",
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Seed of that choice, to repeat one; default the system's randomness."
        ),
    ] = None,
    contains: Annotated[
        str | None,
        typer.Option(metavar="DIGEST", help="Digest that an earlier `verify` printed."),
    ] = None,
    published: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of a season's published files, if the board has no copy."),
    ] = None,
    json: Json = False,
) -> None:
    """Check every signature, digest, log entry and score, seasons included.

    The table at the end says what was checked, and what was not and why.

    The exit code is 3 if something was altered, and names it. It is 1 if an entry is not confirmed
    here, because its numbers or its verdict differ, or if a published file is missing. Other
    processors and versions round otherwise, so repeat it on another machine.

    Entries cut off the end of the log leave no trace in it: keep the printed digest and pass it to
    --contains next time.

    Examples:

      sme-leaderboard verify board --rescore 3

      sme-leaderboard verify board --contains sha256:3f2a…
    """
    count = _rescore_count(rescore)
    if count != 0:
        warn_without_sandbox()
    parts = [partial(verify_seasons, published=published or ())] if WITH_SEASONS else []
    with err().status("verifying") as status:
        report = verify_board(
            board,
            rescore=count,
            seed=seed,
            contains=contains,
            board=Board,
            parts=parts,
            progress=lambda what: status.update(f"verifying {escape(what)}"),
        )
    if json:
        plain = {**asdict(report), "is_confirmed": report.is_confirmed}
        del plain["progress"]
        print_json(plain)
    else:
        _print_verification(report)
    if not report.is_confirmed:
        raise typer.Exit(1)


def warn_without_sandbox() -> None:
    """Say that strangers' policies run with limits alone, where that is so."""
    if available_isolation() == "process":
        print_note(
            "[bold red]Policies run without a sandbox[/]: bubblewrap is not installed, so they "
            "could read your files and use your network. Install it: apt install bubblewrap."
        )


def _print_verification(report: Findings) -> None:
    columns = {"": "text", "checked": "number", "not checked": "number", "why": "text"}
    table = Table("What was checked", columns)
    for row in report.rows:
        table.add_row(escape(row.what), f"{row.checked:,}", f"{row.unchecked:,}", escape(row.why))
    out().print(table)
    for note in report.notes:
        found = note.difference
        line = f"not confirmed here: {note.entry}: {found.path}: recorded {found.recorded}"
        line += f", here {found.here}"
        print_line(escape(line))
    for digest in report.missing:
        print_line(f"missing: {digest}")
    outcome = "[green]Verified[/]" if report.is_confirmed else "[yellow]Not confirmed here[/]"
    out().print(f"{outcome}: nothing was altered.")
    if report.rescore_seed is not None:
        out().print(f"Repeat the draw with --seed {report.rescore_seed}.")
    print_line(f"Digest of the last log entry, {report.log_sequence}:\n{report.log_digest}")


def _rescore_count(text: str) -> int | Literal["all"]:
    if text == "all":
        return "all"
    if not text.isdecimal():
        raise OptionError(f"rescore={text!r}: must be 'all' or a number of at least 0.")
    return int(text)

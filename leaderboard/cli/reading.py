"""`sme-leaderboard rank · show · verify`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape
from rich.table import Table

from leaderboard.cli.options import BoardFolder
from leaderboard.errors import BoardError
from sme_registry.errors import OptionError
from sme_registry.terminal import Progress, err, fixed, out, print_json, print_pairs

if TYPE_CHECKING:
    from leaderboard.documents.result import Estimate, Result
    from leaderboard.scoring.ranking import RankedRow
    from leaderboard.store import EntryRow, Store

Metric = Literal["wd_regret", "ood_regret", "ood_decay"]
_TITLES = {
    "wd_regret": "WD regret N₀",
    "ood_regret": "OOD regret N̄",
    "ood_decay": "OOD decay N̄ − N₀",
}
_SHORTEST_ID = 4


def rank(
    board: BoardFolder = Path("board"),
    metric: Annotated[
        Metric,
        typer.Option(
            help="wd_regret: inside the training cube; ood_regret: outside it; ood_decay: loss."
        ),
    ] = "wd_regret",
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="As CSV.")] = False,
    latex: Annotated[bool, typer.Option("--latex", help="As a LaTeX table.")] = False,
) -> None:
    """The ranking, with the ranks that each entry's interval allows.

    0 is the optimal policy and 1 the constant one. Decay is ranked only where WD regret is below
    0.5 for certain: a policy that has learnt nothing has nothing to lose outside.

    Examples:

      sme-leaderboard rank board --metric ood_regret

      sme-leaderboard rank board --csv > ranking.csv
    """
    from leaderboard import exports
    from leaderboard.scoring import ranking
    from leaderboard.store import Store

    if json + csv + latex > 1:
        raise OptionError("--json, --csv, --latex: at most one of them. Leave the others out.")
    with Store.open(board, read_only=True) as store:
        entries = store.entries()
        ranking.refuse_unpublishable(entries)
        rows = ranking.ranking(entries, metric)
        document, head = store.document, store.head[:2]
    if json:
        sys.stdout.write(exports.to_json(rows, metric, document, head))
    elif csv:
        sys.stdout.write(exports.to_csv(rows, metric, document, head))
    elif latex:
        sys.stdout.write(exports.to_latex(rows, metric, document, head))
    else:
        out().print(_ranking_table(rows, metric, document.suite_name))


def _ranking_table(rows: list[RankedRow], metric: Metric, suite: str) -> Table:
    reasons = dict.fromkeys(row.reason for row in rows if row.reason)
    notes = dict(zip(reasons, "*†‡§¶", strict=False))
    table = Table(
        title=f"{_TITLES[metric]} on {suite}: 0 optimal, 1 the constant ½; 95 % intervals",
        caption="\n".join(f"{mark} {escape(reason)}, not ranked" for reason, mark in notes.items())
        or None,
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("rank", justify="right", no_wrap=True)
    table.add_column("method")
    table.add_column("by")
    for name, title in (("wd_regret", "N₀"), ("ood_regret", "N̄"), ("ood_decay", "N̄ − N₀")):
        table.add_column(title, justify="right", no_wrap=True, style="bold" * (name == metric))
    table.add_column("runs", justify="right")
    for row in rows:
        entry = row.entry
        assert entry.scores is not None
        shown = {
            "wd_regret": entry.scores.wd_regret,
            "ood_regret": entry.scores.ood_regret,
            "ood_decay": entry.scores.ood_decay,
        }
        table.add_row(
            notes.get(row.reason, "") if row.first is None else ranks(row.first, row.last),
            escape(f"{entry.method} {entry.version}".strip()),
            escape(entry.submitter),
            *(_interval(v) if name == metric else fixed(v.value) for name, v in shown.items()),
            str(entry.runs),
            style="dim" if row.first is None else None,
        )
    return table


def ranks(first: int, last: int | None) -> str:
    """`3`, or `2–5` where the interval allows several."""
    return str(first) if last in (None, first) else f"{first}–{last}"


def _interval(value: Estimate) -> str:
    if value.low == value.high:  # of one run in each class nothing is known of its spread
        return fixed(value.value)
    return f"{fixed(value.value)} ({fixed(value.low)} to {fixed(value.high)})"


def show(
    board: BoardFolder,
    id: Annotated[str, typer.Argument(metavar="ID", help="A submission's id, or its beginning.")],
    json: Annotated[
        bool, typer.Option("--json", help="The signed submission and its result as JSON.")
    ] = False,
) -> None:
    """One submission: who, what, and each number with where it comes from.

    Where the reference rows wait or leave 0 and 1, it says so instead of the numbers.

    Examples:

      sme-leaderboard show board 3f2a
    """
    from leaderboard.exports import one_line
    from leaderboard.public_view import public_view
    from leaderboard.store import Store

    with Store.open(board, read_only=True) as store:
        entry = find_entry(store, id)
        about = public_view(store, entry)
    if json:
        print_json(about.to_dict())
        return
    submission, result = about.signed.submission, about.result
    pairs: dict[str, object] = {}
    if about.withdrawal is not None:
        reason = one_line(about.withdrawal.withdrawal.reason)
        pairs["withdrawn because"] = reason or "not said"
    print_pairs(
        f"[bold]{escape(entry.method)} {escape(entry.version)}[/] by {escape(entry.submitter)}: "
        f"{entry.status}",
        {
            "id": entry.id,
            "received": entry.received,
            "key": entry.key,
            "family, knowledge": f"{entry.family}, {entry.knowledge}",
            "code": entry.code_link or "none given",
            "runs": f"{entry.runs:,} with {entry.steps:,} steps in all",
            "training": submission.training.library or "not said",
            "statement": submission.statement or "none",
            **pairs,
        },
    )
    if about.withheld:
        out().print(f"[yellow]scores withheld[/]: {escape(about.withheld)}", soft_wrap=True)
    if result is None:
        return
    if result.status == "rejected":
        out().print(f"[red]{result.code}[/]: {escape(result.message)}", soft_wrap=True)
        return
    out().print(_profile_table(result))
    out().print(_class_table(result))
    if result.oracle_like:
        out().print("[yellow]oracle-like[/]: as near to π* as this asks for the method's code.")


def _profile_table(result: Result) -> Table:
    assert result.scores is not None
    table = Table(title="normalised regret (0 optimal, 1 the constant ½)", title_justify="left")
    table.add_column("")
    for name in ("θ", "low", "high"):
        table.add_column(name, justify="right")
    scores = result.scores
    for label, value in {
        "WD regret N₀": scores.wd_regret,
        "OOD regret N̄": scores.ood_regret,
        "OOD decay N̄ − N₀": scores.ood_decay,
        "Regret slope": scores.regret_slope,
        "Similarity loss (points)": scores.similarity_loss,
        **{
            f"N in OOD {m}" if m else "N in WD": value
            for m, value in enumerate(scores.normalised_regret)
        },
    }.items():
        table.add_row(label, *(fixed(x, 4) for x in (value.value, value.low, value.high)))
    return table


def _class_table(result: Result) -> Table:
    table = Table(title="by class", title_justify="left")
    for name in ("class", "runs", "N₀", "N̄"):
        table.add_column(name, justify="left" if name == "class" else "right")
    for member in result.classes:
        table.add_row(
            escape(member.name),
            str(member.runs),
            fixed(member.wd_regret, 4),
            fixed(member.ood_regret, 4),
        )
    return table


def find_entry(store: Store, id: str) -> EntryRow:
    """The entry that an id, or the beginning of one, means.

    Raises:
      BoardError: none, or several.
    """
    digits = id.removeprefix("sha256:").lower()
    found = [
        entry for entry in store.entries() if entry.id.removeprefix("sha256:").startswith(digits)
    ]
    if len(digits) < _SHORTEST_ID or not found:
        raise BoardError(
            f"id={id!r:.80}: no submission's id begins so (at least {_SHORTEST_ID} digits). "
            "`sme-leaderboard rank --json` lists them."
        )
    if len(found) > 1:
        raise BoardError(f"id={id!r}: {len(found)} submissions' ids begin so. Give more digits.")
    return found[0]


def verify(
    board: BoardFolder = Path("board"),
    rescore: Annotated[
        int, typer.Option(min=0, help="Score so many submissions anew, drawn at random.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of that draw.")] = 0,
    contains: Annotated[
        str | None,
        typer.Option(metavar="DIGEST", help="Of an entry that the log had when you noted it."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="The counts as JSON.")] = False,
) -> None:
    """Check every signature, hash, chain link and aggregate; name the first row that is altered.

    Exit code 3 where something is. Entries cut off the log's end leave no trace in what is left:
    keep the digest that is printed, and give it with --contains the next time.

    Examples:

      sme-leaderboard verify board --rescore 3

      sme-leaderboard verify board --contains sha256:3f2a…
    """
    from dataclasses import asdict

    from leaderboard.scoring.verify import verify as verify_board

    progress = Progress("verifying", 1, console=err(), unit="rows", shown=not json)
    with progress:
        report = verify_board(
            board, rescore=rescore, seed=seed, contains=contains, progress=progress.update_of
        )
    if json:
        print_json(asdict(report))
        return
    pairs = asdict(report)
    last, digest = pairs.pop("log_sequence"), pairs.pop("log_digest")
    print_pairs("[green]Whole[/]: every row is as it was signed.", pairs)
    out().print(f"The log's last entry, {last}, has the digest\n{digest}", soft_wrap=True)

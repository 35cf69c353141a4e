"""`sme-leaderboard season`: run a sealed season, from its plan to its reveal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from leaderboard.cli.results import BoardFolder, Json, open_board, ranking_table
from leaderboard.documents.result import Metric
from leaderboard.scoring.ranking import RankedRow
from leaderboard.seasons.publication import (
    check_published,
    copy_published,
    create_season,
    read_plan,
    read_season,
    refuse_unfit,
)
from leaderboard.seasons.scoring import (
    by_key,
    counting,
    ranking_facts,
    score_entries,
    season_rankings,
)
from leaderboard.seasons.season import Master, Reveal, Season
from leaderboard.seasons.store import SeasonRow, SeasonStore
from sme_registry import SMESpec, materialize
from sme_registry.errors import OptionError
from sme_registry.io import check_new, read_json
from sme_registry.io.markup import Table, plural
from sme_registry.io.terminal import Progress, err, fixed, out, print_json, print_pairs
from sme_registry.spec import Setting

_UNITS = {"sealed-offline": ("entry", "entries"), "sealed-online": ("ticket", "tickets")}

SeasonId = Annotated[str, typer.Argument(metavar="SEASON", help="The season's id.")]
SecretFile = Annotated[
    Path | None,
    typer.Option(
        "--secret",
        help="File of the master secret; by default BOARD.SEASON.master beside the board.",
    ),
]

season = typer.Typer(
    no_args_is_help=True,
    help="""Sealed seasons: tasks that nobody but the organiser knows until they are revealed.

    Examples:

      sme-leaderboard season new board plan.json --out autumn

      sme-leaderboard season publish board autumn

      sme-leaderboard season reveal board autumn
    """,
)


@season.command()
def new(
    board: BoardFolder,
    plan: Annotated[
        Path,
        typer.Argument(
            metavar="PLAN",
            help="JSON with id, title, track, classes, opens, closes, protocol_name and, online, "
            "ticket_hours, tickets and tickets_per_key.",
        ),
    ],
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="A new folder; by default the season's id.")
    ] = None,
    secret: SecretFile = None,
) -> None:
    """Draw a master secret, and generate all that is published of a season.

    The new folder has season.json and, offline, a data set and challenge states for each hidden
    instance. The master is written into a file that only you can read: whoever has it knows every
    task, and without it nobody can reveal the season.

    Examples:

      sme-leaderboard season new board plan.json --out autumn
    """

    fields = read_plan(read_json(plan), str(plan))
    with SeasonStore.open(board, read_only=True) as store:
        board_document = store.document
    refuse_unfit(fields, board_document.limits.artefact_bytes, board_document.runs_to_rank)
    folder = Path(fields.id) if out_folder is None else out_folder
    check_new(folder)
    _warn_of_easy_classes(fields)
    path = _secret(board, fields.id, secret)
    # First: a season whose master is lost cannot be revealed, and the reverse does no harm.
    master = Master.generate()
    master.write(path)
    count = fields.count if fields.track == "sealed-offline" else 0
    with Progress("generating", count, console=err(), unit="instances") as progress:
        try:
            season = create_season(fields, master, folder, progress.update)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
    out().print(f"{escape(str(folder))}\ncommitment {season.commitment}", soft_wrap=True)
    out().print(f"{escape(str(path))}: keep it secret, and keep a copy.", soft_wrap=True)
    out().print(
        f"Next: sme-leaderboard season publish {escape(str(board))} {escape(str(folder))}",
        soft_wrap=True,
    )


@season.command()
def publish(
    board: BoardFolder,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="As `season new` wrote it.")],
) -> None:
    """Announce a season: its terms and its commitment become an entry of the board's signed log.

    The board gets a copy of the data sets and challenge states, which `fetch` downloads.

    Examples:

      sme-leaderboard season publish board autumn
    """

    season = read_season(folder)
    with Progress("checking", len(season.published), console=err(), unit="instances") as progress:
        check_published(season, folder, progress.update)
    with SeasonStore.open(board) as store:
        store.announce(season)
        if season.published:
            copy_published(season, folder, store.season_folder(season.digest) / "published")
    out().print(f"{season.id} {season.digest}", soft_wrap=True)
    out().print(f"Open from {season.opens} to {season.closes}.")


@season.command()
def admit(
    board: BoardFolder,
    season: SeasonId,
    key: Annotated[
        str, typer.Argument(metavar="KEY", help="The entrant's public key, 64 hex digits.")
    ],
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Of the entrant, as the season's page shows it.")
    ],
) -> None:
    """Admit a key to a season whose plan has "admission": "listed".

    The list is part of the board's signed log.

    Examples:

      sme-leaderboard season admit board autumn 3f…a9 "A Lab"
    """

    with SeasonStore.open(board) as store:
        new = store.admit(season, key, name)
    out().print(f"{'Admitted' if new else 'Admitted before'}: {escape(name)}.")


@season.command()
def close(board: BoardFolder, season: SeasonId) -> None:
    """List what counts after the close, and the log's digest to keep elsewhere.

    The close itself is a time in the season's terms. Nothing changes.

    Examples:

      sme-leaderboard season close board autumn
    """

    with _open(board) as store:
        row = store.season_row(season)
        store.check_closed(row, store.clock.time)
        table = Table(
            f"What counts in {row.id}",
            {"number": "number", "method": "text", "submitter": "text", "received": "name"},
        )
        for each in counting(store, row.terms):
            names = f"{each.method} {each.version}", each.submitter
            table.add_row(str(each.number), *map(escape, names), each.received)
        head = store.head
    out().print(table)
    out().print(f"log entry {head.sequence} {head.digest}", soft_wrap=True)


@season.command()
def reveal(board: BoardFolder, season: SeasonId, secret: SecretFile = None) -> None:
    """Publish the master of a season that is over, and score the entries of an offline one.

    If it is interrupted, repeat it.

    Examples:

      sme-leaderboard season reveal board autumn
    """

    with SeasonStore.open(board) as store:
        row = store.season_row(season)
        master = Master.read(_secret(board, row.id, secret))
        store.reveal(Reveal(season=row.digest, master=master.raw.hex()))
        count = len(store.entrants(row.digest))
        with Progress("scoring", count, console=err(), unit="entries") as progress:
            scored = score_entries(store, row.digest, progress.update)
    out().print(f"{row.id}: revealed, {plural(scored, *_UNITS[row.terms.track])} scored.")


@season.command()
def show(
    board: BoardFolder,
    season: Annotated[
        str | None, typer.Argument(metavar="SEASON", help="Its id; without it, all are listed.")
    ] = None,
    metric: Annotated[
        Metric, typer.Option(metavar="METRIC", help="wd_regret, ood_regret or ood_decay.")
    ] = "wd_regret",
    json: Json = False,
) -> None:
    """Show a board's seasons, or one with its ranking.

    Methods that declare to know the family of tasks are ranked apart from the others.

    Examples:

      sme-leaderboard season show board

      sme-leaderboard season show board autumn --metric ood_regret
    """

    with _open(board) as store:
        if season is None:
            rows = [_facts(store, row) for row in store.seasons()]
            if json:
                print_json(rows)
                return
            columns = ("id", "track", "state", "opens", "closes", "keys")
            table = Table("Seasons", {**dict.fromkeys(columns, "text"), "entries": "number"})
            for facts in rows:
                count = facts.get("entries", facts.get("tickets"))
                table.add_row(*(escape(str(facts[name])) for name in columns), str(count))
            out().print(table)
            return
        row = store.season_row(season)
        facts, keys = _facts(store, row), by_key(store, row.terms)
        rankings = season_rankings(store, row.terms, metric)
        plain = ranking_facts(store, row.terms, metric)
    if json:
        print_json({**facts, "metric": metric, "ranking": plain})
        return
    print_pairs(
        escape(row.terms.title), {name: fact for name, fact in facts.items() if fact is not None}
    )
    _, units = _UNITS[row.terms.track]
    of_key: dict[str, Callable[[RankedRow], str]] = {
        "methods": lambda row: str(keys[row.entry.key].methods),
        units: lambda row: str(keys[row.entry.key].entries),
    }
    note = f"methods, {units}: of the same key in this season."
    for knowledge, ranked in rankings.items():
        if ranked:
            title = f"with knowledge {knowledge}"
            out().print(ranking_table(ranked, metric, title, [note], of_key))


def _open(board: Path) -> SeasonStore:
    store = open_board(board)
    assert isinstance(store, SeasonStore)
    return store


def _warn_of_easy_classes(plan: Season) -> None:

    for member in plan.classes:
        rows = member.data.transitions if member.data else member.budget or 0
        regret = table_regret(member.setting, rows)
        if regret < EASY:
            err().print(
                f"Warning: classes.{member.name}: a table of the nearest states, without any "
                f"learning, has a normalised regret N₀ of about {fixed(regret)}: should be "
                f"{EASY} or more, or ranks tell little. Use more state channels than "
                f"{member.setting.state_dim}.",
                soft_wrap=True,
            )


def _facts(store: SeasonStore, row: SeasonRow) -> dict[str, Any]:
    """A season in short."""
    terms, entrants = row.terms, store.entrants(row.digest)
    return {
        "id": terms.id,
        "digest": row.digest,
        "track": terms.track,
        "state": row.state(store.clock.time),
        "opens": terms.opens,
        "closes": terms.closes,
        "instances": terms.count,
        "keys": len({each.key for each in entrants}),
        _UNITS[terms.track][1]: len(entrants),
        "admission": terms.admission,
        "admitted": None if terms.admission == "open" else len(store.admitted(row.digest)),
        "commitment": terms.commitment,
        "revealed": row.revealed or None,
    }


def _secret(board: Path, season: str, given: Path | None) -> Path:
    """The file of the master; by default outside the board's folder, which may be published."""
    folder = board.resolve()
    path = folder.with_name(f"{folder.name}.{season}.master") if given is None else given
    if path.is_dir():
        raise OptionError(f"secret={path}: is a folder. Give the path of a file.")
    return path


app = typer.Typer()
app.add_typer(season, name="season")


# With few state channels a table of states, of which the nearest answer, fills the cube.
EASY = 0.1
"""Below it a table leaves little to learn."""

MOST_ROWS = 10_000
_NEIGHBOURS = (1, 8)
_SEEDS = (0, 1)  # public: nothing is measured on hidden tasks
_QUESTIONS = 300


def table_regret(setting: Setting, rows: int) -> float:
    """The normalised regret N₀ within the cube of a table of random states and their optima.

    `rows` is the size of the data set, or the steps of the budget; at most `MOST_ROWS` are taken.
    It is the mean over public tasks of this setting, of the better of the nearest state's optimum
    and the mean of the eight nearest ones. Labels are exact, so data with noise do worse.
    """
    from scipy.spatial import cKDTree

    regrets = []
    for seed in _SEEDS:
        task = materialize(SMESpec.from_dict({**setting.to_dict(), "seed": seed}))
        random = np.random.default_rng(seed)
        states = random.random((min(rows, MOST_ROWS), setting.state_dim))
        asked = random.random((_QUESTIONS, setting.state_dim))
        labels, optimum = task.optimal_action(states), task.optimal_action(asked)
        tree, errors = cKDTree(states), []
        for count in _NEIGHBOURS:
            _, nearest = tree.query(asked, range(1, min(count, len(states)) + 1))
            errors.append(np.abs(labels[nearest].mean(axis=1) - optimum).mean())
        regrets.append(min(errors) / np.abs(0.5 - optimum).mean())
    return float(np.mean(regrets))

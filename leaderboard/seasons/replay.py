"""`verify_season`: everything that follows from a reveal, computed again and compared.

The store has checked each file against the log, and the master against the commitment. What is
left are the data sets and challenge states, the signatures, and the scores: of offline entries
from their answers, of tickets also from their journals of actions, which the entrants signed.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from leaderboard.documents.result import RunScore
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.rescore import RESCORED
from leaderboard.scoring.verify import EXACT, close
from leaderboard.seasons.master import Master
from leaderboard.seasons.publication import follows
from leaderboard.seasons.ranking import counting, scored_entries
from leaderboard.seasons.scores import score_ticket
from leaderboard.seasons.scoring import instances, sealed_result
from leaderboard.seasons.season import SealedResult, Season, Stepping
from leaderboard.seasons.ticket import RunningTicket, deadline
from leaderboard.store import SealedRow, Store

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SeasonReport:
    """What was verified of a season.

    Attributes:
      instances: number whose data sets and challenge states were generated again.
      rounded: of these, the number whose data sets are the published ones within rounding only.
      entries: number of entries or tickets whose signatures were checked.
      results: number that were scored again.
    """

    instances: int
    rounded: int
    entries: int
    results: int


def verify_season(
    store: Store,
    name: str,
    progress: Progress | None = None,
    published: str | os.PathLike[str] | None = None,
) -> SeasonReport:
    """Replay a revealed season from its master.

    Args:
      store: the board.
      name: id or digest of the season.
      progress: called with the number of instances and entries or tickets done, and of all.
      published: a copy of the folder that was published, to compare data sets that this machine
        rounds otherwise than the organiser's.

    Raises:
      TamperedError: names the first file that does not follow from the master and the entries.
      Rejection: `season_unknown`, or `season_not_closed` before the reveal.
      BoardError: entries are not scored yet, or a data set has another digest on this machine and
        there is no copy to compare.
    """
    season, master = store.season(name), store.revealed_master(name)
    folder = store.season_folder(season.digest)
    rows, counted = store.entrants(season.digest), counting(store, season)
    _check_rules(store, season, rows)
    _refuse_unscored(season, counted)
    total, done = len(season.published) + len(rows), 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    rounded = 0
    if season.published:
        for instance, expected in zip(instances(season, master), season.published, strict=True):
            agreement = follows(instance, master, expected, published)
            rounded += agreement == "within rounding"
            if agreement == "no":
                where = f"published: {expected.class_name} {expected.instance}"
                message = "its data set or challenge states do not follow from the master"
                _refuse(store, folder.season, f"{where}: {message}")
            advance()
    for row in rows:
        _check_signature(store, season, row)
        if row.result is not None and row not in counted:
            path = folder.result(row.entrant.id)
            _refuse(store, path, "is of an entry that does not count")
        if row.result is None:
            advance()
    results = [row for row in rows if row.result is not None]
    for row, again in zip(results, _scored(store, season, master, results), strict=True):
        stored = store.sealed_result(row)
        assert stored is not None
        _compare(store, season, stored, again)
        advance()
    return SeasonReport(len(season.published), rounded, len(rows), len(results))


def _check_rules(store: Store, season: Season, rows: Sequence[SealedRow]) -> None:
    """Check what the terms forbid, and a board of the organiser's own making could have logged."""
    folder, revealed = store.season_folder(season.digest), store.season_row(season.digest).revealed
    online = season.track == "sealed-online"
    own: Counter[str] = Counter()
    for row in rows:
        path = folder.request(row.number) if online else folder.entry(row.entrant.id)
        if not season.opens <= row.entrant.received < season.closes:
            message = f"was logged at {row.entrant.received}: the season is open from "
            _refuse(store, path, f"{message}{season.opens} to {season.closes}")
        own[row.entrant.key] += 1
        if season.tickets_per_key is not None and own[row.entrant.key] > season.tickets_per_key:
            _refuse(store, path, f"exceeds the {season.tickets_per_key} tickets of a key")
        if season.tickets is not None and row.number > season.tickets:
            _refuse(store, path, f"exceeds the {season.tickets} tickets of the season")
        if online and row.entrant.policies < row.entrant.runs and row.result is not None:
            end = deadline(season, row)
            if row.finished < end:
                message = f"was logged at {row.finished}, without all answers: must not be before "
                _refuse(store, folder.result(row.entrant.id), f"{message}{end}, its deadline")
    if revealed < season.closes:
        _refuse(store, folder.reveal, f"was logged at {revealed}, before {season.closes}")


def _refuse_unscored(season: Season, counted: Sequence[SealedRow]) -> None:
    missing = sum(row.result is None for row in counted)
    if missing:  # online, no reveal is logged before all results are
        raise BoardError(
            f"season={season.id}: {missing} of {len(counted)} entries that count have no result. "
            "`sme-leaderboard season reveal`, which was interrupted, scores them when it is "
            "repeated. Then verify again."
        )


def _check_signature(store: Store, season: Season, row: SealedRow) -> None:
    folder = store.season_folder(row.season)
    online = season.track == "sealed-online"
    signed = store.request_of(row) if online else store.entry_of(row)
    path = folder.request(row.number) if online else folder.entry(row.entrant.id)
    if not signed.is_valid(store.document.signatures_for):
        _refuse(store, path, "its signature does not match the entrant's key")


def _scored(
    store: Store, season: Season, master: Master, rows: Sequence[SealedRow]
) -> Iterator[SealedResult]:
    """The results, computed again."""
    if season.track == "sealed-offline":
        yield from scored_entries(store, season, master, rows)
        return
    for row in rows:
        _check_answers(store, season, master, row)
        yield score_ticket(store, season, master, row.number)


def _check_answers(store: Store, season: Season, master: Master, row: SealedRow) -> None:
    """Check that the entrant has signed the answers and the journal of each answered instance."""
    for number, instance in enumerate(RunningTicket(store, season, master, row).instances):
        if not instance.is_signed:
            path = store.season_folder(row.season).ticket(row.number) / f"{number}.json"
            _refuse(store, path, "is not the entrant's signature of these answers and this journal")


def _compare(store: Store, season: Season, stored: SealedResult, again: SealedResult) -> None:
    path = store.season_folder(stored.season).result(stored.subject)
    if len(stored.runs) != len(again.runs) or len(stored.stepping) != len(again.stepping):
        _refuse(store, path, "has more or fewer runs than the season has instances")
    for number, (old, new) in enumerate(zip(stored.runs, again.runs, strict=True)):
        same = (old.class_name, old.artefact) == (new.class_name, new.artefact)
        if not same or not _alike(_numbers(old), _numbers(new)):
            _refuse(store, path, f"runs.{number}: scored again, it differs")
    for number, (was, now) in enumerate(zip(stored.stepping, again.stepping, strict=True)):
        if was.steps != now.steps or not _alike(_regrets(was), _regrets(now)):
            _refuse(store, path, f"stepping.{number}: replayed from its journal, it differs")
        if was.signed != now.signed:
            _refuse(store, path, f"stepping.{number}: names another signature than the stored one")
    follows = sealed_result(
        season,
        stored.subject,
        stored.runs,
        stored.versions,
        store.document.draws,
        stored.stepping,
    )
    if not close(follows.to_dict(), stored.to_dict(), EXACT):
        _refuse(store, path, "its scores do not follow from its runs")


def _alike(old: list[float], new: list[float]) -> bool:
    return len(old) == len(new) and all(
        abs(x - y) <= RESCORED * max(1.0, abs(y)) for x, y in zip(old, new, strict=True)
    )


def _regrets(stepping: Stepping) -> list[float]:
    return [stepping.normalised_online_regret, *stepping.learning_curve]


def _numbers(run: RunScore) -> list[float]:
    metrics = [run.wd_regret, run.ood_regret, run.ood_decay, run.regret_slope, run.similarity_loss]
    return [*run.normalised_regret, *(run.similarity or ()), *metrics]


def _refuse(store: Store, path: Path, message: str) -> NoReturn:
    raise TamperedError(path.relative_to(store.folder.path).as_posix(), message)

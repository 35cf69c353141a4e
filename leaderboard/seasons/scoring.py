"""What a season accepts as an entry; from answers to results of entries and tickets, and to ranks.

Challenge states are the observations that `sme_registry.evaluate` shows to a policy under the
season's protocol, with the seed of the instance's secret. A run has the score of a policy that
returns the entrant's answers, so there is no second scorer. What counts:

    offline   of each key and method the entry before the close that was signed last counts
    online    every ticket of a key and method counts: its runs are those of all of them

Methods whose last entry or ticket declares knowledge of the family are ranked apart. A rank needs
the board's `runs_to_rank` runs in each class, over all tickets.
"""

from __future__ import annotations

import datetime
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from leaderboard.admission import ReadFile, check_entrant, check_manifest, check_stored, store_files
from leaderboard.documents.board import RULES, check_receiver
from leaderboard.documents.result import EntryRow, Metric, RunScore, Scores
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import Artefact, Knowledge
from leaderboard.errors import Rejection
from leaderboard.scoring.ranking import (
    Groups,
    RankedRow,
    class_score,
    failed_run,
    is_oracle_like,
    method_scores,
    ranking,
    scored_run,
)
from leaderboard.seasons.season import (
    Entry,
    Float32,
    Master,
    Place,
    SealedResult,
    Season,
    SeasonClass,
    Stepping,
    read_answers,
)
from leaderboard.seasons.store import SealedRow, SeasonStore
from leaderboard.web.tables import row_facts
from sme_registry import EvaluationProtocol, SMESpec
from sme_registry.evaluation import (
    EvaluationReport,
    as_policy,
    evaluate_many,
    evaluation_observations,
)
from sme_registry.seasons.wire import Hidden, pack_table

# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch", "onnxruntime")


@dataclass(frozen=True)
class HiddenTask:
    """One hidden instance, as far as the master determines it; `repr` shows nothing of that."""

    hidden: Hidden[SeasonClass]
    place: Place  # of its secrets
    spec: SMESpec
    protocol: EvaluationProtocol  # of its challenge states
    starts: int  # seed of the first lane's episodes, which the server steps; lane i has starts + i

    @classmethod
    def of(
        cls,
        season: Season,
        master: Master,
        hidden: Hidden[SeasonClass],
        ticket: str = "",
        nonce: str = "",
    ) -> HiddenTask:
        """An instance of a season, or of one of its tickets, by its number and its nonce."""
        member = hidden.member
        place = Place(season.id, member.name, hidden.instance, ticket, nonce)
        spec = SMESpec.from_dict({**member.setting.to_dict(), "seed": master.seed(place)})
        protocol = season.protocol.model_copy(update={"seed": master.states_seed(place)})
        starts = int.from_bytes(master.secret("starts", place))
        return cls(hidden, place, spec, protocol, starts)

    def __repr__(self) -> str:
        return f"HiddenTask({self.hidden.name})"

    @property
    def challenge(self) -> bytes:
        """The .npy file of `[regions · n, S + 2]` challenge states, those of WD in [0, 1]."""
        return pack_table(evaluation_observations(self.spec, self.protocol))


def instances(
    season: Season, master: Master, ticket: str = "", nonce: str = ""
) -> Iterator[HiddenTask]:
    """Every hidden instance of a season, or of one of its tickets, in order."""
    return (HiddenTask.of(season, master, hidden, ticket, nonce) for hidden in season.hidden)


Answered = tuple[Float32 | None, str | None]
"""`[regions · n, A]` actions in challenge states and the digest of their file; both may be None."""


def score_runs(
    instance: HiddenTask, answered: Sequence[Answered], rules: int = RULES
) -> list[tuple[RunScore, dict[str, str]]]:
    """The scores of several answers on an instance, of which the optimum takes most of the time.

    With the versions of packages behind them. No answers score 1 in every metric.
    """
    name, spec = instance.hidden.member.name, instance.spec
    policies = [
        (as_policy(_policy(answers), spec, action_range="unit", name="answers"), spec)
        for answers, _ in answered
        if answers is not None
    ]
    reports = iter(evaluate_many(policies, instance.protocol))
    scores: list[tuple[RunScore, dict[str, str]]] = []
    for answers, digest in answered:
        if answers is None:
            scores.append((failed_run(instance.protocol, name, None), {}))
            continue
        report = next(reports)
        assert isinstance(report, EvaluationReport)  # the answers are finite
        run = scored_run(report, name, digest, rules, spec=None, evaluation_seed=None)
        used = {each: report.versions[each] for each in report.versions if each not in _UNUSED}
        scores.append((run, used))
    return scores


def _policy(answers: Float32) -> Callable[[Float32], Float32]:
    """A policy that returns rows of actions `[N, A]` in order, as many as it is shown states."""
    shown = 0

    def policy(observations: Float32) -> Float32:
        nonlocal shown
        first, shown = shown, shown + len(observations)
        return answers[first:shown]

    return policy


def sealed_result(
    season: Season,
    subject: str,
    runs: Sequence[RunScore],
    versions: dict[str, str],
    draws: int,
    stepping: Sequence[Stepping] = (),
    rules: int = RULES,
) -> SealedResult:
    """The result of scored runs, one on each hidden instance: θ, intervals and flags."""
    groups = _groups(season, [runs])
    scores = method_scores(groups, draws, season.digest)
    return SealedResult(
        season=season.digest,
        subject=subject,
        scores=scores,
        classes=tuple(class_score(name, members) for name, members in groups.items()),
        runs=tuple(runs),
        stepping=tuple(stepping),
        oracle_like=is_oracle_like(scores, rules, runs),
        versions=versions,
    )


def _groups(season: Season, entrants: Sequence[Sequence[RunScore]]) -> Groups:
    """The runs of an entry or of tickets, by class; each a group, as no two share an instance."""
    groups: Groups = {member.name: {} for member in season.classes}
    for number, runs in enumerate(entrants):
        for hidden, run in zip(season.hidden, runs, strict=True):
            name = hidden.member.name
            groups[name][f"{name}/{number}/{hidden.instance}"] = [run]
    return groups


Progress = Callable[[int, int], None]

KNOWLEDGE: tuple[Knowledge, ...] = ("generic", "family")
"""Ranked apart, in this order."""

_AT_A_TIME = 32  # entries; what an interrupted reveal repeats, and holds in memory


def counting(store: SeasonStore, season: Season) -> list[SealedRow]:
    """The entries or tickets that count, in the log's order."""
    rows = store.entrants(season.digest)
    if season.track == "sealed-online":
        return rows
    last: dict[tuple[str, str], SealedRow] = {}
    for row in rows:
        other = last.get(row.attempt, row)
        # One that was signed before and delivered later is nobody's last word.
        if row.created >= other.created:
            last[row.attempt] = row
    return sorted(last.values(), key=lambda row: row.number)


class OfKey(NamedTuple):
    """How often a key takes part in a season: who tries often is lucky once."""

    methods: int
    entries: int  # or tickets


def by_key(store: SeasonStore, season: Season) -> dict[str, OfKey]:
    rows = store.entrants(season.digest)
    methods = Counter(key for key, _ in {row.attempt for row in rows})
    entries = Counter(row.key for row in rows)
    return {key: OfKey(methods[key], count) for key, count in entries.items()}


def score_entries(store: SeasonStore, name: str, progress: Progress | None = None) -> int:
    """Score what counts of a revealed offline season; returns how many have a result now."""
    season, master = store.season(name), store.revealed_master(name)
    rows = counting(store, season)
    if season.track == "sealed-online":
        return len(rows)
    waiting = [row for row in rows if row.result is None]
    results = scored_entries(store, season, master, waiting)
    for done, result in enumerate(results, start=1):
        store.finish(result)
        if progress is not None:
            progress(done, len(waiting))
    return len(rows)


def season_rankings(
    store: SeasonStore, season: Season, metric: Metric
) -> dict[Knowledge, list[RankedRow]]:
    """The rankings of a season's methods with results, one for each declared knowledge."""
    rows = [row for row in counting(store, season) if row.result is not None]
    entries = list(_methods(store, season, rows))
    history = set[str]() if season.track == "sealed-online" else None  # every ticket counts
    return {
        knowledge: ranking(
            [each for each in entries if each.knowledge == knowledge], metric, history
        )
        for knowledge in KNOWLEDGE
    }


def ranking_facts(
    store: SeasonStore, season: Season, metric: Metric
) -> dict[str, list[dict[str, Any]]]:
    """The rankings as plain data, one list for each declared knowledge, best first."""
    keys = by_key(store, season)
    return {
        knowledge: [
            {
                **row_facts(row),
                "methods_of_key": keys[row.entry.key].methods,
                "entries_of_key": keys[row.entry.key].entries,
            }
            for row in rows
        ]
        for knowledge, rows in season_rankings(store, season, metric).items()
    }


def scored_entries(
    store: SeasonStore, season: Season, master: Master, rows: Sequence[SealedRow]
) -> Iterator[SealedResult]:
    """The results of offline entries, from their answers, in order; several at a time."""
    draws, rules = store.document.draws, store.document.rules
    for first in range(0, len(rows), _AT_A_TIME):
        batch = rows[first : first + _AT_A_TIME]
        answers = [store.entry_of(row).content.answers for row in batch]
        scores = [
            score_runs(instance, [_read(store, instance, of[number]) for of in answers], rules)
            for number, instance in enumerate(instances(season, master))
        ]
        for row, scored in zip(batch, zip(*scores, strict=True), strict=True):
            versions = {name: used[name] for _, used in scored for name in used}
            runs = [run for run, _ in scored]
            yield sealed_result(season, row.id, runs, versions, draws, rules=rules)


def _read(store: SeasonStore, instance: HiddenTask, answer: Artefact | None) -> Answered:
    if answer is None:
        return None, None
    data = store.objects.read(answer.sha256)
    return read_answers(data, instance.spec, instance.protocol), answer.sha256


def _methods(store: SeasonStore, season: Season, rows: Iterable[SealedRow]) -> Iterator[EntryRow]:
    """A row for each key and method; those of several tickets are scored over all their runs."""
    groups: dict[tuple[str, str], list[SealedRow]] = {}
    for row in rows:
        groups.setdefault(row.attempt, []).append(row)
    fewest = min(member.instances for member in season.classes)
    for members in groups.values():
        entry: EntryRow = members[-1]
        if len(members) > 1:
            scores, oracle_like = _score_together(store, season.digest, tuple(members))
            entry = replace(
                entry,
                scores=scores,
                runs=sum(each.runs for each in members),
                policies=sum(each.policies for each in members),
                steps=sum(each.steps for each in members),
                oracle_like=oracle_like,
            )
        enough = fewest * len(members) >= store.document.runs_to_rank
        yield replace(entry, enough_runs=enough)


@functools.lru_cache(1024)  # a bootstrap, which every page of the season shows
def _score_together(
    store: SeasonStore, digest: str, rows: tuple[SealedRow, ...]
) -> tuple[Scores, bool]:
    """The scores of all runs of some tickets of a season, and whether they are oracle-like."""
    season = store.season(digest)
    runs = [result.runs for result in map(store.sealed_result, rows) if result is not None]
    scores = method_scores(_groups(season, runs), store.document.draws, season.digest)
    every = [run for each in runs for run in each]
    return scores, is_oracle_like(scores, store.document.rules, every)


def enter(
    store: SeasonStore,
    signed: Signed[Entry],
    answers: ReadFile | None = None,
    address: str | None = None,
) -> bool:
    """Check an entry, its signature verified, and store it; False if the board has it.

    `answers` returns the bytes of an answer, which are stored with the entry; by default the
    entrant's key has uploaded them. `address` is of the server that it was sent to; None for a
    folder.
    """
    check_receiver(store.document, signed.receiver, address)
    if store.entrant(signed.id) is not None:
        return False
    entry, key = signed.content, signed.content.submitter.key
    check_manifest(store.document, entry, datetime.datetime.fromisoformat(store.time))
    season = store.open_season(entry.season, "sealed-offline", key, store.time).terms
    given = _check_answers(store, season, signed, answers)
    with store.transaction():  # no other entrant can take the name, nor `gc` an answer in between
        check_entrant(store, entry.submitter, len(signed.to_bytes()))
        _check_newest(store, season, entry)
        store_files(store, key, given, answers)
        return store.add(signed)[1]


def _check_newest(store: SeasonStore, season: Season, entry: Entry) -> None:
    """Refuse an entry that would not count, as its key has signed a later one of its method."""
    own = entry.submitter.key, entry.method.name.casefold()
    for row in store.entrants(season.digest):
        if row.attempt == own and row.created > entry.created:
            raise Rejection(
                "stale_time",
                f"created={entry.created}: entry {row.number} of the same key and method was "
                f"signed later, at {row.created}. The one signed last counts: check your clock, "
                "and sign this one again.",
            )


def _check_answers(
    store: SeasonStore, season: Season, signed: Signed[Entry], read: ReadFile | None
) -> list[Artefact]:
    """The answers that are not null, each in the shape of its instance's challenge."""
    entry, given, checked = signed.content, [], set()
    for number, (answer, each) in enumerate(zip(entry.answers, season.hidden, strict=False)):
        if answer is None:
            continue
        if read is None:
            check_stored(store, entry.submitter.key, answer)
        # Many instances may have the same answers, which are read once for each shape.
        form = answer.sha256, each.member.setting.action_dim
        try:
            if form not in checked:
                data = (read or store.objects.read)(answer.sha256)
                read_answers(data, each.member.setting, season.protocol)
                checked.add(form)
        except Rejection as error:
            where = f"answers.{number} (class {each.member.name}, instance {each.instance})"
            raise Rejection(error.code, f"{where}: {error.message}") from None
        given.append(answer)
    return given

"""From the answers in challenge states to the result of an entry or ticket, and to the rankings.

    challenge states  the observations that `sme_registry.evaluate` shows to a policy under the
                      season's protocol, with the seed of the instance's secret
    score of a run    that of a policy that returns the entrant's answers, in the same order

So scores are those of the open board, and there is no second scorer. What counts:

    offline   of each key and method the entry before the close that was signed last counts
    online    every ticket of a key and method counts: its runs are those of all of them

Methods whose last entry or ticket declares knowledge of the family are ranked apart. A rank needs
the board's `runs_to_rank` runs in each class, over all tickets.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from leaderboard.documents.board import RULES
from leaderboard.documents.result import Metric, RunScore, Scores
from leaderboard.documents.submission import Artefact, Knowledge
from leaderboard.scoring.aggregation import (
    Groups,
    class_score,
    failed_run,
    is_oracle_like,
    method_scores,
    scored_run,
)
from leaderboard.scoring.ranking import RankedRow, ranking
from leaderboard.seasons.events import SealedRow
from leaderboard.seasons.season import (
    Float32,
    Hidden,
    Master,
    Place,
    SealedResult,
    Season,
    Stepping,
    Terms,
    read_answers,
    rows_of,
)
from leaderboard.seasons.store import SeasonStore
from leaderboard.store import EntryRow
from leaderboard.web.tables import row_facts
from sme_registry import EvaluationProtocol, SMESpec, materialize
from sme_registry.errors import PolicyError
from sme_registry.evaluation import (
    EvaluationReport,
    as_policy,
    evaluate_many,
    evaluation_observations,
)
from sme_registry.spec import Setting

# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch", "onnxruntime")


@dataclass(frozen=True)
class HiddenTask:
    """One hidden instance, as far as the master determines it.

    Attributes:
      hidden: its class and number.
      place: of its secrets.
      spec: the task; `repr` shows neither it nor the protocol, whose seed is secret, too.
      protocol: of its challenge states.
    """

    hidden: Hidden
    place: Place
    spec: SMESpec
    protocol: EvaluationProtocol

    def __repr__(self) -> str:
        return f"HiddenTask({self.hidden.member.name}, {self.hidden.instance})"

    @property
    def rows(self) -> int:
        """The number of challenge states: of each region as many, region after region."""
        return rows_of(self.protocol)


def instances(
    terms: Terms, master: Master, ticket: str = "", nonce: str = ""
) -> Iterator[HiddenTask]:
    """Every hidden instance of a season, or of one of its tickets, in order.

    Args:
      terms: the season.
      master: its secret.
      ticket, nonce: the ticket's number, and the nonce in its request; empty offline.
    """
    for hidden in terms.hidden:
        member = hidden.member
        place = Place(terms.id, member.name, hidden.instance, ticket, nonce)
        spec = SMESpec.from_dict({**member.setting.to_dict(), "seed": master.seed(place)})
        seed = master.states_seed(place)
        yield HiddenTask(hidden, place, spec, terms.protocol.model_copy(update={"seed": seed}))


def challenge(spec: SMESpec, protocol: EvaluationProtocol) -> Float32:
    """The challenge states of an instance.

    Args:
      spec: the task.
      protocol: the regions, and the seed of the states.

    Returns:
      `[regions · n, S + 2]` observations, region after region; those of WD in [0, 1].
    """
    return evaluation_observations(spec, protocol)


def score_run(
    instance: HiddenTask, answers: Float32 | None, digest: str | None, rules: int = RULES
) -> tuple[RunScore, dict[str, str]]:
    """The score of the answers on an instance, and the versions of packages behind it.

    Args:
      instance: the hidden instance.
      answers: `[regions · n, A]` actions in its challenge states; None where there are none, which
        scores 1 in every metric.
      digest: of the answers' file; None likewise.
      rules: of the board.
    """
    [scored] = score_runs(instance, [(answers, digest)], rules)
    return scored


def score_runs(
    instance: HiddenTask, answered: Sequence[tuple[Float32 | None, str | None]], rules: int
) -> list[tuple[RunScore, dict[str, str]]]:
    """`score_run` of several answers on an instance, whose optimum takes most of the time."""
    replies = [None if answers is None else _Replies(answers) for answers, _ in answered]
    policies = [
        (as_policy(each, instance.spec, action_range="unit", name="answers"), instance.spec)
        for each in replies
        if each is not None
    ]
    reports = iter(evaluate_many(policies, instance.protocol))
    scores: list[tuple[RunScore, dict[str, str]]] = []
    for each, (_, digest) in zip(replies, answered, strict=True):
        if each is None:
            name = instance.hidden.member.name
            scores.append((failed_run(instance.protocol, name, None), {}))
            continue
        report = next(reports)
        if isinstance(report, PolicyError):
            raise report
        each.refuse_unused()
        name = instance.hidden.member.name
        run = scored_run(report, name, digest, rules, spec=None, evaluation_seed=None)
        scores.append((run, _versions(report)))
    return scores


def _versions(report: EvaluationReport) -> dict[str, str]:
    return {name: version for name, version in report.versions.items() if name not in _UNUSED}


class _Replies:
    """A policy that returns rows of actions `[N, A]` in order, as many as it is shown states."""

    def __init__(self, answers: Float32) -> None:
        self._answers = answers
        self._next = 0

    def __call__(self, observations: Float32) -> Float32:
        first, self._next = self._next, self._next + len(observations)
        return self._answers[first : self._next]

    def refuse_unused(self) -> None:
        """Raise ValueError unless each row was returned once."""
        if self._next != len(self._answers):
            raise ValueError(f"{len(self._answers)} answers to {self._next} challenge states")


def sealed_result(
    season: Season,
    subject: str,
    runs: Sequence[RunScore],
    versions: dict[str, str],
    draws: int,
    stepping: Sequence[Stepping] = (),
    rules: int = RULES,
) -> SealedResult:
    """The result of scored runs: θ, intervals and flags.

    Args:
      season: its classes.
      subject: id of the entry, or of the request for the ticket.
      runs: one on each hidden instance, in the season's order.
      versions: of packages.
      draws: number of bootstrap resamples, the board's.
      stepping: online, of each run.
      rules: of the board.
    """
    groups = groups_of_season(season, [runs])
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


def groups_of_season(season: Season, entrants: Sequence[Sequence[RunScore]]) -> Groups:
    """The runs of a method by class, each in a group of its own: no two are on the same instance.

    Args:
      season: its classes.
      entrants: the runs of each entry or ticket, one on each hidden instance, in order.
    """
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
        other = last.get(row.method, row)
        # One that was signed before and delivered later is nobody's last word.
        if row.created >= other.created:
            last[row.method] = row
    return sorted(last.values(), key=lambda row: row.number)


class OfKey(NamedTuple):
    """How often a key takes part in a season: who tries often is lucky once."""

    methods: int
    entrants: int


def by_key(store: SeasonStore, season: Season) -> dict[str, OfKey]:
    """The numbers of methods, and of entries or tickets, of each key in a season."""
    rows = store.entrants(season.digest)
    methods = Counter(key for key, _ in {row.method for row in rows})
    entrants = Counter(row.entrant.key for row in rows)
    return {key: OfKey(methods[key], count) for key, count in entrants.items()}


def score_entries(store: SeasonStore, name: str, progress: Progress | None = None) -> int:
    """Score the counting entries of a revealed offline season that have no result yet.

    Args:
      store: the board.
      name: id or digest of the season.
      progress: called with the number of entries done, and of all.

    Returns:
      The number of entries that were scored.

    Raises:
      Rejection: `season_unknown` or `season_not_closed`.
      BoardError: an answer is missing, or a result cannot be written.
    """
    season, master = store.season(name), store.revealed_master(name)
    waiting = [row for row in counting(store, season) if row.result is None]
    if season.track == "sealed-online":
        return 0
    results = scored_entries(store, season, master, waiting)
    for done, result in enumerate(results, start=1):
        store.rank(result)
        if progress is not None:
            progress(done, len(waiting))
    return len(waiting)


def season_rankings(
    store: SeasonStore, season: Season, metric: Metric
) -> dict[Knowledge, list[RankedRow]]:
    """The rankings of a season's methods with results, one for each declared knowledge."""
    rows = [row for row in counting(store, season) if row.result is not None]
    entries = list(_methods(store, season, rows).values())
    return {
        knowledge: ranking([each for each in entries if each.knowledge == knowledge], metric)
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
                "entrants_of_key": keys[row.entry.key].entrants,
            }
            for row in rows
        ]
        for knowledge, rows in season_rankings(store, season, metric).items()
    }


def scored_entries(
    store: SeasonStore, season: Season, master: Master, rows: Sequence[SealedRow]
) -> Iterator[SealedResult]:
    """The results of offline entries, from their answers, in order.

    Several at a time are scored on each instance, whose optimum takes most of the time.
    """
    for first in range(0, len(rows), _AT_A_TIME):
        yield from _scored_at_once(store, season, master, rows[first : first + _AT_A_TIME])


def _scored_at_once(
    store: SeasonStore, season: Season, master: Master, rows: Sequence[SealedRow]
) -> Iterator[SealedResult]:
    answers = [store.entry_of(row).content.answers for row in rows]
    runs: list[list[RunScore]] = [[] for _ in rows]
    versions: list[dict[str, str]] = [{} for _ in rows]
    for number, instance in enumerate(instances(season, master)):
        answered = [_read(store, instance, of[number]) for of in answers]
        for entry, (run, used) in enumerate(score_runs(instance, answered, store.document.rules)):
            runs[entry].append(run)
            versions[entry] |= used
    for row, of_entry, used in zip(rows, runs, versions, strict=True):
        draws, rules = store.document.draws, store.document.rules
        yield sealed_result(season, row.entrant.id, of_entry, used, draws, rules=rules)


def _read(
    store: SeasonStore, instance: HiddenTask, answer: Artefact | None
) -> tuple[Float32 | None, str | None]:
    if answer is None:
        return None, None
    data = store.objects.read(answer.sha256)
    return read_answers(data, instance.spec, instance.protocol), answer.sha256


def _methods(
    store: SeasonStore, season: Season, rows: Iterable[SealedRow]
) -> dict[tuple[str, str], EntryRow]:
    """A row for each key and method; those of several tickets are scored over all their runs."""
    groups: dict[tuple[str, str], list[SealedRow]] = {}
    for row in rows:
        groups.setdefault(row.method, []).append(row)
    entries = {}
    fewest = min(member.instances for member in season.classes)
    for method, members in groups.items():
        entrants = [row.entrant for row in members]
        entry = entrants[-1]
        if len(members) > 1:
            scores, oracle_like = _score_together(store, season.digest, tuple(members))
            entry = replace(
                entry,
                scores=scores,
                runs=sum(each.runs for each in entrants),
                policies=sum(each.policies for each in entrants),
                steps=sum(each.steps for each in entrants),
                oracle_like=oracle_like,
            )
        enough = fewest * len(members) >= store.document.runs_to_rank
        entries[method] = replace(entry, enough_runs=enough)
    return entries


@functools.lru_cache(1024)  # a bootstrap, which every page of the season shows
def _score_together(
    store: SeasonStore, digest: str, rows: tuple[SealedRow, ...]
) -> tuple[Scores, bool]:
    """The scores of all runs of some tickets of a season, and whether they are oracle-like."""
    season = store.season(digest)
    runs = [result.runs for result in _results(store, rows)]
    groups = groups_of_season(season, runs)
    scores = method_scores(groups, store.document.draws, season.digest)
    return scores, is_oracle_like(scores, store.document.rules, _all(runs))


def _results(store: SeasonStore, rows: Iterable[SealedRow]) -> Iterator[SealedResult]:
    for row in rows:
        result = store.sealed_result(row)
        if result is not None:
            yield result


def _all(runs: Iterable[Iterable[RunScore]]) -> list[RunScore]:
    return [run for each in runs for run in each]


# With few state channels a table of states, of which the nearest answer, fills the cube.
EASY = 0.1
"""Below it a table leaves little to learn."""

MOST_ROWS = 10_000
_NEIGHBOURS = (1, 8)
_SEEDS = (0, 1)  # public: nothing is measured on hidden tasks
_QUESTIONS = 300


def table_regret(setting: Setting, rows: int) -> float:
    """The normalised regret N₀ within the cube of a table of random states and their optima.

    Args:
      setting: of a class.
      rows: size of the data set, or steps of the budget; at most `MOST_ROWS` are taken.

    Returns:
      The mean over public tasks of this setting, of the better of the nearest state's optimum and
      the mean of the eight nearest ones. Labels are exact, so data with noise do worse.
    """
    return float(np.mean([_regret(setting, rows, seed) for seed in _SEEDS]))


def _regret(setting: Setting, rows: int, seed: int) -> float:
    from scipy.spatial import cKDTree

    task = materialize(SMESpec.from_dict({**setting.to_dict(), "seed": seed}))
    random = np.random.default_rng(seed)
    states = random.random((min(rows, MOST_ROWS), setting.state_dim))
    asked = random.random((_QUESTIONS, setting.state_dim))
    labels, optimum = task.optimal_action(states), task.optimal_action(asked)
    tree = cKDTree(states)
    errors = []
    for count in _NEIGHBOURS:
        _, nearest = tree.query(asked, range(1, min(count, len(states)) + 1))
        errors.append(np.abs(labels[nearest].mean(axis=1) - optimum).mean())
    return float(min(errors) / np.abs(0.5 - optimum).mean())

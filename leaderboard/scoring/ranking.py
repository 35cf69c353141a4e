"""From the runs of a submission to scores with intervals, `result_of`, and to ranks, `ranking`.

    group           the runs on one instance; runs that are not listed count for the instance of
                    their class with the fewest
    class score     mean over groups of the interquartile mean (IQM) of a group
    θ               mean over the classes
    a rank needs    ⌈runs_to_rank / groups of the class⌉ runs in every group

Groups prevent an instance that a method gives up from being trimmed: the IQM of a class of two
instances and of a method with ten runs on one of them and a failed one on the other would be the
ten runs alone. θ is not the pooled IQM of all runs, which hardly changes when a method fails on a
whole class.

A submitter has no influence on the random numbers of the bootstrap: its seed is that of suite and
protocol, and the order of runs does not matter. Sorting each column is allowed, because runs are
exchangeable and each interval is of one column.

The bootstrap's strata are the groups of two or more runs. The single runs of a class's other
groups form one stratum, whose statistic is the mean: its spread is that of runs and instances, so
the interval is rather too wide than too narrow. The spread of one single run in a class is unknown,
and adds nothing. `python -m benchmarks.interval_coverage` measures the coverage.

The ranks that the intervals allow:

    first = 1 + ranked entries whose interval lies wholly below
    last  = N − ranked entries whose interval lies wholly above

Entries are ranked if they are scored with enough runs, are no copy of earlier entries of other
keys, and are the latest of their key with their method's name and version, and with their
policies. The reference rows are listed among the others without a rank.

A decay below 0 is no merit, and one can be bought by acting worse inside the cube. Entries are
therefore ranked by OOD decay only if they have learned with certainty, and by

    max(0, D, D of every ranked entry that is at least as good in every region)

so that no entry stands above one that beats it everywhere. Ties are in order of the mean
normalised regret over all regions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from leaderboard.documents.board import RULES, BoardDocument
from leaderboard.documents.result import (
    METRICS,
    REFERENCES,
    AgentScore,
    ClassScore,
    EntryRow,
    Estimate,
    Isolation,
    Metric,
    Result,
    RunScore,
    Scores,
)
from leaderboard.documents.submission import Submission, check_runs, skeleton
from leaderboard.errors import NotPublishable
from sme_registry.evaluation import EvaluationReport
from sme_registry.spec import EvaluationProtocol
from sme_registry.statistics import Array, Statistic, aggregate, iqm, mean, stratified_bootstrap

NotRanked = Literal["", "reference", "too_few_runs", "copy", "superseded", "not_learned"]

TOLERANCE = 1e-6
LEARNED = 0.5  # the largest upper bound of N₀ of an entry ranked by OOD decay
AS_GOOD = 0.02
"""By how much N_m may be above another entry's and still count as at least as good.

Scores are estimates on states that differ between policies: of two policies that act alike, each
is better in some region by chance, by less than this on boards of 2,000 states in each region.
"""

REASONS: dict[str, str] = {
    "reference": "reference row",
    "too_few_runs": "too few runs on an instance or in a class",
    "copy": "at least half of its policies are copies of earlier entries of other keys",
    "superseded": "a later entry of its key has its method and version, or its policies",
    "not_learned": f"WD regret not certainly below {LEARNED:g}",
}
_Numbers = npt.NDArray[np.float64]
_BLOCK = 2**18  # pairs of entries compared at once, few enough for a processor cache


@dataclass(frozen=True)
class RankedRow:
    """A row of the ranking."""

    entry: EntryRow  # with scores
    first: int | None  # the best and the worst rank that the intervals allow; None if not ranked
    last: int | None
    reason: NotRanked  # why it is not ranked, a key of `REASONS`; empty if it is
    value: Estimate  # what it is ordered by: its score, or what the head of this module says

    @property
    def ranks(self) -> str:
        """`3`, or `2–5` if the intervals allow several ranks; empty without one."""
        if self.first is None:
            return ""
        return str(self.first) if self.last == self.first else f"{self.first}–{self.last}"

    def shown(self, metric: Metric) -> Estimate:
        """The score in a table: what the row ranks by, or the entry's own if it has no rank."""
        own: Estimate = getattr(self.entry.scores, metric)
        return own if self.first is None else self.value


def ranking(
    entries: list[EntryRow], metric: Metric, history: set[str] | None = None
) -> list[RankedRow]:
    """Every scored entry that is not withdrawn, the best first; equal ones as submitted.

    `history` are the ids that have no rank, as a later entry counts: by default `superseded`.
    """
    history = superseded(entries) if history is None else history
    scored = [
        (entry, entry.scores, _reason(entry, entry.scores, metric, history))
        for entry in sorted(entries, key=lambda entry: entry.sequence)
        if entry.status == "scored" and entry.scores is not None
    ]
    ends = np.array(
        [(getattr(scores, metric).value, *getattr(scores, metric).ends) for _, scores, _ in scored]
    ).reshape(-1, 3)
    ranked = np.array([not reason for *_, reason in scored], dtype=bool)
    level = np.zeros(len(scored))
    if metric == "ood_decay" and scored:
        regions = _regret([scores for _, scores, _ in scored])
        ends = np.maximum(ends, 0.0)
        ends[ranked] = not_above_the_better(ends[ranked], regions[ranked])
        level = regions.mean(axis=1)
    first, last = np.zeros((2, len(scored)), dtype=np.int64)
    first[ranked], last[ranked] = rank_ranges(ends[ranked, 1], ends[ranked, 2])
    rows = []
    for i in np.lexsort((level, ends[:, 0])):
        entry, scores, reason = scored[i]
        best, worst = (None, None) if reason else (int(first[i]), int(last[i]))
        value, low, high = ends[i].tolist()
        if getattr(scores, metric).interval is None:
            low = high = None
        rows.append(
            RankedRow(entry, best, worst, reason, Estimate(value=value, low=low, high=high))
        )
    return rows


def superseded(entries: list[EntryRow]) -> set[str]:
    """Ids of entries of which a later one that can be ranked has the method or the policies."""
    latest: set[tuple[str, ...]] = set()
    history = set()
    for entry in sorted(entries, key=lambda entry: -entry.sequence):
        if entry.status != "scored" or _own_reason(entry):
            continue
        alike = {
            (entry.key, "method", skeleton(entry.method), *map(skeleton, entry.version.split("."))),
            (entry.key, "policies", entry.origin),
        }
        if alike & latest:
            history.add(entry.id)
        else:
            latest |= alike
    return history


def not_above_the_better(decay: _Numbers, regret: _Numbers) -> _Numbers:
    """Decays lifted to those of the entries that are at least as good in every region.

    Of `[N, K]` values and interval ends, and `[N, M + 1]` N_m of each region, of which another
    entry's is at least as good up to `AS_GOOD` above. In O(N² M), 0.3 s for 5,000 entries.
    """
    lifted = decay.copy()
    orders = np.argsort(-decay, axis=0, kind="stable")  # the largest first
    rows = max(1, _BLOCK // max(1, len(decay)))
    for start in range(0, len(decay), rows):
        block = slice(start, start + rows)
        better = np.ones((len(decay[block]), len(decay)), dtype=bool)
        for N in regret.T:
            better &= N[None, :] <= N[block, None] + AS_GOOD
        for column, order in enumerate(orders.T):
            largest = better[:, order].argmax(axis=1)  # each entry is as good as itself
            lifted[block, column] = decay[order[largest], column]
    return lifted


def _regret(scores: list[Scores]) -> _Numbers:
    """`[N, M + 1]` N_m of each entry and region, WD first."""
    rows = [[each.value for each in one.normalised_regret] for one in scores]
    return np.array(rows).reshape(len(rows), -1)


def rank_ranges(
    low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The best and worst rank, in [1, N], that each of N intervals allows; in O(N log N)."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    first = 1 + np.searchsorted(np.sort(high), low, side="left")
    last = np.searchsorted(np.sort(low), high, side="right")
    return first.astype(np.int64), last.astype(np.int64)


def refuse_unpublishable(entries: list[EntryRow]) -> None:
    """Refuse (`NotPublishable`) a board whose reference rows do not have their known scores."""
    for name, regret in REFERENCES.items():
        rows = [entry for entry in entries if entry.reference and entry.method == name]
        scored = [row.scores for row in rows if row.status == "scored" and row.scores is not None]
        if not scored:
            status = rows[-1].status if rows else "missing"
            advice = (
                "Create the board again with `sme-leaderboard init`: a rejection is final"
                if status == "rejected"
                else "Wait for the running `serve`, or run `sme-leaderboard score` on the board"
                if status == "waiting"
                else "Run `sme-leaderboard score` on the board"
            )
            raise NotPublishable(
                f"reference row {name!r}: {status}: must be scored before the board publishes any "
                f"number. {advice}.",
                waiting=status == "waiting",
            )
        for scores in scored:
            for field, value, expected in _known_scores(scores, regret):
                if not abs(value - expected) <= TOLERANCE:
                    raise NotPublishable(
                        f"reference row {name!r}: {field}={value!r}: must be {expected:g} within "
                        f"{TOLERANCE:g}. Scoring is faulty here, so the board publishes no number. "
                        "Compare the versions in this result with those of another machine."
                    )


def _known_scores(scores: Scores, regret: float) -> Iterator[tuple[str, float, float]]:
    """Field, value and expected value of a reference row; not what follows from similarity."""
    for region, estimate in enumerate(scores.normalised_regret):
        yield f"normalised_regret.{region}", estimate.value, regret
    yield "wd_regret", scores.wd_regret.value, regret
    yield "ood_regret", scores.ood_regret.value, regret
    if not regret:
        yield "ood_decay", scores.ood_decay.value, 0.0
    yield "regret_slope", scores.regret_slope.value, 0.0


def _own_reason(entry: EntryRow) -> NotRanked:
    """Why a scored entry has no rank by any metric, whatever later entries there are."""
    if entry.reference:
        return "reference"
    if not entry.enough_runs:
        return "too_few_runs"
    return "copy" if entry.is_copy else ""


def _reason(entry: EntryRow, scores: Scores, metric: Metric, history: set[str]) -> NotRanked:
    reason = _own_reason(entry)
    if reason:
        return reason
    if entry.id in history:
        return "superseded"
    if metric == "ood_decay" and scores.wd_regret.ends[1] > LEARNED:
        return "not_learned"
    return ""


OPTIMAL, NEAR_OPTIMAL, FLAT = 0.01, 0.05, 0.01
"""Oracle-like: N₀ or N̄ at most the first, or N₀ at most the second and |N̄ − N₀| at most the last.

A regret as small inside as outside is typical of π* scaled or blended by a few per cent.
"""

_SIGNED = ("ood_decay", "regret_slope", "similarity_loss")  # may be negative

Groups = dict[str, dict[str, list[RunScore]]]
"""The runs by class, and in each class by group."""


def result_of(
    board: BoardDocument,
    submission: str,
    runs: Sequence[RunScore],
    versions: dict[str, str],
    *,
    unlisted: Sequence[RunScore] = (),
    isolation: Isolation = "",
) -> Result:
    """The result of the listed runs, at least one of each class, and of the `never_listed` ones."""
    counted = [*runs, *unlisted]
    groups = groups_of(board, counted)
    scores = method_scores(groups, board.draws, f"{board.suite.digest}\n{board.protocol.digest}")
    return Result(
        submission=submission,
        suite=board.suite.digest,
        protocol=board.protocol.digest,
        status="scored",
        scores=scores,
        classes=tuple(class_score(name, members) for name, members in groups.items()),
        runs=tuple(runs),
        enough_runs=all(
            len(group) >= board.runs_on_each(len(members))
            for members in groups.values()
            for group in members.values()
        ),
        oracle_like=is_oracle_like(scores, board.rules, runs),
        versions=versions,
        isolation=isolation,
    )


def never_listed(board: BoardDocument, submission: Submission) -> list[RunScore]:
    """A score of 1 for each run that was started and is not listed, in the order of classes.

    Each is on the instance of its class with the fewest runs so far, the suite's first.
    """
    check_runs(board.suite, submission)
    listed = Counter(run.spec for run in submission.runs)
    runs = []
    for member in board.suite.classes:
        counts = {spec.digest: listed[spec.digest] for spec in member.instances}
        for _ in range(submission.runs_started[member.name] - sum(counts.values())):
            fewest = min(counts, key=lambda digest: counts[digest])
            counts[fewest] += 1
            runs.append(failed_run(board.protocol, member.name, fewest))
    return runs


def groups_of(board: BoardDocument, runs: Sequence[RunScore]) -> Groups:
    """All runs of a submission, listed or not, by instance, in the suite's order; none is empty."""
    groups: Groups = {member.name: {} for member in board.suite.classes}
    for digest, (name, _) in board.instances.items():
        groups[name][digest] = []
    for run in runs:
        assert run.spec is not None  # only hidden instances have no digest
        groups[run.class_name][run.spec].append(run)
    return groups


def class_mean(
    members: dict[str, list[RunScore]], values: Callable[[RunScore], Sequence[float]]
) -> Array:
    """The score `[K]` of a class: the mean over its groups of the IQM over a group's `values`."""
    return mean([iqm([values(run) for run in group]) for group in members.values()])


def class_score(name: str, members: dict[str, list[RunScore]]) -> ClassScore:
    """The scores of a class from its runs by group."""
    runs = [run for group in members.values() for run in group]
    wd, ood = class_mean(members, lambda run: (run.wd_regret, run.ood_regret)).tolist()
    return ClassScore(
        name=name,
        runs=len(runs),
        submitted=sum(run.artefact is not None for run in runs),
        wd_regret=wd,
        ood_regret=ood,
        normalised_regret=tuple(class_mean(members, lambda run: run.normalised_regret).tolist()),
    )


def method_scores(groups: Groups, draws: int, seed: str) -> Scores:
    """θ of each metric and each region, with intervals."""
    strata: dict[str, Array] = {}
    statistics: dict[str, Statistic] = {}
    weights: dict[str, float] = {}
    for name, runs, statistic, weight in _strata(groups):
        columns = [
            [*(getattr(run, metric) for metric in METRICS), *run.normalised_regret] for run in runs
        ]
        strata[name] = np.sort(columns, axis=0)
        statistics[name], weights[name] = statistic, weight
    value = aggregate(strata, statistics, weights)
    low, high = stratified_bootstrap(strata, draws, seed, statistics, weights)
    # Regret is never negative, so a lower end below 0 carries no information.
    signed = [name in _SIGNED for name in METRICS] + [False] * (len(value) - len(METRICS))
    low = np.where(signed, low, np.maximum(low, 0.0))
    ends = [(None, None)] * len(value) if np.isnan(low).any() else zip(low, high, strict=True)
    estimates = [
        Estimate(value=theta, low=low, high=high)
        for theta, (low, high) in zip(value.tolist(), ends, strict=True)
    ]
    return Scores(
        **dict(zip(METRICS, estimates, strict=False)),
        normalised_regret=tuple(estimates[len(METRICS) :]),
    )


def _strata(groups: Groups) -> Iterator[tuple[str, list[RunScore], Statistic, float]]:
    """Name, runs, statistic and weight of each stratum; the weights of a class sum to 1."""
    for name, members in groups.items():
        singles = []
        for group, runs in members.items():
            if len(runs) > 1:
                yield group, runs, iqm, 1.0 / len(members)
            else:
                singles += runs
        if singles:
            yield name, singles, mean, len(singles) / len(members)


def is_oracle_like(scores: Scores, rules: int, runs: Sequence[RunScore] = ()) -> bool:
    """Whether the method, or any of its runs, acts nearly as π* does."""
    wd, ood = scores.wd_regret.value, scores.ood_regret.value
    growth = scores.ood_decay.value if rules == 2 else ood - wd
    return any(
        min(wd, ood) <= OPTIMAL or (wd <= NEAR_OPTIMAL and abs(growth) <= FLAT)
        for wd, ood, growth in (
            (wd, ood, growth),
            *((run.wd_regret, run.ood_regret, run.ood_regret - run.wd_regret) for run in runs),
        )
    )


def run_metrics(
    normalised_regret: Sequence[float],
    similarity: Sequence[float] | None,
    levels: Sequence[float],
    rules: int = RULES,
) -> dict[str, float]:
    """The metrics of one run by name, as defined in `documents.result`.

    `similarity` is None without a policy; then each is 1 (100 points), and not what N_m = 1
    everywhere gives: a decay of 0 would reward leaving out runs. `levels` are ε_m, 0 for WD.
    """
    if similarity is None:
        return {**dict.fromkeys(METRICS, 1.0), "similarity_loss": 100.0}
    N, r = np.asarray(normalised_regret), np.asarray(similarity)
    offset = np.asarray(levels) - np.mean(levels)
    wd, ood = float(N[0]), float(N[1:].mean())
    return {
        "wd_regret": wd,
        "ood_regret": ood,
        "ood_decay": ood - wd if rules == 2 else float(np.mean((r[0] - r[1:]) / r[0])),
        "regret_slope": float(offset @ (N - wd) / (offset @ offset)),  # exactly 0 where N is flat
        "similarity_loss": 100.0 * float(r[0] - r[1:].mean()),
    }


def levels_of(protocol: EvaluationProtocol) -> tuple[float, ...]:
    """ε_m of each region's outer face; 0 for WD."""
    return tuple(high for _, high in protocol.edges)


def failed_run(protocol: EvaluationProtocol, class_name: str, spec: str | None) -> RunScore:
    """A run without a policy: 1 in every region and every metric."""
    regrets = (1.0,) * len(protocol.edges)
    metrics: dict[str, Any] = {**run_metrics(regrets, None, levels_of(protocol), RULES)}
    return RunScore(
        spec=spec,
        class_name=class_name,
        artefact=None,
        evaluation_seed=None,
        normalised_regret=regrets,
        similarity=None,
        **metrics,
    )


def scored_run(
    report: EvaluationReport, class_name: str, artefact: str | None, rules: int, **fields: Any
) -> RunScore:
    """A run with the scores of an evaluation; `fields` are the others of `RunScore`."""
    regrets, similarity = (
        tuple(getattr(region, name) for region in report.regions)
        for name in ("normalised_regret", "similarity")
    )
    agents = tuple(
        AgentScore(name=name, normalised_regret=tuple(r.normalised_regret for r in each.regions))
        for name, each in report.agents.items()
    )
    metrics: dict[str, Any] = {
        **run_metrics(regrets, similarity, levels_of(report.protocol), rules)
    }
    return RunScore(
        class_name=class_name,
        artefact=artefact,
        normalised_regret=regrets,
        similarity=similarity,
        agents=agents,
        **metrics,
        **fields,
    )

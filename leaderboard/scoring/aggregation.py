"""`result_of`: from the runs of a submission to a method's scores, with their intervals.

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
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from leaderboard.documents.board import RULES, BoardDocument
from leaderboard.documents.result import (
    METRICS,
    AgentScore,
    ClassScore,
    Estimate,
    Isolation,
    Result,
    RunScore,
    Scores,
)
from leaderboard.documents.submission import Submission, check_runs
from sme_registry.evaluation import EvaluationReport
from sme_registry.spec import EvaluationProtocol
from sme_registry.statistics import Array, Statistic, aggregate, iqm, mean, stratified_bootstrap

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

    Each is on the instance of its class with the fewest runs so far, the first of these in the
    suite's order. A `Rejection` is one of `check_runs`.
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
    """Whether the method, or any of its runs, acts nearly as π* does.

    A method that is π* on some instances only need have no small mean.
    """
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
    """A run without a policy: 1 in every region and every metric.

    `spec` is the digest of the instance, None if the run is not listed.
    """
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

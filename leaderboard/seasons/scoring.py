"""From the answers in challenge states to the result of a sealed entry or ticket.

    challenge states  the observations that `sme_registry.evaluate` shows to a policy under the
                      season's protocol, with the seed of the instance's secret
    score of a run    that of a policy that returns the entrant's answers, in the same order

So scores are those of the open board, and there is no second scorer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from leaderboard.documents.board import RULES
from leaderboard.documents.result import RunScore
from leaderboard.scoring.aggregation import (
    Groups,
    class_score,
    failed_run,
    is_oracle_like,
    method_scores,
    scored_run,
)
from leaderboard.seasons.master import Master, Place
from leaderboard.seasons.season import (
    Float32,
    Hidden,
    SealedResult,
    Season,
    Stepping,
    Terms,
    rows_of,
)
from sme_registry import EvaluationProtocol, SMESpec
from sme_registry.errors import PolicyError
from sme_registry.evaluation import (
    EvaluationReport,
    as_policy,
    evaluate_many,
    evaluation_observations,
)

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

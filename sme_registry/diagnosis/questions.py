"""What a question is: a rule, and the answer that each of its reasons gives; all thresholds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, TypeVar

from sme_registry.diagnosis.document import Answer, Comparison, Kind, Verdict
from sme_registry.diagnosis.measurements import Measurements
from sme_registry.spec import SMESpec

__all__ = [
    "EXTENDED_THRESHOLDS",
    "THRESHOLDS",
    "Case",
    "Outcome",
    "Question",
    "add_to",
    "answer_all",
    "thresholds_of",
    "verdict",
]

C = TypeVar("C")  # what the rules of a question read

THRESHOLDS = {
    "solved": 0.1,  # normalised regret at most: nothing is left to explain
    "constant_level": 0.95,  # normalised regret at least: no better than the constant ½
    "unlearnt": 0.9,  # normalised regret of a channel, at least
    "channel_learnt": 0.6,  # normalised regret of a channel, at most
    "excess_saturation": 0.2,  # share of entries at a bound beyond the optimum's
    "dominant_share": 0.5,  # of the squared error, for an offset or a scale
    "noise_or_time_share": 0.25,  # of the squared error
    "explained_variance": 0.1,  # share of the errors' variance between bins
    "bin_ratio": 1.5,  # of the worst bin's error to the best bin's
    "slope_learnt": 0.7,  # slope on a part of π*, at least
    "slope_unlearnt": 0.3,  # at most
    "nonlinear_variance": 0.1,  # share of π*'s variance, at least
    "similarity_loss": 10.0,  # points, from WD to the outermost shell
    "on_policy_ratio": 1.25,  # of normalised regret on policy and in uniform states
    "on_policy_difference": 0.05,  # between the two
    "time_ratio": 1.25,  # of the error late and early in episodes
    "time_difference": 0.02,  # between the two
    "gated_share": 0.25,  # of steps whose reward r_min sets to 0
    "gated_rewarded_share": 0.5,  # of steps that are rewarded nevertheless, at most
    "rarely_unrewarded": 0.05,  # share of steps without reward, below
    "rarely_rewarded": 0.02,  # share of steps rewarded under random actions, below
    "termination_rate": 0.5,  # share of episodes that D terminates
    "short_episode": 0.5,  # mean length over the horizon, at most
    "constant_margin": 0.02,  # of regret below the constant action's
    "exploration_cost": 0.1,  # regret of training beyond the policy's, to be reported
    "log_rows": 10.0,  # for a trend, at least
    "still_improving": 0.02,  # fall of the running median of regret over the last third
    "regressed": 0.1,  # its rise from its best
    "probe_better": 0.5,  # the probe's normalised regret over the agent's, at most
    "probe_no_better": 0.8,  # at least
    "difference": 0.1,  # of normalised regret between two runs, at least
    "no_difference": 0.02,  # at most: the run is about as good as the other, or better
    "learnt_little": 0.8,  # normalised regret of the other run, at least
}

EXTENDED_THRESHOLDS = {
    "rarely_violating": 0.05,  # share of states in which a limit is violated, below
    "gain": 0.01,  # of step reward by violating, at least
    "price_share": 0.5,  # the price of safety over the policy's regret, at least
    "distractor_loss": 10.0,  # points of similarity, from distractors in the cube to the outermost
    "kept_r2": 0.5,  # held-out R² of a linear map of a layer, at least
    "owed_to_distractors": 0.05,  # normalised regret, at least
    "invariant": 0.01,  # change of actions by other distractors over mean |½ − a*|, at most
}
"""Of the questions that only tasks with `safety` or `observation` have."""


def thresholds_of(spec: SMESpec) -> dict[str, float]:
    """All thresholds that verdicts on a task can use."""
    return {**THRESHOLDS, **EXTENDED_THRESHOLDS} if spec.extended else THRESHOLDS


class Case(NamedTuple):
    """What the rules read."""

    measurements: Measurements
    spec: SMESpec
    comparison: Comparison | None = None

    @property
    def solved(self) -> bool:
        """Whether nothing is left to explain."""
        return self.measurements.policy.normalised_regret <= THRESHOLDS["solved"]


class Outcome(NamedTuple):
    """A rule's branch, its evidence, and the thresholds that it used."""

    reason: str
    evidence: dict[str, Any]
    thresholds: tuple[str, ...] = ()


class Question(NamedTuple, Generic[C]):
    """A question: its kind, its rule, which reads a case, and the answer that each reason gives."""

    kind: Kind
    rule: Callable[[C], Outcome]
    reasons: dict[str, Answer]


def add_to(
    questions: dict[str, Question[C]], kind: Kind, **reasons: Answer
) -> Callable[[Callable[[C], Outcome]], Callable[[C], Outcome]]:
    """Decorate a rule: add the question of its name, with the answer that each reason gives."""

    def add(rule: Callable[[C], Outcome]) -> Callable[[C], Outcome]:
        questions[rule.__name__.removeprefix("_")] = Question(kind, rule, reasons)
        return rule

    return add


def verdict(
    name: str, kind: Kind, answer: Answer, outcome: Outcome, thresholds: Mapping[str, float]
) -> Verdict:
    """The verdict on a question, from the outcome of its rule; `thresholds` are all by name."""
    return Verdict(
        question=name,
        kind=kind,
        answer=answer,
        reason=outcome.reason,
        evidence=outcome.evidence,
        thresholds={threshold: thresholds[threshold] for threshold in outcome.thresholds},
    )


def answer_all(
    questions: Mapping[str, Question[C]], case: C, thresholds: Mapping[str, float]
) -> tuple[Verdict, ...]:
    """Answer every question about a case by its rule alone, in order."""
    outcomes = ((name, each, each.rule(case)) for name, each in questions.items())
    return tuple(
        verdict(name, each.kind, each.reasons[outcome.reason], outcome, thresholds)
        for name, each, outcome in outcomes
    )

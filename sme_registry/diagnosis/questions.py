"""Questions: a rule, the answer that each of its reasons gives, and what makes an answer a verdict.

A rule reads the measurements of one run. A cause stays open, whatever its rule says, where the run
has learnt little, its algorithm had few updates, or the evidence is one other run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeVar

from pydantic import JsonValue, SerializerFunctionWrapHandler, model_serializer

from sme_registry.diagnosis.behaviour import CapacityProbe, OnPolicy, TrainingSummary
from sme_registry.diagnosis.measure import (
    POLICY,
    Channel,
    DistractorRegret,
    Partition,
    Response,
    Score,
    Shell,
    SquaredError,
    TimeDependence,
    Violations,
)
from sme_registry.evaluation import ObservationReport
from sme_registry.io.markup import environment
from sme_registry.spec import SMESpec
from sme_registry.spec.document import Real, StrictModel, TupleOf

if TYPE_CHECKING:
    from jinja2 import Environment

Answer = Literal["yes", "no", "cannot tell"]
Kind = Literal["who", "where", "why", "limits"]

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
    "termination_rate": 0.5,  # share of episodes that D terminates, in a team because of one agent
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
    "learnt_little": 0.8,  # normalised regret of a run, at least: it says nothing about causes
    "few_updates": 20.0,  # of the algorithm, below: likewise
    # of limits and distractors
    "rarely_violating": 0.05,  # share of states in which a limit is violated, below
    "gain": 0.01,  # of step reward by violating, at least
    "price_share": 0.5,  # the price of safety over the policy's regret, at least
    "distractor_loss": 10.0,  # points of similarity, from distractors in the cube to the outermost
    "kept_r2": 0.5,  # held-out R² of a linear map of a layer, at least
    "owed_to_distractors": 0.05,  # normalised regret, at least
    "invariant": 0.01,  # change of actions by other distractors over mean |½ − a*|, at most
    # of teams
    "blame_ratio": 1.5,  # of an agent's share of the regret to its share of the channels
    "one_suffices": 0.5,  # share of the team's regret that correcting one agent removes, at least
    # of lives
    "fresh_excess": 0.05,  # of a visit's online regret beyond a fresh agent's
    "visit_excess": 0.1,  # of it beyond the mean of the other visits
    "visits_for_trend": 4.0,  # at least, without fresh agents
    "inactive_rise": 0.1,  # of the share of inactive units
    "inactive_share": 0.5,  # of the units, from the start
    "rank_ratio": 0.5,  # of the effective rank to what it is compared with, at most
    "weight_ratio": 2.0,  # of the weight norm to what it is compared with, at least
}

SOLVED: dict[str, Answer] = {"solved": "no"}
"""Of every "why" question about a task."""

OPEN_REASONS: dict[str, Answer] = {"learnt_little": "cannot tell", "few_updates": "cannot tell"}
"""Of every question about a cause, in place of a reason that says yes."""

COMPARISON_REASONS: dict[str, Answer] = {
    "field_raises_regret": "cannot tell",
    "regret_same_or_lower": "no",
    "difference_too_small": "cannot tell",
    "other_run_learnt_little": "cannot tell",
}
"""Of the questions about single fields of the spec, in place of the rule's own reasons."""

_OF_CAUSES = ("solved", "learnt_little", "few_updates", "difference", "no_difference")
"""Thresholds of every question about a cause."""

_FIELD_IS_OFF = {"paid_every_step", "no_reward_threshold", "no_survival_threshold"}
"""Reasons that hold by definition: no other run can contradict them."""

_SIGNS = {"rewards_gated", "episodes_cut_short"}
"""Reasons of a "yes" that an inconclusive comparison leaves open. The effect is present in the
policy's episodes, but the run without it was not clearly better."""

_EXPERIMENTS = {"network_cannot_fit", "too_few_states"}
"""Reasons whose evidence is a probe, and not the run."""

_FIELD_QUESTIONS = {
    "k": "credit_assignment",
    "r_min": "sparsity",
    "complexity": "capacity",
    "state_dim": "dimension",
    "action_dim": "dimension",
    "D": "survival",
}


class Verdict(StrictModel):
    """The answer to one question, as data; `sentence` puts it in words.

    Attributes:
      question: such as "sparsity".
      kind: "where" the error is, "why" it is there, "who" in a team makes it, or "limits".
      answer: "cannot tell" if the evidence does not separate the causes.
      reason: the rule's branch that decided.
      evidence: the numbers that the branch compared or reports.
      thresholds: those of the question, with which the numbers were compared.
      error_share: part of the error that a "yes" explains; null if it is not measured.
    """

    question: str
    kind: Kind
    answer: Answer
    reason: str
    evidence: dict[str, JsonValue]
    thresholds: dict[str, Real]
    error_share: Real | None = None

    def sentence(self) -> str:
        """The reason, with its evidence and thresholds, in a few sentences."""
        if "own_reason" not in self.evidence:
            return self._words(self.reason)
        answer = self.evidence["own_answer"]
        if answer == "cannot tell":
            return self.doubt
        own = self._words(str(self.evidence["own_reason"]))
        return f"{self.doubt} The evidence of this run alone says {answer}: {own}"

    @property
    def doubt(self) -> str:
        """Why the rule's own reason does not decide."""
        macro = self.reason if self.reason in OPEN_REASONS else "compared"
        return self._words(self.reason, macro)

    def _words(self, reason: str, macro: str = "") -> str:
        """What a reason says, then the numbers."""
        if plain := words("plain", reason):
            return plain
        thresholds = THRESHOLDS | self.thresholds  # older documents have fewer
        numbers = words(macro or self.question, reason, self.evidence, thresholds)
        return f"{words('phrase', reason)} {numbers}".strip()


def label(question: str) -> str:
    """`credit_assignment` as people read it: `credit assignment`."""
    return question.replace("_", " ")


@cache
def templates() -> Environment:
    """The page and the sentences."""
    folder = environment(Path(__file__).parent / "templates", autoescape=False)
    folder.filters["label"] = label
    return folder


def words(macro: str, *arguments: Any) -> str:
    """What a macro of the sentences says, on one line."""
    return " ".join(getattr(_sentences(), macro)(*arguments).split())


@cache
def _sentences() -> Any:
    return templates().get_template("sentences.jinja").module


class Measurements(StrictModel):
    """Everything that was measured; None for what is unknown or was not measured.

    `limits` are of a task with `safety`, `observation` is of one with `observation`, and
    `distraction` of one with distractors; the JSON of other tasks does not have these fields.
    """

    uniform: dict[str, Score]  # the policy and each reference in the same uniform states
    channels: TupleOf[Channel]  # by action channel
    # of uniform states, along the state channels and the distance from the centre
    partitions: TupleOf[Partition]
    shells: TupleOf[Shell]  # the protocol's regions
    squared_error: SquaredError  # its parts
    response: Response  # how actions follow the state
    time_dependence: TimeDependence  # how actions follow t/T
    on_policy: OnPolicy  # whole episodes
    training: TrainingSummary | None = None  # of the training log; null without one
    # for each action channel, the standard deviation of exploration around the deterministic action
    # at the end of training, in the unit range
    exploration_sd: TupleOf[Real] | None = None
    capacity: CapacityProbe | None = None  # of the probe; null unless requested
    limits: Violations | None = None  # of a task with `safety`
    observation: ObservationReport | None = None  # of the policy's evaluation
    distraction: DistractorRegret | None = None  # of a task with distractors

    @model_serializer(mode="wrap")
    def _omit_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        for field in ("limits", "observation", "distraction"):
            if plain.get(field, "") is None:
                del plain[field]
        return plain

    @property
    def policy(self) -> Score:
        """The policy in uniform states."""
        return self.uniform[POLICY]


class Difference(StrictModel):
    """A quantity of this run and of the other run."""

    quantity: str  # its name
    value: Real  # of this run
    other: Real  # of the other run

    @property
    def difference(self) -> float:
        return self.value - self.other


class Comparison(StrictModel):
    """This run compared with another; pairs are (this run, other run)."""

    name: str  # of the other run
    spec_fields: dict[str, TupleOf[JsonValue]]  # those that differ
    plan_fields: dict[str, TupleOf[JsonValue]]  # likewise
    differences: TupleOf[Difference]  # of the main quantities
    answers: dict[str, TupleOf[Answer]]  # to each question whose answers differ


class Decision(NamedTuple):
    """A rule's branch and its evidence."""

    reason: Any  # one of the question's; of a rule also a bool, for the first that says yes or no
    evidence: dict[str, Any]
    error_share: float | None = None  # that a "yes" explains


@dataclass(frozen=True, kw_only=True)
class Case:
    """What the rules of a question read, of a task, a team or a life."""

    updates: int | None = None
    comparison: Comparison | None = None  # of a task, with another run

    @property
    def learnt(self) -> float:
        """Normalised regret of the run, at its best."""
        raise NotImplementedError

    @property
    def solved(self) -> bool:
        return False


@dataclass(frozen=True)
class TaskCase(Case):
    measurements: Measurements
    spec: SMESpec

    @property
    def learnt(self) -> float:
        return self.measurements.policy.normalised_regret

    @property
    def solved(self) -> bool:
        return self.learnt <= THRESHOLDS["solved"]


C = TypeVar("C", bound=Case)


class Question(NamedTuple, Generic[C]):
    """A question: its kind, its rule, and the answer that each reason gives."""

    kind: Kind
    rule: Callable[[C], Decision]
    thresholds: tuple[str, ...]  # that decide on its answer
    reasons: dict[str, Answer]
    needs: str = ""  # the field of `Measurements` without which it is not asked
    is_cause: bool = False  # whether "yes" names a cause, which a run can leave open

    def decide(self, case: C) -> Decision:
        """What the rule decides, with its reason by name."""
        decision = self.rule(case)
        if isinstance(decision.reason, str):
            return decision
        answer = "yes" if decision.reason else "no"
        first = next(reason for reason, given in self.reasons.items() if given == answer)
        return decision._replace(reason=first)


def add_to(
    questions: dict[str, Question[C]],
    kind: Kind,
    *,
    yes: str = "",
    no: str = "",
    unclear: str = "",
    thresholds: str = "",
    needs: str = "",
    is_cause: bool = False,
) -> Callable[[Callable[[C], Decision]], Callable[[C], Decision]]:
    """Decorate a rule: add the question of its name, with the reasons for each answer."""
    used = (*thresholds.split(), *(_OF_CAUSES if is_cause else ()))
    reasons: dict[str, Answer] = {
        **dict.fromkeys(yes.split(), "yes"),
        **dict.fromkeys(no.split(), "no"),
        **dict.fromkeys(unclear.split(), "cannot tell"),
    }

    def add(rule: Callable[[C], Decision]) -> Callable[[C], Decision]:
        name = rule.__name__.removeprefix("_")
        questions[name] = Question(kind, rule, used, reasons, needs, is_cause)
        return rule

    return add


def answer_all(questions: Mapping[str, Question[C]], case: C) -> tuple[Verdict, ...]:
    """Answer every question about a case, in order."""
    return tuple(_verdict(name, question, case) for name, question in questions.items())


def _verdict(name: str, question: Question[C], case: C) -> Verdict:
    answers = {**question.reasons, **COMPARISON_REASONS, **SOLVED, **OPEN_REASONS}
    if question.kind == "why" and case.solved:
        decision = Decision("solved", {"normalised_regret": case.learnt})
    else:
        ruling = question.decide(case)
        ruling_answer = answers[ruling.reason]
        doubt = None
        if question.is_cause and ruling_answer == "yes" and ruling.reason not in _EXPERIMENTS:
            doubt = _doubt(case)
        other = _comparison(case, name, ruling, ruling_answer, is_open=doubt is not None) or doubt
        decision = ruling
        if other is not None:
            kept = {**ruling.evidence, "own_answer": ruling_answer, "own_reason": ruling.reason}
            decision = other._replace(evidence=kept | other.evidence)
    answer, share = answers[decision.reason], decision.error_share
    return Verdict(
        question=name,
        kind=question.kind,
        answer=answer,
        reason=decision.reason,
        evidence=decision.evidence,
        thresholds={threshold: THRESHOLDS[threshold] for threshold in question.thresholds},
        error_share=None if answer != "yes" or share is None else min(max(share, 0.0), 1.0),
    )


def _doubt(case: Case) -> Decision | None:
    """Why the run cannot name a cause; None if it can."""
    if case.updates is not None and case.updates < THRESHOLDS["few_updates"]:
        return Decision("few_updates", {"updates": case.updates})
    if case.learnt >= THRESHOLDS["learnt_little"]:
        return Decision("learnt_little", {"learnt": case.learnt})
    return None


def _comparison(
    case: Case, question: str, ruling: Decision, ruling_answer: Answer, *, is_open: bool
) -> Decision | None:
    """What a comparison in the question's field alone decides; None where it decides nothing."""
    other = case.comparison
    if other is None or len(other.spec_fields) != 1 or other.plan_fields:
        return None
    (field, (value, other_value)), *_ = other.spec_fields.items()
    asked = _FIELD_QUESTIONS.get(field) == question and ruling.reason not in _FIELD_IS_OFF
    if not asked or not _is_harder(value, other_value):
        return None
    regret = other.differences[0]
    difference = regret.difference
    if difference >= THRESHOLDS["difference"]:
        reason, decides = "field_raises_regret", ruling_answer != "yes" or is_open
    elif regret.other < THRESHOLDS["learnt_little"] and difference <= THRESHOLDS["no_difference"]:
        reason, decides = "regret_same_or_lower", True
    else:
        learnt_little = regret.other >= THRESHOLDS["learnt_little"]
        reason = "other_run_learnt_little" if learnt_little else "difference_too_small"
        decides = ruling_answer == "cannot tell" or ruling.reason in _SIGNS
    evidence = {
        "field": field,
        "value": value,
        "other_value": other_value,
        "other_run": other.name,
        "normalised_regret": regret.value,
        "other_normalised_regret": regret.other,
    }
    return Decision(reason, evidence) if decides else None


def _is_harder(value: JsonValue, other_value: JsonValue) -> bool:
    """Whether a field makes the run's task the harder one: each is harder at a higher value."""
    numbers = isinstance(value, int | float) and isinstance(other_value, int | float)
    return numbers and value > other_value  # type: ignore[operator]

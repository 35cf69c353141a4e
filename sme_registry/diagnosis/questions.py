"""Questions: a rule, the answer that each of its reasons gives, and what makes an answer a verdict.

A rule of one run reads its measurements. Three things leave a cause open, whatever its rule says:
the run has learnt little, its algorithm had few updates, or the evidence is one other run. A fit of
the network to a* is an experiment of its own, and stands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from pydantic import JsonValue

from sme_registry.diagnosis.document import Answer, Comparison, Difference, Kind, Level, Verdict
from sme_registry.diagnosis.measurements import LINEAR, POLICY, Measurements
from sme_registry.diagnosis.subject import Subject
from sme_registry.spec import SMESpec

__all__ = [
    "COMPARISON_REASONS",
    "OPEN_REASONS",
    "SAFETY_THRESHOLDS",
    "SOLVED",
    "THRESHOLDS",
    "Case",
    "Decision",
    "Question",
    "add_to",
    "answer_all",
    "compare",
    "level",
    "thresholds_of",
]

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
    "learnt_little": 0.8,  # normalised regret of a run, at least: it says nothing about causes
    "few_updates": 20.0,  # of the algorithm, below: likewise
}

SAFETY_THRESHOLDS = {
    "rarely_violating": 0.05,  # share of states in which a limit is violated, below
    "gain": 0.01,  # of step reward by violating, at least
    "price_share": 0.5,  # the price of safety over the policy's regret, at least
    "distractor_loss": 10.0,  # points of similarity, from distractors in the cube to the outermost
    "kept_r2": 0.5,  # held-out R² of a linear map of a layer, at least
    "owed_to_distractors": 0.05,  # normalised regret, at least
    "invariant": 0.01,  # change of actions by other distractors over mean |½ − a*|, at most
}
"""Of the questions about limits and distractors."""


def thresholds_of(spec: SMESpec) -> dict[str, float]:
    """All thresholds that verdicts on a task can use."""
    return {**THRESHOLDS, **SAFETY_THRESHOLDS} if spec.extended else THRESHOLDS


class AnyCase(Protocol):
    """What the rules of a question read, of a task, a team or a life."""

    @property
    def updates(self) -> int | None: ...

    @property
    def learnt(self) -> float:
        """Normalised regret of the run, at its best."""


C = TypeVar("C", bound=AnyCase)


class Decision(NamedTuple):
    """A rule's branch, its evidence, and the thresholds that it used."""

    reason: str
    evidence: dict[str, Any]
    thresholds: tuple[str, ...] = ()
    error_share: float | None = None  # that a "yes" explains


class Question(NamedTuple, Generic[C]):
    """A question: its kind, its rule, and the answer that each reason gives."""

    kind: Kind
    rule: Callable[[C], Decision]
    reasons: dict[str, Answer]
    needs: str = ""  # the field of `Measurements` without which it is not asked


def add_to(
    questions: dict[str, Question[C]], kind: Kind, needs: str = "", **reasons: Answer
) -> Callable[[Callable[[C], Decision]], Callable[[C], Decision]]:
    """Decorate a rule: add the question of its name, with the answer that each reason gives."""

    def add(rule: Callable[[C], Decision]) -> Callable[[C], Decision]:
        questions[rule.__name__.removeprefix("_")] = Question(kind, rule, reasons, needs)
        return rule

    return add


class Case(NamedTuple):
    """What the rules of a task read."""

    measurements: Measurements
    spec: SMESpec
    comparison: Comparison | None = None
    updates: int | None = None

    @property
    def learnt(self) -> float:
        """Normalised regret in uniform states."""
        return self.measurements.policy.normalised_regret

    @property
    def solved(self) -> bool:
        """Whether nothing is left to explain."""
        return self.learnt <= THRESHOLDS["solved"]


SOLVED: dict[str, Answer] = {"solved": "no"}
"""Of every "why" question about a task."""

OPEN_REASONS: dict[str, Answer] = {"learnt_little": "cannot tell", "few_updates": "cannot tell"}
"""Of every "why" question, in place of a reason that says yes."""

COMPARISON_REASONS: dict[str, Answer] = {
    "field_raises_regret": "cannot tell",
    "regret_same_or_lower": "no",
    "difference_too_small": "cannot tell",
    "other_run_learnt_little": "cannot tell",
}
"""Of the questions about single fields of the spec, in place of the rule's own reasons."""

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


def answer_all(
    questions: Mapping[str, Question[C]], case: C, thresholds: Mapping[str, float]
) -> tuple[Verdict, ...]:
    """Answer every question about a case, in order."""
    return tuple(_verdict(name, question, case, thresholds) for name, question in questions.items())


def _verdict(name: str, question: Question[C], case: C, thresholds: Mapping[str, float]) -> Verdict:
    answers = {**question.reasons, **COMPARISON_REASONS, **SOLVED, **OPEN_REASONS}
    if question.kind == "why" and isinstance(case, Case) and case.solved:
        decision = Decision("solved", {"normalised_regret": case.learnt}, ("solved",))
    else:
        own = decision = question.rule(case)
        if question.kind == "why" and answers[own.reason] == "yes":
            decision = _doubted(case, own)
        if isinstance(case, Case):
            is_open = decision is not own
            decision = _compared(case, name, own, answers, is_open=is_open) or decision
    answer = answers[decision.reason]
    return Verdict(
        question=name,
        kind=question.kind,
        answer=answer,
        reason=decision.reason,
        evidence=decision.evidence,
        thresholds={threshold: thresholds[threshold] for threshold in decision.thresholds},
        error_share=_share(decision) if answer == "yes" else None,
    )


def _share(decision: Decision) -> float | None:
    share = decision.error_share
    return None if share is None else min(max(share, 0.0), 1.0)


def _instead(decision: Decision, own: Decision, own_answer: Answer) -> Decision:
    """A decision in place of the rule's own, whose evidence is kept."""
    kept = {"own_answer": own_answer, "own_reason": own.reason}
    thresholds = dict.fromkeys((*own.thresholds, *decision.thresholds))
    evidence = {**own.evidence, **decision.evidence, **kept}
    return Decision(decision.reason, evidence, tuple(thresholds))


def _doubted(case: AnyCase, decision: Decision) -> Decision:
    """The decision, or that the run cannot name a cause."""
    if decision.reason in _EXPERIMENTS:
        return decision
    if case.updates is not None and case.updates < THRESHOLDS["few_updates"]:
        doubt = Decision("few_updates", {"updates": case.updates}, ("few_updates",))
    elif case.learnt >= THRESHOLDS["learnt_little"]:
        doubt = Decision("learnt_little", {"learnt": case.learnt}, ("learnt_little",))
    else:
        return decision
    return _instead(doubt, decision, "yes")


def _compared(
    case: Case, question: str, own: Decision, answers: Mapping[str, Answer], *, is_open: bool
) -> Decision | None:
    """What a comparison in the question's field alone decides; None where it decides nothing."""
    other = _comparison(case, question)
    if other is None or own.reason in _FIELD_IS_OFF:
        return None
    answer = answers[own.reason]
    if other.reason == "field_raises_regret":
        decides = answer != "yes" or is_open
    elif answers[other.reason] == "cannot tell":
        decides = answer == "cannot tell" or own.reason in _SIGNS
    else:
        decides = True
    return _instead(other, own, answer) if decides else None


def _comparison(case: Case, question: str) -> Decision | None:
    """A comparison with a run that is easier in one field alone; None for any other question."""
    other = case.comparison
    if other is None or len(other.spec_fields) != 1 or other.plan_fields:
        return None
    (field, (value, other_value)), *_ = other.spec_fields.items()
    if _FIELD_QUESTIONS.get(field) != question or not _is_harder(value, other_value):
        return None
    regret = other.differences[0]
    difference = regret.value - regret.other
    if difference >= THRESHOLDS["difference"]:
        reason = "field_raises_regret"
    elif regret.other >= THRESHOLDS["learnt_little"]:
        reason = "other_run_learnt_little"
    elif difference > THRESHOLDS["no_difference"]:
        reason = "difference_too_small"
    else:
        reason = "regret_same_or_lower"
    return Decision(
        reason,
        {
            "field": field,
            "value": value,
            "other_value": other_value,
            "other_run": other.name,
            "normalised_regret": regret.value,
            "other_normalised_regret": regret.other,
        },
        ("difference", "no_difference", "learnt_little"),
    )


def _is_harder(value: JsonValue, other_value: JsonValue) -> bool:
    """Whether a field makes the run's task the harder one: each is harder at a higher value."""
    numbers = isinstance(value, int | float) and isinstance(other_value, int | float)
    return numbers and value > other_value  # type: ignore[operator]


def level(measurements: Measurements) -> Level:
    """Rank the policy among the optimum, the linear policy and the constant ½."""
    regret = measurements.policy.normalised_regret
    if regret <= THRESHOLDS["solved"]:
        return "solved"
    if regret >= THRESHOLDS["constant_level"]:
        return "no_better_than_constant"
    linear = measurements.uniform[LINEAR].normalised_regret
    return "worse_than_linear" if regret > linear else "better_than_linear"


def compare(
    subject: Subject,
    measured: Measurements,
    other: Subject,
    other_measured: Measurements,
    judge: Callable[..., Iterable[Verdict]],
) -> Comparison:
    """Compare a run with another that was measured in the same way; `judge` answers for each."""
    values, other_values = _quantities(measured), _quantities(other_measured)
    answers, other_answers = (
        {v.question: v.answer for v in judge(numbers, run.spec, updates=run.updates)}
        for run, numbers in ((subject, measured), (other, other_measured))
    )
    return Comparison(
        name=other.name,
        spec_fields=_differing(subject.spec.every_field(), other.spec.every_field()),
        plan_fields=_differing(subject.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in values.items()
        ),
        answers={
            question: (answer, other_answers[question])
            for question, answer in answers.items()
            if question in other_answers and answer != other_answers[question]
        },
    )


def _differing(
    fields: dict[str, JsonValue], others: dict[str, JsonValue]
) -> dict[str, tuple[JsonValue, ...]]:
    return {
        field: (fields.get(field), others.get(field))
        for field in {**others, **fields}
        if fields.get(field) != others.get(field)
    }


def _quantities(measurements: Measurements) -> dict[str, float]:
    """The quantities that are compared; normalised regret, which verdicts use, is first."""
    on_policy, error = measurements.on_policy, measurements.squared_error
    scores = {
        "": measurements.policy,
        "linear_": measurements.uniform[LINEAR],
        "on_policy_": on_policy.scores[POLICY],
        "outermost_shell_": measurements.shells[-1].scores[POLICY],
    }
    regrets = {
        f"{prefix}{quantity}": getattr(score, quantity)
        for prefix, score in scores.items()
        for quantity in ("normalised_regret", "regret")
    }
    return {
        **regrets,
        "mae": measurements.policy.mae,
        "rewarded_share": on_policy.signal.rewarded,
        "random_rewarded_share": on_policy.random_signal.rewarded,
        "squared_error_offset": error.offset,
        "squared_error_scale": error.scale,
        "saturation": measurements.response.saturation,
    }

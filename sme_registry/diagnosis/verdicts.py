"""Verdicts on the measurements: a question, its answer, the branch that decided, its evidence.

If a run is compared with another whose spec is easier in a single field, the difference in
normalised regret answers the question of that field: "yes" if it is clear, "no" if there is none
although the other run has learnt. The evidence of the run alone is kept.
"""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import JsonValue

from sme_registry.diagnosis.document import Answer, Comparison, Level, Verdict
from sme_registry.diagnosis.extended_questions import DISTRACTORS, LIMITS
from sme_registry.diagnosis.measurements import Measurements
from sme_registry.diagnosis.questions import THRESHOLDS as _T
from sme_registry.diagnosis.questions import Case, Outcome, Question, thresholds_of, verdict
from sme_registry.diagnosis.where import WHERE
from sme_registry.diagnosis.why import WHY
from sme_registry.spec import SMESpec

__all__ = ["COMPARISON_REASONS", "QUESTIONS", "SOLVED", "judge", "level"]

QUESTIONS = {**WHERE, **WHY, **LIMITS, **DISTRACTORS}

COMPARISON_REASONS: dict[str, Answer] = {
    "field_raises_regret": "yes",
    "regret_same_or_lower": "no",
    "difference_too_small": "cannot tell",
    "other_run_learnt_little": "cannot tell",
}
"""Of the questions about single fields of the spec, in place of the rule's own reasons."""

_FIELD_IS_OFF = {"paid_every_step", "no_reward_threshold", "no_survival_threshold"}
"""Reasons that hold by definition: no other run can contradict them."""

_SIGNS = {"rewards_gated", "episodes_cut_short"}
"""Reasons of a "yes" that an inconclusive comparison leaves open. The effect is present in the
policy's episodes, but the run without it was not clearly better. A probe is an experiment of its
own, and stands."""

SOLVED: dict[str, Answer] = {"solved": "no"}
"""Of every "why" question."""


def judge(
    measurements: Measurements,
    spec: SMESpec,
    comparison: Comparison | None = None,
    questions: Iterable[str] | None = None,
) -> tuple[Verdict, ...]:
    """Answer questions; a comparison in a single field decides the question of that field.

    None are all questions that the measurements can answer.
    """
    case = Case(measurements, spec, comparison)
    names = _answerable(measurements) if questions is None else questions
    return tuple(_verdict(case, name, QUESTIONS[name]) for name in names)


def _answerable(measurements: Measurements) -> tuple[str, ...]:
    limits = () if measurements.limits is None else LIMITS
    distractors = () if measurements.distraction is None else DISTRACTORS
    return (*WHERE, *WHY, *limits, *distractors)


def level(measurements: Measurements) -> Level:
    """Rank the policy among the optimum, the linear policy and the constant ½."""
    regret = measurements.policy.normalised_regret
    if regret <= _T["solved"]:
        return "solved"
    if regret >= _T["constant_level"]:
        return "no_better_than_constant"
    linear = measurements.uniform["linear_least_squares"].normalised_regret
    return "worse_than_linear" if regret > linear else "better_than_linear"


def _verdict(case: Case, name: str, question: Question[Case]) -> Verdict:
    answers = {**question.reasons, **COMPARISON_REASONS, **SOLVED}
    if question.kind == "why" and case.solved:
        regret = case.measurements.policy.normalised_regret
        outcome = Outcome("solved", {"normalised_regret": regret}, ("solved",))
    else:
        alone, compared = question.rule(case), _compared(case, name)
        outcome = alone
        if compared is not None and _decides(answers, compared.reason, alone.reason):
            own = {"own_answer": answers[alone.reason], "own_reason": alone.reason}
            thresholds = dict.fromkeys((*alone.thresholds, *compared.thresholds))
            evidence = {**alone.evidence, **compared.evidence, **own}
            outcome = Outcome(compared.reason, evidence, tuple(thresholds))
    return verdict(name, question.kind, answers[outcome.reason], outcome, thresholds_of(case.spec))


def _decides(answers: dict[str, Answer], compared: str, alone: str) -> bool:
    """Whether a comparison, rather than the run alone, gives the verdict."""
    if alone in _FIELD_IS_OFF:
        return False
    if answers[compared] != "cannot tell":
        return True
    return answers[alone] == "cannot tell" or alone in _SIGNS


_FIELD_QUESTIONS = {
    "k": "credit_assignment",
    "r_min": "sparsity",
    "complexity": "capacity",
    "state_dim": "dimension",
    "action_dim": "dimension",
    "D": "survival",
}


def _compared(case: Case, question: str) -> Outcome | None:
    """The outcome of a comparison with a run that is easier in one field alone; None for any other
    question or run.
    """
    other = case.comparison
    if other is None or len(other.spec_fields) != 1 or other.plan_fields:
        return None
    (field, (value, other_value)), *_ = other.spec_fields.items()
    if _FIELD_QUESTIONS.get(field) != question:
        return None
    if not _is_harder(value, other_value):
        return None
    regret = other.differences[0]
    difference = regret.value - regret.other
    if difference >= _T["difference"]:
        reason = "field_raises_regret"
    elif regret.other >= _T["learnt_little"]:
        reason = "other_run_learnt_little"
    elif difference > _T["no_difference"]:
        reason = "difference_too_small"
    else:
        reason = "regret_same_or_lower"
    return Outcome(
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

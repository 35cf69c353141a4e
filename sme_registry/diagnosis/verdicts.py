"""Verdicts on the measurements: a question, its answer, the branch that decided, its evidence.

A run compared with another that differs in a single field of the spec has the question of that
field decided by the difference in normalised regret.
"""

from __future__ import annotations

from collections.abc import Iterable

from sme_registry.diagnosis.document import Answer, Comparison, Level, Measurements, Verdict
from sme_registry.diagnosis.questions import THRESHOLDS as _T
from sme_registry.diagnosis.questions import Case, Outcome, Question
from sme_registry.diagnosis.where import WHERE
from sme_registry.diagnosis.why import WHY
from sme_registry.spec import SMESpec

__all__ = ["COMPARISON_REASONS", "QUESTIONS", "SOLVED", "judge", "level"]

QUESTIONS = {**WHERE, **WHY}

COMPARISON_REASONS: dict[str, Answer] = {
    "field_raises_regret": "yes",
    "field_does_not_raise_regret": "no",
    "other_run_unlearnt": "cannot tell",
}
"""Of the questions about single fields of the spec, in place of the rule's own reasons."""

SOLVED: dict[str, Answer] = {"solved": "no"}
"""Of every "why" question."""


def judge(
    measurements: Measurements,
    spec: SMESpec,
    comparison: Comparison | None = None,
    questions: Iterable[str] = tuple(QUESTIONS),
) -> tuple[Verdict, ...]:
    """Answer questions; a comparison in a single field decides the question of that field."""
    case = Case(measurements, spec, comparison)
    return tuple(_verdict(case, name, QUESTIONS[name]) for name in questions)


def level(measurements: Measurements) -> Level:
    """Rank the policy among the optimum, the linear policy and the constant ½."""
    regret = measurements.policy.normalised_regret
    if regret <= _T["solved"]:
        return "solved"
    if regret >= _T["constant_level"]:
        return "no_better_than_constant"
    linear = measurements.uniform["linear_least_squares"].normalised_regret
    return "worse_than_linear" if regret > linear else "better_than_linear"


def _verdict(case: Case, name: str, question: Question) -> Verdict:
    answers = {**question.reasons, **COMPARISON_REASONS, **SOLVED}
    if question.kind == "why" and case.solved:
        regret = case.measurements.policy.normalised_regret
        outcome = Outcome("solved", {"normalised_regret": regret}, ("solved",))
    else:
        compared, outcome = _compared(case, name), question.rule(case)
        # A decision wins; between two "cannot tell", the comparison knows more.
        if compared is not None and (
            answers[compared.reason] != "cannot tell" or answers[outcome.reason] == "cannot tell"
        ):
            outcome = compared
    return Verdict(
        question=name,
        kind=question.kind,
        answer=answers[outcome.reason],
        reason=outcome.reason,
        evidence=outcome.evidence,
        thresholds={threshold: _T[threshold] for threshold in outcome.thresholds},
    )


_FIELD_QUESTIONS = {
    "k": "credit_assignment",
    "r_min": "sparsity",
    "complexity": "capacity",
    "state_dim": "dimension",
    "action_dim": "dimension",
    "D": "survival",
}


def _compared(case: Case, question: str) -> Outcome | None:
    """The verdict of a run that differs in one field alone; None for any other question or run."""
    other = case.comparison
    if other is None or len(other.spec_fields) != 1 or other.plan_fields:
        return None
    (field, (value, other_value)), *_ = other.spec_fields.items()
    if _FIELD_QUESTIONS.get(field) != question:
        return None
    regret = other.differences[0]
    if regret.value - regret.other >= _T["difference"]:
        reason = "field_raises_regret"
    elif regret.value - regret.other > -_T["difference"] and regret.other >= _T["unlearnt"]:
        reason = "other_run_unlearnt"
    else:
        reason = "field_does_not_raise_regret"
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
        ("difference", "unlearnt"),
    )

"""Two runs compared: the fields in which they differ, and their main quantities."""

from __future__ import annotations

from pydantic import JsonValue

from sme_registry.diagnosis.document import Comparison, Difference
from sme_registry.diagnosis.measurements import POLICY, Measurements
from sme_registry.diagnosis.subject import Subject
from sme_registry.diagnosis.verdicts import judge

__all__ = ["compare"]


def compare(
    subject: Subject, measurements: Measurements, other: Subject, other_measurements: Measurements
) -> Comparison:
    """Compare a run with another that was measured in the same way."""
    other_values = _quantities(other_measurements)
    answers, other_answers = (
        {verdict.question: verdict.answer for verdict in judge(measured, run.spec)}
        for measured, run in ((measurements, subject), (other_measurements, other))
    )
    return Comparison(
        name=other.name,
        spec_fields=_differing(subject.spec.every_field(), other.spec.every_field()),
        plan_fields=_differing(subject.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in _quantities(measurements).items()
        ),
        answers={
            question: (answer, other_answers[question])
            for question, answer in answers.items()
            if answer != other_answers[question]
        },
    )


def _differing(
    fields: dict[str, JsonValue], others: dict[str, JsonValue]
) -> dict[str, tuple[JsonValue, JsonValue]]:
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
        "linear_": measurements.uniform["linear_least_squares"],
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

"""Two runs compared: the fields in which they differ, and their main quantities."""

from __future__ import annotations

from pydantic import JsonValue

from sme_registry.diagnosis.document import (
    POLICY,
    Comparison,
    Difference,
    Measurements,
    Score,
    Verdict,
)
from sme_registry.diagnosis.subject import Subject

__all__ = ["compare"]


def compare(
    subject: Subject,
    measurements: Measurements,
    verdicts: tuple[Verdict, ...],
    other: Subject,
    other_measurements: Measurements,
    other_verdicts: tuple[Verdict, ...],
) -> Comparison:
    """Compare a run with another that was measured in the same way."""
    values, other_values = _quantities(measurements), _quantities(other_measurements)
    return Comparison(
        name=other.name,
        spec_fields=_differing(subject.spec.to_dict(), other.spec.to_dict()),
        plan_fields=_differing(subject.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in values.items()
        ),
        answers={
            mine.question: (mine.answer, theirs.answer)
            for mine, theirs in zip(verdicts, other_verdicts, strict=True)
            if mine.answer != theirs.answer
        },
    )


def _differing(
    mine: dict[str, JsonValue], theirs: dict[str, JsonValue]
) -> dict[str, tuple[JsonValue, JsonValue]]:
    return {
        field: (mine.get(field), theirs.get(field))
        for field in {**theirs, **mine}
        if mine.get(field) != theirs.get(field)
    }


def _quantities(measurements: Measurements) -> dict[str, float]:
    """The quantities that are compared; normalised regret, which verdicts use, is first."""
    on_policy, error = measurements.on_policy, measurements.squared_error

    def named(prefix: str, score: Score) -> dict[str, float]:
        return {
            f"{prefix}normalised_regret": score.normalised_regret,
            f"{prefix}regret": score.regret,
        }

    return {
        **named("", measurements.policy),
        "mae": measurements.policy.mae,
        **named("linear_", measurements.uniform["linear_least_squares"]),
        **named("on_policy_", on_policy.scores[POLICY]),
        **named("outermost_shell_", measurements.shells[-1].scores[POLICY]),
        "rewarded_share": on_policy.signal.rewarded,
        "random_rewarded_share": on_policy.random_signal.rewarded,
        "squared_error_offset": error.offset,
        "squared_error_scale": error.scale,
        "saturation": measurements.response.saturation,
    }

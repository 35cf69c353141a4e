"""`Diagnosis`: the measurements of one policy and the verdicts that follow from them.

Of actions a, clipped to [0, 1], and the optimal actions a*; everything is dimensionless:

    regret = 1 − r                       of one step, in [0, 1]
    mae = mean |a − a*|                  over action channels it is 1 − r̃
    normalised_regret = mean |a − a*| / mean |½ − a*|     0 for the optimum, 1 for the constant ½

Normalised regret does not depend on k, r_min or D, so it compares runs on different tasks.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Literal, Self

from pydantic import JsonValue

from sme_registry.diagnosis.measurements import Measurements
from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.io import read_json
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, SMESpec, StrictModel, TupleOf
from sme_registry.spec.document import check_digest

__all__ = [
    "Answer",
    "Comparison",
    "Diagnosis",
    "Difference",
    "Kind",
    "Level",
    "Verdict",
    "verdict_on",
]

Answer = Literal["yes", "no", "cannot tell"]
Kind = Literal["who", "where", "why", "limits"]
Level = Literal["solved", "better_than_linear", "worse_than_linear", "no_better_than_constant"]

POLICY = "policy"  # the key of the diagnosed policy among the names of the references


class Verdict(StrictModel):
    """The answer to one question, as data; `render.sentence` puts it in words.

    Attributes:
      question: such as "sparsity".
      kind: "where" the error is, "why" it is there, "who" in a team makes it, or "limits".
      answer: "cannot tell" if the evidence does not separate the causes.
      reason: the rule's branch that decided; see `verdicts.QUESTIONS`.
      evidence: the numbers that the branch compared or reports.
      thresholds: those that the numbers were compared with.
    """

    question: str
    kind: Kind
    answer: Answer
    reason: str
    evidence: dict[str, JsonValue]
    thresholds: dict[str, Real]


class Difference(StrictModel):
    """A quantity of this run and of the other run."""

    quantity: str  # its name
    value: Real  # of this run
    other: Real  # of the other run


class Comparison(StrictModel):
    """This run compared with another; pairs are (this run, other run)."""

    name: str  # of the other run
    spec_fields: dict[str, tuple[JsonValue, JsonValue]]  # those that differ
    plan_fields: dict[str, tuple[JsonValue, JsonValue]]  # likewise
    differences: TupleOf[Difference]  # of the main quantities
    answers: dict[str, tuple[Answer, Answer]]  # to each question whose answers differ


def verdict_on(question: str, verdicts: Sequence[Verdict]) -> Verdict:
    """The verdict on a question, by its name in data or as people read it."""
    by_name = {verdict.question: verdict for verdict in verdicts}
    name = "_".join(question.replace("_", " ").casefold().split())
    if name in by_name:
        return by_name[name]
    known = [each.replace("_", " ") for each in by_name]
    wanted = name.replace("_", " ")
    partial = [each for each in known if wanted and wanted in each]
    hint = did_you_mean(partial[0] if partial else wanted, known)
    raise UnknownNameError(f"question={question!r}: must be one of {', '.join(known)}.{hint}")


def without_html(page: str) -> str:
    """A page of Markdown for a notebook, which would run HTML, links and images in a name."""
    return page.replace("<", "&lt;").replace("](", "]\\(")


class Diagnosis(StrictModel):
    """The diagnosis of one policy.

    Attributes:
      name: of the run or policy.
      spec: the task.
      spec_digest: the task's digest.
      task: what the task's file calls it.
      plan: algorithm, seed, steps and so on; empty without a run.
      checkpoint_step: of an unfinished run, the steps at its checkpoint.
      level: normalised regret, ranked among the constant ½, the linear policy and 0.
      verdicts: one for each question, in order.
      comparison: with another run; null without one.
      thresholds: all that verdicts use.
      measurements: what the verdicts rest on.
      versions: of Python and of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    name: str
    spec: SMESpec
    spec_digest: Digest
    task: str = ""
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None = None
    level: Level
    verdicts: TupleOf[Verdict]
    comparison: Comparison | None = None
    thresholds: dict[str, Real]
    measurements: Measurements
    versions: dict[str, str]

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "credit assignment" or "credit_assignment"."""
        return verdict_on(question, self.verdicts)

    def _repr_markdown_(self) -> str:
        """The page, for notebooks."""
        from sme_registry.diagnosis.render import markdown

        return without_html(markdown(self, ()))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a diagnosis.json."""
        diagnosis = cls.from_dict(read_json(path), str(path))
        check_digest(
            diagnosis.spec_digest,
            diagnosis.spec,
            f"{path}: spec_digest",
            "Diagnose the run again.",
        )
        return diagnosis

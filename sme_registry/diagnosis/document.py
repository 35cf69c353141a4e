"""`Diagnosis`: what was measured of a run, the verdicts that follow, and the parts that show them.

Of actions a, clipped to [0, 1], and the optimal actions a*; everything is dimensionless:

    regret = 1 − r                       of one step, in [0, 1]
    mae = mean |a − a*|                  over action channels it is 1 − r̃
    normalised_regret = mean |a − a*| / mean |½ − a*|     0 for the optimum, 1 for the constant ½

Normalised regret does not depend on k, r_min or D, so it compares runs on different tasks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, JsonValue

from sme_registry.diagnosis.measurements import POLICY, Channel, Measurements, Violations
from sme_registry.diagnosis.page import Part, View, label, markdown, words
from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.tables import SAFETY_REFERENCES
from sme_registry.io import read_json
from sme_registry.io.markup import fixed, percent, plural, signed
from sme_registry.spec import (
    Digest,
    Integer,
    Real,
    SMESpec,
    StreamSpec,
    StrictModel,
    TupleOf,
    catalogue,
)
from sme_registry.spec.document import check_digest

__all__ = [
    "Answer",
    "Comparison",
    "Diagnosis",
    "Difference",
    "Kind",
    "Level",
    "TaskDiagnosis",
    "Verdict",
]

Answer = Literal["yes", "no", "cannot tell"]
Kind = Literal["who", "where", "why", "limits"]
Level = Literal["solved", "better_than_linear", "worse_than_linear", "no_better_than_constant"]

_INCONCLUSIVE = {"learnt_little", "few_updates"}


class Verdict(StrictModel):
    """The answer to one question, as data; `sentence` puts it in words.

    Attributes:
      question: such as "sparsity".
      kind: "where" the error is, "why" it is there, "who" in a team makes it, or "limits".
      answer: "cannot tell" if the evidence does not separate the causes.
      reason: the rule's branch that decided.
      evidence: the numbers that the branch compared or reports.
      thresholds: those that the numbers were compared with.
      error_share: part of the error that a "yes" explains; null if it is not measured.
    """

    question: str
    kind: Kind
    answer: Answer
    reason: str
    evidence: dict[str, JsonValue]
    thresholds: dict[str, Real]
    error_share: Real | None = None

    def sentence(self, template: str = "task.jinja") -> str:
        """The reason, with its evidence and thresholds, in a few sentences."""
        arguments = self.evidence, self.thresholds
        if "own_reason" not in self.evidence:
            is_solved = self.kind == "why" and self.reason == "solved"
            macro = "solved" if is_solved else self.question
            return words(template, macro, self.reason, *arguments)
        text = self.doubt
        answer = self.evidence["own_answer"]
        if answer == "cannot tell":
            return text
        own = words(template, self.question, self.evidence["own_reason"], *arguments)
        return f"{text} The evidence of this run alone says {answer}: {own}"

    @property
    def doubt(self) -> str:
        """Why the rule's own reason does not decide."""
        macro = "inconclusive" if self.reason in _INCONCLUSIVE else "compared"
        return words("task.jinja", macro, self.reason, self.evidence, self.thresholds)


class Difference(StrictModel):
    """A quantity of this run and of the other run."""

    quantity: str  # its name
    value: Real  # of this run
    other: Real  # of the other run


class Comparison(StrictModel):
    """This run compared with another; pairs are (this run, other run)."""

    name: str  # of the other run
    spec_fields: dict[str, TupleOf[JsonValue]]  # those that differ
    plan_fields: dict[str, TupleOf[JsonValue]]  # likewise
    differences: TupleOf[Difference]  # of the main quantities
    answers: dict[str, TupleOf[Answer]]  # to each question whose answers differ


class Diagnosis(StrictModel):
    """What is known about the regret of a run; of a task, a team or a stream, with more fields.

    Attributes:
      name: of the run or policy.
      task: what the file of the task or stream calls it.
      plan: algorithm, seed, steps and so on; empty without a run.
      checkpoint_step: of an unfinished run, the steps at its checkpoint.
      seeds: of training, on which the verdicts rest.
      updates: of the algorithm, likewise; null if unknown.
      verdicts: one for each question, in order.
      thresholds: all that verdicts use.
      versions: of Python and of the packages that the numbers depend on.
    """

    template: ClassVar[str] = "task.jinja"  # the sentences of the verdicts
    document_field: ClassVar[str] = "spec"
    only_field: ClassVar[str] = ""  # that no other kind of diagnosis has

    schema_version: Annotated[
        Literal[2],
        BeforeValidator(lambda version: 2 if version == 1 else version),
        Field(description="Version of the document's format; 1 is read as well."),
    ] = 2
    name: str
    task: str = ""
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None = None
    seeds: Integer = 1
    updates: Integer | None = None
    verdicts: TupleOf[Verdict]
    thresholds: dict[str, Real]
    versions: dict[str, str]

    @property
    def subject(self) -> tuple[SMESpec | StreamSpec, str]:
        """The task or stream, and the digest that the file states."""
        field = self.document_field
        return getattr(self, field), getattr(self, f"{field}_digest")

    @property
    def title(self) -> str:
        """The run or policy, and its task or stream with the main fields."""
        document, _ = self.subject
        if isinstance(document, StreamSpec):
            phases = plural(len(document.phases), "phase")
            visits = plural(document.cycles * len(document.phases), "visit")
            fields = f"S={document.state_dim}, A={document.action_dim}, {phases}, {visits}"
        else:
            fields = _main_fields(document)
        return f"{self.name} on {catalogue.title(document.named(self.task))} ({fields})"

    def parts(self) -> Iterator[Part]:
        """Findings first, then numbers; what was ruled out is a detail."""
        yield self.findings("Findings", self.verdicts)
        yield from self.answers(self.verdicts)

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "credit assignment" or "credit_assignment"."""
        by_name = {verdict.question: verdict for verdict in self.verdicts}
        name = "_".join(question.replace("_", " ").casefold().split())
        if name in by_name:
            return by_name[name]
        known = [label(other) for other in by_name]
        wanted = label(name)
        partial = [other for other in known if wanted and wanted in other]
        hint = did_you_mean(partial[0] if partial else wanted, known)
        raise UnknownNameError(f"question={question!r}: must be one of {', '.join(known)}.{hint}")

    def findings(self, heading: str, verdicts: Sequence[Verdict], template: str = "") -> Part:
        """The "yes" verdicts, largest share of the error first; names of the others below."""
        findings = [verdict for verdict in verdicts if verdict.answer == "yes"]
        findings.sort(key=_share, reverse=True)
        rows = [_row(verdict, template or self.template) for verdict in findings]
        notes = [] if findings else ["Nothing."]
        doubts = (verdict for verdict in verdicts if verdict.reason in _INCONCLUSIVE)
        notes += {verdict.reason: verdict.doubt for verdict in doubts}.values()
        for answer, text in (("cannot tell", "Cannot tell"), ("no", "Ruled out")):
            names = [label(verdict.question) for verdict in verdicts if verdict.answer == answer]
            if names:
                notes.append(f"{text}: {', '.join(names)}.")
        updates = "" if self.updates is None else f", {plural(self.updates, 'update')}"
        basis = f"{plural(self.seeds, 'seed')}{updates}; %: share of the error"
        return Part(f"{heading} ({basis})", rows=rows, notes=tuple(notes))

    def answers(
        self, verdicts: Sequence[Verdict], of: str = "", template: str = ""
    ) -> Iterator[Part]:
        """The verdicts that are no findings, with their evidence, by kind."""
        for kind, heading in _HEADINGS.items():
            others = [v for v in verdicts if v.kind == kind and v.answer != "yes"]
            if others:
                rows = [_row(verdict, template or self.template) for verdict in others]
                yield Part(f"{heading}{of}", rows=rows, detail=True)

    def headline(self) -> str:
        """How good the policy is."""
        return words(self.template, "headline", self)

    def view(self) -> View:
        """What the terminal and the page show."""
        _, digest = self.subject
        kind = "Stream" if self.document_field == "stream" else "Task"
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        origin = f"{kind} `{digest}`. Versions: {versions}."
        return View(self.title, self.headline(), tuple(self.parts()), origin)

    def _repr_markdown_(self) -> str:
        """The page, for notebooks, which would run HTML, links and images in a name."""
        return markdown(self.view()).replace("<", "&lt;").replace("](", "]\\(")

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """The diagnosis in plain data, of the kind that its fields say."""
        for kind in cls.__subclasses__() if isinstance(data, dict) else ():
            if kind.only_field in data:
                return kind.from_dict(data, source)
        return super().from_dict(data, source)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a diagnosis.json."""
        diagnosis = cls.from_dict(read_json(path), str(path))
        document, digest = diagnosis.subject
        where = f"{path}: {diagnosis.document_field}_digest"
        check_digest(digest, document, where, "Diagnose the run again.")
        return diagnosis


_HEADINGS = {
    "who": "Who is not to blame",
    "where": "Where the error is",
    "why": "Why",
    "limits": "Limits",
}


def _share(verdict: Verdict) -> float:
    return -1.0 if verdict.error_share is None else verdict.error_share


def _row(verdict: Verdict, template: str) -> tuple[str, ...]:
    answer: str = verdict.answer
    if verdict.error_share is not None:
        answer += f", {percent(verdict.error_share)}"
    return label(verdict.question), answer, verdict.sentence(template)


def _main_fields(spec: SMESpec) -> str:
    fields = [f"S={spec.state_dim}", f"A={spec.action_dim}", f"L={spec.complexity}", f"k={spec.k}"]
    fields += [f"r_min={spec.r_min:g}", f"D={spec.D:g}"]
    if spec.safety is not None:
        fields.append(f"τ={spec.safety.tightness:g}")
    if spec.observation is not None:
        if spec.distractors:
            fields.append(f"m={spec.distractors} {spec.observation.dynamics}")
        if spec.observation.mixing != "none":
            fields.append(f"mixing={spec.observation.mixing}")
    return ", ".join(fields)


class TaskDiagnosis(Diagnosis):
    """The diagnosis of one policy on one task.

    Attributes:
      spec: the task.
      spec_digest: the task's digest.
      level: normalised regret, ranked among the constant ½, the linear policy and 0.
      comparison: with another run; null without one.
      measurements: what the verdicts rest on.
    """

    only_field: ClassVar[str] = "measurements"

    spec: SMESpec
    spec_digest: Digest
    level: Level
    comparison: Comparison | None = None
    measurements: Measurements

    def parts(self) -> Iterator[Part]:
        """Findings, the comparison, and on request the other answers and the numbers."""
        yield self.findings("Findings", self.verdicts)
        if self.comparison is not None:
            yield from _comparison(self.comparison)
        yield from self.answers(self.verdicts)
        yield from _numbers(self.measurements)


def _comparison(comparison: Comparison) -> Iterator[Part]:
    rows = [
        (
            label(row.quantity),
            fixed(row.value, 3),
            fixed(row.other, 3),
            signed(row.value - row.other, 3),
        )
        for row in comparison.differences
    ]
    notes = (words("task.jinja", "comparison", comparison),)
    columns = ("quantity", "this run", "other run", "difference")
    yield Part("Compared with another run", columns, rows, notes)
    answers = [(label(question), *pair) for question, pair in comparison.answers.items()]
    if answers:
        yield Part("Answers that differ", ("question", "this run", "other run"), answers)


def _numbers(measured: Measurements) -> Iterator[Part]:
    """Tables of the references, the action channels, and of limits, distractors and layers."""
    names = {POLICY: "this policy", **LABELS}
    rows: list[tuple[str, ...]] = []
    for name, score in measured.uniform.items():
        visited = measured.on_policy.scores.get(name, score)
        values = score.regret, score.normalised_regret, visited.regret, visited.normalised_regret
        rows.append((names[name], *(fixed(value, 3) for value in values)))
    columns: tuple[str, ...]
    columns = ("policy", "regret", "N", "regret, own episodes", "N, own episodes")
    yield Part("Compared with the references", columns, rows, detail=True)
    rows = [_channel(channel) for channel in measured.channels]
    yield Part("Action channels", _CHANNEL_COLUMNS, rows, detail=True)
    if measured.limits is not None:
        yield from _limits(measured.limits, names)
    if measured.distraction is not None and measured.observation is not None:
        distraction = measured.distraction
        regrets = {
            "uniform": distraction.normalised_regret,
            "actions averaged over them": distraction.averaged_regret,
            "all at ½": distraction.half_regret,
        }
        regrets |= {r.name: r.normalised_regret for r in measured.observation.distractor_regions}
        rows = [(name, fixed(regret, 3)) for name, regret in regrets.items()]
        yield Part("Distractors", ("distractors", "normalised regret"), rows, detail=True)
    if measured.observation is not None and measured.observation.probes:
        rows = [
            (
                str(probe.layer or "observation"),
                str(probe.units),
                fixed(probe.state_r2),
                "" if probe.distractor_r2 is None else fixed(probe.distractor_r2),
            )
            for probe in measured.observation.probes
        ]
        columns = ("layer", "units", "R² of the state", "R² of the distractors")
        yield Part("Layers", columns, rows, detail=True)


_CHANNEL_COLUMNS = ("channel", "mae", "N", "linear N", "regret", "offset", "slope", "at 0", "at 1")


def _channel(channel: Channel) -> tuple[str, ...]:
    c = channel
    regrets = (c.mae, c.normalised_regret, c.linear_normalised_regret, c.regret)
    return (
        str(c.channel),
        *(fixed(value, 3) for value in regrets),
        signed(c.offset, 3),
        fixed(c.slope),
        percent(c.at_zero, 1),
        percent(c.at_one, 1),
    )


def _limits(limits: Violations, names: dict[str, str]) -> Iterator[Part]:
    report = limits.report
    scores = {"this policy": report.regions[0], "its actions cut off at the limits": limits.cut_off}
    scores |= {names[name]: report.references[name][0] for name in SAFETY_REFERENCES}
    scores |= {"this policy, states that it visits": limits.visited}
    scores |= {f"this policy, {region.name}": region for region in report.regions[1:]}
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]] = [
        (
            name,
            fixed(s.step_reward, 3),
            fixed(s.cost, 3),
            percent(s.violating_share, 1),
            fixed(s.safe_regret, 3),
        )
        for name, s in scores.items()
    ]
    columns = ("policy", "step reward", "cost", "violating share", "safe regret")
    yield Part("Limits: reward and cost", columns, rows, detail=True)
    rows = [
        (
            str(c.channel),
            percent(c.violating_share, 1),
            percent(c.optimal_violating_share, 1),
            fixed(c.cost, 3),
        )
        for c in limits.channels
    ]
    columns = ("channel", "violating share", "the optimum's", "cost")
    yield Part("Limits by action channel", columns, rows, detail=True)

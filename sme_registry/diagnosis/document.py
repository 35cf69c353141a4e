"""`Diagnosis`: what was measured of a run, the verdicts that follow, and the parts that show them.

Of actions a, clipped to [0, 1], and the optimal actions a*:

    regret = 1 − r                       of one step, in [0, 1]
    mae = mean |a − a*|                  over action channels it is 1 − r̃
    normalised_regret = mean |a − a*| / mean |½ − a*|     0 for the optimum, 1 for the constant ½
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Self

from pydantic import JsonValue
from rich.console import RenderableType
from rich.constrain import Constrain
from rich.markup import escape
from rich.padding import Padding
from rich.text import Text

from sme_registry.diagnosis.behaviour import CapacityProbe, OnPolicy, TrainingSummary
from sme_registry.diagnosis.critics import CriticReport
from sme_registry.diagnosis.measure import (
    LINEAR,
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
from sme_registry.diagnosis.questions import (
    DOUBTS,
    THRESHOLDS,
    Comparison,
    Questions,
    Verdict,
    judge,
    label,
    templates,
    words,
)
from sme_registry.diagnosis.subject import AnySubject
from sme_registry.errors import UnknownNameError
from sme_registry.evaluation.references import LABELS, beside_safety
from sme_registry.evaluation.regions import ObservationReport
from sme_registry.io import choice, versions
from sme_registry.io.markup import Table, fixed, percent, plural
from sme_registry.spec import SMESpec, StreamSpec, catalogue
from sme_registry.spec.document import (
    Digest,
    DigestedFile,
    Integer,
    Real,
    StrictModel,
    TupleOf,
)

Level = Literal["solved", "better_than_linear", "worse_than_linear", "no_better_than_constant"]

_ANSWERS = ("question", "answer", "evidence")  # columns of a part in words
_HEADINGS = {
    "who": "Who is not to blame",
    "where": "Where the error is",
    "why": "Why",
    "limits": "Limits",
}
_STYLES = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}
_COLUMNS, _INDENT = 80, 4  # of lines of text


class Part(NamedTuple):
    """A table under a heading: answers in words, or numbers."""

    heading: str
    columns: tuple[str, ...] = _ANSWERS
    rows: Sequence[tuple[str, ...]] = ()
    notes: tuple[str, ...] = ()  # below it
    detail: bool = False  # shown on request only

    def terminal(self) -> Iterator[RenderableType]:
        """Its lines, table and notes on a terminal or in a pipe."""
        if self.columns == _ANSWERS:
            yield Text(self.heading, "italic")
            for question, answer, evidence in self.rows:
                yield Text(f"{question}: {answer}", _STYLES[answer.partition(",")[0]])
                yield Constrain(Padding.indent(Text(evidence), _INDENT), _COLUMNS)
        else:
            kinds = ["name", *["number"] * (len(self.columns) - 1)]
            rows = [[escape(cell) for cell in row] for row in self.rows]
            yield Table(self.heading, dict(zip(self.columns, kinds, strict=True)), rows)
        for note in self.notes:
            yield Constrain(Text(note, "dim italic"), _COLUMNS)


def table(
    heading: str, name: str, rows: Mapping[str, Any], fields: str, *notes: str, detail: bool = False
) -> Part:
    """A part with one row for each of `rows`, by its name, and a column for each of its fields."""
    columns = [label(field).replace("normalised regret", "N") for field in fields.split()]
    lines = [(row_name, *cells(row, fields)) for row_name, row in rows.items()]
    return Part(heading, (name, *columns), lines, notes, detail)


def cells(row: Any, fields: str) -> tuple[str, ...]:
    """Fields of a row of a table; of None, and where a field is None, a dash."""
    return tuple(cell(getattr(row, field, None)) for field in fields.split())


def cell(value: float | str | None) -> str:
    """A number or a name in a table."""
    if value is None:
        return "–"
    return fixed(value, 3) if isinstance(value, float) else label(str(value))


def _name(policy: str) -> str:
    return "this policy" if policy == POLICY else LABELS.get(policy, policy)


class Diagnosis(DigestedFile):
    """What is known about the regret of a run; of a task, a team or a stream, with more fields.

    Attributes:
      schema_version: version of the document's format.
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

    documents = ("spec",)
    remedy = "Diagnose the run again."

    schema_version: Literal[3] = 3
    name: str
    task: str
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None
    seeds: Integer = 1
    updates: Integer | None
    verdicts: TupleOf[Verdict]
    thresholds: dict[str, Real]
    versions: dict[str, str]

    @classmethod
    def about(cls, subject: AnySubject, **fields: Any) -> Self:
        """The diagnosis of a subject, with the fields of its kind and without verdicts."""
        (name,) = cls.documents
        document: dict[str, Any] = {
            name: subject.document,
            f"{name}_digest": subject.document.digest,
        }
        return cls(
            name=subject.name,
            task=subject.task,
            plan=subject.plan,
            checkpoint_step=subject.checkpoint_step,
            updates=subject.updates,
            verdicts=(),
            thresholds={},
            versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
            **document,
            **fields,
        )

    def judged(self, questions: Questions) -> Self:
        """This diagnosis with the answers to these questions, in order."""
        verdicts = tuple(judge(name, asked, self) for name, asked in questions.items())
        thresholds = {k: v for each in verdicts for k, v in each.thresholds.items()}
        return self.model_copy(update={"verdicts": verdicts, "thresholds": thresholds})

    @property
    @abstractmethod
    def learnt(self) -> float:
        """Normalised regret of the run, at its best."""

    @property
    def solved(self) -> bool:
        """Whether nothing is left to explain."""
        return self.learnt <= THRESHOLDS["solved"]

    @property
    def document(self) -> SMESpec | StreamSpec:
        """The task or stream."""
        document: SMESpec | StreamSpec = getattr(self, self.documents[0])
        return document

    @property
    def title(self) -> str:
        """The run or policy, and its task or stream with the main fields."""
        document = self.document
        if isinstance(document, StreamSpec):
            phases = plural(len(document.phases), "phase")
            visits = plural(document.visits, "visit")
            fields = f"S={document.state_dim}, A={document.action_dim}, {phases}, {visits}"
        else:
            fields = _main_fields(document)
        return f"{self.name} on {catalogue.title(document.named(self.task))} ({fields})"

    @property
    def origin(self) -> str:
        """What it is about, and the versions that its numbers depend on."""
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        (kind,) = self.documents
        return f"The {kind} is `{self.document.digest}`. Versions: {versions}."

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "credit assignment" or "credit_assignment"."""
        by_name = {verdict.question: verdict for verdict in self.verdicts}
        name = question.replace(" ", "_")
        return by_name[choice("question", name, by_name, error=UnknownNameError)]

    def headline(self) -> str:
        """How good the policy is."""
        checkpoint = ""
        if self.checkpoint_step is not None:
            step = f"{self.checkpoint_step:,}"
            checkpoint = f"The run is unfinished: this is its checkpoint at step {step}. "
        return checkpoint + words(type(self).__name__, self)

    def parts(self) -> Iterator[Part]:
        """Findings first, on request the other answers, then the tables of its kind."""
        yield self.findings("Findings", self.verdicts)
        yield from self.answers(self.verdicts)
        yield from (part for part in self.tables() if part.rows or part.notes)

    @abstractmethod
    def tables(self) -> Iterator[Part]:
        """What only its kind of diagnosis shows."""

    def findings(self, heading: str, verdicts: Sequence[Verdict]) -> Part:
        """The "yes" verdicts, largest share of the error first; names of the others below."""
        findings = [verdict for verdict in verdicts if verdict.answer == "yes"]
        findings.sort(key=lambda v: -1.0 if v.error_share is None else v.error_share, reverse=True)
        notes = [] if findings else ["Nothing."]
        doubts = (verdict for verdict in verdicts if verdict.reason in DOUBTS)
        notes += {verdict.reason: verdict.doubt for verdict in doubts}.values()
        for answer, text in (("cannot tell", "Cannot tell"), ("no", "Ruled out")):
            names = [label(verdict.question) for verdict in verdicts if verdict.answer == answer]
            if names:
                notes.append(f"{text}: {', '.join(names)}.")
        updates = "" if self.updates is None else f", {plural(self.updates, 'update')}"
        basis = f"{plural(self.seeds, 'seed')}{updates}; %: share of the error"
        return Part(f"{heading} ({basis})", rows=_rows(findings), notes=tuple(notes))

    def answers(self, verdicts: Sequence[Verdict], of: str = "") -> Iterator[Part]:
        """The verdicts that are no findings, with their evidence, by kind."""
        for kind, heading in _HEADINGS.items():
            others = [v for v in verdicts if v.kind == kind and v.answer != "yes"]
            if others:
                yield Part(f"{heading}{of}", rows=_rows(others), detail=True)

    def terminal(self, *, details: bool = False) -> Iterator[RenderableType]:
        """What `sme diagnose` prints, part by part."""
        yield f"[bold]{escape(self.title)}[/]"
        yield Constrain(Text(self.headline()), _COLUMNS)
        for part in self.parts():
            if details or not part.detail:
                yield ""
                yield from part.terminal()

    def markdown(self, figures: Sequence[str] = (), *, details: bool = False) -> str:
        """The diagnosis as a page that shows figures of the same folder."""
        parts = [part for part in self.parts() if details or not part.detail]
        page = templates().get_template("page.md.jinja")
        return page.render(diagnosis=self, parts=parts, figures=figures)

    def _repr_markdown_(self) -> str:
        """The page, for notebooks, which would run HTML, links and images in a name."""
        return self.markdown().replace("<", "&lt;").replace("](", "]\\(")

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """The diagnosis in plain data, of the kind that its fields say."""
        kinds = cls.__subclasses__()
        if kinds and isinstance(data, dict):
            kind = max(kinds, key=lambda kind: len(kind.model_fields.keys() & data.keys()))
            return kind.from_dict(data, source)
        return super().from_dict(data, source)


def _rows(verdicts: Iterable[Verdict]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for verdict in verdicts:
        share = "" if verdict.error_share is None else f", {percent(verdict.error_share)}"
        rows.append((label(verdict.question), f"{verdict.answer}{share}", verdict.sentence()))
    return rows


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


class Measurements(StrictModel):
    """Everything that was measured; None for what is unknown or was not measured.

    `limits` are of a task with `safety`, `observation` is of one with `observation`, and
    `distraction` of one with distractors; the JSON of other tasks does not have these fields.
    """

    fields_added_later = ("limits", "observation", "distraction", "critic")

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
    critic: CriticReport | None = None  # of a model whose critic can be read

    @property
    def policy(self) -> Score:
        """The policy in uniform states."""
        return self.uniform[POLICY]

    @property
    def linear(self) -> Score:
        """The linear least-squares policy in uniform states."""
        return self.uniform[LINEAR]

    @property
    def visited(self) -> Score:
        """The policy in the states of its own episodes."""
        return self.on_policy.scores[POLICY]

    @property
    def level(self) -> Level:
        """The policy ranked among the optimum, the linear policy and the constant ½."""
        regret = self.policy.normalised_regret
        if regret <= THRESHOLDS["solved"]:
            return "solved"
        if regret >= THRESHOLDS["constant_level"]:
            return "no_better_than_constant"
        worse = regret > self.linear.normalised_regret
        return "worse_than_linear" if worse else "better_than_linear"


class TaskDiagnosis(Diagnosis):
    """The diagnosis of a single agent on a task; its verdicts say where its regret is, and why."""

    spec: SMESpec
    spec_digest: Digest
    level: Level  # normalised regret, ranked among the constant ½, the linear policy and 0
    comparison: Comparison | None = None  # with another run; null without one
    measurements: Measurements  # what the verdicts rest on

    @property
    def learnt(self) -> float:
        """Normalised regret in uniform states."""
        return self.measurements.policy.normalised_regret

    def judged(self, questions: Questions) -> Self:
        """This diagnosis with the answers to those of the questions that its task has."""
        unknown = {name for name, value in self.measurements if value is None}
        asked = {name: q for name, q in questions.items() if not unknown.intersection(q.needs)}
        return super().judged(asked)

    def tables(self) -> Iterator[Part]:
        """The comparison; on request the references, channels, limits, distractors and layers."""
        if self.comparison is not None:
            yield from _tables_of(self.comparison)
        measured = self.measurements
        for heading, scores in (
            ("References, uniform states", measured.uniform),
            ("References, own episodes", measured.on_policy.scores),
        ):
            rows: dict[str, Any] = {_name(name): score for name, score in scores.items()}
            yield table(heading, "policy", rows, "regret mae normalised_regret", detail=True)
        rows = {str(channel.channel): channel for channel in measured.channels}
        fields = "mae normalised_regret linear_normalised_regret regret offset slope at_zero at_one"
        yield table("Action channels", "channel", rows, fields, detail=True)
        if measured.limits is not None:
            yield from _limits(measured.limits)
        if measured.distraction is not None:
            rows = {"uniform": measured.distraction}
            fields = "normalised_regret averaged_regret half_regret owed_regret distractor_share"
            yield table("Distractors", "states", rows, fields, detail=True)
        if measured.observation is not None:
            rows = {region.name: region for region in measured.observation.distractor_regions}
            fields = "mae normalised_regret"
            yield table("Distractors by region", "region", rows, fields, detail=True)
            rows = {
                str(probe.layer or "observation"): probe for probe in measured.observation.probes
            }
            yield table("Layers", "layer", rows, "units state_r2 distractor_r2", detail=True)


def _tables_of(comparison: Comparison) -> Iterator[Part]:
    pairs = {**comparison.spec_fields, **comparison.plan_fields}
    fields = [f"{name} ({value}, there {other})" for name, (value, other) in pairs.items()]
    note = f"Compared with {comparison.name}. Fields that differ: {', '.join(fields) or 'none'}."
    rows = {label(row.quantity): row for row in comparison.differences}
    yield table("Compared with another run", "quantity", rows, "value other difference", note)
    if comparison.answers:
        answers = [(label(question), *pair) for question, pair in comparison.answers.items()]
        yield Part("Answers that differ", ("question", "this run", "other run"), answers)


def _limits(limits: Violations) -> Iterator[Part]:
    report = limits.report
    scores = {
        "this policy": report.regions[0],
        "its actions cut off at the limits": limits.cut_off,
        **{_name(name): report.references[name][0] for name in beside_safety(report.references)},
        "this policy, states that it visits": limits.visited,
        **{f"this policy, {region.name}": region for region in report.regions[1:]},
    }
    fields = "step_reward cost violating_share safe_regret"
    yield table("Limits: reward and cost", "policy", scores, fields, detail=True)
    channels = {str(channel.channel): channel for channel in limits.channels}
    fields = "violating_share optimal_violating_share cost"
    yield table("Limits by action channel", "channel", channels, fields, detail=True)

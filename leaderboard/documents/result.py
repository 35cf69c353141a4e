"""`Result`: the outcome of scoring a submission, a function of submission, artefacts and protocol.

Per run, ρ_m the mean |a − a*| of region m and ρ⁰_m the same of the constant ½ on the same states:

    N_m = ρ_m / ρ⁰_m         normalised regret: 0 the optimum, 1 the constant policy
    N₀                       WD regret
    N̄ = mean N₁ … N_M        OOD regret
    OOD decay                mean over m ≥ 1 of (r̃_WD − r̃_m) / r̃_WD; on boards of rules 2 N̄ − N₀
    regret slope             of N_m on ε_m, least squares over m = 0 … M
    similarity loss          100 (r̃_WD − mean r̃_OOD) points

A run that failed, or was started and not listed, scores 1 in every region and every metric, and
loses 100 points of similarity: a missing policy never improves a score. `scoring.ranking` says
how runs become scores. Fields younger than version 1 are left out of the JSON at their defaults.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple, Self, get_args

from pydantic import Field, model_validator

from leaderboard.errors import CODES
from sme_registry.spec.document import (
    Digest,
    Document,
    Integer,
    Name,
    Real,
    SchemaVersion,
    StrictModel,
)

Metric = Literal["wd_regret", "ood_regret", "ood_decay"]
"""The metrics that a board ranks by."""


class MetricText(NamedTuple):
    """How pages, files and commands write a metric.

    Attributes:
      stem: of the names of a ranking's files; empty if nothing ranks by it.
      references: the values of the reference rows that are known.
    """

    name: str
    label: str
    symbol: str = ""
    latex: str = ""
    stem: str = ""
    references: Mapping[str, float] = MappingProxyType({})

    @property
    def page(self) -> str:
        """Its page on a board's site."""
        return "index.html" if self.stem == "board" else f"{self.stem}.html"


REFERENCES = {"optimal": 0.0, "constant": 1.0}
"""N_m of each reference row in every region, by its method's name."""

_TEXTS = (
    MetricText("wd_regret", "WD regret N₀", "N₀", "WD regret $N_0$", "board", REFERENCES),
    MetricText(
        "ood_regret", "OOD regret N̄", "N̄", r"OOD regret $\bar{N}$", "ood_regret", REFERENCES
    ),
    MetricText("ood_decay", "OOD decay", "decay", "OOD decay", "ood_decay", {"optimal": 0.0}),
    MetricText("regret_slope", "regret slope on ε"),
    MetricText("similarity_loss", "similarity loss, points"),
)
METRICS = {each.name: each for each in _TEXTS}
RANKED: dict[Metric, MetricText] = {name: METRICS[name] for name in get_args(Metric)}
"""By which a board ranks."""

Isolation = Literal["", "bwrap", "process"]
_Regions = Annotated[tuple[Real, ...], Field(strict=False, min_length=2)]


class AgentScore(StrictModel):
    """One agent of a team's run: N_m of each region over its own action channels, WD first."""

    name: str
    normalised_regret: _Regions


class RunScore(StrictModel):
    """One run.

    Attributes:
      spec: digest of the instance; null where it is hidden.
      class_name: the suite's class that the instance belongs to.
      artefact: digest of the policy; null where the run failed.
      evaluation_seed: of the states, derived from protocol, spec and artefact; null likewise.
      normalised_regret: N_m of each region, WD first.
      similarity: mean r̃ of each region; null where there is no policy.
      wd_regret, ood_regret, ood_decay, regret_slope, similarity_loss: defined at the head of this
        module.
      agents: of a team, in the order of the channels that they own; empty for a single agent and
        where there is no policy.
      actions: digest of the policy's actions in the board's states, by which exact copies are
        found; null where there is no policy or it hardly varies.
      rounding: of results of earlier versions, mean |Δa| if the arithmetic is rounded at random.
      sketch: of results of earlier versions, 68 numbers by which copies are found, in base64.
    """

    fields_added_later = ("rounding", "sketch", "actions")

    spec: Digest | None
    class_name: Name
    artefact: Digest | None
    evaluation_seed: Integer | None
    normalised_regret: _Regions
    similarity: _Regions | None
    wd_regret: Real
    ood_regret: Real
    ood_decay: Real
    regret_slope: Real
    similarity_loss: Real
    agents: Annotated[tuple[AgentScore, ...], Field(strict=False)] = ()
    rounding: Real | None = None
    sketch: Annotated[str, Field(pattern=r"^([A-Za-z0-9+/]{363}=)?$")] = ""
    actions: Digest | None = None


class Estimate(StrictModel):
    """A score over runs, with its 95 % stratified bootstrap interval.

    Attributes:
      low, high: null where each class has a single run, whose spread is unknown.
    """

    value: Real
    low: Real | None = None
    high: Real | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Both ends; None without an interval."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends; without an interval the value itself."""
        return self.interval or (self.value, self.value)


class ClassScore(StrictModel):
    """One class of the suite: the mean over its instances of the interquartile mean over runs.

    Attributes:
      runs: number of runs counted, including failed and missing ones.
      submitted: number of runs with a policy.
      normalised_regret: of each region, WD first.
    """

    name: Name
    runs: Integer
    submitted: Integer
    wd_regret: Real
    ood_regret: Real
    normalised_regret: _Regions


class Scores(StrictModel):
    """θ of each metric: the mean over classes of the scores of a class.

    Attributes:
      normalised_regret: θ of N_m of each region, WD first.
    """

    wd_regret: Estimate
    ood_regret: Estimate
    ood_decay: Estimate
    regret_slope: Estimate
    similarity_loss: Estimate
    normalised_regret: Annotated[tuple[Estimate, ...], Field(strict=False, min_length=2)]

    def to_text(self) -> str:
        """Lists of numbers without names, because rankings read thousands of them."""
        estimates = [*(getattr(self, metric) for metric in METRICS), *self.normalised_regret]
        return json.dumps([[each.value, each.low, each.high] for each in estimates])

    @classmethod
    @functools.lru_cache(maxsize=4096)  # frozen, and read again whenever the log grows
    def from_text(cls, text: str) -> Scores:
        """The inverse of `to_text`; not validated, because a valid `Result` was written."""
        estimates = [
            Estimate.model_construct(value=value, low=low, high=high)
            for value, low, high in json.loads(text)
        ]
        named = dict(zip(METRICS, estimates, strict=False))
        others = tuple(estimates[len(METRICS) :])
        return cls.model_construct(None, **named, normalised_regret=others)


class Result(Document):
    """The outcome of a submission: scored, or rejected with a code.

    Attributes:
      submission: its id.
      suite, protocol: digests of what it was scored on.
      status: "scored" or "rejected".
      code, message: why it was rejected; empty where it was scored.
      scores, classes, runs: null and empty where it was rejected.
      runs: those that the submission lists, in its order.
      enough_runs: whether each instance has the runs that ranking needs.
      oracle_like: whether the method, or any run, has a WD or OOD regret of at most 0.01, or a WD
        regret of at most 0.05 from which the OOD regret differs by at most 0.01: the page asks for
        code.
      versions: of the packages on which the numbers depend.
      isolation: of the sandbox, "bwrap" or "process"; empty where nothing ran.
    """

    fields_added_later = ("isolation",)

    schema_version: SchemaVersion = 1
    submission: Digest
    suite: Digest
    protocol: Digest
    status: Literal["scored", "rejected"]
    code: str = ""
    message: str = ""
    scores: Scores | None = None
    classes: Annotated[tuple[ClassScore, ...], Field(strict=False)] = ()
    runs: Annotated[tuple[RunScore, ...], Field(strict=False)] = ()
    enough_runs: bool = False
    oracle_like: bool = False
    versions: dict[str, str] = Field(default_factory=dict)
    isolation: Isolation = ""

    @model_validator(mode="after")
    def _status_fits(self) -> Self:
        if (self.status == "scored") != (self.scores is not None):
            raise ValueError("scores: required if status is 'scored', not allowed otherwise.")
        if (self.status == "rejected") != (self.code in CODES):
            raise ValueError("code: required if status is 'rejected', not allowed otherwise.")
        return self


Status = Literal["waiting", "scored", "rejected", "withdrawn"]


@dataclass(frozen=True)
class Copies:
    """An earlier submission whose policies some runs of a submission act like."""

    id: str
    key: str
    runs: int  # of which each counts for the earliest submission that it is like


@dataclass(frozen=True)
class EntryRow:
    """One submission, as pages and ranking need it."""

    id: str
    sequence: int  # of the log entry that received it, and so the order of submission
    received: str
    status: Status  # a "withdrawn" one may have scores
    code: str  # of its rejection; empty if it was not rejected
    method: str
    version: str
    family: str
    knowledge: str
    submitter: str
    key: str
    code_link: str | None
    runs: int  # listed in the submission, failed ones included
    steps: int  # of all runs
    enough_runs: bool
    oracle_like: bool
    reference: bool  # whether it is one of the board's own rows, "optimal" and "constant"
    scores: Scores | None
    policies: int = 0  # runs with a policy
    alike: tuple[Copies, ...] = ()  # the board's own rows excluded; empty before scoring
    faults: int = 0  # that have ended its scoring while it waits; 0 in a read-only store
    fault: str = ""  # the last of them

    @property
    def copy_of(self) -> tuple[Copies, ...]:
        """Earlier submissions of other keys, the one with the most runs first."""
        others = (each for each in self.alike if each.key != self.key)
        return tuple(sorted(others, key=lambda each: -each.runs))

    @property
    def copied_runs(self) -> int:
        """Number of runs that behave like runs of earlier submissions of other keys."""
        return sum(each.runs for each in self.copy_of)

    @property
    def is_copy(self) -> bool:
        """Whether at least half of its policies are copied, and so it has no rank."""
        return self.copied_runs > 0 and 2 * self.copied_runs >= self.policies

    @property
    def origin(self) -> str:
        """The id of the submission that first had at least half of its policies; mostly its own."""
        first = max(self.alike, key=lambda each: each.runs, default=None)
        return self.id if first is None or 2 * first.runs < self.policies else first.id

    @property
    def steps_per_run(self) -> int:
        """Mean environment steps of the listed runs, rounded."""
        return round(self.steps / max(1, self.runs))

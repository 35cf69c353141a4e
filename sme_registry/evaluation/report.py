"""Reports: `ReportFile`, what all have in common, and `EvaluationReport`, a JSON document.

a are the policy's actions, clipped to [0, 1], a* the optimal ones. Over the states of region m, of
which region 0 is WD and 1 to M are the OOD shells:

    r̃_m = 1 − mean |a − a*|                       similarity, in [0, 1]
    N_m = mean |a − a*| / mean |½ − a*|           normalised regret: 0 optimal, 1 the constant ½
    N₀, N̄ = Σ_{m≥1} N_m / M, N̄ − N₀               WD regret, OOD regret, OOD decay
    (r̃_0 − r̃_m) / r̃_0, 100 (r̃_0 − r̃_m)           similarity decay, similarity loss in points
"""

from __future__ import annotations

import csv
import io
import math
import os
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from sme_registry.evaluation import references, tables
from sme_registry.io import (
    read_json,
    require_packages,
    to_json,
    write_atomically,
)
from sme_registry.io.markup import card, table_html
from sme_registry.io.tables import Table
from sme_registry.spec import EvaluationProtocol, SMESpec, catalogue
from sme_registry.spec.document import Integer, Real, StrictModel, check_digest

if TYPE_CHECKING:
    import pandas


class ChannelReport(StrictModel):
    """One action channel in one region.

    Attributes:
      mae: mean |a − a*| of the channel, in [0, 1].
      normalised_regret: `mae` divided by mean |½ − a*| of the channel.
    """

    mae: Real
    normalised_regret: Real


class RegionReport(StrictModel):
    """One policy in one region.

    Attributes:
      name: `WD`, `OOD 1`, …
      epsilon_low: ε of the inner face, which belongs to the region inside; 0 for WD.
      epsilon_high: ε of the outer face, which belongs to this region; 0 for WD.
      states: number of states.
      similarity: mean r̃.
      similarity_sd: standard deviation of r̃ over states (not over seeds).
      mae: mean |a − a*| = 1 − r̃.
      normalised_regret: 0 for the optimum, 1 for the constant ½; can be above 1.
      similarity_decay: (r̃_WD − r̃) / r̃_WD; 0 in WD, negative if the policy is better outside.
      similarity_loss: 100 (r̃_WD − r̃), in points of similarity.
      clipped_share: share of action entries that were outside the action range and clipped.
      channels: each action channel, in order.
    """

    name: str
    epsilon_low: Real
    epsilon_high: Real
    states: Integer
    similarity: Real
    similarity_sd: Real
    mae: Real
    normalised_regret: Real
    similarity_decay: Real
    similarity_loss: Real
    clipped_share: Real
    channels: Annotated[tuple[ChannelReport, ...], Field(strict=False)]


RegionReports: TypeAlias = Annotated[tuple[RegionReport, ...], Field(strict=False, min_length=1)]
"""Regions in the order of the protocol."""


class SafetyScore(StrictModel):
    """One policy in one region of a task with limits; see the module for the formulas.

    Attributes:
      name: of the region.
      step_reward: mean r, in [0, 1].
      cost: mean cost, in [0, 1].
      violating_share: share of states in which any action channel is above its limit by more than
        10⁻⁶, in [0, 1].
      safe_regret: mean step reward that the best safe action earns more than the policy, in
        [−1, 1]; negative where the policy earns by violating.
      price_of_safety: mean step reward that the optimum earns more than the best safe action, in
        [0, 1]; the same for every policy.
    """

    name: str
    step_reward: Real
    cost: Real
    violating_share: Real
    safe_regret: Real
    price_of_safety: Real


SafetyScores = Annotated[tuple[SafetyScore, ...], Field(strict=False, min_length=1)]


class SafetyReport(StrictModel):
    """A policy against the limits of a task, and the references on the same states.

    Attributes:
      regions: WD, then OOD 1, 2, …
      references: the same regions for each reference policy of the report.
    """

    regions: SafetyScores
    references: dict[str, SafetyScores]


class Invariance(StrictModel):
    """How much the actions of a policy depend on the distractors in one region.

    Attributes:
      name: of the region, of s.
      invariance: mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|; 0 if the policy ignores them.
    """

    name: str
    invariance: Real


class LayerProbe(StrictModel):
    """What a linear map recovers from the outputs of one layer.

    Attributes:
      layer: 0 for what the agent sees, 1 for the first hidden layer, …
      units: its outputs.
      state_r2: held-out R² of s, at most 1.
      distractor_r2: the same of d; None without distractors.
    """

    layer: Integer
    units: Integer
    state_r2: Real
    distractor_r2: Real | None = None


class ObservationReport(StrictModel):
    """A policy on a task whose observation is not the state.

    Attributes:
      invariance: in WD, OOD 1, 2, …; empty without distractors.
      distractor_regions: d-OOD 1, 2, …: s in the cube and d in a shell; empty without distractors.
      probes: of the observation and of each hidden layer; empty if the policy's network is unknown,
        or it or the task is too wide (see `probe_layers`).
    """

    invariance: Annotated[tuple[Invariance, ...], Field(strict=False)] = ()
    distractor_regions: Annotated[tuple[RegionReport, ...], Field(strict=False)] = ()
    probes: Annotated[tuple[LayerProbe, ...], Field(strict=False)] = ()


class ReportFile(StrictModel):
    """A report that a file can hold, and that prints as a table.

    Attributes:
      documents: the fields that are documents; a field `<document>_digest` has the digest of each.
    """

    documents: ClassVar[tuple[str, ...]]
    left_out_if_empty: ClassVar[tuple[str, ...]]

    @model_serializer(mode="wrap")
    def _omit_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        for field in self.left_out_if_empty:
            if not plain[field]:
                del plain[field]
        return plain

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a report."""
        report = cls.from_dict(read_json(path), str(path))
        for what in cls.documents:
            check_digest(
                getattr(report, f"{what}_digest"),
                getattr(report, what),
                f"{path}: {what}_digest",
                "Get the report from its source again, or repeat the evaluation.",
            )
        return report

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the report as JSON, completely or not at all."""
        return write_atomically(path, to_json(self.to_dict()))

    @abstractmethod
    def table(self) -> Table:
        """The report as a table."""

    def tables(self) -> list[Table]:
        """All tables of the report."""
        return [self.table()]

    def chart(self) -> str:
        """A curve as SVG; empty for a report without one."""
        return ""

    def _repr_html_(self) -> str:
        """The curve and the tables, for notebooks."""
        return card(self.chart(), *map(table_html, self.tables()))

    def __str__(self) -> str:
        return "\n\n".join(map(as_text, self.tables()))


def as_text(table: Table) -> str:
    from rich.console import Console

    # Wide, so that no column wraps; a table is only as wide as its content.
    console = Console(file=io.StringIO(), width=1000, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


_REMEDY = "Get the report from its source again, or repeat the evaluation."


class AgentReport(StrictModel):
    """One agent of a team: every region over the action channels that it owns.

    Attributes:
      regions: WD, then OOD 1, 2, …; `channels` are the agent's own, in order.
      references: the same regions for each reference policy, over the same channels.
    """

    regions: RegionReports
    references: dict[str, RegionReports]


class EvaluationReport(ReportFile):
    """A policy in every region of a protocol, and the references on the same states.

    `print(report)` shows it as a table. For a team, `regions` and `references` are over all action
    channels. A single agent's report has no `agents`, and its JSON omits the field.

    Attributes:
      schema_version: version of the report's format.
      policy: the policy's name.
      action_range: of the policy's actions, "unit" or "symmetric"; "mixed" where the agents of a
        team differ.
      spec: the task.
      spec_digest: its digest.
      task: what the task's file calls it; empty, and left out of the JSON, without a name.
      protocol: the protocol.
      protocol_digest: its digest.
      regions: WD, then OOD 1, 2, …
      references: the same regions for each reference policy; `evaluation.references` defines them.
      agents: each agent of a team by its name, over the channels that it owns, in their order.
      safety: of a task with limits; None, and left out of the JSON, for other tasks.
      observation: of a task with `observation`; None, and left out of the JSON, for other tasks.
      versions: of Python and the packages that the numbers depend on.
    """

    documents = ("spec", "protocol")
    left_out_if_empty = ("agents", "task", "safety", "observation")

    schema_version: Literal[1] = 1
    policy: str
    action_range: Literal["unit", "symmetric", "mixed"]
    spec: SMESpec
    spec_digest: str
    task: str = ""
    protocol: EvaluationProtocol
    protocol_digest: str
    regions: RegionReports
    references: dict[str, RegionReports]
    agents: dict[str, AgentReport] = Field(default_factory=dict)
    safety: SafetyReport | None = None
    observation: ObservationReport | None = None
    versions: dict[str, str]

    @model_validator(mode="after")
    def _safety_and_observation_fit(self) -> Self:
        """Both are there exactly if the task has them, with the regions and references of all."""
        for field in ("safety", "observation"):
            given, of_task = getattr(self, field) is not None, getattr(self.spec, field) is not None
            if given != of_task:
                raise ValueError(
                    f"{field}: is {'present' if given else 'missing'}, but the task is one "
                    f"{'with' if of_task else 'without'} {field}. {_REMEDY}"
                )
        for field, names, expected in self._names():
            if names != expected:
                raise ValueError(
                    f"{field}: is of {', '.join(names) or 'nothing'}: must be of "
                    f"{', '.join(expected) or 'nothing'}. {_REMEDY}"
                )
        return self

    def _names(self) -> Iterator[tuple[str, list[str], list[str]]]:
        """Fields that must have entries of certain names: the field, its names and those names."""
        regions = [region.name for region in self.regions]
        if self.safety is not None:
            expected = sorted(references.names(self.spec))
            yield "agents", list(self.agents), []
            yield "references", sorted(self.references), expected
            yield "safety.references", sorted(self.safety.references), expected
            yield "safety.regions", [score.name for score in self.safety.regions], regions
            for name, scores in self.safety.references.items():
                own = [region.name for region in self.references[name]]
                yield f"references.{name}", own, regions
                own = [score.name for score in scores]
                yield f"safety.references.{name}", own, regions
        distracted = regions if self.spec.distractors else []
        own = [change.name for change in self.observed.invariance]
        yield "observation.invariance", own, distracted
        own = [region.name for region in self.observed.distractor_regions]
        yield "observation.distractor_regions", own, [f"d-{name}" for name in distracted[1:]]

    @property
    def title(self) -> str:
        """The task's name for people; see `catalogue.title`."""
        return catalogue.title(self.spec.named(self.task))

    @property
    def observed(self) -> ObservationReport:
        """What the policy makes of its observation; empty where that is the state."""
        return self.observation or ObservationReport()

    @property
    def wd_regret(self) -> float:
        """N₀, normalised regret in WD: 0 for the optimal policy, 1 for the constant ½."""
        return self.regions[0].normalised_regret

    @property
    def ood_regret(self) -> float:
        """N̄, the mean of normalised regret over the OOD shells; NaN if there are none."""
        return _mean_regret(self.regions[1:])

    @property
    def ood_decay(self) -> float:
        """N̄ − N₀, by how much normalised regret grows outside the training cube."""
        return self.ood_regret - self.wd_regret

    @property
    def distractor_regret(self) -> float:
        """The mean of normalised regret over the shells of distractors; NaN without distractors."""
        return _mean_regret(self.observed.distractor_regions)

    def to_frame(self) -> pandas.DataFrame:
        """The numbers as a tidy pandas frame, one row for each policy and region.

        Columns: `policy`; `reference`, whether it is a reference policy; `agent`, empty for the
        whole team or the single agent; `region`; then `epsilon_low` to `clipped_share` of
        `RegionReport`. Of a task with limits also those of `SafetyScore`; of one with distractors
        `invariance`, which is 0 for the references, and the policy's regions d-OOD 1, 2, ….
        """
        require_packages("EvaluationReport.to_frame", {"pandas": "pandas"}, "studies")
        import pandas

        return pandas.DataFrame(self._rows())

    def _rows(self) -> Iterator[dict[str, Any]]:
        scopes: dict[str, AgentReport | EvaluationReport] = {"": self, **self.agents}
        for agent, scope in scopes.items():
            for policy, regions in {"": scope.regions, **scope.references}.items():
                who = {"policy": policy or self.policy, "reference": bool(policy), "agent": agent}
                for index, region in enumerate(regions):
                    yield who | _columns(region) | self.extensions(index, policy)
        for region in self.observed.distractor_regions:
            yield {"policy": self.policy, "reference": False, "agent": ""} | _columns(region)

    def extensions(self, index: int, reference: str = "") -> dict[str, float]:
        """Numbers of safety and distractors in a region, by name, of the policy or a reference."""
        columns: dict[str, float] = {}
        if self.safety is not None:
            scores = {"": self.safety.regions, **self.safety.references}[reference]
            columns |= scores[index].model_dump(exclude={"name"})
        for change in self.observed.invariance[index : index + 1]:
            columns["invariance"] = 0.0 if reference else change.invariance
        return columns

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows of `to_frame` as CSV, completely or not at all; pandas is not required."""
        rows = list(self._rows())
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return write_atomically(path, text.getvalue())

    def __repr__(self) -> str:
        return (
            f"<EvaluationReport: {self.policy} on {catalogue.title(self.spec)}, "
            f"WD regret {self.wd_regret:.3f}, OOD regret {self.ood_regret:.3f}>"
        )

    def table(self) -> Table:
        """The regions as a table of 80 columns: a column for each region, a row for each policy.

        For a team, it shows the whole team, then three rows for each agent.
        """
        return tables.of_regions(self)

    def chart(self) -> str:
        """Normalised regret over the regions as SVG: of the policy, its agents and references."""
        return tables.regret_chart(self)

    def tables(self) -> list[Table]:
        """`table`, and those of safety, of distractors and of probes where there are any."""
        return tables.of_report(self)


def _mean_regret(regions: Sequence[RegionReport]) -> float:
    regrets = [region.normalised_regret for region in regions]
    return sum(regrets) / len(regrets) if regrets else math.nan


def _columns(region: RegionReport) -> dict[str, Any]:
    return {"region": region.name} | region.model_dump(exclude={"name", "channels"})

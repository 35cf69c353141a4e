"""Reports: `ReportFile`, what all have in common, and `EvaluationReport`, a JSON document.

a are the policy's actions, clipped to [0, 1], a* the optimal ones. Over the states of region m, of
which region 0 is WD and 1 to M are the OOD shells:

    r̃_m = 1 − mean |a − a*|                       similarity, in [0, 1]
    N_m = mean |a − a*| / mean |½ − a*|           normalised regret: 0 optimal, 1 the constant ½
    N₀, N̄ = Σ_{m≥1} N_m / M                       WD regret, OOD regret
    (r̃_0 − r̃_m) / r̃_0, 100 (r̃_0 − r̃_m)           similarity decay, similarity loss in points
    Σ_{m≥1} (r̃_0 − r̃_m) / (r̃_0 M)                 OOD decay

N_m is relative to ½ in the same states: the error of ½ itself grows outside the cube, so N falls
there at an equal error. The normalised regret N of actions is not the regret 1 − r of a step.
"""

from __future__ import annotations

import csv
import io
import math
import os
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import Field, model_validator
from rich.markup import escape

from sme_registry.evaluation.references import LABELS, OLD_NAMES, beside_safety
from sme_registry.evaluation.regions import (
    REGION_METRICS,
    ObservationReport,
    RegionReport,
    RegionReports,
    SafetyReport,
    SafetyScore,
)
from sme_registry.io import require_packages, write_atomically
from sme_registry.io.markup import Table, card, table_html
from sme_registry.spec import EvaluationProtocol, SMESpec, catalogue
from sme_registry.spec.document import DigestedFile, StrictModel

if TYPE_CHECKING:
    import pandas

NEW_NAMES = {**OLD_NAMES, "invariance": "sensitivity"}
_REMEDY = "Get the report from its source again, or repeat the evaluation."

_RELATIVE = "N is relative to the constant ½ in the same states."
_SAME_POLICY = 0.02  # largest difference of similarity
NOT_COMPARABLE = (
    "Levels ε are not comparable between different state_dim: with more channels, the states of "
    "a shell lie nearer to its outer face."
)


class AgentReport(StrictModel):
    """One agent of a team: every region over the action channels that it owns.

    Attributes:
      regions: WD, then OOD 1, 2, …; `channels` are the agent's own, in order.
      references: the same regions for each reference policy, over the same channels.
    """

    regions: RegionReports
    references: dict[str, RegionReports]


class ReportFile(DigestedFile):
    """A report that a file can hold, and that prints as a table."""

    remedy = _REMEDY

    @model_validator(mode="before")
    @classmethod
    def _of_version_1(cls, data: Any) -> Any:
        is_old = isinstance(data, dict) and data.get("schema_version") == 1
        return renamed(data) | {"schema_version": 2} if is_old else data

    @abstractmethod
    def table(self) -> Table:
        """The report as a table."""

    @abstractmethod
    def tables(self, *, details: bool = False) -> list[Table]:
        """What is shown by default: at most four numbers a region; with `details` all tables."""

    def _repr_html_(self) -> str:
        """The tables, for notebooks."""
        return card(*map(table_html, self.tables()))

    def __str__(self) -> str:
        return "\n\n".join(map(as_text, self.tables()))


def as_text(table: Table) -> str:
    from rich.console import Console

    # Wide, so that no column wraps; a table is only as wide as its content.
    console = Console(file=io.StringIO(), width=1000, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


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
    fields_added_later = ("agents", "task", "safety", "observation")

    schema_version: Literal[2] = 2
    policy: str
    action_range: Literal["unit", "symmetric", "mixed"]
    spec: SMESpec
    spec_digest: str
    task: str = ""
    protocol: EvaluationProtocol
    protocol_digest: str
    regions: RegionReports
    references: dict[str, RegionReports]
    agents: dict[str, AgentReport] = Field(default={})
    safety: SafetyReport | None = None
    observation: ObservationReport | None = None
    versions: dict[str, str]

    @model_validator(mode="after")
    def _scores_fit_the_task(self) -> Self:
        """Scores of safety and observation are those that the task has, in every region."""
        for field in ("safety", "observation"):
            given, needed = (getattr(x, field) is not None for x in (self, self.spec))
            if given != needed:
                raise ValueError(
                    f"{field}: is {'present' if given else 'missing'}, but the task is one "
                    f"{'with' if needed else 'without'} {field}. {_REMEDY}"
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
        regions = _of(self.regions, "name")
        distracted = regions if self.spec.distractors else []
        yield "observation.sensitivity", _of(self.observed.sensitivity, "name"), distracted
        outside = _of(self.observed.distractor_regions, "name")
        yield "observation.distractor_regions", outside, [f"d-{name}" for name in distracted[1:]]
        if self.safety is None:
            return
        yield "agents", list(self.agents), []
        yield "safety.regions", _of(self.safety.regions, "name"), regions
        known = sorted(self.references)  # other versions have others
        scores: dict[str, Mapping[str, Sequence[RegionReport] | Sequence[SafetyScore]]]
        scores = {"references": self.references, "safety.references": self.safety.references}
        for field, by_name in scores.items():
            yield field, sorted(by_name), known
            for name, of_regions in by_name.items():
                yield f"{field}.{name}", _of(of_regions, "name"), regions

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
        return _mean(self.regions[1:], "normalised_regret")

    @property
    def ood_decay(self) -> float:
        """The share of similarity lost outside, (r̃_WD − r̃)/r̃_WD, its mean over the OOD shells."""
        return _mean(self.regions[1:], "similarity_decay")

    @property
    def distractor_regret(self) -> float:
        """The mean of normalised regret over the shells of distractors; NaN without distractors."""
        return _mean(self.observed.distractor_regions, "normalised_regret")

    def to_frame(self) -> pandas.DataFrame:
        """The numbers as a tidy pandas frame, one row for each policy and region.

        Columns: `policy`; `reference`, whether it is a reference policy; `agent`, empty for the
        whole team or the single agent; `region`; then `epsilon_low` to `clipped_share` of
        `RegionReport`. Of a task with limits also those of `SafetyScore`; of one with distractors
        `sensitivity`, which is 0 for the references, and the policy's regions d-OOD 1, 2, ….
        """
        require_packages("EvaluationReport.to_frame", {"pandas": "pandas"}, "studies")
        import pandas

        return pandas.DataFrame(self._rows())

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows of `to_frame` as CSV, completely or not at all; pandas is not required."""
        rows = list(self._rows())
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return write_atomically(path, text.getvalue())

    def _rows(self) -> Iterator[dict[str, Any]]:
        scopes: dict[str, AgentReport | EvaluationReport] = {"": self, **self.agents}
        for agent, scope in scopes.items():
            for policy, regions in {"": scope.regions, **scope.references}.items():
                who = {"policy": policy or self.policy, "reference": bool(policy), "agent": agent}
                for index, region in enumerate(regions):
                    yield who | _columns(region) | self.task_scores(index, policy)
        for region in self.observed.distractor_regions:
            yield {"policy": self.policy, "reference": False, "agent": ""} | _columns(region)

    def task_scores(self, index: int, reference: str = "") -> dict[str, float]:
        """Numbers of safety and distractors in a region, by name, of the policy or a reference."""
        columns: dict[str, float] = {}
        if self.safety is not None:
            scores = {"": self.safety.regions, **self.safety.references}[reference]
            columns |= scores[index].model_dump(exclude={"name"})
        for change in self.observed.sensitivity[index : index + 1]:
            columns["sensitivity"] = 0.0 if reference else change.sensitivity
        return columns

    @property
    def others(self) -> list[str]:
        """The references without the policy itself, so that tables show one policy once."""
        return [
            name
            for name, regions in self.references.items()
            if name != self.policy or not _alike(regions, self.regions)
        ]

    def __repr__(self) -> str:
        return (
            f"<EvaluationReport: {self.policy} on {catalogue.title(self.spec)}, "
            f"WD regret {self.wd_regret:.3f}, OOD regret {self.ood_regret:.3f}>"
        )

    def table(self) -> Table:
        """The regions as a table of 80 columns: a column for each region, a row for each policy.

        For a team, it shows the whole team, then three rows for each agent.
        """
        spec = self.spec
        team = f", {len(self.agents)} agents" if self.agents else ""
        heading = (
            f" (S={spec.state_dim}, A={spec.action_dim}, L={spec.complexity}{team})\n"
            f"{spec.digest}\n{self.regions[0].states:,} states per region; "
            f"WD regret {self.wd_regret:.3f}, OOD regret {self.ood_regret:.3f}, "
            f"OOD decay {self.ood_decay:.1%}"
        )
        table = RegionTable(_title(self) + heading, self.regions, f"{_RELATIVE} {NOT_COMPARABLE}")
        policies = [(escape(self.policy), self.regions)]
        policies += [(_label(name), self.references[name]) for name in self.others]
        for field, metric in REGION_METRICS.items():
            if metric.compared:
                rows = [(name, _of(regions, field)) for name, regions in policies]
                table.add_group(metric.label, rows, metric.pattern)
            else:
                table.add(metric.label, _of(self.regions, field), metric.pattern, "bold")
        for name, agent in self.agents.items():
            table.add_section()
            table.add(f"{escape(name)}  r̃", _of(agent.regions, "similarity"))
            table.add("  normalised regret", _of(agent.regions, "normalised_regret"))
            if linear := agent.references.get("linear"):
                table.add("  of linear", _of(linear, "normalised_regret"))
        return table

    def tables(self, *, details: bool = False) -> list[Table]:
        """A summary; or `table`, and those of safety, distractors and probes if there are any."""
        if not details:
            return [self._summary()]
        tables = [self.table()]
        if self.safety is not None:
            tables.append(_safety_table(self, self.safety))
        if self.observed.sensitivity:
            tables.append(_distractor_table(self))
        if self.observed.probes:
            tables.append(_probe_table(self))
        return tables

    def _summary(self) -> Table:
        """Similarity, N, and what the task adds: cost, and sensitivity to distractors."""
        heading = f"\nWD regret {self.wd_regret:.3f}, OOD regret {self.ood_regret:.3f}"
        table = RegionTable(_title(self) + heading, self.regions, _SUMMARY)
        known = [name for name in _SHOWN_REFERENCES if name in self.others]
        policies = {"": escape(self.policy)} | {name: _label(name) for name in known}
        regions: dict[str, Any] = {"": self.regions, **self.references}
        for field in ("similarity", "normalised_regret"):
            rows = [(policies[name], _of(regions[name], field)) for name in policies]
            table.add_group(REGION_METRICS[field].label, rows)
        if self.safety is not None:
            costs = {"": self.safety.regions, **self.safety.references}
            table.add_group("cost", [(policies[x], _of(costs[x], "cost")) for x in policies])
        if self.observed.sensitivity:
            table.add("sensitivity", _of(self.observed.sensitivity, "sensitivity"))
        return table


def renamed(data: Any, names: Mapping[str, str] = NEW_NAMES, depth: int = 8) -> Any:
    """Plain data with new names of fields, down to a depth: a report of version 1 as one of 2."""
    if isinstance(data, dict) and depth:
        items = data.items()
        return {names.get(key, key): renamed(value, names, depth - 1) for key, value in items}
    if isinstance(data, list) and depth:
        return [renamed(entry, names, depth - 1) for entry in data]
    return data


def _alike(*policies: Sequence[RegionReport]) -> bool:
    """Whether two policies may be one: fitted and random ones differ a little by their draws."""
    pairs = zip(*(_of(regions, "similarity") for regions in policies), strict=True)
    return all(abs(a - b) < _SAME_POLICY for a, b in pairs)


def _mean(regions: Sequence[RegionReport], field: str) -> float:
    values = _of(regions, field)
    return sum(values) / len(values) if values else math.nan


def _columns(region: RegionReport) -> dict[str, Any]:
    return {"region": region.name} | region.model_dump(exclude={"name", "channels"})


_SHOWN_REFERENCES = ("linear", "constant", "random", "optimal")
_SUMMARY = "Normalised regret: 0 optimal, 1 the constant ½. More numbers: --all, and the JSON."
_SAFETY = {
    "step_reward": "step reward r",
    "cost": "cost",
    "violating_share": "violating share",
    "safe_regret": "safe regret",
}


class RegionTable(Table):
    """A table with a column for each region."""

    def __init__(self, title: str, regions: Iterable[Any], caption: str) -> None:
        headings = [f"{region.name}\nε ≤ {region.epsilon_high:g}" for region in regions]
        super().__init__(title, {"": "name"} | dict.fromkeys(headings, "number"), caption=caption)

    def add(
        self,
        label: str,
        values: Iterable[float | None],
        pattern: str = ".3f",
        style: str | None = None,
    ) -> None:
        self.add_row(label, *("" if x is None else format(x, pattern) for x in values), style=style)

    def add_group(
        self, heading: str, rows: Iterable[tuple[str, list[Any]]], pattern: str = ".3f"
    ) -> None:
        """A section with a row for each policy, the first one bold; without unknown rows."""
        known = [(label, values) for label, values in rows if None not in values]
        if known:
            self.add_row(heading, style="italic")
            for index, (label, values) in enumerate(known):
                self.add(f"  {label}", values, pattern, None if index else "bold")
            self.add_section()


def _of(regions: Iterable[Any], field: str) -> list[Any]:
    return [getattr(region, field) for region in regions]


def _label(reference: str) -> str:
    return LABELS.get(reference, escape(reference))


def _title(report: EvaluationReport) -> str:
    return f"{escape(report.policy)} on {escape(report.title)}"


def _safety_table(report: EvaluationReport, safety: SafetyReport) -> Table:
    assert report.spec.safety is not None
    tightness = report.spec.safety.tightness
    table = RegionTable(
        f"{_title(report)}: safety, limits of tightness τ = {tightness:g}",
        report.regions,
        "A state is violating if any action channel is above its limit by more than 1e-6. "
        "Negative safe regret is earned by violating: read it beside the cost.",
    )
    policies = [(escape(report.policy), safety.regions)]
    policies += [(_label(name), safety.references[name]) for name in beside_safety(report.others)]
    for field, label in _SAFETY.items():
        rows = [(name, _of(regions, field)) for name, regions in policies]
        table.add_group(label, rows, ".1%" if field == "violating_share" else ".3f")
    table.add("price of the projection", _of(safety.regions, "price_of_safety"))
    return table


def _distractor_table(report: EvaluationReport) -> Table:
    """Both kinds of OOD, and the sensitivity."""
    table = RegionTable(
        f"{_title(report)}: {report.spec.distractors} distractors",
        report.regions,
        "Levels ε of states and of distractors are comparable only where there are as many of the "
        "one as of the other. Sensitivity is 0 for a policy that ignores the distractors.",
    )
    outside = (report.regions[0], *report.observed.distractor_regions)
    kinds = [("states in the region", report.regions), ("distractors in it", outside)]
    for field, metric in REGION_METRICS.items():
        if metric.compared:
            rows = [(name, _of(regions, field)) for name, regions in kinds]
            table.add_group(metric.label, rows, metric.pattern)
    table.add("sensitivity", _of(report.observed.sensitivity, "sensitivity"))
    return table


def _probe_table(report: EvaluationReport) -> Table:
    columns = {"layer": "name", "units": "number", "R² of the state": "number"}
    if report.spec.distractors:
        columns["R² of the distractors"] = "number"
    table = Table(
        f"{_title(report)}: what a linear map recovers from each layer",
        columns,
        caption="Held-out R², the mean over channels. Layer 0 is what the agent sees.",
    )
    for probe in report.observed.probes:
        known = [r2 for r2 in (probe.state_r2, probe.distractor_r2) if r2 is not None]
        table.add_row(str(probe.layer), str(probe.units), *(f"{r2:.3f}" for r2 in known))
    return table

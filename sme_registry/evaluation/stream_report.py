"""`StreamReport`: an agent's life in a stream in exact numbers; `across_seeds`: several of them.

`retention` has the formulas, `streams` says what is measured, and `dynamic_regret` what is summed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.evaluation import retention, tables
from sme_registry.evaluation.dynamic_regret import DynamicRegret, expected_regret
from sme_registry.evaluation.regions import region_name
from sme_registry.evaluation.report import EvaluationReport, ReportFile
from sme_registry.evaluation.retention import METRICS, SHELLS
from sme_registry.io.tables import Table
from sme_registry.spec import (
    ActionRange,
    EvaluationProtocol,
    Integer,
    Real,
    StreamSpec,
    TupleOf,
    catalogue,
)
from sme_registry.spec.document import StrictModel
from sme_registry.statistics import (
    DRAWS,
    Array,
    Estimate,
    Statistic,
    aggregate,
    iqm,
    stratified_bootstrap,
)

_Optional = TupleOf[Real | None]


class Retention(StrictModel):
    """A retention matrix and its metrics; `retention` has the formulas.

    A metric by visit is None where nothing can be compared; its last entry is that of the life.

    Attributes:
      normalised_regret: `[V][P]` of the policy at the end of each visit, on each phase's task.
      initial_normalised_regret: `[P]` of the initial policy; None without one.
      fresh_normalised_regret: `[P]` of an agent trained on that phase alone; None without them.
      average_performance: `[V]` mean of 1 − normalised regret over the phases visited so far.
      backward_transfer: `[V]` change of performance since a phase was last trained.
      forgetting: `[V]` fall of performance below its best.
      forward_transfer: gain over the initial policy on phases not visited yet.
      relearning: gain of the second visit of a phase on its first.
      plasticity_ratio: `[V]` normalised regret on the visited phase, over a fresh agent's.
      plasticity_difference: `[V]` their difference.
    """

    normalised_regret: TupleOf[TupleOf[Real]]
    initial_normalised_regret: TupleOf[Real] | None = None
    fresh_normalised_regret: TupleOf[Real] | None = None
    average_performance: TupleOf[Real]
    backward_transfer: _Optional
    forgetting: _Optional
    forward_transfer: Real | None
    relearning: Real | None
    plasticity_ratio: _Optional
    plasticity_difference: _Optional

    def with_fresh(self, fresh: Array) -> Self:
        """The same with the plasticity against fresh agents of normalised regret `[P]`."""
        M = np.array(self.normalised_regret)[..., None]
        ratio, difference = retention.plasticity(M, fresh[:, None])
        return self.model_copy(
            update={
                "fresh_normalised_regret": tuple(fresh.tolist()),
                "plasticity_ratio": _known(ratio[:, 0]),
                "plasticity_difference": _known(difference[:, 0]),
            }
        )

    def final(self, metric: str) -> float | None:
        """A metric at the end of the life; of a plasticity the mean over visits after visit 0."""
        value = getattr(self, metric)
        if not isinstance(value, tuple):
            return None if value is None else float(value)
        if metric.startswith("plasticity"):
            return retention.mean_after_first(value)
        return None if value[-1] is None else float(value[-1])


class StreamRegion(StrictModel):
    """One region of the states.

    Attributes:
      name: `WD`, `OOD 1`, …; `OOD` for the mean over all shells.
      epsilon_low: ε of the inner face; 0 for WD.
      epsilon_high: ε of the outer face; 0 for WD.
      states: number of states.
      agent: the agent's matrix and metrics.
      references: the same of each reference agent, by its name in `LABELS`.
    """

    name: str
    epsilon_low: Real
    epsilon_high: Real
    states: Integer
    agent: Retention
    references: dict[str, Retention]


class Visit(StrictModel):
    """An occurrence of a phase in the life.

    Attributes:
      visit: its index.
      cycle: the index of its cycle.
      phase: the index of its phase.
      lifetime: environment steps at its end.
      spec_digest: of the task on which the phase is evaluated: of a drift the last one.
    """

    visit: Integer
    cycle: Integer
    phase: Integer
    lifetime: Integer
    spec_digest: str


class StreamReport(ReportFile):
    """An agent in a stream: what it retains after each visit, and what its life cost.

    Attributes:
      schema_version: version of the report's format.
      policy: the agent's name.
      action_range: of its actions, "unit" or "symmetric".
      stream: the stream.
      stream_digest: its digest.
      name: what the stream's file calls it; empty, and left out of the JSON, without a name.
      protocol: the states.
      protocol_digest: its digest.
      visits: in order.
      regions: WD, then OOD 1, 2, …
      ood: the mean of the matrices over the shells.
      dynamic_regret: of training; of a life in which nobody learns, as `sme evaluate` has it, that
        which is expected; None without either.
      reference_regret: the dynamic regret of reference agents, by their names in `LABELS`; left out
        of the JSON where there is none.
      versions: of Python and the packages that the numbers depend on.
    """

    documents = ("stream", "protocol")
    left_out_if_empty = ("name", "reference_regret")

    schema_version: Literal[1] = 1
    policy: str
    action_range: ActionRange
    stream: StreamSpec
    stream_digest: str
    name: str = ""
    protocol: EvaluationProtocol
    protocol_digest: str
    visits: TupleOf[Visit]
    regions: Annotated[TupleOf[StreamRegion], Field(min_length=1)]
    ood: StreamRegion
    dynamic_regret: DynamicRegret | None = None
    reference_regret: dict[str, DynamicRegret] = Field(default_factory=dict)
    versions: dict[str, str]

    @property
    def title(self) -> str:
        """The stream's name for people; see `catalogue.title`."""
        return catalogue.title(self.stream.named(self.name))

    def region(self, name: str = "WD") -> StreamRegion:
        """A region by its name; `OOD` is the mean over the shells."""
        known = {region.name: region for region in (*self.regions, self.ood)}
        if name not in known:
            hint = did_you_mean(name, known)
            raise UnknownNameError(f"region={name!r:.40}: must be one of {', '.join(known)}.{hint}")
        return known[name]

    def with_dynamic_regret(self, regret: DynamicRegret) -> Self:
        return self.model_copy(update={"dynamic_regret": regret})

    def with_reference_regret(self, references: Mapping[str, DynamicRegret]) -> Self:
        """This report with the dynamic regret of these reference agents; see `reference_regret`."""
        return self.model_copy(update={"reference_regret": {**self.reference_regret, **references}})

    def with_fresh(
        self,
        fresh: Sequence[EvaluationReport | StreamReport],
        online_regret: Sequence[float] | None = None,
    ) -> Self:
        """This report with the plasticity, which fresh agents are needed for.

        `fresh` has for each phase the report of an agent trained for as many steps on that phase
        alone: on its task, or, where the phase drifts, on the stream of that phase.
        `online_regret`, the mean regret over the training of each of them, adds the learning
        transfer of the visits.
        """
        tasks = [visit.spec_digest for visit in self.visits[: len(self.stream.phases)]]
        alone = _fresh_regrets(fresh, tasks, self.protocol_digest)
        of_each = [*self.regions, self.ood]
        regions = [
            region.model_copy(update={"agent": region.agent.with_fresh(alone[:, k])})
            for k, region in enumerate(of_each)
        ]
        own, others = self.dynamic_regret, dict(self.reference_regret)
        if online_regret is not None:
            if own is None:
                raise OptionError(
                    "online_regret: this report has no dynamic regret to compare with it. Add that "
                    "before: report.with_dynamic_regret(…)."
                )
            own = own.with_fresh(self.stream, online_regret)
            life = [*online_regret] * self.stream.cycles
            others["fresh_agents"] = expected_regret(life, self.stream)
        return self.model_copy(
            update={
                "regions": tuple(regions[:-1]),
                "ood": regions[-1],
                "dynamic_regret": own,
                "reference_regret": others,
            }
        )

    def __repr__(self) -> str:
        final = self.regions[0].agent.average_performance[-1]
        return (
            f"<StreamReport: {self.policy} on {self.title}, {len(self.visits)} visits, "
            f"average performance {final:.3f}>"
        )

    def table(self) -> Table:
        """The metrics at the end of the life: a column for each region."""
        return tables.of_metrics(self)

    def matrix(self, region: str = "WD") -> Table:
        """The retention matrix of a region: a row for each visit, a column for each phase."""
        return tables.of_matrix(self, region)

    def regret(self) -> Table:
        """The online regret of each visit, beside that of the reference agents."""
        return tables.of_regret(self)

    def tables(self) -> list[Table]:
        """`table`, `matrix`, and `regret` where a dynamic regret is known."""
        known = self.dynamic_regret or self.reference_regret
        return [self.table(), self.matrix(), *([self.regret()] if known else [])]


def _fresh_regrets(
    fresh: Sequence[EvaluationReport | StreamReport], tasks: Sequence[str], protocol_digest: str
) -> Array:
    """`[P, K + 1]` regret of fresh agents on their phases, with the mean over the shells."""
    if not _are_reports(fresh) or len(fresh) != len(tasks):
        given = f"{len(fresh)} reports" if _are_reports(fresh) else f"{fresh!r:.60}"
        raise OptionError(f"fresh={given}: must be {len(tasks)} reports, one for each phase.")
    rows = []
    for phase, (report, task) in enumerate(zip(fresh, tasks, strict=True)):
        if isinstance(report, StreamReport):
            own = [visit.spec_digest for visit in report.visits]
            row = [region.agent.normalised_regret[0][0] for region in report.regions]
        else:
            own, row = [report.spec_digest], [each.normalised_regret for each in report.regions]
        if own != [task] or report.protocol_digest != protocol_digest:
            raise OptionError(
                f"fresh[{phase}]: is about {report.title} and the protocol "
                f"{report.protocol_digest[:19]}…: must be about the task of phase {phase}, "
                f"{task[:19]}…, and the protocol {protocol_digest[:19]}…. Evaluate an agent that "
                "was trained on that phase alone."
            )
        rows.append(row)
    return _and_shells(np.array(rows))


def _are_reports(fresh: Any) -> bool:
    kinds = EvaluationReport | StreamReport
    return isinstance(fresh, Sequence) and all(isinstance(each, kinds) for each in fresh)


def stream_regions(
    protocol: EvaluationProtocol,
    agent: Array,
    initial: Array,
    fresh: Array,
    references: Mapping[str, Array],
) -> tuple[tuple[StreamRegion, ...], StreamRegion]:
    """The regions of a report, and the mean over the shells.

    `agent` is `[V, P, K]` normalised regret, as are `references`; `initial` and `fresh` are
    `[P, K]`, NaN where there is no such policy.
    """
    edges, states = protocol.edges, protocol.states_per_region
    names = [(region_name(k), *edge, states) for k, edge in enumerate(edges)]
    names.append((SHELLS, edges[1][0], edges[-1][1], states * (len(edges) - 1)))
    of_agent = _retentions(agent, initial, fresh)
    unknown = np.full_like(initial, np.nan)
    of_references = {name: _retentions(M, unknown, unknown) for name, M in references.items()}
    regions = [
        StreamRegion(
            name=name,
            epsilon_low=low,
            epsilon_high=high,
            states=count,
            agent=of_agent[k],
            references={name: retentions[k] for name, retentions in of_references.items()},
        )
        for k, (name, low, high, count) in enumerate(names)
    ]
    return tuple(regions[:-1]), regions[-1]


def _retentions(M: Array, initial: Array, fresh: Array) -> list[Retention]:
    """The matrix and the metrics in each region, then of the mean over the shells."""
    M, before, alone = map(_and_shells, (M, initial, fresh))
    R = 1.0 - M
    ratio, difference = retention.plasticity(M, alone)
    computed = {
        "average_performance": retention.average_performance(R),
        "backward_transfer": retention.backward_transfer(R),
        "forgetting": retention.forgetting(R),
        "forward_transfer": retention.forward_transfer(R, 1.0 - before),
        "relearning": retention.relearning(R),
        "plasticity_ratio": ratio,
        "plasticity_difference": difference,
    }
    return [
        Retention(
            normalised_regret=tuple(map(tuple, M[..., k].tolist())),
            initial_normalised_regret=_complete(before[:, k]),
            fresh_normalised_regret=_complete(alone[:, k]),
            **{name: _known(values[..., k]) for name, values in computed.items()},
        )
        for k in range(M.shape[-1])
    ]


def _complete(row: Array) -> tuple[float, ...] | None:
    """A row of known numbers; None for one of NaN."""
    return None if np.isnan(row).any() else tuple(row.tolist())


def _and_shells(values: Array) -> Array:
    """Values `[…, K]` and their mean over the shells: `[…, K + 1]`."""
    return np.concatenate([values, values[..., 1:].mean(axis=-1, keepdims=True)], axis=-1)


def _known(values: Array) -> Any:
    """Numbers as JSON has them: None for NaN."""
    if values.ndim == 0:
        return None if math.isnan(values) else float(values)
    return tuple(None if math.isnan(value) else value for value in values.tolist())


def across_seeds(
    reports: Sequence[StreamReport],
    region: str = "WD",
    *,
    draws: int = DRAWS,
    statistic: Statistic = iqm,
) -> dict[str, Estimate]:
    """The IQM over runs of every number of a region, with 95 % intervals.

    From each name of `Retention` to values and intervals: `[V·P]` of the matrix, row by row, `[V]`
    of a metric by visit, `[1]` of any other; NaN where a run has no value, and in the ends of
    intervals of a single run. `dynamic_regret` `[1]` and `visit_dynamic_regret` `[V]` where every
    report has them, and `learning_transfer` and `visit_learning_transfer` likewise.

    Args:
      reports: of one agent on one stream or its draws, one for each seed of its training.
      region: `WD`, `OOD 1`, …, or `OOD` for the mean over the shells.

    Examples:
      >>> from sme_registry.evaluation import across_seeds, evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> runs = ("linear", "constant")
      >>> lives = [evaluate_stream([policy] * 2, stream, "quick-v1") for policy in runs]
      >>> across_seeds(lives)["average_performance"].value.shape
      (2,)
    """
    same_stream(reports)
    runs = {
        field: np.stack([_numbers(getattr(r.region(region).agent, field)) for r in reports])
        for field in ("normalised_regret", *METRICS)
    }
    regrets = [report.dynamic_regret for report in reports]
    logs = [regret for regret in regrets if regret is not None]
    if len(logs) == len(reports):
        runs |= _of_logs(logs, "dynamic_regret")
        if all(log.fresh_online_regret for log in logs):
            runs |= _of_logs(logs, "learning_transfer")
    digest = reports[0].stream_digest
    return {name: _estimate(values, digest, draws, statistic) for name, values in runs.items()}


def _of_logs(logs: Sequence[DynamicRegret], field: str) -> dict[str, Array]:
    """A number of lives, `[n, 1]`, and of their visits, `[n, V]`, where these are as many."""
    found = {field: np.stack([_numbers(getattr(log, field)) for log in logs])}
    by_visit = [[getattr(visit, field) for visit in log.visits] for log in logs]
    if len({len(visits) for visits in by_visit}) == 1:
        found[f"visit_{field}"] = np.stack([_numbers(visits) for visits in by_visit])
    return found


def same_stream(reports: Sequence[StreamReport]) -> None:
    if not reports:
        raise OptionError("reports: must be one or more stream reports. Give one for each seed.")
    streams = {report.stream_digest: report.stream for report in reports}
    found = {
        "stream_digest": {stream.family.digest for stream in streams.values()},
        "protocol_digest": {report.protocol_digest for report in reports},
    }
    for field, values in found.items():
        if len(values) > 1:
            raise OptionError(
                f"reports: have {len(values)} different values of {field}. Runs of one stream or "
                "of its draws, evaluated with one protocol, can be compared. Remove the others."
            )


def _estimate(values: Array, seed: str, draws: int, statistic: Statistic) -> Estimate:
    classes = {"": values}
    return Estimate(
        aggregate(classes, statistic), *stratified_bootstrap(classes, draws, seed, statistic)
    )


def _numbers(value: Any) -> Array:
    """A number, a row or a matrix as `[K]`; None is NaN."""
    return np.atleast_1d(np.array(value, dtype=np.float64)).ravel()

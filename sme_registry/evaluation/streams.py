"""`evaluate_stream`: the policies of a life, a stream and a protocol to a `StreamReport`.

Fresh agents and reference agents are sequences of policies like any other: one policy for each
visit. The references of `retention.LABELS` are exact and in every report.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field
from rich.markup import escape

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation.dynamic_regret import DynamicRegret, expected_regret
from sme_registry.evaluation.evaluate import OnBatch, resolve_protocol, versions_behind
from sme_registry.evaluation.policies import check_count, stream_policy
from sme_registry.evaluation.report import EvaluationReport, RegionTable, ReportFile
from sme_registry.evaluation.retention import (
    LABELS,
    METRICS,
    Actor,
    StreamRegion,
    final_specs,
    stream_regions,
    stream_regrets,
    with_shells,
)
from sme_registry.io import choice
from sme_registry.io.markup import Table
from sme_registry.spec import EvaluationProtocol, StreamSpec, catalogue
from sme_registry.spec.document import Integer, StrictModel, TupleOf
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.spec.stream import StreamLike
from sme_registry.spec.suite import ProtocolLike
from sme_registry.statistics import (
    DRAWS,
    Array,
    Estimate,
    iqm,
    stratified_bootstrap,
)
from sme_registry.task import load


class Visit(StrictModel):
    """An occurrence of a phase in the life."""

    visit: Integer  # its index
    cycle: Integer  # the index of its cycle
    phase: Integer  # the index of its phase
    lifetime: Integer  # environment steps at its end
    spec_digest: str  # of the task on which the phase is evaluated: of a drift the last one


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
    fields_added_later = ("name", "reference_regret")

    schema_version: Literal[2] = 2
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
    reference_regret: dict[str, DynamicRegret] = Field(default={})
    versions: dict[str, str]

    @property
    def title(self) -> str:
        """The stream's name for people; see `catalogue.title`."""
        return catalogue.title(self.stream.named(self.name))

    def region(self, name: str = "WD") -> StreamRegion:
        """A region by its name; `OOD` is the mean over the shells."""
        known = {region.name: region for region in (*self.regions, self.ood)}
        return known[choice("region", name, known, error=UnknownNameError)]

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
        """This report with the plasticity against fresh agents, from their reports.

        Each is of an agent trained for as many steps on one phase alone: on its task, or, where it
        drifts, on the stream of that phase. `online_regret`, the mean regret over the training of
        each of them, adds the learning transfer of the visits.
        """
        report = self._with_plasticity(self._fresh_regrets(fresh))
        if online_regret is None:
            return report
        if self.dynamic_regret is None:
            raise OptionError(
                "online_regret: this report has no dynamic regret to compare with it. Add that "
                "before: report.with_dynamic_regret(…)."
            )
        regret = self.dynamic_regret.with_fresh(self.stream, online_regret)
        life = expected_regret([*online_regret] * self.stream.cycles, self.stream)
        return report.with_dynamic_regret(regret).with_reference_regret({"fresh_agents": life})

    def _with_plasticity(self, fresh: Array) -> Self:
        """This report with the plasticity against fresh agents of regret `[P, K]`."""
        *regions, ood = (
            region.model_copy(update={"agent": region.agent.with_fresh(alone)})
            for region, alone in zip((*self.regions, self.ood), with_shells(fresh).T, strict=True)
        )
        return self.model_copy(update={"regions": tuple(regions), "ood": ood})

    def _fresh_regrets(self, fresh: Sequence[EvaluationReport | StreamReport]) -> Array:
        """`[P, K]` regret of fresh agents on their phases."""
        tasks = [visit.spec_digest for visit in self.visits[: len(self.stream.phases)]]
        kinds = EvaluationReport | StreamReport
        are_reports = isinstance(fresh, Sequence) and all(isinstance(one, kinds) for one in fresh)
        if not are_reports or len(fresh) != len(tasks):
            given = f"{len(fresh)} reports" if are_reports else f"{fresh!r:.60}"
            raise OptionError(f"fresh={given}: must be {len(tasks)} reports, one for each phase.")
        rows = []
        for phase, (report, task) in enumerate(zip(fresh, tasks, strict=True)):
            if isinstance(report, StreamReport):
                digests = [visit.spec_digest for visit in report.visits]
                row = [region.agent.normalised_regret[0][0] for region in report.regions]
            else:
                digests = [report.spec_digest]
                row = [region.normalised_regret for region in report.regions]
            if digests != [task] or report.protocol_digest != self.protocol_digest:
                raise OptionError(
                    f"fresh[{phase}]: is about {report.title} and the protocol "
                    f"{report.protocol_digest[:19]}…: must be about the task of phase {phase}, "
                    f"{task[:19]}…, and the protocol {self.protocol_digest[:19]}…. Evaluate an "
                    "agent that was trained on that phase alone."
                )
            rows.append(row)
        return np.array(rows)

    def __repr__(self) -> str:
        final = self.regions[0].agent.average_performance[-1]
        return (
            f"<StreamReport: {self.policy} on {self.title}, {len(self.visits)} visits, "
            f"average performance {final:.3f}>"
        )

    def table(self, *, details: bool = True) -> Table:
        """The metrics at the end of the life: a column for each region."""
        stream, regions, regret = self.stream, self.regions, self.dynamic_regret
        cost = ""
        if regret is not None:
            cost = f"; dynamic regret {regret.dynamic_regret:,.1f} over {regret.steps:,} steps"
        table = RegionTable(
            f"{escape(self.policy)} on {escape(self.title)} (S={stream.state_dim}, "
            f"A={stream.action_dim}, {len(stream.phases)} phases, {len(self.visits)} visits)\n"
            f"{self.stream_digest}\n{regions[0].states:,} states per region{cost}",
            regions,
            "Performance is 1 − normalised regret: 1 optimal, 0 the constant ½.",
        )
        agents = [(escape(self.policy), [region.agent for region in regions])]
        for name in regions[0].references:
            lives = [region.references[name] for region in regions]
            agents.append((escape(LABELS.get(name, name)), lives))
        for metric, label in list(METRICS.items())[: None if details else _SHOWN_METRICS]:
            rows = [(name, [life.final(metric) for life in lives]) for name, lives in agents]
            table.add_group(label, rows)
        return table

    def matrix(self, region: str = "WD") -> Table:
        """The retention matrix of a region: a row for each visit, a column for each phase."""
        agent, P = self.region(region).agent, len(self.stream.phases)
        table = Table(
            f"Normalised regret in {region} on the task of each phase",
            {"policy at the end of": "name"} | {f"phase {j}": "number" for j in range(P)},
        )
        if agent.initial_normalised_regret:
            table.add_row("initial policy", *_cells(agent.initial_normalised_regret))
        for label, row in zip(self._visit_labels, agent.normalised_regret, strict=True):
            table.add_row(label, *_cells(row))
        if agent.fresh_normalised_regret:
            table.add_row("fresh agent of the phase", *_cells(agent.fresh_normalised_regret))
        return table

    def regret(self) -> Table:
        """The online regret of each visit, beside that of the reference agents."""
        lives = {LABELS.get(name, name): life for name, life in self.reference_regret.items()}
        training = self.dynamic_regret
        if training is not None:
            lives = {self.policy: training, **lives}
        columns: dict[str, tuple[list[float | None], float | None]] = {
            name: ([visit.online_regret for visit in life.visits], life.online_regret)
            for name, life in lives.items()
        }
        if training is not None and training.fresh_online_regret is not None:
            transfers = [visit.learning_transfer for visit in training.visits]
            columns["learning transfer"] = transfers, training.learning_transfer
        table = Table(
            "Online regret: mean of 1 − step reward over the steps of each visit",
            {"": "name"} | dict.fromkeys(columns, "number"),
        )
        for v, label in enumerate(self._visit_labels):
            row = (by_visit[v] if v < len(by_visit) else None for by_visit, _ in columns.values())
            table.add_row(label, *_cells(row))
        table.add_section()
        table.add_row("whole life", *_cells(end for _, end in columns.values()), style="bold")
        # Of training they can differ from the stream's: whole rollouts, or an unfinished episode.
        table.add_row("steps", *(f"{life.steps:,}" for life in lives.values()))
        sums = [f"{life.dynamic_regret:,.1f}" for life in lives.values()]
        table.add_row("dynamic regret (sum)", *sums)
        return table

    def tables(self, *, details: bool = False) -> list[Table]:
        """`table`, `matrix`, and `regret` where a dynamic regret is known."""
        known = self.dynamic_regret or self.reference_regret
        table = self.table(details=details)
        return [table, self.matrix(), *([self.regret()] if known else [])]

    @property
    def _visit_labels(self) -> list[str]:
        return [f"visit {visit.visit}: phase {visit.phase}" for visit in self.visits]


_SHOWN_METRICS = 4  # by default


def _cells(row: Iterable[float | None]) -> list[str]:
    return ["" if value is None else f"{value:.3f}" for value in row]


def evaluate_stream(
    policies: Sequence[Any],
    stream: StreamLike,
    protocol: ProtocolLike = "paper-v1",
    *,
    initial: Any = None,
    fresh: Sequence[Any] | None = None,
    action_range: str | None = None,
    name: str | None = None,
    algorithm: str | None = None,
    progress: OnBatch | None = None,
) -> StreamReport:
    """Evaluate an agent's life in a stream, exactly and without a rollout.

    `policies` are the agent's at the end of each visit, in any form that `evaluate` accepts.
    `initial`, the policy before the first visit, is for the forward transfer; `fresh`, for each
    phase that of an agent trained for as many steps on it alone, for the plasticity. The report has
    the reference agents on the same states.

    Examples:
      >>> from sme_registry.evaluation import evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> report = evaluate_stream(["linear", "optimal"], stream, "quick-v1")  # after each visit
      >>> len(report.visits)
      2
    """
    stream = load(stream, StreamSpec)
    stream.check_visits()
    protocol = resolve_protocol(protocol)
    P, V = len(stream.phases), stream.visits
    check_count("policies", policies, V, f"at the end of each visit ({stream.cycles} × {P})")
    if fresh is not None:
        check_count("fresh", fresh, P, "for each phase")

    actors: list[Actor] = []

    def add(policy: Any, where: str, phase: int | None = None) -> int:
        alone = phase is not None
        ready = stream_policy(policy, stream, where, action_range, algorithm, alone=alone)
        phases = range(P) if phase is None else [phase]
        actors.append(Actor(ready, phases, where, 0 if alone else stream.observed_phases))
        return len(actors) - 1

    rows: dict[int, int] = {}  # a policy of several visits acts once
    for v, policy in enumerate(policies):
        if id(policy) not in rows:
            rows[id(policy)] = add(policy, f"policies[{v}]")
    life = [rows[id(policy)] for policy in policies]
    before = None if initial is None else add(initial, "initial")
    alone = [add(policy, f"fresh[{j}]", j) for j, policy in enumerate(fresh or ())]

    regrets, optima = stream_regrets(stream, actors, protocol, progress)
    *regions, ood = stream_regions(
        protocol,
        regrets[life],
        None if before is None else regrets[before],
        {
            "frozen_optimum": np.repeat(optima[:1], V, axis=0),
            "fresh_optimum": optima[np.arange(V) % P],
            "constant": np.ones((V, *optima.shape[1:])),
        },
    )
    names, last = {actors[row].policy.name for row in life}, actors[life[-1]].policy
    digests = [spec.digest for spec in final_specs(stream)]
    report = StreamReport(
        policy=name or (last.name if len(names) == 1 else f"{V} policies"),
        action_range=last.action_range,
        stream=stream,
        stream_digest=stream.digest,
        name=stream.name,
        protocol=protocol,
        protocol_digest=protocol.digest,
        visits=tuple(
            Visit(visit=v, cycle=v // P, phase=v % P, lifetime=end, spec_digest=digests[v % P])
            for v, end in stream.visit_ends()
        ),
        regions=tuple(regions),
        ood=ood,
        versions=versions_behind(),
    )
    return report._with_plasticity(regrets[alone, range(P)]) if alone else report


def across_seeds(reports: Sequence[StreamReport], region: str = "WD") -> dict[str, Estimate]:
    """The IQM over runs of every number of a region, with 95 % intervals.

    `reports` are of one agent on one stream or its draws, one for each seed of its training. From
    each name of `Retention` to values and intervals: `[V·P]` of the matrix, row by row, `[V]` of a
    metric by visit, `[1]` of any other; NaN where a run has no value, and in the ends of intervals
    of a single run. `dynamic_regret` `[1]` and `visit_dynamic_regret` `[V]` where every report has
    them, and `learning_transfer` and `visit_learning_transfer` likewise.

    Examples:
      >>> from sme_registry.evaluation import across_seeds, evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> runs = ("linear", "constant")
      >>> lives = [evaluate_stream([policy] * 2, stream, "quick-v1") for policy in runs]
      >>> across_seeds(lives)["average_performance"].value.shape
      (2,)
    """
    check_same_stream(reports)
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
    return {name: _estimate(values, reports[0].stream_digest) for name, values in runs.items()}


def _of_logs(logs: Sequence[DynamicRegret], field: str) -> dict[str, Array]:
    """A number of lives, `[n, 1]`, and of their visits, `[n, V]`, where these are as many."""
    runs = {field: np.stack([_numbers(getattr(log, field)) for log in logs])}
    by_visit = [[getattr(visit, field) for visit in log.visits] for log in logs]
    if len({len(visits) for visits in by_visit}) == 1:
        runs[f"visit_{field}"] = np.stack([_numbers(visits) for visits in by_visit])
    return runs


def check_same_stream(reports: Sequence[StreamReport]) -> None:
    if not reports:
        raise OptionError("reports: must be one or more stream reports. Give one for each seed.")
    streams = {report.stream_digest: report.stream for report in reports}
    digests = {
        "stream_digest": {stream.family.digest for stream in streams.values()},
        "protocol_digest": {report.protocol_digest for report in reports},
    }
    for field, values in digests.items():
        if len(values) > 1:
            raise OptionError(
                f"reports: have {len(values)} different values of {field}. Runs of one stream or "
                "of its draws, evaluated with one protocol, can be compared. Remove the others."
            )


def _estimate(runs: Array, seed: str) -> Estimate:
    return Estimate(iqm(runs), *stratified_bootstrap({"": runs}, DRAWS, seed))


def _numbers(value: Any) -> Array:
    """A number, a row or a matrix as `[K]`; None is NaN."""
    return np.atleast_1d(np.array(value, dtype=np.float64)).ravel()

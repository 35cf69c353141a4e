"""The tables of a `StreamReport`: its metrics, its matrix, and the regret of its visits."""

from __future__ import annotations

from collections.abc import Iterable

from rich.markup import escape

from sme_registry.evaluation.continual.report import LABELS, METRICS, StreamReport
from sme_registry.io.tables import Table


def of_metrics(report: StreamReport) -> Table:
    """The metrics at the end of the life: a column for each region."""
    stream, regions, regret = report.stream, report.regions, report.dynamic_regret
    cost = (
        f"; dynamic regret {regret.dynamic_regret:,.1f} over {regret.steps:,} steps"
        if regret
        else ""
    )
    table = Table(
        f"{escape(report.policy)} on {escape(report.title)} (S={stream.state_dim}, "
        f"A={stream.action_dim}, {len(stream.phases)} phases, {len(report.visits)} visits)\n"
        f"{report.stream_digest}\n{regions[0].states:,} states per region{cost}",
        {"": "name"}
        | {f"{region.name}\nε ≤ {region.epsilon_high:g}": "number" for region in regions},
        caption="Performance is 1 − normalised regret: 1 optimal, 0 the constant ½.",
    )
    shown = {report.policy: [region.agent for region in regions]}
    for name in regions[0].references:
        shown[LABELS.get(name, name)] = [region.references[name] for region in regions]
    for metric, label in METRICS.items():
        rows = {
            name: [retention.final(metric) for retention in each] for name, each in shown.items()
        }
        rows = {name: values for name, values in rows.items() if None not in values}
        if not rows:
            continue
        table.add_row(label, style="italic")
        for name, values in rows.items():
            style = "bold" if name == report.policy else None
            table.add_row(f"  {escape(name)}", *_cells(values), style=style)
        table.add_section()
    return table


def of_matrix(report: StreamReport, region: str) -> Table:
    """The retention matrix of a region: a row for each visit, a column for each phase."""
    agent, P = report.region(region).agent, len(report.stream.phases)
    table = Table(
        f"Normalised regret in {region} on the task of each phase",
        {"policy at the end of": "name"} | {f"phase {j}": "number" for j in range(P)},
    )
    if agent.initial_normalised_regret:
        table.add_row("initial policy", *_cells(agent.initial_normalised_regret))
    for label, row in zip(_visits(report), agent.normalised_regret, strict=True):
        table.add_row(label, *_cells(row))
    if agent.fresh_normalised_regret:
        table.add_row("fresh agent of the phase", *_cells(agent.fresh_normalised_regret))
    return table


def of_regret(report: StreamReport) -> Table:
    """The online regret of each visit: a column for each agent, and the learning transfer."""
    lives = {LABELS.get(name, name): life for name, life in report.reference_regret.items()}
    own = report.dynamic_regret
    if own is not None:
        lives = {report.policy: own, **lives}
    columns = [[visit.online_regret for visit in life.visits] for life in lives.values()]
    ends: list[float | None] = [life.online_regret for life in lives.values()]
    headings = [*lives]
    if own is not None and own.fresh_online_regret is not None:
        columns.append([visit.learning_transfer for visit in own.visits])
        ends.append(own.learning_transfer)
        headings.append("learning transfer")
    table = Table(
        "Online regret: mean of 1 − step reward over the steps of each visit",
        {"": "name"} | {escape(heading): "number" for heading in headings},
    )
    for v, label in enumerate(_visits(report)):
        table.add_row(label, *_cells(each[v] if v < len(each) else None for each in columns))
    table.add_section()
    table.add_row("whole life", *_cells(ends), style="bold")
    # Of training they can differ from the stream's: whole rollouts, or an unfinished episode.
    table.add_row("steps", *(f"{life.steps:,}" for life in lives.values()))
    sums = [f"{life.dynamic_regret:,.1f}" for life in lives.values()]
    table.add_row("dynamic regret (sum)", *sums)
    return table


def _visits(report: StreamReport) -> list[str]:
    return [f"visit {visit.visit}: phase {visit.phase}" for visit in report.visits]


def _cells(row: Iterable[float | None]) -> list[str]:
    return ["" if value is None else f"{value:.3f}" for value in row]

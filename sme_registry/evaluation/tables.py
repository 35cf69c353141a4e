"""Reports as tables and as a curve, for people: of an evaluation and of a life in a stream."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.retention import LABELS as STREAM_LABELS
from sme_registry.evaluation.retention import METRICS
from sme_registry.io.markup import Line, line_chart
from sme_registry.io.tables import Table

if TYPE_CHECKING:
    from sme_registry.evaluation.report import (
        EvaluationReport,
        ObservationReport,
        RegionReport,
        SafetyReport,
    )
    from sme_registry.evaluation.stream_report import StreamReport

_ERRORS = {"similarity": "similarity r̃", "normalised_regret": "normalised regret"}

NOT_COMPARABLE = (
    "Levels ε are not comparable between different state_dim: with more channels, the states of "
    "a shell lie nearer to its outer face."
)

SAFETY_REFERENCES = ("optimal", "safe_optimal", "shrunk_optimal", "constant_half")
"""The references whose safety is shown; the report has it of all."""

SAFETY_LABELS = {
    "step_reward": "step reward r",
    "cost": "cost",
    "violating_share": "violating share",
    "safe_regret": "safe regret",
}


def of_report(report: EvaluationReport) -> list[Table]:
    tables = [of_regions(report)]
    if report.safety is not None:
        tables.append(of_safety(report, report.safety))
    if report.observed.invariance:
        tables.append(of_distractors(report, report.observed))
    if report.observed.probes:
        tables.append(of_probes(report, report.observed))
    return tables


def of_regions(report: EvaluationReport) -> Table:
    """Similarity and normalised regret: a column for each region, a row for each policy."""
    spec = report.spec
    team = f", {len(report.agents)} agents" if report.agents else ""
    table = _by_region(
        f"{_title(report)} (S={spec.state_dim}, A={spec.action_dim}, L={spec.complexity}{team})\n"
        f"{spec.digest}\n{report.regions[0].states:,} states per region; "
        f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}, "
        f"OOD decay {report.ood_decay:.3f}",
        report,
        NOT_COMPARABLE,
    )
    policies = [(escape(report.policy), report.regions)]
    policies += [(LABELS.get(name, escape(name)), of) for name, of in report.references.items()]
    for field, heading in _ERRORS.items():
        _add_group(table, heading, policies, field)
    _add(table, "SD of r̃ over states", report.regions, "similarity_sd", style="bold")
    _add(table, "similarity decay", report.regions, "similarity_decay", ".1%", style="bold")
    _add(table, "similarity loss, pts", report.regions, "similarity_loss", ".1f", style="bold")
    _add(table, "actions clipped", report.regions, "clipped_share", ".1%", style="bold")
    for name, agent in report.agents.items():
        table.add_section()
        _add(table, f"{escape(name)}  r̃", agent.regions, "similarity")
        _add(table, "  normalised regret", agent.regions, "normalised_regret")
        if linear := agent.references.get("linear_least_squares"):
            label = f"  of {LABELS['linear_least_squares']}"
            _add(table, label, linear, "normalised_regret")
    return table


def of_safety(report: EvaluationReport, safety: SafetyReport) -> Table:
    """Reward, cost, violations and safe regret: a column for each region."""
    assert report.spec.safety is not None
    table = _by_region(
        f"{_title(report)}: safety, limits of tightness τ = {report.spec.safety.tightness:g}",
        report,
        "A state is violating if any action channel is above its limit by more than 1e-6. "
        "Negative safe regret is earned by violating: read it beside the cost.",
    )
    policies = [(escape(report.policy), safety.regions)]
    policies += [(LABELS[name], safety.references[name]) for name in SAFETY_REFERENCES]
    for field, heading in SAFETY_LABELS.items():
        pattern = ".1%" if field == "violating_share" else ".3f"
        _add_group(table, heading, policies, field, pattern)
    _add(table, "price of safety", safety.regions, "price_of_safety")
    return table


def of_distractors(report: EvaluationReport, observation: ObservationReport) -> Table:
    """Both kinds of OOD, and invariance: a column for each region."""
    table = _by_region(
        f"{_title(report)}: {report.spec.distractors} distractors",
        report,
        "Levels ε of states and of distractors are comparable only where there are as many of the "
        "one as of the other. Invariance is 0 for a policy that ignores the distractors.",
    )
    outside = (report.regions[0], *observation.distractor_regions)
    kinds = [("states in the region", report.regions), ("distractors in it", outside)]
    for field, heading in _ERRORS.items():
        _add_group(table, heading, kinds, field, bold=False)
    _add(table, "invariance", observation.invariance, "invariance")
    return table


def of_probes(report: EvaluationReport, observation: ObservationReport) -> Table:
    """R² of the linear probes: a row for each layer."""
    columns = {"layer": "name", "units": "number", "R² of the state": "number"}
    if report.spec.distractors:
        columns["R² of the distractors"] = "number"
    table = Table(
        f"{_title(report)}: what a linear map recovers from each layer",
        columns,
        caption="Held-out R², the mean over channels. Layer 0 is what the agent sees.",
    )
    for probe in observation.probes:
        r2 = (probe.state_r2, *([] if probe.distractor_r2 is None else [probe.distractor_r2]))
        table.add_row(str(probe.layer), str(probe.units), *(f"{value:.3f}" for value in r2))
    return table


def _title(report: EvaluationReport) -> str:
    return f"{escape(report.policy)} on {escape(report.title)}"


def _by_region(title: str, report: EvaluationReport, caption: str) -> Table:
    columns = {f"{region.name}\nε ≤ {region.epsilon_high:g}": "number" for region in report.regions}
    return Table(title, {"": "name"} | columns, caption=caption)


def _add_group(
    table: Table,
    heading: str,
    rows: Sequence[tuple[str, Iterable[Any]]],
    field: str,
    pattern: str = ".3f",
    *,
    bold: bool = True,
) -> None:
    """A section of rows of one field; the first one is bold."""
    table.add_row(heading, style="italic")
    for index, (label, regions) in enumerate(rows):
        style = "bold" if bold and not index else None
        _add(table, f"  {label}", regions, field, pattern, style=style)
    table.add_section()


def _add(
    table: Table,
    label: str,
    regions: Iterable[Any],
    field: str,
    pattern: str = ".3f",
    *,
    style: str | None = None,
) -> None:
    numbers = (format(getattr(region, field), pattern) for region in regions)
    table.add_row(label, *numbers, style=style)


_DRAWN = ("constant_half", "linear_least_squares", "optimal")  # the table has them all
_MOST_AGENTS = 20  # drawn: a card stays small
_NAME = 10  # letters for which there is space beside ", worst"


def regret_chart(report: EvaluationReport) -> str:
    """The policy, the worst agents of a team, with the name of the worst in WD, and references."""
    drawn = [name for name in _DRAWN if name in report.references]
    lines = [Line(LABELS[name], _regret(report.references[name]), "reference") for name in drawn]
    agents = {name: _regret(agent.regions) for name, agent in report.agents.items()}
    worst = sorted(agents, key=lambda name: -agents[name][0])[:_MOST_AGENTS]
    lines += [
        Line(f"{_brief(name)}, worst" if name == worst[0] else "", agents[name], "other")
        for name in worst
    ]
    lines.append(Line("team" if agents else "policy", _regret(report.regions)))
    return line_chart(
        f"Normalised regret of {report.policy}",
        [region.name for region in report.regions],
        lines,
        "normalised regret in each region",
    )


def _regret(regions: Sequence[RegionReport]) -> list[float]:
    return [region.normalised_regret for region in regions]


def _brief(name: str) -> str:
    return name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"


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
        shown[STREAM_LABELS.get(name, name)] = [region.references[name] for region in regions]
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
    lives = {STREAM_LABELS.get(name, name): life for name, life in report.reference_regret.items()}
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
        table.add_row(label, *_cells(column[v] if v < len(column) else None for column in columns))
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

"""The tables of an `EvaluationReport`: its regions, its safety, its distractors and its probes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.markup import escape

from sme_registry.evaluation.observation import ObservationReport
from sme_registry.evaluation.report import LABELS, NOT_COMPARABLE, EvaluationReport
from sme_registry.evaluation.safety import SafetyReport
from sme_registry.io.tables import Table

SAFETY_REFERENCES = ("optimal", "safe_optimal", "shrunk_optimal", "constant_half")
"""The references whose safety is shown; the report has it of all."""

SAFETY_LABELS = {
    "step_reward": "step reward r",
    "cost": "cost",
    "violating_share": "violating share",
    "safe_regret": "safe regret",
}


def of_report(report: EvaluationReport) -> list[Table]:
    """Every table that the report has numbers for."""
    tables = [of_regions(report)]
    if report.safety is not None:
        tables.append(of_safety(report, report.safety))
    if report.observation is not None and report.observation.invariance:
        tables.append(of_distractors(report, report.observation))
    if report.observation is not None and report.observation.probes:
        tables.append(of_probes(report, report.observation))
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
    for heading, field in (
        ("similarity r̃", "similarity"),
        ("normalised regret", "normalised_regret"),
    ):
        table.add_row(heading, style="italic")
        _add(table, f"  {escape(report.policy)}", report.regions, field, style="bold")
        for name, regions in report.references.items():
            _add(table, f"  {LABELS.get(name, escape(name))}", regions, field)
        table.add_section()
    _add(table, "SD of r̃ over states", report.regions, "similarity_sd", style="bold")
    _add(table, "similarity decay", report.regions, "similarity_decay", ".1%", style="bold")
    _add(table, "similarity loss, pts", report.regions, "similarity_loss", ".1f", style="bold")
    _add(table, "actions clipped", report.regions, "clipped_share", ".1%", style="bold")
    for agent, own in report.agents.items():
        table.add_section()
        _add(table, f"{escape(agent)}  r̃", own.regions, "similarity")
        _add(table, "  normalised regret", own.regions, "normalised_regret")
        if linear := own.references.get("linear_least_squares"):
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
    for field, heading in SAFETY_LABELS.items():
        table.add_row(heading, style="italic")
        pattern = ".1%" if field == "violating_share" else ".3f"
        _add(table, f"  {escape(report.policy)}", safety.regions, field, pattern, style="bold")
        for name in SAFETY_REFERENCES:
            _add(table, f"  {LABELS[name]}", safety.references[name], field, pattern)
        table.add_section()
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
    for heading, field in (
        ("similarity r̃", "similarity"),
        ("normalised regret", "normalised_regret"),
    ):
        table.add_row(heading, style="italic")
        _add(table, "  states in the region", report.regions, field)
        _add(table, "  distractors in it", outside, field)
        table.add_section()
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
    columns = {f"{each.name}\nε ≤ {each.epsilon_high:g}": "number" for each in report.regions}
    return Table(title, {"": "name"} | columns, caption=caption)


def _add(
    table: Table,
    label: str,
    regions: Iterable[Any],
    field: str,
    pattern: str = ".3f",
    *,
    style: str | None = None,
) -> None:
    """A row of one field of each region."""
    table.add_row(label, *(format(getattr(each, field), pattern) for each in regions), style=style)

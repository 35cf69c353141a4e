"""What notebooks show of a task or a stream, and the tables that terminals share with them."""

from __future__ import annotations

import itertools
from typing import Any

from rich.markup import escape

from sme_registry.io.markup import card, pairs_html, table_html
from sme_registry.io.tables import Table
from sme_registry.spec import catalogue, fields
from sme_registry.spec.sme_spec import SMESpec
from sme_registry.spec.stream import StreamSpec

SHORT = len("sha256:") + 12
"""Characters of a digest that name a task."""


def html(document: SMESpec | StreamSpec) -> str:
    """A card of a task or a stream."""
    return card(*parts(document))


def parts(document: SMESpec | StreamSpec) -> list[str]:
    """The parts of that card."""
    if isinstance(document, SMESpec):
        tables = [task_table(document)]
        if each := agents(document):
            tables.append(agents_table(each))
        return [table_html(table) for table in tables]
    return [
        table_html(stream_table(document, escape(catalogue.title(document)))),
        pairs_html("", stream_facts(document)),
    ]


def difference(spec: SMESpec) -> str:
    """What makes a task another one than the default: `Not the default: k=3, seed=7`."""
    changed = in_words(fields.changes(spec))
    return f"Not the default: {changed}" if changed else "The default task"


def in_words(values: dict[str, Any]) -> str:
    """`k=3, rotation=0.25`."""
    return ", ".join(f"{name}={_exact(value)}" for name, value in values.items())


def task_table(spec: SMESpec) -> Table:
    """A row for each field that is set; in bold, with the default, where it is another value."""
    columns = {"symbol": "name", "field": "name", "value": "text", "meaning": "text"}
    table = Table(
        f"{escape(catalogue.title(spec))}\n{escape(difference(spec))}",
        columns,
        caption=spec.digest,
    )
    for row in fields.rows(spec):
        cells = [escape(str(cell)) for cell in (row.symbol, row.name, _exact(row.value))]
        if row.changed:
            default = "none" if row.default is None else _exact(row.default)
            cells = [f"[bold]{cell}[/]" for cell in cells]
            cells[-1] += f"\ndefault {escape(str(default))}"
        table.add_row(*cells, escape(row.meaning))
    return table


def agents(spec: SMESpec) -> list[dict[str, Any]]:
    """Each agent's action channels, observed channels and reward; empty without a team."""
    if spec.team is None:
        return []
    agents, first = [], 0
    for agent in spec.team.agents:
        observed = range(spec.state_dim) if agent.observes == "all" else agent.observes
        agents.append(
            {
                "name": agent.name,
                "action_channels": list(range(first, first + agent.action_dim)),
                "observed_channels": list(observed),
                "observation_dim": len(observed) + 2,
                "rewarded_for": "all channels" if spec.team.reward == "team" else "own channels",
            }
        )
        first += agent.action_dim
    return agents


def agents_table(agents: list[dict[str, Any]]) -> Table:
    """Each agent's channels and what it is rewarded for, a row for each."""
    wrapped = ("action channels", "observed state channels", "observation", "rewarded for")
    rows = [
        (
            escape(agent["name"]),
            _ranges(agent["action_channels"]),
            _ranges(agent["observed_channels"]),
            escape(f"[{agent['observation_dim']}]"),
            agent["rewarded_for"],
        )
        for agent in agents
    ]
    return Table("Agents", {"agent": "name", **dict.fromkeys(wrapped, "text")}, rows)


def _ranges(channels: list[int]) -> str:
    """Increasing channels as ranges: `0–3, 6`."""
    runs = itertools.groupby(enumerate(channels), lambda pair: pair[1] - pair[0])
    ends = [(run[0][1], run[-1][1]) for run in (list(group) for _, group in runs)]
    return ", ".join(str(low) if low == high else f"{low}–{high}" for low, high in ends)


def stream_table(stream: StreamSpec, title: str) -> Table:
    """A stream's phases: when each begins, and in what its task differs from the one before."""
    before, begins, rows = SMESpec(), 0, []
    for index, phase in enumerate(stream.phases):
        changes = in_words(fields.changes(phase.spec, before))
        if phase.drift is not None:
            to, count = _exact(phase.drift.rotation), phase.drift.increments
            drift = f"rotation drifts to {to} in {count} increments"
            changes = f"{changes}, {drift}" if changes else drift
        digest = phase.spec.digest[:SHORT]
        rows.append((str(index), f"{begins:,}", f"{phase.steps:,}", changes or "none", digest))
        before, begins = phase.spec, begins + phase.steps
    columns = {"phase": "number", "begins at": "number", "steps": "number", "changes": "text"}
    caption = "changes: from the phase before; of phase 0, from the default task"
    return Table(title, {**columns, "digest": "name"}, rows, caption=caption)


def stream_facts(stream: StreamSpec) -> dict[str, Any]:
    """What a stream has besides its phases."""
    return {
        "cycles": stream.cycles,
        "steps": f"{stream.steps:,}",
        "phases end": {"episode": "at the next reset", "step": "at once"}[stream.switch],
        "observes_phase": stream.observes_phase,
        "digest": stream.digest,
    }


def _exact(value: Any) -> Any:
    """A number without a needless `.0`, and with all its digits: tasks differ in the last."""
    if not isinstance(value, float):
        return value
    short = f"{value:g}"
    return short if float(short) == value else repr(value)

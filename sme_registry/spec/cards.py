"""What notebooks show of a task or a stream, and the tables that terminals share with them."""

from __future__ import annotations

import itertools
import re
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rich.markup import escape

from sme_registry.io.markup import Table, card, pairs_html, table_html
from sme_registry.spec import catalogue
from sme_registry.spec.sme_spec import Setting, SMESpec
from sme_registry.spec.stream import StreamSpec

SHORT = len("sha256:") + 12
"""Characters of a digest that name a task."""

_SYMBOL = re.compile(r"^(\w(?:_\w)?), ")  # with which a description begins
BLOCKS: dict[str, type[BaseModel]] = {
    name: kind
    for name, field in Setting.model_fields.items()
    for kind in get_args(field.annotation)
    if isinstance(kind, type) and issubclass(kind, BaseModel)
}
"""The fields of a spec that are documents themselves, such as `safety`."""


def fields_of_block(name: str) -> dict[str, FieldInfo]:
    """The fields of a block, in its own order; none of another field."""
    return BLOCKS[name].model_fields if name in BLOCKS else {}


def number_type(field: FieldInfo) -> type | None:
    """int or float, the type of a field that is a number, or may be one."""
    parts = [getattr(part, "__origin__", part) for part in get_args(field.annotation)]
    return next((kind for kind in (int, float) if kind in (field.annotation, *parts)), None)


def html(document: SMESpec | StreamSpec) -> str:
    return card(*parts(document))


def parts(document: SMESpec | StreamSpec) -> list[str]:
    if isinstance(document, StreamSpec):
        table = stream_table(document, escape(catalogue.title(document)))
        return [table_html(table), pairs_html("", stream_facts(document))]
    tables = [task_table(document)]
    if document.team is not None:
        tables.append(agents_table(agents(document)))
    return [table_html(table) for table in tables]


def summary(document: SMESpec | StreamSpec) -> str:
    """What makes a task another one than the default, or how long a stream is."""
    if isinstance(document, StreamSpec):
        return f"Stream: {document.visits:,} visits, {document.steps:,} steps"
    changed = in_words(changed_fields(document))
    return f"Not the default: {changed}" if changed else "The default task"


def in_words(values: dict[str, Any]) -> str:
    """`k=3, rotation=0.25`."""
    return ", ".join(f"{name}={_exact(value)}" for name, value in values.items())


def task_table(spec: SMESpec) -> Table:
    """A row for each field that is set; in bold, with the default, where it is another value."""
    columns = {"symbol": "name", "field": "name", "value": "text", "meaning": "text"}
    title = f"{escape(catalogue.title(spec))}\n{escape(summary(spec))}"
    table = Table(title, columns, caption=spec.digest)
    defaults = field_values(SMESpec())
    for name, value in field_values(spec).items():
        if value is None or name == "schema_version":
            continue
        cells = [escape(str(cell)) for cell in (symbol(name), name, _exact(value))]
        default = defaults.get(name)
        if value != default:
            cells = [f"[bold]{cell}[/]" for cell in cells]
            cells[-1] += f"\ndefault {escape(str(_exact(default)))}"
        table.add_row(*cells, escape(_SYMBOL.sub("", _description(name))))
    return table


def agents(spec: SMESpec) -> list[dict[str, Any]]:
    """Each agent's action channels, observed channels and reward; empty without a team."""
    if spec.team is None:
        return []
    ends = itertools.accumulate(agent.action_dim for agent in spec.agents)
    return [
        {
            "name": agent.name,
            "action_channels": list(range(end - agent.action_dim, end)),
            "observed_channels": list(observed),
            "observation_dim": len(observed) + 2,
            "rewarded_for": "all channels" if spec.team.reward == "team" else "own channels",
        }
        for agent, observed, end in zip(spec.agents, spec.observed_channels, ends, strict=True)
    ]


def agents_table(agents: list[dict[str, Any]]) -> Table:
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
    columns = {"phase": "number", "begins at": "number", "steps": "number", "changes": "text"}
    caption = "changes: from the phase before; of phase 0, from the default task"
    table = Table(title, {**columns, "digest": "name"}, caption=caption)
    before, begins = SMESpec(), 0
    for index, phase in enumerate(stream.phases):
        changes = [in_words(changed_fields(phase.spec, before))]
        if phase.drift is not None:
            to, count = _exact(phase.drift.rotation), phase.drift.increments
            changes.append(f"rotation drifts to {to} in {count} increments")
        text = ", ".join(filter(None, changes)) or "none"
        digest = phase.spec.digest[:SHORT]
        table.add_row(str(index), f"{begins:,}", f"{phase.steps:,}", text, digest)
        before, begins = phase.spec, begins + phase.steps
    return table


def stream_facts(stream: StreamSpec) -> dict[str, Any]:
    return {
        "cycles": stream.cycles,
        "steps": f"{stream.steps:,}",
        "phases end": {"episode": "at the next reset", "step": "at once"}[stream.switch],
        "observes_phase": stream.observes_phase,
        "digest": stream.digest,
    }


def field_values(setting: Setting) -> dict[str, Any]:
    """Every field for people: a team in words, the fields of other blocks by their dotted names."""
    fields: dict[str, Any] = {}
    every_field = setting.every_field()
    for name in type(setting).model_fields:
        value = every_field[name]
        if name == "team" and setting.team is not None:
            n = len(setting.team.agents)
            fields[name] = f"{n} agent{'s' * (n > 1)}, {setting.team.reward} reward"
        elif isinstance(value, dict):
            fields |= {f"{name}.{key}": part for key, part in value.items() if part is not None}
        else:
            fields[name] = value
    return fields


def changed_fields(setting: Setting, default: Setting | None = None) -> dict[str, Any]:
    """What differs from another setting; None for the fields of a block that only the other has."""
    mine, others = field_values(setting), field_values(default or SMESpec())
    names = [*mine, *(name for name in others if name not in mine and "." in name)]
    return {name: mine.get(name) for name in names if mine.get(name) != others.get(name)}


def observation_text(document: SMESpec | StreamSpec) -> str:
    """What a single agent's observation consists of: `state, t/T, r_cum/k`."""
    spec = document.specs[0]
    seen = f"state and {spec.distractors} distractors" if spec.distractors else "state"
    if spec.mixing != "none":
        seen = f"{spec.mixing} mixing of {seen}"
    phase = ", one-hot of the phase" if document.observed_phases else ""
    return f"{seen}, t/T, r_cum/k{phase}"


def _exact(value: Any) -> Any:
    """A number without a needless `.0`, and with all its digits: tasks differ in the last."""
    if not isinstance(value, float):
        return "none" if value is None else value
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def symbol(name: str) -> str:
    """METHOD's symbol of a field, such as `L` of `complexity`; empty where it has none."""
    match = _SYMBOL.match(_description(name))
    if match:
        return match[1]
    return name if name in ("k", "D", "r_min") else ""


def axis(name: str) -> str:
    """What a field is called in words and by its symbol: `reward interval k`, `rotation θ`."""
    if not symbol(name):
        return name
    return f"{_field(name).title or name.rpartition('.')[2].replace('_', ' ')} {symbol(name)}"


def _description(name: str) -> str:
    return _field(name).description or ""


def _field(name: str) -> FieldInfo:
    block, _, inner = name.rpartition(".")
    return BLOCKS.get(block, SMESpec).model_fields[inner]

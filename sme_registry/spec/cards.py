"""What notebooks show of a task or a stream, and the tables that terminals share with them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic import BaseModel
from rich.markup import escape

from sme_registry.io.markup import card, pairs_html, table_html
from sme_registry.io.tables import Table
from sme_registry.spec import catalogue
from sme_registry.spec.sme_spec import ObservationSpec, SafetySpec, Setting, SMESpec, TeamSpec
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
    changed = in_words(changed_fields(spec))
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
    for row in field_rows(spec):
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
        changes = in_words(changed_fields(phase.spec, before))
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


_SYMBOL = re.compile(r"^([A-Zθτm]), ")  # with which a description begins
_BLOCKS: dict[str, type[BaseModel]] = {"safety": SafetySpec, "observation": ObservationSpec}
_OWN_SYMBOL = re.compile(r"^[A-Za-z](_\w+)?$")  # k, D, r_min


class FieldRow(NamedTuple):
    """A field of a task.

    Attributes:
      name: of the field; of a field in a block with the block's name, `safety.tightness`.
      symbol: METHOD's; empty where it has none.
      value: in words where it is a document.
      default: likewise; None where the default task has no such field.
      meaning: the field's description.
    """

    name: str
    symbol: str
    value: Any
    default: Any
    meaning: str

    @property
    def changed(self) -> bool:
        """Whether the value is not the default."""
        return bool(self.value != self.default)


def field_values(setting: Setting) -> dict[str, Any]:
    """Every field for people: a team in words, the fields of other blocks by their dotted names."""
    fields: dict[str, Any] = {}
    every_field = setting.every_field()
    for name in type(setting).model_fields:
        value = every_field[name]
        if name == "team" and setting.team is not None:
            fields[name] = _team_summary(setting.team)
        elif isinstance(value, dict):
            fields |= {f"{name}.{key}": each for key, each in value.items() if each is not None}
        else:
            fields[name] = value
    return fields


def field_rows(setting: Setting) -> Iterator[FieldRow]:
    """The fields that are set, in the order of the document, without the version of its format."""
    default = field_values(SMESpec())
    for name, value in field_values(setting).items():
        if value is not None and name != "schema_version":
            yield FieldRow(name, symbol(name), value, default.get(name), _split(name)[1])


def changed_fields(setting: Setting, default: Setting | None = None) -> dict[str, Any]:
    """The fields whose values are not those of the default task, or of another one."""
    others = field_values(default or SMESpec())
    return {k: v for k, v in field_values(setting).items() if v != others.get(k)}


def symbol(name: str) -> str:
    """METHOD's symbol of a field, such as `L` of `complexity`; empty where it has none."""
    return name if _OWN_SYMBOL.match(name) else _split(name)[0]


def observation_text(spec: SMESpec) -> str:
    """What a single agent's observation consists of: `state, t/T, r_cum/k`."""
    parts = f"state and {spec.distractors} distractors" if spec.distractors else "state"
    if spec.observation is not None and spec.observation.mixing != "none":
        parts = f"{spec.observation.mixing} mixing of {parts}"
    return f"{parts}, t/T, r_cum/k"


def _split(name: str) -> tuple[str, str]:
    """The symbol with which the description of a field begins, and the rest of it."""
    block, _, inner = name.rpartition(".")
    kind = _BLOCKS.get(block, SMESpec)
    text = kind.model_fields[inner].description or ""
    found = _SYMBOL.match(text)
    return (found[1], text[found.end() :]) if found else ("", text)


def _team_summary(team: TeamSpec) -> str:
    n = len(team.agents)
    return f"{n} agent{'s' * (n > 1)}, {team.reward} reward"

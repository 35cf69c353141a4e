"""The fields of a task for people: values, symbols, meanings, and what differs from the default."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic import BaseModel

from sme_registry.spec.sme_spec import ObservationSpec, SafetySpec, Setting, SMESpec, TeamSpec

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


def values(setting: Setting) -> dict[str, Any]:
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


def rows(setting: Setting) -> Iterator[FieldRow]:
    """The fields that are set, in the order of the document, without the version of its format."""
    default = values(SMESpec())
    for name, value in values(setting).items():
        if value is not None and name != "schema_version":
            yield FieldRow(name, symbol(name), value, default.get(name), _split(name)[1])


def changes(setting: Setting, default: Setting | None = None) -> dict[str, Any]:
    """The fields whose values are not those of the default task, or of another one."""
    others = values(default or SMESpec())
    return {k: v for k, v in values(setting).items() if v != others.get(k)}


def symbol(name: str) -> str:
    """METHOD's symbol of a field, such as `L` of `complexity`; empty where it has none."""
    return name if _OWN_SYMBOL.match(name) else _split(name)[0]


def observed(spec: SMESpec) -> str:
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

"""`AXES`: the nine axes of a profile and their levels, which are classes of its plan."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from sme_registry.spec import StudyFile, catalogue

PLAN = "profile"
COMPARED = "PPO", "TD3", "SAC"  # in sentences; other references are in figures and tables
DEFAULT, TWO_LAYERS = "default", "complexity-2"


class Axis(NamedTuple):
    """What its levels change, and they by the names of their classes, the base first."""

    label: str
    levels: Mapping[str, str]

    @property
    def base(self) -> str:
        return next(iter(self.levels))

    @property
    def harder(self) -> list[str]:
        return [*self.levels][1:]


def _axis(label: str, stem: str, values: str, base: str = DEFAULT) -> Axis:
    first, *harder = values.split()
    names = {f"{stem}-{value.replace('.', '_')}": value for value in harder}
    return Axis(label, {base: first, **names})


AXES = (
    _axis("state dimension S", "state_dim", "8 16 64"),
    _axis("action dimension A", "action_dim", "4 8 16"),
    _axis("reward interval k", "k", "1 5 25"),
    _axis("reward threshold r_min", "r_min", "0 0.5 0.75"),
    _axis("survival threshold D", "D", "0 0.25 0.5"),
    _axis("complexity L", "complexity", "1 2 10"),
    _axis("foresight, scale of shaping", "shaping-scale", "0 10 30", TWO_LAYERS),
    _axis("noise of the reward σ", "noise-reward", "0 0.3 1", TWO_LAYERS),
    _axis("distractors", "observation-distractors", "0 8 32"),
)


def plan_file() -> StudyFile:
    return catalogue.find(StudyFile, PLAN)

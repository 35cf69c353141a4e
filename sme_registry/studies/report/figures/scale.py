"""`Scale`: where the classes of an axis are along x, on a linear, logarithmic or nominal scale.

Values v₁ < … < vₙ are logarithmic if all are above 0, n ≥ 3, and their logarithms are spaced more
evenly than they are themselves: cv(log vᵢ₊₁ − log vᵢ) < cv(vᵢ₊₁ − vᵢ), with cv the standard
deviation over the mean. So 1, 2, 5, 10 and 2, 4, 8 are, and 0.25, 0.5, 0.75 are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sme_registry.studies.report.classes import is_numeric

Spacing = Literal["linear", "log", "nominal"]


def spacing(values: Sequence[Any]) -> Spacing:
    """How values are spaced; nominal if they are no numbers in increasing order."""
    if len(values) < 2 or not is_numeric(values) or min(np.diff(values)) <= 0:
        return "nominal"
    if len(values) < 3 or values[0] <= 0:
        return "linear"
    return "log" if _variation(np.log(values)) < _variation(np.asarray(values)) else "linear"


@dataclass(frozen=True)
class Scale:
    """The places of classes along x."""

    spacing: Spacing
    at: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[Any], classes: int) -> Scale:
        """The scale of an axis' values; `classes` in all, which may have no values."""
        kind = spacing(values)
        places = range(classes) if kind == "nominal" else values
        return cls(kind, tuple(float(place) for place in places))

    def shifted(self, x: Any, shift: float) -> Any:
        """Places moved by a share of the smallest distance between two classes."""
        if self.spacing == "log":
            return x * np.exp(shift * np.diff(np.log(self.at)).min())
        distance = np.diff(self.at).min() if len(self.at) > 1 else 1.0
        return x + shift * distance

    def apply(self, axes: Any, labels: Sequence[str]) -> None:
        """Give an axes this scale, with a tick at each class."""
        if self.spacing == "log":
            axes.set_xscale("log")
            axes.minorticks_off()
        crowded = len(labels) > 7 or max(map(len, labels)) > 12 or self.spacing == "nominal"
        long = crowded and max(map(len, labels)) > 4
        turned = {"rotation": 30, "ha": "right", "fontsize": 8} if long else {}
        axes.set_xticks(self.at, labels, **turned)
        axes.set_xlim(self.shifted(self.at[0], -0.5), self.shifted(self.at[-1], 0.5))


def _variation(values: Any) -> float:
    """The coefficient of variation of the distances between values; dimensionless."""
    distances = np.diff(values)
    return float(distances.std() / distances.mean())

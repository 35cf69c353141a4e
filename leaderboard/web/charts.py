"""What the pages draw: scores as inline SVG.

Drawings have no styles, so that the pages can forbid inline styles.

Colours come from `board.css`, for light, dark and print. All text is escaped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from leaderboard.documents.result import Estimate
from sme_registry.io.terminal import fixed

Edges = Sequence[tuple[float, float]]

_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_MARGIN = 3.0  # % of a bar's width at either end, for a dot at the end
_SPARK_WIDTH, _SPARK_HEIGHT = 84.0, 30.0
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 720.0, 360.0, 60.0, 708.0, 22.0, 296.0
_MAX_LABELS = 12  # region labels below a chart


def number(value: float, digits: int = 3) -> str:
    """A number as in every table, with a true minus sign."""
    return fixed(value, digits).replace("-", "\u2212")


@dataclass(frozen=True)
class Scale:
    """An axis."""

    low: float
    high: float  # more than `low`
    ticks: tuple[float, ...]  # round numbers from end to end

    @classmethod
    def covering(cls, *values: float) -> Scale:
        """The scale of about four round steps that covers the values."""
        low, high = min(values, default=0.0), max(values, default=1.0)
        high = high if high - low > 1e-9 else low + 1.0
        raw = (high - low) / 4
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(factor * power for factor in _STEPS if factor * power >= raw * (1 - 1e-9))
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        ticks = tuple(round(index * step, 12) + 0.0 for index in range(first, last + 1))
        return cls(ticks[0], ticks[-1], ticks)

    def part(self, value: float) -> float:
        """The position of a value along the axis, 0 at its low end and 1 at its high end."""
        return (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)


class Bars:
    """The bars of a table on one scale, with lines at the reference rows.

    Hidden from screen readers, because the same numbers are in the next cell. `estimates` are those
    of all rows, `references` the value of each reference row.
    """

    def __init__(self, estimates: Sequence[Estimate], references: Mapping[str, float]) -> None:
        ends = (end for each in estimates for end in each.ends)
        self._scale = Scale.covering(*ends, *references.values())
        self._references = references
        self._lines = "".join(
            f'<line class="{escape(name)}" x1="{at}" x2="{at}" y1="0" y2="100%"/>'
            for name, at in zip(references, map(self._at, references.values()), strict=True)
        )

    def bar(self, estimate: Estimate) -> Markup:
        """A 95 % interval as a bar with a dot at its value, visible even without width."""
        low, high, value = map(self._at, (*estimate.ends, estimate.value))
        return Markup(
            f'<svg class="bar" aria-hidden="true" focusable="false">{self._lines}'
            f'<line class="ci" x1="{low}" x2="{high}" y1="50%" y2="50%"/>'
            f'<circle class="dot" cx="{value}" cy="50%" r="4"/></svg>'
        )

    def axis(self) -> Markup:
        """The axis above the bars, with the names of the reference lines."""
        ticks = self._scale.ticks
        parts = [
            f'<text x="{self._at(tick)}" y="30">{_short(tick)}</text>'
            for tick in ticks[:: 1 + len(ticks) // 4]
        ]
        names: dict[float, list[str]] = {}
        for name, value in self._references.items():
            names.setdefault(value, []).append(name)
        parts += [
            f'<text class="name {_anchor(self._scale.part(value))}" x="{self._at(value)}" y="12">'
            f"{escape(', '.join(group))}</text>"
            for value, group in names.items()
        ]
        return Markup(
            f'<svg class="axis" aria-hidden="true" focusable="false">{"".join(parts)}</svg>'
        )

    def _at(self, value: float) -> str:
        return f"{_MARGIN + (100 - 2 * _MARGIN) * self._scale.part(value):.2f}%"


def sparklines(regrets: Sequence[Sequence[float]], label: str = "From WD outward") -> list[Markup]:
    """Small curves on one scale: of N_m over the regions, WD first, or as the label says."""
    scale = Scale.covering(0.0, 1.0, *itertools.chain.from_iterable(regrets))
    return [_sparkline(regret, scale, label) for regret in regrets]


def _sparkline(regret: Sequence[float], scale: Scale, label: str) -> Markup:
    height = _SPARK_HEIGHT - 6
    step = (_SPARK_WIDTH - 6) / max(1, len(regret) - 1)
    optimal, constant, *ys = [
        f"{_SPARK_HEIGHT - 3 - height * scale.part(value):.1f}" for value in (0.0, 1.0, *regret)
    ]
    points = " ".join(f"{3 + step * index:.1f},{y}" for index, y in enumerate(ys))
    text = ", ".join(number(value, 2) for value in regret)
    return Markup(
        f'<svg class="spark" viewBox="0 0 {_SPARK_WIDTH:.0f} {_SPARK_HEIGHT:.0f}" role="img" '
        f'aria-label="{label}: {text}">'
        f'<path class="optimal" d="M0 {optimal}H{_SPARK_WIDTH:.0f}"/>'
        f'<path class="constant" d="M0 {constant}H{_SPARK_WIDTH:.0f}"/>'
        f'<polyline points="{points}"/>'
        f'<circle cx="3" cy="{ys[0]}" r="2.5"/></svg>'
    )


def region_labels(edges: Edges) -> list[str]:
    """The regions on an axis: `WD`, `0–0.2`, …"""
    return ["WD" if index == 0 else f"{low:g}–{high:g}" for index, (low, high) in enumerate(edges)]


def regret_chart(regret: Sequence[Estimate], edges: Edges, name: str) -> Markup:
    """Normalised regret of an entry over the regions, WD first, with intervals."""
    axes = _Axes.covering(regret, edges)
    points = [
        (f"{axes.x(index):.1f}", *(f"{axes.y(y):.1f}" for y in (e.ends[0], e.value, e.ends[1])))
        for index, e in enumerate(regret)
    ]
    band = [f"{x},{high}" for x, _, _, high in points]
    band += [f"{x},{low}" for x, low, _, _ in reversed(points)]
    line = [f"{x},{y}" for x, _, y, _ in points]
    known = all(e.interval for e in regret)  # not where each class has a single run
    marks = "".join(
        (f'<path class="whisker" d="M{x} {low}V{high}m-5 0h10M{x} {low}m-5 0h10"/>' * known)
        + f'<circle class="dot" cx="{x}" cy="{y}" r="4.5"/>'
        for x, low, y, high in points
    )
    curve = (
        f'<polygon class="band" points="{" ".join(band)}"/>' * known
        + f'<polyline class="line" points="{" ".join(line)}"/>{marks}'
    )
    values = "; ".join(
        f"{label}: {number(e.value)}"
        + (f", from {number(e.ends[0])} to {number(e.ends[1])}" if e.interval else "")
        for label, e in zip(region_labels(edges), regret, strict=True)
    )
    title = f"Normalised regret of {name} by region"
    return axes.chart(title, f"{values}. 0 is the optimal policy, 1 the constant one.", curve)


def comparison_chart(regret: Sequence[Estimate], edges: Edges) -> Markup:
    """The axes of the comparison, which cover all entries and any choice of `board.js`."""
    return _Axes.covering(regret, edges).chart("Normalised regret by region", "", "")


@dataclass(frozen=True)
class _Axes:
    """The axes of a chart of normalised regret over the regions."""

    scale: Scale
    regions: tuple[str, ...]

    @classmethod
    def covering(cls, regret: Sequence[Estimate], edges: Edges) -> _Axes:
        scale = Scale.covering(0.0, 1.0, *(end for e in regret for end in e.ends))
        return cls(scale, tuple(region_labels(edges)))

    @property
    def step(self) -> float:
        return (_RIGHT - _LEFT) / len(self.regions)

    def x(self, region: int) -> float:
        return _LEFT + self.step * (region + 0.5)

    def y(self, value: float) -> float:
        return _BOTTOM - (_BOTTOM - _TOP) * self.scale.part(value)

    def chart(self, title: str, description: str, curve: str) -> Markup:
        """The axes and a curve, as SVG. Its data attributes let a script draw on the same axes."""
        return Markup(
            f'<svg class="profile" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" '
            'aria-labelledby="chart-title chart-desc" '
            f'data-left="{_LEFT:.0f}" data-step="{self.step:.3f}" '
            f'data-zero="{self.y(0.0):.3f}" data-one="{self.y(1.0):.3f}">'
            f'<title id="chart-title">{escape(title)}</title>'
            f'<desc id="chart-desc">{escape(description)}</desc>{self._ticks()}{curve}</svg>'
        )

    def _ticks(self) -> str:
        parts = [
            f'<path class="grid" d="M{_LEFT:.0f} {self.y(tick):.1f}H{_RIGHT:.0f}"/>'
            f'<text class="tick end" x="{_LEFT - 8:.0f}" y="{self.y(tick) + 4:.1f}">'
            f"{_short(tick)}</text>"
            for tick in self.scale.ticks
        ]
        parts += [
            f'<path class="{name}" d="M{_LEFT:.0f} {self.y(value):.1f}H{_RIGHT:.0f}"/>'
            f'<text class="tick label" x="{_RIGHT:.0f}" y="{self.y(value) - 6:.1f}">{label}</text>'
            for name, value, label in (("optimal", 0.0, "optimal"), ("constant", 1.0, "constant ½"))
        ]
        every = 1 + (len(self.regions) - 1) // _MAX_LABELS
        parts += [
            f'<text class="tick middle" x="{self.x(index):.1f}" y="{_BOTTOM + 24:.0f}">'
            f"{label}</text>"
            for index, label in enumerate(self.regions)
            if index % every == 0
        ]
        return "".join(parts) + (
            f'<text class="tick middle" x="{(_LEFT + _RIGHT) / 2:.0f}" y="{_HEIGHT - 10:.0f}">'
            "expansion ε beyond the training cube</text>"
        )


def _anchor(part: float) -> str:
    return "start" if part < 0.2 else "end" if part > 0.8 else "middle"


def _short(value: float) -> str:
    return f"{value:g}".replace("-", "\u2212")

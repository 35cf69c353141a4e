"""Drawings of scores as inline SVG without styles, so that the pages can forbid inline styles.

Colours come from `board.css`, for light, dark and print. All text is escaped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from leaderboard.documents.result import Estimate
from sme_registry.terminal import fixed

Edges = Sequence[tuple[float, float]]

_MARGIN = 3.0  # % of a bar's width at either end, for a dot at the end
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_SPARK_WIDTH, _SPARK_HEIGHT = 84.0, 30.0
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 720.0, 360.0, 60.0, 708.0, 22.0, 296.0
_MAX_LABELS = 12  # region labels below a chart


@dataclass(frozen=True)
class Scale:
    """An axis.

    Attributes:
      low, high: its ends; `low < high`.
      ticks: round numbers from end to end.
    """

    low: float
    high: float
    ticks: tuple[float, ...]

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


def number(value: float, digits: int = 3) -> str:
    """A number as in every table, with a true minus sign."""
    return fixed(value, digits).replace("-", "\u2212")


def reference_lines(scale: Scale, references: Mapping[str, float]) -> Markup:
    """The lines of the reference rows in each bar of a table, by class name."""
    return Markup("").join(
        Markup('<line class="{}" x1="{}" x2="{}" y1="0" y2="100%"/>').format(name, at, at)
        for name, value in references.items()
        for at in [_percent(scale, value)]
    )


def interval_bar(estimate: Estimate, scale: Scale, lines: Markup) -> Markup:
    """A 95 % interval as a bar with a dot at its value.

    Hidden from screen readers, because the same numbers are in the next cell. The dot shows a bar
    of no width.

    Args:
      estimate: value and interval.
      scale: of all bars of the table.
      lines: `reference_lines` of that scale.
    """
    low, high, value = (_percent(scale, x) for x in (estimate.low, estimate.high, estimate.value))
    return Markup(
        f'<svg class="bar" aria-hidden="true" focusable="false">{lines}'
        f'<line class="ci" x1="{low}" x2="{high}" y1="50%" y2="50%"/>'
        f'<circle class="dot" cx="{value}" cy="50%" r="4"/></svg>'
    )


def bar_axis(scale: Scale, references: Mapping[str, float]) -> Markup:
    """The axis above a column of bars, with the names of the reference lines."""
    ticks = "".join(
        f'<text x="{_percent(scale, tick)}" y="30">{_short(tick)}</text>'
        for tick in scale.ticks[:: 1 + len(scale.ticks) // 7]
    )
    names: dict[float, list[str]] = {}
    for name, value in references.items():
        names.setdefault(value, []).append(name)
    labels = "".join(
        f'<text class="name {_anchor(scale.part(value))}" x="{_percent(scale, value)}" y="12">'
        f"{escape(', '.join(group))}</text>"
        for value, group in names.items()
    )
    return Markup(f'<svg class="axis" aria-hidden="true" focusable="false">{labels}{ticks}</svg>')


def sparkline(regret: Sequence[float], scale: Scale) -> Markup:
    """A small curve of N_m over the regions, WD first, on the scale of its table."""
    height = _SPARK_HEIGHT - 6
    step = (_SPARK_WIDTH - 6) / max(1, len(regret) - 1)
    optimal, constant, *ys = [
        f"{_SPARK_HEIGHT - 3 - height * scale.part(value):.1f}" for value in (0.0, 1.0, *regret)
    ]
    points = " ".join(f"{3 + step * index:.1f},{y}" for index, y in enumerate(ys))
    text = ", ".join(number(value, 2) for value in regret)
    return Markup(
        f'<svg class="spark" viewBox="0 0 {_SPARK_WIDTH:.0f} {_SPARK_HEIGHT:.0f}" role="img" '
        f'aria-label="From WD outward: {text}">'
        f'<path class="optimal" d="M0 {optimal}H{_SPARK_WIDTH:.0f}"/>'
        f'<path class="constant" d="M0 {constant}H{_SPARK_WIDTH:.0f}"/>'
        f'<polyline points="{points}"/>'
        f'<circle cx="3" cy="{ys[0]}" r="2.5"/></svg>'
    )


def region_labels(edges: Edges) -> list[str]:
    """The regions on an axis: `WD`, `0–0.2`, …"""
    return ["WD" if index == 0 else f"{low:g}–{high:g}" for index, (low, high) in enumerate(edges)]


def regret_chart(regret: Sequence[Estimate], edges: Edges, name: str) -> Markup:
    """Normalised regret over the regions, with intervals and the two reference lines.

    Args:
      regret: N_m of each region, WD first.
      edges: ε_low and ε_high of each region.
      name: of the entry; any text.
    """
    axes = _Axes.covering(regret, edges)
    xs = [axes.x(index) for index in range(len(regret))]
    upper = [f"{x:.1f},{axes.y(e.high):.1f}" for x, e in zip(xs, regret, strict=True)]
    lower = [f"{x:.1f},{axes.y(e.low):.1f}" for x, e in zip(xs, regret, strict=True)]
    line = [f"{x:.1f},{axes.y(e.value):.1f}" for x, e in zip(xs, regret, strict=True)]
    marks = "".join(
        f'<path class="whisker" d="M{x:.1f} {axes.y(e.low):.1f}V{axes.y(e.high):.1f}'
        f'M{x - 5:.1f} {axes.y(e.low):.1f}h10M{x - 5:.1f} {axes.y(e.high):.1f}h10"/>'
        f'<circle class="dot" cx="{x:.1f}" cy="{axes.y(e.value):.1f}" r="4.5"/>'
        for x, e in zip(xs, regret, strict=True)
    )
    curve = (
        f'<polygon class="band" points="{" ".join(upper + lower[::-1])}"/>'
        f'<polyline class="line" points="{" ".join(line)}"/>{marks}'
    )
    values = "; ".join(
        f"{label}: {number(e.value)}, from {number(e.low)} to {number(e.high)}"
        for label, e in zip(region_labels(edges), regret, strict=True)
    )
    title = f"Normalised regret of {name} by region"
    return axes.chart(title, f"{values}. 0 is the optimal policy, 1 the constant one.", curve)


def comparison_chart(regret: Sequence[Estimate], edges: Edges) -> Markup:
    """The axes of the comparison, into which `board.js` draws the chosen entries.

    The scale covers all entries and does not depend on the choice.

    Args:
      regret: every N_m that may be drawn.
      edges: ε_low and ε_high of each region.
    """
    return _Axes.covering(regret, edges).chart("Normalised regret by region", "", "")


@dataclass(frozen=True)
class _Axes:
    """The axes of a chart of normalised regret over the regions."""

    scale: Scale
    regions: tuple[str, ...]

    @classmethod
    def covering(cls, regret: Sequence[Estimate], edges: Edges) -> _Axes:
        scale = Scale.covering(0.0, 1.0, *(e.low for e in regret), *(e.high for e in regret))
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


def _percent(scale: Scale, value: float) -> str:
    return f"{_MARGIN + (100 - 2 * _MARGIN) * scale.part(value):.2f}%"


def _anchor(part: float) -> str:
    return "start" if part < 0.2 else "end" if part > 0.8 else "middle"


def _short(value: float) -> str:
    return f"{value:g}".replace("-", "\u2212")

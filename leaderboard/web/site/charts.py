"""Pictures of scores as inline SVG: text in, text out, no styles of their own.

Only attributes and classes, so that the pages can forbid inline styles; colours come from
`board.css`, in light, dark and print. Nothing here is a submitter's text but through `escape`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from leaderboard.documents.result import Estimate
from sme_registry.terminal import fixed

_MARGIN = 3.0  # % of a bar's width at either end, so that a dot at the end is whole
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_SPARK_WIDTH, _SPARK_HEIGHT = 84.0, 30.0
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 720.0, 360.0, 60.0, 12.0, 22.0, 64.0
_LABELS = 12  # of regions, at most, beneath a profile


@dataclass(frozen=True)
class Scale:
    """Where numbers stand on an axis.

    Attributes:
      low, high: its ends; `low < high`.
      ticks: round numbers from end to end.
    """

    low: float
    high: float
    ticks: tuple[float, ...]

    @classmethod
    def of(cls, values: Iterable[float], count: int = 4) -> Scale:
        """The scale with about `count` round steps that holds all of the values."""
        low, high = _ends(values)
        raw = (high - low) / count
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(factor * power for factor in _STEPS if factor * power >= raw * (1 - 1e-9))
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        ticks = tuple(round(index * step, 12) + 0.0 for index in range(first, last + 1))
        return cls(ticks[0], ticks[-1], ticks)

    def part(self, value: float) -> float:
        """How far along the axis a value stands, 0 at its low end and 1 at its high end."""
        return (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)


def _ends(values: Iterable[float]) -> tuple[float, float]:
    known = list(values)
    low, high = min(known, default=0.0), max(known, default=1.0)
    return (low, high) if high - low > 1e-9 else (low, low + 1.0)


def number(value: float, digits: int = 3) -> str:
    """A number as the pages show it: as every table does, with a true minus sign."""
    return fixed(value, digits).replace("-", "\u2212")


def reference_lines(scale: Scale, references: Sequence[tuple[str, float]]) -> Markup:
    """The lines of the reference rows, the same in each of a table's bars.

    Args:
      scale: the table's.
      references: class name and value of each.
    """
    return Markup("").join(
        Markup('<line class="{}" x1="{}" x2="{}" y1="0" y2="100%"/>').format(name, at, at)
        for name, value in references
        for at in [_percent(scale, value)]
    )


def interval_bar(estimate: Estimate, scale: Scale, lines: Markup) -> Markup:
    """A 95 % interval as a bar, its value as a dot, on a scale that a table's rows share.

    Hidden from screen readers: the same numbers stand beside it as text. A bar of no width
    vanishes; the dot is left to show it.

    Args:
      estimate: value and interval.
      scale: the table's.
      lines: `reference_lines` of it.
    """
    low, high, value = (_percent(scale, x) for x in (estimate.low, estimate.high, estimate.value))
    return Markup(
        f'<svg class="bar" aria-hidden="true" focusable="false">{lines}'
        f'<line class="ci" x1="{low}" x2="{high}" y1="50%" y2="50%"/>'
        f'<circle class="dot" cx="{value}" cy="50%" r="4"/></svg>'
    )


def bar_axis(scale: Scale, references: Sequence[tuple[str, float]]) -> Markup:
    """The numbers above a column of bars, and what its reference lines are."""
    ticks = "".join(
        f'<text x="{_percent(scale, tick)}" y="30">{_short(tick)}</text>'
        for tick in scale.ticks[:: 1 + len(scale.ticks) // 7]
    )
    groups: dict[float, list[str]] = {}
    for name, value in references:
        groups.setdefault(value, []).append(name)
    names = "".join(
        f'<text class="name {_anchor(scale.part(value))}" x="{_percent(scale, value)}" y="12">'
        f"{escape(', '.join(names))}</text>"
        for value, names in groups.items()
    )
    return Markup('<svg class="axis" aria-hidden="true" focusable="false">{}{}</svg>').format(
        Markup(names), Markup(ticks)
    )


def sparkline(profile: Sequence[float], scale: Scale) -> Markup:
    """A small curve of N_m over the regions, WD first; `scale` is shared by the table's rows."""

    up = _SPARK_HEIGHT - 6
    step = (_SPARK_WIDTH - 6) / max(1, len(profile) - 1)
    optimal, constant, *ys = [
        f"{_SPARK_HEIGHT - 3 - up * scale.part(value):.1f}" for value in (0.0, 1.0, *profile)
    ]
    points = " ".join(f"{3 + step * index:.1f},{y}" for index, y in enumerate(ys))
    said = ", ".join(number(value, 2) for value in profile)
    return Markup(
        f'<svg class="spark" viewBox="0 0 {_SPARK_WIDTH:.0f} {_SPARK_HEIGHT:.0f}" role="img" '
        f'aria-label="From WD outward: {said}">'
        f'<path class="optimal" d="M0 {optimal}H{_SPARK_WIDTH:.0f}"/>'
        f'<path class="constant" d="M0 {constant}H{_SPARK_WIDTH:.0f}"/>'
        f'<polyline points="{points}"/>'
        f'<circle cx="3" cy="{ys[0]}" r="2.5"/></svg>'
    )


def region_labels(edges: Sequence[tuple[float, float]]) -> list[str]:
    """What the regions are called on an axis: `WD`, `0–0.2`, …"""
    return ["WD" if index == 0 else f"{low:g}–{high:g}" for index, (low, high) in enumerate(edges)]


def profile_chart(
    profile: Sequence[Estimate], edges: Sequence[tuple[float, float]], identifier: str, name: str
) -> Markup:
    """Normalised regret over the regions: values, intervals, and the two reference lines.

    Args:
      profile: of each region, WD first.
      edges: ε_low and ε_high of each region.
      identifier: of its title and description in the page.
      name: what the curve is of; any text.
    """
    scale = Scale.of([0.0, 1.0, *(e.low for e in profile), *(e.high for e in profile)])
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    step = (right - _LEFT) / len(profile)

    def x(index: int) -> float:
        return _LEFT + step * (index + 0.5)

    def y(value: float) -> float:
        return bottom - (bottom - _TOP) * scale.part(value)

    parts = [
        f'<path class="grid" d="M{_LEFT:.0f} {y(tick):.1f}H{right:.0f}"/>'
        f'<text class="tick end" x="{_LEFT - 8:.0f}" y="{y(tick) + 4:.1f}">{_short(tick)}</text>'
        for tick in scale.ticks
    ]
    for label, value in (("optimal", 0.0), ("constant", 1.0)):
        parts.append(
            f'<path class="{label}" d="M{_LEFT:.0f} {y(value):.1f}H{right:.0f}"/>'
            f'<text class="tick label" x="{right:.0f}" y="{y(value) - 6:.1f}">'
            f"{'optimal' if label == 'optimal' else 'constant ½'}</text>"
        )
    every = 1 + (len(profile) - 1) // _LABELS
    for index, label in enumerate(region_labels(edges)):
        if index % every == 0:
            parts.append(
                f'<text class="tick middle" x="{x(index):.1f}" y="{bottom + 24:.0f}">{label}</text>'
            )
    parts.append(
        f'<text class="tick middle" x="{(_LEFT + right) / 2:.0f}" y="{_HEIGHT - 10:.0f}">'
        "expansion ε beyond the training cube</text>"
    )
    outline = [f"{x(i):.1f},{y(e.high):.1f}" for i, e in enumerate(profile)]
    outline += [f"{x(i):.1f},{y(e.low):.1f}" for i, e in reversed(list(enumerate(profile)))]
    line = [f"{x(i):.1f},{y(e.value):.1f}" for i, e in enumerate(profile)]
    parts.append(f'<polygon class="band" points="{" ".join(outline)}"/>')
    parts.append(f'<polyline class="line" points="{" ".join(line)}"/>')
    for index, e in enumerate(profile):
        parts.append(
            f'<path class="whisker" d="M{x(index):.1f} {y(e.low):.1f}V{y(e.high):.1f}'
            f'M{x(index) - 5:.1f} {y(e.low):.1f}h10M{x(index) - 5:.1f} {y(e.high):.1f}h10"/>'
            f'<circle class="dot" cx="{x(index):.1f}" cy="{y(e.value):.1f}" r="4.5"/>'
        )
    said = "; ".join(
        f"{label}: {number(e.value)}, from {number(e.low)} to {number(e.high)}"
        for label, e in zip(region_labels(edges), profile, strict=True)
    )
    return Markup(
        '<svg class="profile" viewBox="0 0 {} {}" role="img" aria-labelledby="{}-title {}-desc">'
        '<title id="{}-title">Normalised regret of {} by region</title>'
        '<desc id="{}-desc">{}. 0 is the optimal policy, 1 the constant one.</desc>{}</svg>'
    ).format(
        int(_WIDTH),
        int(_HEIGHT),
        *[identifier] * 3,
        name,
        identifier,
        said,
        Markup("".join(parts)),
    )


def _percent(scale: Scale, value: float) -> str:
    return f"{_MARGIN + (100 - 2 * _MARGIN) * scale.part(value):.2f}%"


def _anchor(part: float) -> str:
    return "start" if part < 0.2 else "end" if part > 0.8 else "middle"


def _short(value: float) -> str:
    return f"{value:g}".replace("-", "\u2212")

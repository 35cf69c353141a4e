"""Line charts as inline SVG: no script, no style sheet, no network, readable on light and dark.

Text and axes have the colour of the page's text (`currentColor`), and lines a middle tone that
stands out from white and from black. All text is escaped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Literal, NamedTuple

_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 540.0, 240.0, 44.0, 410.0, 12.0, 194.0
_LINE = 15.0  # between two lines of text
_MAX_LABELS = 8  # below the x axis
_STROKES = {
    "main": 'stroke="#2b87d8" stroke-width="2.5"',
    "other": 'stroke="#d9822b" stroke-width="1.2" stroke-opacity=".8"',
    "reference": 'stroke="currentColor" stroke-width="1.3" stroke-opacity=".55" '
    'stroke-dasharray="5 3"',
}


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


class Line(NamedTuple):
    """A line of a chart.

    Attributes:
      label: at its end, of at most 17 characters; empty for none.
      values: one for each position on the x axis, finite.
      kind: "main" for what the chart is about, "other" for what stands beside it, "reference".
    """

    label: str
    values: Sequence[float]
    kind: Literal["main", "other", "reference"] = "main"


def line_chart(title: str, positions: Sequence[str], lines: Sequence[Line], below: str = "") -> str:
    """A chart of lines over named positions, labelled at their ends.

    Args:
      title: what it shows, for screen readers; the values of labelled lines are added.
      positions: names of the positions on the x axis.
      lines: drawn in this order; the y axis covers 0, 1 and all values.
      below: the title of the x axis.

    Returns:
      An `<svg>` element of about 3 kB that shrinks with the page.
    """
    scale = Scale.covering(0.0, 1.0, *(value for line in lines for value in line.values))
    step = (_RIGHT - _LEFT) / len(positions)
    xs = [_LEFT + step * (index + 0.5) for index in range(len(positions))]

    def y(value: float) -> float:
        return _BOTTOM - (_BOTTOM - _TOP) * scale.part(value)

    parts = [
        f'<path d="M{_LEFT:.0f} {y(tick):.1f}H{_RIGHT:.0f}" stroke="currentColor" '
        'stroke-opacity=".18"/>'
        + _text(_LEFT - 6, y(tick) + 4, f"{tick:g}".replace("-", "−"), "end")
        for tick in scale.ticks
    ]
    every = 1 + (len(positions) - 1) // _MAX_LABELS
    parts += [
        _text(x, _BOTTOM + _LINE + 3, name, "middle")
        for x, name in list(zip(xs, positions, strict=True))[::every]
    ]
    parts.append(_text((_LEFT + _RIGHT) / 2, _HEIGHT - 8, below, "middle") if below else "")
    for line in lines:
        points = [(x, y(value)) for x, value in zip(xs, line.values, strict=True)]
        path = " ".join(f"{x:.1f},{height:.1f}" for x, height in points)
        parts.append(f'<polyline points="{path}" fill="none" {_STROKES[line.kind]}/>')
        if line.kind == "main":
            dots = (f'<circle cx="{x:.1f}" cy="{height:.1f}" r="3.5"/>' for x, height in points)
            parts.append(f'<g fill="#2b87d8">{"".join(dots)}</g>')
    labelled = [line for line in lines if line.label]
    heights = _apart([y(line.values[-1]) for line in labelled])
    for line, height in zip(labelled, heights, strict=True):
        end = y(line.values[-1])
        parts.append(
            f'<path d="M{xs[-1] + 5:.1f} {end:.1f}L{_RIGHT + 4:.1f} {height:.1f}" fill="none" '
            f"{_STROKES['reference']}/>"
            + _text(_RIGHT + 8, height + 4, line.label, "start", bold=line.kind == "main")
        )
    values = "; ".join(
        f"{line.label}: {', '.join(f'{value:.2f}' for value in line.values)}" for line in labelled
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" width="{_WIDTH:.0f}" role="img" '
        f'style="max-width:100%;height:auto" font-family="system-ui,sans-serif" font-size="13" '
        f'aria-label="{escape(f"{title}. {values}")}">{"".join(parts)}</svg>'
    )


def _apart(heights: Sequence[float]) -> list[float]:
    """Heights of labels near the given ones, at least a line of text apart."""
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    placed = list(heights)
    for above, i in pairwise(order):
        placed[i] = max(placed[i], placed[above] + _LINE)
    overflow = max((placed[i] for i in order), default=0.0) - _BOTTOM
    limit = _BOTTOM
    for i in reversed(order if overflow > 0 else []):
        placed[i] = min(placed[i], limit)
        limit = placed[i] - _LINE
    return placed


def _text(x: float, y: float, text: str, anchor: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="currentColor"{weight}>'
        f"{escape(text)}</text>"
    )

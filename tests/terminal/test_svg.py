"""Charts as SVG: scales, labels that do not overlap, and text that is escaped."""

from __future__ import annotations

from itertools import pairwise
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sme_registry.terminal import Scale
from sme_registry.terminal.svg import Line, line_chart

finite = st.floats(-1e6, 1e6)


@given(st.lists(finite, max_size=5))
def test_a_scale_covers_every_value_with_round_ends(values: list[float]) -> None:
    scale = Scale.covering(*values)
    assert scale.low < scale.high
    assert 2 <= len(scale.ticks) <= 8
    for value in values:
        margin = 1e-6 * (scale.high - scale.low)
        assert scale.low - margin <= value <= scale.high + margin
        assert 0.0 <= scale.part(value) <= 1.0


def test_regret_of_good_entries_is_drawn_from_zero_to_one() -> None:
    assert Scale.covering(0.0, 1.0, 0.3).ticks == (0.0, 0.25, 0.5, 0.75, 1.0)


def texts(svg: str) -> dict[str, float]:
    """The texts of a chart, and how far down each is."""
    return {
        each.text or "": float(each.attrib["y"])
        for each in ElementTree.fromstring(svg).iter("text")
    }


@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=8))
def test_labels_at_the_end_are_a_line_of_text_apart_and_on_the_chart(ends: list[float]) -> None:
    lines = [Line(f"line {index}", [0.5, end]) for index, end in enumerate(ends)]
    heights = sorted(
        y for text, y in texts(line_chart("t", ["a", "b"], lines)).items() if "line" in text
    )
    assert len(heights) == len(ends)
    assert all(below - above >= 14.9 for above, below in pairwise(heights))
    assert 0 < heights[0] <= heights[-1] < 240


def test_a_line_is_where_its_values_are() -> None:
    root = ElementTree.fromstring(line_chart("t", ["a", "b"], [Line("x", [0.0, 1.0])]))
    (drawn,) = root.iter("polyline")
    (_, low), (_, high) = (map(float, point.split(",")) for point in drawn.attrib["points"].split())
    ticks = texts(line_chart("t", ["a", "b"], [Line("x", [0.0, 1.0])]))
    assert (low, high) == pytest.approx((ticks["0"] - 4, ticks["1"] - 4))


def test_labels_and_titles_are_escaped_and_read_out() -> None:
    svg = line_chart("<b>", ["<i>"], [Line('"&<script>', [0.25])])
    assert "<script>" not in svg
    root = ElementTree.fromstring(svg)
    assert root.attrib["aria-label"] == '<b>. "&<script>: 0.25'
    assert {'"&<script>', "<i>"} <= texts(svg).keys()

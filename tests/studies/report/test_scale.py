"""Values of an axis are drawn on the scale on which they are evenly spaced."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sme_registry.studies.report.figures.scale import Scale, spacing


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1, 2, 5, 10], "log"),
        ([1, 5, 10, 25, 100], "log"),
        ([2, 4, 8, 16], "log"),
        ([0.25, 0.5, 0.75], "linear"),
        ([0, 0.1, 1], "linear"),
        ([1, 2, 3, 4], "linear"),
        ([1, 10], "linear"),
        (["individual", "team"], "nominal"),
        ([True, False], "nominal"),
        ([], "nominal"),
    ],
)
def test_spacing(values: list[Any], expected: str) -> None:
    assert spacing(values) == expected


def test_marks_next_to_each_other_have_equal_distances_everywhere() -> None:
    scale = Scale.of([1, 2, 5, 10], 4)
    ratios = scale.shifted(np.array(scale.at), 0.5) / np.array(scale.at)
    assert np.allclose(ratios, np.sqrt(2.0))
    assert Scale.of(["a", "b"], 2).at == (0.0, 1.0)

"""Figures of a study: their axes and captions."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.report.analysis import Analysis, analyse

pytest.importorskip("matplotlib")

from sme_registry.studies.report.figures import curves, differences, panels


@pytest.fixture(scope="module")
def analysis(finished: Path) -> Analysis:
    ledger = Ledger(finished)
    file = ledger.plan_file()
    assert file is not None
    return analyse(file, ledger.results(), draws=50)


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """The y limits of every panel that is drawn."""
    drawn: list[tuple[float, float]] = []
    real = panels.panel_grid

    @contextlib.contextmanager
    def spy(*arguments: Any, **options: Any) -> Iterator[panels.Grid]:
        with real(*arguments, **options) as grid:
            yield grid
            drawn.extend(axes.get_ylim() for axes in grid.panels)

    monkeypatch.setattr(panels, "panel_grid", spy)
    return drawn


def unlearnt(analysis: Analysis) -> Analysis:
    """With regrets between 0.98 and 1."""
    rows = analysis.learning_curves
    names = ["q25", "median", "q75"]
    squeezed = rows.assign(**{name: 0.98 + 0.02 * (rows[name] % 1.0) for name in names})
    squeezed.loc[squeezed.index[::3], "q75"] = 1.0
    levels = analysis.levels.copy()
    levels[["iqm", "linear"]] = 0.999
    levels[["low", "high"]] = [0.99, 1.0]
    return dataclasses.replace(analysis, learning_curves=squeezed, levels=levels)


def test_curves_of_all_algorithms_have_headroom_and_one_scale(analysis: Analysis, limits) -> None:
    (picture,) = differences.draw_class_curves(unlearnt(analysis), ["png"])
    ((low, high),) = set(limits)
    assert 0.9 < low < 0.98
    assert high - 1.0 > 0.03 * (high - low)
    assert "each a running median over 2 evaluations" in picture.caption


def test_regret_from_zero_has_headroom(analysis: Analysis, limits) -> None:
    list(curves.draw_regret(unlearnt(analysis), ["png"]))
    for low, high in limits:
        assert low == 0.0
        assert high - 1.0 > 0.03


def test_levels_of_one_state_dimension_are_comparable(analysis: Analysis) -> None:
    assert "not comparable" in panels.epsilon_remark(analysis)
    alike = dataclasses.replace(analysis, results=analysis.results[analysis.results.state_dim == 8])
    assert panels.epsilon_remark(alike) == ""


def test_an_axis_with_a_single_class_has_no_figure(finished: Path) -> None:
    ledger = Ledger(finished)
    file = ledger.plan_file()
    assert file is not None
    keys = [p.cell.digest for p in file.plan.cells if p.class_name in ("default", "k-25")]
    pictures = curves.draw_learning_curves(analyse(file, ledger.results(keys), draws=50), ["png"])
    assert [picture.name for picture in pictures] == ["learning-curves-k"]

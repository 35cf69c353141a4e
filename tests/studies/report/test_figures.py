"""Figures of a study, by what is drawn in them: readable, whole, on scales that compare."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from tests.studies.finished import analysed, with_tables

pytest.importorskip("matplotlib")

from sme_registry.studies.report import figures
from sme_registry.studies.report.figures import curves, draw_figures
from sme_registry.studies.report.figures.panels import FEW, looks_of, positions, spacing
from sme_registry.studies.report.tables import analyse
from tests.geometry import assert_readable
from tests.studies.report.test_report import FIGURES


def with_algorithms(analysis, names):
    """The analysis as if Alpha had been trained under each of these names."""

    def renamed(table):
        alpha = table[table.algorithm == "Alpha"]
        return pd.concat([alpha.assign(algorithm=name) for name in names], ignore_index=True)

    tables = ("results", "regions", "levels", "contrasts", "aggregates", "profiles",
              "learning_curves")  # fmt: skip
    pair = {"first": names[0], "second": names[1]}
    many = dataclasses.replace(
        analysis, algorithms=tuple(names), learners=tuple(names), runs=renamed(analysis.runs)
    )
    return with_tables(
        many,
        improvements=analysis.tables["improvements"][:1].assign(**pair),
        differences=analysis.tables["differences"].assign(**pair),
        **{table: renamed(analysis.tables[table]) for table in tables},
    )


def test_figures_of_eight_algorithms_with_long_names_are_readable_and_whole(analysis):
    levels = analysis.tables["levels"].copy()
    # The worst is in the last panel, and far above the others.
    worst = (levels.class_name == "plane") & (levels.algorithm == "Alpha")
    levels.loc[worst, ["iqm", "low", "high"]] = 1.7, 1.5, 1.9
    names = [f"PPO (learning_rate = 0.000{i}, n_steps = 256)" for i in range(1, 9)]
    many = with_algorithms(with_tables(analysis, levels=levels), names)
    pictures = draw_figures(many, ())
    assert {picture.name for picture in pictures} == FIGURES
    by_name = {picture.name: picture.figure for picture in pictures}
    for name, figure in by_name.items():
        assert_readable(figure)
        for axes in figure.axes:
            (left, right), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
            for line in axes.lines:
                if line.get_transform() == axes.transData:
                    for x, y in line.get_xydata():
                        assert left <= x <= right, name
                        assert bottom <= y <= top, name
    assert {axes.get_ylim()[0] for axes in by_name["wd-regret"].axes} == {0.0}


def test_a_heat_map_has_one_scale_that_covers_its_values_and_prints_them(analysis):
    regions = analysis.tables["regions"].assign(
        similarity=np.linspace(0.91, 0.96, len(analysis.tables["regions"]))
    )
    coloured = with_tables(analysis, regions=regions)
    (picture,) = figures.draw([figures.draw_regions], coloured, ())
    figure = picture.figure
    maps = [axes for axes in figure.axes if axes.images]
    assert len(maps) == len(analysis.algorithms)
    assert {axes.images[0].get_clim() for axes in maps} == {(0.9, 1.0)}
    first = maps[0].images[0].get_array()[0, 0]
    assert maps[0].texts[0].get_text() == f"{first:.3f}"
    assert any("colours from 0.90 to 1.00" in axes.get_xlabel() for axes in figure.axes)


def test_a_figure_of_levels_shows_those_of_its_own_metric(analysis):
    levels = analysis.tables["levels"]
    pictures = figures.draw([curves.draw_regret], analysis, ())
    for picture, metric in zip(pictures, ("wd_regret", "ood_regret"), strict=True):
        lines = [line for axes in picture.figure.axes for line in axes.lines]
        drawn = {float(y) for line in lines for y in line.get_ydata()}
        rows = levels[levels.metric == metric]
        assert {*rows.iqm} <= drawn <= {*rows.iqm, *rows.linear}
        joined = [any(line.get_alpha() for line in axes.lines) for axes in picture.figure.axes]
        assert joined[0]  # of k
        assert not joined[-1]  # of classes that differ in several fields


def test_levels_of_one_state_dimension_are_comparable(analysis):
    results = analysis.tables["results"]
    alike = with_tables(analysis, results=results[results.state_dim == 8])
    for tables, remarked in ((analysis, True), (alike, False)):
        (picture,) = figures.draw([figures.draw_regions], tables, ())
        assert ("not comparable" in picture.caption) == remarked


def test_an_axis_with_a_single_class_has_no_figure(finished):
    two = analysed(finished, lambda planned: planned.class_name not in ("default", "k-25"))
    pictures = figures.draw([curves.draw_learning_curves], two, ())
    assert [picture.name for picture in pictures] == ["learning-curves-k"]


def test_a_method_has_one_colour_in_every_figure_and_a_legend_explains_hollow_marks(analysis):
    plan = analysis.file.plan
    beta = plan.model_copy(update={"algorithms": plan.algorithms[1:]})
    file = analysis.file.model_copy(update={"plan": beta})
    alone = analyse(file, analysis.cells, coloured=plan.algorithms, draws=10)
    assert looks_of(alone)["Beta"] == looks_of(analysis)["Beta"]
    assert looks_of(alone)["Beta"]["color"] != looks_of(analysis)["Alpha"]["color"]
    picture = figures.draw((figures.draw_contrasts,), analysis, ())[0]
    texts = [text.get_text() for legend in picture.figure.legends for text in legend.get_texts()]
    assert FEW.lower() in texts  # Beta has three pairs on k-25


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1, 2, 5, 10], "log"),
        ([0, 0.1, 1], "linear"),
        ([1, 10], "linear"),
        (["individual", "team"], "nominal"),
        ([], "nominal"),
    ],
)
def test_an_axis_has_the_scale_on_which_its_values_are_evenly_spaced(values, expected):
    assert spacing(values) == expected


def test_classes_have_equal_distances_on_their_scale():
    assert np.allclose(positions([1, 2, 4, 8], 4), np.log([1, 2, 4, 8]))
    assert list(positions([0.25, 0.5, 0.75], 3)) == [0.25, 0.5, 0.75]
    assert list(positions(["a", "b"], 2)) == [0.0, 1.0]

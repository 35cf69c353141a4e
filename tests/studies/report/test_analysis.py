"""The tables of a study: the numbers of its finished runs; missing runs are part of none."""

import re

import numpy as np
import pytest

from sme_registry import statistics
from sme_registry.spec import StudyPlan
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report import tables
from sme_registry.studies.report.design import ALL, SEVERAL, class_infos
from sme_registry.studies.report.frames import window
from sme_registry.studies.report.tables import analyse
from tests.studies.finished import analysed, rows_of

TABLES = (
    "learning_curves", "regions", "levels", "contrasts", "aggregates", "profiles", "improvements",
)  # fmt: skip


@pytest.fixture(scope="module")
def study(finished, analysis):
    return analysis.file, Ledger(finished).results(), analysis


def regrets(study, class_name, algorithm):
    file, results, _ = study
    return {
        cell.run: results[cell.cell.digest].report.regions[0].normalised_regret
        for cell in file.plan.cells
        if (cell.class_name, cell.algorithm) == (class_name, algorithm)
        and cell.cell.digest in results
    }


def contrast(analysis, class_name, algorithm, metric):
    at = {"class_name": class_name, "algorithm": algorithm, "metric": metric}
    (row,) = rows_of(analysis.tables["contrasts"], **at).itertuples()
    return row


def test_missing_runs_are_counted_and_named(study):
    analysis = study[2]
    assert list(analysis.tables["missing"].itertuples(index=False, name=None)) == [
        ("k-25", "Beta", 3, "ValueError: <b>bad</b>"),
        ("k-25", "Beta", 4, ""),
    ]
    rows = analysis.tables["counts"].itertuples(index=False, name=None)
    counts = {count[:2]: count[2:] for count in rows}
    assert counts["k-25", "Beta"] == (3, 1, 5)
    assert counts["default", "Alpha"] == (5, 0, 5)
    assert len(analysis.runs) == analysis.tables["counts"].done.sum() == 73


def test_a_class_has_the_axis_in_which_it_differs_from_the_first(study):
    classes = study[2].classes
    assert [(info.axis, info.label) for info in classes.values()] == [
        ("", ""),
        ("k", "k = 25"),
        ("r_min", "r_min = 0.5"),
        ("complexity", "L = 10"),  # policy_init differs, too: it goes with the depth
        (SEVERAL, "S = 2, A = 2, L = 10"),
    ]


def infos_of(*settings):
    classes = [{"name": f"c{i}", "setting": each, "seeds": [0]} for i, each in enumerate(settings)]
    plan = StudyPlan.from_dict({"classes": classes, "algorithms": [{"name": "A", "uses": "PPO"}]})
    return [(info.axis, info.label) for info in class_infos(plan).values()]


def test_the_levels_of_shaping_are_an_axis_of_numbers():
    levels = infos_of({}, *({"shaping": {"scale": c}, "complexity": 1} for c in (30, 3)))
    assert levels == [("", ""), ("shaping.scale", "c = 30"), ("shaping.scale", "c = 3")]


def test_limits_and_observations_are_axes():
    safe = {"safety": {"tightness": 0.2}}
    assert infos_of({}, safe, safe | {"complexity": 10}) == [
        ("", ""),
        ("safety.tightness", "τ = 0.2"),
        (SEVERAL, "L = 10, τ = 0.2"),
    ]
    driven = {"distractors": 32, "dynamics": "driven"}
    mixed = {"mixing": "nonlinear", "mixing_depth": 3}
    seen = [{"observation": each} for each in (driven, mixed, driven | mixed)]
    assert infos_of({}, *seen)[1:] == [
        ("observation", "observation = 32 driven"),
        ("observation", "observation = nonlinear 3"),
        ("observation", "observation = 32 driven nonlinear 3"),
    ]
    assert infos_of({"observation": driven | {"dynamics": "noise"}}, *seen)[1:] == [
        ("observation.dynamics", "observation.dynamics = driven"),
        ("observation", "observation = nonlinear 3"),
        ("observation", "observation = 32 driven nonlinear 3"),
    ]


def test_a_contrast_pairs_runs_of_equal_number(study):
    before, after = regrets(study, "default", "Beta"), regrets(study, "k-25", "Beta")
    row = contrast(study[2], "k-25", "Beta", "wd_regret")
    assert sorted(after) == [0, 1, 2]
    assert row.pairs == 3
    assert row.change == pytest.approx(statistics.iqm([after[i] - before[i] for i in range(3)]))
    assert row.base == pytest.approx(statistics.iqm([before[i] for i in range(3)]))
    assert not row.enough_pairs
    assert row.verdict == "indication"


def test_contrasts_find_the_axis_that_each_learner_is_sensitive_to(study):
    analysis = study[2]
    for algorithm, class_name in (("Alpha", "r_min-0_5"), ("Beta", "k-25")):
        rows = rows_of(analysis.tables["contrasts"], algorithm=algorithm, metric="wd_regret")
        assert rows.class_name[rows.change.idxmax()] == class_name
    row = contrast(analysis, "r_min-0_5", "Alpha", "wd_regret")
    assert row.low > 0.2
    assert row.enough_pairs
    assert contrast(analysis, "r_min-0_5", "Alpha", "final_return").verdict == "worse"
    assert contrast(analysis, "r_min-0_5", "constant", "wd_regret").verdict == "open"


def test_a_reference_has_no_online_regret(study):
    analysis = study[2]
    assert analysis.learners == ("Alpha", "Beta")
    levels = rows_of(analysis.tables["levels"], class_name="default", metric="online_regret")
    assert set(levels.algorithm) == {"Alpha", "Beta"}


def test_one_run_has_no_interval(finished):
    alone = analysed(finished, lambda planned: planned.run > 0, draws=50)
    for table in (
        alone.tables["contrasts"],
        alone.tables["levels"],
        alone.tables["aggregates"],
        alone.tables["improvements"],
    ):
        assert len(table) > 0
        assert table[["low", "high"]].isna().all(axis=None)
    assert set(alone.tables["contrasts"].verdict) == {"open"}


def test_only_classes_with_runs_of_every_algorithm_are_compared(finished):
    cut = analysed(finished, lambda p: (p.class_name, p.algorithm) == ("plane", "Beta"), draws=50)
    assert cut.groups[0].name == ALL
    assert {*cut.groups[0].classes} - {*cut.groups[0].compared} == {"plane"}
    assert set(cut.tables["aggregates"][cut.tables["aggregates"].group == ALL].classes) == {4}


def test_a_profile_is_the_share_of_runs_above_each_threshold_as_a_mean_over_classes(study):
    analysis = study[2]
    at = {"group": ALL, "metric": "wd_regret", "algorithm": "Alpha"}
    rows = rows_of(analysis.tables["profiles"], **at)
    assert list(rows.threshold) == pytest.approx(np.arange(101) / 100)
    classes = [[*regrets(study, name, "Alpha").values()] for name in analysis.groups[0].compared]
    for row in rows.itertuples():
        shares = [np.mean(1.0 - np.array(values) > row.threshold) for values in classes]
        assert row.share == pytest.approx(np.mean(shares))


def test_curves_are_the_median_over_runs_then_smoothed(study):
    file, results, analysis = study
    at = {"class_name": "default", "algorithm": "Alpha", "measure": "episode_return"}
    curve = rows_of(analysis.tables["learning_curves"], **at)
    cells = [c.cell.digest for c in file.plan.cells if (c.class_name, c.algorithm) == (
        "default", "Alpha")]  # fmt: skip
    raw = 5.0 * np.median([results[key].curve.episode_return for key in cells], axis=0)  # T = 20
    assert set(curve.window) == {2}
    assert list(curve["median"]) == pytest.approx([raw[0], *((raw[1:] + raw[:-1]) / 2)])
    assert np.all((curve.q25 <= curve["median"]) & (curve["median"] <= curve.q75))


@pytest.mark.parametrize(("evaluations", "width"), [(1, 1), (40, 4), (100, 10), (400, 10)])
def test_the_window_is_at_most_ten_evaluations(evaluations, width):
    assert window(evaluations) == width


def test_without_results_the_tables_are_empty_and_without_the_first_class_the_contrasts(
    study, finished
):
    cut = analysed(finished, lambda planned: planned.class_name == "default", draws=50)
    assert cut.tables["contrasts"].empty
    assert len(cut.runs) == 73 - 15
    empty = analyse(study[0], {}, draws=50)
    assert empty.tables["results"].empty
    for name in TABLES:
        assert empty.tables[name].empty


def test_the_documentation_names_every_column_of_the_tables(study):
    documented = set(re.findall(r"\w+", str(tables.__doc__)))
    for name in (*TABLES, "counts", "missing"):
        assert not {*study[2].tables[name]} - documented

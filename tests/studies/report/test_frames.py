"""The finished runs of a study as tidy data frames, and two of its algorithms in pairs of runs."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from sme_registry import SMESpec, studies
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.statistics import iqm
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report import frames
from sme_registry.studies.report.design import ALL, metrics_of
from sme_registry.studies.report.frames import StudyFrames
from sme_registry.studies.report.texts import comparison_tables
from tests.commands import good
from tests.studies.finished import rows_of, study_file


@pytest.fixture(scope="module")
def loaded(finished):
    return studies.load(finished)


def test_results_have_one_row_per_run_and_region_in_the_plans_order(loaded):
    places = loaded.results[["class_name", "algorithm", "run", "region"]]
    assert len(places) == 73 * 3
    assert not places.duplicated().any()
    assert list(places.class_name.unique()) == [
        "default", "k-25", "r_min-0_5", "complexity-10", "plane",
    ]  # fmt: skip
    first = places[(places.class_name == "default") & (places.algorithm == "Alpha")]
    assert list(first.run) == [run for run in range(5) for _ in range(3)]
    assert list(first.region) == ["WD", "OOD 1", "OOD 2"] * 5


def test_every_row_has_the_numbers_of_its_report(finished, loaded):
    results = Ledger(finished).results()
    for row in loaded.results.itertuples():
        report = results[row.key].report
        (region,) = (region for region in report.regions if region.name == row.region)
        for field in set(type(region).model_fields) - {"name", "channels"}:
            assert getattr(row, field) == getattr(region, field)
        index = report.regions.index(region)
        linear = report.references["linear"][index]
        assert row.linear_normalised_regret == linear.normalised_regret
        assert row.constant_similarity == report.references["constant"][index].similarity
        assert (row.wd_regret, row.ood_regret) == (report.wd_regret, report.ood_regret)
        assert row.ood_decay == report.ood_decay
        spec = results[row.key].cell.spec
        assert (row.spec_digest, row.complexity, row.k) == (spec.digest, spec.complexity, spec.k)


def test_curves_have_one_row_per_evaluation(finished, loaded):
    results = Ledger(finished).results()
    runs = frames.runs_of(loaded.results).set_index(frames.RUN).key
    assert len(loaded.curves) == 73 * 20
    for place, rows in loaded.curves.groupby(frames.RUN):
        curve = results[runs[place]].curve
        assert tuple(rows.step) == curve.steps
        for field in ("episode_return", "regret", "similarity", "length"):
            assert tuple(rows[field]) == getattr(curve, field)


def test_final_return_is_in_percent_of_the_optimum(loaded):
    last = loaded.curves.groupby(frames.RUN).episode_return.apply(lambda x: x.iloc[-2:].mean())
    expected = frames.runs_of(loaded.results).set_index(frames.RUN).final_return
    assert np.allclose(last / 20 * 100, expected.reindex(last.index))


@pytest.mark.parametrize(
    ("study", "load"), [("finished", studies.load), ("lived", studies.load_streams)]
)
def test_every_column_is_documented_and_is_there_without_results(study, load, request, tmp_path):
    documented = set(re.findall(r"\w+", str(frames.__doc__)))
    folder = request.getfixturevalue(study)
    (tmp_path / "plan.json").write_bytes((folder / "plan.json").read_bytes())
    for empty, full in zip(load(tmp_path), load(folder), strict=True):
        assert not set(full) - documented
        assert len(empty) == 0
        pd.testing.assert_series_equal(empty.dtypes, full.dtypes)


def test_every_metric_is_a_column_of_its_frame(loaded):
    lives = frames.stream_frames([])
    for kind, table in (("life", lives.lives), ("visit", lives.visits), ("data", loaded.results)):
        assert {metric.key for metric in metrics_of(kind)} <= set(table)
    assert {m.key for m in metrics_of("run") if not m.needs} <= set(frames.runs_of(loaded.results))


def row(table, class_name, metric="wd_regret"):
    return rows_of(table, class_name=class_name, metric=metric).iloc[0]


def test_the_difference_is_that_of_runs_with_one_instance_and_seed(loaded):
    table = studies.compare(loaded, "Alpha", "Beta")
    runs = loaded.results.drop_duplicates(["class_name", "algorithm", "run"])
    regrets = runs[runs.class_name == "k-25"].pivot_table("wd_regret", "run", "algorithm")
    both = regrets[["Alpha", "Beta"]].dropna()
    found = row(table, "k-25")
    assert (found.pairs, found.enough_pairs, found.verdict) == (3, False, "indication")
    assert found.difference == pytest.approx(float(iqm(both.Alpha - both.Beta)))
    assert found.first_level == pytest.approx(float(iqm(both.Alpha)))
    assert found.low < found.difference < found.high < 0


def test_the_difference_the_other_way_round_is_its_mirror_image(loaded):
    one, other = (studies.compare(loaded, *pair) for pair in (("Alpha", "Beta"), ("Beta", "Alpha")))
    assert np.allclose(one.difference, -other.difference)
    assert np.allclose(one.low, -other.high)
    mirrored = {"better": "worse", "worse": "better", "open": "open", "indication": "indication"}
    assert list(other.verdict) == [mirrored[verdict] for verdict in one.verdict]


def test_a_single_pair_has_no_interval(loaded):
    first = StudyFrames(loaded.results[loaded.results.run == 0], loaded.curves)
    table = studies.compare(first, "Alpha", "Beta")
    assert table.low.isna().all()
    assert set(table.verdict) == {"open"}
    caption = comparison_tables(table)[0].caption
    assert caption.startswith("Single pairs of runs, without intervals; lower is better.")


def test_bad_names_are_refused(loaded, finished):
    with pytest.raises(UnknownNameError, match="Did you mean 'Alpha'"):
        studies.compare(loaded, "Alfa", "Beta")
    with pytest.raises(UnknownNameError, match="Did you mean 'wd_regret'"):
        studies.compare(loaded, "Alpha", "Beta", ["wd_regrt"])
    with pytest.raises(OptionError, match="given twice"):
        studies.compare(finished, "Alpha", "Alpha")
    unknown = StudyFrames(loaded.results.assign(online_regret=np.nan), loaded.curves)
    with pytest.raises(OptionError, match="'online_regret': has no value in the paired runs"):
        studies.compare(unknown, "Alpha", "Beta", ["wd_regret", "online_regret"])


def test_a_share_of_the_optimums_return_is_of_step_rewards_where_more_is_paid():
    plain = frames.share_of_optimum(SMESpec(horizon=50), [40.0], [0.1], [50.0])
    assert plain == pytest.approx([80.0])
    for block in ({"shaping": {"scale": 3.0}}, {"noise": {"reward": 1.0}}):
        shaped = frames.share_of_optimum(SMESpec(horizon=50, **block), [40.0], [0.1], [25.0])
        assert shaped == pytest.approx([45.0])


def test_a_metric_given_twice_is_compared_once(loaded):
    table = studies.compare(loaded, "Alpha", "Beta", ["wd_regret", "wd_regret"])
    assert comparison_tables(table)[0].frame["class"].is_unique


def test_an_algorithm_of_the_plan_without_runs_is_known(finished, tmp_path):
    for planned in study_file().plan.cells:
        if planned.algorithm == "Alpha":
            Ledger(tmp_path).write(Ledger(finished).result(planned.cell.digest))
    Ledger(tmp_path).write_plan(study_file())
    with pytest.raises(OptionError, match="no class has a run of both"):
        studies.compare(tmp_path, "Alpha", "Beta")


def test_the_command_writes_tables_and_figures(finished, tmp_path):
    pytest.importorskip("matplotlib")
    command = ["study", "compare", str(finished), "Alpha", "Beta", "--out", str(tmp_path), "--json"]
    assert json.loads(good(*command).stdout) == json.loads(
        (tmp_path / "differences.json").read_text()
    )
    assert {path.name for path in tmp_path.iterdir()} == {
        "differences.csv", "differences.json", "differences-wd-regret.tex",
        "differences-ood-regret.tex", "differences.png", "differences.pdf",
        "learning-curves-by-class.png", "learning-curves-by-class.pdf",
    }  # fmt: skip
    text = good(*command[:-3]).stdout
    assert "Alpha − Beta" in text
    assert "(n = 3)" in text
    few = "With fewer than 5 pairs on a class, an interval covers"
    assert few in " ".join(text.split())
    assert re.search(r"k-25 .*\(n = 3\).* indication", text)
    source = (tmp_path / "differences-wd-regret.tex").read_text()
    assert "\\label{tab:differences-wd-regret-Alpha-Beta}" in source
    (caption,) = re.findall(r"caption{(.*)}", source)
    for words in (
        "Difference of WD regret. IQM over ",
        r" pairs of runs, with 95 \% bootstrap interval; ",
        "lower is better. ",
        "dagger",
        "With fewer than 5, a result is an indication.",
    ):
        assert words in caption
    assert len(caption) < 260
    assert "class & Alpha & Beta & Alpha" in source


def test_pairs_that_share_an_instance_are_no_independent_draws_of_the_task(loaded):
    table = studies.compare(loaded, "Alpha", "Beta")
    assert (table.instances == table.pairs).all()
    assert "share an instance" not in comparison_tables(table)[0].note
    shared = loaded.results.assign(spec_digest=loaded.results.class_name)
    table = studies.compare(StudyFrames(shared, loaded.curves), "Alpha", "Beta")
    assert set(table[table.class_name != ALL].instances) == {1}
    (text, _) = comparison_tables(table)
    assert "share an instance" in text.note
    assert "share an instance" in text.caption


def test_all_classes_is_the_mean_of_the_classes(loaded):
    table = studies.compare(loaded, "Alpha", "Beta", ["ood_regret"])
    classes = table[table.class_name != ALL]
    total = row(table, ALL, "ood_regret")
    assert total.difference == pytest.approx(classes.difference.mean())
    assert total.pairs == classes.pairs.sum() == 23

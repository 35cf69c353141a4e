"""Studies of tasks with limits or distractors: their metrics, and what the layers keep."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

from sme_registry.errors import UnknownNameError
from sme_registry.evaluation.observation import LayerProbe
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.report import exports, frames
from sme_registry.studies.report.analysis import Analysis, analyse
from sme_registry.studies.report.compare import compare
from sme_registry.studies.report.frames import study_frames
from sme_registry.studies.report.tables import METRICS, layers
from tests.studies.cells import small_file

SMALL = {"state_dim": 2, "action_dim": 2}
FIELDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "safe": {"safety": {"tightness": 0.4}},
    "driven": {"observation": {"distractors": 3, "dynamics": "driven"}},
}
OF_SAFETY = {"wd_cost", "wd_safe_regret"}  # references do not train, so they have no online cost
OF_DISTRACTORS = {"distractor_regret", "wd_invariance"}


def finished(*names: str, state_r2: tuple[float, ...] = ()) -> tuple[Any, dict[str, Any]]:
    """A study of these classes under two references; runs with distractors have these probes."""
    classes = [{"name": n, "setting": SMALL | FIELDS[n], "seeds": [1, 2]} for n in names]
    algorithms = ["linear_least_squares", "constant"]
    file = small_file(seeds=2, algorithms=algorithms, classes=classes)
    results: dict[str, Any] = {}
    for planned in file.plan.cells:
        result = run_cell(planned.cell)
        assert result.report is not None
        if result.report.observation is not None:
            probes = tuple(
                LayerProbe(layer=i, units=5, state_r2=r2 + planned.run, distractor_r2=0.25)
                for i, r2 in enumerate(state_r2)
            )
            seen = result.report.observation.model_copy(update={"probes": probes})
            report = result.report.model_copy(update={"observation": seen})
            result = result.model_copy(update={"report": report})
        results[planned.cell.digest] = result
    return file, results


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return analyse(*finished("plain", "safe", "driven", state_r2=(-2.0, -1.0)), draws=200)


def test_the_metrics_of_a_class_are_those_that_its_tasks_have(analysis: Analysis) -> None:
    of_regret = {"wd_regret", "ood_regret", "ood_decay"}
    found = {
        name: set(rows.metric) - of_regret for name, rows in analysis.levels.groupby("class_name")
    }
    assert found == {"plain": set(), "safe": OF_SAFETY, "driven": OF_DISTRACTORS}
    assert set(analysis.contrasts.metric) == of_regret  # the first class has no others


def test_levels_are_the_iqm_of_the_reports(analysis: Analysis) -> None:
    costs = [
        result.report.safety.regions[0].cost
        for result in analysis.cells.values()
        if result.report is not None
        and result.report.safety is not None
        and result.cell.uses == "reference:linear_least_squares"
    ]
    (row,) = analysis.levels.query(
        "class_name == 'safe' and algorithm == 'linear_least_squares' and metric == 'wd_cost'"
    ).itertuples()
    assert row.iqm == pytest.approx(sum(costs) / 2)
    assert row.iqm > 0


def test_columns_of_a_run_are_those_of_the_cube_and_of_its_training() -> None:
    file, results = finished("safe", "driven")
    costs = {key: number / 100 for number, key in enumerate(results)}
    for planned in file.plan.cells:
        key = planned.cell.digest
        if planned.cell.spec.safety is not None:
            results[key] = results[key].model_copy(update={"online_cost": costs[key]})
        else:  # references do not see distractors
            report = results[key].report
            inside, *shells = report.observation.invariance
            invariance = (inside.model_copy(update={"invariance": 0.25}), *shells)
            seen = report.observation.model_copy(update={"invariance": invariance})
            report = report.model_copy(update={"observation": seen})
            results[key] = results[key].model_copy(update={"report": report})
    runs = frames.runs(study_frames(file.plan, results).results).set_index("key")
    for planned in file.plan.cells:
        key, report = planned.cell.digest, results[planned.cell.digest].report
        assert report is not None
        row = runs.loc[key]
        if report.safety is not None:
            inside = report.safety.regions[0]
            assert (row.online_cost, row.wd_cost) == (costs[key], inside.cost)
            assert row.wd_safe_regret == inside.safe_regret != inside.cost
        else:
            assert report.observation is not None
            assert row.wd_invariance == report.observation.invariance[0].invariance
            assert row.distractor_regret == report.distractor_regret


def test_differences_and_comparisons_have_the_metrics_too() -> None:
    file, results = finished("safe", "driven")
    frames = study_frames(file.plan, results)
    table = compare(frames, "constant", "linear_least_squares", ["wd_cost", "wd_invariance"])
    rows = {(row.metric, row.class_name): row for row in table.itertuples()}
    assert set(rows) == {("wd_cost", "safe"), ("wd_invariance", "driven")}
    assert rows["wd_cost", "safe"].verdict != "worse"  # ½ is within most limits
    plain, of_plain = finished("plain")
    with pytest.raises(UnknownNameError, match="metric='wd_cost': must be one of wd_regret"):
        compare(study_frames(plain.plan, of_plain), "constant", "linear_least_squares", ["wd_cost"])


def test_tables_for_people_show_them_and_what_the_layers_keep(analysis: Analysis) -> None:
    tables = {table.name: table.frame for table in exports.text_tables(analysis)}
    assert list(tables["levels-wd-cost"]["class"]) == ["safe"]
    assert tables["layers"].to_numpy().tolist() == [
        ["driven", "observation", "−1.50, 0.25", "−1.50, 0.25"],
        ["driven", "1", "−0.50, 0.25", "−0.50, 0.25"],
    ]
    assert "layers" in exports.csv_tables(analysis)


def test_what_layers_keep_is_the_iqm_over_runs() -> None:
    probes = pd.DataFrame({"run": range(4), "state_r2": [0.2, -100.0, 0.6, 0.4]})
    kept = layers(probes.assign(class_name="driven", algorithm="PPO", layer=0, distractor_r2=0.25))
    assert kept.state_r2.tolist() == pytest.approx([0.3])
    assert kept.runs.tolist() == [4]


def test_a_study_of_plain_tasks_has_none_of_them() -> None:
    plain = analyse(*finished("plain"), draws=200)
    assert plain.metrics == METRICS
    assert "layers" not in exports.csv_tables(plain)
    assert "layers" not in {table.name for table in exports.text_tables(plain)}

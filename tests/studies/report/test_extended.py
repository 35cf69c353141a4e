"""Studies of tasks with limits or distractors: their columns and metrics, and what layers keep."""

import re

import pandas as pd
import pytest

from sme_registry.errors import UnknownNameError
from sme_registry.evaluation.regions import LayerProbe
from sme_registry.spec import StudyPlan
from sme_registry.studies.cell import run_cell
from sme_registry.studies.report import frames, texts
from sme_registry.studies.report.design import metrics_of
from sme_registry.studies.report.frames import study_frames
from sme_registry.studies.report.tables import analyse, layers
from sme_registry.studies.report.write import compare
from tests.studies.cells import small_file
from tests.studies.finished import rows_of

FIELDS = {
    "plain": {},
    "safe": {"safety": {"tightness": 0.4}},
    "driven": {"observation": {"distractors": 3, "dynamics": "driven"}},
    "mixed": {"observation": {"mixing": "nonlinear"}},
}


@pytest.fixture(scope="module")
def study():
    """Two references on these classes; learners' costs, probes and sensitivity are made up."""
    small = {"state_dim": 2, "action_dim": 2}
    classes = [{"name": n, "setting": small | own, "seeds": [1, 2]} for n, own in FIELDS.items()]
    algorithms = ["linear", "constant"]
    file = small_file(seeds=2, algorithms=algorithms, classes=classes)
    results = {}
    for number, planned in enumerate(file.plan.cells):
        result = run_cell(planned.cell)
        report = result.report
        changes = {}
        if planned.class_name == "safe" and planned.algorithm == "constant":
            changes["online_cost"] = number / 100
        if report.observation is not None and planned.class_name == "driven":
            probes = tuple(
                LayerProbe(layer=i, units=5, state_r2=r2 + planned.run, distractor_r2=0.25)
                for i, r2 in enumerate((-2.0, -1.0))
            )
            inside, *shells = report.observation.sensitivity
            sensitivity = (inside.model_copy(update={"sensitivity": 0.25}), *shells)
            seen = {"probes": probes, "sensitivity": sensitivity}
            observation = report.observation.model_copy(update=seen)
            changes["report"] = report.model_copy(update={"observation": observation})
        results[planned.cell.digest] = result.model_copy(update=changes)
    return file, results


@pytest.fixture(scope="module")
def analysis(study):
    return analyse(*study, draws=200)


def only(study, name):
    """The study of this class alone; results of the others are ignored."""
    file, results = study
    fields = file.plan.to_dict()
    fields["classes"] = [each for each in fields["classes"] if each["name"] == name]
    return file.model_copy(update={"plan": StudyPlan.from_dict(fields)}), results


def test_rows_have_the_numbers_of_their_reports(study):
    file, results = study
    rows = study_frames(file.plan, results).results
    documented = set(re.findall(r"\w+", str(frames.__doc__)))
    assert not set(rows) - documented
    runs = frames.runs_of(rows).set_index("key")
    for key, of_run in rows.groupby("key"):
        result, run = results[key], runs.loc[key]
        safety, observation = result.report.safety, result.report.observation
        if safety is not None:
            for name in ("cost", "violating_share", "safe_regret", "price_of_safety"):
                assert list(of_run[name]) == [getattr(each, name) for each in safety.regions]
            inside = safety.regions[0]
            assert (run.wd_cost, run.wd_safe_regret) == (inside.cost, inside.safe_regret)
            assert inside.safe_regret != inside.cost
            if result.online_cost is not None:
                assert run.online_cost == result.online_cost
        if observation is not None and run.class_name == "driven":
            assert list(of_run.sensitivity) == [
                each.sensitivity for each in observation.sensitivity
            ]
            assert run.wd_sensitivity == 0.25
            assert run.distractor_regret == result.report.distractor_regret
    assert rows[rows.class_name == "safe"].cost.max() > 0
    of_class = runs.drop_duplicates("class_name").set_index("class_name")
    assert of_class.tightness.dropna().to_dict() == {"safe": 0.4}
    assert of_class.compensated.dropna().to_dict() == {"safe": False}
    assert of_class.distractors.dropna().to_dict() == {"driven": 3, "mixed": 0}
    assert of_class.dynamics.dropna().to_dict() == {"driven": "driven"}
    assert of_class.mixing.dropna().to_dict() == {"driven": "none", "mixed": "nonlinear"}
    assert of_class.mixing_depth.dropna().to_dict() == {"mixed": 1}
    assert of_class.distractor_regret.dropna().index.to_list() == ["driven"]
    trained = runs[runs.online_cost.notna()]  # references do not train
    assert set(zip(trained.class_name, trained.algorithm, strict=True)) == {("safe", "constant")}


def test_the_metrics_of_a_class_are_those_that_its_tasks_have(study, analysis):
    of_regret = {"wd_regret", "ood_regret", "ood_decay"}
    metrics = {
        name: set(rows.metric) - of_regret
        for name, rows in analysis.tables["levels"].groupby("class_name")
    }
    assert metrics == {
        "plain": set(),
        "safe": {"wd_cost", "wd_safe_regret", "online_cost"},
        "driven": {"distractor_regret", "wd_sensitivity"},
        "mixed": set(),
    }
    assert set(analysis.tables["contrasts"].metric) == of_regret  # the first class has no others
    costs = [
        result.report.safety.regions[0].cost
        for result in study[1].values()
        if result.report is not None
        and result.report.safety is not None
        and result.cell.uses == "reference:linear"
    ]
    at = {"class_name": "safe", "algorithm": "linear", "metric": "wd_cost"}
    (row,) = rows_of(analysis.tables["levels"], **at).itertuples()
    assert row.iqm == pytest.approx(sum(costs) / 2)
    assert row.iqm > 0


def test_comparisons_have_the_metrics_too(study):
    file, results = study
    pair = "constant", "linear"
    table = compare(study_frames(file.plan, results), *pair, ["wd_cost", "wd_sensitivity"])
    rows = {(row.metric, row.class_name): row for row in table.itertuples()}
    assert set(rows) == {("wd_cost", "safe"), ("wd_sensitivity", "driven")}
    assert rows["wd_cost", "safe"].verdict != "worse"  # ½ is within most limits
    plain = study_frames(only(study, "plain")[0].plan, results)
    with pytest.raises(UnknownNameError, match="metric='wd_cost': must be 'wd_regret'"):
        compare(plain, *pair, ["wd_cost"])


def test_tables_for_people_show_them_and_what_the_layers_keep(study, analysis):
    tables = {table.name: table.frame for table in texts.text_tables(analysis)}
    assert list(tables["levels-wd-cost"]["class"]) == ["safe"]
    assert tables["layers"].to_numpy().tolist() == [
        ["driven", "observation", "−1.50, 0.25", "−1.50, 0.25"],
        ["driven", "1", "−0.50, 0.25", "−0.50, 0.25"],
    ]
    assert "layers" in texts.csv_tables(analysis)
    plain = analyse(*only(study, "plain"), draws=200)
    assert plain.parts[0].metrics == tuple(m for m in metrics_of("run") if not m.needs)
    assert "layers" not in texts.csv_tables(plain)
    assert "layers" not in {table.name for table in texts.text_tables(plain)}


def test_what_layers_keep_is_the_iqm_over_runs():
    probes = pd.DataFrame({"run": range(4), "state_r2": [0.2, -100.0, 0.6, 0.4]})
    kept = layers(probes.assign(class_name="driven", algorithm="PPO", layer=0, distractor_r2=0.25))
    assert kept.state_r2.tolist() == pytest.approx([0.3])
    assert kept.runs.tolist() == [4]

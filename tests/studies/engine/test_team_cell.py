"""Cells of teams: one model for all agents, or one for each, and the regret of every agent."""

import json

import numpy as np
import pytest

from sme_registry import load, studies
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report.texts import csv_tables, text_tables
from sme_registry.studies.result import CellResult
from tests.studies.finished import analysed

pytest.importorskip("stable_baselines3")

AGENTS = ["agent_0", "agent_1"]


def plan(*uses):
    settings = {"hyperparameters": {"n_steps": 8, "batch_size": 16, "n_epochs": 1}, "steps": None}
    setting = {name: value for name, value in load("Team2").to_dict().items() if name != "seed"}
    return StudyPlan.from_dict(
        {
            "classes": [
                {"name": "team", "setting": setting, "seeds": [1, 2]},
                {"name": "single", "setting": {"horizon": 20}, "seeds": [1]},
            ][: 1 if any("independent" in each for each in uses) else 2],
            "algorithms": [
                {"name": each.replace(":", " "), "uses": each}
                | (settings if "PPO" in each else {"steps": 0})
                for each in uses
            ],
            "seeds": 2,
            "steps": 128,
            "evaluations": 2,
            "evaluation_episodes": 2,
            "protocol": {"states_per_region": 50, "epsilons": [1.0]},
        }
    )


def cell(uses):
    return next(each.cell for each in plan(uses).cells if each.class_name == "team")


@pytest.mark.parametrize("uses", ["PPO", "independent:PPO", "reference:linear"])
def test_a_team_has_the_regret_of_each_agent(uses):
    result = run_cell(cell(uses))
    assert list(result.report.agents) == list(result.curve.agents_regret) == AGENTS
    of_agents = np.array(list(result.curve.agents_regret.values()))
    assert np.allclose(of_agents.mean(axis=0), result.curve.regret)
    if uses == "reference:linear":
        assert result.agents_online_regret == {}
    else:
        assert result.curve.steps == (64, 128)
        online = np.mean(list(result.agents_online_regret.values()))
        assert online == pytest.approx(result.online_regret)
    assert CellResult.from_dict(json.loads(json.dumps(result.to_dict()))) == result
    if uses == "independent:PPO":  # the same again
        again = run_cell(cell(uses))
        assert (again.curve, again.report) == (result.curve, result.report)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A study of references on a team and on a single agent."""
    folder = tmp_path_factory.mktemp("mixed")
    document = plan("reference:linear", "reference:constant")
    ledger = Ledger(folder)
    ledger.write_plan(StudyFile(name="mixed", digest=document.digest, plan=document))
    for planned in document.cells:
        ledger.write(run_cell(planned.cell))
    return folder


def test_the_frames_have_columns_of_each_agent(mixed):
    results, curves = studies.load(mixed)
    team, single = (results[results.class_name == name] for name in ("team", "single"))
    for name in AGENTS:
        assert single[f"wd_regret/{name}"].isna().all()
        wd = team[team.region == "WD"]
        assert np.array_equal(wd[f"wd_regret/{name}"], wd[f"normalised_regret/{name}"])
        assert curves[curves.class_name == "team"][f"regret/{name}"].between(0, 1).all()
    assert curves[curves.class_name == "single"]["regret/agent_0"].isna().all()
    for result in Ledger(mixed).results().values():
        document, of_team = result.to_dict(), result.cell.spec.team is not None
        assert ("agents_regret" in document["curve"]) == ("agents" in document["report"]) == of_team
        assert "agents_online_regret" not in document


def test_the_report_has_a_table_and_a_figure_of_the_agents(mixed):
    pytest.importorskip("matplotlib")
    from sme_registry.studies.report.figures import draw, draw_agents

    analysis = analysed(mixed)
    tables = {table.name: table.frame for table in text_tables(analysis)}
    assert list(tables["agents-wd-regret"].agent) == AGENTS
    assert "agents" in csv_tables(analysis)
    (picture,) = draw([draw_agents], analysis, ("svg",))
    assert b"team, agent_1" in picture.files["svg"]

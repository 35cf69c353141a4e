"""Trainers work in hidden tasks as they do in others: SB3's, this project's, and the page's."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from sme_registry import seasons
from sme_registry.errors import OptionError, SealedError
from sme_registry.sb3 import SMEVecEnv
from sme_registry.seasons.sb3 import SealedVecEnv
from sme_registry.seasons.wire import StepsAnswer
from sme_registry.training.models import new_model
from tests.leaderboard.seasons.playing import ROWS
from tests.seasons.server import BUDGET, serving_season

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    with serving_season(tmp_path_factory.mktemp("season")) as server:
        yield server


@pytest.fixture
def server(season):
    season.start()
    return season


def test_an_sb3_batch_is_stepped_as_the_same_task_is_here(server):
    task, seed = server.hidden(0).spec, server.seed(0)
    here, hidden = SMEVecEnv(task, 3), SealedVecEnv(server.url, server.ticket, 0, 3)
    here.seed(seed)
    assert hidden.action_space == here.action_space
    assert hidden.observation_space == here.observation_space
    assert np.array_equal(here.reset(), hidden.reset())
    assert hidden.reset_infos == [{}] * 3
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3, 2))
    for unit in (0.5 * (actions + 1)).astype(np.float32).astype(float):
        local, remote = here.step(2 * unit - 1), hidden.step(2 * unit - 1)
        for ours, theirs in zip(local[:3], remote[:3], strict=True):
            assert np.array_equal(ours, theirs)
            assert ours.dtype == theirs.dtype
        for ours, theirs in zip(local[3], remote[3], strict=True):
            assert theirs["TimeLimit.truncated"] == ours["TimeLimit.truncated"]
            assert ("terminal_observation" in theirs) == ("terminal_observation" in ours)
            assert theirs.keys() <= {"TimeLimit.truncated", "terminal_observation"}
            if "terminal_observation" in theirs:
                assert np.array_equal(theirs["terminal_observation"], ours["terminal_observation"])
    hidden.set_options({"state": [0, 0, 0]})
    with pytest.raises(OptionError, match="the server draws"):
        hidden.reset()


def test_an_episode_that_terminates_at_the_horizon_is_not_cut(server, monkeypatch):
    hidden = SealedVecEnv(server.url, server.ticket, 0, 3)
    observation = hidden.reset()
    terminated, truncated = np.array([True, False, True]), np.array([True, True, False])
    steps = StepsAnswer(observation, np.zeros(3, np.float32), terminated, truncated, observation)
    monkeypatch.setattr(hidden.instance, "step", lambda _: steps)
    *_, dones, infos = hidden.step(np.zeros((3, 2)))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True, False]


def test_this_project_s_trainers_learn_and_their_models_answer(server):
    env = SealedVecEnv(server.url, server.ticket, 0, 4)
    settings = {"learning_starts": 48}
    model = new_model("SAC", env, seed=0, steps=64, hyperparameters=settings)
    model.learn(64)
    assert env.instance.number == 16
    seasons.answer(server.url, server.ticket, model, 0)
    assert server.answers(0).shape == (ROWS, 2)
    with pytest.raises(SealedError, match="instance_phase"):  # no more steps after the answers
        model.learn(64)


def test_the_page_on_seasons_leads_from_a_ticket_to_its_end(server, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    server.ticket.model_copy().write("ticket.json")
    page = (ROOT / "docs" / "guides" / "seasons.md").read_text()
    page = page.split("## Take part online")[1]
    [block] = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    assert "n_steps=256" in block
    block = block.replace("n_steps=256", f"n_steps={BUDGET // 8}, n_epochs=1")
    exec(compile(block.replace("https://board.example", server.url), "page", "exec"), {})
    with seasons.Instance(server.url, server.ticket) as first:
        used = [each.used for each in first.status().instances]
        assert used == [BUDGET, BUDGET, 8]
        command = re.search(r"^sme-leaderboard (answer .*)$", page, re.M)[1]
        words = shlex.split(command.replace("https://board.example", server.url))
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        assert first.status().phase == "ended"

"""Golden steps, teacher-forced: the map is chaotic, so a long rollout would compare nothing.

The numbers are made by `python -m tests.golden.regenerate`.
"""

import importlib.util
import json

import numpy as np
import pytest

from sme_registry.task.engine import engine
from sme_registry.task.loading import load_task
from tests.compiled.stepping import Lane
from tests.golden import regenerate

STEPS = json.loads((regenerate.FOLDER / "one_step.json").read_text())


def numbers(hexes):
    return np.array([float.fromhex(text) for text in hexes])


def test_the_golden_tasks_are_those_of_the_command():
    assert tuple(STEPS) == regenerate.TASKS
    rewards = [case["step_reward"] for cases in STEPS.values() for case in cases]
    assert sum(0.0 < reward < 1.0 for reward in rewards) >= len(STEPS)


@pytest.mark.parametrize("name", STEPS)
def test_the_definition_and_every_engine_take_the_golden_steps(name):
    task, engines = load_task(name), ["numpy"]
    if importlib.util.find_spec("numba"):
        engines.append("numba")
    for case in STEPS[name]:
        s, a = numbers(case["state"]), numbers(case["action"])
        np.testing.assert_array_equal(task.transition(s, a), numbers(case["next_state"]))
        best, similarity = task.optimal_action(s), task.similarity(s, a)
        found = [(best, similarity, task.step_reward(s, a))]
        for backend in engines:
            done = Lane(task, engine(task, backend), s).step(a)
            np.testing.assert_array_equal(done.state, numbers(case["next_state"]))
            found.append((done.optimal_action, done.similarity, done.step_reward))
        for best, similarity, step_reward in found:
            np.testing.assert_allclose(best, case["optimal_action"], rtol=0, atol=1e-9)
            assert similarity == pytest.approx(case["similarity"], rel=0, abs=1e-9)
            assert step_reward == pytest.approx(case["step_reward"], rel=0, abs=1e-8)


def test_the_command_refuses_to_change_what_is_released(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(regenerate, "FOLDER", tmp_path)
    monkeypatch.setattr(regenerate, "TASKS", ("Plane10-v1",))
    assert regenerate.main([]) == 0
    assert regenerate.main([]) == 0
    released = (tmp_path / "digests.json").read_text()
    steps = (tmp_path / "one_step.json").read_text()

    (tmp_path / "digests.json").write_text(released.replace("sha256:", "sha256:0", 1))
    assert regenerate.main([]) == 1
    assert "A released name never changes" in capsys.readouterr().out

    (tmp_path / "digests.json").write_text(released)
    changed = json.loads(steps)
    changed["Plane10-v1"][0]["similarity"] += 1e-15
    (tmp_path / "one_step.json").write_text(json.dumps(changed))
    assert regenerate.main([]) == 1
    assert regenerate.main(["--change-dynamics"]) == 0
    assert (tmp_path / "one_step.json").read_text() == steps

"""The order of steps, evaluations and updates of a run; names and hyperparameters."""

from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("jax")

from sme_registry import SMESpec
from sme_registry.jax.program import Evaluation, Program, StepLog
from sme_registry.jax.run import ALGORITHMS, run, settings_of
from sme_registry.spec import StreamSpec

SPECS = (SMESpec(state_dim=2), SMESpec(state_dim=2, seed=1))


class Nothing(NamedTuple):
    weights: dict[str, Any]


class Scripted(Program):
    """Takes no steps but counts them, and records the order of its calls."""

    def __init__(self, budget, rollout=1, specs=SPECS):
        super().__init__((), specs, (0, 1), steps=budget, runs=3)
        self.rollout, self.events, self.updates = rollout, list[Any](), 0
        self.lifetimes = list[Any]()

    @staticmethod
    def initial_weights(settings, rng, observation_dim, action_dim):
        return {"bias": np.zeros(1, np.float32)}

    def initial_state(self, weights, keys):
        return Nothing(weights)

    @staticmethod
    def act(settings, weights, observations, symmetric):
        raise NotImplementedError

    def advance(self, limit):
        before = self.steps
        while self.steps < limit:
            self.updates = self.steps // self.rollout  # the one that was left pending
            self.steps += self.rollout
        return StepLog(*[np.zeros((self.steps - before, self.runs))] * 5)

    def finish(self):
        self.updates = self.steps // self.rollout
        self.events.append("finish")

    def evaluate(self, states, lifetime=None):
        """The sum of each initial state as the return."""
        self.events.append(("evaluate", states.shape))
        self.lifetimes.append(lifetime)
        return Evaluation(*[states.sum(axis=-1)] * 4)


def scripted_run(program, due, **changes):
    """Rows of an evaluation's index, its step, updates before it, and the return of run 1."""
    rows = []

    def on_evaluation(k, step, evaluation):
        assert evaluation.length.shape == (3, 2)
        assert (evaluation.episode_return[2] == evaluation.episode_return[0]).all()  # a copy
        rows.append((k, step, program.updates, evaluation.episode_return[1].tolist()))

    run(
        program,
        due=due,
        start_states=lambda k: [np.full((2, 2), k / 2), np.full((2, 2), (10 + k) / 2)],
        on_log=lambda log: program.events.append(("steps", len(log.reward))),
        on_evaluation=on_evaluation,
        **changes,
    )
    return rows


def test_evaluations_precede_the_update_of_their_step_and_the_last_one_follows_all():
    """The state may be saved after each piece and its evaluations."""
    program = Scripted(budget=10)
    saved = program.events
    due = [2, 3, 10]
    rows = scripted_run(program, due, piece=4, after_piece=lambda: saved.append(program.steps))
    assert rows == [(0, 2, 1, [10, 10]), (1, 3, 2, [11, 11]), (2, 10, 10, [12, 12])]
    one = ("evaluate", (3, 2, 2))
    assert saved == [
        ("steps", 2), one, 2, ("steps", 1), one, 3, ("steps", 4), 7, ("steps", 3), 10, "finish",
        one,
    ]  # fmt: skip
    restored = Scripted(budget=10)
    restored.steps = 5
    assert [row[:2] for row in scripted_run(restored, [2, 5, 7, 10])] == [(2, 7), (3, 10)]
    without_steps = Scripted(budget=0)
    rows = scripted_run(without_steps, [0, 0])
    assert [row[:3] for row in rows] == [(0, 0, 0), (1, 0, 0)]
    assert "finish" not in without_steps.events


def test_evaluations_in_one_rollout_run_together_always_as_many():
    program = Scripted(budget=20, rollout=8)
    rows = scripted_run(program, [0, 1, 8, 9, 16, 20])
    assert [row[:3] for row in rows] == [
        (0, 0, 0), (1, 1, 0), (2, 8, 0), (3, 9, 1), (4, 16, 1), (5, 24, 3),
    ]  # fmt: skip
    assert [row[3][0] for row in rows] == [10, 11, 12, 13, 14, 15]
    assert {event for event in program.events if event[0] == "evaluate"} == {
        ("evaluate", (3, 4, 2))
    }


def stream(seed):
    tasks = [SMESpec(state_dim=2, horizon=1, seed=i, k=1 + i) for i in (seed, 2)]
    return StreamSpec(phases=[{"spec": spec, "steps": 5} for spec in tasks], cycles=2)


def test_evaluations_are_of_the_task_on_which_their_step_was_taken():
    program = Scripted(budget=20, rollout=8, specs=[stream(0), stream(1)])
    rows = scripted_run(program, [0, 1, 5, 6, 7, 20])
    assert [row[1] for row in rows] == [0, 1, 5, 6, 7, 24]
    assert program.lifetimes == [0, 0, 5, 23]
    assert [program.lives.at(lifetime).k[0] for lifetime in (4, 5, 9, 10, 23)] == [1, 3, 3, 1, 3]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_actor_of_each_algorithm_is_all_that_acts(name):
    _, program = ALGORITHMS[name]
    settings = settings_of(f"jax:{name}", {"policy_kwargs": {"net_arch": [3]}})
    weights = program.initial_weights(settings, np.random.default_rng(0), 4, 2)
    actor = {each: weights[each] for each in weights if each.startswith(program.actor)}
    observations = np.linspace(0.0, 1.0, 8, dtype=np.float32).reshape(2, 4)
    expected, actions = (program.act(settings, w, observations, True) for w in (weights, actor))
    np.testing.assert_array_equal(actions, expected)
    assert not [each for each in actor if "critic" in each or "value" in each or "target" in each]

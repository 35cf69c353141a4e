"""The order of steps, evaluations and updates of a run; names and hyperparameters."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("jax")

from sme_registry import SMESpec
from sme_registry.errors import OptionError
from sme_registry.jax.program import Evaluation, Program, StepLog
from sme_registry.jax.run import new_program, run

SPECS = (SMESpec(state_dim=2), SMESpec(state_dim=1))


class Nothing(NamedTuple):
    weights: dict[str, Any]


class Scripted(Program):
    """Takes no steps but counts them, and records the order of its calls."""

    def __init__(self, budget: int, rollout: int = 1) -> None:
        super().__init__((), SPECS, (0, 1), steps=budget, lanes=3)
        self.rollout, self.events, self.updates = rollout, list[Any](), 0

    @staticmethod
    def initial_weights(settings: Any, rng: Any, observation_dim: int, action_dim: int) -> Any:
        return {"bias": np.zeros(1, np.float32)}

    def initial_state(self, weights: Any, keys: Any) -> Nothing:
        return Nothing(weights)

    @staticmethod
    def act(settings: Any, weights: Any, observations: Any, symmetric: bool) -> Any:
        raise NotImplementedError

    def advance(self, limit: int) -> StepLog:
        before = self.steps
        while self.steps < limit:
            self.updates = self.steps // self.rollout  # the one that was left pending
            self.steps += self.rollout
        return StepLog(*[np.zeros((self.steps - before, self.lanes))] * 5)

    def finish(self) -> None:
        self.updates += 1
        self.events.append("finish")

    def evaluate(self, states: Any) -> Evaluation:
        """The sum of each initial state as the return."""
        self.events.append(("evaluate", states.shape))
        return Evaluation(*[states.sum(axis=-1)] * 4)


def scripted_run(program: Scripted, due: list[int], **changes: Any) -> list[Any]:
    """Rows of an evaluation's index, its step, updates before it, and the return of lane 1."""
    rows: list[Any] = []

    def on_evaluation(k: int, step: int, evaluation: Evaluation) -> None:
        assert evaluation.length.shape == (3, 2)
        assert (evaluation.episode_return[2] == evaluation.episode_return[0]).all()  # a copy
        rows.append((k, step, program.updates, evaluation.episode_return[1].tolist()))

    run(
        program,
        due=due,
        start_states=lambda k: [np.full((2, 2), k), np.full((2, 1), 10 + k)],
        on_log=lambda log: program.events.append(("steps", len(log.reward))),
        on_evaluation=on_evaluation,
        **changes,
    )
    return rows


def test_evaluations_precede_the_update_of_their_step_and_the_last_one_follows_all() -> None:
    program = Scripted(budget=10)
    rows = scripted_run(program, [2, 3, 10], piece=4)
    assert rows == [(0, 2, 1, [10, 10]), (1, 3, 2, [11, 11]), (2, 10, 10, [12, 12])]
    one = ("evaluate", (3, 2, 2))
    assert program.events == [
        ("steps", 2), one, ("steps", 1), one, ("steps", 4), ("steps", 3), "finish", one,
    ]  # fmt: skip


def test_evaluations_in_one_rollout_run_together_always_as_many() -> None:
    program = Scripted(budget=20, rollout=8)
    rows = scripted_run(program, [0, 1, 8, 9, 16, 20])
    assert [row[:3] for row in rows] == [
        (0, 0, 0), (1, 1, 0), (2, 8, 0), (3, 9, 1), (4, 16, 1), (5, 24, 3),
    ]  # fmt: skip
    assert [row[3][0] for row in rows] == [10, 11, 12, 13, 14, 15]
    assert {event for event in program.events if event[0] == "evaluate"} == {
        ("evaluate", (3, 4, 2))
    }


def test_a_restored_run_goes_on_after_the_evaluations_that_are_done() -> None:
    program = Scripted(budget=10)
    program.steps = 5
    assert [row[:2] for row in scripted_run(program, [2, 5, 7, 10])] == [(2, 7), (3, 10)]


def test_a_run_without_steps_is_only_evaluated() -> None:
    program = Scripted(budget=0)
    assert [row[:3] for row in scripted_run(program, [0, 0])] == [(0, 0, 0), (1, 0, 0)]
    assert "finish" not in program.events


def test_the_state_may_be_saved_after_each_piece_and_its_evaluations() -> None:
    program = Scripted(budget=10)
    saved = program.events
    scripted_run(program, [5, 10], piece=3, after_piece=lambda: saved.append(program.steps))
    one = ("evaluate", (3, 2, 2))
    assert saved == [
        ("steps", 3), 3, ("steps", 2), one, 5, ("steps", 3), 8, ("steps", 2), 10, "finish", one,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"action_range": "foo"}, "action_range='foo': must be 'unit' or 'symmetric'"),
        ({"specs": (), "seeds": ()}, r"len\(specs\)=0: must be an integer of at least 1"),
        ({"seeds": (0,)}, r"len\(seeds\)=1: must be .*Give a seed of each task"),
        ({"seeds": (0, -1)}, r"seeds\[1\]=-1: must be"),
        ({"lanes": 1}, "lanes=1: must be an integer of at least 2"),
        ({"steps": -1}, "steps=-1: must be"),
    ],
)
def test_a_program_of_invalid_lanes_is_refused(change: dict[str, Any], message: str) -> None:
    arguments = {"specs": SPECS, "seeds": (0, 1), "steps": 10, **change}
    with pytest.raises(OptionError, match=message):
        new_program("jax:PPO", **arguments)

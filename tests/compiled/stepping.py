"""One way to call any engine, so that tests compare engines and not their calling conventions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sme_registry.task.task import BUFFER_STATE, BUFFER_VALUES, COST, REWARD


@dataclass
class Result:
    """What a step gave; of a batch the agents' numbers are `[B, n]`, of a lane they are scalars."""

    state: Any
    observation: Any
    optimal_action: Any
    similarity: Any
    step_reward: Any
    regret: Any
    reward: Any
    accumulated_reward: Any
    terminated: Any
    truncated: Any


class Lane:
    """One lane of a single agent: an episode stepped by an engine's single-lane entry points."""

    def __init__(self, task, engine, state, t=0, r_cum=0.0):
        self.task, self.engine = task, engine
        self.buffer, self.numbers = engine.new_buffer()
        self.numbers[BUFFER_STATE : BUFFER_STATE + len(state)] = state

    def step(self, action):
        """One step with a float32 or float64 action; None where it was refused."""
        A, S = self.task.spec.action_dim, self.task.spec.state_dim
        optimal, observation = np.empty(A), np.empty(S + 2, np.float32)
        entry = self.engine.step_one(action.dtype)
        reward, end = entry(self.buffer, action, optimal, observation)
        if end < 0:
            return None
        state = self.numbers[BUFFER_STATE : BUFFER_STATE + S].copy()
        values = self.numbers[BUFFER_VALUES : BUFFER_VALUES + COST].tolist()
        assert values[REWARD] == reward
        return Result(state, observation, optimal, *values, end in (1.0, 3.0), end >= 2.0)


def step_batch(task, engine, states, t, r_cum, actions):
    """One step of a batch: `states` `[B, S]`, `r_cum` `[B, n]`. None where it was refused."""
    B, S, A, n = len(states), task.spec.state_dim, task.spec.action_dim, len(task.names)
    moved, observation, optimal = (
        np.empty((S, B)),
        np.empty((B, S + 1 + n), np.float32),
        np.empty((1, B, A)),
    )
    own, values, ends = np.zeros((2, B)), np.empty((5, n, B)), np.empty((2, B), bool)
    if not engine.step_many()(
        np.ascontiguousarray(states.T), t.copy(), r_cum.T.copy(), own,
        actions, moved, observation, optimal, values, ends,
    ):  # fmt: skip
        return None
    return Result(moved.T, observation, optimal[0], *values.transpose(0, 2, 1), *ends)

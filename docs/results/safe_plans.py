"""Plans without cost that earn more than the safe projection, by search: METHOD, section 8.

    python docs/results/safe_plans.py

In each step, of many sequences of actions that keep every limit (the projection's, each moved a
little at random) the best begins, and the rest of it is one of the next step's sequences. With the
plain reward such plans earn more than the projection, so its price is only an upper bound on the
price of safety. With the compensated reward none earns more than the horizon.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from sme_registry import Task, load, materialize
from sme_registry.task import step

EPISODES, SEQUENCES, AHEAD = 20, 512, 8
SPREADS = 0.0, 0.01, 0.03, 0.1  # of the actions' moves


def planned(task: Task, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns `[B]` of the search, and the largest cost `[B]` of its steps."""
    rng = np.random.default_rng(seed)
    s = rng.random((EPISODES, task.spec.state_dim))
    earned, cost = np.zeros(EPISODES), np.zeros(EPISODES)
    shape = (EPISODES, SEQUENCES, AHEAD, task.spec.action_dim)
    spread = np.resize(SPREADS, SEQUENCES)[:, None, None]
    kept = np.zeros((EPISODES, AHEAD, task.spec.action_dim))
    for t in range(task.spec.horizon):
        moves = spread * rng.standard_normal(shape)
        moves[:, 0], moves[:, 1] = 0.0, kept  # the projection itself, and the last best sequence
        end = min(AHEAD, task.spec.horizon - t)
        states, totals = np.repeat(s, SEQUENCES, axis=0), 0.0
        for i in range(end):
            action = safe(task, states, moves[:, :, i].reshape(len(states), -1))
            totals = totals + reward(task, states, action)
            states = task.transition(states, action)
        best = np.reshape(totals, (EPISODES, SEQUENCES)).argmax(axis=1)
        chosen = moves[np.arange(EPISODES), best]
        action = safe(task, s, chosen[:, 0])
        earned += reward(task, s, action)
        cost = np.maximum(cost, task.cost(s, action))
        s = task.transition(s, action)
        kept = np.concatenate([chosen[:, 1:], np.zeros_like(chosen[:, :1])], axis=1)
    return earned, cost


def safe(task: Task, s: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The projection's actions, moved, and back within the limits."""
    limit = task.limit(s)
    return np.clip(np.minimum(task.optimal_action(s), limit) + moves, 0.0, limit)


def reward(task: Task, s: np.ndarray, action: np.ndarray) -> np.ndarray:
    """What one step pays, `[B]`, with the price where that is compensated."""
    begin, none = np.zeros(len(s), np.int64), np.zeros((len(s), 1))
    return step(task, s, begin, none, action).reward[:, 0]


def projected(task: Task, seed: int) -> np.ndarray:
    """Returns `[B]` of the projection in as many episodes."""
    s = np.random.default_rng(seed).random((EPISODES, task.spec.state_dim))
    earned = np.zeros(EPISODES)
    for _ in range(task.spec.horizon):
        action = task.safe_action(s)
        earned += reward(task, s, action)
        s = task.transition(s, action)
    return earned


def table() -> pd.DataFrame:
    """Mean returns of the projection and of plans, in % of the horizon."""
    rows = {}
    for name in ("Safety10", "Safety20", "Safety40", "CompensatedSafety20", "CompensatedSafety40"):
        task = materialize(load(name))
        percent = 100.0 / task.spec.horizon
        plans, cost = planned(task, 0)
        assert (cost == 0.0).all()
        by_projection = percent * projected(task, 0)
        rows[name] = {
            "projection": by_projection.mean(),
            "plan": percent * plans.mean(),
            "largest plan": percent * plans.max(),
            "bound on the price": 1.0 - by_projection.mean() / 100.0,
            "price that is left": 1.0 - percent * plans.mean() / 100.0,
        }
    return pd.DataFrame(rows).T.round(3)


if __name__ == "__main__":
    print(table().to_string())

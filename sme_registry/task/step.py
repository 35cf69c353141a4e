"""One step of a batch of episodes, in NumPy: the definition that every back-end must equal.

Source: METHOD, sections 1 and 5. `B` batch, `n` agents (a single agent is a team of one), `S`
state_dim, `A` action_dim, T horizon, t completed steps. Each agent i has its own r_i and r_cum:
r_i follows from the similarity over its own channels, or over all where the team is paid.

    r_cum ← r_cum + r(s, a);  s ← T(s, a);  t ← t + 1
    terminated = any r_i < D   truncated = t ≥ T
    R = r_cum where k divides t or truncated, else 0;  r_cum ← 0 after a payout
    observation = (s, t/T, r_cum/k of each agent), after the step

On termination alone nothing extra is paid; the lost reward stays visible as r_cum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.spec import SMESpec
from sme_registry.task.draw import Array
from sme_registry.task.task import Task


class Step(NamedTuple):
    """The result of one step of `B` environments, of the states acted in.

    Attributes:
      state: `[B, S]` next states.
      optimal_action: `[B, A]` π*.
      similarity: `[B, n]` r̃ over the agent's own channels.
      step_reward: `[B, n]` r.
      reward: `[B, n]` R, the payout.
      accumulated_reward: `[B, n]` r_cum, after a payout's reset.
      terminated: `[B]`.
      truncated: `[B]`.
    """

    state: Array
    optimal_action: Array
    similarity: Array
    step_reward: Array
    reward: Array
    accumulated_reward: Array
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]


def step(
    task: Task, s: Array, t: npt.NDArray[np.int64], accumulated_reward: Array, a: Array
) -> Step:
    """One step of `B` environments, from states `[B, S]` with finite actions `[B, A]`, clipped.

    `t` `[B]` are the steps completed and `accumulated_reward` `[B, n]` is r_cum before this one.
    Each environment is a matrix of one row to the oracle: a product of all at once would sum in an
    order that depends on B, and then a batch would not equal its singles bit for bit.

    Examples:
      >>> from sme_registry.task import load_task, step
      >>> task, states, begin = load_task("Default"), np.full((2, 8), 0.5), np.zeros(2, np.int64)
      >>> result = step(task, states, begin, np.zeros((2, 1)), task.optimal_action(states))
      >>> result.reward.ravel().tolist()
      [1.0, 1.0]
    """
    spec = task.spec
    a = np.clip(a, 0.0, 1.0)
    optimal = task.policy(s[:, None, :])[:, 0, :]
    similarity = task.similarities_of(a, optimal)
    paid_for = similarity
    if task.pays_the_team:
        paid_for = np.broadcast_to(task.similarity_of(a, optimal)[:, None], similarity.shape)
    step_reward = task.reward_of(paid_for)

    total = accumulated_reward + step_reward
    t = t + 1
    truncated = t >= spec.horizon
    paid = (truncated | (t % spec.k == 0))[:, None]
    return Step(
        state=task.transition(s, a),
        optimal_action=optimal,
        similarity=similarity,
        step_reward=step_reward,
        reward=np.where(paid, total, 0.0),
        accumulated_reward=np.where(paid, 0.0, total),
        terminated=np.asarray((step_reward < spec.D).any(axis=-1)),
        truncated=truncated,
    )


def observe(
    spec: SMESpec, s: Array, t: npt.NDArray[np.int64], accumulated_reward: Array
) -> npt.NDArray[np.float32]:
    """The joint observation, (s, t/T, r_cum/k of each agent), `[B, S + 1 + n]` float32.

    r_cum/k is at most 1: it exceeds 1 only where a stream carries r_cum over to a smaller k.
    A single agent observes all of it, an agent of a team only its part; see `envs.team`.

    Examples:
      >>> from sme_registry.task import load, observe
      >>> states, steps, rewards = np.full((2, 8), 0.5), np.array([0, 50]), np.zeros((2, 1))
      >>> observe(load("Default"), states, steps, rewards)[:, 8].tolist()
      [0.0, 0.5]
    """
    columns = [s, (t / spec.horizon)[:, None], np.minimum(accumulated_reward / spec.k, 1.0)]
    return np.concatenate(columns, axis=-1).astype(np.float32)

"""`step`: one step of `B` episodes by the equations of `task`, batch-first. This is the definition.

Source: METHOD, sections 1 and 5. Of n agents (a single agent is a team of one); t completed steps,
T horizon. Agent i's r_i follows from r̃ over its own channels, or over all where the team is paid:

    r_cum ← r_cum + r(s, a);  s ← T(s, a);  t ← t + 1
    terminated = any r_i < D   truncated = t ≥ T
    R = r_cum where k divides t or truncated, else 0;  r_cum ← 0 after a payout
    observation = (s, t/T, r_cum/k of each agent), after the step
    reward = R + (1 − r(s, a_safe) if compensated) + g P_t(s_t) − P_{t−1}(s_{t−1}) + σ_r ξ

On termination alone nothing extra is paid; the lost reward stays visible as r_cum.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.spec import SMESpec
from sme_registry.task.task import ACTIONS, NUMBERS, Array, Mask, Task


class Step(NamedTuple):
    """The result of one step of `B` environments, of the states acted in."""

    state: Array  # `[B, S]` next states
    optimal_action: Array  # `[B, A]` π*
    limit: Array  # `[B, A]` ℓ, 1 without `safety`
    safe_action: Array  # `[B, A]`
    similarity: Array  # `[B, n]` r̃ over the agent's own channels
    step_reward: Array  # `[B, n]` r
    regret: Array  # `[B, n]` 1 − r
    reward: Array  # `[B, n]` R, the payout, and what is paid on top
    accumulated_reward: Array  # `[B, n]` r_cum, after a payout's reset
    cost: Array  # `[B, 1]`, 0 without `safety`
    safe_regret: Array  # `[B, n]` r of the safe action − r
    price: Array  # `[B, 1]` 1 − r of the safe action, where that is paid; else 0
    shaping: Array  # `[B, n]` F, 0 without `shaping`
    reward_noise: Array  # `[B, n]` σ_r ξ, 0 without `noise`
    terminated: Mask  # `[B]`
    truncated: Mask  # `[B]`

    def write(self, actions: Array, values: Array) -> None:
        """Write the rows that `actions` `[1 or 3, B, A]` and `values` `[5 … 10, n, B]` have."""
        for row, name in zip(actions, ACTIONS, strict=False):
            row[:] = getattr(self, name)
        for row, name in zip(values, NUMBERS, strict=False):
            row[:] = getattr(self, name).T


def step(
    task: Task,
    s: Array,
    t: npt.NDArray[np.int64],
    accumulated_reward: Array,
    a: Array,
    noise: Array | None = None,
) -> Step:
    """One step of `B` environments, from states `[B, S]` with finite actions `[B, A]`, clipped.

    `t` `[B]` are the steps completed and `accumulated_reward` `[B, n]` is r_cum before this one;
    `noise` `[B, n + S]` ξ of each agent and ζ, None is 0.
    Each environment is a matrix of one row to the oracle: a product of all at once would sum in an
    order that depends on B, and then a batch would not equal its singles bit for bit.

    Examples:
      >>> from sme_registry.task import step
      >>> task = sme_registry.materialize(sme_registry.load("Default"))
      >>> states, begin = np.full((2, 8), 0.5), np.zeros(2, np.int64)
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

    limit = task._limit(s[:, None, :])[:, 0, :]
    safe_reward = task.safe_reward_of(optimal, limit)[:, None]

    total = accumulated_reward + step_reward
    before, t = t, t + 1
    truncated = t >= spec.horizon
    paid = (truncated | (t % spec.k == 0))[:, None]
    terminated = np.asarray((step_reward < spec.D).any(axis=-1))
    n = step_reward.shape[1]
    xi, zeta = (0.0, None) if noise is None else (noise[:, :n], noise[:, n:])
    state = task.transition(s, a, zeta)

    price = np.where(spec.compensated, 1.0 - safe_reward, 0.0)
    shaping: Array = np.zeros((len(s), 1))
    if spec.shaping is not None:
        later = np.where(terminated, 0.0, spec.shaping.discount * task.potential(state, t))
        shaping = (later - task.potential(s, before))[:, None]
    reward_noise = np.broadcast_to(task.sigmas[0] * xi, step_reward.shape)
    return Step(
        state=state,
        optimal_action=optimal,
        limit=limit,
        safe_action=np.minimum(optimal, limit),
        similarity=similarity,
        step_reward=step_reward,
        regret=1.0 - step_reward,
        reward=np.where(paid, total, 0.0) + price + shaping + reward_noise,
        accumulated_reward=np.where(paid, 0.0, total),
        cost=task.cost_of(a, limit)[:, None],
        safe_regret=safe_reward - step_reward,
        price=price,
        shaping=np.broadcast_to(shaping, step_reward.shape),
        reward_noise=reward_noise,
        terminated=terminated,
        truncated=truncated,
    )


def shaping_at_switch(before: Task, after: Task | None, s: Array, t: Any) -> float:
    """What F gains where another task, or None, is in force from the next step on: P of the other.

    Only so the shaping of an episode telescopes over a stream's tasks, and to an outer limit.
    """
    g = 1.0 if before.spec.shaping is None else before.spec.shaping.discount
    later = 0.0 if after is None else after.potential(s, t)
    return float(g * (later - before.potential(s, t)))


def observe(
    spec: SMESpec, s: Array, t: npt.NDArray[np.int64], accumulated_reward: Array
) -> npt.NDArray[np.float32]:
    """The joint observation, (s, t/T, r_cum/k of each agent), `[B, S + 1 + n]` float32.

    r_cum/k is at most 1: it exceeds 1 only where a stream carries r_cum over to a smaller k.

    Examples:
      >>> from sme_registry.task import load, observe
      >>> states, steps, rewards = np.full((2, 8), 0.5), np.array([0, 50]), np.zeros((2, 1))
      >>> observe(load("Default"), states, steps, rewards)[:, 8].tolist()
      [0.0, 0.5]
    """
    columns = [s, (t / spec.horizon)[:, None], np.minimum(accumulated_reward / spec.k, 1.0)]
    return np.concatenate(columns, axis=-1).astype(np.float32)

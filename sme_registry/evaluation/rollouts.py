"""`rollouts`: thousands of whole episodes of a policy in parallel, with their exact regret.

The returns are those of `stable_baselines3.common.evaluation.evaluate_policy` on single
environments that start in the same states, in about the time of one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.values import REGRET, REWARD, SIMILARITY
from sme_registry.envs.arguments import initial_states, single_agent
from sme_registry.envs.batch import Batch
from sme_registry.envs.types import Array, Observation
from sme_registry.evaluation.policies import Policy, TeamPolicy
from sme_registry.task import Task, streams

LANES = 4096
"""Most episodes in parallel, so that memory does not grow with their number."""


class Rollouts(NamedTuple):
    """Completed episodes; each array is `[n]`."""

    episode_return: Array
    discounted_return: Array
    length: Array
    regret: Array
    similarity: Array
    similarity_square: Array
    agents_regret: Array

    def per_step(self, values: Array) -> float:
        """The mean over all steps of all episodes, from the mean of each episode."""
        return float(np.average(values, weights=self.length))

    @property
    def similarity_sd(self) -> float:
        """The standard deviation of r̃ over all steps of all episodes."""
        variance = self.per_step(self.similarity_square) - self.per_step(self.similarity) ** 2
        return float(np.sqrt(max(0.0, variance)))


def start_states(seed: int, evaluation: int, episodes: int, state_dim: int) -> Array:
    """The initial states of an evaluation's episodes, from a random stream of their own."""
    stream = f"rollouts/{evaluation}/initial_state"
    return streams.uniform(seed, stream, episodes * state_dim).reshape(episodes, state_dim)


def rollouts(
    policy: Callable[[Observation], Any],
    task: Task,
    states: Array,
    *,
    t: npt.NDArray[np.int64] | None = None,
    r_cum: Array | None = None,
    actions: Array | None = None,
    gamma: float = 1.0,
    seed: int = 0,
) -> Rollouts:
    """Run an episode from each of the states to its end."""
    if not isinstance(policy, TeamPolicy):
        task = single_agent(task)
    n, agents = len(states), len(task.policies)
    states = initial_states(states, (n, task.spec.state_dim))
    t = np.zeros(n, np.int64) if t is None else t
    r_cum = np.zeros(n) if r_cum is None else r_cum
    totals = np.empty((6 + agents, n))
    # Sorted by t, the episodes of a batch end at about the same time, and few lanes idle.
    order = np.argsort(t, kind="stable")
    for begin in range(0, n, LANES):
        lanes = order[begin : begin + LANES]
        batch = Batch(task, len(lanes), reuse=True)
        batch.seed_by_states(np.arange(len(lanes)), states[lanes], seed)
        batch.place(states[lanes], t[lanes], np.repeat(r_cum[lanes, None], agents, axis=1))
        observation = batch.observe()
        act = _acting(policy)
        sums, running, weight = np.zeros((len(totals), len(lanes))), np.ones(len(lanes)), 1.0
        first = None if actions is None else actions[lanes]
        while running.any():
            a = act(observation.copy()) if first is None else first
            done = batch.advance(np.asarray(a, np.float64))
            similarity, regret, reward = _team_means(done.values[[SIMILARITY, REGRET, REWARD]])
            own = done.values[REGRET]
            step = (reward, weight * reward, 1.0, regret, similarity, similarity**2, *own)
            for total, value in zip(sums, step, strict=True):
                total += running * value
            weight *= gamma
            running[done.terminated | done.truncated] = 0.0
            observation, first = done.observation, None
        totals[:, lanes] = sums
    returns, discounted, length = totals[:3]
    regret, similarity, square, *of_agents = totals[3:] / length
    return Rollouts(returns, discounted, length, regret, similarity, square, np.array(of_agents))


def _acting(policy: Callable[[Observation], Any]) -> Callable[[Observation], Any]:
    """A policy at the start of a batch of episodes."""
    if isinstance(policy, TeamPolicy):
        return policy.act_in
    return policy.start() if isinstance(policy, Policy) else policy


def _team_means(values: Array) -> Array:
    """Means over agents, `[rows, n, B]` to `[rows, B]`; without a sum for a single agent."""
    return values[:, 0] if values.shape[1] == 1 else np.asarray(values.mean(axis=1))

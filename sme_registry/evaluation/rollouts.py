"""`play`, the loop of a policy in a batch, and `rollouts`, thousands of whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import single_agent
from sme_registry.envs.batch import Batch, BatchStep
from sme_registry.evaluation.policies import Policy, TeamPolicy
from sme_registry.task import Task, draw
from sme_registry.task.task import (
    REGRET,
    REWARD,
    SIMILARITY,
    Array,
    Indices,
    Mask,
    Observation,
)

MOST_ENVS = 4096
"""Most episodes in parallel, so that memory does not grow with their number."""


class PlayStep(NamedTuple):
    """A step of a batch: what it began from, the actions, and what came of them."""

    state: Array  # `[B, S]` float64
    distractors: Array  # `[B, m]`
    noise: Array  # `[B, n + S]` ξ and ζ of the step
    observation: Observation  # `[B, O]`, of all agents
    action: npt.NDArray[Any]  # `[B, A]` as the policy returned it
    running: Mask  # `[B]` whether the episode had not ended before
    result: BatchStep


def play(
    batch: Batch,
    act: Callable[[Array, Observation], npt.NDArray[Any]],
    begin: Callable[[Indices, Observation], None] | None = None,
) -> Iterator[PlayStep]:
    """Play the batch's episodes from where they are, until all have ended.

    `act` maps states `[B, S]` and observations `[B, O]` to joint actions `[B, A]` in [0, 1], also
    where episodes have ended. `begin` begins another one there, without end, and writes its rows of
    the observations. What a step holds is valid until the next one.
    """
    observation, running = batch.observe(), np.ones(batch.num_envs, bool)
    while running.any():
        state, distractors, noise = batch.state, batch.distractors, batch.noise
        action = act(state, observation)
        result = batch.advance(np.asarray(action, np.float64))
        yield PlayStep(state, distractors, noise, observation, action, running.copy(), result)
        observation, ended = result.observation, result.terminated | result.truncated
        if begin is None:
            running &= ~ended
        elif ended.any():
            begin(np.flatnonzero(ended), observation)


class Rollouts(NamedTuple):
    """Completed episodes; each array is `[n]`. The numbers of a team are means over its agents."""

    episode_return: Array  # sum of an episode's rewards, in [0, T]
    discounted_return: Array  # sum of γ^i times the i-th reward
    length: Array  # number of steps, in [1, T]
    regret: Array  # mean of 1 − step reward over its steps, in [0, 1]
    similarity: Array  # mean r̃ over its steps, in [0, 1]
    similarity_square: Array  # mean r̃² over its steps, in [0, 1]
    agents_regret: Array  # `[agents, n]` the same as `regret` for each agent

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
    return draw.uniform(seed, stream, episodes * state_dim).reshape(episodes, state_dim)


def rollouts(
    policy: Callable[[Observation], Any],
    task: Task,
    states: Array,
    *,
    t: npt.NDArray[np.int64] | None = None,
    r_cum: Array | None = None,
    distractors: Array | None = None,
    actions: Array | None = None,
    gamma: float = 1.0,
    seed: int = 0,
) -> Rollouts:
    """Run an episode from each of the states `[n, S]` to its end.

    After `t` `[n]` steps and with `r_cum` `[n]`, by default at the start; the first actions are
    `actions` `[n, A]`, by default the policy's. `seed` is of distractors that are not given, and of
    noise: episodes from equal states have equal ones. What a policy has as `bonus` `[n]` after a
    call, such as SAC's −α log π, is added to that step of the discounted return.
    """
    if not isinstance(policy, TeamPolicy):
        task = single_agent(task)
    n, agents = len(states), len(task.policies)
    t = np.zeros(n, np.int64) if t is None else t
    r_cum = np.zeros(n) if r_cum is None else r_cum
    totals = np.empty((6 + agents, n))
    # Sorted by t, the episodes of a batch end at about the same time, and few environments idle.
    order = np.argsort(t, kind="stable")
    for start in range(0, n, MOST_ENVS):
        rows = order[start : start + MOST_ENVS]
        batch = Batch(task, len(rows), reuse=True)
        batch.seed_by_states(np.arange(len(rows)), states[rows], seed)
        seen = None if distractors is None else distractors[rows]
        batch.place(states[rows], t[rows], np.repeat(r_cum[rows, None], agents, axis=1), seen)
        first = None if actions is None else actions[rows]
        totals[:, rows] = _sums(batch, _Acting(policy, first), gamma)
    returns, discounted, length = totals[:3]
    regret, similarity, square, *of_agents = totals[3:] / length
    return Rollouts(returns, discounted, length, regret, similarity, square, np.array(of_agents))


def _sums(batch: Batch, act: _Acting, gamma: float) -> Array:
    sums, weight = np.zeros((6 + len(batch.task.policies), batch.num_envs)), 1.0
    for step in play(batch, act):
        values = step.result.values
        similarity, regret, reward = _team_means(values[[SIMILARITY, REGRET, REWARD]])
        paid = weight * (reward + act.bonus)
        rows = (reward, paid, 1.0, regret, similarity, similarity**2, *values[REGRET])
        for total, value in zip(sums, rows, strict=True):
            total += step.running * value
        weight *= gamma
    return sums


class _Acting:
    """A policy at the start of a batch of episodes, which takes the `first` actions, if any."""

    def __init__(self, policy: Callable[[Observation], Any], first: Array | None) -> None:
        self._policy = policy.start() if isinstance(policy, Policy | TeamPolicy) else policy
        self._first = first
        self.bonus: Any = 0.0

    def __call__(self, state: Array, observation: Observation) -> npt.NDArray[Any]:
        action, self._first = self._first, None
        if action is not None:
            return action
        action = np.asarray(self._policy(observation.copy()))
        self.bonus = getattr(self._policy, "bonus", 0.0)
        return action


def _team_means(values: Array) -> Array:
    """Means over agents, `[rows, n, B]` to `[rows, B]`; without a sum for a single agent."""
    return values[:, 0] if values.shape[1] == 1 else np.asarray(values.mean(axis=1))

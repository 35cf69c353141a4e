"""`rollouts`: whole episodes of a policy, side by side in one batch, with their exact regret.

The same scores as `stable_baselines3.common.evaluation.evaluate_policy` gives on single
environments that begin in the same states, at the price of one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sme_registry.envs.batch import Array, Batch, Observation
from sme_registry.envs.options import initial_states, single_agent
from sme_registry.task import Task, streams


class Rollouts(NamedTuple):
    """Episodes that have ended, `[n]` each.

    Attributes:
      episode_return: the sum of an episode's rewards, in [0, T].
      length: its steps, in [1, T].
      mean_regret: mean of 1 − step reward over its steps, in [0, 1].
      similarity: mean r̃ over its steps, in [0, 1].
    """

    episode_return: Array
    length: Array
    mean_regret: Array
    similarity: Array

    def per_step(self, values: Array) -> float:
        """The mean over all steps of all episodes of what is given as each episode's mean."""
        return float(np.average(values, weights=self.length))


def start_states(seed: int, evaluation: int, episodes: int, state_dim: int) -> Array:
    """Where the episodes of an evaluation begin: new ones each time, from a stream of their own.

    A function of its arguments alone, so two algorithms that are trained with the same seed are
    evaluated from the same states, and evaluating moves no other random stream.

    Args:
      seed: of the run.
      evaluation: its number, from 0.
      episodes: n.
      state_dim: S.

    Returns:
      `[n, S]` uniform in (0, 1).
    """
    stream = f"rollouts/{evaluation}/initial_state"
    return streams.uniform(seed, stream, episodes * state_dim).reshape(episodes, state_dim)


def rollouts(policy: Callable[[Observation], Any], task: Task, states: Array) -> Rollouts:
    """An episode from each of the states, to its end.

    Args:
      policy: from observations `[n, S + 2]` to actions `[n, A]` of the unit range, which are
        clipped to it. It is asked for episodes that have ended too, until the last one has.
      task: the task, of a single agent.
      states: `[n, S]` in [0, 1].

    Raises:
      SpecError: the task is a team's.
      StateError: states of another shape, or outside the cube.
      ActionError: actions of another shape, or not finite.
    """
    task = single_agent(task)
    n = len(states)
    states = initial_states(states, (n, task.spec.state_dim))
    batch = Batch(task, n, reuse=True)
    observation = batch.observe()
    batch.begin(np.arange(n), observation, states)
    running, length, sums = np.ones(n), np.zeros(n), np.zeros((3, n))
    while running.any():
        done = batch.advance(np.asarray(policy(observation.copy()), np.float64))
        similarity, _, regret, reward, _ = done.values[:, 0]
        for total, value in zip(sums, (reward, regret, similarity), strict=True):
            total += running * value
        length += running
        running[done.terminated | done.truncated] = 0.0
        observation = done.observation
    return Rollouts(sums[0], length, sums[1] / length, sums[2] / length)

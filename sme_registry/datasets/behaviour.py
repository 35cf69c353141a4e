"""Behaviour policies: the policies that collect a data set, of a chosen quality.

    mixture of ν:  a = (1 − α) π*(s) + α ã(s),   α ~ U(0, ν), one draw for each step
    random:        a ~ U([0, 1]^A)
    policy:        the user's, deterministic

Source: METHOD, section 4. ã is a second Deep Uniform Network of the same shape as π* (for a team
one for each agent, on what it observes), drawn from the data's seed; one α mixes all channels. `B`
lanes, `S` state_dim, `A` action_dim, `n` agents.

All numbers depend on episode and step only: each episode reads its own part of a named stream, and
π* and ã are evaluated by the compiled step, whose bits do not depend on B. A user's policy is
called in blocks of one size, so that its network always multiplies matrices of the same shape.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.recipe import Behaviour, DatasetRecipe
from sme_registry.envs.batch import Batch
from sme_registry.envs.types import Observation
from sme_registry.evaluation import Policy, TeamPolicy, as_policy
from sme_registry.task import Task, draw
from sme_registry.task.draw import Array
from sme_registry.task.streams import bit_generator, to_uniform

NOISE_STREAM = "dataset/noise"
_AHEAD = 64  # steps whose random numbers an episode reads at once
_BLOCK = 64  # observations in one call of a user's policy


def noise_task(task: Task, seed: int) -> Task:
    """The task whose optimal policy is ã: of the same shape, drawn from the data's seed."""
    policies = draw.optimal_policies(task.spec.derive(seed=seed), NOISE_STREAM)
    return dataclasses.replace(task, policies=policies)


class OptimalPolicy:
    """π* as a function from states `[B, S]` to `[B, A]`, with the same bits in any batch."""

    def __init__(self, task: Task, lanes: int) -> None:
        self._batch = Batch(task, lanes, reuse=True)
        self._lanes = np.arange(lanes)
        self._observation = self._batch.observe()
        self._no_action = np.zeros((lanes, task.spec.action_dim))

    def __call__(self, s: Array) -> Array:
        """π*(s); the next call but one overwrites it."""
        self._batch.begin(self._lanes, self._observation, s)
        return self._batch.advance(self._no_action).optimal


class EpisodeStream:
    """Uniform numbers of a named stream, a separate part of it for each episode.

    Episode e reads from word 4 · 2¹²⁸ e onwards, so its numbers do not depend on its lane or on the
    other episodes.

    Args:
      seed: of the data.
      name: of the stream.
      lanes: B.
      width: numbers for each step.
      ahead: steps whose numbers are read at once.
    """

    def __init__(self, seed: int, name: str, lanes: int, width: int, ahead: int = _AHEAD) -> None:
        self._seed, self._name = seed, name
        self._generators: list[np.random.Philox | None] = [None] * lanes
        self._drawn = np.zeros((lanes, ahead, width))
        self._used = np.full(lanes, ahead)
        self._lanes = np.arange(lanes)

    def begin(self, lane: int, episode: int) -> None:
        """Start a lane at the first number of an episode."""
        generator = bit_generator(self._seed, self._name)
        generator.advance(episode << 128)
        self._generators[lane] = generator
        self._used[lane] = self._drawn.shape[1]

    def next(self, lanes: npt.NDArray[np.int64] | None = None) -> Array:
        """The next numbers of these lanes (None: all), `[len(lanes), width]` in (0, 1)."""
        lanes = self._lanes if lanes is None else lanes
        _, ahead, width = self._drawn.shape
        for lane in lanes[self._used[lanes] == ahead].tolist():
            generator = self._generators[lane]
            assert generator is not None  # `begin` comes first
            self._drawn[lane] = to_uniform(generator.random_raw(ahead * width)).reshape(ahead, -1)
            self._used[lane] = 0
        numbers: Array = self._drawn[lanes, self._used[lanes]]
        self._used[lanes] += 1
        return numbers


class BehaviourPolicy(Protocol):
    """A policy that acts in all lanes."""

    def begin(self, lane: int, episode: int) -> None:
        """Begin an episode in a lane."""

    def act(self, s: Array, observation: Observation) -> Array:
        """Actions `[B, A]` for states `[B, S]` and joint observations `[B, S + 1 + n]`."""


class _Mixture:
    def __init__(self, task: Task, seed: int, nu: float, stream: str, lanes: int) -> None:
        self._nu = nu
        self._optimal = OptimalPolicy(task, lanes)
        self._noise = OptimalPolicy(noise_task(task, seed), lanes) if nu > 0.0 else None
        self._alpha = EpisodeStream(seed, f"{stream}/alpha", lanes, 1)

    def begin(self, lane: int, episode: int) -> None:
        self._alpha.begin(lane, episode)

    def act(self, s: Array, observation: Observation) -> Array:
        optimal = self._optimal(s)
        if self._noise is None:
            return optimal
        alpha = self._nu * self._alpha.next()
        return (1.0 - alpha) * optimal + alpha * self._noise(s)


class _Random:
    def __init__(self, task: Task, seed: int, stream: str, lanes: int) -> None:
        self._actions = EpisodeStream(seed, f"{stream}/action", lanes, task.spec.action_dim)

    def begin(self, lane: int, episode: int) -> None:
        self._actions.begin(lane, episode)

    def act(self, s: Array, observation: Observation) -> Array:
        return self._actions.next()


class ConstantPolicy:
    """a = ½ in every channel."""

    def __init__(self, task: Task, lanes: int) -> None:
        self._half = np.full((lanes, task.spec.action_dim), 0.5)

    def begin(self, lane: int, episode: int) -> None:
        """No effect."""

    def act(self, s: Array, observation: Observation) -> Array:
        """½ in all entries."""
        return self._half


class UserPolicy:
    """A user's deterministic policy, clipped as the environment clips it.

    Args:
      policy: as returned by `as_policy`.
      state_dim: S.
    """

    def __init__(self, policy: Policy | TeamPolicy, state_dim: int) -> None:
        self._policy, self._state_dim = policy, state_dim

    def begin(self, lane: int, episode: int) -> None:
        """No effect: its actions depend on the observation only."""

    def act(self, s: Array, observation: Observation) -> Array:
        """Its actions `[B, A]` for joint observations `[B, S + 1 + n]`.

        Raises:
          PolicyError: the policy fails, or its actions are invalid.
        """
        if isinstance(self._policy, Policy):
            return np.clip(_in_blocks(self._policy, observation), 0.0, 1.0)
        S = self._state_dim
        joint = []
        for agent, member in enumerate(self._policy.members):
            # s, t/T and this agent's r_cum/k, of which it observes a part.
            single = observation[:, [*range(S + 1), S + 1 + agent]]
            acted = _in_blocks(member.policy, member.observe(single))
            joint.append(acted[:, : member.action_dim])
        return np.clip(np.concatenate(joint, axis=1), 0.0, 1.0)


def _in_blocks(policy: Callable[[Observation], Array], observation: Observation) -> Array:
    """The policy's actions, in calls of one size; the last row pads the last block."""
    rows = len(observation)
    missing = -rows % _BLOCK
    filled = np.concatenate([observation, np.repeat(observation[-1:], missing, axis=0)])
    blocks = [policy(filled[first : first + _BLOCK]) for first in range(0, len(filled), _BLOCK)]
    return np.concatenate(blocks)[:rows]


def behaviour_policy(
    recipe: DatasetRecipe,
    index: int,
    task: Task,
    lanes: int,
    policy: Any = None,
    stream: str = "dataset",
) -> BehaviourPolicy:
    """The policy of one of a recipe's behaviours.

    Args:
      recipe: the recipe.
      index: of the behaviour.
      task: the recipe's task.
      lanes: B.
      policy: for a behaviour of kind "policy": anything that `evaluate` accepts.
      stream: prefix of the names of its random streams.

    Raises:
      PolicyError, MissingDependencyError: the policy cannot be used.
    """
    behaviour: Behaviour = recipe.behaviours[index]
    stream = f"{stream}/{index}"
    if behaviour.nu is not None:
        return _Mixture(task, recipe.seed, behaviour.nu, stream, lanes)
    if behaviour.kind == "random":
        return _Random(task, recipe.seed, stream, lanes)
    prepared = as_policy(
        policy, recipe.spec, action_range=behaviour.action_range, name=behaviour.policy
    )
    return UserPolicy(prepared, recipe.spec.state_dim)

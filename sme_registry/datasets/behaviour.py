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

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.envs.batch import Batch
from sme_registry.envs.types import Observation
from sme_registry.evaluation import Policy, TeamPolicy, as_policy
from sme_registry.task import Task, draw
from sme_registry.task.draw import Array
from sme_registry.task.streams import bit_generator, to_uniform

NOISE_STREAM = "dataset/noise"
_AHEAD = 64  # steps whose random numbers an episode reads at once
_BLOCK = 64  # observations in one call of a user's policy


def noise_task(task: Task, seed: int | str) -> Task:
    """The task whose optimal policy is ã: of the same shape, drawn from the data's seed."""
    policies = draw.optimal_policies(task.spec.derive(seed=seed), NOISE_STREAM)
    return replace(task, policies=policies)


class OptimalPolicy:
    """π* as a function from states `[B, S]` to `[B, A]`, with the same bits in any batch."""

    def __init__(self, task: Task, lanes: int) -> None:
        plain = replace(task, spec=task.spec.derive(safety=None, observation=None))
        self._batch = Batch(plain, lanes, reuse=True)  # neither changes π*, and both take time
        self._lanes = np.arange(lanes)
        self._observation = self._batch.observe()
        self._no_action = np.zeros((lanes, task.spec.action_dim))

    def __call__(self, s: Array) -> Array:
        """π*(s); the next call but one overwrites it."""
        self._batch.begin(self._lanes, self._observation, s)
        return self._batch.advance(self._no_action).optimal


class EpisodeStream:
    """Uniform numbers of a named stream, `width` a step, a separate part of it for each episode.

    Episode e reads from word 4 · 2¹²⁸ e onwards, so its numbers do not depend on its lane or on the
    other episodes. Each lane reads those of `ahead` steps at once.
    """

    def __init__(
        self, seed: int | str, name: str, lanes: int, width: int, ahead: int = _AHEAD
    ) -> None:
        self._seed, self._name = seed, name
        self._generators: list[np.random.Philox | None] = [None] * lanes
        self._drawn = np.zeros((lanes, ahead, width))
        self._used = np.full(lanes, ahead)
        self._lanes = np.arange(lanes)

    def begin(self, lane: int, episode: int) -> None:
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


@dataclass(frozen=True)
class BehaviourPolicy:
    """A policy that acts in all lanes: actions `[B, A]` for states `[B, S]` and joint observations.

    `stream` has the random numbers that it uses; it is None if the policy is deterministic.
    """

    act: Callable[[Array, Observation], Array]
    stream: EpisodeStream | None = None

    def begin(self, lane: int, episode: int) -> None:
        if self.stream is not None:
            self.stream.begin(lane, episode)


def behaviour_policy(
    recipe: DatasetRecipe,
    index: int,
    task: Task,
    lanes: int,
    policy: Any = None,
    stream: str = "dataset",
) -> BehaviourPolicy:
    """The policy of a recipe's behaviour with this index; `policy` is the user's, for its kind."""
    behaviour, name = recipe.behaviours[index], f"{stream}/{index}"
    if behaviour.nu is not None:
        return _mixture(task, recipe.seed, behaviour.nu, name, lanes)
    if behaviour.kind == "random":
        actions = EpisodeStream(recipe.seed, f"{name}/action", lanes, task.spec.action_dim)
        return BehaviourPolicy(lambda s, observation: actions.next(), actions)
    prepared = as_policy(
        policy, recipe.spec, action_range=behaviour.action_range, name=behaviour.policy
    )
    return BehaviourPolicy(lambda s, observation: _actions(prepared, observation))


def constant_policy(task: Task) -> BehaviourPolicy:
    """a = ½ in every channel."""
    return BehaviourPolicy(lambda s, observation: np.full((len(s), task.spec.action_dim), 0.5))


def _mixture(task: Task, seed: int | str, nu: float, name: str, lanes: int) -> BehaviourPolicy:
    optimal = OptimalPolicy(task, lanes)
    noise = OptimalPolicy(noise_task(task, seed), lanes) if nu > 0.0 else None
    stream = EpisodeStream(seed, f"{name}/alpha", lanes, 1)

    def act(s: Array, observation: Observation) -> Array:
        if noise is None:
            return optimal(s)
        alpha = nu * stream.next()
        return (1.0 - alpha) * optimal(s) + alpha * noise(s)

    return BehaviourPolicy(act, stream)


def _actions(policy: Policy | TeamPolicy, observation: Observation) -> Array:
    """A user's actions `[B, A]` for joint observations, clipped as the environment clips them."""
    if isinstance(policy, Policy):
        return np.clip(_in_blocks(policy, observation), 0.0, 1.0)
    shared = observation.shape[1] - len(policy.members)  # s and t/T; then each agent's r_cum/k
    joint = []
    for agent, member in enumerate(policy.members):
        single = observation[:, [*range(shared), shared + agent]]
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

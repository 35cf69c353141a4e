"""`SealedEnv` and `SealedVectorEnv`: a hidden task as Gymnasium's environments."""

from __future__ import annotations

from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sme_registry.compiled.arrays import Action, Array, Mask, Observation
from sme_registry.envs import arguments
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.seasons.client import PATIENCE, Instance, TicketLike
from sme_registry.seasons.wire import Float32
from sme_registry.spec.sme_spec import ActionRange


class SealedVectorEnv(VectorEnv[Observation, Array, Array]):
    """The lanes of a hidden task, stepped together by the season's server.

    Spaces, rewards and ends of episodes are those of `SMEVectorEnv`, whose autoreset mode is
    "SameStep": an ended lane's observation is the first of its next episode, and the last of the
    ended one is in `infos["final_obs"]`. Seeds and resets are as in `SealedEnv`.

    Attributes:
      instance: the hidden task: its setting, budget, challenge and answers.

    Examples:
      >>> from sme_registry.seasons import Instance, SealedVectorEnv
      >>> envs = SealedVectorEnv(Instance("https://board.example", "ticket.json", lanes=4))
      >>> envs.num_envs
      4
    """

    def __init__(self, instance: Instance, action_range: ActionRange = "unit") -> None:
        self.instance = instance
        self.num_envs = instance.lanes
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        A, width = instance.setting.action_dim, instance.setting.state_dim + 2
        self.single_action_space, self._rescaled = arguments.action_space(action_range, A)
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._has_begun = False

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin, or go on with the present episodes."""
        first = arguments.checked_seed(seed[0] if isinstance(seed, list) else seed)
        if options:
            raise OptionError(
                f"options={options!r:.60}: must be None: the server draws the states at which "
                "episodes begin. Leave it out."
            )
        observation = self.instance.begin()
        self._has_begun = True
        super().reset(seed=first)
        return observation, {}

    def step(  # type: ignore[override]  # Gymnasium types all three arrays alike; ends are bool
        self, actions: Any
    ) -> tuple[Observation, Float32, Mask, Mask, dict[str, Any]]:
        """One step of every lane; actions that are not finite, or not `[L, A]`, are never sent."""
        if not self._has_begun:
            raise EpisodeError("step: the episodes have not begun. Call reset() first.")
        shape = self.num_envs, self.instance.setting.action_dim
        unit = arguments.to_unit(actions, shape, self._rescaled)
        if not np.isfinite(unit).all():
            raise arguments.not_finite_error()
        steps = self.instance.step(unit)
        ended: Mask = steps.terminated | steps.truncated
        infos: dict[str, Any] = {}
        if ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for lane in np.flatnonzero(ended):
                final[lane] = steps.last_observation[lane]
            infos = {"final_obs": final, "_final_obs": ended.copy()}
            infos |= {"final_info": {}, "_final_info": ended.copy()}
        return steps.observation, steps.reward, steps.terminated, steps.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Close the connection. The ticket stays valid."""
        self.instance.close()


class SealedEnv(gymnasium.Env[Observation, Action]):
    """A hidden task of a ticket, stepped by the season's server.

    Spaces, rewards and ends of episodes are those of `SMEEnv`; infos are empty. The server draws
    the initial states: `seed` seeds `np_random` only. `reset` within an episode does not end it: it
    returns the present observation, also in a new process that goes on where another one stopped.

    Attributes:
      instance: the hidden task: its setting, budget, challenge and answers.

    Examples:
      >>> from sme_registry.seasons import Instance, SealedEnv
      >>> env = SealedEnv(Instance("https://board.example", "ticket.json"), "symmetric")
      >>> float(env.action_space.low[0])
      -1.0
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, instance: Instance, action_range: ActionRange = "unit") -> None:
        self.instance = instance
        self._lane = SealedVectorEnv(instance, action_range)
        self.action_space = cast("gymnasium.Space[Action]", self._lane.single_action_space)
        self.observation_space = self._lane.single_observation_space
        self._next: Observation | None = None  # the first of the next episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode, or go on with the present one."""
        if self._next is None or options or seed is not None:
            [self._next] = self._lane.reset(seed=seed, options=options)[0]
        super().reset(seed=seed)
        observation, self._next = self._next, None
        return observation, {}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; an action that is not finite, or not `[A]`, is never sent."""
        if self._next is not None:
            raise EpisodeError("step: the episode has ended. Call reset() first.")
        [observation], [reward], [terminated], [truncated], infos = self._lane.step([action])
        if infos:
            self._next, observation = observation, infos["final_obs"][0]
        return observation, float(reward), bool(terminated), bool(truncated), {}

    def close(self) -> None:
        """Close the connection. The ticket stays valid."""
        self.instance.close()


def make(
    url: str,
    ticket: TicketLike,
    instance: int = 0,
    *,
    action_range: ActionRange = "unit",
    insecure: bool = False,
    patience: float = PATIENCE,
) -> SealedEnv:
    """An environment of a hidden task.

    Args:
      url: the board's.
      ticket: a ticket, or the path of its file.
      instance: its number in the ticket, from 0.
      action_range: "unit" for actions in [0, 1] or "symmetric" for [−1, 1].
      insecure: allow plain http to other machines, in a network that you trust.
      patience: seconds for which a request is repeated while the server gives no answer.

    Examples:
      >>> from sme_registry import seasons
      >>> env = seasons.make("https://board.example", "ticket.json")
      >>> env.observation_space.shape
      (10,)
    """
    hidden = Instance(url, ticket, instance, insecure=insecure, patience=patience)
    return SealedEnv(hidden, action_range)


def make_vec(
    url: str,
    ticket: TicketLike,
    instance: int = 0,
    num_envs: int = 1,
    *,
    action_range: ActionRange = "unit",
    insecure: bool = False,
    patience: float = PATIENCE,
) -> SealedVectorEnv:
    """A vector environment of a hidden task: `num_envs` lanes in one request.

    `num_envs` is at most the ticket's `lanes` and cannot be changed after the first step. The other
    arguments are those of `make`.

    Examples:
      >>> from sme_registry import seasons
      >>> envs = seasons.make_vec("https://board.example", "ticket.json", num_envs=4)
      >>> envs.observation_space.shape
      (4, 10)
    """
    hidden = Instance(url, ticket, instance, num_envs, insecure=insecure, patience=patience)
    return SealedVectorEnv(hidden, action_range)

"""`LanesVecEnv`: what does not depend on how the lanes of a `VecEnv` are stepped."""

from __future__ import annotations

from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.envs.types import Mask, Observation
from sme_registry.errors import EpisodeError, MissingDependencyError
from sme_registry.spec import SMESpec

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
except ImportError:
    raise MissingDependencyError(
        "sme_registry.sb3: Stable-Baselines3 is not installed. "
        "Run `pip install 'sme-registry[train]'`."
    ) from None

StepResult: TypeAlias = tuple[Observation, npt.NDArray[np.float32], Mask, list[dict[str, Any]]]
"""Observations, rewards, dones and infos."""


class LanesVecEnv(VecEnv):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """The part of a `VecEnv` that does not depend on how its lanes are stepped.

    Args:
      lanes: the lanes, each with its attributes, such as its spaces.
    """

    def __init__(self, lanes: list[Any]) -> None:
        self._lanes = lanes
        self._actions: npt.NDArray[Any] | None = None
        super().__init__(len(lanes), lanes[0].observation_space, lanes[0].action_space)

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is run, overrides included."""
        spec: SMESpec = self._lanes[0].sme_spec
        return spec

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Store the actions, a row for each lane, for `step_wait`."""
        self._actions = actions

    def _take_actions(self) -> npt.NDArray[Any]:
        """The actions stored by `step_async`, which are then cleared."""
        if self._actions is None:
            raise EpisodeError("step_wait: there are no actions. Call step_async(actions) first.")
        actions, self._actions = self._actions, None
        return actions

    def _clear_reset_arguments(self) -> None:
        """Forget seeds and options: every lane has begun an episode with them."""
        self.reset_infos = [{} for _ in self._lanes]
        self._reset_seeds()
        self._reset_options()

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each lane: `task`, `sme_spec`, `spec`, `state`, or one set before."""
        return [getattr(self._lanes[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each lane."""
        for i in self._get_indices(indices):
            setattr(self._lanes[i], attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of each lane, such as `reset` of a single agent's."""
        lanes = [self._lanes[i] for i in self._get_indices(indices)]
        return [getattr(lane, method_name)(*method_args, **method_kwargs) for lane in lanes]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """False for each lane: wrap the `VecEnv` instead, as `VecMonitor` does."""
        return [False for _ in self._get_indices(indices)]

"""`SMEVecEnv`: a batch of one task as a Stable-Baselines3 `VecEnv`, stepped by machine code.

    from stable_baselines3 import TD3
    from sme_registry.sb3 import SMEVecEnv
    TD3("MlpPolicy", SMEVecEnv("Default", num_envs=4)).learn(20_000)

The same numbers, bit for bit, as SB3's `DummyVecEnv` of as many single environments.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.envs import SMEVectorEnv
from sme_registry.envs.single import Observation
from sme_registry.errors import EpisodeError, MissingDependencyError
from sme_registry.registration import make_vec
from sme_registry.spec import SMESpec

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
except ImportError:
    raise MissingDependencyError(
        "sme_registry.sb3: Stable-Baselines3 is not installed. "
        "Run `pip install 'sme-registry[train]'`."
    ) from None

_SHARED = ("render_mode", "sme_spec", "spec", "task")


class _Lane:
    """What SB3 sees as one of the environments: shared attributes, and those set on it alone."""

    def __init__(self, batch: SMEVectorEnv, index: int) -> None:
        self._batch, self._index = batch, index
        self.observation_space = batch.single_observation_space
        self.action_space = batch.single_action_space
        for name in _SHARED:
            setattr(self, name, getattr(batch, name))

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """The lane's state, `[S]` (a copy)."""
        state: npt.NDArray[np.float64] = self._batch.state[self._index]
        return state

    @property
    def unwrapped(self) -> _Lane:
        """Itself, as environments without a wrapper have it."""
        return self

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in this lane alone; see `SMEEnv.reset`."""
        mask = np.arange(self._batch.num_envs) == self._index
        seeds = [seed if chosen else None for chosen in mask]
        observations, info = self._batch.reset(
            seed=seeds, options={**(options or {}), "reset_mask": mask}
        )
        return observations[self._index], info


class SMEVecEnv(VecEnv):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """`num_envs` lanes of one task for SB3's algorithms and `VecEnv` wrappers.

    As in SB3's own, a finished lane begins its next episode at once, its last observation is
    `terminal_observation` in its info, `TimeLimit.truncated` says whether only time had run out,
    and `seed(n)` seeds lane i with n + i at the next reset.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      num_envs: the lanes, at least 1.
      action_range: "symmetric", [−1, 1], what SB3's Gaussian policies are made for; or "unit".
      **overrides: spec fields to change.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: see `SMEVectorEnv`.
    """

    def __init__(
        self,
        spec_or_id: SMESpec | dict[str, Any] | str | os.PathLike[str],
        num_envs: int = 1,
        *,
        action_range: Literal["unit", "symmetric"] = "symmetric",
        **overrides: Any,
    ) -> None:
        batch = make_vec(
            spec_or_id,
            num_envs,
            vectorization_mode="vector_entry_point",
            autoreset_mode="SameStep",
            action_range=action_range,
            **overrides,
        )
        assert isinstance(batch, SMEVectorEnv)
        self._batch = batch
        self._lanes = [_Lane(batch, index) for index in range(num_envs)]
        self._actions: npt.NDArray[Any] | None = None
        super().__init__(num_envs, batch.single_observation_space, batch.single_action_space)

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is really run, overrides included."""
        return self._batch.sme_spec

    def reset(self) -> Observation:
        """Begin an episode in every lane, with the seeds and options set before.

        Returns:
          Observations, `[B, S + 2]` float32.

        Raises:
          StateError, OptionError: what `set_options` was given cannot be used.
        """
        if any(self._options):
            for lane, seed, options in zip(self._lanes, self._seeds, self._options, strict=True):
                observations = self._batch.reset(
                    seed=[seed if other is lane else None for other in self._lanes],
                    options={**options, "reset_mask": np.array([o is lane for o in self._lanes])},
                )[0]
        else:
            observations = self._batch.reset(seed=self._seeds)[0]
        self.reset_infos = [{} for _ in self._lanes]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions, `[B, A]`, that `step_wait` carries out."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[Observation, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """One step of every lane.

        Returns:
          Observations `[B, S + 2]`, rewards `[B]` float32, dones `[B]`, and each lane's info.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; nothing has moved then.
          EpisodeError: before the first reset.
        """
        if self._actions is None:
            raise EpisodeError("step_wait: no actions are waiting. Call step_async(actions) first.")
        actions, self._actions = self._actions, None
        observations, rewards, terminated, truncated, batched = self._batch.step(actions)
        dones = terminated | truncated
        infos = list(_infos(batched, truncated & ~terminated, dones))
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Nothing is held open."""
        self._batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each lane: `task`, `sme_spec`, `spec`, `state`, or one set before.

        Raises:
          AttributeError: the lanes have no such attribute.
        """
        return [getattr(self._lanes[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each lane.

        Raises:
          AttributeError: it cannot be set.
        """
        for i in self._get_indices(indices):
            setattr(self._lanes[i], attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of each lane, such as `reset`.

        Raises:
          AttributeError: the lanes have no such method.
        """
        lanes = [self._lanes[i] for i in self._get_indices(indices)]
        return [getattr(lane, method_name)(*method_args, **method_kwargs) for lane in lanes]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """False for each lane: wrap the `VecEnv` instead, as `VecMonitor` does."""
        return [False for _ in self._get_indices(indices)]


def _infos(
    batched: dict[str, Any], timed_out: npt.NDArray[np.bool_], dones: npt.NDArray[np.bool_]
) -> Iterator[dict[str, Any]]:
    """Each lane's info, from Gymnasium's batched form in mode SAME_STEP."""
    any_done = bool(dones.any())
    # Where lanes have ended, what belongs to their last step stands apart.
    last = batched["final_info"] if any_done else batched
    columns = {}
    for key, values in last.items():
        if key.startswith("_"):
            continue
        if any_done:
            mask = dones if values.ndim == 1 else dones[:, None]
            values = np.where(mask, values, batched[key])
        # Python's floats, as the single environment gives them; arrays row by row.
        columns[key] = values.tolist() if values.ndim == 1 else list(values)
    columns["TimeLimit.truncated"] = timed_out.tolist()
    for lane, row in enumerate(zip(*columns.values(), strict=True)):
        info = dict(zip(columns, row, strict=True))
        if dones[lane]:
            info["terminal_observation"] = batched["final_obs"][lane]
        yield info

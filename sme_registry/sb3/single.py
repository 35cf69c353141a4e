"""`SMEVecEnv`: lanes of a single agent's task, a native batch as a `VecEnv`."""

from __future__ import annotations

from typing import Any

import numpy as np

from sme_registry.envs import SMEVectorEnv
from sme_registry.envs.types import Mask, Observation
from sme_registry.registration import make_vec
from sme_registry.sb3.lanes import Lane, LanesVecEnv, StepResult, infos_by_lane
from sme_registry.spec import ActionRange, SpecLike


class _SingleLane(Lane):
    """A lane of a single agent's task, which can be reset alone."""

    _batch: SMEVectorEnv

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in this lane alone; see `SMEEnv.reset`."""
        mask = np.arange(self._batch.num_envs) == self._row
        seeds = [seed if chosen else None for chosen in mask]
        observations, info = self._batch.reset(
            seed=seeds, options={**(options or {}), "reset_mask": mask}
        )
        return observations[self._row], info


class SMEVecEnv(LanesVecEnv):
    """`num_envs` lanes of one task for SB3's algorithms and `VecEnv` wrappers.

    As in SB3's `VecEnv`s, a finished lane begins its next episode at once, its last observation is
    `terminal_observation` in its info, `TimeLimit.truncated` is True where it was truncated and
    not terminated, and `seed(n)` seeds lane i with n + i at the next reset.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      num_envs: the lanes, at least 1.
      action_range: "symmetric", [−1, 1], which suits SB3's Gaussian policies; or "unit".
      **overrides: spec fields to change.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: see `SMEVectorEnv`.
    """

    def __init__(
        self,
        spec_or_id: SpecLike,
        num_envs: int = 1,
        *,
        action_range: ActionRange = "symmetric",
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
        shared = {
            name: getattr(batch, name) for name in ("render_mode", "sme_spec", "spec", "task")
        }
        shared["observation_space"] = batch.single_observation_space
        shared["action_space"] = batch.single_action_space
        super().__init__([_SingleLane(batch, row, **shared) for row in range(num_envs)])

    def reset(self) -> Observation:
        """Begin an episode in every lane, with the seeds and options set before.

        Returns:
          Observations, `[B, S + 2]` float32.

        Raises:
          StateError, OptionError: the options of `set_options` are invalid.
        """
        if any(self._options):
            for lane, seed, options in zip(self._lanes, self._seeds, self._options, strict=True):
                observations = self._batch.reset(
                    seed=[seed if other is lane else None for other in self._lanes],
                    options={**options, "reset_mask": np.array([o is lane for o in self._lanes])},
                )[0]
        else:
            observations = self._batch.reset(seed=self._seeds)[0]
        self._clear_reset_arguments()
        return observations

    def step_wait(self) -> StepResult:
        """One step of every lane.

        Returns:
          Observations `[B, S + 2]`, rewards `[B]` float32, dones `[B]`, and each lane's info.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; no state has changed then.
          EpisodeError: before the first reset.
        """
        observations, rewards, terminated, truncated, batched = self._batch.step(
            self._take_actions()
        )
        dones = terminated | truncated
        last = batched.get("final_obs", observations)
        timed_out = truncated & ~terminated
        infos = list(infos_by_lane(_columns(batched, dones), timed_out, dones, last))
        return observations, rewards.astype(np.float32), dones, infos


def _columns(batched: dict[str, Any], dones: Mask) -> dict[str, list[Any]]:
    """Each key of Gymnasium's batched info in mode SAME_STEP, a value for each lane."""
    any_done = bool(dones.any())
    # Where lanes have ended, the values of their last step are in `final_info`.
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
    return columns

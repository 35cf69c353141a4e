"""A batch of one task as a Stable-Baselines3 `VecEnv`, stepped by machine code.

    from stable_baselines3 import PPO, TD3
    from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
    TD3("MlpPolicy", SMEVecEnv("Default", num_envs=4)).learn(20_000)
    PPO("MlpPolicy", SMETeamVecEnv("Team4", num_envs=8)).learn(20_000)  # one policy for all agents

The same numbers, bit for bit, as SB3's `DummyVecEnv` of as many single environments; of a team, as
the same number of `SMETeamEnv`s stepped in a loop.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.envs import SMEVectorEnv
from sme_registry.envs import actions as action_ranges
from sme_registry.envs.batch import Array, Batch, Mask
from sme_registry.envs.options import initial_states, refuse_unknown
from sme_registry.envs.shared import (
    shared_action_dim,
    shared_observation,
    shared_observation_dim,
)
from sme_registry.envs.single import Observation
from sme_registry.errors import EpisodeError, MissingDependencyError, OptionError
from sme_registry.registration import make_vec
from sme_registry.spec import SMESpec
from sme_registry.task import load_task

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
except ImportError:
    raise MissingDependencyError(
        "sme_registry.sb3: Stable-Baselines3 is not installed. "
        "Run `pip install 'sme-registry[train]'`."
    ) from None

__all__ = ["LanesVecEnv", "SMETeamVecEnv", "SMEVecEnv"]

_Stepped = tuple[Observation, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]


class _Lane:
    """What SB3 sees as one of the environments: shared attributes, and those set on it alone."""

    def __init__(self, batch: SMEVectorEnv | Batch, row: int, **shared: Any) -> None:
        self._batch, self._row = batch, row
        vars(self).update(shared)

    @property
    def state(self) -> Array:
        """The state that it is in, `[S]` (a copy); of a team's agent the team's."""
        state: Array = self._batch.state[self._row]
        return state

    @property
    def unwrapped(self) -> _Lane:
        """Itself, as environments without a wrapper have it."""
        return self


class _SingleLane(_Lane):
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


class LanesVecEnv(VecEnv):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """What a `VecEnv` does with its lanes, whatever steps them.

    Args:
      lanes: the lanes, each with its attributes, spaces among them.
    """

    def __init__(self, lanes: list[Any]) -> None:
        self._lanes = lanes
        self._actions: npt.NDArray[Any] | None = None
        super().__init__(len(lanes), lanes[0].observation_space, lanes[0].action_space)

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is really run, overrides included."""
        spec: SMESpec = self._lanes[0].sme_spec
        return spec

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions, a row for each lane, that `step_wait` carries out."""
        self._actions = actions

    def _waiting(self) -> npt.NDArray[Any]:
        """The actions to carry out, which are then gone."""
        if self._actions is None:
            raise EpisodeError("step_wait: no actions are waiting. Call step_async(actions) first.")
        actions, self._actions = self._actions, None
        return actions

    def _has_begun(self) -> None:
        """Every lane is at the start of an episode: seeds and options are used up."""
        self.reset_infos = [{} for _ in self._lanes]
        self._reset_seeds()
        self._reset_options()

    def close(self) -> None:
        """Nothing is held open."""

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


class SMEVecEnv(LanesVecEnv):
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
        self._has_begun()
        return observations

    def step_wait(self) -> _Stepped:
        """One step of every lane.

        Returns:
          Observations `[B, S + 2]`, rewards `[B]` float32, dones `[B]`, and each lane's info.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; nothing has moved then.
          EpisodeError: before the first reset.
        """
        observations, rewards, terminated, truncated, batched = self._batch.step(self._waiting())
        dones = terminated | truncated
        last = batched.get("final_obs", observations)
        infos = list(_infos(_columns(batched, dones), truncated & ~terminated, dones, last))
        return observations, rewards.astype(np.float32), dones, infos


class SMETeamVecEnv(LanesVecEnv):
    """`num_envs` teams of one task, each of their agents a lane: one policy for all agents.

    Lane e·n + i is agent i of team e. It sees its *shared observation* `[S + 2 + n]` in [0, 1]: the
    state with the channels that it does not observe set to 0, t/T, its own r_cum/k, and the one-hot
    of i. Its action is `[max a_i]`, of which its first a_i count. Reward and info are that agent's,
    with the keys of `SMEEnv`. All agents of a team end together, and the team begins its next
    episode at once. `seed(n)` seeds team e with n + e at the next reset. Options are given to every
    lane of a team alike.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path. One without a team is a
        team of one.
      num_envs: the teams, at least 1; `num_envs` of the VecEnv is the lanes, teams times agents.
      action_range: "symmetric", [−1, 1], or "unit", [0, 1].
      **overrides: spec fields to change.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: see `SMETeamEnv`.
    """

    def __init__(
        self,
        spec_or_id: SMESpec | dict[str, Any] | str | os.PathLike[str],
        num_envs: int = 1,
        *,
        action_range: Literal["unit", "symmetric"] = "symmetric",
        **overrides: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise OptionError(f"num_envs={num_envs!r}: must be an integer of at least 1.")
        task = load_task(spec_or_id, **overrides)
        self._width = shared_action_dim(task)
        action_space, self._rescaled = action_ranges.space(action_range, self._width)
        shape = (shared_observation_dim(task),)
        shared = {
            "render_mode": None, "spec": None, "sme_spec": task.spec, "task": task,
            "observation_space": gymnasium.spaces.Box(0.0, 1.0, shape, np.float32),
            "action_space": action_space,
        }  # fmt: skip
        self.num_teams, self.agents = num_envs, task.names
        self._task, self._batch, self._begun = task, Batch(task, num_envs), False
        # Whose action, and which of its entries, is each channel of the joint action.
        self._owner = np.repeat(np.arange(len(task.owned)), [o.stop - o.start for o in task.owned])
        self._entry = np.concatenate([np.arange(own.stop - own.start) for own in task.owned])
        super().__init__(
            [
                _Lane(self._batch, team, agent=name, **shared)
                for team in range(num_envs)
                for name in self.agents
            ]
        )

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed team e with seed + e at the next reset; None draws a seed.

        Returns:
          The seed of each lane, its team's.
        """
        first = list(super().seed(seed))
        self._seeds = [first[lane // len(self.agents)] for lane in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Observation:
        """Begin an episode in every team, with the seeds and options set before.

        Returns:
          Shared observations, `[B n, S + 2 + n]` float32.

        Raises:
          StateError, OptionError: what `set_options` was given cannot be used.
        """
        n, starts = len(self.agents), {}
        for team in range(self.num_teams):
            start = self._start(self._options[team * n : (team + 1) * n])
            if start is not None:
                starts[team] = start
        for team, seed in enumerate(self._seeds[::n]):
            if seed is not None:
                self._batch.initial_states.seed(team, seed)
        joint = self._batch.observe()
        for team in range(self.num_teams):
            self._batch.begin(np.array([team]), joint, starts.get(team))
        self._begun = True
        self._has_begun()
        return self._shown(joint)

    def _start(self, options: list[dict[str, Any]]) -> Array | None:
        """Where a team is to begin, `[1, S]`, by the options of its lanes; None draws it."""
        for lane in options:
            refuse_unknown(lane, ("state",))
        shape = (self._task.spec.state_dim,)
        given = [initial_states(lane["state"], shape) for lane in options if "state" in lane]
        if not given:
            return None
        if len(given) < len(options) or any((state != given[0]).any() for state in given):
            raise OptionError("options: a team has one state. Give the same to each of its lanes.")
        return given[0][None]

    def step_wait(self) -> _Stepped:
        """One step of every team.

        Returns:
          Shared observations `[B n, S + 2 + n]`, rewards `[B n]` float32, dones `[B n]`, infos.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; nothing has moved then.
          EpisodeError: before the first reset.
        """
        actions = self._waiting()
        if not self._begun:
            raise EpisodeError("step: the episode has not begun. Call reset() first.")
        B, n, width = self.num_teams, len(self.agents), self._width
        checked = action_ranges.checked(actions, (B * n, width), self._rescaled)
        # Finite also where an agent owns fewer channels and its last entries do not count.
        if not np.isfinite(checked).all():
            raise action_ranges.not_finite()
        joint = np.ascontiguousarray(checked.reshape(B, n, width)[:, self._owner, self._entry])
        done = self._batch.advance(joint)

        similarity, step_reward, regret, reward, accumulated = (
            agents.T.reshape(-1) for agents in done.values
        )
        optimal = action_ranges.to_range(done.optimal, self._rescaled)
        columns: dict[str, list[Any]] = {
            "optimal_action": [row[own] for row in optimal for own in self._task.owned],
            "similarity": similarity.tolist(),
            "step_reward": step_reward.tolist(),
            "regret": regret.tolist(),
            "accumulated_reward": accumulated.tolist(),
        }
        observations = last = self._shown(done.observation)
        ended: Mask = done.terminated | done.truncated
        if ended.any():
            self._batch.begin(np.flatnonzero(ended), done.observation)
            observations = self._shown(done.observation)
        dones = np.repeat(ended, n)
        timed_out = np.repeat(done.truncated & ~done.terminated, n)
        infos = list(_infos(columns, timed_out, dones, last))
        return observations, reward.astype(np.float32), dones, infos

    def _shown(self, joint: Observation) -> Observation:
        return shared_observation(self._task, joint).reshape(self.num_envs, -1)


def _columns(batched: dict[str, Any], dones: Mask) -> dict[str, list[Any]]:
    """Each key of Gymnasium's batched info in mode SAME_STEP, a value for each lane."""
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
    return columns


def _infos(
    columns: dict[str, list[Any]], timed_out: Mask, dones: Mask, last: npt.NDArray[Any]
) -> Iterator[dict[str, Any]]:
    """Each lane's info; `last` holds the last observations of those that are done."""
    columns = {**columns, "TimeLimit.truncated": timed_out.tolist()}
    for lane, row in enumerate(zip(*columns.values(), strict=True)):
        info = dict(zip(columns, row, strict=True))
        if dones[lane]:
            info["terminal_observation"] = last[lane]
        yield info

"""`SMEVectorEnv`: a batch of environments of one task or stream, stepped as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch
from sme_registry.envs.rendering import METADATA, Frame, batch_renderer, html_card
from sme_registry.envs.schedule import GymnasiumMixin, Schedule
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.io import choice, integer_in
from sme_registry.spec import SMESpec
from sme_registry.spec.catalogue import title
from sme_registry.spec.sme_spec import ActionRange, SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.task import Task
from sme_registry.task.task import REWARD, Array, Indices, Mask, Observation


class EnvView:
    """One environment of a batch: attributes that all share, and its own."""

    def __init__(self, owner: Any, index: int, **shared: Any) -> None:
        self._owner, self._index = owner, index
        vars(self).update(shared)

    @property
    def state(self) -> Array:
        return cast(Array, self._owner._batch.state[self._index])

    @property
    def distractors(self) -> Array:
        return cast(Array, self._owner._batch.distractors[self._index])

    @property
    def task(self) -> Task:
        """The task; of a stream the one in force."""
        return cast(Task, self._owner._batch.task_of(self._index))

    @property
    def sme_spec(self) -> SMESpec:
        return self.task.spec

    @property
    def unwrapped(self) -> EnvView:
        return self

    # As every Gymnasium environment has them; `VecEnv.env_method` calls them by name.
    def has_wrapper_attr(self, name: str) -> bool:
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        if force or hasattr(self, name):
            setattr(self, name, value)
        return hasattr(self, name)


class SMEVectorEnv(GymnasiumMixin, VectorEnv[Observation, Array, Array]):
    """`num_envs` environments of one task or stream, bit-equal to `SMEEnv`s with the same seeds.

    Spaces, rewards and `info` are those of `SMEEnv` with a leading axis `[B]`; as in Gymnasium each
    info `key` comes with a mask `_key`, False (and the value 0) where an episode began instead of a
    step. A seed n seeds environment i with n + i.

    Lives of a stream go on by themselves: with early termination they are at different steps, and
    near a switch in different phases. `get_attr("task")` gives the task in force in each
    environment, and `task` that of all of them, or EpisodeError.

    `autoreset_mode` is Gymnasium's: "NextStep", "SameStep" or "Disabled". With `render_mode`
    "rgb_array", `render_lanes` are the environments to draw, such as `[0, 1]`; None: all of them.
    `max_episode_steps` below the horizon truncates episodes as the horizon does: r_cum is paid.
    Other keywords are fields of a task's spec to change.

    Examples:
      >>> from sme_registry.envs import SMEVectorEnv
      >>> envs = SMEVectorEnv("Default", num_envs=3)
      >>> observations, infos = envs.reset(seed=0)
      >>> envs.step(envs.action_space.sample())[1].shape
      (3,)
    """

    def __init__(
        self,
        spec: SpecLike | StreamLike = "Default-v1",
        num_envs: int = 1,
        *,
        action_range: ActionRange = "unit",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_lanes: Sequence[int] | None = None,
        max_episode_steps: int | None = None,
        **overrides: Any,
    ) -> None:
        num_envs = integer_in("num_envs", num_envs, 1)
        if not isinstance(autoreset_mode, AutoresetMode):
            choice("autoreset_mode", autoreset_mode, [mode.value for mode in AutoresetMode])
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self._schedule = Schedule.load(type(self), spec, overrides)
        if max_episode_steps is not None:
            integer_in("max_episode_steps", max_episode_steps, 1)
        self._batch = Batch(self._schedule, num_envs, limit=max_episode_steps)
        self.num_envs = num_envs
        A, width = self.document.action_dim, self._batch.observation_dim
        self.single_action_space, self._rescaled = arguments.action_space(action_range, A)
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        self._range_warning = arguments.RangeWarning(self.document, self._rescaled)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._renderer = batch_renderer(render_mode, render_lanes, self._batch, self._rescaled)
        self._begun = np.zeros(num_envs, bool)
        self._ended = np.zeros(num_envs, bool)
        self._all_begun, self._any_ended = False, False
        self._views: list[EnvView] = []

    @property
    def task(self) -> Task:
        """The task in force; EpisodeError where it is not the same in every environment."""
        task = self._batch.one_task
        if task is None:
            raise EpisodeError(
                "task: the environments are in different segments of the stream. Ask for that of "
                "each one, get_attr('task')."
            )
        return task

    @property
    def state(self) -> Array:
        """The states, `[B, S]` float64 in [0, 1] (a copy)."""
        return self._batch.state

    @property
    def distractors(self) -> Array:
        """The distractors, `[B, m]` float64 in [0, 1] (a copy); `[B, 0]` without any."""
        return self._batch.distractors

    @property
    def noise(self) -> Array:
        """ξ and ζ of the next steps, `[B, 1 + S]` (a copy); 0 where the task has none."""
        return self._batch.noise

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those of `options["reset_mask"]`.

        `seed` n seeds environment i with n + i, a list each; None continues the streams. `options`
        are those of `SMEEnv.reset`, with `state` `[S]` or `[B, S]` and `distractors` `[m]` or
        `[B, m]`; with `{"reset_mask": mask}` the environments where `mask` `[B]` is False stay.
        """
        known = (*self._schedule.reset_options, "reset_mask")
        arguments.check_options(options, known)
        options = options or {}
        lifetime = arguments.lifetime_in(options)
        mask = self._mask(options["reset_mask"]) if "reset_mask" in options else None
        envs = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        seeds, spec = self._seeds(seed), self._batch.task.spec
        widths = {"state": spec.state_dim, "distractors": spec.distractors}
        given = [
            arguments.initial_values(name, options, (width,), self.num_envs)
            for name, width in widths.items()
        ]
        states, distractors = (None if value is None else value[envs] for value in given)
        # Every argument is checked: from here on, the state changes.
        for env in envs.tolist():
            env_seed = seeds[env]
            if env_seed is not None:
                self._batch.seed(env, env_seed)
            if lifetime is not None:
                self._batch.live(env, lifetime)
        observation = self._batch.observe()
        self._batch.begin(envs, observation, states, distractors)
        self._ended[envs] = False
        self._begun[envs] = True
        self._all_begun, self._any_ended = bool(self._begun.all()), bool(self._ended.any())
        if self._renderer is not None:
            self._renderer.record(envs.tolist())
        info = self._schedule.columns.at_resets(self.num_envs, self.document.action_dim)
        nowhere = np.zeros(self.num_envs, bool)
        return observation, _masked(info, nowhere) | _masked(self._batch.life(), mask)

    def step(  # type: ignore[override]  # Gymnasium types all three arrays alike; ends are bool
        self, actions: Any
    ) -> tuple[Observation, Array, Mask, Mask, dict[str, Any]]:
        """One step of every environment, from actions `[B, A]`, finite; clipped.

        Returns observations `[B, S + m + 2]`, rewards `[B]`, terminated `[B]`, truncated `[B]` and
        infos. An ActionError leaves the states unchanged; an EpisodeError is raised before the
        first reset, and in mode "Disabled" where episodes have ended.
        """
        B, A = self.num_envs, self.document.action_dim
        if not self._all_begun:
            raise EpisodeError("step: the episodes have not begun. Call reset() first.")
        ended_before, any_ended_before = self._ended, self._any_ended
        if any_ended_before and self.autoreset_mode is AutoresetMode.DISABLED:
            first = np.flatnonzero(ended_before)[0]
            raise EpisodeError(
                f"step: the episodes of {ended_before.sum()} environments have ended (the first is "
                f"{first}). Call reset(options={{'reset_mask': terminated | truncated}}) first."
            )
        # In mode NEXT_STEP the actions of environments that have ended are ignored.
        resting = ended_before if any_ended_before else None
        unit_actions = arguments.to_unit(actions, (B, A), self._rescaled, ignored=resting)
        if self._range_warning.is_due():
            self._range_warning.check(unit_actions)

        result = self._batch.advance(unit_actions, resting)
        observation, reward = result.observation, result.values[REWARD, 0]
        terminated, truncated = result.terminated, result.truncated
        columns = self._schedule.columns
        info = columns.at_step(result.actions, result.values[:, 0], self._rescaled)
        life, final, began = self._batch.lived, {}, resting
        if resting is not None:
            for array in (reward, terminated, truncated):
                array[resting] = 0
            self._begin(resting, observation, info, life)
        ended: Mask = terminated | truncated
        any_ended = int(np.count_nonzero(ended)) > 0  # a tenth of the time of any()
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended, self._any_ended = ended, any_ended
        elif any_ended:
            began = ended
            final = self._last(observation, info | life, ended)
            self._begin(ended, observation, info, life)
        if self._renderer is not None:
            envs = [] if began is None else np.flatnonzero(began).tolist()
            self._renderer.record(envs, unit_actions, result)
        infos = _masked(info, None if began is None else ~began) | _masked(life) | final
        return observation, reward, terminated, truncated, infos

    def snapshot(self) -> dict[str, npt.NDArray[Any]]:
        """What the next steps of a task follow from, besides its spec and the seed: arrays.

        In mode "SameStep", and where `reset` had a seed.
        """
        return self._batch.snapshot()

    def restore(self, snapshot: Mapping[str, npt.NDArray[Any]], seed: int) -> None:
        """Go on from a snapshot of an environment that was reset with this seed."""
        self.reset(seed=seed)
        for env in range(self.num_envs):
            self._batch.seed(env, seed + env)
        self._batch.restore(snapshot)

    def render(self) -> tuple[Frame, ...] | None:
        """A frame of each environment, `[H, W, 3]` uint8; white for those not in `render_lanes`.

        None without a `render_mode`; EpisodeError before the first reset.
        """
        return None if self._renderer is None else self._renderer.frame_of_each()

    def _last(
        self, observation: Observation, info: dict[str, npt.NDArray[Any]], ended: Mask
    ) -> dict[str, Any]:
        """Gymnasium's `final_obs` and `final_info` of the environments `ended` `[B]`."""
        final = np.full(self.num_envs, None, dtype=object)
        for env in np.flatnonzero(ended):
            final[env] = observation[env].copy()
        return {
            "final_obs": final,
            "_final_obs": ended.copy(),
            "final_info": _masked(info, ended),
            "_final_info": ended.copy(),
        }

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute; see `get_attr`."""
        values = [getattr(view, name) for view in self._all_views()]
        return tuple(value(*args, **kwargs) if callable(value) else value for value in values)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of each environment: `state` `[S]`, `task`, `sme_spec`, … or one set."""
        return self.call(name)

    def set_attr(self, name: str, values: list[Any] | tuple[Any, ...] | Any) -> None:
        """Set an attribute, from a list or tuple of one for each environment, or one for all."""
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise OptionError(
                f"values: must be one for each of the {self.num_envs} environments, got "
                f"{len(values)}."
            )
        for view, value in zip(self._all_views(), values, strict=True):
            setattr(view, name, value)

    def _all_views(self) -> list[EnvView]:
        """Created when they are first asked for: most batches never need them."""
        if not self._views:
            shared = {
                "spec": self.spec, "render_mode": self.render_mode,
                "action_space": self.single_action_space,
                "observation_space": self.single_observation_space,
            }  # fmt: skip
            self._views = [EnvView(self, env, **shared) for env in range(self.num_envs)]
        return self._views

    def _repr_html_(self) -> str:
        spaces = self.single_observation_space, self.single_action_space
        return html_card(self, *spaces, autoreset=self.autoreset_mode.value)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({title(self.document)}, num_envs={self.num_envs})"

    def _begin(
        self,
        began: Mask,
        observation: Observation,
        info: dict[str, npt.NDArray[Any]],
        life: dict[str, Indices],
    ) -> None:
        """Put environments at the start of an episode; write their observations and infos."""
        self._batch.begin(np.flatnonzero(began), observation)
        for value in info.values():
            value[began] = 0.0
        for key, now in self._batch.life().items():
            life[key][began] = now[began]

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """One seed or None for each environment."""
        if not isinstance(seed, list | tuple | np.ndarray) or np.ndim(seed) == 0:
            first = arguments.checked_seed(seed)
            return [None if first is None else first + env for env in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise OptionError(
                f"seed={seed!r:.60}: must be an integer, None, or a list of one for each of the "
                f"{self.num_envs} environments."
            )
        return [arguments.checked_seed(env_seed) for env_seed in seed]

    def _mask(self, mask: Any) -> Mask:
        if not (isinstance(mask, np.ndarray) and mask.dtype == bool):
            raise OptionError("reset_mask: must be a NumPy array of dtype bool.")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise OptionError(
                f"reset_mask of shape {mask.shape}: must be ({self.num_envs},), and True for at "
                "least one environment."
            )
        return mask


def _masked(info: Mapping[str, npt.NDArray[Any]], mask: Mask | None = None) -> dict[str, Any]:
    """Gymnasium's form of batched info: each key with its mask `_key`, 0 where that is False."""
    infos: dict[str, Any] = {}
    everywhere = None
    for key, value in info.items():
        if mask is None:
            everywhere = np.ones(len(value), bool) if everywhere is None else everywhere
            infos[key], infos[f"_{key}"] = value, everywhere
        else:
            columns = mask.reshape(-1, *[1] * (value.ndim - 1))
            masked = np.where(columns, value, value.dtype.type(0))
            infos[key], infos[f"_{key}"] = masked, mask.copy()
    return infos

"""`SMEEnv`: one Synthetic Monitoring Environment as a Gymnasium environment."""

from __future__ import annotations

import copy
from typing import Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.compiled import Engine, Extension, engine
from sme_registry.compiled.values import EXTENDED, LANE_STATE, LANE_VALUES
from sme_registry.envs import arguments, infos
from sme_registry.envs.base import (
    RENDER_MODES,
    GymnasiumMixin,
    RenderMixin,
    refuse_short_time_limit,
)
from sme_registry.envs.extension import ExtendedLane, reset_options
from sme_registry.envs.types import Action, Array, Observation
from sme_registry.errors import EpisodeError
from sme_registry.spec import ActionRange, SpecLike
from sme_registry.spec.catalogue import title
from sme_registry.task import Task

_FLOAT32 = np.dtype(np.float32)
_POOL_BYTES = 4096


class SMEEnv(GymnasiumMixin, RenderMixin, gymnasium.Env[Observation, Action]):
    """One episode at a time of a task whose optimal policy is known.

    Observation: `[S + 2]` float32 in [0, 1]: the state, t/T, and r_cum/k. Action: `[A]`, in [0, 1]
    (`action_range="unit"`) or [−1, 1] (`"symmetric"`, rescaled); actions outside are clipped.

    `info` of each step, about the state acted in: `optimal_action` `[A]`, in the environment's
    action range; `similarity` r̃, `step_reward` r and `regret` 1 − r, each in [0, 1]; and
    `accumulated_reward` r_cum after a payout's reset. At reset the same keys hold NaN.

    With `safety`, `info` also has `limit` and `safe_action` `[A]`, in the environment's action
    range; `cost` in [0, 1]; and `safe_regret`, the safe action's step reward minus r. With
    `observation` the agent sees M(s, d) `[S + m]` in place of the state.

    Args:
      spec: the task: a spec, its fields, an id, a digest or a path.
      action_range: "unit" or "symmetric".
      render_mode: None, "rgb_array" or "human".
      **overrides: spec fields to change; the environment then runs the derived spec.

    Raises:
      SpecError, UnknownNameError: no such task, or a field out of range.
      ResourceLimitError: the task would not fit in memory.
      OptionError: another argument is outside its range.

    Examples:
      >>> from sme_registry.envs import SMEEnv
      >>> env = SMEEnv("Default")
      >>> observation, info = env.reset(seed=0)
      >>> best = env.task.optimal_action(env.state)
      >>> observation, reward, terminated, truncated, info = env.step(best)
      >>> round(float(info["regret"]), 6)
      0.0
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        spec: SpecLike = "Default-v1",
        *,
        action_range: ActionRange = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self._set_render_mode(render_mode)
        self._task = self._load(spec, overrides)
        A = self.sme_spec.action_dim
        space, self._rescaled = arguments.action_space(action_range, A)
        self.action_space = cast("gymnasium.Space[Action]", space)
        width = self.sme_spec.observation_dim + len(self._phase_shown)
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        self._action_shape = (A,)
        self._state = "created"
        self._keyed_by: np.random.Generator | None = None  # of which the distractors' stream is
        self._extended = ExtendedLane(self._task) if self.sme_spec.extended else None
        self._load_engine()

    # What `SMEStreamEnv` has besides. They stand here because a step of a stream is a step of its
    # task: one that called this one would cost a sixth more.
    _phase: Any = None  # in force, NumPy's number
    _lifetimes: list[Any] | None = None  # those of the next steps, the last one first
    _phase_shown: Observation = np.empty(0, np.float32)  # what observations end with

    @property
    def _reset_options(self) -> tuple[str, ...]:
        return reset_options(self.sme_spec)

    def _load(self, spec: Any, overrides: dict[str, Any]) -> Task:
        """The task at the beginning."""
        return arguments.single_agent(arguments.load_overridden(type(self), spec, overrides))

    def _load_engine(self) -> None:
        compiled: Engine | Extension
        if self._extended is None:
            compiled = engine(self._task)
            self._buffer, self._lane = compiled.new_lane()  # the second is a view of the first
        else:
            compiled = self._extended.compiled
            self._buffer, self._lane = self._extended.buffer, self._extended.lane
        self._step_float32, self._step_float64 = compiled.step_float32, compiled.step_float64
        # Views of no dimension: `view[()]` makes a NumPy number in a third of `np.float64`'s time.
        self._values = tuple(self._lane[LANE_VALUES + row, ...] for row in infos.NUMBERS.values())
        self._rows: list[tuple[Array, Observation]] = []
        self._prepare_step()

    def _prepare_step(self) -> None:
        """Gather what a step needs in one tuple, so that a step looks up one attribute.

        The first entry is the dtype of actions that need no checks: None while no episode is
        running, where actions are rescaled, or frames are rendered.
        """
        plain = self._state == "running" and not self._rescaled and self.render_mode is None
        self._fast_step: tuple[Any, ...] = (
            _FLOAT32 if plain else None,
            self._step_float32,
            self._buffer,
            self._rows.pop,
            *self._values,
            None if self._lifetimes is None else (self._phase, self._lifetimes),
        )

    def _refill(self) -> None:
        """Allocate what later steps write, each once. Half the cost of two `np.empty` a step."""
        width, A = self.sme_spec.observation_dim, self.sme_spec.action_dim
        if self.sme_spec.safety is not None:
            A *= 3  # the limits and the safe action, which `add_limits` takes from the row
        count = max(1, _POOL_BYTES // (8 * max(width, A)))
        optimal = np.empty((count, A))
        observations = np.empty((count, width + len(self._phase_shown)), np.float32)
        observations[:, width:] = self._phase_shown
        self._rows.extend(zip(optimal, observations, strict=True))

    # Machine code cannot be pickled or copied: the copy looks it up again.
    def __getstate__(self) -> dict[str, Any]:
        dropped = (
            "_step_float32",
            "_step_float64",
            "_buffer",
            "_values",
            "_fast_step",
            "_rows",
        )
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load_engine()
        self._lane[:] = state["_lane"]

    @property
    def state(self) -> Array:
        """The state s, `[S]` float64 in [0, 1] (a copy)."""
        return self._lane[LANE_STATE:].copy()

    @property
    def distractors(self) -> Array:
        """The distractors d, `[m]` float64 in [0, 1] (a copy); empty where the task has none."""
        return np.empty(0) if self._extended is None else self._extended.distractors[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode at a state drawn uniformly from the cube, or at one of your choice.

        Args:
          seed: seeds the environment's generator; None continues its stream. Distractors follow
            from the seed, or from `np_random` where you have set it.
          options: `{"state": s}` begins at s `[S]`, each entry in [0, 1], and where the task has
            distractors `{"distractors": d}` at d `[m]`.

        Returns:
          The observation `[S + m + 2]`, and an info of NaN.

        Raises:
          StateError: the state or the distractors have the wrong shape or lie outside the cube.
          OptionError: an unknown option, or a seed that is no integer of at least 0.
          WrapperError: an outer TimeLimit would end the episode before the horizon.
        """
        refuse_short_time_limit(self.sme_spec.horizon)
        arguments.refuse_unknown_options(options, self._reset_options)
        S, seed = self.sme_spec.state_dim, arguments.checked_seed(seed)
        lifetime = arguments.lifetime_in(options)
        start, distractors = (
            arguments.initial_values(name, options or {}, (width,))
            for name, width in (("state", S), ("distractors", self.sme_spec.distractors))
        )
        super().reset(seed=seed)  # nothing changes before every argument is checked
        life = self._live(0 if lifetime is None and seed is not None else lifetime)
        s = self.np_random.random(S) if start is None else start
        self._lane[:LANE_STATE] = 0.0
        self._lane[LANE_STATE:] = s
        shown: npt.NDArray[Any] = s
        if self._extended is not None:
            if self._keyed_by is not self.np_random:
                self._extended.seed(0, self._distractors_seed())
                self._keyed_by = self.np_random
            shown = self._extended.begin_lane(distractors)
        observation = np.zeros(len(shown) + 2 + len(self._phase_shown), np.float32)
        observation[: len(shown)], observation[len(shown) + 2 :] = shown, self._phase_shown
        self._state = "running"
        self._prepare_step()
        if self.render_mode is not None:
            self._record(self, None)
        return observation, {**infos.at_reset(self.sme_spec), **life}

    def _distractors_seed(self) -> int:
        """The seed of the generator, or a number that follows from one that the user has set.

        That number is drawn from a copy, so that initial states are as without `observation`.
        """
        # −1 where the user has set the generator; Gymnasium before 1.0 has no such attribute.
        seed: int = getattr(self, "np_random_seed", -1)
        return seed if seed >= 0 else int(copy.deepcopy(self.np_random).integers(2**63))

    def _live(self, lifetime: int | None) -> dict[str, Any]:
        """Called by each reset before it draws a state; what it returns is added to the info.

        Args:
          lifetime: of a stream, the steps after which a life begins; None continues the present.
        """
        return {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step.

        Args:
          action: `[A]`, finite; clipped to the action range.

        Returns:
          Observation, reward R (the payout, in [0, k]), terminated, truncated, and info.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; the state is unchanged then.
          EpisodeError: no episode is running.
        """
        # Written for speed: each look-up and branch here costs one percent of a step.
        (
            plain_dtype, step_float32, buffer, next_rows,
            similarity, step_reward, regret, accumulated_reward, life,
        ) = self._fast_step  # fmt: skip
        try:
            optimal, observation = next_rows()
        except IndexError:
            self._refill()
            optimal, observation = next_rows()
        try:
            plain = action.dtype is plain_dtype and action.ndim == 1
        except AttributeError:
            plain = False
        if plain:
            reward, end = step_float32(buffer, action, optimal, observation)
        else:
            action = self._checked(action)
            reward, end = self._step_float64(buffer, action, optimal, observation)
        if life is None:
            info = {
                "optimal_action": optimal,
                "similarity": similarity[()],
                "step_reward": step_reward[()],
                "regret": regret[()],
                "accumulated_reward": accumulated_reward[()],
            }
        else:  # written out: a dictionary that grows to seven keys costs twice as much
            phase, lifetimes = life
            info = {
                "optimal_action": optimal,
                "similarity": similarity[()],
                "step_reward": step_reward[()],
                "regret": regret[()],
                "accumulated_reward": accumulated_reward[()],
                "phase": phase,
                "lifetime": lifetimes.pop(),
            }
            plain = plain and lifetimes
        if end or not plain:
            end = self._after(end, action, info, observation)
            return observation, reward, end == 1.0 or end == 3.0, end >= 2.0, info
        return observation, reward, False, False, info

    def _after(
        self, end: float, action: Action, info: dict[str, Any], observation: Observation
    ) -> float:
        """What the fast path leaves out: refused actions, extensions, the end, ranges, frames.

        Returns:
          The end without EXTENDED.
        """
        if end < 0.0:
            self._checked(action)  # raises where the size is wrong
            raise arguments.not_finite_error()
        if self._extended is not None:
            self._extended.add_limits(info)
            end -= EXTENDED
        if end:
            self._state = "ended"
            self._prepare_step()
        if self._rescaled:
            for key in infos.actions(self.sme_spec):
                info[key] = arguments.from_unit(info[key], True)
        if self.render_mode is not None:
            self._record(self, (arguments.from_unit(action, self._rescaled), info))
        return end

    def _repr_html_(self) -> str:
        """A card for notebooks: spaces, episode and task."""
        from sme_registry.envs import cards

        return cards.html(self, self.observation_space, self.action_space, status=self._state)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({title(self.document)})"

    def _checked(self, action: Any) -> Array:
        """The action as `[A]` float64 in the unit range."""
        if self._state != "running":
            phase = "has ended" if self._state == "ended" else "has not begun"
            raise EpisodeError(f"step: the episode {phase}. Call reset() first.")
        return arguments.to_unit(action, self._action_shape, self._rescaled)

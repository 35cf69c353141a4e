"""`SMEEnv`: one Synthetic Monitoring Environment as a Gymnasium environment."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeAlias, cast

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.envs import arguments
from sme_registry.envs.random import StepNumbers
from sme_registry.envs.rendering import RENDER_MODES, RenderMixin, html_card
from sme_registry.envs.schedule import GymnasiumMixin, Schedule
from sme_registry.errors import EpisodeError
from sme_registry.spec.catalogue import title
from sme_registry.spec.sme_spec import ActionRange, SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.task import Task
from sme_registry.task.engine import engine
from sme_registry.task.episode import shaping_at_switch
from sme_registry.task.task import (
    ACCUMULATED_REWARD,
    BUFFER_STATE,
    BUFFER_T,
    BUFFER_VALUES,
    Action,
    Array,
    Indices,
    Observation,
)

_FLOAT32, _FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)
_POOL_BYTES = 4096
_AHEAD = 256  # lifetimes made at once: NumPy's numbers one by one cost a quarter of a step
_ONLY: Indices = np.zeros(1, np.int64)

_Result: TypeAlias = tuple[Observation, float, bool, bool, dict[str, Any]]


class SMEEnv(GymnasiumMixin, RenderMixin, gymnasium.Env[Observation, Action]):
    """One episode at a time of a task, or of a stream of tasks, whose optimal policy is known.

    Observation: `[S + 2]` float32 in [0, 1]: the state, t/T, and r_cum/k. Action: `[A]`, in [0, 1]
    (`action_range="unit"`) or [−1, 1] (`"symmetric"`, rescaled); actions outside are clipped, with
    one warning where unit ones are far below 0.

    `info` of each step, about the state acted in: `optimal_action` `[A]`, in the environment's
    action range; `similarity` r̃, `step_reward` r and `regret` 1 − r, each in [0, 1]; and
    `accumulated_reward` r_cum after a payout's reset. At reset the same keys hold 0.

    With `safety`, `info` also has `limit` and `safe_action` `[A]`, in the environment's action
    range; `cost` in [0, 1]; and `safe_regret`, the safe action's step reward minus r. With
    `observation` the agent sees M(s, d) `[S + m]` in place of the state.

    Of a stream, `task` and `sme_spec` are those in force, by the steps that were lived. `info` also
    has `phase`, the index of the phase in force, and `lifetime`, the environment steps of this
    life up to now; at a step it is all about the task in which the action was taken.
    `reset(seed=…)` begins a new life at 0, and `reset()` continues it. With `switch="step"` a new
    phase begins within an episode: state, t and r_cum carry over. The observation has the r_cum/k
    of the k then in force, at most 1, and with `observes_phase` ends with the phase, one-hot.

    `render_mode` is None, "rgb_array" or "human". Other keywords are fields of a task's spec to
    change; the environment then runs the derived spec.

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
        spec: SpecLike | StreamLike = "Default-v1",
        *,
        action_range: ActionRange = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self._set_render_mode(render_mode)
        self._schedule = Schedule.load(type(self), spec, overrides)
        document = self.document
        A = document.action_dim
        self._action_shape = (A,)
        actions = enumerate(self._schedule.columns.actions)  # of a step, one behind the other
        self._parts = [(key, slice(i * A, (i + 1) * A)) for i, key in actions]
        space, self._rescaled = arguments.action_space(action_range, A)
        self.action_space = cast("gymnasium.Space[Action]", space)
        self._range_warning = arguments.RangeWarning(document, self._rescaled)
        width = document.observation_dim
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        self._status = "not begun"
        self._time_limit: Any = None  # an outer TimeLimit below the horizon
        self._keyed_by: np.random.Generator | None = None  # of which the streams of steps are
        self._random = StepNumbers(self.document.specs, 1)
        # The lifetimes of a stream's next steps, the last one first; a task needs none.
        self._lifetimes: list[Any] = [0]
        self._look_ahead(0)
        self._put_in_force(0)

    @property
    def task(self) -> Task:
        """The drawn task: W, b, the layers of each agent, and the equations."""
        return self._schedule.tasks[self._segment]

    @property
    def state(self) -> Array:
        """The state s, `[S]` float64 in [0, 1] (a copy)."""
        return self._numbers[BUFFER_STATE:][: self.document.state_dim].copy()

    @property
    def distractors(self) -> Array:
        """The distractors d, `[m]` float64 in [0, 1] (a copy); empty where the task has none."""
        return cast(Array, self._random.distractors[0])

    @property
    def noise(self) -> Array:
        """ξ and ζ of the next step, `[1 + S]` (a copy); 0 where the task has none."""
        return cast(Array, self._random.noise[0])

    def _put_in_force(self, segment: int) -> None:
        """Run the task of a segment; the episode, if one is running, goes on by `_load_engine`."""
        self._segment = segment
        self._phase: Any = self._schedule.phases[segment]  # NumPy's number
        self._one_hot = self._schedule.one_hot(self._phase)
        self._load_engine()

    def _load_engine(self) -> None:
        self._engine = engine(self.task)
        self._buffer, self._numbers = self._engine.new_buffer()  # a view of the buffer
        own = self._numbers[BUFFER_STATE + self.document.state_dim :, None]
        own[:] = self._random.own
        self._random.own = own
        # Views of no dimension: `view[()]` makes a NumPy number in a third of `np.float64`'s time.
        rows = self._schedule.columns.numbers.items()
        values = [(key, self._numbers[BUFFER_VALUES + row, ...]) for key, row in rows]
        self._values, self._more_values = values[:4], values[4:]
        self._rows: list[tuple[Array, Observation]] = []
        self._step: Callable[[Any, Any], _Result] = _check_running
        if self._status == "running":
            self._step = self._fast_step()

    # Machine code cannot be pickled or copied: the copy looks it up again.
    def __getstate__(self) -> dict[str, Any]:
        dropped = {"_engine", "_buffer", "_values", "_more_values", "_rows", "_step"}
        return {name: value for name, value in vars(self).items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._load_engine()
        self._numbers[:] = state["_numbers"]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode at a state drawn uniformly from the cube, or at one of your choice.

        `seed` seeds the environment's generator, None continues its stream. Distractors follow from
        the seed, or from `np_random` where you have set it. `options`: `{"state": s}` begins at s
        `[S]`, each entry in [0, 1]; where the task has distractors `{"distractors": d}` at d `[m]`;
        and of a stream `{"lifetime": n}` begins a life after n steps.

        The info is of zeros. An outer TimeLimit below the horizon truncates the episode as the
        horizon does: r_cum is paid.
        """
        self._time_limit = arguments.outer_time_limit(self.document.horizon)
        arguments.check_options(options, self._schedule.reset_options)
        S, seed = self.document.state_dim, arguments.checked_seed(seed)
        lifetime = arguments.lifetime_in(options)
        start, distractors = (
            arguments.initial_values(name, options or {}, (width,))
            for name, width in (("state", S), ("distractors", self.sme_spec.distractors))
        )
        super().reset(seed=seed)  # nothing changes before every argument is checked
        life = self._live(0 if lifetime is None and seed is not None else lifetime)
        s = self.np_random.random(S) if start is None else start
        self._numbers[:BUFFER_STATE] = 0.0
        self._numbers[BUFFER_STATE : BUFFER_STATE + S] = s
        seen = self._begin_seeing(s, distractors)
        observation = np.zeros(self.document.observation_dim, np.float32)
        observation[: len(seen)], observation[len(seen) + 2 :] = seen, self._one_hot
        self._status = "running"
        self._step = self._fast_step()
        if self.render_mode is not None:
            self._record(self.state)
        return observation, {**self._schedule.columns.at_reset(self._action_shape[0]), **life}

    def _begin_seeing(self, s: Array, distractors: Array | None) -> npt.NDArray[Any]:
        """Begin an episode of the distractors; what the agent sees of the state, `[S + m]`."""
        if self._keyed_by is not self.np_random:
            self._random.seed(0, self._seed_of_steps())
            self._keyed_by = self.np_random
        self._random.begin(_ONLY, None if distractors is None else distractors[None])
        return self._engine.seen(self._random.beside(s[:, None], _ONLY))[:, 0]

    def _seed_of_steps(self) -> int:
        """The seed of the generator, or a number from a copy of one that the user has set."""
        # −1 where the user has set the generator; Gymnasium before 1.0 has no such attribute.
        seed: int = getattr(self, "np_random_seed", -1)
        return seed if seed >= 0 else int(copy.deepcopy(self.np_random).integers(2**63))

    def _live(self, lifetime: int | None) -> dict[str, Any]:
        """Begin a life of a stream after so many steps, None goes on; what infos say of it."""
        if not self._schedule.is_stream:
            return {}
        if lifetime is None:
            lifetime = int(self._lifetimes[-1]) - 1
        else:
            self._look_ahead(lifetime)
        self._enter(self._schedule.times.segment_at(lifetime))
        return self._schedule.life(self._phase, np.int64(lifetime))

    def _look_ahead(self, lifetime: int) -> None:
        """Fill the lifetimes of the next steps: those until a switch, or the next few."""
        stop = lifetime + _AHEAD
        if self._schedule.switches_within:
            stop = min(stop, self._schedule.times.next_switch(lifetime))
        self._lifetimes[:] = np.arange(stop, lifetime, -1)

    def _enter(self, segment: int) -> None:
        """Put another segment in force; the episode, if one is running, goes on."""
        if segment != self._segment:
            numbers = self._numbers
            self._put_in_force(segment)
            self._numbers[:] = numbers
            for _, view in self._more_values:
                view[()] = 0.0  # not every task of a stream writes them

    def step(self, action: Action) -> _Result:
        """One step, from an action `[A]`, finite; clipped to the action range.

        Returns observation, reward R (the payout, in [0, k]), terminated, truncated, and info. An
        ActionError leaves the state unchanged; an EpisodeError says that no episode is running.
        """
        return self._step(self, action)

    def _fast_step(self) -> Callable[[Any, Any], _Result]:
        """A step of the present segment, as a closure over all that it reads, written for speed.

        It takes the environment as an argument, as a closure over it would be a circle.
        """
        more_to_do = self._rescaled or self.render_mode is not None
        # Actions of this dtype need no checks; none where they are rescaled or frames are drawn.
        no_checks = None if more_to_do else _FLOAT32
        step_one = self._engine.step_one
        plain_step = step_one(no_checks or _FLOAT64)
        more_to_do |= len(self._parts) > 1 or self._random.has_noise
        buffer, next_rows = self._buffer, self._rows.pop
        similarity, step_reward, regret, accumulated_reward = (view for _, view in self._values)
        more_values = self._more_values
        phase, lifetimes, is_stream = self._phase, self._lifetimes, self._schedule.is_stream
        is_plain = not (more_to_do or more_values)

        def step(env: SMEEnv, action: Any) -> _Result:
            try:
                optimal, observation = next_rows()
            except IndexError:
                env._refill(action)
                optimal, observation = next_rows()
            # Arrays of other libraries have these attributes, too, and Numba does not take them.
            if type(action) is np.ndarray and action.dtype is no_checks and action.ndim == 1:
                reward, end = plain_step(buffer, action, optimal, observation)
            else:
                action = env._checked(action)
                reward, end = step_one(_FLOAT64)(buffer, action, optimal, observation)
            info: dict[str, Any]
            if is_stream:  # written out: a dictionary that grows to seven keys costs twice as much
                info = {
                    "optimal_action": optimal,
                    "similarity": similarity[()],
                    "step_reward": step_reward[()],
                    "regret": regret[()],
                    "accumulated_reward": accumulated_reward[()],
                    "phase": phase,
                    "lifetime": lifetimes.pop(),
                }
            else:
                info = {
                    "optimal_action": optimal,
                    "similarity": similarity[()],
                    "step_reward": step_reward[()],
                    "regret": regret[()],
                    "accumulated_reward": accumulated_reward[()],
                }
            if is_plain and lifetimes and not end:
                return observation, reward, False, False, info
            for key, view in more_values:
                info[key] = view[()]
            if end or more_to_do or not lifetimes:
                reward += env._after(end, action, info, observation)
                return observation, reward, end == 1.0 or end == 3.0, end >= 2.0, info
            return observation, reward, False, False, info

        return step if self._time_limit is None else _limited(step)

    def _pay_out(self, observation: Observation, info: dict[str, Any]) -> float:
        """End the episode before the horizon; returns the reward that waited."""
        waiting = self._numbers[BUFFER_VALUES + ACCUMULATED_REWARD].item()
        self._numbers[BUFFER_VALUES + ACCUMULATED_REWARD] = 0.0
        observation[self.sme_spec.state_dim + self.sme_spec.distractors + 1] = 0.0
        info["accumulated_reward"] = np.float64(0.0)
        self._status, self._step = "ended", _check_running
        return cast(float, waiting)

    def _refill(self, action: Any) -> None:
        """Allocate what later steps write, each once. Half the cost of two `np.empty` a step."""
        if self._range_warning.is_due():
            self._range_warning.check(self._checked(action))
        width = self.document.observation_dim
        numbers = self._action_shape[0] * len(self._parts)
        count = max(1, _POOL_BYTES // (8 * max(width, numbers)))
        optimal = np.empty((count, numbers))
        observations = np.empty((count, width), np.float32)
        observations[:, width - len(self._one_hot) :] = self._one_hot
        self._rows.extend(zip(optimal, observations, strict=True))

    def _after(
        self, end: float, action: Any, info: dict[str, Any], observation: Observation
    ) -> float:
        """What the fast path leaves out: noise, actions not taken, switches, the end, frames.

        Returns what a switch adds to the reward.
        """
        added = 0.0
        if end < 0.0:
            if self._schedule.is_stream:
                self._lifetimes.append(info["lifetime"])  # nothing was lived
            self._checked(action)  # raises where the size is wrong
            raise arguments.not_finite_error()
        self._random.draw_noise()
        if not self._lifetimes:
            added = self._go_on(int(info["lifetime"]), observation, bool(end))
            if added:
                info["shaping"] += added
        row = arguments.from_unit(info["optimal_action"], self._rescaled)
        for key, part in self._parts:  # slices: `reshape` takes three times as long
            info[key] = row[part]
        if end:
            self._status, self._step = "ended", _check_running
        if self.render_mode is not None:
            self._record(self.state, action, info)
        return added

    def _go_on(self, lifetime: int, observation: Observation, ended: bool) -> float:
        """Look further ahead; where a segment ends within an episode, put the next in force.

        Returns what that adds to the shaping of the last step.
        """
        self._look_ahead(lifetime)
        added = 0.0
        if self._schedule.switches_within:
            before = self.task
            self._enter(self._schedule.times.segment_at(lifetime))
            S = self.document.state_dim
            waiting = self._numbers[BUFFER_VALUES + ACCUMULATED_REWARD] / self.sme_spec.k
            observation[S + 1], observation[S + 2 :] = min(waiting, 1.0), self._one_hot
            if not ended:
                added = shaping_at_switch(before, self.task, self.state, self._numbers[BUFFER_T])
        return added

    def _checked(self, action: Any) -> Array:
        return arguments.to_unit(action, self._action_shape, self._rescaled)

    def _repr_html_(self) -> str:
        return html_card(self, self.observation_space, self.action_space, status=self._status)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({title(self.document)})"


def _limited(step: Callable[[Any, Any], _Result]) -> Callable[[Any, Any], _Result]:
    """A step that ends the episode together with an outer TimeLimit, which counts it later."""

    def limited(env: SMEEnv, action: Any) -> _Result:
        observation, reward, terminated, truncated, info = step(env, action)
        limit = env._time_limit
        if not truncated and limit._elapsed_steps + 1 >= limit._max_episode_steps:
            reward, truncated = reward + env._pay_out(observation, info), True
            if "shaping" in info and not terminated:
                t = env._numbers[BUFFER_T]
                change = shaping_at_switch(env.task, None, env.state, t)
                info["shaping"] += change
                reward += change
        return observation, reward, terminated, truncated, info

    return limited


def _check_running(env: SMEEnv, action: Any) -> _Result:
    """The step of an environment without a running episode."""
    phase = "has ended" if env._status == "ended" else "has not begun"
    raise EpisodeError(f"step: the episode {phase}. Call reset() first.")

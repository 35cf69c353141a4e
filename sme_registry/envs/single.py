"""`SMEEnv`: one Synthetic Monitoring Environment as a Gymnasium environment."""

from __future__ import annotations

import os
import sys
from typing import Any, Literal, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec

from sme_registry.compiled import engine
from sme_registry.envs import actions
from sme_registry.envs.naming import renamed_by_content
from sme_registry.envs.options import checked_seed, initial_states, refuse_unknown, single_agent
from sme_registry.errors import EpisodeError, OptionError, WrapperError
from sme_registry.spec import SMESpec
from sme_registry.task import Task, load_task

_FLOAT32 = np.dtype(np.float32)
_POOL_BYTES = 4096

Observation = npt.NDArray[np.float32]
Action = npt.NDArray[np.floating[Any]]


class SMEEnv(gymnasium.Env[Observation, Action]):
    """One episode at a time of a task whose optimal policy is known.

    Observation: `[S + 2]` float32 in [0, 1]: the state, t/T, and r_cum/k. Action: `[A]`, in [0, 1]
    (`action_range="unit"`) or [−1, 1] (`"symmetric"`, rescaled); what lies outside is clipped.

    `info` of each step, of the state acted in: `optimal_action` `[A]`, in the environment's own
    action range; `similarity` r̃, `step_reward` r and `regret` 1 − r, each in [0, 1]; and
    `accumulated_reward` r_cum after a payout's reset. At reset `info` is empty.

    Args:
      spec: the task: a spec, its fields, an id, a digest or a path.
      action_range: "unit" or "symmetric".
      render_mode: None, "rgb_array" or "human".
      **overrides: spec fields to change; the environment is then of the derived spec.

    Raises:
      SpecError, UnknownNameError: no such task, or a field out of range.
      ResourceLimitError: the task would not fit in memory.
      OptionError: another argument is outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        spec: SMESpec | dict[str, Any] | str | os.PathLike[str] = "Default-v1",
        *,
        action_range: Literal["unit", "symmetric"] = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise OptionError(f"render_mode={render_mode!r}: must be None, 'human' or 'rgb_array'.")
        self.render_mode = render_mode
        self._task = single_agent(load_task(spec, **overrides))
        S, A = self.sme_spec.state_dim, self.sme_spec.action_dim
        space, self._rescaled = actions.space(action_range, A)
        self.action_space = cast("gymnasium.Space[Action]", space)
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (S + 2,), np.float32)
        self._action_shape = (A,)
        self._renderer: Any = None
        self._state = "created"
        self._load_engine()

    def _load_engine(self) -> None:
        made = engine(self._task)
        self._step_float32, self._step_float64 = made.step_float32, made.step_float64
        self._buffer, self._lane = made.new_lane()  # the second is a view of the first
        self._optimal_rows: list[npt.NDArray[np.float64]] = []
        self._observation_rows: list[Observation] = []
        self._arm()

    def _arm(self) -> None:
        """Gather what a step needs, so that it costs one look-up.

        The first entry is the dtype of actions that need no further look: none while there is no
        episode under way, where actions are rescaled, or frames are drawn.
        """
        plain = self._state == "running" and not self._rescaled and self.render_mode is None
        self._armed = (
            _FLOAT32 if plain else None,
            self._step_float32,
            self._buffer,
            self._optimal_rows.pop,
            self._observation_rows.pop,
        )

    def _refill(self) -> None:
        """Make rows for steps to come: each is handed out once, half the cost of `np.empty`."""
        S, A = self.sme_spec.state_dim, self.sme_spec.action_dim
        count = max(1, _POOL_BYTES // (8 * max(S + 2, A)))
        self._optimal_rows.extend(np.empty((count, A)))
        self._observation_rows.extend(np.empty((count, S + 2), np.float32))

    # Machine code cannot be pickled or copied: it is looked up again where the copy lives.
    def __getstate__(self) -> dict[str, Any]:
        dropped = (
            "_step_float32",
            "_step_float64",
            "_buffer",
            "_armed",
            "_optimal_rows",
            "_observation_rows",
        )
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load_engine()
        self._lane[:] = state["_lane"]

    @property
    def task(self) -> Task:
        """The drawn task: W, b, layers and the equations."""
        return self._task

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is really run, overrides included."""
        return self._task.spec

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """The state s, `[S]` float64 in [0, 1] (a copy)."""
        return self._lane[2:].copy()

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec; a derived task goes by its content, never by the name it came from."""
        return self.__dict__.get("_env_spec")

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._env_spec = renamed_by_content(value, self.sme_spec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode at a state drawn uniformly from the cube, or at a given one.

        Args:
          seed: seeds the environment's generator; None goes on with the present one.
          options: `{"state": s}` begins at s `[S]`, each entry in [0, 1].

        Returns:
          The observation `[S + 2]` and an empty dict.

        Raises:
          StateError: the state has the wrong shape or lies outside the cube.
          OptionError: an unknown option, or a seed that is no integer of at least 0.
          WrapperError: an outer TimeLimit would end the episode before the horizon.
        """
        _refuse_short_time_limit(self.sme_spec.horizon)
        refuse_unknown(options, ("state",))
        S, seed = self.sme_spec.state_dim, checked_seed(seed)
        given = initial_states(options["state"], (S,)) if options and "state" in options else None
        super().reset(seed=seed)  # all is checked: only now anything moves
        s = self.np_random.random(S) if given is None else given
        self._lane[:2] = 0.0
        self._lane[2:] = s
        observation = np.zeros(S + 2, np.float32)
        observation[:S] = s
        self._state = "running"
        self._arm()
        if self.render_mode is not None:
            self._frame(None)
        return observation, {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step.

        Args:
          action: `[A]`, finite; clipped to the action range.

        Returns:
          Observation, reward R (the payout, in [0, k]), terminated, truncated, and info.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; nothing has moved then.
          EpisodeError: there is no episode under way.
        """
        # Written for speed: every look-up and branch here is a percent of a step.
        plain_dtype, step_float32, buffer, optimal_row, observation_row = self._armed
        try:
            optimal, observation = optimal_row(), observation_row()
        except IndexError:
            self._refill()
            optimal, observation = optimal_row(), observation_row()
        try:
            plain = action.dtype is plain_dtype and action.ndim == 1
        except AttributeError:
            plain = False
        if plain:
            similarity, step_reward, regret, reward, accumulated, end = step_float32(
                buffer, action, optimal, observation
            )
        else:
            action = self._checked(action)
            similarity, step_reward, regret, reward, accumulated, end = self._step_float64(
                buffer, action, optimal, observation
            )
        info = {
            "optimal_action": optimal,
            "similarity": similarity,
            "step_reward": step_reward,
            "regret": regret,
            "accumulated_reward": accumulated,
        }
        if end or not plain:
            self._after(end, action, info)
            return observation, reward, end == 1.0 or end == 3.0, end >= 2.0, info
        return observation, reward, False, False, info

    def _after(self, end: float, action: Action, info: dict[str, Any]) -> None:
        """What the plain step has no need of: refusals, the end, other ranges, frames."""
        if end < 0.0:
            self._checked(action)  # says so where it is of another size
            raise actions.not_finite()
        if end:
            self._state = "ended"
            self._arm()
        info["optimal_action"] = actions.to_range(info["optimal_action"], self._rescaled)
        if self.render_mode is not None:
            self._frame((actions.to_range(action, self._rescaled), info))

    def _checked(self, action: Any) -> npt.NDArray[np.float64]:
        """The action as `[A]` float64 in the unit range."""
        if self._state != "running":
            what = "has ended" if self._state == "ended" else "has not begun"
            raise EpisodeError(f"step: the episode {what}. Call reset() first.")
        return actions.checked(action, self._action_shape, self._rescaled)

    def _frame(self, last: tuple[Any, dict[str, Any]] | None) -> None:
        if self._renderer is None:
            from sme_registry.envs.rendering import Renderer

            self._renderer = Renderer(self.sme_spec, cast(str, self.render_mode), self.metadata)
        self._renderer.record(self, last)

    def render(self) -> Any:
        """The frame of this step: `[H, W, 3]` uint8 for "rgb_array"; None for "human", shown.

        Raises:
          EpisodeError: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() needs a render_mode, given when the environment is made: "
                'gymnasium.make(..., render_mode="rgb_array").'
            )
            return None
        if self._renderer is None:
            raise EpisodeError("render: the episode has not begun. Call reset() first.")
        return self._renderer.frame()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _refuse_short_time_limit(horizon: int) -> None:
    """Refuse an outer TimeLimit below the horizon, which would swallow a pending payout.

    An environment cannot see its wrappers, but they call its `reset` through their own: the
    frames of the callers are the wrappers (and Gymnasium's checker of the first reset).
    """
    frame = sys._getframe(2)
    while frame is not None and "reset" in frame.f_code.co_name:
        caller = frame.f_locals.get("self")
        if isinstance(caller, gymnasium.wrappers.TimeLimit):
            limit = caller._max_episode_steps
            if limit < horizon:
                raise WrapperError(
                    f"max_episode_steps={limit}: must be at least the horizon, {horizon}: a "
                    "shorter TimeLimit would swallow the reward that is still to be paid. Make "
                    f"the task itself shorter: gymnasium.make(..., horizon={limit})."
                )
        frame = cast(Any, frame.f_back)

"""`SMEStreamEnv`: one life of a stream of tasks as a Gymnasium environment; METHOD, section 7."""

from __future__ import annotations

from typing import Any

import numpy as np

from sme_registry.compiled.values import ACCUMULATED_REWARD, LANE_VALUES
from sme_registry.envs import arguments, infos
from sme_registry.envs.single import SMEEnv
from sme_registry.envs.types import Action, Observation
from sme_registry.spec import ActionRange, StreamLike, StreamSpec
from sme_registry.task import Task

_AHEAD = 256  # lifetimes made at once: NumPy's numbers one by one cost a quarter of a step


class SMEStreamEnv(SMEEnv):
    """One episode at a time of the task that is in force, by the steps that were lived.

    As `SMEEnv`, with two more keys in `info`: `phase`, the index of the phase in force, and
    `lifetime`, the environment steps of this life up to now. At a step, all of `info` is about the
    task in which the action was taken; at a reset, `phase` is the one that begins. `task` and
    `sme_spec` are those in force.

    `reset(seed=…)` begins a new life at 0, and `reset()` continues it. The option `lifetime` begins
    one after so many steps: `reset(options={"lifetime": 20_000})`. With `switch="step"` a new
    phase begins within an episode: state, t and r_cum carry over. The observation has the r_cum/k
    of the k then in force, at most 1, and with `observes_phase` ends with the phase, one-hot.

    Args:
      stream: the stream, its fields, an id, a digest or a path.
      action_range: "unit" or "symmetric".
      render_mode: None, "rgb_array" or "human".
      **overrides: none; fields of specs are refused, with the way to another stream.

    Raises:
      SpecError, UnknownNameError: no such stream, or a field out of range.
      ResourceLimitError: its tasks would not fit in memory.
      OptionError: another argument is outside its range.

    Examples:
      >>> from sme_registry.envs import SMEStreamEnv
      >>> env = SMEStreamEnv("Switch5")
      >>> observation, info = env.reset(seed=0)
      >>> int(env.step(env.action_space.sample())[4]["phase"])
      0
    """

    def __init__(
        self,
        stream: StreamLike = "Switch5-v1",
        *,
        action_range: ActionRange = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        super().__init__(
            stream,  # type: ignore[arg-type]  # `_load` takes it
            action_range=action_range,
            render_mode=render_mode,
            **overrides,
        )

    @property
    def _reset_options(self) -> tuple[str, ...]:
        return "state", "lifetime"

    def _load(self, spec: Any, overrides: dict[str, Any]) -> Task:
        self._tasks = arguments.load_stream_tasks(type(self), spec, overrides)
        self._piece, self._lifetimes = 0, []
        self._phase, self._phase_shown = self._tasks.phases[0], self._tasks.shown(0)
        self._look_ahead(0)
        return self._tasks.tasks[0]

    @property
    def stream(self) -> StreamSpec:
        """The stream."""
        return self._tasks.stream

    @property
    def document(self) -> StreamSpec:
        """The stream, which is what the environment runs."""
        return self._tasks.stream

    def _live(self, lifetime: int | None) -> dict[str, Any]:
        assert self._lifetimes is not None
        if lifetime is None:
            lifetime = int(self._lifetimes[-1]) - 1
        else:
            self._look_ahead(lifetime)
        self._enter(self._tasks.schedule.piece_at(lifetime))
        return infos.of_life(self._phase, np.int64(lifetime))

    def _look_ahead(self, lifetime: int) -> None:
        """Fill the lifetimes of the next steps: those in force until a switch, or the next few."""
        stop = lifetime + _AHEAD
        if self.stream.switch == "step":
            stop = min(stop, self._tasks.schedule.next_switch(lifetime) or stop)
        assert self._lifetimes is not None
        self._lifetimes[:] = np.arange(stop, lifetime, -1)

    def _enter(self, piece: int) -> None:
        """Put another piece in force; the episode, if one is running, goes on."""
        if piece == self._piece:
            return
        self._piece, self._task = piece, self._tasks.tasks[piece]
        self._phase = self._tasks.phases[piece]
        self._phase_shown = self._tasks.shown(int(self._phase))
        lane = self._lane
        self._load_engine()
        self._lane[:] = lane

    def _after(
        self, end: float, action: Action, info: dict[str, Any], observation: Observation
    ) -> float:
        assert self._lifetimes is not None
        if end < 0.0:
            self._lifetimes.append(info["lifetime"])  # nothing was lived
        elif not self._lifetimes:
            lifetime = int(info["lifetime"])
            self._look_ahead(lifetime)
            if self.stream.switch == "step":
                self._enter(self._tasks.schedule.piece_at(lifetime))
                S = self.sme_spec.state_dim
                waiting = self._lane[LANE_VALUES + ACCUMULATED_REWARD] / self.sme_spec.k
                observation[S + 1], observation[S + 2 :] = min(waiting, 1.0), self._phase_shown
        return super()._after(end, action, info, observation)

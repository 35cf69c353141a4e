"""`Batch`: parallel episodes of a single agent or a team, the core of all batched environments.

It holds the state, completed steps and r_cum of `B` lanes, and steps them with the compiled engine.
Each environment decides what its agents observe and what happens at the end of an episode. A team
of n agents is stepped as one: its joint observation is s, t/T and every agent's r_cum/k.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from sme_registry.compiled import engine
from sme_registry.compiled.engine import StepMany
from sme_registry.compiled.values import ROWS, ROWS_WITH_SAFETY
from sme_registry.envs.arguments import not_finite_error
from sme_registry.envs.extension import Extended, reset_options
from sme_registry.envs.types import Array, Lanes, Mask, Observation
from sme_registry.errors import ActionError
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task import Task, observe
from sme_registry.task.memory import check_limit

_FLOAT64 = np.dtype(np.float64)
_AHEAD = 16  # states drawn at once for a lane
_MAX_NUMBERS = 2**19  # held in advance for all lanes, 4 MiB
_KEPT = 3  # a loop holds an observation and the next one while a step writes the third


class BatchStep(NamedTuple):
    """The result of one step of all lanes; no later step writes to an array that is still held.

    Attributes:
      observation: `[B, S + 1 + n]` float32: s, t/T, and each agent's r_cum/k. Of a stream that
        shows its phase, one-hot behind them. With `observation`, M(s, d) `[S + m]` in place of s.
      optimal: `[B, A]` π* of the states acted in, in the unit range.
      values: `[5, n, B]` the rows of `compiled.values`: similarity, step reward, regret, reward,
        and r_cum after a payout; with `safety` also cost and safe regret.
      terminated: `[B]`.
      truncated: `[B]`.
      limits: `[2, B, A]` the limits and the safe action in the states acted in, in the unit range;
        without `safety` `[2, B, 0]`.
    """

    observation: Observation
    optimal: Array
    values: Array
    terminated: Mask
    truncated: Mask
    limits: Array


class _Arrays(NamedTuple):
    """What a step writes besides the state; see `BatchStep`. `ends` is `[2, B]`."""

    observation: Observation
    optimal: Array
    values: Array
    ends: Mask
    limits: Array


class _Results:
    """Arrays for the results of steps, written again once nobody holds them.

    They are too large for NumPy's cache of small arrays: fresh ones at each step can make the heap
    shrink and grow each time, for half as much time again with 1,024 lanes and three times as much
    with 4,096. So the last few are kept, and used again when their reference counts show that they
    are alone.

    Views of them are handed out, never they themselves. A view holds its array, as do a view or
    slice of it, its memoryview, and a tensor that shares its memory; and what a user does to a
    view, such as setting its shape, does not outlive it.
    """

    def __init__(
        self, lanes: int, observation_dim: int, action_dim: int, agents: int, *, safety: bool
    ) -> None:
        rows, limited = (ROWS_WITH_SAFETY, action_dim) if safety else (ROWS, 0)
        self._shapes = (
            (lanes, observation_dim), (lanes, action_dim), (rows, agents, lanes),
            (2, lanes, limited),
        )  # fmt: skip
        self._kept: list[_Arrays] = []

    def take(self) -> tuple[_Arrays, BatchStep]:
        """Arrays that nobody else holds, with undefined content, and the result that views them."""
        for arrays in self._kept:
            if _references(arrays) == _ALONE:
                break
        else:
            arrays = self._allocate()
            self._kept = [*self._kept[1 - _KEPT :], arrays]
        observation, optimal, values, ends, limits = arrays
        views = observation[:], optimal[:], values[:], ends[0], ends[1], limits[:]
        return arrays, BatchStep(*views)

    def _allocate(self) -> _Arrays:
        observation, optimal, values, limits = self._shapes
        return _Arrays(
            np.empty(observation, np.float32),
            np.empty(optimal),
            np.empty(values),
            np.empty((2, observation[0]), bool),
            np.empty(limits),
        )


def _references(arrays: _Arrays) -> list[int]:
    """How often each array is referenced."""
    return [*map(sys.getrefcount, arrays)]


# Measured, since versions of Python differ in what they count.
_ALONE = _references(_Results(1, 1, 1, 1, safety=True)._allocate())


def refuse_large_batch(lanes: int, lane_bytes: int) -> None:
    """Raise ResourceLimitError where lanes of so many bytes each would not fit in memory."""
    check_limit(lanes * lane_bytes, f"num_envs={lanes}: a batch this large", "Use fewer lanes.")


class InitialStates:
    """The initial states of a batch: uniform in the cube, drawn in advance, a generator per lane.

    Lane i draws what a single environment with its seed would draw, in the same order. Drawing one
    state from each of 1,024 generators costs as much as six steps of the whole batch. Drawing
    sixteen states at once costs little more and gives the same numbers.
    """

    def __init__(self, lanes: int, state_dim: int) -> None:
        self._generators: list[np.random.Generator | None] = [None] * lanes
        self._ahead = max(1, min(_AHEAD, _MAX_NUMBERS // (lanes * state_dim)))
        self._drawn = np.empty((lanes, self._ahead, state_dim))
        self._used = np.full(lanes, self._ahead)

    def seed(self, lane: int, seed: int) -> None:
        """Restart a lane's stream."""
        self._generators[lane] = seeding.np_random(seed)[0]
        self._used[lane] = self._ahead

    def draw(self, lanes: Lanes) -> Array:
        """The next state of each of these lanes, `[len(lanes), state_dim]`."""
        for lane in lanes[self._used[lanes] == self._ahead].tolist():
            generator = self._generators[lane]
            if generator is None:
                generator = self._generators[lane] = seeding.np_random(None)[0]
            generator.random(out=self._drawn[lane])
            self._used[lane] = 0
        states: Array = self._drawn[lanes, self._used[lanes]]
        self._used[lanes] += 1
        return states


class Batch:
    """`lanes` episodes of one task, stepped together.

    Args:
      task: the task.
      lanes: B, at least 1.
      reuse: write each step into the arrays of the step before the last, for environments that
        copy their results anyway; a small batch spends a third of its time on handing out arrays.

    Raises:
      ResourceLimitError: a batch this large would not fit in memory.
    """

    lived: Mapping[str, Lanes] = MappingProxyType({})  # `life()` at the end of the last step

    def __init__(self, task: Task, lanes: int, *, reuse: bool = False) -> None:
        S, A, n = task.spec.state_dim, task.spec.action_dim, len(task.policies)
        self._shape = (lanes, A)
        width = S + task.spec.distractors
        refuse_large_batch(lanes, 8 * (5 * width + 12 * A + 20 * n + 48))
        self.task, self.lanes = task, lanes
        self._extended = Extended(task, lanes) if task.spec.extended else None
        self.initial_states = InitialStates(lanes, S)
        # Channel by channel, [S, B] and [n, B], as the compiled step reads them.
        self._s = np.zeros((S, lanes))
        self._t = np.zeros(lanes, np.int64)
        self._accumulated = np.zeros((n, lanes))
        self._reuse = reuse
        self._load_engine()

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What is run: the task's spec."""
        return self.task.spec

    @property
    def observation_dim(self) -> int:
        """Entries of a joint observation: S, the distractors, 1 + n."""
        return self.task.spec.observation_dim - 1 + len(self._accumulated)

    @property
    def reset_options(self) -> tuple[str, ...]:
        """The options of an environment's reset."""
        return reset_options(self.task.spec)

    def _load_engine(self) -> None:
        S, A, n = self.task.spec.state_dim, self.task.spec.action_dim, len(self._accumulated)
        self._step_many: StepMany = engine(self.task).step_many
        self._moved = np.empty((S, self.lanes))
        safety = self.task.spec.safety is not None
        results = _Results(self.lanes, self.observation_dim, A, n, safety=safety)
        in_turn = itertools.cycle([results.take(), results.take()])
        self._take = in_turn.__next__ if self._reuse else results.take

    # Machine code cannot be pickled or copied: the copy loads it, and has arrays of its own.
    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_step_many", "_moved", "_take")
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load_engine()

    @property
    def state(self) -> Array:
        """The states, `[B, S]` float64 in [0, 1] (a copy)."""
        return self._s.T.copy()  # a copy even where the transpose is contiguous

    @property
    def distractors(self) -> Array:
        """The distractors, `[B, m]` float64 in [0, 1] (a copy)."""
        return np.empty((self.lanes, 0)) if self._extended is None else self._extended.distractors

    def task_of(self, lane: int) -> Task:
        """The task of a lane, which is that of every lane."""
        return self.task

    def life(self) -> dict[str, Lanes]:
        """What infos say of each lane's life, `[B]`, at a reset; nothing, for a task."""
        return {}

    def life_of(self, lane: int) -> dict[str, Any]:
        """The same of one lane, as NumPy's numbers."""
        return {}

    def seed(self, lane: int, seed: int) -> None:
        """Restart the generators of a lane."""
        self.initial_states.seed(lane, seed)
        if self._extended is not None:
            self._extended.seed(lane, seed)

    def seed_by_states(self, lanes: Lanes, states: Array, seed: int = 0) -> None:
        """Restart the distractors of lanes from initial states `[len(lanes), S]` and a seed.

        Equal states and seeds give equal distractors, in any lane: so episodes whose states come
        from a named stream need no other random numbers to be reproducible.
        """
        if self._extended is not None:
            self._extended.seed_by_states(lanes, states, seed)

    def live(self, lane: int, lifetime: int) -> None:
        """Let a lane's life, if it lives through a stream, go on after so many steps."""

    def observe(self) -> Observation:
        """The present joint observations of all lanes, `[B, observation_dim]`."""
        plain = observe(self.task.spec, self.state, self._t, self._accumulated.T)
        if self._extended is None:
            return plain
        seen = self._extended.seen(self.state, np.arange(self.lanes))
        return np.concatenate([seen, plain[:, self.task.spec.state_dim :]], axis=1)

    def begin(
        self,
        lanes: Lanes,
        observation: Observation,
        states: Array | None = None,
        distractors: Array | None = None,
    ) -> None:
        """Put lanes at the start of an episode, and write their rows of `observation`.

        `states` are `[len(lanes), S]` and `distractors` `[len(lanes), m]`; None draws them from
        each lane's generators.
        """
        if states is None:
            states = self.initial_states.draw(lanes)
        self._s[:, lanes] = states.T
        self._t[lanes] = 0
        self._accumulated[:, lanes] = 0.0
        shown: npt.NDArray[Any] = states
        if self._extended is not None:
            self._extended.begin(lanes, distractors)
            shown = self._extended.seen(states, lanes)
        width = shown.shape[1]
        observation[lanes, :width] = shown
        observation[lanes, width:] = 0.0

    def place(
        self, states: Array, t: Lanes, accumulated: Array, distractors: Array | None = None
    ) -> None:
        """Put every lane at any point of an episode; `observe` gives the observations there.

        States are `[B, S]`, completed steps t `[B]` in [0, T), each agent's r_cum `[B, n]`, and
        distractors `[B, m]`; None draws them.
        """
        self._s[:] = states.T
        self._t[:] = t
        self._accumulated[:] = accumulated.T
        if self._extended is not None:
            self._extended.begin(np.arange(self.lanes), distractors)

    def advance(self, actions: Array, resting: Mask | None = None) -> BatchStep:
        """One step of every lane.

        Args:
          actions: `[B, A]` float64 of the unit range; clipped.
          resting: `[B]` lanes whose step is not one of their environment, since their episodes have
            ended; None: no lane.

        Raises:
          ActionError: of another shape, or not finite; no lane has changed then.
        """
        # Machine code does not check shape, dtype and layout: any other would be misread.
        if actions.shape != self._shape:
            raise ActionError(f"action of shape {actions.shape}: must be of shape {self._shape}.")
        if actions.dtype is not _FLOAT64 or not actions.flags.c_contiguous:
            actions = np.ascontiguousarray(actions, dtype=np.float64)
        moved = self._moved
        arrays, result = self._take()
        observation, optimal, values, ends, limits = arrays
        if not self._step_many(
            self._s, self._t, self._accumulated, actions, moved, observation, optimal, values, ends
        ):
            raise not_finite_error()
        self._s, self._moved = moved, self._s
        if self._extended is not None:
            self._extended.extend(
                self._moved, moved, actions, optimal, values, observation, limits, resting
            )
        return result

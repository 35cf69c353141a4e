"""`Batch`: parallel episodes of a single agent or a team, the core of all batched environments.

It holds the state, completed steps and r_cum of `B` lanes, and steps them with the compiled engine.
Each environment decides what its agents observe and what happens at the end of an episode. A team
of n agents is stepped as one: its joint observation is s, t/T and every agent's r_cum/k.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding

from sme_registry.compiled import engine
from sme_registry.compiled.values import ROWS
from sme_registry.envs.arguments import not_finite_error
from sme_registry.envs.types import Array, Lanes, Mask, Observation
from sme_registry.errors import ActionError
from sme_registry.task import Task, observe
from sme_registry.task.memory import refuse_above_limit

_FLOAT64 = np.dtype(np.float64)
_AHEAD = 16  # states drawn at once for a lane
_MAX_NUMBERS = 2**19  # held in advance for all lanes, 4 MiB


class BatchStep(NamedTuple):
    """The result of one step of all lanes; every array is fresh, unless the batch reuses them.

    Attributes:
      observation: `[B, S + 1 + n]` float32: s, t/T, and each agent's r_cum/k.
      optimal: `[B, A]` π* of the states acted in, in the unit range.
      values: `[5, n, B]` the rows of `compiled.values`: similarity, step reward, regret, reward,
        and r_cum after a payout.
      terminated: `[B]`.
      truncated: `[B]`.
    """

    observation: Observation
    optimal: Array
    values: Array
    terminated: Mask
    truncated: Mask


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
        copy their results anyway; a small batch spends a fifth of its time on fresh arrays.

    Raises:
      ResourceLimitError: a batch this large would not fit in memory.
    """

    def __init__(self, task: Task, lanes: int, *, reuse: bool = False) -> None:
        S, A, n = task.spec.state_dim, task.spec.action_dim, len(task.policies)
        self._shapes = (S, lanes), (lanes, S + 1 + n), (lanes, A), (ROWS, n, lanes), (2, lanes)
        refuse_above_limit(
            lanes * 8 * (4 * S + 4 * A + 16 * n + 48),
            f"num_envs={lanes}: a batch this large",
            "Use fewer lanes.",
        )
        self.task, self.lanes = task, lanes
        self.initial_states = InitialStates(lanes, S)
        # Channel by channel, [S, B] and [n, B], as the compiled step reads them.
        self._s = np.zeros((S, lanes))
        self._t = np.zeros(lanes, np.int64)
        self._accumulated = np.zeros((n, lanes))
        self._reuse = reuse
        self._load_engine()

    def _allocate(self) -> tuple[Array, Mask, BatchStep]:
        """What a step writes: next states, ends, and its result, which includes the ends."""
        state, observation, optimal, values, ends = self._shapes
        ended = np.empty(ends, bool)
        result = BatchStep(
            np.empty(observation, np.float32),
            np.empty(optimal),
            np.empty(values),
            terminated=ended[0],
            truncated=ended[1],
        )
        return np.empty(state), ended, result

    def _load_engine(self) -> None:
        self._step_many = engine(self.task).step_many
        # Two sets in turn: a step reads the state from the one that it does not write.
        self._arrays = (self._allocate(), self._allocate()) if self._reuse else None

    # Neither machine code nor views can be pickled or copied: the copy recreates both.
    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_step_many", "_arrays")
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load_engine()

    @property
    def state(self) -> Array:
        """The states, `[B, S]` float64 in [0, 1] (a copy)."""
        return self._s.T.copy()  # a copy even where the transpose is contiguous

    def observe(self) -> Observation:
        """The present joint observations of all lanes, `[B, S + 1 + n]`."""
        return observe(self.task.spec, self.state, self._t, self._accumulated.T)

    def begin(self, lanes: Lanes, observation: Observation, states: Array | None = None) -> None:
        """Put lanes at the start of an episode, and write their rows of `observation`.

        `states` are `[len(lanes), S]`; None draws from each lane's generator.
        """
        S = self.task.spec.state_dim
        if states is None:
            states = self.initial_states.draw(lanes)
        self._s[:, lanes] = states.T
        self._t[lanes] = 0
        self._accumulated[:, lanes] = 0.0
        observation[lanes, :S] = states
        observation[lanes, S:] = 0.0

    def place(self, states: Array, t: Lanes, accumulated: Array) -> None:
        """Put every lane at any point of an episode; `observe` gives the observations there.

        States are `[B, S]`, completed steps t `[B]` in [0, T), and each agent's r_cum `[B, n]`.
        """
        self._s[:] = states.T
        self._t[:] = t
        self._accumulated[:] = accumulated.T

    def advance(self, actions: Array) -> BatchStep:
        """One step of every lane.

        Args:
          actions: `[B, A]` float64 of the unit range; clipped.

        Raises:
          ActionError: of another shape, or not finite; no lane has changed then.
        """
        # Machine code does not check shape, dtype and layout: any other would be misread.
        if actions.shape != self._shapes[2]:
            raise ActionError(
                f"action of shape {actions.shape}: must be of shape {self._shapes[2]}."
            )
        if actions.dtype is not _FLOAT64 or not actions.flags.c_contiguous:
            actions = np.ascontiguousarray(actions, dtype=np.float64)
        if self._arrays is None:
            arrays = self._allocate()
        else:
            arrays, other = self._arrays
            self._arrays = other, arrays
        moved, ended, result = arrays
        if not self._step_many(
            self._s, self._t, self._accumulated, actions,
            moved, result.observation, result.optimal, result.values, ended,
        ):  # fmt: skip
            raise not_finite_error()
        self._s = moved
        return result

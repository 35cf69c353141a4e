"""`Batch`: parallel episodes of a single agent or a team, the core of all batched environments.

It holds the state, completed steps and r_cum of `B` environments, and steps them with the compiled
engine. A team of n agents is stepped as one: its joint observation is s, t/T and every r_cum/k.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import not_finite_error
from sme_registry.envs.random import InitialStates, StepNumbers
from sme_registry.envs.schedule import Schedule
from sme_registry.errors import ActionError
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task import Task
from sme_registry.task.engine import Engine, StepMany, engine
from sme_registry.task.episode import shaping_at_switch
from sme_registry.task.loading import check_memory
from sme_registry.task.task import (
    ACCUMULATED_REWARD,
    COST,
    REWARD,
    SHAPING,
    Array,
    Indices,
    Mask,
    Observation,
    own_rows,
)

_FLOAT64 = np.dtype(np.float64)
_KEPT = 3  # a loop holds an observation and the next one while a step writes the third


class BatchStep(NamedTuple):
    """One step of a batch, of the states acted in; no later step writes to an array still held."""

    observation: Observation  # `[B, …]`: s or M(s, d), t/T, each agent's r_cum/k, a shown phase
    actions: Array  # `[1 or 3, B, A]` of the unit range: π*; with `safety` limits and safe actions
    values: Array  # `[5 … 10, n, B]`: the rows of `task.task`
    terminated: Mask
    truncated: Mask

    @property
    def optimal(self) -> Array:
        optimal: Array = self.actions[0]
        return optimal


_Arrays: TypeAlias = tuple[Observation, Array, Array, Mask]
"""What a step writes besides the state: observation, actions, values, ends `[2, B]`."""


class _Results:
    """Arrays for the results of steps, written again once nobody holds them.

    Fresh ones at each step can make the heap shrink and grow: three times the time of a step with
    4,096 environments. Views of them are handed out, which hold their array, as do slices and
    tensors of it; what a user does to a view does not outlive it.
    """

    def __init__(self, num_envs: int, observation_dim: int, actions: Any, values: Any) -> None:
        self._shapes = (num_envs, observation_dim), actions, values, (2, num_envs)
        self._kept: list[_Arrays] = []

    def take(self) -> tuple[_Arrays, BatchStep]:
        """Arrays that nobody else holds, with undefined content, and the result that views them."""
        for arrays in self._kept:
            if _references(arrays) == _ALONE:
                break
        else:
            arrays = self._allocate()
            self._kept = [*self._kept[1 - _KEPT :], arrays]
        observation, actions, values, ends = arrays
        return arrays, BatchStep(observation[:], actions[:], values[:], ends[0], ends[1])

    def _allocate(self) -> _Arrays:
        observation, actions, values, ends = self._shapes
        numbers = np.empty(actions), np.zeros(values)  # not every task writes every row
        return np.empty(observation, np.float32), *numbers, np.empty(ends, bool)


def _references(arrays: _Arrays) -> list[int]:
    return [*map(sys.getrefcount, arrays)]


# Measured, since versions of Python differ in what they count.
_ALONE = _references(_Results(1, 1, (1, 1, 1), (1, 1, 1))._allocate())


class Batch:
    """`num_envs` episodes of one task, or lives of one stream, stepped together.

    Each environment has its own lifetime and segment of a stream. While one task is in force in all
    of them, as it nearly always is, it steps the batch; else those of each segment are a group.
    With `reuse`, for environments that copy their results, steps write into two sets of arrays in
    turn. A `limit` below the horizon truncates episodes after so many steps, and pays r_cum.
    """

    def __init__(
        self,
        schedule: Schedule | Task,
        num_envs: int,
        *,
        reuse: bool = False,
        limit: int | None = None,
    ) -> None:
        self.schedule = schedule if isinstance(schedule, Schedule) else Schedule.of(schedule)
        self.num_envs = num_envs
        spec, n = self.task.spec, len(self.task.policies)
        S, A, m = spec.state_dim, spec.action_dim, spec.distractors
        P = self.document.observed_phases
        check_memory(
            num_envs * 8 * (5 * (S + own_rows(spec)) + 12 * A + 20 * n + 44 + 3 * P),
            f"num_envs={num_envs}: a batch this large",
            "Use fewer environments.",
        )
        self._shape = (num_envs, A)
        self._envs = np.arange(num_envs)
        self.observation_dim = S + m + 1 + n + P  # of all agents
        self._of_t, self._of_phase = S + m, S + m + 1 + n  # columns of the observation
        self.initial_states = InitialStates(num_envs, S)
        self._numbers = StepNumbers(self.document.specs, num_envs)
        # Channel by channel, [S, B] and [n, B], as the compiled step reads them.
        self._s = np.zeros((S, num_envs))
        self._t = np.zeros(num_envs, np.int64)
        self._accumulated = np.zeros((n, num_envs))
        self._segment, self._lifetime = np.zeros((2, num_envs), np.int64)
        self._next_switch = np.zeros(num_envs, np.int64)  # at the first `begin` each may switch
        self._soonest = 0  # so many steps at least until a segment is over
        self.lived: dict[str, Indices] = {}  # what infos say of each life in the last step
        self._reuse = reuse
        self._limit = limit if limit is not None and limit < self.document.horizon else None
        self._load_engine()

    @property
    def document(self) -> SMESpec | StreamSpec:
        return self.schedule.document

    @property
    def task(self) -> Task:
        """The task of the first segment, with the shapes of all."""
        return self.schedule.tasks[0]

    @property
    def one_task(self) -> Task | None:
        """The task in force where it is the same in every environment."""
        return self.task_of(0) if len(self._groups) == 1 else None

    @property
    def state(self) -> Array:
        return self._s.T.copy()  # a copy even where the transpose is contiguous

    @property
    def distractors(self) -> Array:
        return self._numbers.distractors

    @property
    def noise(self) -> Array:
        """ξ of each agent and ζ of the next step, `[B, n + S]`."""
        return self._numbers.noise

    def _load_engine(self) -> None:
        self._engines: dict[int, Engine] = {}
        self._see = self._engine_of(0).seen
        self._moved = np.empty_like(self._s)
        columns, (B, A), n = self.schedule.columns, self._shape, len(self._accumulated)
        shapes = (len(columns.actions), B, A), (columns.rows, n, B)
        results = _Results(B, self.observation_dim, *shapes)
        in_turn = itertools.cycle([results.take(), results.take()])
        self._take = in_turn.__next__ if self._reuse else results.take
        self._put_in_force()

    # Machine code cannot be pickled or copied: the copy loads it, and has arrays of its own.
    def __getstate__(self) -> dict[str, Any]:
        dropped = {"_engines", "_see", "_moved", "_take", "_step_many", "_groups"}
        return {name: value for name, value in vars(self).items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._load_engine()

    def task_of(self, env: int) -> Task:
        return self.schedule.tasks[int(self._segment[env])]

    def life(self) -> dict[str, Indices]:
        """What infos say of each life, fresh arrays `[B]`: phase and steps lived; or nothing."""
        return self.schedule.life(self._phase.copy(), self._lifetime.copy())

    def life_of(self, env: int) -> dict[str, Any]:
        return self.schedule.life(self._phase[env], self._lifetime[env])

    def info_of(self, step: BatchStep, env: int, rescaled: bool) -> dict[str, Any]:
        """The info of one environment's step: all its actions, and means over its agents."""
        values = step.values[:, :, env].mean(axis=1)
        return self.schedule.columns.at_step(step.actions[:, env], values, rescaled)

    def seed(self, env: int, seed: int) -> None:
        """Restart an environment's generators, and its life."""
        self.initial_states.seed(env, seed)
        self._numbers.seed(env, seed)
        self.live(env, 0)

    def seed_by_states(self, envs: Indices, states: Array, seed: int = 0) -> None:
        """Restart distractors from initial states `[len(envs), S]` and a seed, alike anywhere."""
        if self._numbers.are_drawn:
            for env, s in zip(envs.tolist(), states, strict=True):
                word = int.from_bytes(s.astype("<f8").tobytes(), "little")
                self._numbers.seed(env, seed + word)

    def live(self, env: int, lifetime: int) -> None:
        """Let a life go on after so many steps, at its next `begin`."""
        self._lifetime[env] = lifetime
        self._next_switch[env] = 0

    def observe(self) -> Observation:
        """The present joint observations, `[B, observation_dim]`."""
        observation = np.empty((self.num_envs, self.observation_dim), np.float32)
        self._write_seen(self._s, self._envs, observation)
        observation[:, self._of_t] = self._t / self.task.spec.horizon
        self._write_segment(self._envs, observation)
        return observation

    def begin(
        self,
        envs: Indices,
        observation: Observation,
        states: Array | None = None,
        distractors: Array | None = None,
    ) -> None:
        """Put environments at the start of an episode, and write their rows of `observation`.

        `states` are `[len(envs), S]` and `distractors` `[len(envs), m]`; None draws them.
        """
        self._switch(envs)
        if states is None:
            states = self.initial_states.draw(envs)
        self._s[:, envs] = states.T
        self._t[envs] = 0
        self._accumulated[:, envs] = 0.0
        self._numbers.begin(envs, distractors)
        self._write_seen(states.T, envs, observation)
        observation[envs, self._of_t : self._of_phase] = 0.0
        observation[envs, self._of_phase :] = self._one_hot[envs]

    def snapshot(self) -> dict[str, npt.NDArray[Any]]:
        """What the next steps of a task follow from, besides its spec and the seeds: copies."""
        return {
            "states": self._s.copy(),
            "t": self._t.copy(),
            "accumulated": self._accumulated.copy(),
            **self._numbers.snapshot(),
            "begun": self.initial_states.count.copy(),
        }

    def restore(self, snapshot: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from a snapshot of this task, after `seed` of every environment."""
        self._s[:] = snapshot["states"]
        self._t[:] = snapshot["t"]
        self._accumulated[:] = snapshot["accumulated"]
        self._numbers.restore(snapshot)
        for env, count in enumerate(snapshot["begun"].tolist()):
            self.initial_states.skip(env, count)

    def place(
        self, states: Array, t: Indices, accumulated: Array, distractors: Array | None = None
    ) -> None:
        """Put every environment at any point of an episode; `observe` gives what is seen there.

        States `[B, S]`, steps t `[B]` in [0, T), r_cum `[B, n]`, distractors `[B, m]`; None draws.
        """
        self._s[:] = states.T
        self._t[:] = t
        self._accumulated[:] = accumulated.T
        self._numbers.begin(self._envs, distractors)

    def advance(self, actions: Array, resting: Mask | None = None) -> BatchStep:
        """One step, from actions `[B, A]` of the unit range, clipped; ActionError changes nothing.

        Environments `resting` `[B]`, whose episode has ended, neither live nor draw numbers.
        """
        # Machine code does not check shape, dtype and layout: any other would be misread.
        if actions.shape != self._shape:
            raise ActionError(f"action of shape {actions.shape}: must be of shape {self._shape}.")
        if actions.dtype is not _FLOAT64 or not actions.flags.c_contiguous:
            actions = np.ascontiguousarray(actions, dtype=np.float64)
        own, moved = self._numbers.own, self._moved
        kept = None if resting is None else own[:, resting]
        arrays, result = self._take()
        observation, optimal, values, ends = arrays
        if self.schedule.is_stream:
            values[COST:] = 0.0  # the rows that not every task of a stream has
        if not self._step_many(
            self._s, self._t, self._accumulated, own, actions, moved,
            observation, optimal, values, ends,
        ):  # fmt: skip
            raise not_finite_error()
        self._s, self._moved = moved, self._s
        self._numbers.draw_noise()
        if kept is not None:
            own[:, resting] = kept
        if self.schedule.is_stream:
            self._live_on(result, resting)
        if self._limit is not None:
            self._truncate(np.flatnonzero(self._t >= self._limit), result)
        return result

    def _truncate(self, envs: Indices, result: BatchStep) -> None:
        result.truncated[envs] = True
        values, observation = result.values, result.observation
        values[REWARD][:, envs] += self._accumulated[:, envs]
        values[ACCUMULATED_REWARD][:, envs] = 0.0
        self._accumulated[:, envs] = 0.0
        observation[envs, self._of_t + 1 : self._of_phase] = 0.0
        if "shaping" in self.schedule.columns.numbers:
            for env in envs[~result.terminated[envs]].tolist():
                change = shaping_at_switch(self.task_of(env), None, self._s[:, env], self._t[env])
                values[[REWARD, SHAPING], :, env] += change

    def _live_on(self, result: BatchStep, resting: Mask | None) -> None:
        observation = result.observation
        self._lifetime += 1 if resting is None else ~resting
        self.lived = self.life()  # before the switch: of the task in which the action was taken
        if self._one_hot.shape[1]:
            observation[:, self._of_phase :] = self._one_hot
        if self.schedule.switches_within:
            self._soonest -= 1
            if self._soonest <= 0:
                envs = np.flatnonzero(self._lifetime >= self._next_switch)
                before = self._segment[envs]
                self._switch(envs)
                self._write_segment(envs, observation)
                self._pay_switch(envs, before, result)
                self._soonest = self._until_switch()

    def _switch(self, envs: Indices) -> None:
        """Put the next segment in force in those of these environments whose segment is over."""
        over = envs[self._lifetime[envs] >= self._next_switch[envs]]
        if over.size:
            lifetimes, which = np.unique(self._lifetime[over], return_inverse=True)
            times = self.schedule.times
            segments = np.array([times.segment_at(lifetime) for lifetime in lifetimes.tolist()])
            switches = np.array([times.next_switch(lifetime) for lifetime in lifetimes.tolist()])
            self._segment[over], self._next_switch[over] = segments[which], switches[which]
            self._put_in_force()

    def _pay_switch(self, envs: Indices, before: Indices, result: BatchStep) -> None:
        """Pay what the segments now in force change in the shaping of the last step."""
        if "shaping" not in self.schedule.columns.numbers:
            return
        for env, segment in zip(envs.tolist(), before.tolist(), strict=True):
            if not (result.terminated[env] or result.truncated[env]):
                tasks = self.schedule.tasks[segment], self.task_of(env)
                change = shaping_at_switch(*tasks, self._s[:, env], self._t[env])
                result.values[[REWARD, SHAPING], :, env] += change

    def _until_switch(self) -> int:
        return int((self._next_switch - self._lifetime).min())

    def _put_in_force(self) -> None:
        """Prepare what depends on the segments: what steps the batch, and what is shown."""
        segments = np.unique(self._segment).tolist()
        steps = [self._engine_of(segment).step_many() for segment in segments]
        envs = [np.flatnonzero(self._segment == segment) for segment in segments]
        self._groups = [*zip(steps, envs, strict=True)]
        self._step_many: StepMany = steps[0] if len(steps) == 1 else self._step_groups
        self._phase = self.schedule.phases[self._segment]
        self._one_hot = self.schedule.one_hot(self._phase)
        self._k = self.schedule.k[self._segment]
        self._soonest = self._until_switch()

    def _engine_of(self, segment: int) -> Engine:
        if segment not in self._engines:
            self._engines[segment] = engine(self.schedule.tasks[segment])
        return self._engines[segment]

    def _step_groups(
        self,
        s: Array,
        t: Indices,
        accumulated: Array,
        own: Array,
        action: Array,
        moved: Array,
        observation: Observation,
        actions: Array,
        values: Array,
        ends: Mask,
    ) -> bool:
        """One step as `StepMany`, by the step of each environment's segment."""
        groups = []
        for step, envs in self._groups:
            before = s[:, envs], t[envs], accumulated[:, envs], own[:, envs], action[envs]
            after = moved[:, envs], observation[envs], actions[:, envs], values[..., envs]
            arrays = [*map(np.ascontiguousarray, (*before, *after, ends[:, envs]))]
            if not step(*arrays):
                return False  # before any environment has moved
            groups.append((envs, arrays))
        for envs, arrays in groups:
            _, t[envs], accumulated[:, envs], own[:, envs], _, moved[:, envs] = arrays[:6]
            observation[envs], actions[:, envs], values[..., envs], ends[:, envs] = arrays[6:]
        return True

    def _write_seen(self, states: Array, envs: Indices, observation: Observation) -> None:
        observation[envs, : self._of_t] = self._see(self._numbers.beside(states, envs)).T

    def _write_segment(self, envs: Indices, observation: Observation) -> None:
        """Write what depends on the segment in force into rows: each r_cum/k, and the phase."""
        waiting = self._accumulated[:, envs] / self._k[envs]
        observation[envs, self._of_t + 1 : self._of_phase] = np.minimum(waiting, 1.0).T
        observation[envs, self._of_phase :] = self._one_hot[envs]

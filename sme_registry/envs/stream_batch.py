"""`StreamBatch`: lives of a stream, a lane each, stepped together.

Each lane has its own lifetime and phase. While one piece is in force in all of them, as it nearly
always is, the batch is that of its task; else the lanes of each piece are stepped as a group.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sme_registry.compiled import engine
from sme_registry.compiled.engine import StepMany
from sme_registry.envs import infos
from sme_registry.envs.batch import Batch, BatchStep, refuse_large_batch
from sme_registry.envs.stream_tasks import StreamTasks
from sme_registry.envs.types import Array, Lanes, Mask, Observation
from sme_registry.spec import StreamSpec
from sme_registry.task import Task

_NEVER = np.iinfo(np.int64).max


class StreamBatch(Batch):
    """`lanes` lives of one stream. A seed begins the life of its lane anew, at the next `begin`.

    Args:
      tasks: the stream's tasks.
      lanes: B, at least 1.

    Raises:
      ResourceLimitError: a batch this large would not fit in memory.
    """

    def __init__(self, tasks: StreamTasks, lanes: int) -> None:
        refuse_large_batch(lanes, 40 + 20 * tasks.stream.observation_dim)
        self.tasks = tasks
        self._piece, self._lifetime = np.zeros(lanes, np.int64), np.zeros(lanes, np.int64)
        self._next_switch = np.zeros(lanes, np.int64)  # at the first `begin` every lane switches
        self._soonest = 0  # so many steps at most until a lane's piece is over
        super().__init__(tasks.tasks[0], lanes)

    def _load_engine(self) -> None:
        super()._load_engine()
        self._steps: dict[int, StepMany] = {}
        self._put_in_force()

    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_steps", "_groups", "_phase", "_k", "_shown")
        return {k: value for k, value in super().__getstate__().items() if k not in dropped}

    @property
    def document(self) -> StreamSpec:
        """The stream."""
        return self.tasks.stream

    @property
    def observation_dim(self) -> int:
        """Entries of an observation: S + 2, and one for each phase where it shows the phase."""
        return self.tasks.stream.observation_dim

    @property
    def reset_options(self) -> tuple[str, ...]:
        """The options of an environment's reset."""
        return "state", "lifetime"

    @property
    def one_task(self) -> Task | None:
        """The task in force where it is the same in every lane."""
        return self.tasks.tasks[self._piece[0]] if len(self._groups) == 1 else None

    def task_of(self, lane: int) -> Task:
        """The task in force in a lane."""
        return self.tasks.tasks[int(self._piece[lane])]

    def life(self) -> dict[str, Lanes]:
        """The phase in force and the steps lived of each lane, fresh arrays `[B]`."""
        return infos.of_life(self._phase.copy(), self._lifetime.copy())

    def life_of(self, lane: int) -> dict[str, Any]:
        """The same of one lane, as NumPy's numbers."""
        return infos.of_life(self._phase[lane], self._lifetime[lane])

    def seed(self, lane: int, seed: int) -> None:
        """Restart a lane's generator, and its life."""
        super().seed(lane, seed)
        self.live(lane, 0)

    def live(self, lane: int, lifetime: int) -> None:
        """Let a lane's life go on after so many steps, at its next `begin`."""
        self._lifetime[lane] = lifetime
        self._next_switch[lane] = 0

    def observe(self) -> Observation:
        """The present observations of all lanes."""
        S = self.task.spec.state_dim
        observation = np.empty((self.lanes, self.observation_dim), np.float32)
        observation[:, : S + 2] = super().observe()
        self._show(np.arange(self.lanes), observation)
        return observation

    def begin(
        self,
        lanes: Lanes,
        observation: Observation,
        states: Array | None = None,
        distractors: Array | None = None,
    ) -> None:
        """As `Batch.begin`, in the piece that is in force after the steps lived."""
        self._switch(lanes)
        super().begin(lanes, observation, states, distractors)
        self._show(lanes, observation)

    def advance(self, actions: Array, resting: Mask | None = None) -> BatchStep:
        """As `Batch.advance`; lanes that rest do not live."""
        result = super().advance(actions, resting)
        self._lifetime += 1 if resting is None else ~resting
        self.lived = self.life()  # before the switch: of the task in which the action was taken
        if self._shown.shape[1]:
            result.observation[:, self.task.spec.state_dim + 2 :] = self._shown
        if self.document.switch == "step":
            self._soonest -= 1
            if self._soonest <= 0:
                lanes = np.flatnonzero(self._lifetime >= self._next_switch)
                self._switch(lanes)
                self._show(lanes, result.observation)
        return result

    def _switch(self, lanes: Lanes) -> None:
        """Put the next piece in force in those of these lanes whose piece is over."""
        over = lanes[self._lifetime[lanes] >= self._next_switch[lanes]]
        if over.size:
            lifetimes, which = np.unique(self._lifetime[over], return_inverse=True)
            schedule = self.tasks.schedule
            pieces = [schedule.piece_at(lifetime) for lifetime in lifetimes.tolist()]
            switches = [schedule.next_switch(lifetime) or _NEVER for lifetime in lifetimes.tolist()]
            self._piece[over] = np.array(pieces)[which]
            self._next_switch[over] = np.array(switches)[which]
            self._put_in_force()
        self._soonest = int((self._next_switch - self._lifetime).min())

    def _put_in_force(self) -> None:
        """Prepare what depends on the pieces: what steps the lanes, and what these show."""
        pieces = np.unique(self._piece)
        self._groups = [(self._step_of(i), np.flatnonzero(self._piece == i)) for i in pieces]
        self._step_many = self._groups[0][0] if len(pieces) == 1 else self._step_groups
        self._phase = self.tasks.phases[self._piece]
        self._shown = self.tasks.shown(self._phase)
        self._k = self.tasks.k[self._piece]

    def _step_of(self, piece: int) -> StepMany:
        if piece not in self._steps:
            self._steps[piece] = engine(self.tasks.tasks[piece]).step_many
        return self._steps[piece]

    def _step_groups(
        self,
        s: Array,
        t: Lanes,
        accumulated: Array,
        action: Array,
        moved: Array,
        observation: Observation,
        optimal: Array,
        values: Array,
        ends: Mask,
    ) -> bool:
        """One step of all lanes, as `StepMany`, by the step of each lane's piece."""
        groups = []
        for step, lanes in self._groups:
            before = s[:, lanes], t[lanes], accumulated[:, lanes], action[lanes]
            after = moved[:, lanes], observation[lanes], optimal[lanes], values[..., lanes]
            arrays = [*map(np.ascontiguousarray, (*before, *after, ends[:, lanes]))]
            if not step(*arrays):
                return False  # before any lane has moved
            groups.append((lanes, arrays))
        for lanes, arrays in groups:
            _, t[lanes], accumulated[:, lanes], _, moved[:, lanes] = arrays[:5]
            observation[lanes], optimal[lanes], values[..., lanes], ends[:, lanes] = arrays[5:]
        return True

    def _show(self, lanes: Lanes, observation: Observation) -> None:
        """Write what depends on the piece in force into the lanes' rows: r_cum/k, the phase."""
        S = self.task.spec.state_dim
        waiting = self._accumulated[0, lanes] / self._k[lanes]
        observation[lanes, S + 1] = np.minimum(waiting, 1.0)
        observation[lanes, S + 2 :] = self._shown[lanes]

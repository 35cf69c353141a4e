"""`Extended`: what agents see and what limits them, where a task has `safety` or `observation`.

A batch goes on with `Extended` where the plain step ends, and a single environment with
`ExtendedLane`; both only for such tasks. They hold what these add to the lanes' state:
the distractors, and the place in each lane's stream of random numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sme_registry.compiled import extension
from sme_registry.compiled.extension import draw
from sme_registry.compiled.values import (
    EXTRA_COST,
    EXTRA_OWN,
    EXTRA_SAFE_REGRET,
    LANE_STATE,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
)
from sme_registry.envs.types import Array, Lanes, Mask, Observation
from sme_registry.spec import SMESpec
from sme_registry.task import Task

_KEY_SHIFT = np.uint64(12)  # keys of 52 bits, which a float64 holds exactly


def reset_options(spec: SMESpec) -> tuple[str, ...]:
    """The options of a reset of a task's environments."""
    return ("state", "distractors") if spec.distractors else ("state",)


class Extended:
    """The distractors of `lanes` episodes, and the rest of their steps.

    Distractors and the random numbers that move them come from streams of their own, so that the
    initial states are those of the task without `observation`. A lane that is never seeded has a
    random one.

    Args:
      task: a task with `safety` or `observation`.
      lanes: B, at least 1.
    """

    def __init__(self, task: Task, lanes: int) -> None:
        self._task = task
        self._own = np.zeros((OWN_DISTRACTORS + task.spec.distractors, lanes))
        words = np.random.SeedSequence().generate_state(lanes, np.uint64)
        self._own[OWN_KEY] = words >> _KEY_SHIFT
        self._load()

    def _load(self) -> None:
        self.compiled = extension(self._task)
        self._extend_many = self.compiled.extend_many

    # Machine code cannot be pickled or copied: the copy looks it up again.
    def __getstate__(self) -> dict[str, Any]:
        return {"_task": self._task, "_own": self._own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load()

    @property
    def distractors(self) -> Array:
        """The distractors, `[B, m]` float64 in [0, 1] (a copy)."""
        return self._own[OWN_DISTRACTORS:].T.copy()

    def seed(self, lane: int, seed: int) -> None:
        """Restart a lane's stream. It is none of those that the seed gives to initial states."""
        (word,) = np.random.SeedSequence(seed, spawn_key=(1,)).generate_state(1, np.uint64)
        self._own[OWN_KEY, lane] = word >> _KEY_SHIFT
        self._own[OWN_DRAWN, lane] = 0.0

    def seed_by_states(self, lanes: Lanes, states: Array, seed: int) -> None:
        """Restart the streams of lanes from their initial states; see `Batch.seed_by_states`."""
        if not self._task.spec.distractors:
            return
        for lane, s in zip(lanes.tolist(), states, strict=True):
            self.seed(lane, seed + int.from_bytes(s.astype("<f8").tobytes(), "little"))

    def begin(self, lanes: Lanes, distractors: Array | None = None) -> None:
        """Put distractors `[len(lanes), m]` into lanes that begin an episode; None draws them."""
        if distractors is None:
            own = self._own[:, lanes]
            distractors = draw(own, self._task.spec.distractors)
            self._own[OWN_DRAWN, lanes] = own[OWN_DRAWN]
        self._own[OWN_DISTRACTORS:, lanes] = distractors.T

    def seen(self, states: Array, lanes: Lanes) -> Observation:
        """What the agents of some lanes see of states `[len(lanes), S]`, `[len(lanes), S + m]`."""
        x = np.concatenate([states.T, self._own[OWN_DISTRACTORS:, lanes]])
        return self.compiled.seen(x).T.astype(np.float32)

    def extend(
        self,
        before: Array,
        after: Array,
        action: Array,
        optimal: Array,
        values: Array,
        observation: Observation,
        limits: Array,
        resting: Mask | None,
    ) -> None:
        """Go on with a step of all lanes; see `extension_kernels.extend_many`.

        Lanes that rest draw no numbers: their next episode begins as that of a single environment.
        """
        drawn = None if resting is None else self._own[OWN_DRAWN, resting]
        self._extend_many(self._own, before, after, action, optimal, values, observation, limits)
        if drawn is not None:
            self._own[OWN_DRAWN, resting] = drawn


class ExtendedLane(Extended):
    """The same of a single environment, with the lane itself.

    Args:
      task: as `Extended`.

    Attributes:
      compiled: the steps of the lane.
      buffer: to pass to them.
      lane: the view of it that is the plain lane.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task, 1)

    def _load(self) -> None:
        super()._load()
        self.buffer, self.lane, extra = self.compiled.new_lane()
        self._cost, self._safe_regret = (extra[i, ...] for i in (EXTRA_COST, EXTRA_SAFE_REGRET))
        own = extra[EXTRA_OWN:, None]
        own[:] = self._own
        self._own, self._safe = own, self._task.spec.safety is not None
        self._action_dim = self._task.spec.action_dim

    def begin_lane(self, distractors: Array | None) -> Observation:
        """Begin an episode in the lane's state; what the agent sees of it, `[S + m]`."""
        only = np.zeros(1, np.int64)
        self.begin(only, None if distractors is None else distractors[None])
        seen: Observation = self.seen(self.lane[None, LANE_STATE:], only)[0]
        return seen

    def add_limits(self, info: dict[str, Any]) -> None:
        """Complete the info of a step, whose "optimal_action" is what the step wrote, `[3A]`."""
        if self._safe:
            row, A = info["optimal_action"], self._action_dim
            info["optimal_action"] = row[:A]  # slices: `reshape` takes three times as long
            info["cost"] = self._cost[()]
            info["limit"] = row[A : 2 * A]
            info["safe_action"] = row[2 * A :]
            info["safe_regret"] = self._safe_regret[()]

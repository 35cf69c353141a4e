"""`Program`: the lanes of one algorithm, which learn and are evaluated in compiled code.

A lane is one run: a task, a seed, weights. All lanes of a program have the same algorithm,
hyperparameters, budget and padded shapes, and take the same number of steps; their tasks, seeds and
reward settings (k, T, r_min, D) differ. A lane's bits depend on the number of lanes and on no other
lane, so results record that number.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy.typing as npt

Array = npt.NDArray[Any]


class StepLog(NamedTuple):
    """What happened in the steps of one `advance`; each array is `[steps, lanes]`.

    Attributes:
      reward: R, the payout.
      regret: 1 − step reward.
      similarity: r̃.
      terminated: whether the episode ended by D.
      truncated: whether it reached the horizon.
    """

    reward: Array
    regret: Array
    similarity: Array
    terminated: Array
    truncated: Array


class Evaluation(NamedTuple):
    """Episodes of the present deterministic policies; each array is `[lanes, episodes]`.

    Attributes:
      episode_return: the sum of an episode's rewards.
      length: its steps.
      regret: sum of 1 − step reward over its steps.
      similarity: sum of r̃ over its steps.
    """

    episode_return: Array
    length: Array
    regret: Array
    similarity: Array


class Program(ABC):
    """The lanes of one algorithm: `advance` until the budget is used, then `finish`."""

    steps: int
    """Environment steps that each lane has taken."""

    @property
    @abstractmethod
    def lanes(self) -> int:
        """Number of lanes."""

    @abstractmethod
    def advance(self, limit: int) -> StepLog:
        """Go on to at most step `limit`, and stop *before* the update that follows the last step.

        An evaluation that is due at a step precedes that step's update, as in a study's cell.
        On-policy programs always collect a whole rollout, also beyond `limit`: the weights are the
        same in all of it.
        """

    @abstractmethod
    def finish(self) -> None:
        """Make the update that follows the last step."""

    @abstractmethod
    def evaluate(self, states: Array) -> Evaluation:
        """Run an episode from each of `states` `[lanes, episodes, S]` with the present weights."""

    @abstractmethod
    def weights(self, lane: int) -> dict[str, Array]:
        """A lane's weights without padding, by SB3's names, as NumPy arrays."""

    @abstractmethod
    def failed(self) -> Array:
        """`[lanes]`, whether a lane's weights are not finite; such lanes go on without effect."""

    @abstractmethod
    def save(self) -> dict[str, Array]:
        """All state, as named arrays."""

    @abstractmethod
    def restore(self, arrays: dict[str, Array]) -> None:
        """Go on from saved state, bit for bit."""

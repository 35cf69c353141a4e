"""`RegretBlocks`: the regret of every step of lives in one stream, summed over blocks of steps.

In a block one phase is in force, so sums by visit are exact, and a life has about a thousand rows,
whatever its steps. All lives switch at the same steps. The sums are plain arrays, which a program
can save with its state.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sme_registry.evaluation.continual.dynamic_regret import (
    DynamicRegret,
    dynamic_regret,
    visit_ends,
    visits_in_force,
)
from sme_registry.spec import StreamSpec
from sme_registry.task.draw import Array

_BLOCKS = 1000  # of a life, in about equal parts of each visit

_Integers = npt.NDArray[np.int64]


class RegretBlocks:
    """Sums of regret over blocks, while lives are lived."""

    def __init__(self, stream: StreamSpec, lives: int = 1) -> None:
        visits = stream.visits
        ends = visit_ends(stream, visits)
        begins = np.concatenate([[0], ends[:-1]])
        each = np.minimum(ends - begins, max(1, _BLOCKS // visits))
        self._stream, self._visit_ends = stream, ends
        self._ends: _Integers = np.concatenate(
            [
                begin + (end - begin) * np.arange(1, n + 1) // n
                for begin, end, n in zip(begins, ends, each, strict=True)
            ]
        )
        self._last = np.cumsum(each) - 1  # block of each visit
        self.steps = np.zeros(len(self._ends), np.int64)
        self.regret = np.zeros((len(self._ends), lives))

    def add(self, end: int, regret: Array, phase: npt.ArrayLike | None = None) -> None:
        """Count steps."""
        before = end - len(regret) + np.arange(len(regret))
        blocks = np.searchsorted(self._ends, before, side="right")
        visits = np.searchsorted(self._visit_ends[:-1], before, side="right")
        if phase is not None:
            visits = visits_in_force(self._stream, visits, phase)
        # What a phase that is over still gets counts in its last block, and so what follows a life.
        blocks = np.minimum(blocks, self._last[visits])
        np.add.at(self.steps, blocks, 1)
        np.add.at(self.regret, blocks, regret)

    def dynamic_regret(self, life: int = 0) -> DynamicRegret:
        """The dynamic regret of a life."""
        counted = self.steps > 0
        steps = self.steps[counted]
        visits = np.searchsorted(self._last, np.flatnonzero(counted))
        return dynamic_regret(
            self._stream,
            step=np.cumsum(steps),
            regret=self.regret[counted, life] / steps,
            length=steps,
            phase=visits % len(self._stream.phases),
        )

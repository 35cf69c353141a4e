"""`Errors`: mean and spread of |a − a*| over the states of a region, batch by batch.

`B` batch, `A` action_dim. A *scope* is the action channels of all agents, or those of one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sme_registry.evaluation.region_report import ChannelReport, RegionReport
from sme_registry.task.draw import Array

WHOLE = ""
"""The scope of all action channels, among the agents' names."""


class Accumulator:
    """Mean and spread of |a − a*| over states, and its sum for each action channel, in float64."""

    def __init__(self, action_dim: int) -> None:
        self._states = 0
        self._mean = 0.0
        # Σ (‖a − a*‖₁/A − mean)², which is exactly 0 for the optimum, unlike Σ x² − n m².
        self._squares = 0.0
        self._sums = np.zeros(action_dim)
        self._clipped = 0

    def add(self, errors: Array, sums: Array, clipped: int) -> None:
        """Add a batch of |a − a*| `[B, A]` and the number of its entries that were clipped."""
        deviations = errors.mean(axis=1)
        count, mean = len(deviations), float(deviations.mean())
        deviations -= mean
        states = self._states + count
        shift = mean - self._mean
        self._squares += float(deviations @ deviations) + shift**2 * self._states * count / states
        self._mean += shift * count / states
        self._states = states
        self._sums += sums
        self._clipped += clipped

    def relative_to(self, other: Accumulator) -> float:
        """The mean divided by that of another policy."""
        return self._mean / other._mean

    def report(
        self,
        name: str,
        edges: tuple[float, float],
        constant_half: Accumulator,
        wd: Accumulator,
    ) -> RegionReport:
        """The report of this region; `constant_half` is of the policy ½, `wd` of this one in WD."""
        similarity, wd_similarity = 1.0 - self._mean, 1.0 - wd._mean
        channels = zip(self._sums, constant_half._sums, strict=True)
        return RegionReport(
            name=name,
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self.relative_to(constant_half),
            similarity_decay=(wd_similarity - similarity) / wd_similarity,
            similarity_loss=100.0 * (wd_similarity - similarity),
            clipped_share=self._clipped / (self._states * len(self._sums)),
            channels=tuple(
                ChannelReport(
                    mae=float(total) / self._states, normalised_regret=float(total / half)
                )
                for total, half in channels
            ),
        )


class Errors(dict[str, Accumulator]):
    """A policy's errors in one region: over all action channels, and over each agent's."""

    def __init__(self, channels: dict[str, slice]) -> None:
        super().__init__(
            {scope: Accumulator(owned.stop - owned.start) for scope, owned in channels.items()}
        )
        self._channels = channels

    def add(self, a: Array, optimal: Array, clipped: npt.NDArray[np.bool_] | None = None) -> None:
        """Add a batch: `a` `[B, A]` or `[A]`, `optimal` and `clipped` `[B, A]`."""
        errors = np.abs(a - optimal)
        sums = errors.sum(axis=0)
        for scope, owned in self._channels.items():
            count = 0 if clipped is None else int(np.count_nonzero(clipped[:, owned]))
            self[scope].add(errors[:, owned], sums[owned], count)

"""`ErrorAccumulator`: mean and spread of |a − a*| in one region, batch by batch, in float64."""

from __future__ import annotations

import math

import numpy as np

from sme_registry.evaluation.regions import region_name
from sme_registry.evaluation.report import ChannelReport, RegionReport
from sme_registry.task.draw import Array


class ErrorAccumulator:
    """Accumulates |a − a*|: mean and spread over states, and the mean of each action channel.

    Args:
      action_dim: A.
    """

    def __init__(self, action_dim: int) -> None:
        self._states = 0
        self._mean = 0.0
        # Σ (‖a − a*‖₁/A − mean)², which is exactly 0 for the optimum, unlike Σ x² − n m².
        self._squares = 0.0
        self._sums = np.zeros(action_dim)
        self._clipped = 0

    def add(self, errors: Array, sums: Array, clipped: int = 0) -> None:
        """Add a batch.

        Args:
          errors: `[B, A]` |a − a*| of these channels.
          sums: `[A]` its sums over states: computed over all channels of a task at once, so that
            an agent's channels have the same bits in its own report and in its team's.
          clipped: the number of action entries outside [0, 1] before clipping.
        """
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

    @property
    def mae(self) -> float:
        """Mean |a − a*| over states and channels."""
        return self._mean

    def report(
        self,
        region: int,
        edges: tuple[float, float],
        constant_half: ErrorAccumulator,
        wd: ErrorAccumulator,
    ) -> RegionReport:
        """The report of this region.

        Args:
          region: 0 for WD, m for OOD m.
          edges: the region's ε_low and ε_high.
          constant_half: of the constant policy ½ in the same region.
          wd: of the same policy in WD.
        """
        similarity, wd_similarity = 1.0 - self._mean, 1.0 - wd.mae
        channels = zip(self._sums, constant_half._sums, strict=True)
        return RegionReport(
            name=region_name(region),
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self._mean / constant_half.mae,
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

"""`Score`: the running statistics of one policy in one region, batch after batch, in float64."""

from __future__ import annotations

import math

import numpy as np

from sme_registry.evaluation.regions import region_name
from sme_registry.evaluation.report import ChannelReport, RegionReport
from sme_registry.task.draw import Array


class Score:
    """Collects |a − a*| of a region: its mean and spread over states, its mean in each channel.

    Args:
      action_dim: A.
    """

    def __init__(self, action_dim: int) -> None:
        self._states = 0
        self._mean = 0.0
        self._squares = (
            0.0  # Σ (‖a − a*‖₁/A − mean)²; exactly 0 for the optimum, unlike Σ x² − n m²
        )
        self._missed = np.zeros(action_dim)
        self._clipped = 0

    def add(self, missed: Array, sums: Array, clipped: int = 0) -> None:
        """Count a batch in.

        Args:
          missed: `[B, A]` |a − a*| of these channels.
          sums: `[A]` its sums over states: taken over all channels of a task at once, so that an
            agent's channels have the same bits in its own score and in its team's.
          clipped: how many of the actions' entries lay outside [0, 1] before they were clipped.
        """
        errors = missed.mean(axis=1)
        count, mean = len(errors), float(errors.mean())
        errors -= mean
        states = self._states + count
        ahead = mean - self._mean
        self._squares += float(errors @ errors) + ahead**2 * self._states * count / states
        self._mean += ahead * count / states
        self._states = states
        self._missed += sums
        self._clipped += clipped

    @property
    def mae(self) -> float:
        """Mean |a − a*| over states and channels."""
        return self._mean

    def report(
        self, region: int, edges: tuple[float, float], floor: Score, inside: Score
    ) -> RegionReport:
        """The numbers of this region.

        Args:
          region: 0 for WD, m for OOD m.
          edges: the region's ε_low and ε_high.
          floor: the constant ½ in the same region.
          inside: the same policy in WD.
        """
        similarity, similarity_inside = 1.0 - self._mean, 1.0 - inside.mae
        channels = zip(self._missed, floor._missed, strict=True)
        return RegionReport(
            name=region_name(region),
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self._mean / floor.mae,
            similarity_decay=(similarity_inside - similarity) / similarity_inside,
            similarity_loss=100.0 * (similarity_inside - similarity),
            clipped_share=self._clipped / (self._states * len(self._missed)),
            channels=tuple(
                ChannelReport(
                    mae=float(missed) / self._states, normalised_regret=float(missed / half)
                )
                for missed, half in channels
            ),
        )

"""Safety of a policy: what it earns and what it breaks, in each region.

Source: METHOD, section 8. ℓ(s) are the limits, a the policy's actions, clipped to [0, 1], a_safe
the best safe ones, min(π*, ℓ). Over the states of a region:

    step reward        mean r(s, a)
    cost               mean cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ), in [0, 1]
    violating share    share of states with a_i − ℓ_i(s) > 10⁻⁶ in any channel
    safe regret        mean r(s, a_safe) − mean r(s, a)
    price of safety    1 − mean r(s, a_safe)

The tolerance of 10⁻⁶ is that of float32: rounded to it, a safe action can exceed its limit by
6·10⁻⁸. Safe regret is negative where a policy earns by violating, so read it beside the other two.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from sme_registry.spec.document import Real, StrictModel
from sme_registry.task import Task
from sme_registry.task.draw import Array

TOLERANCE = 1e-6


class SafetyScore(StrictModel):
    """One policy in one region of a task with limits; see the module for the formulas.

    Attributes:
      name: of the region.
      step_reward: mean r, in [0, 1].
      cost: mean cost, in [0, 1].
      violating_share: share of states in which any action channel is above its limit by more than
        10⁻⁶, in [0, 1].
      safe_regret: mean step reward that the best safe action earns more than the policy, in
        [−1, 1]; negative where the policy earns by violating.
      price_of_safety: mean step reward that the optimum earns more than the best safe action, in
        [0, 1]; the same for every policy.
    """

    name: str
    step_reward: Real
    cost: Real
    violating_share: Real
    safe_regret: Real
    price_of_safety: Real


SafetyScores = Annotated[tuple[SafetyScore, ...], Field(strict=False, min_length=1)]


class SafetyReport(StrictModel):
    """A policy against the limits of a task, and the references on the same states.

    Attributes:
      regions: WD, then OOD 1, 2, …
      references: the same regions for each reference policy of the report.
    """

    regions: SafetyScores
    references: dict[str, SafetyScores]


class SafetyAccumulator:
    """The sums behind a `SafetyScore`, over a region's states."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._states = self._violating = 0
        self._reward = self._safe_reward = self._cost = 0.0

    def add(self, a: Array, optimal: Array, limit: Array, safe_reward: Array) -> None:
        """Add a batch."""
        task = self._task
        self._states += len(optimal)
        self._reward += float(task.reward_of(task.similarity_of(a, optimal)).sum())
        self._safe_reward += float(safe_reward.sum())
        self._cost += float(task.cost_of(np.broadcast_to(a, limit.shape), limit).sum())
        self._violating += int((a - limit > TOLERANCE).any(axis=1).sum())

    def score(self, region: str) -> SafetyScore:
        """The score in the region of this name."""
        return SafetyScore(
            name=region,
            step_reward=self._reward / self._states,
            cost=self._cost / self._states,
            violating_share=self._violating / self._states,
            safe_regret=(self._safe_reward - self._reward) / self._states,
            price_of_safety=1.0 - self._safe_reward / self._states,
        )

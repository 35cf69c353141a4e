"""`RegionReport`: a policy in one region, over all action channels or over those of one agent."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from sme_registry.spec.document import Integer, Real, StrictModel


class ChannelReport(StrictModel):
    """One action channel in one region.

    Attributes:
      mae: mean |a − a*| of the channel, in [0, 1].
      normalised_regret: `mae` divided by mean |½ − a*| of the channel.
    """

    mae: Real
    normalised_regret: Real


class RegionReport(StrictModel):
    """One policy in one region.

    Attributes:
      name: `WD`, `OOD 1`, …
      epsilon_low: ε of the inner face, which belongs to the region inside; 0 for WD.
      epsilon_high: ε of the outer face, which belongs to this region; 0 for WD.
      states: number of states.
      similarity: mean r̃.
      similarity_sd: standard deviation of r̃ over states (not over seeds).
      mae: mean |a − a*| = 1 − r̃.
      normalised_regret: 0 for the optimum, 1 for the constant ½; can be above 1.
      similarity_decay: (r̃_WD − r̃) / r̃_WD; 0 in WD, negative if the policy is better outside.
      similarity_loss: 100 (r̃_WD − r̃), in points of similarity.
      clipped_share: share of action entries that were outside the action range and clipped.
      channels: each action channel, in order.
    """

    name: str
    epsilon_low: Real
    epsilon_high: Real
    states: Integer
    similarity: Real
    similarity_sd: Real
    mae: Real
    normalised_regret: Real
    similarity_decay: Real
    similarity_loss: Real
    clipped_share: Real
    channels: Annotated[tuple[ChannelReport, ...], Field(strict=False)]


RegionReports: TypeAlias = Annotated[tuple[RegionReport, ...], Field(strict=False, min_length=1)]
"""Regions in the order of the protocol."""

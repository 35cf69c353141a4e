"""Where a step's numbers are: rows of a batch's `values`, and entries of a single lane.

`values` `[5, n, B]` is what one step of a batch computes for n agents in B lanes. A single lane is
t, the five values of its last step, of which it keeps r_cum, and the state s `[S]`.
"""

from __future__ import annotations

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
ROWS = 5

LANE_T, LANE_VALUES, LANE_STATE = 0, 1, 1 + ROWS
"""The first entry of each part of a lane."""

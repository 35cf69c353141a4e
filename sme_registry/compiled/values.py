"""Where a step's numbers are: rows of a batch's `values`, and entries of a single lane.

`values` `[5, n, B]` is what one step of a batch computes for n agents in B lanes; with `safety`
there are two more rows. A single lane is t, the five values of its last step, of which it keeps
r_cum, and the state s `[S]`.
"""

from __future__ import annotations

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
ROWS = 5
COST, SAFE_REGRET = 5, 6
ROWS_WITH_SAFETY = 7

LANE_T, LANE_VALUES, LANE_STATE = 0, 1, 1 + ROWS
"""The first entry of each part of a lane."""

EXTENDED = 4.0
"""Added to the end of a single lane whose info has more to say; see `compiled.extension`."""

OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)
"""An extended lane: the key of its random numbers, how many it has drawn, its distractors `[m]`."""

EXTRA_COST, EXTRA_SAFE_REGRET, EXTRA_OWN = range(3)
"""What a single lane has behind its plain numbers: two values of its last step, and its own."""

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
"""Added to a lane's end where the step goes on with `compiled.extension`."""

OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)
"""An extended lane: the key of its random numbers, how many it has drawn, its distractors `[m]`."""

ROOM_COST, ROOM_SAFE_REGRET, ROOM_STATE = range(3)
"""Besides, a single one has two values of its last step, and the state acted in `[S]`."""

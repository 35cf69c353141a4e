"""Where a step's numbers are: rows of a batch's `values`, and entries of a single environment.

`values` `[5, n, B]` is what one step of a batch computes for n agents in B environments; with
`safety` there are two more rows. A single environment is one buffer: t, the five values of its last
step, of which it keeps r_cum, and the state s `[S]`. With `safety` or `observation` there are more
numbers behind them: two values of its last step, and its own distractors.
"""

from __future__ import annotations

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
ROWS = 5
COST, SAFE_REGRET = 5, 6
ROWS_WITH_SAFETY = 7

LANE_T, LANE_VALUES, LANE_STATE = 0, 1, 1 + ROWS
"""The first entry of each part of a single environment."""

HAS_MORE = 4.0
"""Added to the end of a single step of a task with `safety` or `observation`."""

OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)
"""Of its distractors: the key of their random numbers, how many it has drawn, and d `[m]`."""

MORE_COST, MORE_SAFE_REGRET, MORE_OWN = range(3)
"""The first entry of each part behind the plain numbers of a single environment."""

"""The rows of `values` `[5, n, B]`: what one step of a batch computes for n agents in B lanes."""

from __future__ import annotations

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
ROWS = 5

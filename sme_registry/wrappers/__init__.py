"""Wrappers for your own training loop: the exact regret of each episode, in `info` and in a file.

    env = RecordRegret(gymnasium.make("SME/Default-v1"), "runs/mine/episodes.csv")
    envs = RecordVectorRegret(gymnasium.make_vec("SME/Default-v1", 8), "runs/mine/episodes.csv")

When an episode ends, `info["episode"]` has, as with Gymnasium's `RecordEpisodeStatistics`,

    r, l, t         return, number of steps, seconds since the wrapper was created
    regret          mean of 1 − r over the episode's steps, in [0, 1]; exact
    similarity      mean r̃ over them, in [0, 1]; exact
    online_regret   mean of 1 − r over all training steps so far, in [0, 1]

The file is that of `sme train`: `plots.training_curve` and `sme diagnose --log` read it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sme_registry.wrappers.single import RecordRegret

if TYPE_CHECKING:
    from sme_registry.wrappers.vector import RecordVectorRegret

__all__ = ["RecordRegret", "RecordVectorRegret"]


def __getattr__(name: str) -> Any:
    if name == "RecordVectorRegret":  # Gymnasium 0.29, which CleanRL needs, has no vector wrappers
        from sme_registry.wrappers.vector import RecordVectorRegret

        return RecordVectorRegret
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""Wrappers for your own training loop: exact regret in `info` and in a file; costs from `step`.

    env = RecordRegret(gymnasium.make("SME/Default-v1"), "runs/mine/episodes.csv")
    envs = RecordVectorRegret(gymnasium.make_vec("SME/Default-v1", 8), "runs/mine/episodes.csv")

When an episode ends, `info["episode"]` has, as with Gymnasium's `RecordEpisodeStatistics`,

    r, l, t         return, number of steps, seconds since the wrapper was created
    regret          mean of 1 − r over the episode's steps, in [0, 1]; exact
    similarity      mean r̃ over them, in [0, 1]; exact
    online_regret   mean of 1 − r over all training steps so far, in [0, 1]

and for a task with safety `cost`, `violating_share` and `safe_regret` (`EpisodeSafety`).

The file is that of `sme train`: `plots.training_curve` and `sme diagnose --log` read it.

    env = StepWithCost(sme_registry.make("Safety20"))
    observation, reward, cost, terminated, truncated, info = env.step(action)

is the interface of Safety-Gymnasium, which OmniSafe and SafePO expect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sme_registry.wrappers.cost import StepWithCost
from sme_registry.wrappers.single import RecordRegret

if TYPE_CHECKING:
    from sme_registry.wrappers.vector import RecordVectorRegret
    from sme_registry.wrappers.vector_cost import VectorStepWithCost

__all__ = ["RecordRegret", "RecordVectorRegret", "StepWithCost", "VectorStepWithCost"]


def __getattr__(name: str) -> Any:  # Gymnasium 0.29, which CleanRL needs, has no vector wrappers
    if name == "RecordVectorRegret":
        from sme_registry.wrappers.vector import RecordVectorRegret

        return RecordVectorRegret
    if name == "VectorStepWithCost":
        from sme_registry.wrappers.vector_cost import VectorStepWithCost

        return VectorStepWithCost
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

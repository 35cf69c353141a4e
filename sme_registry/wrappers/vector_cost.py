"""`VectorStepWithCost`, for a vector of environments."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from sme_registry.envs.arguments import refuse_without_limits
from sme_registry.wrappers.cost import spec_of


class VectorStepWithCost(VectorWrapper, RecordConstructorArgs):
    """A vector with the costs `[num_envs]` of a step as the third value that `step` returns.

    All autoreset modes work; Safety-Gymnasium's vectors are in `SAME_STEP` mode.

    Args:
      envs: a vector of `make_vec`, wrapped or not, whose task has `safety`.

    Examples:
      >>> from sme_registry.wrappers import VectorStepWithCost
      >>> envs = VectorStepWithCost(sme_registry.make_vec("Safety20", 3))
      >>> observations, infos = envs.reset(seed=0)
      >>> envs.step(envs.action_space.sample())[2].shape
      (3,)
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        VectorWrapper.__init__(self, envs)
        refuse_without_limits(type(self).__name__, spec_of(type(self).__name__, envs))

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Any, Any, Any, Any, Any, dict[str, Any]]:
        """Observations, rewards, costs, whether terminated, whether truncated, infos.

        A cost is 0 where the step began an episode. In `SAME_STEP` mode, where `info` is of the
        next episode, costs are those of the last step, and the last observations are also under
        Safety-Gymnasium's name, `final_observation`.
        """
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        costs = np.nan_to_num(np.array(info["cost"], np.float64))
        if "final_info" in info:
            ended = info["_final_info"]
            costs[ended] = info["final_info"]["cost"][ended]
            info["final_observation"] = info["final_obs"]
            info["_final_observation"] = info["_final_obs"]
        return observations, rewards, costs, terminated, truncated, info

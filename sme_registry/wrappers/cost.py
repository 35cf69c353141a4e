"""Environments whose `step` returns the cost, as in Safety-Gymnasium: six values instead of five.

    observation, reward, cost, terminated, truncated, info = StepWithCost(env).step(action)

OmniSafe and SafePO take them in this form; FSRL and our own algorithms read `info["cost"]` and need
no wrapper. This is the outermost wrapper: Gymnasium's own expect five values.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sme_registry.envs.arguments import refuse_without_limits
from sme_registry.errors import OptionError


class StepWithCost(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """One environment with the cost of a step as the third value that `step` returns.

    Args:
      env: an environment of this package, wrapped or not, whose task has `safety`.

    Raises:
      OptionError: the task has no limits.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        refuse_without_limits(type(self).__name__, spec_of(type(self).__name__, env))

    def step(  # type: ignore[override]
        self, action: Any
    ) -> tuple[Any, Any, float, bool, bool, dict[str, Any]]:
        """Observation, reward, cost, whether terminated, whether truncated, info."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, float(info["cost"]), terminated, truncated, info


def spec_of(wrapper: str, env: Any) -> Any:
    """The spec of an environment or a vector of this package; OptionError for any other.

    Args:
      wrapper: its name in the error's message.
      env: an environment or a vector, wrapped or not.
    """
    try:
        return env.unwrapped.sme_spec
    except AttributeError:
        raise OptionError(
            f"{wrapper}: {env!r:.80} has no `sme_spec`. Wrap an environment of sme_registry.make, "
            "or a vector of sme_registry.make_vec."
        ) from None


def with_cost(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """Six values of a vector's step, from its five.

    Costs are `[B]` float64, 0 where the step began an episode. In `SAME_STEP` mode, where `info` is
    of the next episode, they are those of the last step, and the last observations are also
    under Safety-Gymnasium's name, `final_observation`.
    """
    observations, rewards, terminated, truncated, info = result
    costs = np.nan_to_num(np.array(info["cost"], np.float64))
    if "final_info" in info:
        ended = info["_final_info"]
        costs[ended] = info["final_info"]["cost"][ended]
        info["final_observation"] = info["final_obs"]
        info["_final_observation"] = info["_final_obs"]
    return observations, rewards, costs, terminated, truncated, info

"""Environments whose `step` returns the cost, as in Safety-Gymnasium: six values instead of five.

    observation, reward, cost, terminated, truncated, info = StepWithCost(env).step(action)

OmniSafe and SafePO take them in this form; FSRL and our own algorithms read `info["cost"]` and need
no wrapper. This is the outermost wrapper: Gymnasium's own expect five values.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from sme_registry.envs.arguments import refuse_without_limits
from sme_registry.errors import OptionError


class StepWithCost(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """One environment with the cost of a step as the third value that `step` returns.

    Args:
      env: an environment of this package, wrapped or not, whose task has `safety`.

    Examples:
      >>> from sme_registry.wrappers import StepWithCost
      >>> env = StepWithCost(sme_registry.make("Safety20"))
      >>> observation, info = env.reset(seed=0)
      >>> action = env.action_space.sample()
      >>> observation, reward, cost, terminated, truncated, info = env.step(action)
      >>> bool(cost == info["cost"])
      True
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
    """The spec of an environment or a vector of this package; OptionError for any other."""
    try:
        return env.unwrapped.sme_spec
    except AttributeError:
        raise OptionError(
            f"{wrapper}: {env!r:.80} has no `sme_spec`. Wrap an environment of sme_registry.make, "
            "or a vector of sme_registry.make_vec."
        ) from None

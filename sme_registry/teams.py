"""Teams as PettingZoo environments, by the names that PettingZoo's own modules use.

    from sme_registry import teams
    env = teams.parallel_env("SME/Team4-v1")

In a parallel environment all agents act at once. In an AEC environment they act in turn, and the
step happens when the last one has acted. `sme_registry.make_parallel` and `make_aec` are the same.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from sme_registry.envs.team import SMETeamEnv
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task.task import Observation

__all__ = ["SMETeamEnv", "env", "parallel_env"]


def parallel_env(
    spec: SpecLike = "Team2-v1", *, max_cycles: int | None = None, **kwargs: Any
) -> SMETeamEnv:
    """A team's task as a PettingZoo parallel environment; see `make_parallel`.

    `max_cycles` is PettingZoo's name of the spec's `horizon`.

    Examples:
      >>> from sme_registry import teams
      >>> team = teams.parallel_env("Team2", max_cycles=10)
      >>> observations, infos = team.reset(seed=0)
      >>> actions = {agent: team.action_space(agent).sample() for agent in team.agents}
      >>> observations, rewards, terminations, truncations, infos = team.step(actions)
      >>> sorted(rewards)
      ['agent_0', 'agent_1']
    """
    if max_cycles is not None and kwargs.setdefault("horizon", max_cycles) != max_cycles:
        raise OptionError(
            f"max_cycles={max_cycles!r}: must equal horizon={kwargs['horizon']!r}, as both are the "
            "length of an episode. Leave one of them out."
        )
    return SMETeamEnv(spec, **kwargs)


def env(
    spec: SpecLike = "Team2-v1", **kwargs: Any
) -> AECEnv[str, Observation, npt.NDArray[np.float64]]:
    """A team's task as a PettingZoo AEC environment; arguments and errors as in `parallel_env`.

    Examples:
      >>> from sme_registry import teams
      >>> team = teams.env("Team2")
      >>> team.reset(seed=0)
      >>> team.step(team.action_space("agent_0").sample())
      >>> team.agent_selection
      'agent_1'
    """
    return TurnBasedTeam(parallel_env(spec, **kwargs))


class TurnBasedTeam(OrderEnforcingWrapper):  # type: ignore[misc]
    """A team, from its parallel environment, whose agents act in turn.

    It rejects an invalid action in its agent's own turn, when it can still be corrected. Until the
    first step its infos are empty: PettingZoo's `seed_test` compares them, and NaN equals nothing.
    """

    def __init__(self, parallel: Any) -> None:
        super().__init__(parallel_to_aec_wrapper(parallel))

    def _repr_html_(self) -> str:
        """The card of the parallel environment, for notebooks."""
        return cast(str, self.unwrapped._repr_html_())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.unwrapped!r})"

    __str__ = __repr__

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        super().reset(seed=seed, options=options)
        for info in self.infos.values():
            info.clear()

    def step(self, action: npt.NDArray[Any] | None) -> None:
        if not self._has_reset:
            raise EpisodeError("step: the episode has not begun. Call reset() first.")
        if not self.agents:
            raise EpisodeError("step: the episode has ended. Call reset() first.")
        name = self.agent_selection
        if not (self.terminations[name] or self.truncations[name]):
            self.unwrapped.check_action(name, action)
        elif action is not None:
            raise EpisodeError(f"{name}: the episode has ended. Pass None, or call reset().")
        super().step(action)

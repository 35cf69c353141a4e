"""`Episodes`: the exact regret of every episode, summed from the steps of parallel environments.

`B` environments, `n` agents of each, `N` steps. A team's episode is one of all its agents.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.spec import SMESpec
from sme_registry.task.task import Array

# Excess over the limits, summed over channels, up to which an action is safe: evaluation's
# tolerance of one channel or, where A > 16, what rounding to float32 can add to a safe action.
_TOLERANCE, _ROUNDING = 1e-6, 6e-8

_PLAIN, _SAFETY = ("regret", "similarity"), ("cost", "safe_regret")
# Sums are return, length, regret, similarity; with `safety` cost, violations, safe regret.
_REGRET, _SAFETY_SUMS = 2, slice(4, 7)


class EpisodeSafety(NamedTuple):
    """Means over the steps of an episode of a task with `safety`.

    A step is violating if its action was above its limits by more than 10⁻⁶, summed over channels
    (6·10⁻⁸ A where A > 16). Infos have no action, so this is not evaluation's rule, by which one
    channel must be: it differs where several are above by less.
    """

    cost: float  # in [0, 1]
    violating_share: float  # in [0, 1]
    safe_regret: float  # in [−1, 1]: what the best safe action earns more in a step


class Episode(NamedTuple):
    """A finished episode; of a team, one of the whole team, whose numbers are means over agents."""

    episode: int  # its number, from 1
    step: int  # of all environments when it ended; a step of a team is one of all its agents
    episode_return: float  # sum of its rewards
    length: int  # steps
    regret: float  # mean of 1 − r over its steps, in [0, 1]; exact
    similarity: float  # mean r̃ over its steps, in [0, 1]; exact
    terminated: int  # 1 if it ended by D, 0 if it reached the horizon
    wall_seconds: float  # since the beginning when it ended
    agents_regret: tuple[float, ...] = ()  # of each agent, in the team's order; of a team only
    safety: EpisodeSafety | None = None  # None for a task without `safety`


class Episodes:
    """The present episode of each environment, and the finished ones.

    Attributes:
      finished: the episodes, oldest first.
      steps: environment steps so far, over all environments.
      sums: `[7, B, n]` over the present episodes; a program can save and restore them.
    """

    def __init__(
        self,
        envs: int = 1,
        agents: int = 1,
        spec: Callable[[], SMESpec] | None = None,
        *,
        steps: int = 0,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """`spec` is called once, where infos have costs; `clock` gives an episode's seconds."""
        self.finished: list[Episode] = []
        self.steps = steps
        self.sums = np.zeros((7, envs, agents))
        self._spec = cache(spec) if spec is not None else None
        self._start, self._clock = time.monotonic(), clock
        self._counted, self._total_regret = 0, 0.0

    @property
    def online_regret(self) -> float:
        """Mean regret over all steps that were added; NaN before the first."""
        return self._total_regret / self._counted if self._counted else float("nan")

    def begin(self, envs: Any = slice(None)) -> None:
        """Forget the present episodes of some environments."""
        self.sums[:, envs] = 0.0

    def add(
        self,
        rewards: npt.ArrayLike,
        info: Mapping[str, Any],
        terminated: npt.ArrayLike,
        ended: npt.ArrayLike,
        stepped: npt.ArrayLike | None = None,
    ) -> list[Episode]:
        """Add one or more steps of every environment; returns the episodes that ended in them.

        Each argument, and each entry of `info`, has an entry for each step, environment and agent:
        `[B]`, `[N, B]` or `[N, B, n]`, or flat in that order. `stepped` is False where an episode
        began instead.
        """
        shape = (-1, *self.sums.shape[1:])
        try:
            regret, similarity = (_numbers(info[key], shape) for key in _PLAIN)
        except KeyError as error:
            raise OptionError(
                f"the environment's info has no {error}. Use an environment of sme_registry, with "
                "wrappers that keep its info."
            ) from None
        of_env = True if stepped is None else np.reshape(stepped, (-1, shape[1], 1))
        stepped = np.broadcast_to(of_env, regret.shape)
        plain = [_numbers(rewards, shape), stepped, regret, similarity]
        values = np.array([*plain, *self._safety(info, shape)])
        if not stepped.all():
            values[:, ~stepped] = 0.0
            regret = regret[stepped]
        self._counted += regret.size
        self._total_regret += float(regret.sum())
        steps = self.steps + np.cumsum(np.count_nonzero(stepped[..., 0], axis=1))
        ends = (np.reshape(ended, shape) & stepped)[..., 0]
        failures = np.reshape(terminated, shape)[..., 0]
        begin, before = 0, len(self.finished)
        for row in np.flatnonzero(ends.any(axis=1)).tolist():
            self._sum(values[:, begin : row + 1])
            self.steps, begin = int(steps[row]), row + 1
            for env in np.flatnonzero(ends[row]).tolist():
                self._finish(env, bool(failures[row, env]), "cost" in info)
        self._sum(values[:, begin:])
        self.steps = int(steps[-1])
        return self.finished[before:]

    def _sum(self, values: Array) -> None:
        sums = self.sums[: len(values)]
        if values.shape[1] == 1:
            sums += values[:, 0]
        else:  # one step after the other: the same bits, however many come at once
            steps = np.concatenate([sums[:, None], values], axis=1)
            sums[:] = np.add.accumulate(steps, axis=1)[:, -1]

    def _safety(self, info: Mapping[str, Any], shape: tuple[int, ...]) -> tuple[Array, ...]:
        """Cost, violations and safe regret, `[N, B, n]` each; nothing without `safety`."""
        if "cost" not in info:
            return ()
        if self._spec is None:
            raise OptionError("Episodes: the task has safety. Give spec, such as lambda: env.spec.")
        cost, safe_regret = (_numbers(info[key], shape) for key in _SAFETY)
        spec = self._spec()
        excess = cost * (2.0 * spec.tightness * spec.action_dim)
        violations = excess > max(_TOLERANCE, _ROUNDING * spec.action_dim)
        return cost, violations.astype(np.float64), safe_regret

    def _finish(self, env: int, terminated: bool, has_safety: bool) -> None:
        sums = self.sums[:, env]
        episode_return, length, regret, similarity = sums[:4].mean(axis=1).tolist()
        by_agent = sums[_REGRET] / length if sums.shape[1] > 1 else ()
        safety = (sums[_SAFETY_SUMS, 0] / length).tolist()
        seconds = time.monotonic() - self._start if self._clock is None else self._clock()
        self.finished.append(
            Episode(
                episode=len(self.finished) + 1,
                step=self.steps,
                episode_return=episode_return,
                length=int(length),
                regret=regret / length,
                similarity=similarity / length,
                terminated=int(terminated),
                wall_seconds=round(seconds, 3),
                agents_regret=tuple(map(float, by_agent)),
                safety=EpisodeSafety(*safety) if has_safety else None,
            )
        )
        self.begin(env)


def info_of_envs(infos: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """The regret, costs and phase in infos of single environments, as the info of all of them."""
    keys = [key for key in (*_PLAIN, *_SAFETY, "phase") if key in infos[0]]
    return {key: [info[key] for info in infos] for key in keys}


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    return np.asarray(values, np.float64).reshape(shape)

"""The policies that every report shows beside the one in question, on the same states.

optimal                π*: similarity 1, normalised regret 0
linear_least_squares   the affine map of the state fitted to π*, clipped to [0, 1]; of a team, each
                       agent's own map of the channels that it observes
best_constant          the constant action of least mean |a − a*|: each channel's median of a*
constant_half          a = ½: normalised regret 1
uniform_random         a ~ U([0, 1]^A), drawn anew in each state

The two fitted ones know the training cube only: they are fitted on the states of WD, at most
`FIT_STATES` of them (all, under paper-v1), and used unchanged in every other region. So they lose
outside what an agent that learnt no more than they did would lose. Judged in WD on the states they
were fitted on, they look too good there where those are not many times state_dim.

An agent's reference knows no more than the agent: a linear map of the whole state, fitted to all
channels at once, would be another policy, which no agent that observes a part of it could follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sme_registry.compiled import engine
from sme_registry.envs.shared import Observation
from sme_registry.spec import SMESpec
from sme_registry.task import materialize
from sme_registry.task.draw import Array

Act = Callable[[Observation], Any]
Joint = Callable[[Array], Array]  # states [B, S] to joint actions [B, A]

NAMES = (
    "optimal",
    "linear_least_squares",
    "best_constant",
    "constant_half",
    "uniform_random",
)
FIT_STATES = 2**16
_FIT_NUMBERS = 2**24  # of the states and actions kept for the fit, 128 MiB as float64


def fit_states(spec: SMESpec) -> int:
    """How many states of WD the fit keeps; fewer where a state is large."""
    return max(1, min(FIT_STATES, _FIT_NUMBERS // (spec.state_dim + spec.action_dim)))


@dataclass(frozen=True, eq=False)
class References:
    """The fitted references.

    Attributes:
      constant: `[A]` the best constant action.
      slope: `[S, A]` of the linear policy, about the cube's centre; 0 where the agent that owns
        the action channel does not observe the state channel.
      intercept: `[A]` its action there.
    """

    constant: Array
    slope: Array
    intercept: Array

    def actions(self, s: Array, optimal: Array, random: Array) -> dict[str, Array]:
        """Every reference's actions in states `[B, S]`, by name.

        Args:
          s: `[B, S]` states.
          optimal: `[B, A]` π*(s).
          random: `[B, A]` uniform numbers in (0, 1).

        Returns:
          `[B, A]` each, or `[A]` where an action is constant; all in [0, 1].
        """
        linear = (s - 0.5) @ self.slope
        linear += self.intercept
        return {
            "optimal": optimal,
            "linear_least_squares": np.clip(linear, 0.0, 1.0, out=linear),
            "best_constant": self.constant,
            "constant_half": np.full_like(self.constant, 0.5),
            "uniform_random": random,
        }


def fit(
    s: Array, optimal: Array, agents: Iterable[tuple[Sequence[int], slice]] | None = None
) -> References:
    """Fit the references on states of WD and their optimal actions.

    Args:
      s: `[N, S]` states.
      optimal: `[N, A]` π*(s).
      agents: the state channels that each agent observes and the action channels that it owns;
        None is one agent with all of them.
    """
    S, A = s.shape[1], optimal.shape[1]
    slope, intercept = np.zeros((S, A)), np.empty(A)
    owned_by_observed: dict[tuple[int, ...], list[int]] = {}
    for observed, own in [(range(S), slice(0, A))] if agents is None else agents:
        owned_by_observed.setdefault(tuple(observed), []).extend(range(own.start, own.stop))
    for channels, owned in owned_by_observed.items():
        design = np.concatenate([s[:, channels] - 0.5, np.ones((len(s), 1))], axis=1)
        solution = np.linalg.lstsq(design, optimal[:, owned])[0]
        slope[np.ix_(channels, owned)] = solution[:-1]
        intercept[owned] = solution[-1]
    return References(np.median(optimal, axis=0), slope, intercept)


def _optimal(spec: SMESpec) -> Joint:
    return engine(materialize(spec)).optimal_action


def _constant(spec: SMESpec) -> Joint:
    return lambda s: np.full((len(s), spec.action_dim), 0.5)


def _random(spec: SMESpec) -> Joint:
    generator = np.random.default_rng(0)
    return lambda s: generator.random((len(s), spec.action_dim))


def _linear(spec: SMESpec) -> Joint:
    task = materialize(spec)
    s = np.random.default_rng(0).random((fit_states(spec), spec.state_dim))
    agents = zip(task.observed, task.owned, strict=True)
    fitted = fit(s, engine(task).optimal_action(s), agents)
    return lambda s: (s - 0.5) @ fitted.slope + fitted.intercept


# The ones that can be asked by name, without a protocol.
POLICIES: dict[str, Callable[[SMESpec], Joint]] = {
    "optimal": _optimal,
    "constant": _constant,
    "random": _random,
    "linear": _linear,
}


def reference_policy(name: str, spec: SMESpec) -> Act | dict[str, Act]:
    """A policy that learns nothing, as `evaluate` takes it.

    Args:
      name: one of `POLICIES`.
      spec: the task.

    Returns:
      From observations `[B, S + 2]` to actions `[B, A]` of the unit range; of a team, one for each
      agent.
    """
    joint, S = POLICIES[name](spec), spec.state_dim
    if spec.team is None:
        return lambda observations: joint(observations[:, :S].astype(np.float64))
    task = materialize(spec)

    def of(observed: tuple[int, ...], own: slice) -> Act:
        def act(observations: Observation) -> Array:
            # What the agent does not observe has no part in its own channels of the joint action.
            s = np.zeros((len(observations), S))
            s[:, observed] = observations[:, : len(observed)]
            return joint(s)[:, own]

        return act

    agents = zip(task.names, task.observed, task.owned, strict=True)
    return {agent: of(observed, own) for agent, observed, own in agents}

"""The policies that every report shows beside the one in question, on the same states.

optimal                π*: similarity 1, normalised regret 0
linear_least_squares   the affine map of the state fitted to π*, clipped to [0, 1]
best_constant          the constant action of least mean |a − a*|: each channel's median of a*
constant_half          a = ½: normalised regret 1
uniform_random         a ~ U([0, 1]^A), drawn anew in each state

The two fitted ones know the training cube only: they are fitted on the states of WD, at most
`FIT_STATES` of them (all, under paper-v1), and used unchanged in every other region. So they lose
outside what an agent that learnt no more than they did would lose. Judged in WD on the states they
were fitted on, they look too good there where those are not many times state_dim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sme_registry.spec import SMESpec
from sme_registry.task.draw import Array

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
      slope: `[S, A]` of the linear policy, about the cube's centre.
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


def fit(s: Array, optimal: Array) -> References:
    """Fit the references on states `[N, S]` of WD and their optimal actions `[N, A]`."""
    design = np.concatenate([s - 0.5, np.ones((len(s), 1))], axis=1)
    solution = np.linalg.lstsq(design, optimal)[0]
    return References(np.median(optimal, axis=0), solution[:-1], solution[-1])

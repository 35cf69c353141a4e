"""The reference policies that every report shows next to the evaluated one, on the same states.

optimal                π*: similarity 1, normalised regret 0
linear_least_squares   the affine map of the state fitted to π*, clipped to [0, 1]; in a team each
                       agent has its own map of the channels that it observes
best_constant          the constant action with the smallest mean |a − a*|: the medians of a*
constant_half          a = ½: normalised regret 1
uniform_random         a ~ U([0, 1]^A), a new draw in each state
safe_optimal           min(π*(s), ℓ(s)), the best action within the limits (METHOD, section 8)
shrunk_optimal         min(π*(s), 1 − 2τ): the optimum cut off at the lowest limit of any state

The fitted ones are fitted on the states of WD, at most `FIT_STATES` of them, and used unchanged in
every other region. All act on the state, also where the agent sees another observation; an agent's
only on the channels that it observes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sme_registry.compiled import engine
from sme_registry.compiled.arrays import Observation
from sme_registry.errors import SpecError
from sme_registry.spec import SMESpec
from sme_registry.task import Task, materialize
from sme_registry.task.draw import Array

Act = Callable[[Observation], Any]

NAMES = ("optimal", "linear_least_squares", "best_constant", "constant_half", "uniform_random")
SAFE_NAMES = ("safe_optimal", "shrunk_optimal")
FIT_STATES = 2**16
_FIT_NUMBERS = 2**24  # of the states and actions kept for the fit, 128 MiB as float64


LABELS = {
    "optimal": "optimal",
    "linear_least_squares": "linear (LSQ)",
    "best_constant": "best constant",
    "constant_half": "constant ½",
    "uniform_random": "random",
    "safe_optimal": "safe optimum",
    "shrunk_optimal": "optimum ≤ 1 − 2τ",
}
"""The labels of references, for people."""


def names(spec: SMESpec) -> tuple[str, ...]:
    return NAMES if spec.safety is None else (*NAMES, *SAFE_NAMES)


def fit_states(spec: SMESpec) -> int:
    """How many states of WD the fit uses; fewer if a state is large."""
    return max(1, min(FIT_STATES, _FIT_NUMBERS // (spec.state_dim + spec.action_dim)))


@dataclass(frozen=True, eq=False)
class References:
    constant: Array  # `[A]` the best constant action
    slope: Array  # `[S, A]` about the centre; 0 of channels that an agent does not observe
    intercept: Array  # `[A]` the linear policy's action at the centre

    def linear(self, s: Array) -> Array:
        """The linear policy's actions `[B, A]` in states `[B, S]`, not clipped."""
        return (s - 0.5) @ self.slope + self.intercept

    def actions(self, s: Array, optimal: Array, random: Array) -> dict[str, Array]:
        """The actions of every reference policy in states `[B, S]`, by name."""
        return {
            "optimal": optimal,
            "linear_least_squares": np.clip(self.linear(s), 0.0, 1.0),
            "best_constant": self.constant,
            "constant_half": np.full_like(self.constant, 0.5),
            "uniform_random": random,
        }


def safe_actions(spec: SMESpec, optimal: Array, limit: Array) -> dict[str, Array]:
    """The actions `[B, A]` of `SAFE_NAMES`, from π*(s) and the limits; none without safety."""
    if spec.safety is None:
        return {}
    lowest = 1.0 - 2.0 * spec.safety.tightness
    return {
        "safe_optimal": np.minimum(optimal, limit),
        "shrunk_optimal": np.minimum(optimal, lowest),
    }


def fit(task: Task, s: Array, optimal: Array) -> References:
    """The references fitted on states `[n, S]` and their optimal actions `[n, A]`."""
    S, A = s.shape[1], optimal.shape[1]
    slope, intercept = np.zeros((S, A)), np.empty(A)
    owned_by_observed: dict[tuple[int, ...], list[int]] = {}
    for observed, owned in zip(task.observed, task.owned, strict=True):
        owned_by_observed.setdefault(tuple(observed), []).extend(range(owned.start, owned.stop))
    for observed, columns in owned_by_observed.items():
        design = np.concatenate([s[:, observed] - 0.5, np.ones((len(s), 1))], axis=1)
        solution = np.linalg.lstsq(design, optimal[:, columns])[0]
        slope[np.ix_(observed, columns)] = solution[:-1]
        intercept[columns] = solution[-1]
    return References(np.median(optimal, axis=0), slope, intercept)


SHORT_NAMES = {
    "linear": "linear_least_squares",
    "constant": "constant_half",
    "random": "uniform_random",
}
POLICIES = (*NAMES, *SAFE_NAMES, *SHORT_NAMES)
"""Names that `reference_policy` accepts: the reports' names, and short ones."""


def reference_policy(name: str, spec: SMESpec) -> Act | dict[str, Act]:
    """A reference policy, as `evaluate` accepts it, by one of the names of `POLICIES`.

    It maps observations `[B, O]`, whose mixing it inverts, to actions `[B, A]` in [0, 1]; for a
    team, one function for each agent. The fitted ones are fitted on states of their own.

    Examples:
      >>> from sme_registry.evaluation import reference_policy
      >>> optimal = reference_policy("optimal", sme_registry.load("Default"))
      >>> optimal(np.full((3, 10), 0.5, np.float32)).shape
      (3, 4)
    """
    joint, S = _joint_policy(SHORT_NAMES.get(name, name), spec), spec.state_dim
    task = materialize(spec)

    def of_agent(observed: Sequence[int], owned: slice) -> Act:
        def act(observations: Observation) -> Array:
            # The agent's channels of the joint action do not depend on what it does not observe.
            s = np.zeros((len(observations), S))
            x = task.unmixed(observations[:, :-2]) if task.mixing else observations
            s[:, observed] = x[:, : len(observed)]
            return joint(s)[:, owned]

        act.__name__ = name
        return act

    agents = zip(task.names, task.observed, task.owned, strict=True)
    policies = {agent: of_agent(observed, owned) for agent, observed, owned in agents}
    return policies if spec.team is not None else policies.popitem()[1]


def _joint_policy(name: str, spec: SMESpec) -> Callable[[Array], Array]:
    """A reference policy from states `[B, S]` to joint actions `[B, A]`, which are not clipped."""
    if name not in names(spec):
        raise SpecError(
            f"policy={name!r}: needs a task with safety, and this one has no limits. Give "
            "'optimal', or add safety to the task."
        )
    if name == "optimal":
        return engine(materialize(spec)).optimal_action
    if name == "constant_half":
        return lambda s: np.full((len(s), spec.action_dim), 0.5)
    if name == "uniform_random":
        generator = np.random.default_rng(0)
        return lambda s: generator.random((len(s), spec.action_dim))
    task = materialize(spec)
    if name in SAFE_NAMES:
        optimal_action = engine(task).optimal_action
        return lambda s: safe_actions(spec, optimal_action(s), task.limit(s))[name]
    s = np.random.default_rng(0).random((fit_states(spec), spec.state_dim))
    fitted = fit(task, s, engine(task).optimal_action(s))
    if name == "best_constant":
        return lambda s: np.tile(fitted.constant, (len(s), 1))
    return fitted.linear

"""The reference policies that every report shows next to the evaluated one, on the same states.

optimal                π*: similarity 1, normalised regret 0
linear                 the affine map of the state fitted to π*, clipped to [0, 1]; in a team each
                       agent has its own map of the channels that it observes
best_constant          the constant action with the smallest mean |a − a*|: the medians of a*
constant               a = ½: normalised regret 1
random                 a ~ U([0, 1]^A), a new draw in each state
safe_projection        min(π*(s), ℓ(s)), the best safe action of a step (METHOD, section 8)
shrunk_optimal         min(π*(s), 1 − 2τ): the optimum cut off at the lowest limit of any state

The fitted ones are fitted on the states of WD, at most `FIT_STATES` of them, and used unchanged in
every other region. All act on the state, also where the agent sees another observation; an agent's
only on the channels that it observes. `REFERENCES` is the only list of them: reports, tables and
figures show what a report has.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sme_registry.errors import SpecError
from sme_registry.io import choice
from sme_registry.spec import SMESpec
from sme_registry.task import Task, materialize
from sme_registry.task.draw import Array
from sme_registry.task.engine import engine
from sme_registry.task.task import Observation

Act = Callable[[Observation], Any]

FIT_STATES = 2**16
_FIT_NUMBERS = 2**24  # of the states and actions kept for the fit, 128 MiB as float64


@dataclass(frozen=True, eq=False)
class References:
    """What is fitted."""

    constant: Array  # `[A]` the best constant action
    slope: Array  # `[S, A]` about the centre; 0 of channels that an agent does not observe
    intercept: Array  # `[A]` the linear policy's action at the centre

    def linear(self, s: Array) -> Array:
        """The linear policy's actions `[B, A]` in states `[B, S]`, not clipped."""
        return (s - 0.5) @ self.slope + self.intercept


@dataclass(frozen=True, eq=False)
class Knowledge:
    """States and what references can know of them, computed when it is asked for."""

    task: Task
    s: Array  # `[B, S]`
    fitted: Callable[[], References]
    random: Callable[..., Array]  # uniform numbers of a shape
    known_optimal: Array | None = None  # `[B, A]` each, where they are known already
    known_limit: Array | None = None

    @property
    def optimal(self) -> Array:
        """π*(s)."""
        known = self.known_optimal
        return engine(self.task).optimal_action(self.s) if known is None else known

    @property
    def limit(self) -> Array:
        """ℓ(s)."""
        return self.task.limit(self.s) if self.known_limit is None else self.known_limit


class Reference(NamedTuple):
    label: str  # for people
    act: Callable[[Knowledge], Array]  # actions `[B, A]` or `[A]`, not clipped
    needs_limits: bool = False


REFERENCES = {
    "optimal": Reference("optimal", lambda at: at.optimal),
    "linear": Reference("linear", lambda at: at.fitted().linear(at.s)),
    "best_constant": Reference("best constant", lambda at: at.fitted().constant),
    "constant": Reference("constant ½", lambda at: np.full(at.task.spec.action_dim, 0.5)),
    "random": Reference("random", lambda at: at.random(len(at.s), at.task.spec.action_dim)),
    "safe_projection": Reference(
        "safe projection", lambda at: np.minimum(at.optimal, at.limit), needs_limits=True
    ),
    "shrunk_optimal": Reference(
        "optimum ≤ 1 − 2τ",
        lambda at: np.minimum(at.optimal, 1.0 - 2.0 * at.task.spec.tightness),
        needs_limits=True,
    ),
}
NAMES = tuple(name for name, reference in REFERENCES.items() if not reference.needs_limits)
SAFE_NAMES = tuple(name for name, reference in REFERENCES.items() if reference.needs_limits)
LABELS = {name: reference.label for name, reference in REFERENCES.items()}
_UNSAFE = ("linear", "best_constant", "random")


def names(spec: SMESpec) -> tuple[str, ...]:
    return NAMES if spec.safety is None else (*NAMES, *SAFE_NAMES)


def beside_safety(names: Iterable[str]) -> list[str]:
    """Those of a report's references whose safety tables and figures show."""
    return [name for name in names if name not in _UNSAFE]


def actions(at: Knowledge, names: Iterable[str]) -> dict[str, Array]:
    """The actions of references by name, `[B, A]` or `[A]` in [0, 1]."""
    return {name: np.clip(REFERENCES[name].act(at), 0.0, 1.0) for name in names}


def fit_states(spec: SMESpec) -> int:
    """How many states of WD the fit uses; fewer if a state is large."""
    return max(1, min(FIT_STATES, _FIT_NUMBERS // (spec.state_dim + spec.action_dim)))


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


POLICIES = (*NAMES, *SAFE_NAMES)
OLD_NAMES = {
    "linear_least_squares": "linear",
    "constant_half": "constant",
    "uniform_random": "random",
    "safe_optimal": "safe_projection",
}
"""The names in reports of version 1, which plans may have too, and today's."""


def reference_policy(name: str, spec: SMESpec) -> Act | dict[str, Act]:
    """A reference policy, as `evaluate` accepts it, by a name of `POLICIES`, or an old one.

    It maps observations `[B, O]`, whose mixing it inverts, to actions `[B, A]` in [0, 1]; for a
    team, one function for each agent. The fitted ones are fitted on states of their own.

    Examples:
      >>> from sme_registry.evaluation import reference_policy
      >>> optimal = reference_policy("optimal", sme_registry.load("Default"))
      >>> optimal(np.full((3, 10), 0.5, np.float32)).shape
      (3, 4)
    """
    name = choice("name", OLD_NAMES.get(name, name), POLICIES)
    joint, task = _joint_policy(name, spec), materialize(spec)

    def of_agent(observed: Sequence[int], owned: slice) -> Act:
        def act(observations: Observation) -> Array:
            # The agent's channels of the joint action do not depend on what it does not observe.
            s = np.zeros((len(observations), spec.state_dim))
            x = task.unmixed(observations[:, :-2]) if task.mixing else observations
            s[:, observed] = x[:, : len(observed)]
            return np.clip(joint(s)[:, owned], 0.0, 1.0)

        act.__name__ = name
        act.action_range = "unit"  # type: ignore[attr-defined]
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
    task, generator = materialize(spec), np.random.default_rng(0)

    @functools.cache
    def fitted() -> References:
        s = np.random.default_rng(0).random((fit_states(spec), spec.state_dim))
        return fit(task, s, engine(task).optimal_action(s))

    def random(*shape: int) -> Array:
        return generator.random(shape)

    def act(s: Array) -> Array:
        a = REFERENCES[name].act(Knowledge(task, s, fitted, random))
        return np.array(np.broadcast_to(a, (len(s), spec.action_dim)))

    return act

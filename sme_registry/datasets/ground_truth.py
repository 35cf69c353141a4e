"""The exact return of a policy, by rollout in the task that a data set is from.

Off-policy evaluation estimates from data what a policy would earn. Here it is known: the task is,
and its transitions are deterministic.

    G(s, t, r_cum) = Σ_i γ^i R_{t+1+i}     from the step after t to the end of the episode, γ = 1
                                           for the undiscounted return

R is what is paid, so r_cum, k, r_min, D and the horizon all count. `M` states, `S` state_dim, `A`
action_dim, T horizon.

Exact means to rounding, and that has a limit of its own: the transition doubles differences at each
step, so a policy whose action differs in the last bit of float32 has gone elsewhere after some 25
steps. A network gives other last bits in batches of another size. The same call gives the same
numbers; another machine or batch gives another trajectory of the same task from there on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from sme_registry.datasets.arrays import Transitions
from sme_registry.envs.batch import Batch, Observation
from sme_registry.envs.options import initial_states
from sme_registry.errors import OptionError, SpecError, StateError
from sme_registry.evaluation import as_policy
from sme_registry.evaluation.rollouts import LANES
from sme_registry.evaluation.rollouts import rollouts as roll_out
from sme_registry.spec import SMESpec
from sme_registry.spec.document import plain_number
from sme_registry.task import Task, load_task
from sme_registry.task.draw import Array

CONFIDENCE = 0.95
_ROUNDED = 1e-6  # of r_cum, which an observation holds as float32

Steps = npt.NDArray[np.int64]
Act = Callable[[Observation], npt.ArrayLike]


class Estimate(NamedTuple):
    """A mean and its 95 % interval, each a number or `[M]`; of no width where it is exact."""

    mean: Any
    low: Any
    high: Any


@dataclass(frozen=True, eq=False)
class ExactReturn:
    """What a policy earns from each of `M` states.

    Attributes:
      undiscounted: `[M]` each: mean, low and high.
      discounted: the same with `gamma`.
      lengths: `[M]` mean steps to the end of the episode.
      similarity: `[M]` mean r̃ over them.
      gamma: γ.
      rollouts: episodes from each state; 1 where the policy is deterministic.
    """

    undiscounted: Estimate
    discounted: Estimate
    lengths: Array
    similarity: Array
    gamma: float
    rollouts: int

    def over_states(self) -> tuple[Estimate, Estimate]:
        """The mean over all states, undiscounted and discounted, with its interval.

        The interval is that of the value of whatever distribution the states were drawn from, each
        by itself; of rows of the same trajectories it is too narrow.

        Raises:
          OptionError: of a single state there is none.
        """
        if len(self.lengths) < 2:
            raise OptionError("states: an interval over states needs at least 2 of them.")
        return _interval(self.undiscounted.mean), _interval(self.discounted.mean)


def exact_return(
    policy: Any,
    spec: SMESpec | dict[str, Any] | str,
    *,
    states: npt.ArrayLike,
    t: npt.ArrayLike = 0,
    r_cum: npt.ArrayLike = 0.0,
    actions: npt.ArrayLike | None = None,
    gamma: float = 0.99,
    rollouts: int = 1,
    action_range: str | None = None,
) -> ExactReturn:
    """Roll a policy out from any states of a task, to the end of the episode.

    Args:
      policy: what `evaluate` takes: a callable `[B, S + 2] → [B, A]`, a model, or a model's path.
      spec: the task: a spec, its fields, an id, a digest or a path; of a single agent.
      states: `[M, S]` in [0, 1]; `Transitions.states` are exact, its observations are not.
      t: `[M]` or one number, steps completed there, in [0, T).
      r_cum: `[M]` or one number, the rewards since the last payout, in [0, t mod k].
      actions: `[M, A]` taken in the first step in place of the policy's, in [0, 1]: the return is
        then Q(s, a), else V(s).
      gamma: γ in [0, 1] of the discounted return.
      rollouts: episodes from each state: 1 for a deterministic policy, which is then exact; for one
        that draws, more, and the mean has a 95 % interval (Student's t).
      action_range: of the policy's actions; None for its own, and "unit" for a callable.

    Returns:
      The returns.

    Raises:
      UnknownNameError, SpecError: no such task, or it is a team's.
      StateError: states of another shape or outside the cube, or no episode can be there.
      OptionError: another argument is out of range, or the policy draws and `rollouts` is 1.
      PolicyError: the policy cannot be used.
    """
    task = _single(load_task(spec))
    gamma = _number("gamma", gamma, 0.0, 1.0)
    rollouts = int(_number("rollouts", rollouts, 1, 10**6, whole=True))
    asked = as_policy(policy, task.spec, action_range=action_range)
    where, first = _positions(task.spec, states, t, r_cum, actions)
    if rollouts == 1:
        _refuse_random(asked, task, where)
    states, t, r_cum = where
    done = [
        roll_out(asked, task, states, t=t, r_cum=r_cum, actions=first, gamma=gamma)
        for _ in range(rollouts)
    ]
    lengths = np.stack([each.length for each in done])
    return ExactReturn(
        _interval(np.stack([each.episode_return for each in done])),
        _interval(np.stack([each.discounted_return for each in done])),
        lengths.mean(axis=0),
        np.average([each.similarity for each in done], axis=0, weights=lengths),
        gamma,
        rollouts,
    )


def positions(
    transitions: Transitions, spec: SMESpec, rows: npt.ArrayLike | None = None
) -> dict[str, Any]:
    """Where rows of a set were acted in, as `exact_return` takes it.

        exact_return(policy, spec, **positions(transitions, spec, rows))

    Args:
      transitions: the set, of a single agent.
      spec: its task.
      rows: `[M]` indices, or a mask; None for all.

    Returns:
      `states` `[M, S]` and `t` `[M]`, exact, and `r_cum` `[M]` as an observation holds it, to a
      relative 6e-8.
    """
    chosen = slice(None) if rows is None else np.asarray(rows)
    seen = transitions.observations[chosen].astype(np.float64)
    S = spec.state_dim
    t = np.rint(seen[:, S] * spec.horizon).astype(np.int64)
    r_cum = np.minimum(seen[:, S + 1] * spec.k, t % spec.k)
    return {"states": transitions.states[chosen], "t": t, "r_cum": r_cum}


def _single(task: Task) -> Task:
    if task.spec.team is not None:
        raise SpecError(
            "team: the returns of a team's agents are not rolled out here. Give the task of a "
            "single agent."
        )
    return task


def _positions(
    spec: SMESpec,
    states: npt.ArrayLike,
    t: npt.ArrayLike,
    r_cum: npt.ArrayLike,
    actions: npt.ArrayLike | None,
) -> tuple[tuple[Array, Steps, Array], Array | None]:
    """The arguments of `exact_return` as arrays of M rows, checked."""
    S, T, k = spec.state_dim, spec.horizon, spec.k
    M = len(states) if isinstance(states, np.ndarray | list | tuple) else 0
    if M == 0:
        raise StateError(f"states={states!r:.60}: must be [M, {S}], one row for each start.")
    s = initial_states(states, (M, S))
    steps, owed = _column("t", t, M), _column("r_cum", r_cum, M)
    wrong = (steps != np.rint(steps)) | (steps < 0) | (steps >= T)
    if wrong.any():
        raise StateError(
            f"t={steps[wrong][0]:g}: must be whole steps in [0, {T}), before the episode's end."
        )
    since = steps % k
    wrong = (owed < 0) | (owed > since + _ROUNDED)
    if wrong.any():
        raise StateError(
            f"r_cum={owed[wrong][0]:g}: must be in [0, {since[wrong][0]:g}] at t="
            f"{steps[wrong][0]:g}, so many steps after the last payout (k={k})."
        )
    if actions is None:
        return (s, steps.astype(np.int64), owed), None
    try:
        first = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError):
        first = np.empty(0)
    if first.shape != (M, spec.action_dim) or not ((first >= 0) & (first <= 1)).all():
        raise OptionError(
            f"actions of shape {first.shape}: must be ({M}, {spec.action_dim}), each in [0, 1]."
        )
    return (s, steps.astype(np.int64), owed), first


def _column(name: str, value: npt.ArrayLike, rows: int) -> Array:
    try:
        column = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise StateError(f"{name}={value!r:.60}: must be a number or an array of them.") from None
    if column.shape not in ((), (rows,)):
        raise StateError(f"{name} of shape {column.shape}: must be ({rows},), or one number.")
    if not np.isfinite(column).all():
        raise StateError(f"{name}: has NaN or infinite entries. Give finite numbers.")
    return np.broadcast_to(column, (rows,)).copy()


def _number(name: str, value: Any, low: float, high: float, whole: bool = False) -> float:
    number = plain_number(value)
    kinds = int if whole else int | float
    if isinstance(number, bool) or not isinstance(number, kinds) or not low <= number <= high:
        kind = "an integer" if whole else "a number"
        raise OptionError(f"{name}={value!r:.60}: must be {kind} in [{low:g}, {high:g}].")
    return float(number)


def _refuse_random(act: Act, task: Task, where: tuple[Array, Steps, Array]) -> None:
    """Raise where a policy answers the same observations differently."""
    states, t, r_cum = where
    batch = Batch(task, min(len(states), LANES))
    batch.place(states[:LANES], t[:LANES], r_cum[:LANES, None])
    if not np.array_equal(act(batch.observe()), act(batch.observe())):
        raise OptionError(
            "rollouts=1: the policy draws its actions, so one episode from a state is no exact "
            "return. Give rollouts=30 or more for a mean with its interval."
        )


def _interval(samples: Array) -> Estimate:
    """Student's interval of the mean over the first axis; of a single sample, the sample."""
    count, mean = len(samples), samples.mean(axis=0)
    if count == 1:
        return Estimate(mean, mean, mean)
    error = samples.std(axis=0, ddof=1) / np.sqrt(count)
    half = stdtrit(count - 1, 0.5 + CONFIDENCE / 2) * error
    return Estimate(mean, mean - half, mean + half)

"""`play`, the loop of a policy in a batch; `rollouts`, thousands of whole episodes; and `values`,
exact values of a policy (METHOD, section 11), which are means of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import initial_states, single_agent
from sme_registry.envs.batch import Batch, BatchStep
from sme_registry.errors import OptionError, StateError
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy
from sme_registry.io import choice, integer_in, number_in
from sme_registry.spec import SMESpec
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task import Task, draw
from sme_registry.task.loading import load_task
from sme_registry.task.task import (
    REGRET,
    REWARD,
    SIMILARITY,
    Array,
    Indices,
    Mask,
    Observation,
)

MOST_ENVS = 4096
"""Most episodes in parallel, so that memory does not grow with their number."""

Horizon = Literal["finite", "continuing"]
_TAILS = 64  # roll-outs from the end of an episode on
_NEGLIGIBLE = 0.01  # weight of the first reward that a tail leaves out


class PlayStep(NamedTuple):
    """A step of a batch: what it began from, the actions, and what came of them."""

    state: Array  # `[B, S]` float64
    distractors: Array  # `[B, m]`
    noise: Array  # `[B, n + S]` ξ and ζ of the step
    observation: Observation  # `[B, O]`, of all agents
    action: npt.NDArray[Any]  # `[B, A]` as the policy returned it
    running: Mask  # `[B]` whether the episode had not ended before
    result: BatchStep


def play(
    batch: Batch,
    act: Callable[[Array, Observation], npt.NDArray[Any]],
    begin: Callable[[Indices, Observation], None] | None = None,
) -> Iterator[PlayStep]:
    """Play the batch's episodes from where they are, until all have ended.

    `act` maps states `[B, S]` and observations `[B, O]` to joint actions `[B, A]` in [0, 1], also
    where episodes have ended. `begin` begins another one there, without end, and writes its rows of
    the observations. What a step holds is valid until the next one.
    """
    observation, running = batch.observe(), np.ones(batch.num_envs, bool)
    while running.any():
        state, distractors, noise = batch.state, batch.distractors, batch.noise
        action = act(state, observation)
        result = batch.advance(np.asarray(action, np.float64))
        yield PlayStep(state, distractors, noise, observation, action, running.copy(), result)
        observation, ended = result.observation, result.terminated | result.truncated
        if begin is None:
            running &= ~ended
        elif ended.any():
            begin(np.flatnonzero(ended), observation)


class Rollouts(NamedTuple):
    """Completed episodes; each array is `[n]`. The numbers of a team are means over its agents."""

    episode_return: Array  # sum of an episode's rewards; in [0, T] where no more is paid
    discounted_return: Array  # sum of γ^i times the i-th reward
    length: Array  # number of steps, in [1, T]
    regret: Array  # mean of 1 − step reward over its steps, in [0, 1]
    similarity: Array  # mean r̃ over its steps, in [0, 1]
    similarity_square: Array  # mean r̃² over its steps, in [0, 1]
    terminated: Array  # 1 where D ended it, possibly at its last step; or 0
    agents_regret: Array  # `[agents, n]` the same as `regret` for each agent

    def per_step(self, values: Array) -> float:
        """The mean over all steps of all episodes, from the mean of each episode."""
        return float(np.average(values, weights=self.length))

    @property
    def similarity_sd(self) -> float:
        """The standard deviation of r̃ over all steps of all episodes."""
        variance = self.per_step(self.similarity_square) - self.per_step(self.similarity) ** 2
        return float(np.sqrt(max(0.0, variance)))


def start_states(seed: int, evaluation: int, episodes: int, state_dim: int) -> Array:
    """The initial states of an evaluation's episodes, from a random stream of their own."""
    stream = f"rollouts/{evaluation}/initial_state"
    return draw.uniform(seed, stream, episodes * state_dim).reshape(episodes, state_dim)


def rollouts(
    policy: Callable[[Observation], Any],
    task: Task,
    states: Array,
    *,
    t: npt.NDArray[np.int64] | None = None,
    r_cum: Array | None = None,
    distractors: Array | None = None,
    actions: Array | None = None,
    gamma: float = 1.0,
    seed: int = 0,
    at_end: bool = False,
) -> Rollouts:
    """Run an episode from each of the states `[n, S]` to its end.

    After `t` `[n]` steps and with `r_cum` `[n]`, by default at the start; the first actions are
    `actions` `[n, A]`, by default the policy's. `seed` is of distractors that are not given, and of
    noise: episodes from equal states have equal ones. What a policy has as `bonus` `[n]` after a
    call, such as SAC's −α log π, is added to that step of the discounted return. `at_end`, a single
    agent always sees t/T = 1.
    """
    if not isinstance(policy, TeamPolicy):
        task = single_agent(task)
    n, agents = len(states), len(task.policies)
    t = np.zeros(n, np.int64) if t is None else t
    r_cum = np.zeros(n) if r_cum is None else r_cum
    totals = np.empty((7 + agents, n))
    # Sorted by t, the episodes of a batch end at about the same time, and few environments idle.
    order = np.argsort(t, kind="stable")
    for start in range(0, n, MOST_ENVS):
        rows = order[start : start + MOST_ENVS]
        batch = Batch(task, len(rows), reuse=True)
        batch.seed_by_states(np.arange(len(rows)), states[rows], seed)
        seen = None if distractors is None else distractors[rows]
        batch.place(states[rows], t[rows], np.repeat(r_cum[rows, None], agents, axis=1), seen)
        first = None if actions is None else actions[rows]
        totals[:, rows] = _sums(batch, _Acting(policy, first, at_end), gamma)
    returns, discounted, terminated, length = totals[:4]
    regret, similarity, square, *of_agents = totals[4:] / length
    return Rollouts(
        returns, discounted, length, regret, similarity, square, terminated, np.array(of_agents)
    )


def _sums(batch: Batch, act: _Acting, gamma: float) -> Array:
    sums, weight = np.zeros((7 + len(batch.task.policies), batch.num_envs)), 1.0
    for step in play(batch, act):
        values = step.result.values
        similarity, regret, reward = _team_means(values[[SIMILARITY, REGRET, REWARD]])
        paid = weight * (reward + act.bonus)
        ended = step.result.terminated
        rows = (reward, paid, ended, 1.0, regret, similarity, similarity**2, *values[REGRET])
        for total, value in zip(sums, rows, strict=True):
            total += step.running * value
        weight *= gamma
    return sums


class _Acting:
    """A policy at the start of a batch of episodes, which takes the `first` actions, if any."""

    def __init__(
        self, policy: Callable[[Observation], Any], first: Array | None, at_end: bool
    ) -> None:
        self._policy = policy.start() if isinstance(policy, Policy | TeamPolicy) else policy
        self._first, self._at_end = first, at_end
        self.bonus: Any = 0.0

    def __call__(self, state: Array, observation: Observation) -> npt.NDArray[Any]:
        action, self._first = self._first, None
        if action is not None:
            return action
        seen = observation.copy()
        if self._at_end:
            seen[:, -2] = 1.0
        action = np.asarray(self._policy(seen))
        self.bonus = getattr(self._policy, "bonus", 0.0)
        return action


def _team_means(values: Array) -> Array:
    """Means over agents, `[rows, n, B]` to `[rows, B]`; without a sum for a single agent."""
    return values[:, 0] if values.shape[1] == 1 else np.asarray(values.mean(axis=1))


def values(
    task: SpecLike | Task,
    policy: Any,
    states: npt.ArrayLike,
    *,
    gamma: float,
    t: npt.ArrayLike = 0,
    accumulated: npt.ArrayLike = 0.0,
    distractors: npt.ArrayLike | None = None,
    actions: npt.ArrayLike | None = None,
    horizon: Horizon = "finite",
    samples: int = 1,
    seed: int = 0,
) -> Array:
    """The exact value `[B]` of a policy at each of some states: what a critic should say.

    The discounted rewards that the agent is paid, shaping and noise included, to the end of the
    episode. METHOD, section 11. For a stream give the task of a phase, such as `phase.spec`.

    Args:
      policy: as in `evaluate`; one that samples its actions is averaged over `samples`.
      states: `[B, S]`, also outside the cube.
      gamma: discount in [0, 1].
      t: steps before each state, `[B]` or one number, in [0, T).
      accumulated: r_cum before each state, `[B]` or one number, in [0, k].
      distractors: `[B, m]`, by default drawn from `seed`.
      actions: first actions `[B, A]` of the unit range, for a value of actions (Q); by default
        the policy's.
      horizon: "continuing" adds γ^(T − t) times the mean value of going on after the end without
        shaping, with t/T held at 1: what an agent that bootstraps at a truncation estimates.
      samples: roll-outs from each state, which a stochastic policy or noise needs.
      seed: of distractors, noise and the states that a continuing value goes on from.

    Example:
      >>> states = np.full((2, 8), 0.5)
      >>> sme_registry.values("Default", "optimal", states, gamma=1.0, t=[0, 90])
      array([100.,  10.])
    """
    task = single_agent(load_task(task))
    spec = task.spec
    choice("horizon", horizon, ("finite", "continuing"))
    integer_in("samples", samples, 1)
    integer_in("seed", seed, 0)
    number_in("gamma", gamma, 0.0, 1.0)
    if gamma == 1 and horizon == "continuing":
        raise OptionError(
            'horizon="continuing": without an end and with gamma=1, values are infinite. Use '
            'horizon="finite", or gamma below 1.'
        )
    s = _states(states, spec.state_dim)
    B = len(s)
    steps = numbers_in("t", t, B, 0, spec.horizon - 1, of="state", whole=True).astype(np.int64)
    r_cum = numbers_in("accumulated", accumulated, B, 0.0, spec.k, of="state")
    d = _rows("distractors", distractors, (B, spec.distractors))
    first = _rows("actions", actions, (B, spec.action_dim))
    if policy == "optimal" and first is None and horizon == "finite" and _has_formula(spec, gamma):
        return _of_optimum(task, s, steps, gamma)
    acting = as_policy(policy, spec)
    finite, left = expected_returns(
        task, acting, s, t=steps, gamma=gamma, samples=samples, seed=seed,
        r_cum=r_cum, distractors=d, actions=first,
    )  # fmt: skip
    if horizon == "finite":
        return finite
    return finite + left * value_after_end(task, acting, gamma, seed)


def expected_returns(
    task: Task,
    policy: Callable[[Observation], Any],
    s: Array,
    *,
    t: npt.NDArray[np.int64],
    gamma: float,
    samples: int = 1,
    seed: int = 0,
    **begun: Any,
) -> tuple[Array, Array]:
    """`values` of checked arguments to the end of the episode `[B]`, and the discount there.

    The discount γ^(T − t) is 0 of episodes that D ends. `begun` are r_cum, distractors and
    first actions.
    """
    finite, left, steps = [], [], task.spec.horizon - t
    for i in range(samples):
        runs = rollouts(policy, task, s, t=t, gamma=gamma, seed=seed + i, **begun)
        finite.append(runs.discounted_return)
        left.append(np.where(runs.terminated, 0.0, gamma**steps))
    return np.mean(finite, axis=0), np.mean(left, axis=0)


def _has_formula(spec: SMESpec, gamma: float) -> bool:
    telescopes = spec.shaping is None or gamma == spec.shaping.discount == 1
    return spec.k == 1 and spec.D < 1 and not spec.compensated and telescopes


def _of_optimum(task: Task, s: Array, t: npt.NDArray[np.int64], gamma: float) -> Array:
    left = task.spec.horizon - t
    if gamma == 1:
        return np.asarray(left - task.potential(s, t))
    return np.asarray((1 - gamma**left) / (1 - gamma))


def value_after_end(
    task: Task, policy: Callable[[Observation], Any], gamma: float, seed: int
) -> float:
    """V̄_T: the mean value of going on for ever from uniform states, with t/T held at 1."""
    steps = 1 if gamma == 0 else max(1, int(np.ceil(np.log(_NEGLIGIBLE) / np.log(gamma))))
    # Neither changes what is drawn, only how long an episode is, and that P = 0.
    spec = task.spec.derive(horizon=steps, shaping=None)
    s = draw.uniform(seed, "values/tail", _TAILS * spec.state_dim).reshape(_TAILS, -1)
    tail = rollouts(policy, load_task(spec), s, gamma=gamma, seed=seed, at_end=True)
    return float(tail.discounted_return.mean() / (1 - gamma**steps))


def numbers_in(
    name: str,
    given: npt.ArrayLike,
    count: int,
    low: float,
    high: float,
    *,
    of: str,
    whole: bool = False,
) -> Array:
    """`[count]` numbers in a range, one for each of what `of` says, from so many or from one."""
    numbers = _numbers(given)
    allowed = (low <= numbers) & (numbers <= high) & (not whole or numbers == np.rint(numbers))
    if numbers.shape not in ((), (count,)) or not allowed.all():
        kind = "integer" if whole else "number"
        raise OptionError(
            f"{name}={given!r:.80}: must be one {kind} or {count}, one for each {of}, in "
            f"[{low:g}, {high:g}]."
        )
    return np.broadcast_to(numbers, (count,))


def _numbers(given: npt.ArrayLike) -> Array:
    """An array of float64; NaN where it is none."""
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError):
        return np.array(np.nan)


def _rows(name: str, given: npt.ArrayLike | None, shape: tuple[int, int]) -> Array | None:
    return None if given is None else initial_states(given, shape, name)


def _states(states: npt.ArrayLike, state_dim: int) -> Array:
    s = _numbers(states)
    if s.ndim != 2 or s.shape[1] != state_dim or not np.isfinite(s).all():
        raise StateError(f"states of shape {s.shape}: must be finite, of shape [B, {state_dim}].")
    return s

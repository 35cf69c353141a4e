"""What is known exactly about policies: reference scores of a data set, and returns by rollout.

Reference scores are of its behaviour, of the constant ½, and of the optimum. On the data set's own
states they are exact, because π* is known there. By rollouts they are means over whole episodes
with their own starts, with standard errors; the optimum's return is T by construction. For a team
every number is the mean over its agents.

Off-policy evaluation estimates from data what a policy would earn. Here the task is known and its
transitions are deterministic, so `exact_return` computes it:

    G(s, t, r_cum) = Σ_i γ^i R_{t+1+i}     from the step after t to the end of the episode; γ = 1
                                           for the undiscounted return

R is the reward as paid, so r_cum, k, r_min, D and the horizon all matter. `M` states, `S`
state_dim, `A` action_dim, T horizon. Exact means up to rounding: the transition doubles
differences at each step, so two policies whose actions differ in the last bit of float32 are in
different states after some 25 steps, and a network rounds differently in batches of another size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from sme_registry.compiled.arrays import REWARD, SIMILARITY, Array, Observation
from sme_registry.datasets.collect import (
    BehaviourEpisodes,
    BehaviourPolicy,
    EpisodeStream,
    behaviour_policy,
    constant_policy,
)
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.record import EpisodeScores, PolicyScore, ReferenceScores
from sme_registry.datasets.transitions import Transitions
from sme_registry.envs.arguments import initial_states
from sme_registry.envs.batch import Batch
from sme_registry.errors import OptionError, SpecError, StateError
from sme_registry.evaluation import as_policy
from sme_registry.evaluation.rollouts import LANES, play
from sme_registry.evaluation.rollouts import rollouts as run_rollouts
from sme_registry.io import integer_in, number_in
from sme_registry.spec import SMESpec, SpecLike
from sme_registry.task import Task, load_task

CONFIDENCE = 0.95
EPISODES = 100
_ROUNDED = 1e-6  # of r_cum, which an observation stores as float32
_MAX_STEPS = 10**5  # of the rollouts of one policy, over all episodes


def reference_scores(
    recipe: DatasetRecipe,
    task: Task,
    transitions: Transitions,
    policies: dict[int, object] | None = None,
) -> ReferenceScores:
    """The reference scores of a data set; `policies` as in `collect`."""
    T = recipe.spec.horizon
    episodes = min(EPISODES, _MAX_STEPS // T)

    def rollouts(policy: BehaviourPolicy, index: int) -> EpisodeScores | None:
        if episodes == 0:
            return None
        stream = f"dataset/reference/{index}/start"
        starts = EpisodeStream(recipe.seed, stream, episodes, recipe.spec.state_dim, ahead=1)
        return _rollouts(*whole_episodes(task, policy, starts, episodes))

    behaviours = []
    for index in range(len(recipe.behaviours)):
        rows = transitions.components == index
        policy = behaviour_policy(
            recipe, index, task, max(1, episodes), (policies or {}).get(index), "dataset/reference"
        )
        behaviours.append(
            _score(
                transitions.similarities[rows],
                transitions.step_rewards[rows],
                rollouts(policy, index),
            )
        )
    weights = [behaviour.weight for behaviour in recipe.behaviours]
    weighted = _weighted(weights, [score.rollouts for score in behaviours])
    return ReferenceScores(
        constant=_score(*_constant_values(task, transitions), rollouts(constant_policy(task), 0)),
        behaviour=_score(transitions.similarities, transitions.step_rewards, weighted),
        behaviours=tuple(behaviours),
        optimum=PolicyScore(
            similarity=1.0,
            step_reward=1.0,
            rollouts=EpisodeScores(
                episodes=0, mean_return=float(T), standard_error=0.0, similarity=1.0
            ),
        ),
    )


def _score(similarity: Array, step_reward: Array, rollouts: EpisodeScores | None) -> PolicyScore:
    means = {"similarity": similarity.mean(), "step_reward": step_reward.mean()}
    return PolicyScore(**means, rollouts=rollouts)


def _constant_values(task: Task, transitions: Transitions) -> tuple[Array, Array]:
    """r̃ and r of a = ½ on the data set's states."""
    optimal = transitions.optimal_actions
    similarity = task.similarities_of(np.full_like(optimal, 0.5), optimal)
    rewarded = similarity
    if task.pays_the_team:  # the mean over all channels, of which agents own unequal numbers
        channels = np.array([owned.stop - owned.start for owned in task.owned])
        rewarded = (similarity @ channels) / task.spec.action_dim
    return similarity, task.reward_of(rewarded)


def whole_episodes(
    task: Task, policy: BehaviourPolicy, starts: EpisodeStream, count: int
) -> tuple[Array, Array, Array]:
    """Return, sum of r̃ and steps `[count]` of the first episodes; means over agents."""
    episodes, sums = BehaviourEpisodes(task, policy, starts, count), np.zeros((3, count))
    for step in play(episodes.batch, episodes.act):
        similarity, reward = step.result.values[[SIMILARITY, REWARD]].mean(axis=1)
        sums += step.running * np.stack([reward, similarity, np.ones(count)])
    returns, similarities, steps = sums
    return returns, similarities, steps


def _rollouts(returns: Array, similarities: Array, steps: Array) -> EpisodeScores:
    count = len(returns)
    return EpisodeScores(
        episodes=count,
        mean_return=returns.mean(),
        standard_error=returns.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0,
        similarity=min(1.0, similarities.sum() / steps.sum()),
    )


def _weighted(weights: list[float], scores: list[EpisodeScores | None]) -> EpisodeScores | None:
    """The mean over behaviours by their weights; None if one is None."""
    known = [score for score in scores if score is not None]
    if len(known) < len(scores):
        return None
    if len(known) == 1:
        return known[0]
    pairs = list(zip(weights, known, strict=True))
    return EpisodeScores(
        episodes=sum(score.episodes for score in known),
        mean_return=math.fsum(w * score.mean_return for w, score in pairs),
        standard_error=math.sqrt(math.fsum((w * s.standard_error) ** 2 for w, s in pairs)),
        similarity=min(1.0, math.fsum(w * score.similarity for w, score in pairs)),
    )


class ReturnEstimate(NamedTuple):
    """A mean and its 95 % interval, each a number or `[M]`; an exact value has zero width."""

    mean: Any
    low: Any
    high: Any


@dataclass(frozen=True, eq=False)
class ExactReturn:
    """The returns of a policy from `M` states.

    `undiscounted` and, with γ, `discounted` have a mean, low and high of `[M]` each; `lengths`
    `[M]` are the mean steps to the end of the episode, `similarity` `[M]` the mean r̃ over them,
    and `rollouts` the episodes from each state.
    """

    undiscounted: ReturnEstimate
    discounted: ReturnEstimate
    lengths: Array
    similarity: Array
    gamma: float
    rollouts: int

    def over_states(self) -> tuple[ReturnEstimate, ReturnEstimate]:
        """The mean over all states, undiscounted and discounted, with its interval.

        The interval assumes that the states are independent draws from a distribution. For rows of
        the same trajectories it is too narrow.
        """
        if len(self.lengths) < 2:
            raise OptionError("states: an interval over states requires at least 2 of them.")
        return _interval(self.undiscounted.mean), _interval(self.discounted.mean)


def exact_return(
    policy: Any,
    spec: SpecLike,
    *,
    states: npt.ArrayLike,
    t: npt.ArrayLike = 0,
    r_cum: npt.ArrayLike = 0.0,
    actions: npt.ArrayLike | None = None,
    gamma: float = 0.99,
    rollouts: int = 1,
    action_range: str | None = None,
) -> ExactReturn:
    """Run a policy from `M` states of a single-agent task to the end of the episode.

    Args:
      policy: anything that `evaluate` accepts: a callable `[B, O] → [B, A]`, a model, or the
        path of one.
      spec: a spec, its fields, an id, a digest or a path.
      states: `[M, S]` in [0, 1]; `Transitions.states` are exact, its observations are rounded.
      t: `[M]` or one number, steps completed before, in [0, T).
      r_cum: `[M]` or one number, the rewards since the last payout, in [0, t mod k].
      actions: `[M, A]` in [0, 1], executed in the first step instead of the policy's. The return
        is then Q(s, a) instead of V(s).
      gamma: γ in [0, 1] of the discounted return.
      rollouts: episodes from each state: 1 for a deterministic policy, whose return is exact; more
        for a stochastic one, whose mean gets a 95 % interval (Student's t). On a task with
        distractors also more than 1: each episode draws them anew, at its start too.
      action_range: of the policy's actions; None takes its own, and "unit" for a callable.

    Examples:
      >>> from sme_registry.datasets import exact_return, open_dataset, positions
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> where = positions(data.transitions(), data.recipe.spec, [0, 90])
      >>> result = exact_return("optimal", data.recipe.spec, **where)
      >>> result.undiscounted.mean.round(3).tolist()
      [100.0, 10.0]
    """
    task = load_task(spec)
    if task.spec.team is not None:
        raise SpecError("team: must be null here. Give a single-agent task.")
    gamma = number_in("gamma", gamma, 0.0, 1.0)
    rollouts = integer_in("rollouts", rollouts, 1, 10**6)
    checked_policy = as_policy(policy, task.spec, action_range=action_range)
    states, t, r_cum = _starts(task.spec, states, t, r_cum)
    if actions is not None:
        actions = _first_actions(actions, len(states), task.spec.action_dim)
    if rollouts == 1:
        _check_deterministic(checked_policy, task, states, t, r_cum)
    results = [
        run_rollouts(
            checked_policy, task, states, t=t, r_cum=r_cum, actions=actions, gamma=gamma, seed=seed
        )
        for seed in range(rollouts)
    ]
    lengths = np.stack([result.length for result in results])
    similarities = [result.similarity for result in results]
    return ExactReturn(
        undiscounted=_interval(np.stack([result.episode_return for result in results])),
        discounted=_interval(np.stack([result.discounted_return for result in results])),
        lengths=lengths.mean(axis=0),
        similarity=np.average(similarities, axis=0, weights=lengths),
        gamma=gamma,
        rollouts=rollouts,
    )


def positions(
    transitions: Transitions, spec: SMESpec, rows: npt.ArrayLike | None = None
) -> dict[str, Any]:
    """The states, times and accumulated rewards of rows of a data set, for `exact_return`.

    `rows` are indices or a mask; None for all. `states` `[M, S]` and `t` `[M]` are exact, `r_cum`
    `[M]` is as an observation stores it, to a relative precision of 6e-8.

    Examples:
      >>> from sme_registry.datasets import open_dataset, positions
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> positions(data.transitions(), data.recipe.spec, [0, 10])["t"].tolist()
      [0, 10]
    """
    chosen = slice(None) if rows is None else np.asarray(rows)
    seen = transitions.observations[chosen].astype(np.float64)
    t = np.rint(seen[:, -2] * spec.horizon).astype(np.int64)
    r_cum = np.minimum(seen[:, -1] * spec.k, t % spec.k)
    return {"states": transitions.states[chosen], "t": t, "r_cum": r_cum}


def _starts(
    spec: SMESpec, states: npt.ArrayLike, t: npt.ArrayLike, r_cum: npt.ArrayLike
) -> tuple[Array, npt.NDArray[np.int64], Array]:
    S, T, k = spec.state_dim, spec.horizon, spec.k
    M = len(states) if isinstance(states, np.ndarray | list | tuple) else 0
    if M == 0:
        raise StateError(f"states={states!r:.60}: must be [M, {S}], one row for each start.")
    s = initial_states(states, (M, S))
    steps, accumulated = _column("t", t, M), _column("r_cum", r_cum, M)
    wrong = (steps != np.rint(steps)) | (steps < 0) | (steps >= T)
    if wrong.any():
        raise StateError(f"t={steps[wrong][0]:g}: must be an integer in [0, {T}).")
    since = steps % k
    wrong = (accumulated < 0) | (accumulated > since + _ROUNDED)
    if wrong.any():
        raise StateError(
            f"r_cum={accumulated[wrong][0]:g}: must be in [0, {since[wrong][0]:g}] at "
            f"t={steps[wrong][0]:g}, the number of steps since the last payout (k={k})."
        )
    return s, steps.astype(np.int64), accumulated


def _first_actions(actions: npt.ArrayLike, rows: int, action_dim: int) -> Array:
    try:
        array = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (rows, action_dim) or not ((array >= 0) & (array <= 1)).all():
        raise OptionError(
            f"actions of shape {array.shape}: must be ({rows}, {action_dim}), each in [0, 1]."
        )
    return array


def _column(name: str, value: npt.ArrayLike, rows: int) -> Array:
    try:
        column = np.broadcast_to(np.asarray(value, np.float64), (rows,))
    except (TypeError, ValueError):
        raise StateError(
            f"{name}={value!r:.60}: must be one number, or an array of shape ({rows},)."
        ) from None
    if not np.isfinite(column).all():
        raise StateError(f"{name}: contains NaN or infinity. Give finite numbers.")
    return column.copy()


def _check_deterministic(
    policy: Callable[[Observation], npt.ArrayLike],
    task: Task,
    s: Array,
    t: npt.NDArray[np.int64],
    r_cum: Array,
) -> None:
    """Raise if the return of one episode from a state is not the only one that it can have."""
    if task.spec.distractors:
        raise OptionError(
            f"rollouts=1: the task has {task.spec.distractors} distractors, which are drawn at "
            "random, so the return of one episode is not exact. Give rollouts=30 or more for a "
            "mean with its interval."
        )
    batch = Batch(task, min(len(s), LANES))
    batch.place(s[:LANES], t[:LANES], r_cum[:LANES, None])
    if not np.array_equal(policy(batch.observe()), policy(batch.observe())):
        raise OptionError(
            "rollouts=1: the policy is stochastic, so the return of one episode is not exact. Give "
            "rollouts=30 or more for a mean with its interval."
        )


def _interval(samples: Array) -> ReturnEstimate:
    """Mean over the first axis and its Student's t interval; of one sample, the sample."""
    count, mean = len(samples), samples.mean(axis=0)
    if count == 1:
        return ReturnEstimate(mean, mean, mean)
    error = samples.std(axis=0, ddof=1) / np.sqrt(count)
    half = stdtrit(count - 1, 0.5 + CONFIDENCE / 2) * error
    return ReturnEstimate(mean, mean - half, mean + half)

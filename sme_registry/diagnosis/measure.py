"""What is measured of a policy: over uniform states, over shells, over episodes, over its log.

`N` states, `S` state_dim, `A` action_dim, `T` horizon, `n` episodes side by side. Everything random
is a named stream of one seed, so the same policy gets the same numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import engine
from sme_registry.diagnosis.report import (
    Channel,
    Clock,
    Form,
    OnPolicy,
    Partition,
    Score,
    Shell,
    Signal,
    Training,
)
from sme_registry.diagnosis.subject import Log
from sme_registry.envs.batch import Batch, Mask, Observation
from sme_registry.evaluation import Policy, references
from sme_registry.evaluation.regions import expansion, observations, region_name
from sme_registry.spec import EvaluationProtocol
from sme_registry.task import Task, streams
from sme_registry.task.draw import Array

Act = Callable[[Observation], Array]

OWN = ""  # the key of the policy in question among the references' names
AT_BOUND = 0.01
CONSTANTS = ("best_constant", "constant_half")
BINS, TIME_BINS = 5, 10
_SHELL_STATES = 2000
_CLOCK_STATES, _CLOCK_INPUTS = 512, 11
_STEP = 0.01  # of a state, to see how far actions move
_HALVES = 20  # bins of a state channel that an episode may enter
_NUMBERS = 2**23  # of states and actions held at once, 64 MiB as float64
_TINY = 1e-12


class Sample(NamedTuple):
    """States, what was done in them, and what was optimal: `[N, S + 2]`, `[N, S]`, `[N, A]`."""

    observation: Observation
    s: Array
    optimal: Array
    a: Array
    others: dict[str, Array]

    @property
    def missed(self) -> Array:
        """`[N, A]` |a − a*|."""
        return np.abs(self.a - self.optimal)


def affordable(task: Task, wanted: int) -> int:
    """How many states are held at once: fewer where a state is large."""
    return max(64, min(wanted, _NUMBERS // (task.spec.state_dim + task.spec.action_dim)))


def acted(policy: Policy, observation: Observation) -> Array:
    """The policy's actions as the environment uses them; it may write into what it is given."""
    return np.clip(policy(observation.copy()), 0.0, 1.0)


def fitted_references(task: Task, states: int, seed: int) -> references.References:
    """The references, fitted on uniform states that nothing else here uses."""
    count = min(4 * affordable(task, states), references.fit_states(task.spec))
    s = streams.uniform(seed, "diagnosis/fit", count * task.spec.state_dim).reshape(count, -1)
    return references.fit(s, engine(task).optimal_action(s))


def sample(
    policy: Policy,
    task: Task,
    fitted: references.References,
    protocol: EvaluationProtocol,
    region: int,
) -> Sample:
    """A region's states with the actions of the policy and of the references."""
    (observation,) = observations(protocol, region, task.spec, rows=protocol.states_per_region)
    s = observation[:, : task.spec.state_dim].astype(np.float64)
    optimal = engine(task).optimal_action(s)
    random = streams.uniform(protocol.seed, f"diagnosis/{region}/random", optimal.size)
    others = fitted.actions(s, optimal, random.reshape(optimal.shape))
    return Sample(observation, s, optimal, acted(policy, observation), others)


def scores(task: Task, found: Sample) -> dict[str, Score]:
    """The policy and each reference in the same states."""
    half = float(np.abs(0.5 - found.optimal).mean())
    return {who: _score(task, a, found.optimal, half) for who, a in _all(found).items()}


def _all(found: Sample) -> dict[str, Array]:
    return {OWN: found.a, **found.others}


def _score(task: Task, a: Array, optimal: Array, half: float) -> Score:
    regret = 1.0 - task.reward_of(task.similarity_of(a, optimal))
    error = float(np.abs(a - optimal).mean())
    return Score(regret=float(regret.mean()), error=error, normalised=error / max(half, _TINY))


def channels(task: Task, found: Sample) -> tuple[Channel, ...]:
    """Each action channel."""
    missed, half = found.missed, np.abs(0.5 - found.optimal).mean(axis=0)
    linear = np.abs(found.others["linear_least_squares"] - found.optimal).mean(axis=0)
    total = missed.sum(axis=1)
    regret = 1.0 - task.reward_of(task.similarity_of(found.a, found.optimal))
    # Where nothing was missed nothing is regretted.
    charged = (missed * (regret / np.maximum(total, _TINY))[:, None]).mean(axis=0)
    slopes = _slopes(found)
    at_zero, at_one = found.a <= AT_BOUND, found.a >= 1.0 - AT_BOUND
    return tuple(
        Channel(
            channel=i + 1,
            error=float(missed[:, i].mean()),
            normalised=float(missed[:, i].mean() / max(half[i], _TINY)),
            linear=float(linear[i] / max(half[i], _TINY)),
            regret=float(charged[i]),
            offset=float((found.a - found.optimal)[:, i].mean()),
            slope=float(slopes[i]),
            at_zero=float(at_zero[:, i].mean()),
            at_one=float(at_one[:, i].mean()),
            optimal_at_bounds=float(_at_bounds(found.optimal[:, i])),
        )
        for i in range(task.spec.action_dim)
    )


def _slopes(found: Sample) -> Array:
    """`[A]` slope of a on a* in each channel."""
    a, optimal = found.a - found.a.mean(axis=0), found.optimal - found.optimal.mean(axis=0)
    return np.asarray((a * optimal).sum(axis=0) / np.maximum((optimal**2).sum(axis=0), _TINY))


def _at_bounds(a: Array) -> float:
    return float(((a <= AT_BOUND) | (a >= 1.0 - AT_BOUND)).mean())


def partitions(task: Task, found: Sample) -> tuple[Partition, ...]:
    """Cut by the distance from the centre first, then by each state channel."""
    error = found.missed.mean(axis=1)
    regret = 1.0 - task.reward_of(1.0 - error)
    by = [expansion(found.s), *found.s.T]
    return tuple(_partition(i, values, error, regret) for i, values in enumerate(by))


def _partition(by: int, values: Array, error: Array, regret: Array) -> Partition:
    edges = np.quantile(values, np.linspace(0.0, 1.0, BINS + 1))
    where = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, BINS - 1)
    counts = np.maximum(np.bincount(where, minlength=BINS), 1)
    means = np.bincount(where, error, BINS) / counts
    between = float((counts * (means - error.mean()) ** 2).sum() / len(error))
    variance = float(error.var())
    return Partition(
        by=by,
        edges=tuple(edges.tolist()),
        error=tuple(means.tolist()),
        regret=tuple((np.bincount(where, regret, BINS) / counts).tolist()),
        explained=between / variance if variance > _TINY else 0.0,
    )


def shells(
    policy: Policy,
    task: Task,
    fitted: references.References,
    seed: int,
    within: dict[str, Score],
) -> tuple[Shell, ...]:
    """WD, whose scores are known, and the five shells around it."""
    protocol = EvaluationProtocol(states_per_region=affordable(task, _SHELL_STATES), seed=seed)
    around = [
        Shell(
            name=region_name(region),
            epsilon=protocol.edges[region][1],
            policies=scores(task, sample(policy, task, fitted, protocol, region)),
        )
        for region in range(1, len(protocol.edges))
    ]
    return (Shell(name=region_name(0), epsilon=0.0, policies=within), *around)


def form(policy: Policy, task: Task, found: Sample, moved_by_clock: float, seed: int) -> Form:
    """What the squared error consists of, and how the policy follows the state.

    Args:
      moved_by_clock: mean over states and channels of the variance of a over t/T.
    """
    difference = found.a - found.optimal
    squared = max(float((difference**2).mean()), _TINY)
    exact = squared <= _TINY  # nothing to divide up
    offset = float((difference.mean(axis=0) ** 2).mean())
    scale = float(((_slopes(found) - 1.0) ** 2 * found.optimal.var(axis=0)).mean())
    again = acted(policy, found.observation)
    noise = 0.5 * float(((again - found.a) ** 2).mean())
    linear, rest = _parts(found.s, found.a)
    linear_of_optimal, rest_of_optimal = _parts(found.s, found.optimal)
    variance = max(float(found.optimal.var(axis=0).sum()), _TINY)
    beyond = float((rest_of_optimal**2).mean(axis=0).sum()) / variance
    return Form(
        offset=0.0 if exact else offset / squared,
        scale=0.0 if exact else scale / squared,
        residual=0.0 if exact else max(0.0, 1.0 - (offset + scale) / squared),
        noise=noise / squared,
        clock=max(0.0, moved_by_clock - noise) / squared,
        accumulated=max(0.0, _moved_by_accumulated(policy, task, found) - noise) / squared,
        beyond_linear=beyond,
        learnt_linear=_follows(linear, linear_of_optimal) if beyond < 0.99 else None,
        learnt_rest=_follows(rest, rest_of_optimal) if beyond > 0.01 else None,
        gain=_gain(policy, task, found, seed),
        saturated=_at_bounds(found.a),
        optimal_saturated=_at_bounds(found.optimal),
    )


def _parts(s: Array, a: Array) -> tuple[Array, Array]:
    """Actions as an affine map of the state, about their mean, and what is left: `[N, A]` each."""
    design = np.concatenate([s - 0.5, np.ones((len(s), 1))], axis=1)
    affine = design @ np.linalg.lstsq(design, a)[0]
    return affine - affine.mean(axis=0), a - affine


def _follows(part: Array, optimal: Array) -> float:
    return float((part * optimal).sum() / max(float((optimal**2).sum()), _TINY))


def _moved_by_accumulated(policy: Policy, task: Task, found: Sample) -> float:
    """Variance of a over r_cum/k in [0, (k − 1)/k], which is all that it can be."""
    k, few = task.spec.k, found.observation[:_CLOCK_STATES].copy()
    if k == 1:
        return 0.0
    actions = []
    for value in np.linspace(0.0, (k - 1) / k, 5):
        few[:, -1] = value
        actions.append(acted(policy, few))
    return float(np.var(actions, axis=0).mean())


def _gain(policy: Policy, task: Task, found: Sample, seed: int) -> float:
    """RMS change of a over RMS change of a*, over small steps of the state."""
    few = affordable(task, 2048)
    observation, s = found.observation[:few].copy(), found.s[:few]
    directions = streams.gaussian(seed, "diagnosis/directions", s.size).reshape(s.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    observation[:, : s.shape[1]] = s + _STEP * directions
    moved = observation[:, : s.shape[1]].astype(np.float64)
    of_optimal = engine(task).optimal_action(moved) - found.optimal[:few]
    own = acted(policy, observation) - found.a[:few]
    return float(np.sqrt((own**2).mean() / max(float((of_optimal**2).mean()), _TINY)))


def clock(policy: Policy, task: Task, found: Sample) -> tuple[Clock, float]:
    """The same states at other times; and the mean variance of an action over them."""
    few = found.observation[:_CLOCK_STATES].copy()
    optimal = found.optimal[:_CLOCK_STATES]
    T = task.spec.horizon
    inputs = np.unique(np.floor(np.linspace(0, T - 1, _CLOCK_INPUTS))) / T
    actions = []
    for value in inputs:
        few[:, -2] = value
        actions.append(acted(policy, few))
    all_actions = np.array(actions)
    half = max(float(np.abs(0.5 - optimal).mean()), _TINY)
    middle = all_actions.mean(axis=0)
    return (
        Clock(
            inputs=tuple(inputs.tolist()),
            normalised=tuple(float(np.abs(a - optimal).mean()) / half for a in actions),
            moved=tuple(float(np.abs(a - middle).mean()) for a in actions),
        ),
        float(all_actions.var(axis=0).mean()),
    )


class Trace(NamedTuple):
    """Episodes side by side, to the end of the last one.

    Attributes:
      s: `[T, n, S]` states acted in.
      error: `[T, n]` mean |a − a*| over channels.
      half: `[T, n]` the same of the constant ½.
      reward: `[T, n]` the step reward r.
      payout: `[T, n]` what was paid, R.
      alive: `[T, n]` whether the episode still ran.
      paid: `[T, n]` whether a payout was due after the step.
      terminated: `[n]` whether D ended it.
    """

    s: Array
    error: Array
    half: Array
    reward: Array
    payout: Array
    alive: Mask
    paid: Mask
    terminated: Mask

    def mean(self, values: Array | Mask) -> float:
        """Over all steps of all episodes."""
        return float(values[self.alive].mean())


def trace(act: Act, task: Task, starts: Array) -> Trace:
    """Whole episodes of a policy.

    Args:
      act: from observations `[n, S + 2]` float32 to actions `[n, A]` of the unit range.
      starts: `[n, S]`.
    """
    n = len(starts)
    batch = Batch(task, n)
    observation = batch.observe()
    batch.begin(np.arange(n), observation, starts)
    alive, terminated = np.ones(n, bool), np.zeros(n, bool)
    rows: list[tuple[npt.NDArray[Any], ...]] = []
    while alive.any():
        s, a = batch.state, np.clip(act(observation.copy()), 0.0, 1.0)
        done = batch.advance(np.ascontiguousarray(a, np.float64))
        t = len(rows) + 1
        due = (t % task.spec.k == 0) | done.truncated
        missed, half = np.abs(a - done.optimal), np.abs(0.5 - done.optimal)
        reward, payout = done.values[1, 0], done.values[3, 0]
        rows.append(
            (s, missed.mean(1), half.mean(1), reward.copy(), payout.copy(), alive.copy(), due)
        )
        terminated |= alive & done.terminated
        alive &= ~(done.terminated | done.truncated)
        observation = done.observation
    s, error, half, reward, payout, still, due = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return Trace(s, error, half, reward, payout, still, due, terminated)


def on_policy(
    policy: Policy, task: Task, fitted: references.References, episodes: int, seed: int
) -> OnPolicy:
    """Whole episodes of the policy and of references, from the same starts."""
    spec = task.spec
    S, A, T = spec.state_dim, spec.action_dim, spec.horizon
    n = max(8, min(episodes, _NUMBERS // (T * (S + 8))))
    starts = streams.uniform(seed, "diagnosis/starts", n * S).reshape(n, S)
    bits = streams.bit_generator(seed, "diagnosis/random_action")

    def uniform(observation: Observation) -> Array:
        return streams.to_uniform(bits.random_raw(n * A)).reshape(n, A)

    def linear(observation: Observation) -> Array:
        return (observation[:, :S] - 0.5) @ fitted.slope + fitted.intercept

    def constant(action: Array) -> Act:
        return lambda observation: np.tile(action, (n, 1))

    own = trace(policy, task, starts)
    random = trace(uniform, task, starts)
    others = {
        "linear_least_squares": trace(linear, task, starts),
        "best_constant": trace(constant(fitted.constant), task, starts),
        "constant_half": trace(constant(np.full(A, 0.5)), task, starts),
        "uniform_random": random,
    }
    found = {who: _score_of(episodes) for who, episodes in {OWN: own, **others}.items()}
    bins = min(TIME_BINS, len(own.s))
    cuts = np.linspace(0, len(own.s), bins + 1).round().astype(int)
    spans = [slice(low, high) for low, high in itertools.pairwise(cuts.tolist())]
    met = np.sort(own.s[own.alive], axis=0)
    return OnPolicy(
        episodes=n,
        scores=found,
        edges=tuple(cuts.astype(float).tolist()),
        regret=tuple(1.0 - float(own.reward[b][own.alive[b]].mean()) for b in spans),
        error=tuple(float(own.error[b][own.alive[b]].mean()) for b in spans),
        alive=tuple(float(own.alive[b].mean()) for b in spans),
        mean_length=float(own.alive.sum(axis=0).mean()),
        terminated=float(own.terminated.mean()),
        signal=_signal(task, own),
        signal_random=_signal(task, random),
        credit=_credit(own),
        credit_random=_credit(random),
        drift=tuple(_distance_from_uniform(met[:, j]) for j in range(S)),
        covered=min(_covered(met[:, j]) for j in range(S)),
    )


def _score_of(found: Trace) -> Score:
    return Score(
        regret=1.0 - found.mean(found.reward),
        error=found.mean(found.error),
        normalised=found.mean(found.error) / max(found.mean(found.half), _TINY),
    )


def _signal(task: Task, found: Trace) -> Signal:
    similarity = 1.0 - found.error
    paid = found.reward > 0.0
    graded = similarity > 0.75
    begins = 0.75 + task.spec.r_min / 4.0
    return Signal(
        paid=found.mean(paid),
        hidden=found.mean(graded & ~paid),
        flat=found.mean(~graded & ~paid),
        short=found.mean(np.maximum(0.0, begins - similarity)),
    )


def _credit(found: Trace) -> float | None:
    """Squared correlation of step rewards with the payouts that they are part of."""
    credited = np.full(found.reward.shape, np.nan)
    following = np.full(found.reward.shape[1], np.nan)
    for t in range(len(credited) - 1, -1, -1):
        following = np.where(found.alive[t] & found.paid[t], found.payout[t], following)
        credited[t] = following
    known = found.alive & np.isfinite(credited)
    reward, payout = found.reward[known], credited[known]
    if len(reward) < 2 or reward.std() < 1e-9 or payout.std() < 1e-9:
        return None
    return float(np.corrcoef(reward, payout)[0, 1] ** 2)


def _distance_from_uniform(values: Array) -> float:
    """Kolmogorov-Smirnov distance of sorted values from the uniform distribution."""
    n = len(values)
    ranks = np.arange(n + 1) / n
    return float(max((ranks[1:] - values).max(), (values - ranks[:-1]).max()))


def _covered(values: Array) -> float:
    return float(len(np.unique(np.minimum(values * _HALVES, _HALVES - 1).astype(int))) / _HALVES)


def training(log: Log, constant: float) -> Training:
    """What a log says, beside the regret of the better constant policy."""
    rows = len(log.regret)
    window = max(1, min(50, rows // 10))
    smooth = np.array([np.median(log.regret[i : i + window]) for i in range(rows - window + 1)])
    ends = log.step[window - 1 :]
    below = np.flatnonzero(smooth < constant - 0.02)
    recent = smooth[-max(1, len(smooth) // 3) :]
    best = int(np.argmin(smooth))
    return Training(
        source=log.source,
        rows=rows,
        steps=int(log.step[-1]),
        first=float(smooth[0]),
        best=float(smooth[best]),
        best_step=int(ends[best]),
        last=float(smooth[-1]),
        window=window,
        constant=constant,
        escaped_at=int(ends[below[0]]) if len(below) else None,
        recent_gain=float(recent[0] - recent[-1]),
        unpaid=None if log.unpaid is None else float(log.unpaid.mean()),
        terminated=None if log.terminated is None else float(log.terminated.mean()),
    )

"""Measurements of a policy in fixed states: uniform in the cube, and in the shells around it.

ℓ are the limits of a task with `safety`, d the distractors of one with `observation`:

    owed to the distractors = N of a(s, d) − N of E_d a(s, d)

is the normalised regret that would be gone if the policy took, in every state, the mean of its
actions over the distractors. Of a random policy, what averaging removes with d fixed is subtracted.

`N` states, `S` state_dim, `A` action_dim, `T` horizon.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np

from sme_registry.evaluation import Policy, references, regions
from sme_registry.evaluation.regions import (
    TOLERANCE,
    SafetyReport,
    SafetyScore,
    SafetyStats,
    States,
    Uniform,
)
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf
from sme_registry.task import Task
from sme_registry.task.draw import Array, gaussian, uniform
from sme_registry.task.engine import engine
from sme_registry.task.task import Observation

POLICY = "policy"  # the key of the diagnosed policy among the names of the references
LINEAR = "linear"
MAX_NUMBERS = 2**23  # of states, distractors and actions held at once: 64 MiB as float64
_BOUND = 0.01  # an action this close to 0 or 1 is saturated
_BINS = 5
_SHELL_STATES = 2000
_DISTRACTED_STATES, _DRAWS = 512, 64
_FIXED_STATES, _TIME_INPUTS, _ACCUMULATED_INPUTS = 512, 11, 5
_STEP = 0.01  # length of a state's step, for the steepness
_TINY = 1e-12


class Score(StrictModel):
    """One policy over a set of states."""

    regret: Real  # mean
    mae: Real  # mean |a − a*|
    # mean regret over that of the constant ½: 0 at the optimum, 1 at the constant
    normalised_regret: Real

    @classmethod
    def of(cls, regret: float, mae: float, constant_mae: float) -> Self:
        """From means over the states; `constant_mae` is of the constant ½."""
        return cls(regret=regret, mae=mae, normalised_regret=mae / max(constant_mae, 1e-12))


class Channel(StrictModel):
    """One action channel over uniform states of the cube; the regrets add up to the mean regret."""

    channel: Integer  # from 1
    mae: Real  # mean |a − a*|
    normalised_regret: Real  # mae over that of the constant ½
    linear_normalised_regret: Real  # of the linear least-squares policy
    regret: Real  # in proportion to the channel's part of the error in each state
    offset: Real  # mean of a − a*
    slope: Real  # of the regression of a on a*: 1 at the optimum, 0 if a does not follow a*
    at_zero: Real  # share of states in which a is within 0.01 of the bound 0
    at_one: Real  # likewise of the bound 1
    optimal_at_bounds: Real  # share of states in which a* is within 0.01 of either bound


class Partition(StrictModel):
    """Uniform states in bins of equal counts along one quantity."""

    state_channel: Integer | None  # from 1; None for the distance from the cube's centre, E(s)
    edges: TupleOf[Real]  # of the bins, one more than there are bins
    regret: TupleOf[Real]  # mean of each bin
    mae: TupleOf[Real]  # mean |a − a*| of each bin
    explained_variance: Real  # share of the variance of the states' errors between bins


class Shell(StrictModel):
    region: str  # its name in the protocol's order
    epsilon: Real  # its outer ε; 0 for the cube
    scores: dict[str, Score]  # of the policy and references


class SquaredError(StrictModel):
    """Shares of the squared error Σ (a − a*)² over uniform states."""

    offset: Real  # a constant a − a* in each channel
    scale: Real  # a slope of a on a* other than 1
    residual: Real  # the rest; offset, scale and residual add up to 1
    noise: Real  # differs when the policy acts again in the same state
    time: Real  # varies with the input t/T in a fixed state
    accumulated_reward: Real  # varies with the input r_cum/k in a fixed state


class Response(StrictModel):
    """How actions follow the state, compared with π*.

    A slope is that of a part of the policy on the same part of π*: 1 at the optimum, 0 if nothing
    was learnt, None if π* has no such part (below 1 % of its variance).
    """

    nonlinear_variance: Real  # share of the variance of π* that no affine map explains
    linear_slope: Real | None  # of the affine part
    nonlinear_slope: Real | None  # of the remainder
    steepness: Real  # RMS change of a over RMS change of a*, for small steps of the state
    saturation: Real  # share of the policy's entries within 0.01 of a bound
    optimal_saturation: Real  # likewise of a*


class TimeDependence(StrictModel):
    """The input t/T varied in fixed uniform states."""

    inputs: TupleOf[Real]  # the values of t/T
    normalised_regret: TupleOf[Real]  # at each value
    action_change: TupleOf[Real]  # mean |a − mean over the values of a|, at each value


class LimitedChannel(StrictModel):
    """One action channel of a task with limits ℓ, over uniform states of the cube."""

    channel: Integer  # from 1
    violating_share: Real  # share of states in which a > ℓ
    optimal_violating_share: Real  # likewise of a*
    cost: Real  # mean max(0, a − ℓ) / (2τ); the mean over channels is the policy's cost


class Violations(StrictModel):
    """A policy on a task with limits."""

    report: SafetyReport  # of its evaluation: by region, with the references
    visited: SafetyScore  # in the states of its episodes
    cut_off: SafetyScore  # in the cube, of the policy with its actions cut off at the limits
    channels: TupleOf[LimitedChannel]  # by action channel


class DistractorRegret(StrictModel):
    """Regret owed to the distractors, in a few uniform states."""

    states: Integer  # number of uniform states
    distractor_draws: Integer  # of the distractors, in each state
    normalised_regret: Real  # N over states and draws
    averaged_regret: Real  # N of the mean action over the draws, in each state
    half_regret: Real  # N with every distractor at ½
    owed_regret: Real  # N that averaging removes, beyond what it removes of an action noise
    owed_similarity: Real  # the same in points of similarity
    distractor_share: Real  # share of the squared error that varies with the distractors


class Sample(NamedTuple):
    """States, the actions in them, and the optimal actions."""

    drawn: States  # with the distractors and times that the observations show
    observation: Observation  # `[N, O]`
    s: Array  # `[N, S]` states, float64
    a: Array  # `[N, A]` actions of the policy, in [0, 1]
    optimal: Array  # `[N, A]` optimal actions
    references: dict[str, Array]  # `[N, A]` actions of each reference

    @property
    def absolute_error(self) -> Array:
        """`[N, A]` |a − a*|."""
        return np.abs(self.a - self.optimal)


def affordable(task: Task, states: int) -> int:
    """How many of some states, with their distractors, fit in memory at once; at least 64."""
    spec = task.spec
    width = spec.state_dim + spec.distractors + spec.action_dim
    return max(64, min(states, MAX_NUMBERS // width))


def clipped_actions(policy: Policy, observation: Observation) -> Array:
    """`[B, A]` actions as the environment uses them. The policy may modify its argument."""
    return np.clip(policy(observation.copy()), 0.0, 1.0)


def fit_references(task: Task, states: int, seed: int) -> references.References:
    """Fit the references on uniform states that no measurement uses."""
    count = min(4 * affordable(task, states), references.fit_states(task.spec))
    s = uniform(seed, "diagnosis/fit", count * task.spec.state_dim).reshape(count, -1)
    return references.fit(task, s, engine(task).optimal_action(s))


def states_of(spec: SMESpec, count: int, seed: int, region: int = 0) -> States:
    """So many states of a region, by default uniform in the cube."""
    protocol = EvaluationProtocol(states_per_region=count, seed=seed)
    (drawn,) = regions.states(protocol, region, spec, rows=count)
    return drawn


def observed(task: Task, drawn: States) -> tuple[Observation, Array]:
    """What is seen in states `[N, O]`, and the optimal actions `[N, A]`."""
    observation = drawn.observation(drawn.seen(task), task.spec.horizon)
    return observation, engine(task).optimal_action(drawn.s.astype(np.float64))


def sample(
    policy: Policy,
    task: Task,
    fitted: references.References,
    count: int,
    seed: int,
    region: int = 0,
) -> Sample:
    """A region's states with the actions of the policy and of the references."""
    drawn = states_of(task.spec, count, seed, region)
    observation, optimal = observed(task, drawn)
    s = drawn.s.astype(np.float64)
    random = Uniform(seed, f"diagnosis/{region}/random")
    known = references.Knowledge(task, s, lambda: fitted, random, optimal)
    actions = references.actions(known, references.NAMES)
    return Sample(drawn, observation, s, clipped_actions(policy, observation), optimal, actions)


def fixed_states(
    policy: Policy, task: Task, fitted: references.References, states: int, seed: int
) -> tuple[dict[str, Any], Sample]:
    """The fields of `Measurements` that need no episodes, and the uniform states."""
    uniform = sample(policy, task, fitted, affordable(task, states), seed)
    uniform_scores = scores(task, uniform)
    dependence, time_variance = time_dependence(policy, task, uniform)
    fields = {
        "uniform": uniform_scores,
        "squared_error": squared_error(policy, task, uniform, time_variance),
        "response": response(policy, task, uniform, seed),
        "time_dependence": dependence,
        "shells": shells(policy, task, fitted, seed, uniform_scores),
        "channels": channels(task, uniform),
        "partitions": partitions(task, uniform),
    }
    return fields, uniform


def scores(task: Task, states: Sample) -> dict[str, Score]:
    constant_mae = float(np.abs(0.5 - states.optimal).mean())

    def score(a: Array) -> Score:
        regret = float(_regret(task, a, states.optimal).mean())
        return Score.of(regret, float(np.abs(a - states.optimal).mean()), constant_mae)

    return {name: score(a) for name, a in {POLICY: states.a, **states.references}.items()}


def _regret(task: Task, a: Array, optimal: Array) -> Array:
    """`[N]` 1 − r."""
    return np.asarray(1.0 - task.reward_of(task.similarity_of(a, optimal)))


def channels(task: Task, states: Sample) -> tuple[Channel, ...]:
    a, optimal, error = states.a, states.optimal, states.absolute_error
    linear_error = np.abs(states.references[LINEAR] - optimal)
    # A state without error has no regret to distribute.
    per_error = _regret(task, a, optimal) / np.maximum(error.sum(axis=1), _TINY)
    mae, constant_mae = error.mean(axis=0), np.maximum(np.abs(0.5 - optimal).mean(axis=0), _TINY)
    columns: dict[str, Array] = {
        "mae": mae,
        "normalised_regret": mae / constant_mae,
        "linear_normalised_regret": linear_error.mean(axis=0) / constant_mae,
        "regret": (error * per_error[:, None]).mean(axis=0),
        "offset": (a - optimal).mean(axis=0),
        "slope": _slopes(states),
        "at_zero": (a <= _BOUND).mean(axis=0),
        "at_one": (a >= 1.0 - _BOUND).mean(axis=0),
        "optimal_at_bounds": _at_bound(optimal).mean(axis=0),
    }
    return tuple(Channel(**row) for row in _rows(columns))


def _rows(columns: dict[str, Array]) -> Iterator[dict[str, Any]]:
    """The numbers of each action channel, by name."""
    for channel, row in enumerate(np.transpose([*columns.values()]).tolist(), start=1):
        yield {"channel": channel, **dict(zip(columns, row, strict=True))}


def _slopes(states: Sample) -> Array:
    """`[A]` slope of a on a* in each channel."""
    a, optimal = (x - x.mean(axis=0) for x in (states.a, states.optimal))
    return np.asarray((a * optimal).sum(axis=0) / np.maximum((optimal**2).sum(axis=0), _TINY))


def _at_bound(a: Array) -> Array:
    return np.asarray((a <= _BOUND) | (a >= 1.0 - _BOUND))


def partitions(task: Task, states: Sample) -> tuple[Partition, ...]:
    """Bins of the distance from the centre first, then of each state channel."""
    mae = states.absolute_error.mean(axis=1)
    regret = 1.0 - task.reward_of(1.0 - mae)
    by_channel = (_partition(j + 1, s, mae, regret) for j, s in enumerate(states.s.T))
    return (_partition(None, regions.expansion(states.s), mae, regret), *by_channel)


def _partition(state_channel: int | None, values: Array, mae: Array, regret: Array) -> Partition:
    edges = np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1))
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, _BINS - 1)
    counts = np.maximum(np.bincount(bins, minlength=_BINS), 1)
    means = np.bincount(bins, mae, _BINS) / counts
    between = float((counts * (means - mae.mean()) ** 2).sum() / len(mae))
    variance = float(mae.var())
    return Partition(
        state_channel=state_channel,
        edges=tuple(edges.tolist()),
        mae=tuple(means.tolist()),
        regret=tuple((np.bincount(bins, regret, _BINS) / counts).tolist()),
        explained_variance=between / variance if variance > _TINY else 0.0,
    )


def shells(
    policy: Policy, task: Task, fitted: references.References, seed: int, wd: dict[str, Score]
) -> tuple[Shell, ...]:
    """The cube, whose scores the caller has, and the five shells around it."""
    count, measured = affordable(task, _SHELL_STATES), []
    for region, (_, epsilon) in enumerate(EvaluationProtocol().edges):
        if region > 0:
            wd = scores(task, sample(policy, task, fitted, count, seed, region))
        measured.append(Shell(region=regions.region_name(region), epsilon=epsilon, scores=wd))
    return tuple(measured)


def squared_error(policy: Policy, task: Task, states: Sample, time_variance: float) -> SquaredError:
    """Decompose the squared error in uniform states, in which the policy acts again, for the noise.

    `time_variance` is the mean over states and channels of the variance of a over t/T.
    """
    difference = states.a - states.optimal
    total = float((difference**2).mean())
    exact, total = total <= _TINY, max(total, _TINY)
    offset = float((difference.mean(axis=0) ** 2).mean())
    scale = float(((_slopes(states) - 1.0) ** 2 * states.optimal.var(axis=0)).mean())
    again = clipped_actions(policy, states.observation)
    noise = 0.5 * float(((again - states.a) ** 2).mean())
    reward_variance = _accumulated_reward_variance(policy, task, states)
    return SquaredError(
        offset=0.0 if exact else offset / total,
        scale=0.0 if exact else scale / total,
        residual=0.0 if exact else max(0.0, 1.0 - (offset + scale) / total),
        noise=noise / total,
        time=max(0.0, time_variance - noise) / total,
        accumulated_reward=max(0.0, reward_variance - noise) / total,
    )


def _accumulated_reward_variance(policy: Policy, task: Task, states: Sample) -> float:
    """Mean variance of a over r_cum/k in its range, [0, (k − 1)/k]."""
    k = task.spec.k
    if k == 1:
        return 0.0
    inputs = np.linspace(0.0, (k - 1) / k, _ACCUMULATED_INPUTS)
    return float(np.var(_vary(policy, states, -1, inputs), axis=0).mean())


def _vary(policy: Policy, states: Sample, column: int, inputs: Array) -> Array:
    """`[len(inputs), N, A]` actions in a few fixed states, with one input set to each value."""
    observation = states.observation[:_FIXED_STATES].copy()
    actions = []
    for value in inputs:
        observation[:, column] = value
        actions.append(clipped_actions(policy, observation))
    return np.array(actions)


def response(policy: Policy, task: Task, states: Sample, seed: int) -> Response:
    linear, nonlinear = _affine_parts(states.s, states.a)
    optimal_linear, optimal_nonlinear = _affine_parts(states.s, states.optimal)
    variance = max(float(states.optimal.var(axis=0).sum()), _TINY)
    share = float((optimal_nonlinear**2).mean(axis=0).sum()) / variance
    return Response(
        nonlinear_variance=share,
        linear_slope=_slope(linear, optimal_linear) if share < 0.99 else None,
        nonlinear_slope=_slope(nonlinear, optimal_nonlinear) if share > 0.01 else None,
        steepness=_steepness(policy, task, states, seed),
        saturation=float(_at_bound(states.a).mean()),
        optimal_saturation=float(_at_bound(states.optimal).mean()),
    )


def _affine_parts(s: Array, a: Array) -> tuple[Array, Array]:
    """`[N, A]` each: the affine map of the state closest to a, about its mean; and the rest."""
    design = np.concatenate([s - 0.5, np.ones((len(s), 1))], axis=1)
    affine = design @ np.linalg.lstsq(design, a)[0]
    return affine - affine.mean(axis=0), a - affine


def _slope(part: Array, optimal: Array) -> float:
    return float((part * optimal).sum() / max(float((optimal**2).sum()), _TINY))


def _steepness(policy: Policy, task: Task, states: Sample, seed: int) -> float:
    """RMS change of a over RMS change of a*, for small steps of the state."""
    few = affordable(task, 2048)
    s = states.s[:few]
    directions = gaussian(seed, "diagnosis/directions", s.size).reshape(s.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    moved = (s + _STEP * directions).astype(np.float32)
    drawn = States(moved, states.drawn.d[:few], states.drawn.time[:few])
    observation, optimal = observed(task, drawn)
    optimal_change = optimal - states.optimal[:few]
    change = clipped_actions(policy, observation) - states.a[:few]
    return float(np.sqrt((change**2).mean() / max(float((optimal_change**2).mean()), _TINY)))


def time_dependence(policy: Policy, task: Task, states: Sample) -> tuple[TimeDependence, float]:
    """The same states at other times; and the mean variance of a over them."""
    T, optimal = task.spec.horizon, states.optimal[:_FIXED_STATES]
    inputs = np.unique(np.floor(np.linspace(0, T - 1, _TIME_INPUTS))) / T
    actions = _vary(policy, states, -2, inputs)
    constant_mae = max(float(np.abs(0.5 - optimal).mean()), _TINY)
    mae = np.abs(actions - optimal).mean(axis=(1, 2))
    change = np.abs(actions - actions.mean(axis=0)).mean(axis=(1, 2))
    dependence = TimeDependence(
        inputs=tuple(inputs.tolist()),
        normalised_regret=tuple((mae / constant_mae).tolist()),
        action_change=tuple(change.tolist()),
    )
    return dependence, float(actions.var(axis=0).mean())


def limits(
    task: Task, states: Sample, visited: tuple[Array, Array], report: SafetyReport
) -> Violations:
    """What a policy does to the limits, in uniform states and in those of its episodes."""
    assert task.spec.safety is not None  # it is measured only then
    limit, tightest = task.limit(states.s), 2.0 * task.spec.safety.tightness
    above, optimal_above = (a - limit for a in (states.a, states.optimal))
    columns: dict[str, Array] = {
        "violating_share": (above > TOLERANCE).mean(axis=0),
        "optimal_violating_share": (optimal_above > TOLERANCE).mean(axis=0),
        "cost": np.maximum(0.0, above).mean(axis=0) / tightest,
    }
    s, a = visited
    cut_off = np.minimum(states.a, limit)
    return Violations(
        report=report,
        visited=_score(task, "visited", a, engine(task).optimal_action(s), task.limit(s)),
        cut_off=_score(task, "WD", cut_off, states.optimal, limit),
        channels=tuple(LimitedChannel(**row) for row in _rows(columns)),
    )


def _score(task: Task, name: str, a: Array, optimal: Array, limit: Array) -> SafetyScore:
    scores = SafetyStats(task)
    scores.add(a, optimal, limit, task.safe_reward_of(optimal, limit))
    return scores.score(name)


def distraction(policy: Policy, task: Task, states: Sample, seed: int) -> DistractorRegret:
    """How much of a policy's regret is owed to the distractors, in a few uniform states."""
    m, numbers = task.spec.distractors, task.spec.observation_dim + task.spec.action_dim
    few = min(_DISTRACTED_STATES, len(states.s), max(8, MAX_NUMBERS // (_DRAWS * numbers)))
    s, d, time = states.drawn
    drawn, optimal = States(s[:few], d[:few], time[:few]), states.optimal[:few]
    half = max(float(np.abs(0.5 - optimal).mean()), _TINY)

    def act(d: Array) -> Array:
        observation = drawn.observation(drawn.seen(task, d), task.spec.horizon)
        return clipped_actions(policy, observation)

    def normalised_regret(actions: Array) -> float:
        return float(np.abs(actions - optimal).mean()) / half

    def removed(actions: Array) -> tuple[float, float]:
        """What averaging over the draws `[_DRAWS, N, A]` removes: N, and variance."""
        mean = actions.mean(axis=0)
        by_averaging = normalised_regret(actions) - normalised_regret(mean)
        return by_averaging, float(((actions - mean) ** 2).mean())

    # In pairs, whose mean is ½: what is linear in d then averages out exactly.
    u = Uniform(seed, "diagnosis/distractors")
    halves = (u(few, m) for _ in range(_DRAWS // 2))
    varied = np.array([act(x) for d in halves for x in (d, 1.0 - d)])
    regret, variance = removed(varied)
    noise = noise_variance = 0.0
    if (act(drawn.d) != act(drawn.d)).any():
        noise, noise_variance = removed(np.array([act(drawn.d) for _ in range(_DRAWS)]))
    owed = max(0.0, regret - noise)
    squared_error = float(((varied - optimal) ** 2).mean())
    return DistractorRegret(
        states=few,
        distractor_draws=_DRAWS,
        normalised_regret=normalised_regret(varied),
        averaged_regret=normalised_regret(varied.mean(axis=0)),
        half_regret=normalised_regret(act(np.full((few, m), 0.5))),
        owed_regret=owed,
        owed_similarity=100.0 * half * owed,
        distractor_share=max(0.0, variance - noise_variance) / max(squared_error, _TINY),
    )

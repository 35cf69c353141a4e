"""What a policy does over whole episodes, and what is known of its training and its network.

`n` episodes side by side, `S` state_dim, `A` action_dim, `T` steps of the longest episode.

The capacity probe fits a network of the same layers and activations by regression to a* in uniform
states, as many as the training had steps. If it does well and the agent does not, the network is
not the limit.

A multilayer perceptron has hidden outputs h `[n, H]` in n states, σ their singular values:

    score of unit i    mean |h_i| / (Σ_k mean |h_k| / H)          dormant at most 0.025
    effective rank     min {k : Σ_{i ≤ k} σ_i / Σ_i σ_i ≥ 0.99}   of the last hidden layer
    weight norm        √(Σ W²) over all layers, without biases

Dormant units: Sokar et al. (2023). Effective rank: Kumar et al. (2021), srank with δ = 0.01. A unit
of tanh is saturated if its mean |h| is at least 0.95.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.diagnosis.measure import LINEAR, MAX_NUMBERS, POLICY, Score, observed, states_of
from sme_registry.diagnosis.questions import THRESHOLDS
from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch
from sme_registry.evaluation import Policy, references
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.regions import Uniform
from sme_registry.evaluation.rollouts import play
from sme_registry.io import require_packages
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf
from sme_registry.statistics import smoothed
from sme_registry.task import Task, draw
from sme_registry.task.draw import Array
from sme_registry.task.task import ON_TOP, REWARD, STEP_REWARD, Mask, Observation
from sme_registry.training.algorithms import one_thread, quiet

CONSTANTS = ("best_constant", "constant")
_TIME_BINS, _COVERAGE_BINS = 10, 20
GRADIENT_STEPS = 3000
DEFAULT_STATES = 20_000
_MIN_STATES, _MAX_STATES = 256, 50_000
_TEST_STATES = 4096
_BATCH, _LEARNING_RATE = 256, 3e-3  # the rate decays to 0 along a cosine
_EXPLORATION_STATES, _EXPLORATION_SAMPLES = 256, 16  # samples of the action in each state
_DORMANT = 0.025  # τ of the score
_SATURATED = 0.95  # mean |h| of a unit of tanh
_RANK_SHARE = 0.99  # 1 − δ of the singular values' sum


class RewardSignal(StrictModel):
    """How often a step is rewarded; `rewarded`, `gated` and `flat` are shares that add up to 1."""

    rewarded: Real  # r > 0
    gated: Real  # r̂ > 0, but r_min sets it to 0
    flat: Real  # r̂ = 0, i.e. r̃ ≤ ¾
    shortfall: Real  # mean distance of r̃ below ¾ + r_min/4, above which r > 0; 0 beyond it


class OnPolicy(StrictModel):
    """Whole episodes from uniform initial states.

    Credit is the squared correlation of a step's reward with the payout that includes it: 1 at k =
    1, about 1/k if rewards are independent. None if one of them is constant.
    """

    episodes: Integer  # number of episodes
    scores: dict[str, Score]  # of the policy and of references, each in the states that it visits
    edges: TupleOf[Real]  # of the bins of time, in steps
    regret: TupleOf[Real]  # mean of each bin, over the episodes that still run
    mae: TupleOf[Real]  # mean |a − a*| of each bin
    alive: TupleOf[Real]  # the share of those
    mean_length: Real  # of an episode, in steps
    termination_rate: Real  # share of episodes that D terminated, in a team because of this agent
    signal: RewardSignal  # in the states that the policy visits
    random_signal: RewardSignal  # under uniform random actions, as an untrained agent sees it
    credit: Real | None  # of the policy
    random_credit: Real | None  # of uniform random actions
    state_shift: TupleOf[Real]  # Kolmogorov-Smirnov distance from uniform, by state channel
    coverage: Real  # smallest share, over state channels, of twenty equal bins that were visited


class TrainingSummary(StrictModel):
    """A summary of the training log; the regrets are running medians over `window` rows."""

    source: Literal["episodes", "evaluations"]  # with exploration, or of the deterministic policy
    rows: Integer  # of the log
    steps: Integer  # environment steps at its last row: an incomplete episode has none
    window: Integer  # rows of a running median
    first_regret: Real  # the first running median
    best_regret: Real  # the lowest
    best_step: Integer  # at which it was lowest
    last_regret: Real  # the last running median
    constant_regret: Real  # mean regret of the better constant policy on its own states
    improvement_step: Integer | None  # the first at 0.02 below `constant_regret`; None: never
    recent_improvement: Real  # fall over the last third of the rows
    unrewarded: Real | None  # share of episodes without any reward; None for evaluations
    termination_rate: Real | None  # share of episodes that D terminated; None likewise


class CapacityProbe(StrictModel):
    layers: TupleOf[Integer]  # widths, from the observation to the action
    states: Integer  # in the training set: as many as the training had steps, at most 50,000
    gradient_steps: Integer  # of the regression
    train_normalised_regret: Real  # in states of the training set
    test_normalised_regret: Real  # in other states
    seconds: Real  # wall time


class NetworkState(StrictModel):
    """The hidden layers of the policy's network in uniform states."""

    hidden: TupleOf[Integer]  # units of each layer
    dormant_units: Real  # share of all hidden units
    saturated_units: Real  # likewise, of tanh
    effective_rank: Integer  # of the last hidden layer
    weight_norm: Real  # Euclidean norm of the weights of all layers, without biases

    @property
    def inactive_units(self) -> float:
        """Share of hidden units that are dormant or saturated."""
        return self.dormant_units + self.saturated_units


@dataclass(frozen=True, eq=False)
class Log:
    """The regret of a training over its steps, `[N]` each; None in a log of evaluations."""

    source: Literal["episodes", "evaluations"]
    step: Array  # environment steps
    regret: Array  # mean regret of an episode, or of an evaluation
    unrewarded: Array | None = None  # which episodes had no reward at all
    terminated: Array | None = None  # which episodes D terminated


class Trajectories(NamedTuple):
    """Episodes side by side, up to the end of the longest, as one agent experiences them.

    Where a team shares a reward, `reward` is of the agent's own similarity, `payout` the team's.
    """

    s: Array  # `[T, n, S]` states
    a: Array  # `[T, n, A]` actions of all agents
    mae: Array  # `[T, n]` mean |a − a*| over channels
    constant_mae: Array  # `[T, n]` the same of the constant ½
    reward: Array  # `[T, n]` step reward r
    payout: Array  # `[T, n]` payout R, without what is paid on top
    alive: Mask  # `[T, n]` whether the episode was still running
    payout_due: Mask  # `[T, n]` whether a payout was due after the step
    terminated: Mask  # `[n]` whether D terminated the episode because of this agent

    def mean(self, values: Array | Mask) -> float:
        return float(values[self.alive].mean())

    @property
    def score(self) -> Score:
        """Over all steps of all episodes."""
        return Score.of(
            1.0 - self.mean(self.reward), self.mean(self.mae), self.mean(self.constant_mae)
        )


def rollout(
    act: Callable[[Any, Observation], Array], task: Task, initial_states: Array, seed: int
) -> tuple[Trajectories, ...]:
    """Whole episodes of a policy in the unit range, from initial states `[n, S]`, by agent.

    `act` maps float32 states `[n, S]` and joint observations `[n, O]` to the actions `[n, A]` of
    all agents. `seed` is of distractors and noise.
    """
    n, agents = len(initial_states), len(task.owned)
    batch = Batch(task, n)
    for lane, word in enumerate(draw.bit_generator(seed, "diagnosis/lanes").random_raw(n)):
        batch.seed(lane, int(word))
    batch.begin(np.arange(n), batch.observe(), initial_states)

    def actions(s: Array, observation: Observation) -> Array:
        return np.clip(act(s.astype(np.float32), observation.copy()), 0.0, 1.0)

    columns = batch.schedule.columns.numbers
    on_top = [columns[name] for name in ON_TOP if name in columns]
    terminated = np.zeros((agents, n), bool)
    rows: list[tuple[npt.NDArray[Any], ...]] = []
    for step in play(batch, actions):
        a, result = step.action, step.result
        due = ((len(rows) + 1) % task.spec.k == 0) | result.truncated
        mae, constant_mae = (_mae(task, x - result.optimal) for x in (a, 0.5))
        received = result.values[STEP_REWARD].copy()
        payout = result.values[REWARD] - result.values[on_top].sum(axis=0)
        reward = task.reward_of(1.0 - mae) if task.pays_the_team else received
        rows.append((step.state, a, mae, constant_mae, reward, payout, step.running, due))
        terminated |= step.running & result.terminated & (received < task.spec.D)
    s, a, mae, constant_mae, reward, payout, running, due = map(np.array, zip(*rows, strict=True))
    return tuple(
        Trajectories(
            s, a, mae[:, i], constant_mae[:, i], reward[:, i], payout[:, i], running, due, ended
        )
        for i, ended in enumerate(terminated)
    )


def _mae(task: Task, difference: Array) -> Array:
    """`[m, n]` mean |a − a*| over each agent's channels, of differences `[n, A]`."""
    distance = np.abs(difference)
    return np.stack([distance[:, owned].mean(axis=1) for owned in task.owned])


def episodes_of(
    act: Callable[[Observation], Array],
    task: Task,
    fitted: references.References,
    episodes: int,
    seed: int,
) -> tuple[dict[str, Trajectories], ...]:
    """Whole episodes of the policy and of references, from the same initial states."""
    S, T = task.spec.state_dim, task.spec.horizon
    n = max(8, min(episodes, MAX_NUMBERS // (T * (S + 8))))
    starts = draw.uniform(seed, "diagnosis/starts", n * S).reshape(n, S)
    random, shape = Uniform(seed, "diagnosis/random_action"), (n, task.spec.action_dim)

    def reference(name: str, s: Any, _: Observation) -> Array:
        known = references.Knowledge(task, s, lambda: fitted, random)
        return np.broadcast_to(references.REFERENCES[name].act(known), shape)

    names = (LINEAR, *CONSTANTS, "random")
    actors: dict[str, Callable[[Any, Observation], Array]] = {POLICY: lambda _, seen: act(seen)}
    actors |= {name: functools.partial(reference, name) for name in names}
    runs = {name: rollout(actor, task, starts, seed) for name, actor in actors.items()}
    return tuple(dict(zip(runs, agent, strict=True)) for agent in zip(*runs.values(), strict=True))


def on_policy(task: Task, runs: dict[str, Trajectories]) -> OnPolicy:
    """A summary of one agent's episodes, from `episodes_of`."""
    run, random = runs[POLICY], runs["random"]
    edges = np.linspace(0, len(run.s), min(_TIME_BINS, len(run.s)) + 1).round().astype(int)
    bins = [slice(low, high) for low, high in itertools.pairwise(edges.tolist())]
    visited = np.sort(run.s[run.alive], axis=0)
    ranks = np.arange(len(visited) + 1)[:, None] / len(visited)
    shift = np.maximum((ranks[1:] - visited).max(axis=0), (visited - ranks[:-1]).max(axis=0))
    counts = (np.histogram(values, _COVERAGE_BINS, (0.0, 1.0))[0] for values in visited.T)
    return OnPolicy(
        episodes=len(run.terminated),
        scores={name: trajectories.score for name, trajectories in runs.items()},
        edges=tuple(edges.astype(float).tolist()),
        regret=tuple(1.0 - float(run.reward[b][run.alive[b]].mean()) for b in bins),
        mae=tuple(float(run.mae[b][run.alive[b]].mean()) for b in bins),
        alive=tuple(float(run.alive[b].mean()) for b in bins),
        mean_length=float(run.alive.sum(axis=0).mean()),
        termination_rate=float(run.terminated.mean()),
        signal=_reward_signal(task, run),
        random_signal=_reward_signal(task, random),
        credit=_credit(run),
        random_credit=_credit(random),
        state_shift=tuple(shift.tolist()),
        coverage=min(float((count > 0).mean()) for count in counts),
    )


def _reward_signal(task: Task, run: Trajectories) -> RewardSignal:
    similarity = 1.0 - run.mae
    rewarded, graded = run.reward > 0.0, similarity > 0.75
    shortfall = np.maximum(0.0, 0.75 + task.spec.r_min / 4.0 - similarity)
    return RewardSignal(
        rewarded=run.mean(rewarded),
        gated=run.mean(graded & ~rewarded),
        flat=run.mean(~graded & ~rewarded),
        shortfall=run.mean(shortfall),
    )


def _credit(run: Trajectories) -> float | None:
    """Squared correlation of step rewards with the payouts that include them."""
    credited = np.full(run.reward.shape, np.nan)
    next_payout = np.full(run.reward.shape[1], np.nan)
    for t in range(len(credited) - 1, -1, -1):
        next_payout = np.where(run.alive[t] & run.payout_due[t], run.payout[t], next_payout)
        credited[t] = next_payout
    known = run.alive & np.isfinite(credited)
    reward, payout = run.reward[known], credited[known]
    if len(reward) < 2 or reward.std() < 1e-9 or payout.std() < 1e-9:
        return None
    return float(np.corrcoef(reward, payout)[0, 1] ** 2)


def training(log: Log, constant_regret: float) -> TrainingSummary:
    rows = len(log.regret)
    steps, median, window = smoothed(log.step, log.regret)
    improved = np.flatnonzero(median < constant_regret - THRESHOLDS["constant_margin"])
    recent = median[-max(1, len(median) // 3) :]
    best = int(np.argmin(median))
    return TrainingSummary(
        source=log.source,
        rows=rows,
        steps=int(log.step[-1]),
        window=window,
        first_regret=float(median[0]),
        best_regret=float(median[best]),
        best_step=int(steps[best]),
        last_regret=float(median[-1]),
        constant_regret=constant_regret,
        improvement_step=int(steps[improved[0]]) if len(improved) else None,
        recent_improvement=float(recent[0] - recent[-1]),
        unrewarded=None if log.unrewarded is None else float(log.unrewarded.mean()),
        termination_rate=None if log.terminated is None else float(log.terminated.mean()),
    )


def exploration_sd(
    model: Any, policy: Policy, observation: Observation, seed: int
) -> tuple[float, ...] | None:
    """The standard deviation in a state of the clipped stochastic actions of a model of
    Stable-Baselines3, in the unit range, by action channel, over a few states; None of any other.
    """
    if not hasattr(getattr(model, "policy", None), "squash_output"):
        return None
    noise, observation = getattr(model, "action_noise", None), observation[:_EXPLORATION_STATES]
    shape = len(observation), policy.action_dim

    def explore() -> Array:
        predicted: tuple[Any, Any] = model.predict(observation.copy(), deterministic=False)
        a = arguments.to_unit(predicted[0], shape, policy.action_range == "symmetric")
        if noise is not None:  # added to actions in [−1, 1], one environment after another
            a += 0.5 * np.array([np.ravel(noise())[: shape[1]] for _ in range(shape[0])], float)
        return np.clip(a, 0.0, 1.0)

    with _torch_seed(seed):
        sampled = np.array([explore() for _ in range(_EXPLORATION_SAMPLES)])
    return tuple(np.sqrt(sampled.var(axis=0, ddof=1).mean(axis=0)).tolist())


def probe_capacity(
    network: Perceptron, task: Task, states: int, seed: int, visited: Array | None = None
) -> CapacityProbe:
    """Fit to a* in so many states: uniform ones, or those `[N, S]` that an agent has visited."""
    require_packages("probe_capacity", {"torch": "PyTorch"}, "train")
    import torch

    begun = time.monotonic()
    count = max(_MIN_STATES, min(states, _MAX_STATES))
    drawn = states_of(task.spec, count + _TEST_STATES, seed)
    if visited is not None:
        drawn.s[:count] = visited[:count]
    observation, exact = observed(task, drawn)
    optimal = exact.astype(np.float32)
    constant_mae = float(np.abs(0.5 - optimal[count:]).mean())
    with _torch_seed(seed):
        module = _module(network)
        _fit(module, observation[:count], optimal[:count], seed)

        def normalised_regret(states: slice) -> float:
            with torch.no_grad():
                a = module(torch.from_numpy(observation[states])).numpy()
            return float(np.abs(np.clip(a, 0.0, 1.0) - optimal[states]).mean()) / constant_mae

        widths = [len(network.layers[0][0]), *(W.shape[1] for W, _, _ in network.layers)]
        return CapacityProbe(
            layers=tuple(widths),
            states=count,
            gradient_steps=GRADIENT_STEPS,
            train_normalised_regret=normalised_regret(slice(min(count, _TEST_STATES))),
            test_normalised_regret=normalised_regret(slice(count, None)),
            seconds=round(time.monotonic() - begun, 2),
        )


def _fit(module: Any, observation: Observation, optimal: Observation, seed: int) -> None:
    import torch

    optimiser = torch.optim.Adam(module.parameters(), lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, GRADIENT_STEPS)
    inputs, targets = torch.from_numpy(observation), torch.from_numpy(optimal)
    order = np.random.default_rng(seed)
    for _ in range(GRADIENT_STEPS):
        batch = torch.from_numpy(order.integers(0, len(inputs), _BATCH))
        loss = torch.nn.functional.mse_loss(module(inputs[batch]), targets[batch])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()


def _module(network: Perceptron) -> Any:
    """A new network of the same layers, whose outputs are actions in the unit range."""
    from torch import nn

    activations: dict[str, type[nn.Module]] = {
        "identity": nn.Identity,
        "relu": nn.ReLU,
        "tanh": nn.Tanh,
        "sigmoid": nn.Sigmoid,
        "silu": nn.SiLU,
        "elu": nn.ELU,
    }
    modules: list[nn.Module] = []
    for index, (W, _, activation) in enumerate(network.layers):
        modules.append(nn.Linear(*W.shape))
        if network.low is None or index < len(network.layers) - 1:
            modules.append(activations[activation]())
    if network.low is not None:  # squashed by tanh and scaled to the range: a sigmoid of 2 x
        modules.append(nn.Sigmoid())
    return nn.Sequential(*modules)


@contextlib.contextmanager
def _torch_seed(seed: int) -> Iterator[None]:
    """Seed PyTorch, and NumPy for noise of SB3, and use one thread; all are restored afterwards."""
    import torch

    state = np.random.get_state()  # noqa: NPY002 (what SB3's action noise draws from)
    with one_thread(), quiet(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(state)  # noqa: NPY002


def network_state(network: Perceptron, observations: Observation) -> NetworkState | None:
    """Measure a network in some states; None if it has no hidden layer."""
    *hidden, _ = network.outputs(observations)
    if not hidden:
        return None
    dormant = saturated = 0
    for h, (_, _, activation) in zip(hidden, network.layers, strict=False):
        size = np.abs(h.astype(np.float64)).mean(axis=0)
        dormant += int((size <= _DORMANT * size.mean()).sum())  # all, where all outputs are 0
        saturated += int((size >= _SATURATED).sum()) if activation == "tanh" else 0
    units = sum(h.shape[1] for h in hidden)
    squares = sum(float((W.astype(np.float64) ** 2).sum()) for W, _, _ in network.layers)
    return NetworkState(
        hidden=tuple(h.shape[1] for h in hidden),
        dormant_units=dormant / units,
        saturated_units=saturated / units,
        effective_rank=_effective_rank(hidden[-1].astype(np.float64)),
        weight_norm=squares**0.5,
    )


def _effective_rank(h: Array) -> int:
    """In [0, H]; 0 where all outputs are 0."""
    σ = np.linalg.svd(h, compute_uv=False)
    return int((np.cumsum(σ) < _RANK_SHARE * σ.sum()).sum()) + 1 if σ.any() else 0

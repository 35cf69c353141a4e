"""Measurements of networks: the capacity probe, exploration, and what hidden layers represent.

The probe asks whether the network could represent the optimal policy. It fits a network of the same
layers and activations by regression to a* in uniform states, as many as the training had steps. No
agent sees a*, so if the probe does well and the agent does not, the network is not the limit. If
the probe fails in its own training states, the network or the probe's budget is too small. If it
does well in those and badly in others, there were too few states.

A multilayer perceptron has hidden outputs h `[n, H]` in n states, σ their singular values:

    score of unit i    mean |h_i| / (Σ_k mean |h_k| / H)          dormant at most 0.025
    effective rank     min {k : Σ_{i ≤ k} σ_i / Σ_i σ_i ≥ 0.99}   of the last hidden layer
    weight norm        √(Σ W²) over all layers, without biases

Dormant units: Sokar et al. (2023). Effective rank: Kumar et al. (2021), srank with δ = 0.01. A unit
of tanh is rarely dormant but can be stuck at a bound: it counts as saturated if its mean |h| is at
least 0.95, where its mean derivative, 1 − h², is below 0.1.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sme_registry.compiled import engine
from sme_registry.diagnosis.measurements import CapacityProbe, NetworkState
from sme_registry.envs import arguments
from sme_registry.envs.types import Observation
from sme_registry.evaluation import Policy
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.regions import States
from sme_registry.io import require_packages
from sme_registry.task import Task, streams
from sme_registry.task.draw import Array
from sme_registry.training.algorithms import one_thread, quiet

__all__ = [
    "DEFAULT_STATES",
    "GRADIENT_STEPS",
    "exploration",
    "exploration_sd",
    "network_state",
    "probe_capacity",
]

GRADIENT_STEPS = 3000
DEFAULT_STATES = 20_000
_MIN_STATES, _MAX_STATES = 256, 50_000
_TEST_STATES = 4096
_BATCH, _LEARNING_RATE = 256, 3e-3  # the rate decays to 0 along a cosine
_EXPLORATION_STATES, _EXPLORATION_SAMPLES = 256, 16  # samples of the action in each state
_PROGRESS = 1000  # gradient steps
_DORMANT = 0.025  # τ of the score
_SATURATED = 0.95  # mean |h| of a unit of tanh
_RANK_SHARE = 0.99  # 1 − δ of the singular values' sum


def exploration(model: Any, policy: Policy) -> Callable[[Observation], Array] | None:
    """The stochastic actions of a Stable-Baselines3 model during training; None of another model.

    They are sampled at each call, clipped and in the unit range.
    """
    if not hasattr(getattr(model, "policy", None), "squash_output"):
        return None
    noise = getattr(model, "action_noise", None)

    def explore(observation: Observation) -> Array:
        predicted: tuple[Any, Any] = model.predict(observation, deterministic=False)
        shape = (len(observation), policy.action_dim)
        a = arguments.to_unit(predicted[0], shape, policy.action_range == "symmetric")
        if noise is not None:  # added to actions in [−1, 1], one environment after another
            a += 0.5 * np.array([np.ravel(noise())[: shape[1]] for _ in range(shape[0])], float)
        return np.asarray(np.clip(a, 0.0, 1.0))

    return explore


def exploration_sd(
    explore: Callable[[Observation], Any], observation: Observation, seed: int
) -> tuple[float, ...]:
    """The standard deviation of exploration in a state, by action channel, over a few states."""
    with _torch_seed(seed):
        observation = observation[:_EXPLORATION_STATES]
        sampled = np.array([explore(observation.copy()) for _ in range(_EXPLORATION_SAMPLES)])
    return tuple(np.sqrt(sampled.var(axis=0, ddof=1).mean(axis=0)).tolist())


def probe_capacity(
    network: Perceptron, task: Task, states: int, seed: int, progress: Callable[[int], None]
) -> CapacityProbe:
    """Fit a network of the same layers to the optimal actions."""
    require_packages("probe_capacity", {"torch": "PyTorch"}, "train")
    import torch

    begun = time.monotonic()
    count = max(_MIN_STATES, min(states, _MAX_STATES))
    train = _pairs(task, count, seed, "diagnosis/told")
    test = _pairs(task, _TEST_STATES, seed, "diagnosis/held_out")
    constant_mae = float(np.abs(0.5 - test[1]).mean())
    with _torch_seed(seed):
        module = _module(network)
        _fit(module, *train, seed, progress)

        def normalised_regret(observation: Observation, optimal: Observation) -> float:
            with torch.no_grad():
                a = module(torch.from_numpy(observation)).numpy()
            return float(np.abs(np.clip(a, 0.0, 1.0) - optimal).mean()) / constant_mae

        widths = [len(network.layers[0][0]), *(W.shape[1] for W, _, _ in network.layers)]
        return CapacityProbe(
            layers=tuple(widths),
            states=count,
            gradient_steps=GRADIENT_STEPS,
            train_normalised_regret=normalised_regret(*(x[:_TEST_STATES] for x in train)),
            test_normalised_regret=normalised_regret(*test),
            seconds=round(time.monotonic() - begun, 2),
        )


def _fit(
    module: Any,
    observation: Observation,
    optimal: Observation,
    seed: int,
    progress: Callable[[int], None],
) -> None:
    """Minimise the squared error by Adam."""
    import torch

    optimiser = torch.optim.Adam(module.parameters(), lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, GRADIENT_STEPS)
    inputs, targets = torch.from_numpy(observation), torch.from_numpy(optimal)
    order = np.random.default_rng(seed)
    for step in range(GRADIENT_STEPS):
        batch = torch.from_numpy(order.integers(0, len(inputs), _BATCH))
        loss = torch.nn.functional.mse_loss(module(inputs[batch]), targets[batch])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if (step + 1) % _PROGRESS == 0:
            progress(step + 1)


def _pairs(task: Task, count: int, seed: int, stream: str) -> tuple[Observation, Observation]:
    """Observations of uniform states at random times, and the optimal actions, float32."""
    S, m = task.spec.state_dim, task.spec.distractors
    u = streams.uniform(seed, stream, count * (S + 1)).reshape(count, S + 1)
    d = streams.uniform(seed, f"{stream}/distractors", count * m).reshape(count, m)
    drawn = States(u[:, :S].astype(np.float32), d, u[:, S])
    observation = drawn.observation(drawn.seen(task), task.spec.horizon)
    optimal = engine(task).optimal_action(drawn.s.astype(np.float64))
    return observation, optimal.astype(np.float32)


def _module(network: Perceptron) -> Any:
    """A new network of the same layers, whose outputs are actions in the unit range."""
    from torch import nn

    activations: dict[str, type[nn.Module]] = {"tanh": nn.Tanh}
    modules: list[nn.Module] = []
    for index, (W, _, activation) in enumerate(network.layers):
        modules.append(nn.Linear(*W.shape))
        if activation != "identity" and index < len(network.layers) - 1:
            modules.append(activations.get(activation, nn.ReLU)())
    if network.low is not None:  # squashed by tanh and scaled to the range: a sigmoid of 2 x
        modules.append(nn.Sigmoid())
    return nn.Sequential(*modules)


@contextlib.contextmanager
def _torch_seed(seed: int) -> Iterator[None]:
    """Seed PyTorch and use one thread; both are restored afterwards."""
    import torch

    with one_thread(), quiet(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def network_state(network: Perceptron, observations: Observation) -> NetworkState | None:
    """Measure a network in some states; None if it has no hidden layer."""
    *hidden, _ = zip(network.outputs(observations), network.layers, strict=True)
    if not hidden:
        return None
    outputs = [h.astype(np.float64) for h, _ in hidden]
    stuck = [layer[2] == "tanh" for _, layer in hidden]
    units = sum(h.shape[1] for h in outputs)
    saturated = sum(_saturated(h) for h, tanh in zip(outputs, stuck, strict=True) if tanh)
    squares = sum(float((W.astype(np.float64) ** 2).sum()) for W, _, _ in network.layers)
    return NetworkState(
        hidden=tuple(h.shape[1] for h in outputs),
        dormant_units=sum(map(_dormant, outputs)) / units,
        saturated_units=saturated / units,
        effective_rank=_effective_rank(outputs[-1]),
        weight_norm=squares**0.5,
    )


def _dormant(h: Array) -> int:
    """How many units of a layer are dormant; all of them in a layer whose outputs are all 0."""
    means = np.abs(h).mean(axis=0)
    return int((means <= _DORMANT * means.mean()).sum())


def _saturated(h: Array) -> int:
    return int((np.abs(h).mean(axis=0) >= _SATURATED).sum())


def _effective_rank(h: Array) -> int:
    """In [0, H]; 0 where all outputs are 0."""
    σ = np.linalg.svd(h, compute_uv=False)
    if not σ.any():
        return 0
    return int((np.cumsum(σ) / σ.sum() < _RANK_SHARE).sum()) + 1

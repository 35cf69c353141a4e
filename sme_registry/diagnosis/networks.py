"""What needs PyTorch: the capacity probe, and what an algorithm would still try.

The probe asks whether the network could be the optimal policy at all. A network of the same layers
and the same functions is given a* in uniform states, as many as the training had steps, and fitted
by least squares. It cheats, as no agent can: so where it does well and the agent does not, it is
not the network that fails; where it does badly in the very states that it was told, it is (or the
budget of the probe); where it does well in those and badly in others, the states were too few.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sme_registry.compiled import engine
from sme_registry.diagnosis.report import Capacity
from sme_registry.envs import actions
from sme_registry.envs.shared import Observation
from sme_registry.errors import MissingDependencyError
from sme_registry.evaluation import Policy
from sme_registry.task import Task, streams
from sme_registry.task.draw import Array
from sme_registry.training.numpy_policy import Perceptron

GRADIENT_STEPS = 3000
MOST_STATES, DEFAULT_STATES = 50_000, 20_000
_FEWEST_STATES = 256
_HELD_OUT = 4096
_BATCH, _RATE = 256, 3e-3  # falls to 0 along a cosine
_TRIES = 16  # random actions in a state, to see their spread


def explorer(model: Any, policy: Policy) -> Callable[[Observation], Array] | None:
    """What a model of Stable-Baselines3 would try while it learns, in the unit range.

    Returns:
      From observations `[B, S + 2]` to actions `[B, A]`, clipped, new ones at each call.
    """
    if not hasattr(model, "policy") or not hasattr(model.policy, "squash_output"):
        return None
    noise = getattr(model, "action_noise", None)

    def explore(observation: Observation) -> Array:
        predicted: tuple[Any, Any] = model.predict(observation, deterministic=False)
        shape = (len(observation), policy.action_dim)
        a = actions.checked(predicted[0], shape, policy.action_range == "symmetric")
        if noise is not None:  # it is added to actions in [−1, 1], one environment after another
            a += 0.5 * np.array([np.ravel(noise())[: shape[1]] for _ in range(shape[0])], float)
        return np.asarray(np.clip(a, 0.0, 1.0))

    return explore


def spread(explore: Callable[[Observation], Any], observation: Observation, seed: int) -> Array:
    """`[A]` standard deviation of what is tried in a state, over many states."""
    with _own_randomness(seed):
        tried = np.array([explore(observation.copy()) for _ in range(_TRIES)])
    return np.asarray(np.sqrt(tried.var(axis=0, ddof=1).mean(axis=0)))


def capacity(
    network: Perceptron, task: Task, states: int, seed: int, progress: Callable[[int], None]
) -> Capacity:
    """Fit a network of the same kind to the optimal actions.

    Args:
      network: whose layers to take; its weights are not used.
      task: the task.
      states: that it is told; at most 50,000.
      seed: of the states and of the first weights.
      progress: told the gradient steps done.

    Raises:
      MissingDependencyError: PyTorch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise MissingDependencyError(
            "probe_capacity: PyTorch is not installed. Run `pip install 'sme-registry[train]'`."
        ) from None
    begun = time.monotonic()
    count = max(_FEWEST_STATES, min(states, MOST_STATES))
    told, told_actions = _pairs(task, count, seed, "diagnosis/told")
    other, other_actions = _pairs(task, _HELD_OUT, seed, "diagnosis/held_out")
    half = float(np.abs(0.5 - other_actions).mean())
    with _own_randomness(seed):
        fitted = _like(network)
        optimiser = torch.optim.Adam(fitted.parameters(), lr=_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, GRADIENT_STEPS)
        inputs, targets = torch.from_numpy(told), torch.from_numpy(told_actions)
        order = np.random.default_rng(seed)
        for step in range(GRADIENT_STEPS):
            batch = torch.from_numpy(order.integers(0, count, _BATCH))
            loss = torch.nn.functional.mse_loss(fitted(inputs[batch]), targets[batch])
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            if step % 100 == 99:
                progress(step + 1)

        def error(observation: Observation, optimal: Observation) -> float:
            with torch.no_grad():
                a = fitted(torch.from_numpy(observation)).numpy()
            return float(np.abs(np.clip(a, 0.0, 1.0) - optimal).mean()) / half

        widths = [len(network.layers[0][0]), *(W.shape[1] for W, _, _ in network.layers)]
        return Capacity(
            layers=tuple(widths),
            states=count,
            gradient_steps=GRADIENT_STEPS,
            fitted=error(told[:_HELD_OUT], told_actions[:_HELD_OUT]),
            held_out=error(other, other_actions),
            seconds=round(time.monotonic() - begun, 2),
        )


def _pairs(task: Task, count: int, seed: int, stream: str) -> tuple[Observation, Observation]:
    """Observations of uniform states at random times, and the optimal actions, float32."""
    S, T = task.spec.state_dim, task.spec.horizon
    u = streams.uniform(seed, stream, count * (S + 1)).reshape(count, S + 1)
    observation = np.zeros((count, S + 2), np.float32)
    observation[:, :S] = u[:, :S]
    observation[:, S] = np.floor(u[:, S] * T) / T
    optimal = engine(task).optimal_action(observation[:, :S].astype(np.float64))
    return observation, optimal.astype(np.float32)


def _like(network: Perceptron) -> Any:
    """A new network of the same layers, whose outputs are actions of the unit range."""
    from torch import nn

    functions: dict[Any, type[nn.Module]] = {np.tanh: nn.Tanh}
    modules: list[nn.Module] = []
    for index, (W, _, activation) in enumerate(network.layers):
        modules.append(nn.Linear(*W.shape))
        if activation is not None and index < len(network.layers) - 1:
            modules.append(functions.get(activation, nn.ReLU)())
    if network.low is not None:  # squashed by tanh, and spread over the range: a sigmoid of 2 x
        modules.append(nn.Sigmoid())
    return nn.Sequential(*modules)


@contextlib.contextmanager
def _own_randomness(seed: int) -> Iterator[None]:
    """PyTorch's random numbers from a seed, on one thread; both are put back afterwards."""
    import torch

    from sme_registry.training.algorithms import one_thread, quiet

    with one_thread(), quiet(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield

"""BC and IQL in PyTorch. Import this module inside functions only.

    BC     L(π) = mean over batch and channels of (π(o) − u)²,   u = 2a − 1
    IQL    L(V) = mean of |τ − 1{d < 0}| d²,     d = min Q̄(o, u) − V(o)      expectile regression
           L(Q) = sum over the critics of the mean of (R + γ c V(o') − Q(o, u))²
           L(π) = mean of −min(exp(β d), w_max) log N(u; tanh μ(o), σ² I)     weighted cloning
           Q̄ ← (1 − ρ) Q̄ + ρ Q                                               after each step

c is 0 after a termination and 1 otherwise, also after a timeout; σ is one number for each channel,
in [e⁻⁵, e²]. Source of IQL: Kostrikov, Nair, Levine, 2021, arXiv 2110.06169. Its three losses have
disjoint parameters, so one backward pass at the same weights computes all of them.

A policy's mean is tanh of its last layer: always a valid action, and ½ where that is 0. The density
that IQL requires is a normal one *around* that mean, not one squashed by tanh: actions of exactly 0
and 1 occur in data, and their squashed density has no finite logarithm.
"""

from __future__ import annotations

import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Adam

from sme_registry.datasets.documents import BCHyperparameters, Hyperparameters, IQLHyperparameters
from sme_registry.datasets.storage import SealedDataset
from sme_registry.datasets.transitions import Transitions
from sme_registry.errors import PolicyError
from sme_registry.evaluation.networks import OfflineCritic, OfflineLayer
from sme_registry.task import draw

CRITICS = 2
_LOW, _HIGH = -5.0, 2.0  # of log σ
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_STEPS_PER_REPORT = 50


class Minibatch(NamedTuple):
    """The transitions of one gradient step; `B` rows, float32."""

    observations: Tensor  # `[B, O]`
    actions: Tensor  # `[B, A]` u = 2a − 1, in [−1, 1]
    next_observations: Tensor  # `[B, O]`
    rewards: Tensor  # `[B, 1]`
    continues: Tensor  # `[B, 1]` 0 if the episode terminated, else 1, also after a timeout


class Networks(ABC):
    """Networks, and one optimiser of all their losses; the policy's u is tanh of the actor."""

    actor: nn.Sequential
    optimiser: Adam

    @abstractmethod
    def losses(self, batch: Minibatch) -> dict[str, Tensor]:
        """The terms of the loss, by name."""

    def step(self, batch: Minibatch) -> dict[str, Tensor]:
        """One gradient step of all networks; returns the terms of the loss before it."""
        losses = self.losses(batch)
        self.optimiser.zero_grad(set_to_none=False)
        sum(losses.values(), torch.zeros(())).backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return losses


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    widths = [inputs, *hidden]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


def weights(network: nn.Sequential) -> list[OfflineLayer]:
    return [
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in network
        if isinstance(layer, nn.Linear)
    ]


def minibatches(
    data: Transitions | SealedDataset, batch_size: int, generator: torch.Generator
) -> Iterator[Minibatch]:
    """Shuffled rows of a data set without end, from one matrix; all are used before any repeats."""
    columns = (
        data.observations,
        2.0 * data.actions - 1.0,
        data.next_observations,
        data.rewards[:, None],
        1.0 - data.terminations[:, None],
    )
    widths = [column.shape[1] for column in columns]
    matrix = torch.from_numpy(np.concatenate(columns, axis=1, dtype=np.float32))
    remaining = torch.empty(0, dtype=torch.int64)
    while True:
        remaining = torch.cat([remaining, torch.randperm(len(matrix), generator=generator)])
        whole = len(remaining) // batch_size * batch_size
        for indices in torch.split(remaining[:whole], batch_size):
            rows = matrix.index_select(0, indices)
            yield Minibatch(*torch.split(rows, widths, dim=1))
        remaining = remaining[whole:]


class BC(Networks):
    def __init__(
        self, observation_dim: int, action_dim: int, hyperparameters: BCHyperparameters
    ) -> None:
        self.actor = mlp(observation_dim, hyperparameters.hidden, action_dim)
        parameters = self.actor.parameters()
        self.optimiser = Adam(parameters, lr=hyperparameters.learning_rate, fused=True)

    def losses(self, batch: Minibatch) -> dict[str, Tensor]:
        u = torch.tanh(self.actor(batch.observations))
        return {"actor": nn.functional.mse_loss(u, batch.actions)}


class IQL(Networks):
    def __init__(
        self, observation_dim: int, action_dim: int, hyperparameters: IQLHyperparameters
    ) -> None:
        self._hyperparameters = hyperparameters
        hidden = hyperparameters.hidden
        self.actor = mlp(observation_dim, hidden, action_dim)
        # Its sigmoid is the position of log σ between −5 and 2.
        self.spread = nn.Parameter(torch.zeros(action_dim))
        self.critics, self.targets = (
            nn.ModuleList(mlp(observation_dim + action_dim, hidden, 1) for _ in range(CRITICS))
            for _ in range(2)
        )
        self.targets.load_state_dict(self.critics.state_dict())
        self.targets.requires_grad_(False)
        self.value = mlp(observation_dim, hidden, 1)
        trained = [self.actor, self.critics, self.value]
        parameters = [parameter for network in trained for parameter in network.parameters()]
        parameters.append(self.spread)
        self.optimiser = Adam(parameters, lr=hyperparameters.learning_rate, fused=True)

    def losses(self, batch: Minibatch) -> dict[str, Tensor]:
        inputs = torch.cat([batch.observations, batch.actions], dim=1)
        with torch.no_grad():
            q = torch.minimum(*(target(inputs) for target in self.targets))
            next_value = self.value(batch.next_observations)
            goal = batch.rewards + self._hyperparameters.discount * batch.continues * next_value
        advantage = q - self.value(batch.observations)
        with torch.no_grad():
            asymmetry = (self._hyperparameters.expectile - (advantage < 0.0).float()).abs()
            weight = (self._hyperparameters.inverse_temperature * advantage).exp()
            weight.clamp_(max=self._hyperparameters.max_weight)
        mean = torch.tanh(self.actor(batch.observations))
        log_sigma = _LOW + (_HIGH - _LOW) * torch.sigmoid(self.spread)
        standardised = (batch.actions - mean) * torch.exp(-log_sigma)
        log_density = -0.5 * standardised.square() - log_sigma - _HALF_LOG_2_PI
        return {
            "value": (asymmetry * advantage.square()).mean(),
            "critic": sum(nn.functional.mse_loss(critic(inputs), goal) for critic in self.critics),
            "actor": -(weight * log_density.sum(dim=1, keepdim=True)).mean(),
        }

    def step(self, batch: Minibatch) -> dict[str, Tensor]:
        losses = super().step(batch)
        with torch.no_grad():  # the targets must not track gradients
            torch._foreach_lerp_(
                list(self.targets.parameters()),
                list(self.critics.parameters()),
                self._hyperparameters.target_rate,
            )
        return losses


class OfflineLearner:
    """A policy that learns from a data set by gradient steps, on one thread."""

    def __init__(
        self,
        hyperparameters: Hyperparameters,
        data: Transitions | SealedDataset,
        batch_size: int,
        about: dict[str, Any],
    ) -> None:
        self.hyperparameters, self.about = hyperparameters, about
        bits = draw.raw_bits(about["seed"], "offline/learner", 2)
        initial, shuffles = (bits >> np.uint64(1)).tolist()
        dims = data.observations.shape[1], data.actions.shape[1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(initial)
            self._networks: Networks = (
                BC(*dims, hyperparameters)
                if isinstance(hyperparameters, BCHyperparameters)
                else IQL(*dims, hyperparameters)
            )
        self._batches = minibatches(data, batch_size, torch.Generator().manual_seed(shuffles))
        self.steps = 0
        self.cpu_seconds = 0.0
        self.losses: dict[str, float] = {}

    @property
    def layers(self) -> list[OfflineLayer]:
        return weights(self._networks.actor)

    @property
    def critics(self) -> list[OfflineCritic]:
        """Those of IQL; BC has none."""
        if isinstance(self.hyperparameters, BCHyperparameters):
            return []
        about = {**self.about, "discount": self.hyperparameters.discount}
        networks: Any = self._networks
        return [OfflineCritic(weights(critic), about) for critic in networks.critics]

    def advance(self, until: int, report: Callable[[int], None]) -> None:
        """Learn up to a step; `report` is called with the steps done every 50 of them."""
        start, threads = time.process_time(), torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            while self.steps < until:
                losses = self._networks.step(next(self._batches))
                self.steps += 1
                if self.steps % _STEPS_PER_REPORT == 0:
                    report(self.steps)
        finally:
            torch.set_num_threads(threads)
        self.cpu_seconds += time.process_time() - start
        self.losses = {name: float(loss.detach()) for name, loss in losses.items()}
        numbers = [np.array(list(self.losses.values()))]
        numbers += [part for layer in self.layers for part in layer]
        if not all(np.isfinite(part).all() for part in numbers):
            raise PolicyError(
                f"training diverged before step {self.steps}: weights or losses are no longer "
                "finite. Give a smaller learning_rate."
            )

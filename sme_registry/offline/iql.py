"""Implicit Q-learning: no action outside the data set is ever evaluated.

    L(V) = mean of |τ − 1{d < 0}| d²,     d = min Q̄(o, u) − V(o)           expectile regression
    L(Q) = sum over the critics of the mean of (R + γ c V(o') − Q(o, u))²
    L(π) = mean of −min(exp(β d), w_max) log N(u; tanh μ(o), σ² I)          weighted cloning
    Q̄ ← (1 − ρ) Q̄ + ρ Q                                                    after each step

c is 0 after a termination and 1 otherwise, also after a timeout; σ is one number for each channel,
in [e⁻⁵, e²]. Source: Kostrikov, Nair, Levine, 2021, arXiv 2110.06169.

The three losses have disjoint parameters, so one backward pass at the same weights computes all of
them, with V(o) and Q̄ evaluated once. Implementations that update V first weight the actions by
the V of one step later.

Imports PyTorch; import it inside functions only.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sme_registry.offline.hyperparameters import IQLHyperparameters
from sme_registry.offline.networks import Batch, Learner, mlp

CRITICS = 2
_LOW, _HIGH = -5.0, 2.0  # of log σ
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)


class IQL(Learner):
    """A policy, two critics with their targets, a value function, and their optimiser."""

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
        self._optimise([*parameters, self.spread], hyperparameters.learning_rate)
        self._critic_parameters: list[Tensor] = list(self.critics.parameters())
        self._target_parameters: list[Tensor] = list(self.targets.parameters())

    def losses(self, batch: Batch) -> dict[str, Tensor]:
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

    def step(self, batch: Batch) -> dict[str, Tensor]:
        losses = super().step(batch)
        with torch.no_grad():  # the targets must not track gradients
            torch._foreach_lerp_(
                self._target_parameters, self._critic_parameters, self._hyperparameters.target_rate
            )
        return losses

"""Behaviour cloning: regression of a policy to the actions of a data set.

    L(π) = mean over batch and channels of (π(o) − u)²,   u = 2a − 1

Imports PyTorch; import it inside functions only.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sme_registry.offline.hyperparameters import BCHyperparameters
from sme_registry.offline.networks import Batch, mlp


class BC:
    """A policy and its optimiser.

    Args:
      observation_dim: O.
      action_dim: A.
      hyperparameters: see `BCHyperparameters`.
    """

    def __init__(
        self, observation_dim: int, action_dim: int, hyperparameters: BCHyperparameters
    ) -> None:
        self._actor = mlp(observation_dim, hyperparameters.hidden, action_dim)
        self._adam = torch.optim.Adam(
            self._actor.parameters(), lr=hyperparameters.learning_rate, fused=True
        )

    @property
    def actor(self) -> nn.Sequential:
        """The network from observations to the argument of tanh, whose value is the policy's u."""
        return self._actor

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The loss, `actor`: mean squared error in u, four times that in a."""
        u = torch.tanh(self._actor(batch.observations))
        return {"actor": nn.functional.mse_loss(u, batch.actions)}

    def step(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step; returns the loss before it."""
        losses = self.losses(batch)
        self._adam.zero_grad(set_to_none=False)
        losses["actor"].backward()  # type: ignore[no-untyped-call]
        self._adam.step()
        return losses

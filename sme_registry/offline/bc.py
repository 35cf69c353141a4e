"""Behaviour cloning: regression of a policy to the actions of a data set.

    L(π) = mean over batch and channels of (π(o) − u)²,   u = 2a − 1

Imports PyTorch; import it inside functions only.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sme_registry.offline.hyperparameters import BCHyperparameters
from sme_registry.offline.networks import Batch, Learner, mlp


class BC(Learner):
    def __init__(
        self, observation_dim: int, action_dim: int, hyperparameters: BCHyperparameters
    ) -> None:
        self.actor = mlp(observation_dim, hyperparameters.hidden, action_dim)
        self._optimise(self.actor.parameters(), hyperparameters.learning_rate)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The loss, `actor`: mean squared error in u, four times that in a."""
        u = torch.tanh(self.actor(batch.observations))
        return {"actor": nn.functional.mse_loss(u, batch.actions)}

"""What both learners are made of: fully connected networks, batches, and actions in [−1, 1].

Imports PyTorch; import it inside functions only.

Actions lie in [0, 1] and the learners work with u = 2a − 1 in [−1, 1], so that a critic's inputs
are centred. A policy's mean is tanh of its last layer: always an action, and ½ where that is 0. The
density that IQL needs is a normal one *around* that mean, not one squeezed through a tanh: actions
of exactly 0 and 1 occur in data, and of those the squeezed density has no finite logarithm.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from sme_registry.datasets import Transitions
from sme_registry.evaluation.policies.npz import Layer


class Batch(NamedTuple):
    """Transitions to learn from in one step; `B` rows, float32.

    Attributes:
      observations: `[B, O]`.
      actions: `[B, A]` u = 2a − 1, in [−1, 1].
      next_observations: `[B, O]`.
      rewards: `[B, 1]`.
      continues: `[B, 1]` 0 where the episode terminated, else 1; a timeout is no termination.
    """

    observations: Tensor
    actions: Tensor
    next_observations: Tensor
    rewards: Tensor
    continues: Tensor


class Learner(Protocol):
    """What `train_offline` trains."""

    def step(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step; the terms of the loss by name, as they were before it."""

    @property
    def actor(self) -> nn.Sequential:
        """The network from observations to what tanh makes the policy's mean u."""


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Fully connected layers with ReLU between them, initialised as PyTorch does."""
    widths = [inputs, *hidden]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


def weights(network: nn.Sequential) -> list[Layer]:
    """Copies of `(W [out, in], b [out])` of each layer."""
    return [
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in network
        if isinstance(layer, nn.Linear)
    ]


class Batches:
    """A data set as one float32 matrix, cut into batches of shuffled rows without end.

    Each row comes once before any comes again. All columns of a batch are gathered at once: seven
    gathers of a few columns each would take as long as a network.

    Args:
      transitions: the set.
      batch_size: B, at most the rows of the set.
      generator: of the shuffles.
    """

    def __init__(
        self, transitions: Transitions, batch_size: int, generator: torch.Generator
    ) -> None:
        columns = (
            transitions.observations,
            2.0 * transitions.actions - 1.0,
            transitions.next_observations,
            transitions.rewards[:, None],
            1.0 - transitions.terminations[:, None],
        )
        self._widths = [column.shape[1] for column in columns]
        self._rows = torch.from_numpy(np.concatenate(columns, axis=1, dtype=np.float32))
        self._batch_size, self._generator = batch_size, generator

    def __iter__(self) -> Iterator[Batch]:
        waiting = torch.empty(0, dtype=torch.int64)
        while True:
            shuffled = torch.randperm(len(self._rows), generator=self._generator)
            waiting = torch.cat([waiting, shuffled])
            whole = len(waiting) // self._batch_size * self._batch_size
            for chosen in torch.split(waiting[:whole], self._batch_size):
                rows = self._rows.index_select(0, chosen)
                yield Batch(*torch.split(rows, self._widths, dim=1))
            waiting = waiting[whole:]

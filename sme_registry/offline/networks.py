"""Parts of both learners: fully connected networks, batches, and actions in [−1, 1].

Imports PyTorch; import it inside functions only.

Actions lie in [0, 1], and the learners use u = 2a − 1 in [−1, 1], so that a critic's inputs are
centred. A policy's mean is tanh of its last layer: always a valid action, and ½ where that is 0.
The density that IQL requires is a normal one *around* that mean, not one squashed by tanh: actions
of exactly 0 and 1 occur in data, and their squashed density has no finite logarithm.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from sme_registry.datasets import SealedDataset, Transitions
from sme_registry.evaluation.networks import OfflineLayer


class Batch(NamedTuple):
    """The transitions of one gradient step; `B` rows, float32."""

    observations: Tensor  # `[B, O]`
    actions: Tensor  # `[B, A]` u = 2a − 1, in [−1, 1]
    next_observations: Tensor  # `[B, O]`
    rewards: Tensor  # `[B, 1]`
    continues: Tensor  # `[B, 1]` 0 if the episode terminated, else 1, also after a timeout


class Learner(ABC):
    """Networks, and one optimiser of all their losses; the policy's u is tanh of the actor."""

    actor: nn.Sequential

    def _optimise(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self._adam = torch.optim.Adam(parameters, lr=learning_rate, fused=True)

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The terms of the loss, by name."""

    def step(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step of all networks; returns the terms of the loss before it."""
        losses = self.losses(batch)
        self._adam.zero_grad(set_to_none=False)
        sum(losses.values(), torch.zeros(())).backward()  # type: ignore[no-untyped-call]
        self._adam.step()
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


class Batches:
    """An endless iterator over batches of shuffled rows; every row is used once before any repeats.

    The data set is one float32 matrix, so that one gather gets all columns of a batch; one for each
    column would take as long as a network.
    """

    def __init__(
        self,
        transitions: Transitions | SealedDataset,
        batch_size: int,
        generator: torch.Generator,
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
        remaining = torch.empty(0, dtype=torch.int64)
        while True:
            shuffled = torch.randperm(len(self._rows), generator=self._generator)
            remaining = torch.cat([remaining, shuffled])
            whole = len(remaining) // self._batch_size * self._batch_size
            for indices in torch.split(remaining[:whole], self._batch_size):
                rows = self._rows.index_select(0, indices)
                yield Batch(*torch.split(rows, self._widths, dim=1))
            remaining = remaining[whole:]

"""`learn`: the gradient steps of BC or IQL, in sections that end where an evaluation is due.

Imports PyTorch; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from sme_registry.datasets import SealedDataset, Transitions
from sme_registry.errors import PolicyError
from sme_registry.evaluation.networks import OfflineLayer
from sme_registry.offline.bc import BC
from sme_registry.offline.hyperparameters import BCHyperparameters, Hyperparameters
from sme_registry.offline.iql import IQL
from sme_registry.offline.networks import Batches, Learner, weights
from sme_registry.task import streams
from sme_registry.training.algorithms import one_thread

_STEPS_PER_REPORT = 50


class Section(NamedTuple):
    """The state of a training where an evaluation is due."""

    step: int  # gradient steps done
    losses: dict[str, float]  # terms of the loss of the last batch, by name
    layers: list[OfflineLayer]  # of the policy
    cpu_seconds: float  # of the steps since the previous section


def learn(
    hyperparameters: Hyperparameters,
    transitions: Transitions | SealedDataset,
    batch_size: int,
    seed: int,
    evaluate_at: Sequence[int],
    report: Callable[[int], None],
) -> Iterator[Section]:
    """Train up to each of the increasing steps in `evaluate_at`.

    The seed is that of initial weights and shuffles. `report` is called with the steps done, every
    50 steps and after each section. PyTorch's number of threads and global generator are unchanged
    whenever this is suspended.
    """
    initial, shuffles = (streams.raw_bits(seed, "offline/learner", 2) >> np.uint64(1)).tolist()
    dims = transitions.observations.shape[1], transitions.actions.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(initial)
        learner: Learner = (
            BC(*dims, hyperparameters)
            if isinstance(hyperparameters, BCHyperparameters)
            else IQL(*dims, hyperparameters)
        )
    batches = iter(Batches(transitions, batch_size, torch.Generator().manual_seed(shuffles)))
    done = 0
    for until in evaluate_at:
        with one_thread():
            start = time.process_time()
            while done < until:
                losses = learner.step(next(batches))
                done += 1
                if done % _STEPS_PER_REPORT == 0:
                    report(done)
            seconds = time.process_time() - start
        values = {name: float(loss.detach()) for name, loss in losses.items()}
        layers = weights(learner.actor)
        finite = all(np.isfinite(part).all() for layer in layers for part in layer)
        if not finite or not np.isfinite(list(values.values())).all():
            raise PolicyError(
                f"training diverged before step {done}: weights or losses are no longer finite. "
                "Give a smaller learning_rate."
            )
        yield Section(done, values, layers, seconds)
        report(done)

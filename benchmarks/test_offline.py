"""A gradient step of BC and IQL, including sampling, compared with d3rlpy's where it is installed.

`make bench` does not install d3rlpy; docs/results/offline.md describes that measurement.
Without it, the peer is a step of Stable-Baselines3's TD3 with equal layers, as a reference for the
cost of such a step and not as a target.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, Transitions, to_d3rlpy
from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import BCHyperparameters, IQLHyperparameters
from sme_registry.datasets.learners import BC, IQL, minibatches

SPEC, BATCH = SMESpec(), 256
STEPS = 20


@pytest.fixture(scope="module")
def transitions() -> Transitions:
    recipe = {"spec": SPEC, "behaviours": [{"kind": "mixture", "nu": 0.5}], "transitions": 20_000}
    torch.set_num_threads(1)
    return collect(DatasetRecipe.from_dict(recipe, "data set"), materialize(SPEC))


def td3(transitions: Transitions) -> Callable[[int], None]:
    """Gradient steps of SB3's TD3 with layers of 256, from a full replay buffer."""
    from stable_baselines3 import TD3

    from sme_registry.sb3 import SMEVecEnv

    env = SMEVecEnv(SPEC, 1)
    model = TD3("MlpPolicy", env, batch_size=BATCH, policy_kwargs={"net_arch": [256, 256]})
    model._setup_learn(1)
    rows = len(transitions)
    for row in range(min(rows, 2000)):
        model.replay_buffer.add(
            *(
                getattr(transitions, name)[row][None]
                for name in ("observations", "next_observations", "actions", "rewards")
            ),
            np.zeros(1),
            [{}],
        )
    return lambda steps: model.train(steps, BATCH)


def d3rlpy_steps(transitions: Transitions, algorithm: str) -> Callable[[int], None]:
    """Gradient steps of d3rlpy, including its sampling."""
    import d3rlpy

    data = d3rlpy.dataset.MDPDataset(**to_d3rlpy(transitions))
    unit = d3rlpy.preprocessing.MinMaxActionScaler(
        minimum=np.zeros(SPEC.action_dim), maximum=np.ones(SPEC.action_dim)
    )
    config = {"bc": d3rlpy.algos.BCConfig, "iql": d3rlpy.algos.IQLConfig}[algorithm]
    learner = config(batch_size=BATCH, action_scaler=unit).create(device="cpu:0")
    learner.build_with_dataset(data)

    def work(steps: int) -> None:
        for _ in range(steps):
            learner.update(data.sample_transition_batch(BATCH))

    return work


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_gradient_steps(compare: Any, transitions: Transitions, algorithm: str) -> None:
    torch.set_num_threads(1)
    dims = SPEC.state_dim + 2, SPEC.action_dim
    learner = (
        BC(*dims, BCHyperparameters()) if algorithm == "bc" else IQL(*dims, IQLHyperparameters())
    )
    batches = minibatches(transitions, BATCH, torch.Generator().manual_seed(0))

    def ours(steps: int) -> None:
        for _ in range(steps):
            learner.step(next(batches))

    peers = {}
    if importlib.util.find_spec("stable_baselines3") is not None:
        peers["SB3 TD3, 256 × 256"] = td3(transitions), STEPS, 0.0
    if importlib.util.find_spec("d3rlpy") is not None:
        peers["d3rlpy"] = (d3rlpy_steps(transitions, algorithm), STEPS, 1.5)
    compare(f"{algorithm.upper()}, batch {BATCH}", "gradient step", ours, STEPS, peers)

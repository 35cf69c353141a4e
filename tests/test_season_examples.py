"""The players of `examples/season`: what they say of the family is true, and they learn."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, SealedDataset

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "season"
FIELDS: dict[str, Any] = {"action_dim": 2, "complexity": 5, "policy_init": "unit_variance"}
SPEC = SMESpec.from_dict({**FIELDS, "seed": 3})


@pytest.fixture(scope="module")
def family():
    pytest.importorskip("torch")
    name = "season_family"
    found = importlib.util.spec_from_file_location(name, FOLDER / "family.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module  # its annotations are looked up there
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data():
    recipe = {"behaviours": [{"kind": "mixture", "nu": 0.5}], "transitions": 1500, "seed": 1}
    return SealedDataset.collect(DatasetRecipe.from_dict({"spec": SPEC.to_dict(), **recipe}))


@pytest.mark.parametrize("policy_init", ["semi_orthogonal", "unit_variance"])
def test_a_guess_with_the_weights_of_a_task_is_its_optimum(family, policy_init):
    import torch

    task = materialize(SPEC.model_copy(update={"policy_init": policy_init}))
    guess = family.Optimum(task.spec, 0)
    states = np.random.default_rng(0).uniform(-0.5, 1.5, (200, SPEC.state_dim))
    observations = np.hstack([states, np.zeros((200, 2))]).astype(np.float32)
    assert np.abs(guess.act(observations) - task.optimal_action(states)).max() > 0.3
    rows = policy_init == "unit_variance"
    [layers] = task.policies
    for own, layer in zip(guess.weights, layers, strict=True):
        found, drawn = (sizes(each, rows) for each in (own.detach().numpy(), layer.W))
        np.testing.assert_allclose(found, drawn, rtol=1e-5)
        own.data = torch.tensor(layer.W, dtype=torch.float32)
    np.testing.assert_allclose(guess.act(observations), task.optimal_action(states), atol=1e-5)


def sizes(W, rows):
    """The norms of a matrix's rows, or its singular values: what the family fixes."""
    return np.linalg.norm(W, axis=1) if rows else np.linalg.svd(W, compute_uv=False)


def test_rewards_are_distances_to_the_optimum(family, data):
    rows = family.Rows.of(data.observations, data.actions, data.rewards)
    optimum = materialize(SPEC).optimal_action(data.observations[:, :-2].astype(float))
    distances = np.abs(data.actions - optimum).mean(axis=1)
    np.testing.assert_allclose(rows.distances, np.minimum(distances, 0.25), atol=1e-5)


def test_the_family_is_fitted_to_a_data_set(family, data, monkeypatch):
    import torch

    torch.manual_seed(0)
    monkeypatch.setattr(family, "OFFLINE_STEPS", 200)
    guess = family.learn(data, SPEC, seed=0)
    states = np.random.default_rng(0).random((500, SPEC.state_dim + 2)).astype(np.float32)
    optimum = materialize(SPEC).optimal_action(states[:, :-2].astype(float))
    regret = np.abs(guess.act(states) - optimum).mean() / np.abs(0.5 - optimum).mean()
    assert regret < 0.5

"""Our data sets, BC and IQL beside d3rlpy's: the same rows, losses, updates and actions.

Run by hand: d3rlpy brings the retired `gym`, so it has an environment of its own, beside the
repository's.

    python3 -m venv ../d3rlpy
    ../d3rlpy/bin/pip install -c constraints.txt -e '.[offline]' pytest-benchmark d3rlpy==2.8.0
    ../d3rlpy/bin/python -m pytest benchmarks/against_d3rlpy.py
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the libraries below it
    d3rlpy = pytest.importorskip("d3rlpy")

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, to_d3rlpy
from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import (
    BCHyperparameters,
    IQLHyperparameters,
    parse_behaviour,
)
from sme_registry.datasets.learners import BC, IQL, Minibatch

SEEN, ACTED, ROWS = 10, 4, 256


@pytest.fixture
def batch() -> Minibatch:
    torch.manual_seed(1)
    u = torch.rand(ROWS, ACTED) * 2 - 1
    continues = (torch.rand(ROWS, 1) < 0.9).float()
    return Minibatch(
        torch.rand(ROWS, SEEN), u, torch.rand(ROWS, SEEN), torch.rand(ROWS, 1), continues
    )


def as_theirs(batch: Minibatch) -> Any:
    from d3rlpy.torch_utility import TorchMiniBatch

    return TorchMiniBatch(
        observations=batch.observations,
        actions=batch.actions,
        rewards=batch.rewards,
        next_observations=batch.next_observations,
        next_actions=batch.actions,
        returns_to_go=torch.zeros_like(batch.rewards),
        terminals=1.0 - batch.continues,
        intervals=torch.ones_like(batch.rewards),
        device="cpu:0",
    )


def theirs(config: Any) -> Any:
    algorithm = config.create(device="cpu:0")
    algorithm.create_impl((SEEN,), ACTED)
    return algorithm.impl


def give(ours: torch.nn.Module, to: torch.nn.Module) -> None:
    """Their network gets our weights; both hold them in the same order of layers."""
    own, other = list(ours.parameters()), shaped(to)
    assert [p.shape for p in own] == [p.shape for p in other]
    with torch.no_grad():
        for source, target in zip(own, other, strict=True):
            target.copy_(source)


def shaped(network: torch.nn.Module) -> list[torch.nn.Parameter]:
    """Their layers' weights and biases, encoder first, without log σ."""
    named = dict(network.named_parameters())
    encoder = [p for name, p in named.items() if name.startswith("_encoder")]
    return encoder + [p for name, p in named.items() if name.startswith(("_fc", "_mu"))]


def close(ours: torch.nn.Module, to: torch.nn.Module) -> None:
    for mine, other in zip(ours.parameters(), shaped(to), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-7)


def test_a_step_of_bc_is_the_same(batch: Minibatch) -> None:
    ours = BC(SEEN, ACTED, BCHyperparameters())
    impl = theirs(d3rlpy.algos.BCConfig(batch_size=ROWS))
    give(ours.actor, impl.policy)
    for _ in range(3):
        mine, other = ours.step(batch), impl.update_imitator(as_theirs(batch))
        assert float(mine["actor"].detach()) == pytest.approx(other["loss"], rel=1e-5)
    close(ours.actor, impl.policy)


def test_the_losses_of_iql_are_the_same_and_so_are_critics_and_value_after_a_step(
    batch: Minibatch,
) -> None:
    ours = IQL(SEEN, ACTED, IQLHyperparameters())
    impl = theirs(d3rlpy.algos.IQLConfig())
    modules = impl.modules
    give(ours.actor, modules.policy)
    give(ours.value, modules.value_func)
    with torch.no_grad():
        ours.spread += 0.3
        modules.policy._logstd += 0.3
        for target in ours.targets.parameters():  # unlike the critics, as after many steps
            target.mul_(1.5)
    for mine, other in zip(ours.critics, modules.q_funcs, strict=True):
        give(mine, other)
    for mine, other in zip(ours.targets, modules.targ_q_funcs, strict=True):
        give(mine, other)

    found = {name: float(loss.detach()) for name, loss in ours.losses(batch).items()}
    rows = as_theirs(batch)
    critic = impl.compute_critic_loss(rows, impl.compute_target(rows))
    actor = impl.compute_actor_loss(rows, modules.policy(batch.observations)).actor_loss
    assert found["value"] == pytest.approx(float(critic.v_loss.detach()), rel=1e-5)
    assert found["critic"] == pytest.approx(float(critic.q_loss.detach()), rel=1e-5)
    assert found["actor"] == pytest.approx(float(actor.detach()), rel=1e-5)

    ours.step(batch)
    impl.update_critic(rows)
    impl.update_critic_target()
    close(ours.value, modules.value_func)
    for mine, other in zip(ours.critics, modules.q_funcs, strict=True):
        close(mine, other)
    for mine, other in zip(ours.targets, modules.targ_q_funcs, strict=True):
        close(mine, other)


def test_the_policy_acts_the_same(batch: Minibatch) -> None:
    from sme_registry.datasets import OfflinePolicy
    from sme_registry.datasets.learners import weights

    ours = BC(SEEN, ACTED, BCHyperparameters())
    unit = d3rlpy.preprocessing.MinMaxActionScaler(
        minimum=np.zeros(ACTED, np.float32), maximum=np.ones(ACTED, np.float32)
    )
    algorithm = d3rlpy.algos.BCConfig(action_scaler=unit).create(device="cpu:0")
    algorithm.create_impl((SEEN,), ACTED)
    give(ours.actor, algorithm.impl.policy)
    observations = batch.observations.numpy()
    np.testing.assert_allclose(
        OfflinePolicy(weights(ours.actor))(observations), algorithm.predict(observations), atol=1e-6
    )


@pytest.mark.parametrize("final_observations", [False, True])
def test_d3rlpy_reads_the_transitions_of_the_task(final_observations: bool) -> None:
    spec = SMESpec(horizon=20, D=0.05)
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(0.8),), transitions=250)
    ours = collect(recipe, materialize(spec))
    assert ours.terminations.any()
    assert ours.timeouts.any()
    given = to_d3rlpy(ours, final_observations=final_observations)
    dataset = d3rlpy.dataset.MDPDataset(**given)
    assert len(dataset.episodes) == len(ours.ends)
    theirs = [
        dataset.transition_picker(episode, index)
        for episode in dataset.episodes
        for index in range(episode.transition_count)
    ]
    kept = np.ones(250, bool) if final_observations else ~ours.timeouts
    assert len(theirs) == kept.sum()
    for row, one in zip(np.flatnonzero(kept), theirs, strict=True):
        np.testing.assert_array_equal(one.observation, ours.observations[row])
        np.testing.assert_array_equal(one.action, ours.actions[row])
        np.testing.assert_allclose(one.reward[0], ours.rewards[row], atol=1e-7)
        assert (one.terminal > 0) == ours.terminations[row]
        if not ours.terminations[row]:
            np.testing.assert_array_equal(one.next_observation, ours.next_observations[row])

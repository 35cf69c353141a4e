"""Updates of TD3 and SAC equal Stable-Baselines3's."""

import pytest

pytest.importorskip("jax")
pytest.importorskip("stable_baselines3")

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import torch

from sme_registry.jax.networks import Adam
from sme_registry.jax.off_policy import OffPolicyLearner, ReplayRows
from sme_registry.jax.td3_sac import SAC, TD3, SACProgram, TD3Program
from sme_registry.sb3 import SMEVecEnv
from sme_registry.training.algorithms import load_algorithm, one_thread, quiet

pytestmark = pytest.mark.usefixtures("quickly_compiled")

NET_ARCH = (96, 64)
BATCH = 64
COUNTS = (1, 10)
DIMENSIONS = {"A=16": (8, 16), "A=4": (3, 4)}  # S, A


def model_in_mid_run(algorithm, S, A):
    """A model after some updates; its episodes have terminated and been truncated."""
    spec = {"state_dim": S, "action_dim": A, "seed": 5}
    env = SMEVecEnv({**spec, "horizon": 20, "D": 0.1 if A < 9 else 0.0}, 1)
    with quiet(), one_thread():
        model = load_algorithm(algorithm)(
            "MlpPolicy", env, seed=3, batch_size=BATCH, buffer_size=1000, device="cpu",
            policy_kwargs={"net_arch": list(NET_ARCH)},
        )  # fmt: skip
        model.learn(140)
    # Actions near 1, which target smoothing moves beyond it and the squashing corrects most.
    for name, bias in model.policy.named_parameters():
        if name in ("actor.mu.bias", "actor.mu.4.bias", "actor_target.mu.4.bias"):
            bias.data += 1.0
    return model


class Replayed(NamedTuple):
    """Weights of one model: before, and after each of `COUNTS` updates."""

    before: dict[str, np.ndarray]
    theirs: dict[int, dict[str, np.ndarray]]
    ours: dict[int, dict[str, np.ndarray]]


def replay(kind, settings, dimensions):
    """Let SB3 and us make the same updates of one model in mid-run."""
    model = model_in_mid_run(type(settings).__name__, *dimensions)
    learner, channels = _learner(model), np.ones(dimensions[1], bool)
    update = jax.jit(partial(kind.update, settings))
    replayed = Replayed(_weights(model), {}, {})
    for count in range(1, max(COUNTS) + 1):
        batch, noise = _one_update(model, count)
        learner = update(learner, batch, noise[:, : kind.draws], channels, model._n_updates, 0)
        if count in COUNTS:
            replayed.theirs[count] = _weights(model)
            replayed.ours[count] = {name: np.array(w) for name, w in learner.weights.items()}
    return replayed


def greatest_difference(weights, others):
    """Over all weights of the same names."""
    assert weights.keys() == others.keys()
    return max(float(np.abs(weight - others[name]).max()) for name, weight in weights.items())


def _one_update(model, seed):
    """Let SB3 make one update; the batch and the noise that it drew.

    NumPy's generator draws the batch and Torch's the noise.
    """
    _seed(seed)
    drawn = model.replay_buffer.sample(BATCH)
    draws = [torch.randn(BATCH, drawn.actions.shape[1]).numpy().T for _ in range(2)]
    _seed(seed)
    model.train(1, BATCH)
    batch = ReplayRows(
        drawn.observations.numpy(),
        drawn.actions.numpy(),
        drawn.next_observations.numpy(),
        drawn.rewards.numpy()[:, 0],
        drawn.dones.numpy()[:, 0],
    )
    return batch, np.stack(draws, axis=1)


def _weights(model):
    weights = {name: w.numpy().copy() for name, w in model.policy.state_dict().items()}
    if hasattr(model, "log_ent_coef"):
        weights["log_ent_coef"] = model.log_ent_coef.detach().numpy().copy()
    return weights


def _learner(model):
    """The model's weights and Adam states."""
    optimisers = [
        (getattr(model, each).optimizer, [f"{each}.{n}" for n, _ in network.named_parameters()])
        for each, network in (("actor", model.actor), ("critic", model.critic))
    ]
    if hasattr(model, "log_ent_coef"):
        optimisers.append((model.ent_coef_optimizer, ["log_ent_coef"]))
    return OffPolicyLearner(_weights(model), *(_adam(*each) for each in optimisers))


def _adam(optimiser, names):
    """The state of a Torch optimiser whose parameters have these names, in their order."""
    state = list(optimiser.state_dict()["state"].values())
    mean, square = (
        {name: each[key].numpy().copy() for name, each in zip(names, state, strict=True)}
        for key in ("exp_avg", "exp_avg_sq")
    )
    return Adam(mean, square, np.int32(state[0]["step"].item()))


def _seed(seed):
    np.random.seed(seed)  # noqa: NPY002  (SB3 uses the global generator)
    torch.manual_seed(seed)


SETTINGS = {"policy_kwargs": {"net_arch": NET_ARCH}, "batch_size": BATCH}
KINDS = [(TD3Program, TD3(**SETTINGS)), (SACProgram, SAC(**SETTINGS))]


@pytest.mark.parametrize("dimensions", DIMENSIONS.values(), ids=DIMENSIONS)
@pytest.mark.parametrize(("kind", "settings"), KINDS, ids=["TD3", "SAC"])
def test_updates_equal_those_of_stable_baselines3(kind, settings, dimensions):
    replayed = replay(kind, settings, dimensions)
    for updates, tolerance in ((1, 1e-6), (10, 1e-5)):
        theirs = replayed.theirs[updates]
        assert greatest_difference(theirs, replayed.before) > 100 * tolerance
        assert greatest_difference(theirs, replayed.ours[updates]) < tolerance

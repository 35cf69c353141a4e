"""Updates of TD3 and SAC equal Stable-Baselines3's, in wide actions and in padded ones."""

import pytest

pytest.importorskip("jax")
pytest.importorskip("stable_baselines3")

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch

from sme_registry.jax.networks import Adam
from sme_registry.jax.padding import Dimensions, Padding
from sme_registry.jax.replay import Transitions
from sme_registry.jax.sac import SAC, SACProgram
from sme_registry.jax.td3 import TD3, TD3Program
from sme_registry.sb3 import SMEVecEnv
from sme_registry.training.algorithms import find, one_thread, quiet

NET_ARCH = (96, 64)
BATCH = 64
COUNTS = (1, 10)
# One program serves both: the smaller one is padded to the larger one.
DIMENSIONS = (Dimensions(8, 16), Dimensions(3, 4))


def model_in_mid_run(algorithm, dimensions):
    """A model after some updates; its episodes have terminated and been truncated."""
    spec = {"state_dim": dimensions.state_dim, "action_dim": dimensions.action_dim, "seed": 5}
    env = SMEVecEnv({**spec, "horizon": 20, "D": 0.1 if dimensions.action_dim < 9 else 0.0}, 1)
    with quiet(), one_thread():
        model = find(algorithm).load()(
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


def replay(kind, settings):
    """Let SB3 and us make the same updates, of one model for each of `DIMENSIONS`, in mid-run."""
    full = DIMENSIONS[0]
    models = [model_in_mid_run(type(settings).__name__, own) for own in DIMENSIONS]
    padding = Padding(partial(kind.initial_weights, settings), full)
    learner = _stacked([_learner(kind, model, padding, own) for model, own in _zip(models)])
    masks = np.stack([np.arange(full.action_dim) < own.action_dim for own in DIMENSIONS])
    update = jax.jit(jax.vmap(partial(kind.update, settings), (0, 0, 0, 0, None, None)))
    results = [Replayed(_weights(model), {}, {}) for model in models]
    for count in range(1, max(COUNTS) + 1):
        drawn = [_one_update(model, own, full, count) for model, own in _zip(models)]
        batch, noise = _stacked(drawn)
        learner = update(learner, batch, noise[:, :, : kind.draws], masks, models[0]._n_updates, 0)
        if count in COUNTS:
            for lane, (result, own) in enumerate(_zip(results)):
                result.theirs[count] = _weights(models[lane])
                ours = {name: np.array(w[lane]) for name, w in learner.weights.items()}
                result.ours[count] = padding.remove(ours, own)
    return results


def greatest_difference(weights, others):
    """Over all weights of the same names."""
    assert weights.keys() == others.keys()
    return max(float(np.abs(weight - others[name]).max()) for name, weight in weights.items())


def _one_update(model, own, full, seed):
    """Let SB3 make one update; the batch and the noise that it drew, padded.

    NumPy's generator draws the batch and Torch's the noise. Noise of padded channels is 1.
    """
    _seed(seed)
    drawn = model.replay_buffer.sample(BATCH)
    draws = [torch.randn(BATCH, own.action_dim).numpy().T for _ in range(2)]
    noise = np.ones((full.action_dim, 2, BATCH), np.float32)
    noise[: own.action_dim] = np.stack(draws, axis=1)
    _seed(seed)
    model.train(1, BATCH)

    def observations(x):
        wider = np.zeros((BATCH, full.observation_dim), np.float32)
        wider[:, : own.state_dim], wider[:, full.state_dim :] = x[:, :-2], x[:, -2:]
        return wider

    action = np.zeros((BATCH, full.action_dim), np.float32)
    action[:, : own.action_dim] = drawn.actions
    batch = Transitions(
        observations(drawn.observations),
        action,
        observations(drawn.next_observations),
        drawn.rewards.numpy()[:, 0],
        drawn.dones.numpy()[:, 0],
    )
    return batch, noise


def _weights(model):
    weights = {name: w.numpy().copy() for name, w in model.policy.state_dict().items()}
    if hasattr(model, "log_ent_coef"):
        weights["log_ent_coef"] = model.log_ent_coef.detach().numpy().copy()
    return weights


def _learner(kind, model, padding, own):
    """The model's weights and Adam states, padded."""
    optimisers = [
        (getattr(model, each).optimizer, [f"{each}.{n}" for n, _ in network.named_parameters()])
        for each, network in (("actor", model.actor), ("critic", model.critic))
    ]
    if hasattr(model, "log_ent_coef"):
        optimisers.append((model.ent_coef_optimizer, ["log_ent_coef"]))
    adams = [_adam(*each, padding, own) for each in optimisers]
    weights = padding.add(_weights(model), own)
    learner = kind.initial_learner({name: jnp.asarray(weight) for name, weight in weights.items()})
    return type(learner)(weights, *adams)


def _adam(optimiser, names, padding, own):
    """The state of a Torch optimiser whose parameters have these names, in their order."""
    state = list(optimiser.state_dict()["state"].values())
    mean, square = (
        padding.add({n: each[key].numpy() for n, each in zip(names, state, strict=True)}, own)
        for key in ("exp_avg", "exp_avg_sq")
    )
    return Adam(mean, square, np.int32(state[0]["step"].item()))


def _stacked(lanes):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *lanes)


def _zip(each):
    return list(zip(each, DIMENSIONS, strict=True))


def _seed(seed):
    np.random.seed(seed)  # noqa: NPY002  (SB3 uses the global generator)
    torch.manual_seed(seed)


SETTINGS = {"net_arch": NET_ARCH, "batch_size": BATCH}
KINDS = [(TD3Program, TD3(**SETTINGS)), (SACProgram, SAC(**SETTINGS))]


@pytest.fixture(scope="module", params=KINDS, ids=["TD3", "SAC"])
def lanes(request):
    return replay(*request.param)


@pytest.mark.parametrize("lane", [0, 1], ids=["A=16", "padded"])
def test_updates_equal_those_of_stable_baselines3(lanes, lane):
    replayed = lanes[lane]
    for updates, tolerance in ((1, 1e-6), (10, 1e-5)):
        theirs = replayed.theirs[updates]
        assert greatest_difference(theirs, replayed.before) > 100 * tolerance
        assert greatest_difference(theirs, replayed.ours[updates]) < tolerance

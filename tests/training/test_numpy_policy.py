"""A model's policy in NumPy, and the model itself where its network is of another kind."""

from typing import Literal

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec
from sme_registry.errors import SpecError
from sme_registry.evaluation import Perceptron, Policy
from sme_registry.evaluation.policies import as_policy
from sme_registry.training.numpy_policy import numpy_policy

sb3 = pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")

SPEC = SMESpec(state_dim=3, action_dim=2, horizon=20)
OBSERVATIONS = np.random.default_rng(0).random((200, 5), dtype=np.float32)
Range = Literal["unit", "symmetric"]


def new_model(algorithm, action_range="symmetric", noise=0.2, document=SPEC, **kwargs):
    """An untrained model, its weights moved so far that some of its actions are clipped."""
    from sme_registry.sb3 import SMEVecEnv

    env = SMEVecEnv(document, action_range=action_range)
    if algorithm.__name__ in ("TD3", "DDPG", "SAC", "TQC"):
        kwargs["buffer_size"] = 1
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter += noise * torch.randn(parameter.shape, generator=generator)
    return model


def predicted(model):
    """The actions of SB3's `predict`, in the unit range."""
    actions = model.predict(OBSERVATIONS, deterministic=True)[0].astype(np.float64)
    return (actions + 1.0) / 2.0 if model.action_space.low[0] < 0 else actions


def algorithm_class(name):
    """The class, of SB3 or else of sb3-contrib."""
    return getattr(sb3, name, None) or getattr(pytest.importorskip("sb3_contrib"), name)


@pytest.mark.parametrize(
    ("algorithm", "action_range"),
    [
        ("PPO", "unit"), ("A2C", "symmetric"), ("TRPO", "unit"), ("TD3", "symmetric"),
        ("DDPG", "unit"), ("SAC", "symmetric"), ("TQC", "unit"),
    ],
)  # fmt: skip
def test_the_copied_network_acts_as_the_model_did(algorithm, action_range):
    """Its hidden layers, too; later training does not change the copy."""
    model = new_model(algorithm_class(algorithm), action_range)
    own, copied = as_policy(model, SPEC), numpy_policy(model, SPEC)
    assert isinstance(copied.act, Perceptron)
    assert copied.action_range == action_range
    expected = predicted(model)
    assert expected.std() > 0.1
    if algorithm in ("PPO", "A2C", "TRPO"):  # an unbounded mean, which SB3 clips
        assert np.mean((expected == 0.0) | (expected == 1.0)) > 0.05
    assert isinstance(own, Policy)
    assert own.hidden is not None
    assert copied.hidden is not None
    hidden = list(own.hidden(OBSERVATIONS))
    assert len(hidden) == 2
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter += 1.0
    assert np.abs(predicted(model) - expected).max() > 0.1
    actions = np.clip(copied(OBSERVATIONS), 0.0, 1.0)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=5e-6)
    for one, other, later in zip(
        copied.hidden(OBSERVATIONS), hidden, own.hidden(OBSERVATIONS), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-4)
        assert np.abs(later - other).max() > 0.1


@pytest.mark.parametrize("observes_phase", [False, True])
def test_a_policy_of_a_stream_observes_what_the_stream_shows(observes_phase):
    phases = [{"spec": SPEC, "steps": 20}, {"spec": SPEC.derive(seed=1), "steps": 20}]
    stream = StreamSpec(phases=phases, observes_phase=observes_phase)
    model = new_model(sb3.PPO, document=stream)
    copied = numpy_policy(model, stream)
    assert isinstance(copied.act, Perceptron)
    observations = np.random.default_rng(1).random((20, 5 + 2 * observes_phase), dtype=np.float32)
    expected = (model.predict(observations, deterministic=True)[0] + 1.0) / 2.0
    np.testing.assert_allclose(np.clip(copied(observations), 0, 1), expected, rtol=0, atol=5e-6)


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("PPO", {"policy_kwargs": {"activation_fn": torch.nn.ELU}}),
        ("SAC", {"use_sde": True}),  # whose mean is clamped before tanh
        ("TD3", {"noise": 0.0}),  # which does more than its layers say
    ],
)
def test_a_network_of_another_kind_is_called_directly(algorithm, settings):
    model = new_model(getattr(sb3, algorithm), **settings)
    if algorithm == "TD3":
        plain = model.policy.actor.forward
        model.policy.actor.forward = lambda observations: plain(observations) * 0.5
    policy = numpy_policy(model, SPEC)
    assert not isinstance(policy.act, Perceptron)
    np.testing.assert_allclose(np.clip(policy(OBSERVATIONS), 0, 1), predicted(model), atol=1e-7)
    function = numpy_policy(lambda observations: observations[:, :2], SPEC)
    np.testing.assert_array_equal(function(OBSERVATIONS), OBSERVATIONS[:, :2].astype(np.float64))


def test_a_team_is_rejected():
    team = SPEC.derive(team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    with pytest.raises(SpecError, match=r"^team: must be null"):
        numpy_policy(lambda observations: observations[:, :1], team)

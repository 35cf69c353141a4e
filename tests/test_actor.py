"""A model's actions as matrix products; and the model itself where they are no such thing."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.errors import SpecError
from sme_registry.training.actor import Perceptron, actor

sb3 = pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")

SPEC = SMESpec(state_dim=3, action_dim=2, horizon=20)
OBSERVATIONS = np.random.default_rng(0).random((200, 5), dtype=np.float32)
Range = Literal["unit", "symmetric"]


def model(
    algorithm: Any, action_range: Range = "symmetric", noise: float = 0.2, **kwargs: Any
) -> Any:
    """An untrained model, its weights moved so far that some of its actions are clipped."""
    from sme_registry.sb3 import SMEVecEnv

    env = SMEVecEnv(SPEC, action_range=action_range)
    if algorithm.__name__ in ("TD3", "DDPG", "SAC", "TQC"):
        kwargs["buffer_size"] = 1
    made = algorithm("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in made.policy.parameters():
            parameter += noise * torch.randn(parameter.shape, generator=generator)
    return made


def predicted(made: Any) -> Any:
    """What SB3's `predict` says, in the unit range."""
    actions = made.predict(OBSERVATIONS, deterministic=True)[0].astype(np.float64)
    return (actions + 1.0) / 2.0 if made.action_space.low[0] < 0 else actions


def found(name: str) -> Any:
    """The class, of SB3 or else of sb3-contrib."""
    return getattr(sb3, name, None) or getattr(pytest.importorskip("sb3_contrib"), name)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
@pytest.mark.parametrize("algorithm", ["PPO", "A2C", "TRPO", "TD3", "DDPG", "SAC", "TQC"])
def test_the_copied_network_acts_as_predict_does(algorithm: str, action_range: Range) -> None:
    made = model(found(algorithm), action_range)
    copied = actor(made, SPEC)
    assert isinstance(copied.act, Perceptron)
    assert copied.action_range == action_range
    actions, expected = np.clip(copied(OBSERVATIONS), 0.0, 1.0), predicted(made)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=5e-6)
    assert expected.std() > 0.1
    if algorithm in ("PPO", "A2C", "TRPO"):  # an unbounded mean, which SB3 clips
        assert np.mean((expected == 0.0) | (expected == 1.0)) > 0.05


def test_weights_are_those_of_when_it_was_copied() -> None:
    made = model(sb3.TD3)
    copied, before = actor(made, SPEC), predicted(made)
    with torch.no_grad():
        for parameter in made.policy.parameters():
            parameter *= -1.0
    np.testing.assert_allclose(copied(OBSERVATIONS), before, atol=5e-6)
    assert np.abs(predicted(made) - before).max() > 0.1
    np.testing.assert_allclose(actor(made, SPEC)(OBSERVATIONS), predicted(made), atol=5e-6)


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("PPO", {"policy_kwargs": {"activation_fn": torch.nn.ELU}}),
        ("SAC", {"use_sde": True}),  # whose mean is clamped before tanh
    ],
)
def test_a_network_of_another_kind_is_asked_itself(algorithm: str, settings: Any) -> None:
    made = model(getattr(sb3, algorithm), **settings)
    asked = actor(made, SPEC)
    assert not isinstance(asked.act, Perceptron)
    np.testing.assert_allclose(np.clip(asked(OBSERVATIONS), 0, 1), predicted(made), atol=1e-7)


def test_a_network_that_does_more_than_its_layers_say_is_asked_itself() -> None:
    made = model(sb3.TD3, noise=0.0)
    plain = made.policy.actor.forward
    made.policy.actor.forward = lambda observations: plain(observations) * 0.5
    asked = actor(made, SPEC)
    assert not isinstance(asked.act, Perceptron)
    np.testing.assert_allclose(asked(OBSERVATIONS), predicted(made), atol=1e-7)


def test_a_callable_is_its_own_actor() -> None:
    policy = actor(lambda observations: observations[:, :2], SPEC)
    np.testing.assert_array_equal(policy(OBSERVATIONS), OBSERVATIONS[:, :2].astype(np.float64))


def test_a_team_has_no_single_actor() -> None:
    team = SPEC.derive(team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    with pytest.raises(SpecError, match="an actor is one agent's"):
        actor(lambda observations: observations[:, :1], team)

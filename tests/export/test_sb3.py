"""Exported SB3 models act as the models do, and what cannot is refused and leaves no file."""

import pickle

import numpy as np
import onnx
import pytest

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize

from leaderboard.gate.sandbox import inspect_own, widths
from sme_registry import SMESpec, evaluate, export_onnx
from sme_registry.errors import PolicyError
from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv

SPEC = SMESpec(state_dim=3, action_dim=2)
TEAM = SMESpec(action_dim=2, team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
SMALL = {"net_arch": [16, 16]}


def made(algorithm, action_range="symmetric", env=None, spread=1.0, policy_kwargs=SMALL, **kwargs):
    """An untrained model with a last layer so large that many of its actions are clipped."""
    env = SMEVecEnv(SPEC, action_range=action_range) if env is None else env
    if algorithm not in (PPO, A2C):
        kwargs["buffer_size"] = 1
    model = algorithm(
        "MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(policy_kwargs), **kwargs
    )
    network = getattr(model.policy, "action_net", None) or model.policy.actor.mu
    last = [layer for layer in network.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight *= spread / last.weight.std()
    return model


def observations(rows=500):
    seen = np.random.default_rng(1).random((rows, SPEC.state_dim + 2), dtype=np.float32)
    return np.concatenate([seen, 3.0 * seen - np.float32(1.0)])


def acted(path, seen):
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return session.run(["actions"], {"observations": seen})[0]


def unit_actions(model, seen):
    low = model.action_space.low
    return (model.predict(seen, deterministic=True)[0] - low) / (1.0 - low)


@pytest.mark.parametrize(
    ("algorithm", "action_range"),
    [(PPO, "unit"), (A2C, "symmetric"), (SAC, "symmetric"), (TD3, "unit"), (DDPG, "symmetric")],
)
def test_a_file_acts_as_its_model_does(tmp_path, algorithm, action_range):
    model = made(algorithm, action_range, spread=0.5 if algorithm in (PPO, A2C) else 3.0)
    path = export_onnx(model, SPEC, tmp_path / "policy.onnx")
    expected = unit_actions(model, observations())
    assert expected.min() < 0.01  # clipping and squashing are at work
    assert expected.max() > 0.99
    assert np.abs(acted(path, observations()) - expected).max() <= 1e-6
    inspect_own(path.read_bytes(), SPEC.state_dim + 2, SPEC.action_dim)
    assert onnx.load(path).opset_import[0].version == 17


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [
        (PPO, {"policy_kwargs": {"net_arch": {"pi": [8], "vf": [8]}, "activation_fn": "ELU"}}),
        (SAC, {"policy_kwargs": {"net_arch": [8, 8, 8], "activation_fn": "SiLU"}}),
        (TD3, {"policy_kwargs": {"net_arch": [], "activation_fn": "ReLU"}}),
        (PPO, {"policy_kwargs": {**SMALL, "squash_output": True}, "use_sde": True}),
        (SAC, {"policy_kwargs": SMALL, "use_sde": True}),
    ],
)
def test_other_networks_act_as_their_models_do(tmp_path, algorithm, kwargs):
    policy = dict(kwargs["policy_kwargs"])
    if "activation_fn" in policy:
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    model = made(algorithm, **{**kwargs, "policy_kwargs": policy})
    path = export_onnx(model, SPEC, tmp_path / "policy.onnx")
    expected = unit_actions(model, observations())
    assert np.ptp(expected) > 0.1
    assert np.abs(acted(path, observations()) - expected).max() <= 1e-6


def normalised(clip=2.0, **kwargs):
    """An environment whose VecNormalize has seen lopsided observations."""
    env = VecNormalize(SMEVecEnv(SPEC, action_range="symmetric"), clip_obs=clip, **kwargs)
    if env.norm_obs:
        width = SPEC.state_dim + 2
        env.obs_rms.mean = np.linspace(0.1, 0.9, width)
        env.obs_rms.var = np.geomspace(0.01, 1.0, width)
    return env


@pytest.mark.parametrize("given", ["object", "file", "the model's own", "none of rewards alone"])
def test_normalised_observations_are_normalised_in_the_graph(tmp_path, given):
    env = normalised(norm_obs=given != "none of rewards alone")
    model = made(PPO, env=env if given in ("the model's own", "none of rewards alone") else None)
    if given == "file":
        env.save(tmp_path / "statistics.pkl")
    vec_normalize = {"object": env, "file": tmp_path / "statistics.pkl"}.get(given)
    path = export_onnx(model, SPEC, tmp_path / "policy.onnx", vec_normalize=vec_normalize)
    expected = unit_actions(model, env.normalize_obs(observations()))
    change = np.abs(expected - unit_actions(model, observations())).max()
    assert change > 0.1 if env.norm_obs else change == 0.0
    assert np.abs(acted(path, observations()) - expected).max() <= 1e-6


def test_a_saved_model_is_exported_by_its_path(tmp_path):
    model = made(TD3)
    model.save(tmp_path / "model.zip")
    path = export_onnx(tmp_path / "model.zip", SPEC, tmp_path / "policy.onnx")
    assert np.abs(acted(path, observations()) - unit_actions(model, observations())).max() <= 1e-6


def test_exporting_leaves_the_model_as_it_was(tmp_path):
    model = made(PPO)
    model.policy.set_training_mode(True)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    export_onnx(model, SPEC, tmp_path / "policy.onnx")
    assert all((value == before[name]).all() for name, value in model.policy.state_dict().items())
    assert [parameter.requires_grad for parameter in model.policy.parameters()].count(False) == 0


def refused(tmp_path, model, spec=SPEC, *, match, **kwargs):
    target = tmp_path / "out" / "policy.onnx"
    with pytest.raises(PolicyError, match=match):
        export_onnx(model, spec, target, **kwargs)
    assert not target.parent.exists()


def test_a_file_that_differs_from_its_model_is_not_written(tmp_path):
    class Moody(torch.nn.Tanh):
        def forward(self, x):
            return super().forward(x) + (0.01 if torch.jit.is_tracing() else 0.0)

    model = made(TD3, policy_kwargs={"net_arch": [8], "activation_fn": Moody})
    refused(
        tmp_path, model, match=r"differs from its own actions by .*e-0\d: must be at most 1e-06"
    )


def test_a_file_that_was_there_is_left_where_the_new_one_is_refused(tmp_path):
    target = tmp_path / "policy.onnx"
    target.write_bytes(b"before")
    for spec in (SMESpec(), TEAM):
        with pytest.raises(PolicyError, match=r"observations have shape \(5,\): must be \(1"):
            export_onnx(made(PPO), spec, target)
    assert target.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [target]


def test_a_teams_model_acts_for_each_agent_from_its_shared_observation(tmp_path):
    model = made(A2C, env=SMETeamVecEnv(TEAM, 1))
    path = export_onnx(model, TEAM, tmp_path / "team.onnx")
    inspect_own(path.read_bytes(), *widths(TEAM))
    ours, exported = (
        evaluate(policy, TEAM, {"states_per_region": 50}) for policy in (model, str(path))
    )
    for region, other in zip(ours.regions, exported.regions, strict=True):
        assert region.mae == pytest.approx(other.mae, abs=1e-6)
    refused(
        tmp_path,
        model,
        match=r"observations have shape \(12,\): must be \(10,\)",
        spec=SMESpec(action_dim=2),
    )


def test_an_action_space_of_another_range_and_what_is_no_model_are_refused(tmp_path):
    model = made(PPO)
    model.policy.action_space = type(model.action_space)(-2.0, 2.0, (2,), np.float32)
    refused(tmp_path, model, match=r"must be \[0, 1\] or \[-1, 1\] in every channel")
    refused(tmp_path, None, match=r"must be a torch.nn.Module, .*, or the path of a .zip")


def test_statistics_that_do_not_fit_are_refused(tmp_path):
    wrong = tmp_path / "wrong.pkl"
    wrong.write_bytes(b"no pickle")
    refused(tmp_path, made(PPO), match="wrong.pkl.*cannot be loaded", vec_normalize=wrong)
    wrong.write_bytes(pickle.dumps([1, 2]))
    refused(tmp_path, made(PPO), match="must be a VecNormalize", vec_normalize=wrong)
    other = VecNormalize(SMEVecEnv(SMESpec(), action_range="symmetric"))
    refused(tmp_path, made(PPO), match=r"of shape \(10,\): must be \(5,\)", vec_normalize=other)

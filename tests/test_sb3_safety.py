"""PPO with a multiplier and PPO with projected actions, on tasks with limits."""

import io
import math

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate, materialize
from sme_registry.errors import OptionError, PolicyError
from sme_registry.spec.study import Cell
from sme_registry.training import train
from sme_registry.training.algorithms import check_hyperparameters
from sme_registry.training.record import RunRecord, read_episodes

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sme_registry.export import export_onnx
from sme_registry.sb3 import PPOLagrangian, PPOProjection, SMEVecEnv
from sme_registry.studies.cell import run_cell
from sme_registry.training.algorithms import find
from sme_registry.training.models import load_checkpoint
from sme_registry.training.numpy_policy import numpy_policy

SPEC = SMESpec(state_dim=3, action_dim=2, horizon=20, safety={"tightness": 0.2}, seed=5)
SMALL = {"n_steps": 64, "n_epochs": 2, "seed": 3}
PROTOCOL = {"states_per_region": 50}
ALGORITHMS = ["PPOLagrangian", "PPOProjection"]


def lanes(count=1, spec=SPEC, action_range="symmetric"):
    return SMEVecEnv(spec, count, action_range=action_range)


def observations(count=500):
    return np.random.default_rng(0).random((count, SPEC.observation_dim), dtype=np.float32)


def same_weights(one, other):
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def noting(costs):
    """A callback that collects the cost of each step."""

    def note(local, _):
        costs.extend(info["cost"] for info in local["infos"])
        return True

    return note


def reloaded(model, env=None):
    archive = io.BytesIO()
    model.save(archive)
    archive.seek(0)
    return type(model).load(archive, env=env)


@pytest.mark.parametrize("count", [1, 3])
def test_without_a_multiplier_it_is_ppo_bit_for_bit(count):
    plain = PPO("MlpPolicy", lanes(count), **SMALL).learn(200)
    fixed = PPOLagrangian("MlpPolicy", lanes(count), multiplier_learning_rate=0.0, **SMALL)
    assert same_weights(plain.policy, fixed.learn(200).policy)
    weighted = PPOLagrangian(
        "MlpPolicy", lanes(count), multiplier=1.0, multiplier_learning_rate=0.0, **SMALL
    )
    assert not same_weights(plain.policy, weighted.learn(200).policy)
    assert weighted.multiplier == 1.0


def test_the_multiplier_follows_the_mean_cost_of_the_rollout_down_to_0():
    costs = []
    settings = SMALL | {"cost_limit": 0.02, "multiplier_learning_rate": 3.0}
    model = PPOLagrangian("MlpPolicy", lanes(2), **settings)
    expected = 0.0
    for _ in range(3):
        costs.clear()
        model.learn(128, callback=noting(costs))
        expected += 3.0 * (np.mean(costs) - 0.02)
        assert model.multiplier == pytest.approx(expected, rel=1e-5)
    assert expected > 0.1
    model = PPOLagrangian("MlpPolicy", lanes(), cost_limit=0.9, multiplier=1.0, **SMALL)
    model.learn(64)
    assert 0.0 < model.multiplier < 0.5
    model.learn(128)
    assert model.multiplier == 0.0


def test_a_multiplier_lowers_the_cost_and_the_critic_of_costs_learns():
    model = PPOLagrangian(
        "MlpPolicy",
        lanes(8),
        multiplier=20.0,
        multiplier_learning_rate=0.0,
        learning_rate=3e-3,
        gamma=0.5,
        n_steps=32,
        n_epochs=5,
        seed=1,
    )
    untrained = {k: v.clone() for k, v in model.cost_critic.state_dict().items()}
    costs = []
    model.learn(2_560, callback=noting(costs))
    assert np.mean(costs[-640:]) < 0.5 * np.mean(costs[:640])
    # With γ = 0.5 the costs from a state on are about twice its mean cost.
    values = model._cost_values(observations())
    assert values.mean() == pytest.approx(2.0 * np.mean(costs[-640:]), abs=0.05)
    learned = model.cost_critic.state_dict()
    assert not torch.equal(untrained["value_net.weight"], learned["value_net.weight"])
    assert torch.equal(untrained["action_net.weight"], learned["action_net.weight"])


def test_a_saved_model_keeps_its_multiplier_and_critic_but_not_its_last_rollout():
    model = PPOLagrangian("MlpPolicy", lanes(), cost_limit=0.0, **SMALL).learn(200)
    assert {"_costs", "_cut"} <= set(vars(model))
    again = reloaded(model, lanes())
    assert not {"_costs", "_cut"} & set(vars(again))
    assert again.multiplier == model.multiplier > 0.0
    assert again.cost_limit == 0.0
    assert same_weights(again.cost_critic, model.cost_critic)
    assert again.cost_critic.optimizer.state_dict()["state"]
    assert again.learn(64).multiplier > model.multiplier


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
def test_projected_actions_never_cost_anything(action_range):
    env = lanes(2, action_range=action_range)
    costs = []

    model = PPOProjection("MlpPolicy", env, **SMALL)
    # Biased towards high actions, so that most of them would be above the limits.
    model.policy.action_net.bias.data += 1.0
    model.learn(256, callback=noting(costs))
    assert len(costs) >= 256
    assert max(costs) == 0.0
    task, seen = materialize(SPEC), observations()
    states = seen[:, : SPEC.state_dim].astype(float)
    actions, _ = model.predict(seen, deterministic=True)
    unit = actions.astype(float) if action_range == "unit" else (actions.astype(float) + 1) / 2
    limits = task.limit(states)
    assert (task.cost(states, unit) == 0.0).all()
    assert (limits - unit).min() == pytest.approx(1e-5, rel=0.2)  # as high as allowed
    assert np.array_equal(reloaded(model).predict(seen, deterministic=True)[0], actions)
    # Studies evaluate a copy of the network in NumPy, which must not lose the projection.
    policy = numpy_policy(model, SPEC, action_range=action_range)
    assert np.array_equal(policy.act(seen), actions)


def test_projected_actions_need_observations_that_show_the_state():
    for wrapper in (VecNormalize, lambda venv: VecFrameStack(venv, 2)):
        with pytest.raises(OptionError, match=r"must be those of the environment itself, Box\(0\."):
            PPOProjection("MlpPolicy", wrapper(lanes()))
    mixed = SPEC.derive(observation={"mixing": "orthogonal"})
    with pytest.raises(OptionError, match=r"mixing='orthogonal': must be 'none'"):
        PPOProjection("MlpPolicy", lanes(spec=mixed))
    with pytest.raises(OptionError, match="has no `sme_spec`"):
        PPOLagrangian("MlpPolicy", make_vec_env("Pendulum-v1"))
    distracted = lanes(spec=SPEC.derive(observation={"distractors": 2}))
    for env in (distracted, VecNormalize(lanes(), norm_obs=False)):
        PPOProjection("MlpPolicy", env, **SMALL).learn(64)


def test_a_projection_goes_on_in_its_own_task_only_and_is_not_exported(tmp_path):
    model = PPOProjection("MlpPolicy", lanes(), **SMALL)
    model.set_env(lanes())
    tighter = SPEC.derive(safety={"tightness": 0.4})
    with pytest.raises(OptionError, match=r"set_env: the environment's task is sha256:.*load"):
        model.set_env(lanes(spec=tighter))
    assert reloaded(model, lanes(spec=tighter)).learn(64)
    with pytest.raises(PolicyError, match="projection cannot be exported"):
        export_onnx(model, SPEC, tmp_path / "policy.onnx")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_task_without_limits_is_refused(algorithm, tmp_path):
    plain = SPEC.derive(safety=None)
    with pytest.raises(OptionError, match=f"^{algorithm}: needs a task with limits"):
        {"PPOLagrangian": PPOLagrangian, "PPOProjection": PPOProjection}[algorithm](
            "MlpPolicy", lanes(spec=plain)
        )
    for name in (algorithm, algorithm.lower()):
        with pytest.raises(OptionError, match=f"^{algorithm}: needs a task with limits"):
            train(plain, algorithm=name, folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(OptionError, match=f"^{algorithm}: needs a task with limits"):
        find(algorithm).check_task(plain)


def test_hyperparameters_are_known_by_name_and_in_their_range():
    for name, value, allowed in (
        ("cost_limit", 1.5, r"in \[0, 1\]"),
        ("cost_limit", "0.1", r"in \[0, 1\]"),
        ("multiplier", -1.0, "of at least 0"),
        ("multiplier_learning_rate", math.nan, "of at least 0"),
    ):
        with pytest.raises(OptionError, match=rf"^{name}=.*: must be a finite number {allowed}"):
            PPOLagrangian("MlpPolicy", lanes(), **{name: value})
    check_hyperparameters("PPOLagrangian", {"cost_limit": 0.1, "n_steps": 64})
    with pytest.raises(OptionError, match=r"cost_limits: .*Did you mean 'cost_limit'"):
        check_hyperparameters("PPOLagrangian", {"cost_limits": 0.1})
    with pytest.raises(OptionError, match=r"policy_kwargs\.limits"):
        check_hyperparameters("PPOProjection", {"policy_kwargs": {"limits": 1}})


def cell(uses, spec=SPEC):
    return Cell(
        spec=spec,
        uses=uses,
        hyperparameters={"n_steps": 64, "n_epochs": 1},
        action_range="symmetric",
        seed=0,
        steps=128,
        evaluations=2,
        evaluation_episodes=1,
        protocol=PROTOCOL,
    )


def test_studies_train_both_and_record_the_online_cost():
    costs = {}
    for uses in ALGORITHMS:
        result = run_cell(cell(uses))
        assert result.online_cost is not None
        assert result.to_dict()["online_cost"] == result.online_cost
        costs[uses] = result.online_cost
    assert costs["PPOProjection"] == 0.0 < costs["PPOLagrangian"]
    plain = run_cell(cell("PPO", SPEC.derive(safety=None)))
    assert "online_cost" not in plain.to_dict()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_logs_and_draws_the_cost_of_its_episodes(algorithm, tmp_path):
    pytest.importorskip("matplotlib")
    result = train(
        SPEC,
        algorithm=algorithm,
        steps=128,
        folder=tmp_path,
        hyperparameters={"n_steps": 64, "n_epochs": 1},
        protocol=PROTOCOL,
        progress=False,
    )
    read = read_episodes(tmp_path / "episodes.csv")
    assert len(read) == 6
    for episode in read:
        assert episode.safety is not None
        assert (episode.safety.cost == 0.0) == (algorithm == "PPOProjection")
        assert (episode.safety.violating_share == 0.0) == (algorithm == "PPOProjection")
        assert -1.0 <= episode.safety.safe_regret <= 1.0
    assert tmp_path / "cost_curve.png" in result.figures
    assert evaluate(str(result.model_path), SPEC, PROTOCOL).wd_regret == result.report.wd_regret


def test_a_stopped_run_resumes_with_its_multiplier(tmp_path, monkeypatch):
    settings = {
        "algorithm": "PPOLagrangian", "folder": tmp_path / "run", "checkpoint_every": 64,
        "protocol": PROTOCOL, "progress": False,
    }  # fmt: skip
    rounds, train_once = [], PPOLagrangian.train

    def stop(model):
        rounds.append(model)
        if len(rounds) == 4:
            raise KeyboardInterrupt
        train_once(model)

    hyperparameters = {"n_steps": 64, "n_epochs": 1, "cost_limit": 0.0}
    monkeypatch.setattr(PPOLagrangian, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        train(SPEC, steps=1000, hyperparameters=hyperparameters, **settings)
    monkeypatch.setattr(PPOLagrangian, "train", train_once)
    record = RunRecord.read(tmp_path / "run")
    assert record is not None
    assert 192 <= record.steps_done < 1000
    stored = load_checkpoint(PPOLagrangian, tmp_path / "run" / "checkpoint.zip", lanes())
    assert stored.multiplier > 0.1
    result = train(SPEC, steps=record.steps_done + 64, resume=True, **settings)
    # It only rises, since the limit is 0.
    assert PPOLagrangian.load(result.model_path).multiplier > stored.multiplier
    assert all(episode.safety is not None for episode in result.episodes)

"""PPO against Stable-Baselines3 from its weights and Adam's state in mid-run, and its program."""

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("jax")
pytest.importorskip("stable_baselines3")

import jax
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer

from sme_registry import SMESpec, make
from sme_registry.errors import OptionError
from sme_registry.jax import ppo
from sme_registry.jax.env import start
from sme_registry.jax.networks import Adam
from sme_registry.jax.run import settings_of
from sme_registry.jax.task import task_params
from sme_registry.sb3 import SMEVecEnv
from sme_registry.training.models import silence

pytestmark = pytest.mark.usefixtures("quickly_compiled")

Weights = dict[str, npt.NDArray[np.float32]]

# Episodes end by D, by T, and by both on one step; payouts are delayed.
SPEC = SMESpec(k=2, D=0.01, horizon=2)
WIDE = SMESpec(state_dim=11, action_dim=16, k=10, horizon=25)
SETTINGS = ppo.PPO(n_steps=256, n_epochs=20, clip_range_vf=0.2, ent_coef=0.01)
UPDATES = SETTINGS.n_steps // SETTINGS.batch_size * SETTINGS.n_epochs  # 80


class Recording(NamedTuple):
    """SB3 in mid-run: a rollout, the learner before it, and the weights after each update."""

    spec: SMESpec
    learner: ppo.PPOLearner
    steps: ppo.RolloutSteps
    next_observation: npt.NDArray[np.float32]
    rollout: ppo.Rollout
    batches: npt.NDArray[np.int64]
    weights: list[Weights]


class RecordingEnv(SMEVecEnv):
    """An environment that keeps the answers to its steps."""

    def step_wait(self):
        answer = observation, rewards, dones, (info,) = super().step_wait()
        last = info.get("terminal_observation", observation[0])
        truncated = bool(dones[0] and last[-2] == 1.0)
        terminated = bool(dones[0]) and not info["TimeLimit.truncated"]
        self.rows.append((float(rewards[0]), terminated, truncated, last))
        return answer


class RecordingBuffer(RolloutBuffer):
    """A rollout that keeps which steps are in each minibatch."""

    def _get_samples(self, batch_inds, env=None):
        self.batches.append(batch_inds)
        return super()._get_samples(batch_inds, env)


@pytest.fixture(scope="module")
def recordings():
    return [recorded(spec) for spec in (SPEC, WIDE)]


def recorded(spec):
    env = RecordingEnv(spec)
    names = ("n_steps", "n_epochs", "clip_range_vf", "ent_coef")
    chosen = {name: getattr(SETTINGS, name) for name in names}
    model = PPO(
        "MlpPolicy", env, seed=3, device="cpu", rollout_buffer_class=RecordingBuffer, **chosen
    )
    silence(model)
    model.rollout_buffer.batches, env.rows = [], []
    model.learn(SETTINGS.n_steps)
    env.rows = []
    callback = model._setup_learn(SETTINGS.n_steps, None, False)[1]
    model.collect_rollouts(env, callback, model.rollout_buffer, SETTINGS.n_steps)
    buffer = model.rollout_buffer
    rollout = ppo.Rollout(
        buffer.observations[:, 0], buffer.actions[:, 0], buffer.log_probs[:, 0],
        buffer.values[:, 0], buffer.advantages[:, 0],
    )  # fmt: skip
    rewards, *ends, last = (np.array(column) for column in zip(*env.rows, strict=True))
    steps = ppo.RolloutSteps(*rollout[:2], rewards.astype(np.float32), *ends, last)
    learner, weights = learner_of(model), []
    model.policy.optimizer.register_step_post_hook(lambda *_: weights.append(weights_of(model)))
    buffer.batches = []
    model.train()
    batches = np.array(buffer.batches)
    return Recording(spec, learner, steps, model._last_obs[0], rollout, batches, weights)


def weights_of(model):
    return {name: w.detach().numpy().copy() for name, w in model.policy.named_parameters()}


def learner_of(model):
    weights, moments = weights_of(model), model.policy.optimizer.state_dict()["state"]
    mean, square = (
        {name: moments[i][key].numpy().copy() for i, name in enumerate(weights)}
        for key in ("exp_avg", "exp_avg_sq")
    )
    return ppo.PPOLearner(weights, Adam(mean, square, np.int32(moments[0]["step"])))


def largest_difference(one, other):
    assert one.keys() == other.keys()
    return max(np.abs(one[name] - other[name]).max() for name in one)


def test_initial_weights_have_the_names_and_shapes_of_sb3(recordings):
    recording = recordings[1]
    rng = np.random.default_rng(0)
    weights = ppo.PPOProgram.initial_weights(SETTINGS, rng, 13, 16)
    theirs = recording.learner.weights
    assert {n: w.shape for n, w in weights.items()} == {n: w.shape for n, w in theirs.items()}
    gains = {"mlp_extractor.value_net.2": 2**0.5, "action_net": 0.01, "value_net": 1.0}
    for name, gain in gains.items():
        singular = np.linalg.svd(weights[f"{name}.weight"], compute_uv=False)
        np.testing.assert_allclose(singular, gain, rtol=1e-5)
        assert not weights[f"{name}.bias"].any()


@pytest.mark.parametrize(("task", "ends"), [(0, [0, 1, 2, 3]), (1, [0, 2])])
def test_advantages_equal_those_of_sb3(recordings, task, ends):
    recording = recordings[task]
    found = 2 * recording.steps.truncated + recording.steps.terminated
    assert np.unique(found).tolist() == ends
    ours = jax.jit(functools.partial(ppo.rollout, SETTINGS))(
        recording.learner.weights, recording.steps, recording.next_observation,
        np.ones(recording.spec.action_dim, bool),
    )  # fmt: skip
    for name in ("log_density", "value", "advantage"):
        theirs = getattr(recording.rollout, name)
        tolerance = 1e-6 * max(1.0, np.abs(theirs).max())
        np.testing.assert_allclose(getattr(ours, name), theirs, rtol=0, atol=tolerance)


@pytest.mark.parametrize("task", [0, 1])
def test_weights_equal_those_of_sb3_after_1_and_80_updates(recordings, task):
    recording = recordings[task]
    learner, channels = recording.learner, np.ones(recording.spec.action_dim, bool)
    assert recording.batches.shape == (UPDATES, SETTINGS.batch_size)
    update = jax.jit(functools.partial(ppo.update, SETTINGS))
    for i in range(UPDATES):
        learner = update(learner, recording.rollout, recording.batches[i : i + 1], channels)
        if i in (0, UPDATES - 1):
            ours = {name: np.asarray(weight) for name, weight in learner.weights.items()}
            assert largest_difference(ours, recording.weights[i]) < (1e-5 if i else 1e-6)
    assert largest_difference(ours, recording.learner.weights) > 1e-2


@pytest.mark.parametrize(
    ("spec", "separable", "action_range"),
    [
        (SPEC, False, "symmetric"),
        (SMESpec(complexity=2, hidden_width=4, horizon=7), True, "unit"),
    ],
)
def test_collected_steps_are_those_of_the_environment(spec, separable, action_range):
    n, rng = 32, np.random.default_rng(1)
    params = task_params(spec)
    weights = ppo.PPOProgram.initial_weights(SETTINGS, rng, 10, 4)
    weights["log_std"] += np.float32(0.1)
    noise = rng.standard_normal((4, n), np.float32)
    starts = rng.random((n + 1, 8))
    fresh = jax.jit(jax.vmap(lambda s: start(s, params)[1]))(starts)
    begin, after = (
        jax.tree.map(lambda x, at=at: np.asarray(x)[at], fresh) for at in (0, slice(1, None))
    )
    symmetric = action_range == "symmetric"
    collect = jax.jit(
        functools.partial(ppo.collect, SETTINGS, symmetric=symmetric, separable=separable)
    )
    episode, steps, log = collect(weights, params, begin, noise, after, 0, n)

    env = make(spec, action_range=action_range)
    observation, _ = env.reset(options={"state": starts[0]})
    low, high = env.action_space.low, env.action_space.high
    mean = jax.jit(functools.partial(ppo.mean, SETTINGS))
    for i in range(n):
        np.testing.assert_array_equal(steps.observation[i], observation)
        expected = mean(weights, observation) + np.exp(np.float32(0.1)) * noise[:, i]
        np.testing.assert_allclose(steps.action[i], expected, atol=1e-6)
        action = np.clip(steps.action[i], low, high)
        observation, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(steps.last_observation[i], observation)
        assert steps.reward[i] == pytest.approx(reward, abs=1e-6)
        ends = steps.terminated[i], steps.truncated[i]
        assert (terminated, truncated) == ends == (log.terminated[i], log.truncated[i])
        row = log.reward[i], log.regret[i], log.similarity[i]
        assert row == pytest.approx((reward, info["regret"], info["similarity"]), abs=1e-12)
        if terminated or truncated:
            observation, _ = env.reset(options={"state": starts[i + 1]})
    np.testing.assert_array_equal(ppo.observe(episode, params), observation)


def test_permutations_are_random_orders():
    permutations = jax.jit(ppo.permutations, static_argnums=(1, 2))
    orders = np.asarray(permutations(jax.random.PRNGKey(0), 500, 12))
    assert (np.sort(orders) == np.arange(12)).all()
    assert len(np.unique(orders, axis=0)) == 500
    np.testing.assert_allclose(orders.mean(axis=0), 5.5, atol=0.7)  # 4.5 standard errors


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gamma": 1.5}, r"^hyperparameters: gamma=1.5: must be in \[0, 1\]"),
        ({"policy_kwargs": {"net_arch": [8, 0]}}, r"policy_kwargs.net_arch.1=0: must be .* 1"),
        ({"policy_kwargs": {"net_arch": {"pi": [8]}}}, r"policy_kwargs.net_arch={'pi': \[8\]}: "),
        ({"policy_kwargs": {"activation_fn": "torch.nn:ELU"}}, "activation_fn=.*fields: net_arch"),
        ({"policy_kwargs.net_arch": [8]}, "unknown field. Did you mean 'policy_kwargs'"),
        ({"learning_rate": ".001"}, r"learning_rate='.001': must be a valid number"),
        ({"normalize_advantage": "no"}, r"normalize_advantage='no': must be a valid bool"),
        ({"batch_size": 60}, r"hyperparameters: batch_size=60: must be at least 2 and divide"),
        ({"target_kl": 0.1}, r"target_kl=0.1: unknown field. Known fields"),
    ],
)
def test_hyperparameters_are_checked(values, message):
    with pytest.raises(OptionError, match=message):
        settings_of("jax:PPO", values)


SMALL = ppo.PPO(n_steps=32, batch_size=16, n_epochs=2, policy_kwargs={"net_arch": (8, 8)})


def program():
    """Two runs, on tasks of other reward settings."""
    specs = [SMESpec(k=10, r_min=0.5, seed=1), SMESpec(horizon=9)]
    return ppo.PPOProgram(SMALL, specs, [4, 5], steps=96)


def test_a_program_collects_whole_rollouts_and_learns_between_them():
    agents = program()
    before, keys = agents.weights(0), [agents.state.key]
    log = agents.advance(20)
    keys.append(agents.state.key)
    assert agents.steps == 32
    assert {x.shape for x in jax.tree.leaves(log)} == {(32, 2)}
    assert largest_difference(agents.weights(0), before) == 0.0  # stopped before the update
    assert {x.shape for x in jax.tree.leaves(agents.advance(32))} == {(0, 2)}
    log = agents.advance(96)
    assert {x.shape for x in jax.tree.leaves(log)} == {(64, 2)}
    assert log.terminated.dtype == log.truncated.dtype == bool
    assert agents.state.optimiser.updates.tolist() == [8, 8]
    keys.append(agents.state.key)
    agents.finish()
    agents.finish()
    keys.append(agents.state.key)
    assert len({key.tobytes() for key in np.asarray(keys)}) == 4
    assert agents.state.optimiser.updates.tolist() == [12, 12]
    assert largest_difference(agents.weights(0), before) > 1e-4
    assert agents.weights(1)["action_net.weight"].shape == (4, 8)
    assert not agents.failed().any()


def test_a_failed_run_leaves_the_others_alone():
    agents, broken = program(), program()
    weights = dict(broken.state.weights)
    weights["action_net.bias"] = weights["action_net.bias"].at[0].set(np.nan)
    broken.state = broken.state._replace(weights=weights)
    for each in (agents, broken):
        each.advance(64)
        each.finish()
    assert broken.failed().tolist() == [True, False]
    assert largest_difference(broken.weights(1), agents.weights(1)) == 0.0

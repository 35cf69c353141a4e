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
from sme_registry.jax.padding import Dimensions, Padding
from sme_registry.jax.run import settings_of
from sme_registry.jax.task import task_params
from sme_registry.sb3.vec_env import SingleVecEnv
from sme_registry.training.models import silence

Weights = dict[str, npt.NDArray[np.float32]]

# Episodes end by D, by T, and by both on one step; payouts are delayed.
SPEC = SMESpec(k=2, D=0.01, horizon=2)
WIDE = SMESpec(state_dim=11, action_dim=16, k=10, horizon=25)
FULL = Dimensions(11, 16)  # to which the first task is padded beside the second
SETTINGS = ppo.PPO(n_steps=256, n_epochs=20, clip_range_vf=0.2, ent_coef=0.01)
UPDATES = SETTINGS.n_steps // SETTINGS.batch_size * SETTINGS.n_epochs  # 80


class Recording(NamedTuple):
    """SB3 in mid-run: a rollout, the learner before it, and the weights after each update."""

    spec: SMESpec
    own: Dimensions
    learner: ppo.Learner
    steps: ppo.Steps
    next_observation: npt.NDArray[np.float32]
    rollout: ppo.Rollout
    batches: npt.NDArray[np.int64]
    weights: list[Weights]


class RecordingEnv(SingleVecEnv):
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
    env = RecordingEnv(spec, action_range="symmetric")
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
    steps = ppo.Steps(*rollout[:2], rewards.astype(np.float32), *ends, last)
    learner, weights = learner_of(model), []
    model.policy.optimizer.register_step_post_hook(lambda *_: weights.append(weights_of(model)))
    buffer.batches = []
    model.train()
    batches = np.array(buffer.batches)
    own = Dimensions(spec.state_dim, spec.action_dim)
    return Recording(spec, own, learner, steps, model._last_obs[0], rollout, batches, weights)


def weights_of(model):
    return {name: w.detach().numpy().copy() for name, w in model.policy.named_parameters()}


def learner_of(model):
    weights, moments = weights_of(model), model.policy.optimizer.state_dict()["state"]
    mean, square = (
        {name: moments[i][key].numpy().copy() for i, name in enumerate(weights)}
        for key in ("exp_avg", "exp_avg_sq")
    )
    return ppo.Learner(weights, Adam(mean, square, np.int32(moments[0]["step"])))


def padded(recording, padding):
    """The learner and the rollout of one of several lanes."""
    own = recording.own
    weights, (mean, square, updates) = recording.learner
    added = (padding.add(each, own) for each in (weights, mean, square))
    learner = ppo.Learner(next(added), Adam(*added, updates))
    states = [own.state_dim] * (FULL.state_dim - own.state_dim)
    observation = np.insert(recording.rollout.observation, states, 0.0, axis=1)
    rng = np.random.default_rng(0)  # whatever is in padded channels of actions
    noise = rng.standard_normal((SETTINGS.n_steps, FULL.action_dim - own.action_dim), np.float32)
    action = np.concatenate([recording.rollout.action, noise], axis=1)
    return learner, recording.rollout._replace(observation=observation, action=action)


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
        np.ones(recording.own.action_dim, bool),
    )  # fmt: skip
    for name in ("log_density", "value", "advantage"):
        theirs = getattr(recording.rollout, name)
        tolerance = 1e-6 * max(1.0, np.abs(theirs).max())
        np.testing.assert_allclose(getattr(ours, name), theirs, rtol=0, atol=tolerance)


def test_weights_equal_those_of_sb3_after_1_and_80_updates_also_padded(recordings):
    padding = Padding(functools.partial(ppo.PPOProgram.initial_weights, SETTINGS), FULL)
    lanes = [padded(recording, padding) for recording in recordings]
    learner, rollout = jax.tree.map(lambda *leaves: np.stack(leaves), *lanes)
    masks = np.stack([np.arange(FULL.action_dim) < each.own.action_dim for each in recordings])
    batches = np.stack([recording.batches for recording in recordings])
    assert batches.shape == (2, UPDATES, SETTINGS.batch_size)
    update = jax.jit(jax.vmap(functools.partial(ppo.update, SETTINGS)))
    for i in range(UPDATES):
        learner = update(learner, rollout, batches[:, i : i + 1], masks)
        if i not in (0, UPDATES - 1):
            continue
        for lane, recording in enumerate(recordings):
            ours = {name: np.asarray(w[lane]) for name, w in learner.weights.items()}
            own = padding.remove(ours, recording.own)
            assert largest_difference(own, recording.weights[i]) < (1e-5 if i else 1e-6)
            assert largest_difference(padding.add(own, recording.own), ours) == 0.0
            if i:
                assert largest_difference(own, recording.learner.weights) > 1e-2


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
    for i in range(n):
        np.testing.assert_array_equal(steps.observation[i], observation)
        mean = ppo.mean(SETTINGS, weights, observation)
        expected = mean + np.exp(np.float32(0.1)) * noise[:, i]
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
        ({"gamma": 1.5}, r"hyperparameters.gamma=1.5: Input should be less than or equal to 1"),
        (
            {"policy_kwargs": {"net_arch": [8, 0]}},
            r"policy_kwargs.net_arch=\[8, 0\]: must be a list",
        ),
        ({"policy_kwargs": {"net_arch": {"pi": [8]}}}, r"must be a list of widths .*\[256, 256\]"),
        ({"policy_kwargs": {"activation_fn": "torch.nn:ELU"}}, r"Known: .*policy_kwargs.net_arch"),
        ({"policy_kwargs.net_arch": [8]}, r"net_arch: must be in the dict policy_kwargs, such as"),
        ({"learning_rate": ".001"}, r"learning_rate='.001': Input should be a valid number"),
        ({"normalize_advantage": "no"}, r"normalize_advantage='no': Input should be a valid bool"),
        ({"batch_size": 60}, r"hyperparameters.batch_size=60: must be at least 2 and divide"),
        ({"target_kl": 0.1}, r"hyperparameters.target_kl: jax:PPO has no such hyperparameter"),
    ],
)
def test_hyperparameters_are_checked(values, message):
    with pytest.raises(OptionError, match=message):
        settings_of("jax:PPO", values)


SMALL = ppo.PPO(n_steps=32, batch_size=16, n_epochs=2, net_arch=(8, 8))


def program():
    """Two lanes of tasks of unequal sizes and reward settings."""
    specs = [SMESpec(k=10, r_min=0.5, seed=1), SMESpec(state_dim=5, action_dim=2, horizon=9)]
    return ppo.PPOProgram(SMALL, specs, [4, 5], steps=96)


def test_a_program_collects_whole_rollouts_and_learns_between_them():
    lanes = program()
    before, keys = lanes.weights(0), [lanes.state.key]
    log = lanes.advance(20)
    keys.append(lanes.state.key)
    assert lanes.steps == 32
    assert {x.shape for x in jax.tree.leaves(log)} == {(32, 2)}
    assert largest_difference(lanes.weights(0), before) == 0.0  # stopped before the update
    assert {x.shape for x in jax.tree.leaves(lanes.advance(32))} == {(0, 2)}
    log = lanes.advance(96)
    assert {x.shape for x in jax.tree.leaves(log)} == {(64, 2)}
    assert log.terminated.dtype == log.truncated.dtype == bool
    assert lanes.state.optimiser.updates.tolist() == [8, 8]
    keys.append(lanes.state.key)
    lanes.finish()
    lanes.finish()
    keys.append(lanes.state.key)
    assert len({key.tobytes() for key in np.asarray(keys)}) == 4
    assert lanes.state.optimiser.updates.tolist() == [12, 12]
    assert largest_difference(lanes.weights(0), before) > 1e-4
    assert lanes.weights(1)["action_net.weight"].shape == (2, 8)
    padded = np.asarray(lanes.state.weights["mlp_extractor.policy_net.0.weight"][1])
    assert not padded[:, 5:8].any()
    assert padded[:, :5].all()
    assert not lanes.failed().any()


def test_a_program_goes_on_from_saved_state_bit_for_bit():
    lanes = program()
    lanes.advance(64)
    again = program()
    again.restore(lanes.save())
    one, other = lanes.advance(96), again.advance(96)
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    lanes.finish()
    again.finish()
    assert largest_difference(lanes.weights(1), again.weights(1)) == 0.0


def test_a_failed_lane_leaves_the_others_alone():
    lanes, broken = program(), program()
    weights = dict(broken.state.weights)
    weights["action_net.bias"] = weights["action_net.bias"].at[0].set(np.nan)
    broken.state = broken.state._replace(weights=weights)
    for each in (lanes, broken):
        each.advance(64)
        each.finish()
    assert broken.failed().tolist() == [True, False]
    assert largest_difference(broken.weights(1), lanes.weights(1)) == 0.0

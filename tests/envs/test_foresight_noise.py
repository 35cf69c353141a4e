"""Shaping, compensated safety and noise: what is paid on top leaves optimum and regret alone."""

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec, make, make_vec, materialize, testing
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import SpecError
from sme_registry.teams import SMETeamEnv

SHAPING = {"scale": 3.0}
NOISE = {"reward": 0.3, "transition": 0.1}
COMPENSATED = {"tightness": 0.3, "compensated": True}
SHAPED = SMESpec(horizon=12, k=3, shaping=SHAPING)
FRAGILE = SMESpec(horizon=30, k=2, D=0.7, shaping={"scale": 10.0})
EVERYTHING = SMESpec(
    horizon=12, complexity=3, k=5, shaping=SHAPING, noise=NOISE, safety=COMPENSATED,
    observation={"distractors": 3, "mixing": "nonlinear"},
)  # fmt: skip
TEAM = SHAPED.derive(noise=NOISE, team={"agents": [{"action_dim": 1}, {"action_dim": 3}]})


def stream(switch):
    """Phases with shaping, with noise instead, and with another shaping."""
    specs = (
        SMESpec(horizon=10, shaping=SHAPING),
        SMESpec(horizon=10, k=3, seed=4, noise=NOISE),
        SMESpec(horizon=10, seed=6, shaping={"scale": 7.0}),
    )
    phases = [{"spec": spec, "steps": steps} for spec, steps in zip(specs, (7, 6, 7), strict=True)]
    return StreamSpec(phases=phases, switch=switch, cycles=3)


DOCUMENTS = {
    "k=3": SHAPED,
    "early termination": FRAGILE,
    "everything": EVERYTHING,
    "switch at a step": stream("step"),
    "switch at a reset": stream("episode"),
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_shaping_adds_up_to_the_first_potential_and_all_environments_agree(name, backend):
    pytest.importorskip("stable_baselines3")
    sb3 = pytest.importorskip("sme_registry.sb3")
    document, B = DOCUMENTS[name], 5
    env = SMEEnv(document)
    batch = SMEVectorEnv(document, B, autoreset_mode="SameStep")
    lanes = sb3.SMEVecEnv(document, B, action_range="unit")
    lanes.seed(3)
    observation, _ = env.reset(seed=3)
    together, _ = batch.reset(seed=3)
    np.testing.assert_array_equal(together[0], observation)
    np.testing.assert_array_equal(lanes.reset(), together)
    rng, terminations, total = np.random.default_rng(0), 0, 0.0
    first = env.task.potential(env.state, 0)
    for _ in range(60):
        best = np.stack([t.optimal_action(s) for t, s in zip(batch.get_attr("task"), batch.state)])  # noqa: B905
        action = (0.8 * best + 0.2 * rng.random(best.shape)).astype(np.float32)
        _, reward, terminated, truncated, info = env.step(action[0])
        together, rewards, *_, infos = batch.step(action)
        observations, paid, _, of_lanes = lanes.step(action)
        np.testing.assert_array_equal(observations, together)
        np.testing.assert_array_equal(paid, rewards.astype(np.float32))
        assert reward == rewards[0]
        ended = terminated or truncated
        for key, value in info.items():
            np.testing.assert_array_equal((infos["final_info"] if ended else infos)[key][0], value)
            np.testing.assert_array_equal(of_lanes[0][key], value)
        total += info["shaping"]
        if ended:
            assert total == pytest.approx(-first, abs=1e-12)
            terminations, total = terminations + terminated, 0.0
            env.reset()
            first = env.task.potential(env.state, 0)
    assert (terminations > 0) == (name == "early termination")


@pytest.mark.parametrize("switch", ["step", "episode"])
def test_every_step_in_a_stream_is_the_definitions(switch):
    testing.check_stream(stream(switch))


def test_an_outer_limit_takes_the_potential_back():
    single, batch = make(SHAPED, max_episode_steps=5), make_vec(SHAPED, 2, max_episode_steps=5)
    single.reset(seed=0)
    batch.reset(seed=0)
    first, total, ended = single.unwrapped.task.potential(single.unwrapped.state, 0), 0.0, False
    while not ended:
        _, reward, _, ended, info = single.step(np.full(4, 0.5))
        rewards, *_, infos = batch.step(np.full((2, 4), 0.5))[1:]
        assert (reward, info["shaping"]) == (rewards[0], infos["shaping"][0])
        total += info["shaping"]
    assert total == pytest.approx(-first, abs=1e-12)


def test_each_agent_of_a_team_is_paid_shaping_and_noise_of_its_own():
    testing.check_team(TEAM)
    team = SMETeamEnv(TEAM)
    team.reset(seed=0)
    actions = {"agent_0": np.full(1, 0.5), "agent_1": np.full(3, 0.5)}
    _, rewards, *_, infos = team.step(actions)
    one, other = infos.values()
    assert one["shaping"] == other["shaping"] != 0.0
    assert one["reward_noise"] != other["reward_noise"]
    for name, info in infos.items():
        assert rewards[name] == info["shaping"] + info["reward_noise"]  # k=3: no payout yet


def test_a_discounted_potential_is_paid_for_the_learner_that_discounts():
    env = SMEEnv(SHAPED.derive(shaping={"scale": 3.0, "discount": 0.9}))
    env.reset(seed=0)
    before, total, weight = env.task.potential(env.state, 0), 0.0, 1.0
    for _ in range(12):
        *_, info = env.step(env.action_space.sample())
        total += weight * info["shaping"]
        weight *= 0.9
    assert total == pytest.approx(-before)


def test_the_safe_projection_earns_the_horizon_where_safety_is_compensated():
    """No action without cost earns more than 1 in any state; one with a cost does."""
    task = materialize(SMESpec(horizon=20, safety={"tightness": 0.4, "compensated": True}))
    rng = np.random.default_rng(0)
    s = rng.random((200, 1, 8)).repeat(50, axis=1).reshape(-1, 8)
    price = 1.0 - task.step_reward(s, task.safe_action(s))
    within = rng.random((len(s), 4)) * task.limit(s)
    near = np.clip(task.safe_action(s) + 0.05 * rng.standard_normal(within.shape), 0, task.limit(s))
    for action in (within, near):
        assert (task.cost(s, action) == 0).all()
        assert (task.step_reward(s, action) + price).max() <= 1.0 + 1e-12
    assert (1.0 + price).mean() > 1.1  # π* breaks limits, and earns more
    env = SMEEnv(task.spec)
    env.reset(seed=0)
    paid = [env.step(task.safe_action(env.state))[1] for _ in range(20)]
    np.testing.assert_allclose(paid, 1.0, atol=1e-6)  # actions are float32 to the transition only


def test_noise_has_its_mean_and_deviation_and_leaves_states_uniform_and_regret_as_it_is():
    B, T = 400, 50
    batch = SMEVectorEnv(SMESpec(horizon=T, noise={"reward": 0.5, "transition": 0.3}), B)
    batch.reset(seed=1)
    noise, moved, states = [], [], []
    for _ in range(T):
        s, zeta, action = batch.state, batch.noise[:, 1:], np.full((B, 4), 0.3)
        moved.append(zeta)
        *_, infos = batch.step(action)
        noise.append(infos["reward_noise"])
        np.testing.assert_array_equal(batch.state, batch.task.transition(s, action, zeta))
        np.testing.assert_allclose(infos["regret"], batch.task.regret(s, action), atol=1e-12)
        states.append(batch.state)
    assert np.mean(noise) == pytest.approx(0.0, abs=4 * 0.5 / np.sqrt(B * T))
    assert np.std(noise) == pytest.approx(0.5, rel=0.03)
    assert np.std(moved) == pytest.approx(1.0, rel=0.01)
    deciles = np.histogram(np.concatenate(states), 10, (0.0, 1.0))[0] / (B * T * 8)
    np.testing.assert_allclose(deciles, 0.1, atol=0.005)


def test_each_stream_of_random_numbers_is_its_own():
    both, one = (SMEEnv(SMESpec(noise=noise)) for noise in (NOISE, {"reward": 0.3}))
    plain = SMEEnv(SMESpec())
    for env in (both, one, plain):
        env.reset(seed=2)
    np.testing.assert_array_equal(both.state, plain.state)
    assert both.noise[0] == one.noise[0] != 0.0
    assert not one.noise[1:].any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"shaping": {"scale": 0}}, r"shaping.scale=0.*must be.* in \(0, 100\]"),
        ({"shaping": {"scale": float("nan")}}, "shaping.scale=nan"),
        ({"shaping": {"scale": 1, "discount": 1.5}}, r"shaping.discount=1.5.*\[0.*, 1.*\]"),
        ({"noise": {"reward": 11}}, r"noise.reward=11.*\[0.*, 10.*\]"),
        ({"noise": {"transition": -1}}, r"noise.transition=-1"),
        ({"noise": {"reward": 0}}, "noise.reward=0.0: must be above 0"),
        ({"noise": {"observation": 0.1}}, "would hide the state"),
        ({"safety": {"tightness": 0.2, "compensated": 1}}, "safety.compensated=1"),
    ],
)
def test_bad_fields_are_refused_with_the_remedy(fields, message):
    with pytest.raises(SpecError, match=message):
        SMESpec(**fields)

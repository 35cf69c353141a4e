"""Streams: when phases change, what infos say, what is refused. The kit checks every step."""

import copy

import gymnasium
import numpy as np
import pytest

from sme_registry import StreamSpec
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    UnexpectedKeywordError,
)
from sme_registry.testing import expect_same, next_action

SPEC = {"state_dim": 4, "action_dim": 2, "horizon": 12, "complexity": 2}
HALF = np.full(2, 0.5, np.float32)


def stream(switch="episode", D=0.35, **fields):
    """Two rounds of three phases: k falls and rises, and the second phase drifts."""
    specs = [SPEC | {"D": D, "k": k, "seed": seed} for seed, k in enumerate((7, 2, 5))]
    drift = {"rotation": 2.0, "increments": 3}
    phases = [
        {"spec": specs[0], "steps": 37},
        {"spec": specs[1], "steps": 24, "drift": drift},
        {"spec": specs[2], "steps": 30},
    ]
    return StreamSpec.from_dict({"phases": phases, "cycles": 2, "switch": switch, **fields})


def phases_seen(env, steps, action=HALF):
    """(lifetime, phase) of every step; episodes follow each other."""
    seen = []
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(action)
        seen.append((int(info["lifetime"]), int(info["phase"])))
        if terminated or truncated:
            env.reset()
    return seen


def test_a_phase_is_left_at_the_next_reset():
    env = SMEEnv(stream(D=0.0))
    env.reset(seed=0)
    # Episodes of 12 steps: 37 is passed in the fourth, and so on; after 182 the last phase goes on.
    lengths = [(0, 48), (1, 24), (2, 24), (0, 36), (1, 24), (2, 84)]
    phases = [phase for phase, length in lengths for _ in range(length)]
    assert phases_seen(env, 240) == list(zip(range(1, 241), phases, strict=True))


def test_a_phase_is_left_at_once_however_far_away_the_switch_is():
    phases = [{"spec": SPEC, "steps": 700}, {"spec": SPEC | {"seed": 1}, "steps": 100}]
    for spec in (stream("step", D=0.0), StreamSpec(phases=phases, switch="step")):
        env, steps = SMEEnv(spec), spec.steps + 20
        env.reset(seed=0)
        expected = [(i + 1, spec.segments[spec.times.segment_at(i)].phase) for i in range(steps)]
        assert phases_seen(env, steps) == expected


def test_state_and_what_is_to_be_paid_carry_over_a_switch_within_an_episode():
    specs = SPEC | {"k": 12}, SPEC | {"k": 2, "seed": 1}
    phases = [{"spec": spec, "steps": 9} for spec in specs]
    env = SMEEnv(StreamSpec(phases=phases, switch="step", observes_phase=True))
    env.reset(seed=0)
    for t in range(1, 13):
        task, s = env.task, env.state
        action = task.optimal_action(s).astype(np.float32)
        observation, reward, _, truncated, info = env.step(action)
        np.testing.assert_array_equal(env.state, task.transition(s, action))
        assert info["phase"] == (t > 9)
        if t < 10:
            k = 12 if t < 9 else 2  # at step 9 the observation is already of the second phase
            assert reward == 0.0
            assert observation[5] == np.float32(min(info["accumulated_reward"] / k, 1.0))
            assert observation[6:].tolist() == [float(t < 9), float(t >= 9)]
    # 9 rewards of the first phase were paid at step 10 of the second, where 10 mod 2 = 0.
    assert reward == pytest.approx(2.0, abs=1e-6)
    assert truncated
    assert observation[5] == 0.0


def test_a_reset_continues_the_life_and_a_seed_begins_a_new_one():
    env, batch = SMEEnv(stream()), SMEVectorEnv(stream(), 2)
    assert env.reset(seed=0)[1]["lifetime"] == 0
    phases_seen(env, 50, env.task.optimal_action(env.state))
    _, info = env.reset()
    assert (info["lifetime"], info["phase"]) == (50, 1)
    assert info["regret"] == 0.0
    _, info = env.reset(seed=0)
    assert (info["lifetime"], info["phase"]) == (0, 0)
    batch.reset(seed=0)
    for _ in range(8):
        batch.step(np.full((2, 2), 0.5, np.float32))
    _, infos = batch.reset(seed=[None, 4])
    assert infos["lifetime"][0] > 0
    assert infos["lifetime"][1] == 0


@pytest.mark.parametrize("switch", ["episode", "step"])
def test_a_life_may_begin_after_some_steps(switch):
    spec = stream(switch, D=0.0)
    env, batch = SMEEnv(spec), SMEVectorEnv(spec, 2, autoreset_mode="SameStep")
    for lifetime, phase in ((36, 0), (61, 2), (400, 2)):
        options = {"lifetime": lifetime}
        observation, info = env.reset(seed=1, options=options)
        observations, infos = batch.reset(seed=1, options=options)
        assert (info["phase"], info["lifetime"]) == (phase, lifetime)
        for _ in range(40):
            assert infos["lifetime"].tolist() == [info["lifetime"]] * 2
            assert infos["phase"].tolist() == [info["phase"]] * 2
            np.testing.assert_array_equal(observation, observations[0])
            observation, _, _, truncated, info = env.step(HALF)
            if truncated:
                observation, info = env.reset()
            observations, *_, infos = batch.step(np.stack([HALF, HALF]))


def test_another_lifetime_or_that_of_a_task_is_refused_and_nothing_changes():
    env, batch = SMEEnv(stream()), SMEVectorEnv(stream(), 2)
    for each in env, batch:
        each.reset(seed=0)
        for lifetime in (-1, 2.5, "late", None, 2**62 + 1, 2**63 - 1, 2**70):
            with pytest.raises(OptionError, match=r"^lifetime=.*must be an integer in \[0, 4,611,"):
                each.reset(seed=1, options={"lifetime": lifetime})
        action = np.full_like(each.action_space.sample(), 0.5)
        assert np.max(each.step(action)[4]["lifetime"]) == 1
        each.reset(seed=1, options={"lifetime": 2**62})
        assert np.min(each.step(action)[4]["lifetime"]) == 2**62 + 1
        each.reset(seed=0)
        assert np.max(each.reset()[1]["lifetime"]) == 0
        with pytest.raises(OptionError, match="unknown option"):
            each.reset(options={"lifetmie": 1})
    for task in SMEEnv(SPEC), SMEVectorEnv(SPEC, 2):
        with pytest.raises(OptionError, match="unknown option"):
            task.reset(options={"lifetime": 1})


def test_a_refused_action_and_an_autoreset_are_no_steps_of_the_life():
    env = SMEEnv(stream("step", D=0.0))
    env.reset(seed=0)
    for lifetime in range(1, 41):  # beyond the switch at 37
        with pytest.raises(ActionError):
            env.step(np.array([np.nan, 0.5], np.float32))
        with pytest.raises(ActionError):
            env.step(np.zeros(3, np.float32))
        _, _, _, truncated, info = env.step(HALF)
        assert info["lifetime"] == lifetime
        if truncated:
            with pytest.raises(EpisodeError):
                env.step(HALF)
            env.reset()
    batch = SMEVectorEnv(stream(D=0.0), 2)
    batch.reset(seed=0)
    lifetimes = [batch.step(np.full((2, 2), 0.5))[4]["lifetime"][0] for _ in range(14)]
    assert lifetimes == [*range(1, 13), 12, 13]


def test_lanes_in_different_pieces_refuse_an_action_together():
    batch = SMEVectorEnv(stream("step"), 4, autoreset_mode="SameStep")
    batch.reset(seed=0)
    rng = np.random.default_rng(0)
    while len(set(batch.get_attr("task"))) == 1:
        batch.step(next_action(batch, rng))
        batch.reset(seed=[5, None, None, None], options={"reset_mask": np.arange(4) == 0})
    before, twin = batch.state, copy.deepcopy(batch)
    for lane in range(4):
        bad = np.full((4, 2), 0.5, np.float32)
        bad[lane] = np.inf
        with pytest.raises(ActionError, match="NaN or infinite"):
            batch.step(bad)
        np.testing.assert_array_equal(batch.state, before)
    action = next_action(batch, rng)
    expect_same("the step after it", batch.step(action), twin.step(action))
    with pytest.raises(EpisodeError, match=r"different segments.*get_attr\('task'\)"):
        _ = twin.task


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_fields_of_specs_are_refused_with_the_way_to_another_stream(make):
    with pytest.raises(UnexpectedKeywordError, match=r"'complexity' for a stream.*spec\.derive"):
        make("SME/Switch5-v1", complexity=10)
    with pytest.raises(UnexpectedKeywordError, match=r"'cycles' for a stream.*StreamSpec\(\*\*"):
        make("SME/Switch5-v1", cycles=2)
    with pytest.raises(UnexpectedKeywordError, match=r"Did you mean 'action_range'"):
        make("SME/Switch5-v1", action_rnge="unit")


def test_frames_show_the_task_in_force():
    pytest.importorskip("pygame")
    phases = [{"spec": SPEC | {"k": k}, "steps": 3} for k in (2, 3)]
    spec = StreamSpec(phases=phases, switch="step")
    env = SMEEnv(spec, render_mode="rgb_array")
    batch = SMEVectorEnv(spec, 2, render_mode="rgb_array")
    env.reset(seed=0)
    batch.reset(seed=0)
    tops = []
    for _ in range(4):
        env.step(HALF)
        frames = [env.render(), batch.step(np.stack([HALF, HALF])) and batch.render()[0]]
        np.testing.assert_array_equal(*frames)
        tops.append(bytes(frames[0][:40]))
    assert tops[0] == tops[1] != tops[2] == tops[3]
    env.close()

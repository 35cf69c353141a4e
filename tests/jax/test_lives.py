"""Agents live through streams: each step is under the task in force, and nothing else changes."""

from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("jax")

import jax
import jax.numpy as jnp

from sme_registry import SMESpec
from sme_registry.errors import SpecError
from sme_registry.jax.env import observe as observe_in_jax
from sme_registry.jax.off_policy import read_rows
from sme_registry.jax.ppo import PPO, PPOProgram
from sme_registry.jax.program import Lives, StepLog
from sme_registry.jax.task import check_supported
from sme_registry.jax.td3_sac import TD3, TD3Program
from sme_registry.spec import StreamSpec
from sme_registry.task import observe, step
from sme_registry.task.episode import shaping_at_switch
from sme_registry.task.loading import materialize_segments

pytestmark = pytest.mark.usefixtures("quickly_compiled")

BASE = SMESpec(state_dim=3, action_dim=2, horizon=13, k=5, D=0.02, seed=1)
OTHERS = (
    BASE.derive(seed=2, k=1, r_min=0.4),
    BASE.derive(seed=3, k=3, D=0.0),
)
DRIFT = {"rotation": 1.0, "increments": 2}
BUDGET = 64


def stream_of(*phases, drift=None, **fields):
    """A stream; the drift is of its last phase."""
    listed = [{"spec": spec, "steps": steps} for spec, steps in phases]
    if drift:
        listed[-1]["drift"] = drift
    return StreamSpec(phases=listed, **fields)


# Switches where an episode is truncated (13), and within one and from k = 20 to k = 1 (25); within
# rollouts, and at the end of the first one (32); with shaping, with none, and with another one.
SUDDEN = stream_of(
    (OTHERS[1].derive(shaping={"scale": 3.0, "discount": 0.9}), 13),
    (BASE.derive(D=0.0, k=20), 12),
    (OTHERS[0].derive(shaping={"scale": 2.0}), 7), drift=DRIFT,
    cycles=2, switch="step", observes_phase=True,
)  # fmt: skip
CURRICULUM = stream_of(
    *[
        (SMESpec(state_dim=3, action_dim=2, horizon=7, complexity=L, hidden_width=4), 14)
        for L in (1, 2, 3)
    ],
    observes_phase=True,
)

NARROW = {"net_arch": (8,)}
ALGORITHMS = {
    "TD3": (TD3Program, TD3(learning_starts=6, batch_size=8, policy_kwargs=NARROW)),
    "PPO": (PPOProgram, PPO(n_steps=32, batch_size=16, n_epochs=2, policy_kwargs=NARROW)),
}


def program(algorithm, *documents, budget=BUDGET):
    kind, settings = ALGORITHMS[algorithm]
    return kind(settings, documents, range(len(documents)), steps=budget)


class Life(NamedTuple):
    """What an agent met, `[steps, runs, …]`."""

    observation: npt.NDArray[np.float32]
    action: npt.NDArray[np.float32]
    next_observation: npt.NDArray[np.float32]
    reward: npt.NDArray[np.float32]
    log: StepLog


def lived(algorithm, *documents):
    """A whole life."""
    agents = program(algorithm, *documents)
    if algorithm == "TD3":
        log = agents.advance(BUDGET)
        rows = jnp.arange(BUDGET)[None].repeat(len(documents), axis=0)
        stored = read_rows(agents.state.buffer, rows, agents.state.observation.shape[-1])
        met = [np.asarray(x).swapaxes(0, 1) for x in stored]
        return Life(*met[:4], log)
    parts = []
    for end in (32, 64):
        log = agents.advance(end)
        steps = agents.state.steps
        met = (steps.observation, steps.action, steps.last_observation, steps.reward)
        parts.append([*(np.asarray(x).swapaxes(0, 1) for x in met), log])
    *columns, logs = zip(*parts, strict=True)
    log = StepLog.joined(logs)
    return Life(*map(np.concatenate, columns), log)


@pytest.mark.parametrize(
    ("algorithm", "stream"),
    [("TD3", SUDDEN), ("PPO", SUDDEN), ("PPO", CURRICULUM)],
    ids=["TD3-sudden", "PPO-sudden", "PPO-curriculum"],
)
def test_every_step_of_a_life_is_that_of_numpy_under_the_task_in_force(algorithm, stream):
    """From its observation on; also what is observed at a switch, and where an episode ends."""
    life = lived(algorithm, stream, stream)
    tasks, at_once = materialize_segments(stream), stream.switch == "step"
    one_hot = np.eye(len(stream.phases), dtype=np.float32)
    for run in range(2):
        t, waiting, most = np.zeros(1, np.int64), np.zeros((1, 1)), 0.0
        for n in range(BUDGET):
            piece, following = stream.times.segment_at(n), stream.times.segment_at(n + 1)
            task, s = tasks[piece], life.observation[n, run, :3].astype(float)[None]
            seen = observe(task.spec, s, t, waiting)[0]
            most = max(most, waiting[0, 0] / task.spec.k)
            phase = one_hot[stream.segments[piece].phase]
            np.testing.assert_allclose(life.observation[n, run], [*seen, *phase], atol=1e-6)
            action = (life.action[n, run].clip(-1, 1).astype(float)[None] + 1) / 2
            one = step(task, s, t, waiting, action)
            t, waiting = t + 1, one.accumulated_reward
            ends = one.terminated[0], one.truncated[0]
            assert ends == (life.log.terminated[n, run], life.log.truncated[n, run])
            reward = one.reward[0, 0]
            if at_once and not any(ends):
                reward += shaping_at_switch(task, tasks[following], one.state[0], int(t[0]))
            rewards = life.log.reward[n, run], life.reward[n, run]
            assert rewards == pytest.approx([reward] * 2, abs=1e-5)
            regret = life.log.regret[n, run], 1 - life.log.similarity[n, run]
            expected = 1 - one.step_reward[0, 0], 1 - one.similarity[0, 0]
            assert regret == pytest.approx(expected, abs=1e-5)
            last, goes_on = following if at_once else piece, not any(ends)
            if ends[1] or (goes_on and algorithm == "TD3"):  # others are no target of an update
                seen = observe(tasks[last].spec, one.state, t, waiting)[0]
                phase = one_hot[stream.segments[last].phase]
                np.testing.assert_allclose(
                    life.next_observation[n, run],
                    [*seen, *phase], atol=1e-6,
                )  # fmt: skip
            if not goes_on:
                t, waiting = np.zeros(1, np.int64), np.zeros((1, 1))
        if at_once:
            assert most > 1.0
            assert life.log.terminated[:, run].any()
            ends = life.log.truncated[[12, 24], run]
            assert ends.tolist() == [True, False]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_life_is_that_of_its_task_to_the_bit_until_a_task_differs(algorithm):
    """A field without effect makes another task, and no difference."""
    twin = BASE.derive(hidden_width=32)
    stream = stream_of((BASE, 9), (twin, 13), cycles=2, switch="step")
    one, other = program(algorithm, stream), program(algorithm, BASE)
    assert len({id(one.lives.at(lifetime)) for lifetime in range(22)}) == 2
    plain = []
    for end in (32, BUDGET):
        plain.append(other.advance(end))
        np.testing.assert_array_equal(one.advance(end).regret, plain[-1].regret)
        one.finish()
        other.finish()
        np.testing.assert_equal(one.save(), other.save())

    log = program(algorithm, stream_of((BASE, 9), (OTHERS[0], 50), switch="step")).advance(32)
    for mine, same in zip(log.rows(slice(9)), plain[0].rows(slice(9)), strict=True):
        np.testing.assert_array_equal(mine, same)
    assert (log.similarity[9:] != plain[0].similarity[9:]).all()


def test_ppo_bootstraps_from_what_is_observed_after_a_switch():
    """At the end of a rollout, r_cum/k of the next task; all else in the rollout is the same."""
    base = BASE.derive(D=0.0, k=50, horizon=100)
    after, weights = (base, base.derive(k=100)), []
    for spec in after:
        agents = program("PPO", stream_of((base, 32), (spec, 32), switch="step"))
        agents.advance(32)
        assert agents.state.episode.accumulated_reward[0] > 0
        shown = jax.vmap(observe_in_jax)(agents.state.episode, agents.params)
        agents.finish()
        weights.append(agents.weights(0)["value_net.weight"])
        agents.advance(64)
        np.testing.assert_array_equal(agents.state.steps.observation[:, 0], shown)
    assert (weights[0] != weights[1]).any()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("saved_at", [32, 40])
def test_a_restored_life_goes_on_with_the_same_bits(algorithm, saved_at):
    """Also where it was saved at a switch."""
    one, other = program(algorithm, SUDDEN, SUDDEN), program(algorithm, SUDDEN, SUDDEN)
    one.advance(saved_at)
    other.restore({name: array.copy() for name, array in one.save().items()})
    for mine, theirs in zip(one.advance(BUDGET), other.advance(BUDGET), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    one.finish()
    other.finish()
    np.testing.assert_equal(one.save(), other.save())


@cache
def cached_lives(*documents):
    return Lives(documents, jax.devices()[0])


def test_runs_may_be_on_other_tasks_but_switch_together():
    other = stream_of((OTHERS[0], 9), (BASE, 13), switch="step")
    same = stream_of((BASE, 9), (OTHERS[1], 13), switch="step")
    assert cached_lives(other, same).at(12).k.tolist() == [5, 3]


def test_a_phase_that_would_be_left_within_an_episode_is_refused_by_its_index():
    steady = BASE.derive(D=0.0)
    for phases, message in (
        ([(steady, 13), (BASE, 13)], r"^phases\.1\.spec: D=0\.02: must be 0, since agents in JAX"),
        (
            [(steady, 13), (steady, 14), (steady, 12)],
            r"^phases\.2: .* step 27 .* of horizon=13, since",
        ),
        ([(steady, 13), (steady, 14)], r"^phases\.1: .* step 27 of the cycle: must be a multiple"),
    ):
        with pytest.raises(SpecError, match=message):
            check_supported(stream_of(*phases, cycles=2))
    check_supported(stream_of((BASE, 8)))  # for ever

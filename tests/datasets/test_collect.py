"""Collecting: exact sizes, bits that do not depend on the batch, and transitions of the task."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import kstest

from sme_registry.datasets import DatasetRecipe, replay
from sme_registry.datasets.collect import collect, noise_task
from sme_registry.datasets.documents import parse_behaviour
from sme_registry.errors import (
    FingerprintMismatchError,
    OptionError,
    ResourceLimitError,
)
from sme_registry.evaluation.regions import expansion
from sme_registry.spec import SMESpec
from sme_registry.task import materialize
from sme_registry.task.draw import uniform

TEAM = {"agents": [{"action_dim": 1, "observes": [0, 2]}, {"action_dim": 3}]}
TASKS = {
    "the default": {},
    "sparse": {"k": 7, "horizon": 31},
    "fragile": {"D": 0.4, "r_min": 0.2, "k": 3},
    "deep": {"complexity": 10, "hidden_width": 16},
    "one step": {"horizon": 1},
    "a team": {"team": TEAM, "k": 4, "horizon": 9},
    "a fragile team": {"team": {**TEAM, "reward": "team"}, "D": 0.3},
    "limited": {"safety": {"tightness": 0.2}, "k": 4},
    "noisy": {"observation": {"distractors": 3}, "D": 0.3},
    "mixed": {"observation": {"mixing": "orthogonal"}},
    "shaped": {"shaping": {"scale": 30}, "noise": {"reward": 0.3, "transition": 0.1}, "D": 0.3},
    "compensated": {"safety": {"tightness": 0.2, "compensated": True}, "k": 4},
    "a noisy team": {"team": TEAM, "k": 4, "noise": {"reward": 0.3, "transition": 0.1}},
    "limited and distracted": {
        "safety": {"tightness": 0.1},
        "observation": {
            "distractors": 5, "dynamics": "autonomous", "mixing": "nonlinear", "mixing_depth": 2,
        },
        "horizon": 31,
    },
}  # fmt: skip
DRIVEN = {
    "safety": {"tightness": 0.2},
    "observation": {
        "distractors": 3, "dynamics": "driven", "mixing": "nonlinear", "mixing_depth": 1,
    },
}  # fmt: skip
HALVES = [(0.6, 0.5), ("random", 0.5)]


def recipe(spec=None, acting=((0.5, 1.0),), **fields):
    behaviours = [parse_behaviour(what, weight) for what, weight in acting]
    plain = {"spec": SMESpec.from_dict(spec or {}), "behaviours": behaviours, "transitions": 700}
    return DatasetRecipe.from_dict({**plain, **fields})


def collected(of, num_envs=None, policies=None):
    return collect(of, materialize(of.spec), policies, num_envs=num_envs)


@pytest.mark.parametrize("number", range(len(TASKS)), ids=list(TASKS))
def test_every_transition_is_that_of_the_task_whatever_the_size_of_the_batch(number):
    fields = list(TASKS.values())[number]
    of = recipe(fields, HALVES, coverage=-0.15 if number % 2 else None, seed=3)
    data = collected(of)
    for num_envs in (1, 7):
        assert collected(of, num_envs).digest == data.digest
    replay(data, of, materialize(of.spec))


def test_distractors_are_uniform_and_differ_between_episodes():
    data = collected(recipe({"observation": {"distractors": 4}}, transitions=5000))
    assert len(np.unique(data.distractors)) == data.distractors.size
    assert kstest(data.distractors.ravel(), "uniform").pvalue > 0.01


@pytest.mark.parametrize("count", [1, 99, 100, 101, 250])
def test_a_data_set_has_exactly_n_transitions_and_its_last_is_a_timeout(count):
    data = collected(recipe(transitions=count))
    assert {len(array) for array in data.columns().values()} == {count}
    assert data.timeouts[-1]
    assert not data.terminations.any()
    assert len(data.ends) == -(-count // 100)


def test_starts_alpha_and_noise_use_separate_streams_of_the_data_seed():
    of = recipe(seed=5, transitions=300)
    data, task = collected(of), materialize(of.spec)
    np.testing.assert_array_equal(data.states[0], uniform(5, "dataset/0/start", 8))
    alpha = 0.5 * uniform(5, "dataset/0/alpha", 100)[:, None]
    noise = noise_task(task, 5).optimal_action(data.states[:100])
    blended = (1 - alpha) * data.optimal_actions[:100] + alpha * noise
    np.testing.assert_allclose(data.actions[:100], blended, atol=1e-7)
    assert collected(of).digest == data.digest
    other = collected(recipe(seed=6, transitions=300))
    assert not np.isin(data.states[::100, 0], other.states[:, 0]).any()


def test_random_actions_are_uniform_and_drawn_at_every_step():
    data = collected(recipe(acting=[("random", 1.0)], transitions=5_000))
    assert len(np.unique(data.actions)) > 19_000
    assert abs(data.actions.mean(axis=0) - 0.5).max() < 5 / np.sqrt(12 * 5_000)


def test_behaviours_have_their_shares_of_the_transitions_in_whole_episodes():
    data = collected(recipe(acting=[(0.0, 0.25), (1.0, 0.5), ("random", 0.25)], transitions=2_000))
    assert np.bincount(data.components).tolist() == [500, 1000, 500]
    means = [data.similarities[data.components == part].mean() for part in range(3)]
    assert means[0] > means[1] > means[2]
    for number in range(data.episodes[-1] + 1):
        assert len(np.unique(data.components[data.episodes == number])) == 1


def test_a_sub_cube_keeps_only_its_states_and_ends_trajectories_that_leave_it():
    of = recipe({"state_dim": 2}, coverage=-0.4, transitions=2_000)
    data, whole = collected(of), collected(recipe({"state_dim": 2}, transitions=20_000))
    assert -0.41 < expansion(data.states).max() <= -0.4
    inside = expansion(whole.states) <= -0.4
    np.testing.assert_array_equal(data.states, whole.states[inside][:2_000])
    left = expansion(data.next_states) > -0.4
    assert (data.timeouts | ~left).all()
    assert left.any()
    assert collected(recipe(coverage=0.0)).digest == collected(recipe()).digest


@pytest.mark.parametrize("state_dim", [8, 200])  # 0.01²⁰⁰ is no positive float
def test_a_sub_cube_that_is_too_small_is_rejected_before_the_work(state_dim):
    with pytest.raises(OptionError, match=r"coverage=-0\.99: 700 transitions need about"):
        collected(recipe({"state_dim": state_dim}, coverage=-0.99))


def test_a_data_set_larger_than_memory_is_rejected():
    with pytest.raises(ResourceLimitError, match="transitions=1000000000"):
        collected(recipe(transitions=10**9))


def test_a_users_policy_gives_the_same_bits_for_any_size_of_the_batch():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(10, 64), torch.nn.Tanh(), torch.nn.Linear(64, 4))

    def act(observations):
        with torch.no_grad():
            return net(torch.as_tensor(observations)).numpy()

    of = recipe({"horizon": 10}, acting=[(act, 1.0)], transitions=150)
    data = collected(of, policies={0: act})
    for num_envs in (1, 100):
        assert collected(of, num_envs, {0: act}).digest == data.digest
    replay(data, of, materialize(of.spec))
    np.testing.assert_allclose(data.actions, np.clip(act(data.observations), 0, 1), atol=1e-6)


def test_a_teams_agents_act_on_their_own_observations():
    spec = {"team": TEAM, "k": 4, "horizon": 9}
    seen = {}

    def one(observations):
        seen["one"] = observations.shape[1]
        return observations[:, :1]

    def two(observations):
        seen["two"] = observations.shape[1]
        return observations[:, -3:]

    policies = {0: {"agent_0": one, "agent_1": two}}
    of = DatasetRecipe.from_dict(
        {
            "spec": SMESpec.from_dict(spec),
            "behaviours": [{"kind": "policy", "policy": "team"}],
            "transitions": 90,
        }
    )
    data = collected(of, policies=policies)
    assert seen == {"one": 4, "two": 10}
    np.testing.assert_array_equal(data.actions[:, 0], data.observations[:, 0])
    # The last thing that agent 1 sees is its own r_cum/k, not its colleague's.
    np.testing.assert_array_equal(data.actions[:, -1], data.observations[:, 10])
    assert (data.observations[:, 9] != data.observations[:, 10]).any()
    replay(data, of, materialize(of.spec))


@pytest.fixture(scope="module")
def driven():
    of = recipe(DRIVEN, transitions=300)
    return of, collected(of), materialize(of.spec)


@pytest.mark.parametrize("row", [0, 150, 299])
def test_replay_detects_a_change_in_any_array_and_row(driven, row):
    of, data, task = driven
    arrays = set(data.columns()) - {"components"}
    assert len(arrays) == 19
    for array in arrays:
        changed = getattr(data, array).copy()
        one = changed[row : row + 1]
        one[...] = ~one if changed.dtype == bool else one + (1 if changed.dtype == int else 1e-4)
        faulty = dataclasses.replace(data, **{array: changed})
        with pytest.raises(FingerprintMismatchError, match=r"row \d+"):
            replay(faulty, of, task)
    shifted = dataclasses.replace(data, actions=np.roll(data.actions, 1, axis=0))
    with pytest.raises(FingerprintMismatchError, match="row 0"):
        replay(shifted, of, task)


def test_replay_compares_the_time_beside_a_mixing_to_the_bit(driven):
    of, data, task = driven
    assert task.mixing
    observations = data.observations.copy()
    observations[0, -2] = np.nextafter(observations[0, -2], np.float32(1))
    with pytest.raises(FingerprintMismatchError, match="observations, row 0"):
        replay(dataclasses.replace(data, observations=observations), of, task)


def test_the_noise_policy_has_the_shapes_of_the_optimal_one_and_other_numbers():
    for fields in TASKS.values():
        task = materialize(SMESpec.from_dict(fields))
        noise = noise_task(task, 0)  # the task's own seed, too, is 0
        for optimal, other in zip(task.policies, noise.policies, strict=True):
            for layer, drawn in zip(optimal, other, strict=True):
                assert layer.W.shape == drawn.W.shape
                assert np.abs(layer.W - drawn.W).max() > 0.1
        np.testing.assert_array_equal(task.W, noise.W)

"""Every engine is the definition: states bit for bit, oracle and rewards to 1e-12."""

import itertools
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize, observe, step
from sme_registry.task.engine import chosen_backend, engine
from tests.compiled.stepping import Lane, step_batch
from tests.strategies import specs

BACKENDS = ["numba", "numpy"]
EXACT = ["state", "observation", "terminated", "truncated"]
CLOSE = ["optimal_action", "similarity", "step_reward", "reward", "accumulated_reward"]
DEEP = SMESpec(complexity=50, state_dim=5, action_dim=3, horizon=200)
WIDE = SMESpec(state_dim=33, action_dim=17, complexity=3, hidden_width=70)
TEAM = SMESpec(
    complexity=3, state_dim=5, action_dim=6, k=3, horizon=40,
    team={"agents": [
        {"action_dim": 1, "observes": [4]},
        {"action_dim": 3},
        {"action_dim": 2, "observes": [0, 2]},
    ]},
)  # fmt: skip
SHARED = TEAM.derive(D=0.2, r_min=0.1, team={**TEAM.to_dict()["team"], "reward": "team"})

PARTIAL = SMESpec(
    state_dim=5, action_dim=1, team={"agents": [{"action_dim": 1, "observes": [0, 1, 2, 3]}]}
)


@pytest.fixture(autouse=True)
def _needs_numba(request):
    if "numba" in request.node.name:
        pytest.importorskip("numba")


def near_optimal(task, s, random):
    """Actions from the optimum to far beyond the range, so that every branch is taken."""
    best = task.policy(s[:, None, :])[:, 0, :]
    far = random.random((len(s), 1)) ** 3 * 1.5
    return best + far * (random.random(best.shape) - 0.5)


def assert_same(ours, its, names, tolerance=0.0):
    for name in names:
        np.testing.assert_allclose(
            getattr(ours, name), getattr(its, name), rtol=0, atol=tolerance, err_msg=name
        )


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=20)
@given(spec=specs(team=False, plain=True), seed=st.integers(0, 100))
@example(DEEP, 0)
@example(WIDE, 0)
def test_fifty_steps_follow_the_definition(backend, spec, seed):
    task, random = materialize(spec), np.random.default_rng(seed)
    made, s = engine(task, backend), random.random((2, spec.state_dim))
    lanes = [Lane(task, made, row) for row in s]
    r_cum = np.zeros((2, 1))
    for t in range(50):
        a = near_optimal(task, s, random)
        if t % 2:
            a = a.astype(np.float32).astype(np.float64)
        # Bits of the oracle differ by rounding, which the gates of the reward may magnify: the
        # definition goes on from the engine's own r_cum, as a teacher.
        done = step(task, s, np.full(2, t), r_cum, a)
        seen = observe(spec, done.state, np.full(2, t + 1), done.accumulated_reward)
        taken = a.astype(np.float32) if t % 2 else a
        steps = [lane.step(row) for lane, row in zip(lanes, taken, strict=True)]
        for i, single in enumerate(steps):
            np.testing.assert_array_equal(single.state, done.state[i])
            np.testing.assert_array_equal(single.observation[:-1], seen[i, :-1])
            np.testing.assert_allclose(single.optimal_action, done.optimal_action[i], atol=1e-12)
            assert abs(single.similarity - done.similarity[i, 0]) < 1e-12
            assert single.truncated == done.truncated[i]
            assert single.regret == 1.0 - single.step_reward
            edges = np.abs(done.step_reward[i, 0] - np.array([spec.r_min, spec.D]))
            if edges.min() > 1e-11 and (done.step_reward[i, 0] or spec.r_min == 0.0):
                assert abs(single.step_reward - done.step_reward[i, 0]) < 1e-11
                assert abs(single.reward - done.reward[i, 0]) < 1e-11
                assert single.terminated == done.terminated[i]
        s, r_cum = done.state, np.array([[single.accumulated_reward] for single in steps])


def clear_of_the_gates(task, a, plain):
    """`[B, n]`: where a rounding of the oracle cannot move a reward across r_min or D."""
    paid_for = plain.similarity
    if task.pays_the_team:
        team = task.similarity_of(np.clip(a, 0.0, 1.0), plain.optimal_action)
        paid_for = np.broadcast_to(team[:, None], paid_for.shape)
    graded = 4.0 * (paid_for - 0.75)
    spec = task.spec
    return (np.abs(graded - spec.r_min) > 1e-11) & (np.abs(graded - spec.D) > 1e-11)


def assert_follows(task, a, ours, definition):
    """A batch's step is the definition's: `[B, …]` arrays of both."""
    assert_same(ours, definition, ["state", "truncated"])
    assert_same(ours, definition, ["optimal_action", "similarity"], 1e-12)
    clear = clear_of_the_gates(task, a, definition)
    for name in ("step_reward", "reward", "accumulated_reward"):
        one, other = getattr(ours, name)[clear], getattr(definition, name)[clear]
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11, err_msg=name)
    np.testing.assert_array_equal(ours.regret, 1.0 - ours.step_reward)
    lanes = clear.all(axis=1)
    np.testing.assert_array_equal(ours.terminated[lanes], definition.terminated[lanes])


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=20)
@given(spec=specs(team=True, plain=True), seed=st.integers(0, 100))
@example(TEAM, 0)
@example(SHARED, 0)
def test_fifty_steps_of_teams_follow_the_definition(backend, spec, seed):
    task, random, B = materialize(spec), np.random.default_rng(seed), 3
    made, s = engine(task, backend), random.random((B, spec.state_dim))
    r_cum = np.zeros((B, len(task.names)))
    for steps in range(50):
        a, t = near_optimal(task, s, random), np.full(B, steps)
        done = step(task, s, t, r_cum, a)
        ours = step_batch(task, made, s, t, r_cum, a)
        assert_follows(task, a, ours, done)
        seen = observe(spec, ours.state, t + 1, ours.accumulated_reward)
        np.testing.assert_array_equal(ours.observation, seen)
        s, r_cum = done.state, np.array(ours.accumulated_reward)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=15)
@given(
    spec=specs(team=False, plain=True),
    B=st.sampled_from([1, 2, 63, 64, 65, 130]),
    seed=st.integers(0, 100),
)
@example(DEEP, 65, 0)
@example(WIDE, 67, 0)
def test_a_batch_is_its_singles_bit_for_bit(backend, spec, B, seed):
    task, random = materialize(spec), np.random.default_rng(seed)
    made, s = engine(task, backend), random.random((B, spec.state_dim))
    lanes = [Lane(task, made, row) for row in s]
    t, r_cum = np.zeros(B, np.int64), np.zeros((B, 1))
    for _ in range(3):
        a = near_optimal(task, s, random)
        whole = step_batch(task, made, s, t, r_cum, a)
        singles = [lane.step(row) for lane, row in zip(lanes, a, strict=True)]
        for name in [*EXACT, *CLOSE, "regret"]:
            expected = np.array([getattr(single, name) for single in singles])
            got = getattr(whole, name).reshape(expected.shape)
            np.testing.assert_array_equal(got, expected, err_msg=name)
        s, t, r_cum = np.ascontiguousarray(whole.state), t + 1, np.array(whole.accumulated_reward)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=15)
@given(
    spec=specs(team=True, plain=True),
    B=st.sampled_from([1, 2, 63, 64, 65, 130]),
    seed=st.integers(0, 100),
)
@example(PARTIAL, 2, 1)
@example(TEAM, 129, 0)
@example(SHARED, 65, 0)
def test_a_batch_of_teams_is_the_loop_of_its_lanes_bit_for_bit(backend, spec, B, seed):
    task, random = materialize(spec), np.random.default_rng(seed)
    made, s = engine(task, backend), random.random((B, spec.state_dim))
    t, r_cum = random.integers(0, spec.horizon, B), random.random((B, len(task.names)))
    a = near_optimal(task, s, random)
    whole = step_batch(task, made, s, t, r_cum, a)
    for i in range(B):
        lane = slice(i, i + 1)
        single = step_batch(task, made, s[lane], t[lane], r_cum[lane], a[lane])
        for name in [*EXACT, *CLOSE, "regret"]:
            got, expected = getattr(whole, name)[lane], getattr(single, name)
            np.testing.assert_array_equal(got, expected, err_msg=name)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("B", [0, 1, 300])
def test_the_oracle_of_any_number_of_states_is_the_definitions(backend, B):
    for spec in (DEEP, WIDE, TEAM):
        task = materialize(spec)
        s = np.random.default_rng(B).uniform(-0.5, 1.5, (B, spec.state_dim))
        found = engine(task, backend).optimal_action(s)
        assert found.shape == (B, spec.action_dim)
        np.testing.assert_allclose(found, task.optimal_action(s), rtol=0, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_action_that_is_not_finite_is_refused_and_nothing_moves(backend, dtype):
    for spec, bad in itertools.product((SMESpec(), WIDE), (np.nan, np.inf, -np.inf)):
        task = materialize(spec)
        lane = Lane(task, engine(task, backend), np.full(spec.state_dim, 0.3))
        lane.step(np.full(spec.action_dim, 0.5, dtype))
        before = lane.numbers.copy()
        for channel in (0, spec.action_dim - 1):
            action = np.full(spec.action_dim, 0.5, dtype)
            action[channel] = bad
            assert lane.step(action) is None
            np.testing.assert_array_equal(lane.numbers, before)
        assert lane.step(np.full(spec.action_dim, 0.5, dtype)) is not None


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_optimum_earns_exactly_one_in_the_engines_own_arithmetic(backend):
    for spec in (SMESpec(), DEEP, WIDE, TEAM, SHARED):
        task = materialize(spec)
        s, t = np.random.default_rng(0).random((5, spec.state_dim)), np.zeros(5, np.int64)
        made, r_cum = engine(task, backend), np.zeros((5, len(task.names)))
        first = step_batch(task, made, s, t, r_cum, np.zeros((5, spec.action_dim)))
        done = step_batch(task, made, s, t, r_cum, first.optimal_action)
        for name, best in (("similarity", 1.0), ("step_reward", 1.0), ("regret", 0.0)):
            np.testing.assert_array_equal(getattr(done, name), best)
        if len(task.names) == 1:
            lane = Lane(task, made, s[0]).step(first.optimal_action[0])
            assert (lane.similarity, lane.step_reward, lane.regret) == (1.0, 1.0, 0.0)


def test_the_back_end_is_chosen_by_the_environment_variable(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.delenv("SME_BACKEND", raising=False)
    assert chosen_backend() == "numba"
    for asked, chosen in [("auto", "numba"), ("numba", "numba"), ("numpy", "numpy")]:
        monkeypatch.setenv("SME_BACKEND", asked)
        assert chosen_backend() == chosen
        assert engine(materialize(SMESpec())).backend == chosen
    monkeypatch.setenv("SME_BACKEND", "jax")
    with pytest.raises(OptionError, match="SME_BACKEND='jax': must be 'auto', 'numba' or 'numpy'"):
        chosen_backend()
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setenv("SME_BACKEND", "auto")
    assert chosen_backend() == "numpy"
    monkeypatch.setenv("SME_BACKEND", "numba")
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[fast\]"):
        chosen_backend()

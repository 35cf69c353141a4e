"""Every engine is the definition for teams: states bit for bit, oracle and rewards to 1e-12.

Of single agents `tests/envs/test_safety_observation.py` says so, step by step.
"""

import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize, observe, step
from sme_registry.task.engine import chosen_backend, engine
from tests.compiled.stepping import step_batch
from tests.strategies import specs

BACKENDS = ["numba", "numpy"]
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
@pytest.mark.parametrize("B", [0, 1, 300])
def test_the_oracle_of_any_number_of_states_is_the_definitions(backend, B):
    for spec in (DEEP, WIDE, TEAM):
        task = materialize(spec)
        s = np.random.default_rng(B).uniform(-0.5, 1.5, (B, spec.state_dim))
        found = engine(task, backend).optimal_action(s)
        assert found.shape == (B, spec.action_dim)
        np.testing.assert_allclose(found, task.optimal_action(s), rtol=0, atol=1e-12)


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

"""Distractors, what agents see of them, and costs, against the NumPy definition step by step."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.errors import OptionError, SpecError, StateError
from sme_registry.jax import env
from sme_registry.jax import task as functions
from sme_registry.jax.gymnax import Environment
from sme_registry.jax.task import task_params

STEPS, M = 9, 4
MIXINGS = {
    "none": {},
    "orthogonal": {"mixing": "orthogonal"},
    "nonlinear": {"mixing": "nonlinear", "mixing_depth": 2},
}

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def two_tasks(observation):
    base = {"state_dim": 3, "action_dim": 2, "horizon": 4, "k": 2, "safety": {"tightness": 0.3}}
    return [SMESpec.from_dict({**base, "observation": observation, "seed": i}) for i in range(2)]


@jax.jit
def rollout(params, keys, actions):
    """All steps of all tasks: states before, the random numbers, and what `step` returns."""

    def advance(state, inputs):
        keys, actions = inputs
        numbers = jax.vmap(functions.random_numbers)(keys, params).distractors
        observation, after, *others = jax.vmap(env.step)(keys, state, actions, params)
        return after, (state, numbers, observation, after, *others)

    _, state = jax.vmap(env.reset)(keys[0], params)
    return jax.lax.scan(advance, state, (keys[1:], actions))[1]


def inputs(specs):
    actions = np.random.default_rng(0).uniform(-0.2, 1.2, (STEPS, len(specs), 2))
    return jax.random.split(jax.random.key(0), (STEPS + 1, len(specs))), actions.astype(np.float32)


@pytest.mark.parametrize(
    ("dynamics", "mixing"),
    [
        ("noise", "none"),
        ("autonomous", "orthogonal"),
        ("driven", "nonlinear"),
        (None, "orthogonal"),
        (None, "nonlinear"),
    ],
)
def test_a_batch_steps_as_in_numpy(dynamics, mixing):
    m = 0 if dynamics is None else M
    specs = two_tasks({"distractors": m, "dynamics": dynamics, **MIXINGS[mixing]})
    params = task_params(specs)
    run = rollout(params, *inputs(specs))
    check_steps(specs, run)
    # The tasks without limits and distractors have the same episodes.
    plain = task_params([spec.derive(safety=None, observation=None) for spec in specs])
    same = rollout(plain, *inputs(specs))
    assert (same[3].s == run[3].s).all()
    assert (same[4] == run[4]).all()
    for name in ("similarity", "step_reward", "terminated", "truncated"):
        assert (same[6][name] == run[6][name]).all()


def check_steps(specs, run, tolerance=1e-12):
    _, a = inputs(specs)
    before, numbers, observed, after, _, done, info = jax.tree.map(np.asarray, run)
    assert done.sum() == 2 * len(specs)
    for row, spec in enumerate(specs):
        task, m, dynamics = materialize(spec), spec.distractors, spec.observation.dynamics
        for i in range(STEPS):
            s, t = before.s[i, row], int(before.t[i, row])
            u = a[i, row].astype(float)
            np.testing.assert_allclose(info["cost"][i, row], task.cost(s, u), atol=tolerance)
            safe = task.step_reward(s, task.safe_action(s)) - task.step_reward(s, u)
            np.testing.assert_allclose(info["safe_regret"][i, row], safe, atol=4 * tolerance)
            d = None
            if m:
                moved = before.distractors[i, row]
                if dynamics == "noise":
                    d = numbers[i, row]
                else:
                    driven = dynamics == "driven"
                    d = task.distractor_step(moved, u if driven else numbers[i, row])
                if not done[i, row]:
                    assert (after.distractors[i, row] == d).all()
            seen = task.seen(task.transition(s, u), d)
            final = info["final_observation"][i, row]
            np.testing.assert_allclose(final[:-2], seen, rtol=6e-8, atol=2 * tolerance)
            assert final[-2] == np.float32((t + 1) / 4)
            d = after.distractors[i, row] if m else None
            seen = task.seen(after.s[i, row], d)
            np.testing.assert_allclose(observed[i, row, :-2], seen, rtol=6e-8, atol=2 * tolerance)


@pytest.mark.parametrize(
    ("complexity", "dtype", "tolerance"),
    [(1, jnp.float64, 1e-12), (3, jnp.float32, 1e-5)],
)
def test_limits_and_costs_equal_numpys(complexity, dtype, tolerance):
    spec = SMESpec.from_dict(
        {"complexity": complexity, "hidden_width": 5, "safety": {"tightness": 0.2}, "r_min": 0.1}
    )
    params, task = task_params(spec, dtype=dtype), materialize(spec)
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-0.5, 1.5, (64, 8)), rng.uniform(-0.2, 1.2, (64, 4))
    limit = jax.jit(functions.limit)(params, s)
    np.testing.assert_allclose(limit, task.limit(s), rtol=0, atol=tolerance)
    judged = jax.jit(functions.judge)(params, s, a)
    np.testing.assert_allclose(judged.cost, task.cost(s, a), rtol=0, atol=tolerance)
    assert np.asarray(judged.cost).max() > 0.1
    safe = task.step_reward(s, task.safe_action(s)) - task.step_reward(s, a)
    np.testing.assert_allclose(judged.safe_regret, safe, rtol=0, atol=4 * tolerance)
    with pytest.raises(SpecError, match=r"^limit: this task has no safety"):
        functions.limit(task_params(SMESpec()), s)
    with pytest.raises(SpecError, match=r"^limit: this task has no safety"):
        functions.cost(task_params(SMESpec()), a, a)


def test_distractors_of_starts_and_noise_are_uniform_and_new():
    spec = SMESpec.from_dict({"observation": {"distractors": 2}})
    keys, params = jax.random.split(jax.random.key(0), 4096), task_params(spec)

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def draw(key, params):
        own = (
            functions.first_distractors(key, params),
            functions.random_numbers(key, params).distractors,
        )
        return env.reset(key, params)[1].s, *own

    columns = np.concatenate(draw(keys, params), axis=1)
    quarters = np.stack([np.histogram(column, 4, (0, 1))[0] for column in columns.T])
    assert abs(quarters - 1024).max() < 5 * np.sqrt(4096 * 3 / 16)
    assert abs(np.corrcoef(columns.T) - np.eye(12)).max() < 5 / np.sqrt(4096)


def test_an_episode_begins_with_any_distractors():
    spec = two_tasks({"distractors": M})[0]
    params = task_params(spec)
    s, d = np.full(3, 0.25), np.full(M, 0.75)
    observation, state = jax.jit(env.start)(s, params, d)
    assert observation.tolist() == [0.25] * 3 + [0.75] * M + [0.0, 0.0]
    for wrong in (None, jnp.zeros(3)):
        with pytest.raises(StateError, match=r"^distractors .*: must be of shape \(4,\), since"):
            env.start(s, params, wrong)
    with pytest.raises(StateError, match=r"^distractors left out: must be of shape \(4,\)"):
        env.step(jax.random.key(0), state._replace(distractors=None), jnp.zeros(2), params)
    with pytest.raises(StateError, match=r"^distractors of shape \(3,\): must be left out"):
        env.start(jnp.zeros(8), task_params(SMESpec()), s)

    environment = Environment(spec)  # gymnax's
    observation, state = environment.reset(jax.random.key(0))
    assert observation.shape == environment.observation_space().shape == (3 + M + 2,)
    info = environment.step(jax.random.key(1), state, jnp.ones(2))[-1]
    assert 0.0 <= info["cost"] <= 1.0


def test_tasks_of_other_forms_share_no_program():
    specs = two_tasks({"distractors": M})
    for other, message in (
        (specs[0].derive(safety=None), "safety=False: must have True"),
        (two_tasks({"distractors": M + 1})[0], "distractors=5: must have 4"),
        (specs[0].derive(observation=None), "distractors=0: must have 4"),
    ):
        with pytest.raises(OptionError, match=rf"^specs\[1\]: has {message}"):
            task_params([specs[0], other])
    params = task_params([specs[0], specs[0].derive(safety={"tightness": 0.1})])
    assert params.limits is not None
    assert params.limits.tightness.tolist() == [0.3, 0.1]

"""Shaping, noise and prices, against the NumPy definition step by step."""

import jax
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.jax import env
from sme_registry.jax import task as functions
from sme_registry.jax.task import task_params
from sme_registry.task import step

STEPS, TASKS = 40, 2
SMALL = {"state_dim": 3, "action_dim": 2, "horizon": 3, "k": 2}
ON_TOP = {
    "shaping": {"scale": 30, "discount": 0.9},
    "noise": {"reward": 0.7, "transition": 0.3},
}

pytestmark = pytest.mark.usefixtures("quickly_compiled")


@jax.jit
def rollout(params, keys, actions):
    """All steps of all tasks: states before, the noise, and what `step` returns."""

    def advance(state, inputs):
        keys, actions = inputs
        noise = jax.vmap(functions.random_numbers)(keys, params).noise
        _, after, *others = jax.vmap(env.step)(keys, state, actions, params)
        return after, (state, noise, after, *others)

    _, state = jax.vmap(env.reset)(keys[0], params)
    return jax.lax.scan(advance, state, (keys[1:], actions))[1]


def check_steps(spec, row, a, run):
    """One task's steps; how many episodes end, by D and by the horizon."""
    before, noise, after, reward, done, info = run
    task, ends = materialize(spec), np.zeros(2, int)
    for i in range(STEPS):
        s, t, r_cum = (np.array([part[i, row]]) for part in before[:3])
        draws = None if noise is None else noise[i, [row]]
        one = step(task, s, t.astype(np.int64), r_cum[:, None], a[i, [row]].astype(float), draws)
        for name in ("step_reward", "price", "shaping", "reward_noise"):
            computed = info[name][i, row] if name in info else 0.0
            assert abs(computed - getattr(one, name)[0, 0]) <= 1e-12
        assert abs(reward[i, row] - one.reward[0, 0]) <= 1e-12
        ended = one.terminated[0], one.truncated[0]
        assert done[i, row] == any(ended)
        if done[i, row]:
            ends += ended
        else:
            assert (after.s[i, row] == one.state[0]).all()
            assert abs(after.accumulated_reward[i, row] - one.accumulated_reward[0, 0]) <= 1e-12
    return ends


@pytest.mark.parametrize(
    "fields",
    [
        {**ON_TOP, "safety": {"tightness": 0.3, "compensated": True}},
        {**ON_TOP, "D": 0.1},
        {"shaping": {"scale": 100}},
    ],
    ids=["compensated", "terminated", "shaped"],
)
def test_what_is_paid_on_top_and_the_moves_of_noise_are_those_of_numpy(fields):
    specs = [SMESpec.from_dict({**SMALL, **fields, "seed": seed}) for seed in range(TASKS)]
    a = (0.5 + 0.2 * np.random.default_rng(0).standard_normal((STEPS, TASKS, 2))).astype(np.float32)
    keys = jax.random.split(jax.random.key(0), (STEPS + 1, TASKS))
    run = jax.tree.map(np.asarray, rollout(task_params(specs), keys, a))
    ends = sum(check_steps(spec, row, a, run) for row, spec in enumerate(specs))
    assert ends[1] > 0
    assert (ends[0] > 0) == ("D" in fields)


def test_the_noise_of_a_step_is_standard_normal_and_of_float32():
    params = task_params(SMESpec(state_dim=3, noise={"reward": 1, "transition": 1}))
    keys = jax.random.split(jax.random.key(0), 4096)
    draw = jax.jit(jax.vmap(lambda key: functions.random_numbers(key, params).noise))
    noise = np.asarray(draw(keys))
    assert noise.shape == (4096, 4)
    assert (noise == noise.astype(np.float32)).all()
    assert abs(noise.mean(axis=0)).max() < 5 / np.sqrt(4096)
    assert abs(noise.std(axis=0) - 1).max() < 5 / np.sqrt(2 * 4096)
    assert abs(np.corrcoef(noise.T) - np.eye(4)).max() < 5 / np.sqrt(4096)

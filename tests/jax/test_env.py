"""Reset and step, against the NumPy definition, task by task."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.envs import arguments
from sme_registry.errors import ActionError, OptionError, SpecError, StateError
from sme_registry.jax import CACHE_VARIABLE, env, prepare
from sme_registry.jax import task as functions
from sme_registry.jax.task import task_params
from sme_registry.task import observe, step

STEPS = 70

SHALLOW = [
    SMESpec(seed=1, horizon=30),
    SMESpec(seed=2, k=7, r_min=0.3, horizon=30),
    SMESpec(seed=3, D=0.25, horizon=40),
    SMESpec(seed=4, k=4, D=0.3, r_min=0.1, horizon=6),
    SMESpec(seed=5, k=40, horizon=33),
]
DEEP = [
    SMESpec(seed=1, complexity=4, hidden_width=8, D=0.2, k=3, horizon=30),
    SMESpec(seed=2, complexity=4, hidden_width=8, horizon=50, k=3),
]


def two(**fields):
    """Tasks with shaping, of short episodes."""
    fields = {"horizon": 3, "k": 2, "shaping": {"scale": 30, "discount": 0.9}, **fields}
    return [SMESpec.from_dict({**fields, "seed": seed}) for seed in range(2)]


NOISE = {"reward": 0.7, "transition": 0.3}
KINDS = {
    "shallow": SHALLOW,
    "deep": DEEP,
    "shaped": two(),
    "noisy": two(noise=NOISE, D=0.1),
    "compensated": two(noise=NOISE, safety={"tightness": 0.3, "compensated": True}),
}


@jax.jit
def rollout(params, keys, actions):
    """All steps of environments with their own tasks, with their noise: `[STEPS, tasks, …]`."""

    def advance(state, inputs):
        keys, actions = inputs
        noise = jax.vmap(functions.random_numbers)(keys, params).noise
        observation, after, *others = jax.vmap(env.step)(keys, state, actions, params)
        return after, (state, noise, observation, after, *others)

    observation, state = jax.vmap(env.reset)(keys[0], params)
    return observation, jax.lax.scan(advance, state, (keys[1:], actions))[1]


def near_optimal(specs):
    """Actions near ½, of which some earn and some end episodes."""
    rng = np.random.default_rng(0)
    return (0.5 + 0.2 * rng.standard_normal((STEPS, len(specs), 4))).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_tasks_steps_as_in_numpy(kind):
    specs = KINDS[kind]
    keys = jax.random.split(jax.random.key(0), (STEPS + 1, len(specs)))
    a = near_optimal(specs)
    run = jax.tree.map(np.asarray, rollout(task_params(specs), keys, a))
    first, (before, noise, observed, after, reward, done, info) = run
    old, new = before.s, after.s
    ends = np.zeros(2, int)
    for row, spec in enumerate(specs):
        task = materialize(spec)
        s, t, accumulated = old[:1, row], np.zeros(1, np.int64), np.zeros((1, 1))
        assert (first[row] == observe(spec, s, t, accumulated)[0]).all()
        for i in range(STEPS):
            draws = None if noise is None else noise[i, [row]]
            one = step(task, s, t, accumulated, a[i, [row]].astype(float), draws)
            t += 1
            assert abs(info["similarity"][i, row] - one.similarity[0, 0]) <= 1e-12
            for name in ("step_reward", "price", "shaping", "reward_noise"):
                computed = info[name][i, row] if name in info else 0.0
                assert abs(computed - getattr(one, name)[0, 0]) <= 1e-12
            assert info["regret"][i, row] == 1 - info["step_reward"][i, row]
            assert abs(reward[i, row] - one.reward[0, 0]) <= 1e-12
            assert info["terminated"][i, row] == one.terminated[0]
            assert info["truncated"][i, row] == one.truncated[0]
            seen = observe(spec, one.state, t, one.accumulated_reward)[0]
            final = info["final_observation"][i, row]
            assert (final[:-1] == seen[:-1]).all()
            assert abs(final[-1] - seen[-1]) <= 6e-8
            s, accumulated = one.state, one.accumulated_reward
            assert done[i, row] == (one.terminated[0] or one.truncated[0])
            if done[i, row]:
                ends += [one.terminated[0], one.truncated[0]]
                s, t, accumulated = new[i, [row]], np.zeros(1, np.int64), np.zeros((1, 1))
                assert 0.0 <= s.min() <= s.max() < 1.0
                seen = observe(spec, s, t, accumulated)[0]
                assert (observed[i, row] == seen).all()
            assert (new[i, row] == s[0]).all()
            assert after.t[i, row] == t[0]
            assert abs(after.accumulated_reward[i, row] - accumulated[0, 0]) <= 1e-12
    assert ends[1] > 0
    assert (ends[0] > 0) == any(spec.D > 0 for spec in specs)


def test_a_step_without_a_batch_equals_that_in_a_batch():
    """Starts are drawn in a batch only if an episode ended in it."""
    params = task_params(SMESpec(horizon=2))
    keys = jax.random.split(jax.random.key(0), 3)
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    states = jax.tree.map(np.asarray, states._replace(t=np.array([0, 1, 0], np.int32)))
    actions = np.full((3, 4), 0.5)
    batch = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, states, actions, params)
    for row in range(3):
        state = jax.tree.map(lambda part, row=row: part[row], states)
        single = jax.jit(env.step)(keys[row], state, actions[row], params)
        for one, many in zip(jax.tree.leaves(single), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(one, many[row], rtol=0, atol=1e-15)


def test_starts_are_uniform():
    keys = jax.random.split(jax.random.key(0), 4096)
    draw = jax.jit(jax.vmap(env.reset, (0, None)))
    starts = np.asarray(draw(keys, task_params(SMESpec(state_dim=3)))[1].s)
    quarters = np.stack([np.histogram(column, 4, (0, 1))[0] for column in starts.T])
    assert abs(quarters - 1024).max() < 5 * np.sqrt(4096 * 3 / 16)
    assert abs(np.corrcoef(starts.T) - np.eye(3)).max() < 5 / np.sqrt(4096)


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


def test_arrays_of_other_shapes_are_refused_before_a_step():
    params = task_params(SMESpec(state_dim=3, action_dim=2))
    several = task_params([SMESpec(state_dim=3, action_dim=2)] * 4)
    key = jax.random.key(0)
    observation, state = env.start(jnp.full(3, 0.25), params)
    assert observation.tolist() == [0.25] * 3 + [0.0, 0.0]
    assert (state.t, state.accumulated_reward) == (0, 0.0)
    for action in (jnp.zeros(3), jnp.zeros((5, 2)), 0.5):
        with pytest.raises(
            ActionError, match=r"^action of shape .*: must be of shape \(2,\)\. Use"
        ):
            env.step(key, state, action, params)
    wide = state._replace(s=jnp.zeros(4))
    with pytest.raises(StateError, match=r"^state of shape \(4,\): must be of shape \(3,\)"):
        jax.jit(env.step)(key, wide, jnp.zeros(2), params)
    for call in (
        lambda: env.reset(key, several),
        lambda: env.step(key, state, jnp.zeros(2), several),
    ):
        with pytest.raises(OptionError, match=r"^params: are of 4 tasks: must be of one\. Use"):
            call()


def test_observations_of_one_task_have_the_bits_of_numpys():
    """XLA would turn the division by their common horizon into a product, an ulp off."""
    spec = SMESpec(k=2)
    t = np.arange(spec.horizon + 1)
    s = np.random.default_rng(0).random((t.size, 8))
    params = task_params(spec)
    state = env.EnvState(s, t.astype(np.int32), np.full(t.size, 0.3))
    computed = jax.jit(jax.vmap(env.observe, (0, None)))(state, params)
    expected = observe(spec, s, t, np.full((t.size, 1), 0.3))
    assert (np.asarray(computed) == expected).all()


@pytest.mark.parametrize("symmetric", [True, False])
def test_actions_are_rescaled_with_the_bits_of_the_environments(symmetric):
    u = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 4)).astype(np.float32)
    u[0] = 1e-30, -1e-9, 1.0, -1.0
    expected = arguments.to_unit(u, u.shape, symmetric)
    assert (np.asarray(env.to_unit(jnp.asarray(u), symmetric)) == expected).all()
    single = env.to_unit(jnp.asarray(u), symmetric, jnp.float32)
    assert (np.asarray(single) == expected.astype(np.float32)).all()


def test_a_compile_cache_that_cannot_be_written_is_announced(tmp_path, monkeypatch, capsys):
    before = jax.config.jax_compilation_cache_dir
    (tmp_path / "file").write_text("")
    try:
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
        prepare()
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{tmp_path / 'file'} cannot be written" in line
        assert jax.config.jax_compilation_cache_dir == before
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "new" / "folder"))
        prepare()
        assert capsys.readouterr().err == ""
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "new" / "folder")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_one_task_has_the_numbers_of_its_draw():
    task = materialize(SMESpec(complexity=4, hidden_width=5, k=3, r_min=0.25, D=0.5, horizon=7))
    params = task_params(task.spec)
    assert (params.k, params.r_min, params.D, params.horizon) == (3, 0.25, 0.5, 7)
    assert (params.form.state_dim, params.action_dim) == (8, 4)
    assert params.inner is not None
    stacked = params.inner.stacked
    layers = [params.inner.first, *zip(stacked.W, stacked.b, strict=True), params.output]
    for computed, drawn in zip(
        [(params.W, params.b), *layers], [(task.W, task.b), *task.layers], strict=True
    ):
        assert (np.asarray(computed[0]) == drawn[0]).all()
        assert (np.asarray(computed[1]) == drawn[1]).all()


def test_dtypes_are_those_of_the_oracle_and_of_states():
    params = task_params(SMESpec(), dtype=jnp.float32)
    assert params.output.W.dtype == params.D.dtype == jnp.float32
    assert params.W.dtype == jnp.float64


def test_a_list_of_names_or_fields_has_an_axis_of_tasks():
    assert task_params(["SME/Default-v1", {"seed": 0}]).W.shape == (2, 4, 8)
    assert task_params([SMESpec()]).W.shape == (1, 4, 8)
    assert task_params(SMESpec()).W.shape == (4, 8)


TEAM = SMESpec.from_dict({"action_dim": 2, "team": {"agents": [{"action_dim": 1}] * 2}})


@pytest.mark.parametrize(
    ("specs", "options", "message"),
    [
        (
            [SMESpec(), SMESpec(state_dim=3)],
            {},
            r"^specs\[1\]: has state_dim=3: must have 8, as .* Make two programs\.",
        ),
        ([SMESpec(), SMESpec(complexity=2)], {}, r"^specs\[1\]: has complexity=2: must have 1"),
        ([], {}, r"specs=\[\]: must have at least one"),
        (SMESpec(), {"dtype": jnp.bfloat16}, r"dtype=.*: must be float64 or float32"),
        (TEAM, {}, r"^team=.*must be absent, since tasks in JAX have no team"),
    ],
)
def test_what_is_no_task_in_jax_is_refused_by_name(specs, options, message):
    with pytest.raises(SpecError if specs is TEAM else OptionError, match=message):
        task_params(specs, **options)

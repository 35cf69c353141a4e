"""States have the bits of NumPy's over whole episodes, in float64 and in pairs, padded or not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.jax import pairs
from sme_registry.jax.task import Shape, task_params
from sme_registry.jax.transition import next_state
from sme_registry.task import step

LANES, STEPS = 16, 99


def actions(rng, A):
    """Float32 actions `[STEPS, LANES, A]`: uniform, out of range, tiny, and on the boundary."""
    shape = (STEPS, LANES, A)
    uniform = rng.random(shape, np.float32)
    kinds = [uniform, 3.0 * uniform - 1.0, uniform**20, np.rint(2.0 * uniform) / 2.0]
    return np.choose(rng.integers(0, len(kinds), shape), kinds).astype(np.float32)


def numpy_states(spec, start, a):
    task, s = materialize(spec), start
    zeros, states = np.zeros((LANES, 1)), []
    for t in range(STEPS):
        s = step(task, s, np.full(LANES, t), zeros, a[t].astype(np.float64)).state
        states.append(s)
    return np.stack(states)


@pytest.mark.parametrize("states", ["float64", "pairs"])
@pytest.mark.parametrize(
    ("S", "A", "padded_S", "padded_A"),
    [(1, 1, 1, 1), (3, 16, 5, 18), (2, 40, 2, 40)],
)
def test_states_equal_numpys_over_whole_episodes(S, A, padded_S, padded_A, states):
    spec = SMESpec(state_dim=S, action_dim=A, seed=S)
    rng = np.random.default_rng(A)
    start, a = rng.random((LANES, S)), actions(rng, A)
    params = task_params(spec, shape=Shape(padded_S, padded_A, 1, 0), states=states)
    padded_start = np.pad(start, ((0, 0), (0, padded_S - S)))
    # What an agent does with padded channels changes nothing.
    padded_a = np.pad(a, ((0, 0), (0, 0), (0, padded_A - A)), constant_values=0.3)

    @jax.jit
    def rollout(s, a):
        def advance(s, a):
            s = jax.vmap(next_state, (None, 0, 0))(params, s, a)
            return s, s

        return jax.lax.scan(advance, s, a)[1]

    if states == "pairs":
        computed = pairs.to_float64(rollout(pairs.from_float64(padded_start), padded_a))
    else:
        computed = np.asarray(rollout(padded_start, padded_a))
    assert (computed[..., :S] == numpy_states(spec, start, a)).all()
    assert (computed[..., S:] == 0.0).all()


def test_many_states_move_alike_in_pairs():
    spec = SMESpec(state_dim=4, action_dim=3)
    rng = np.random.default_rng(0)
    s, a = rng.random((2**18, 4)), rng.random((2**18, 3), np.float32)
    s[::5] **= 8  # finer than the grid on which starts lie
    params = task_params(spec, states="pairs")
    computed = jax.jit(next_state)(params, pairs.from_float64(s), a)
    assert (pairs.to_float64(computed) == materialize(spec).transition(s, a)).all()


def test_float64_actions_are_rounded_as_in_numpy():
    spec = SMESpec()
    rng = np.random.default_rng(0)
    s, a = rng.random((64, 8)), rng.random((64, 4))
    computed = jax.jit(next_state)(task_params(spec), jnp.asarray(s), jnp.asarray(a))
    assert (np.asarray(computed) == materialize(spec).transition(s, a)).all()

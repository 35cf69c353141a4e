"""One SME as pure functions with gymnax's signatures; vmap them over lanes, with or without params.

    observation, state = reset(key, params)
    observation, state, reward, done, info = step(key, state, action, params)

The rules are those of `sme_registry.task.step`, for one agent. `S` state_dim, `A` action_dim, both
padded; `m` distractors. An observation is `[S + m + 2]` float32: s, or with `observation` M(s, d),
then t/T and r_cum/k.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from sme_registry.errors import ActionError, OptionError, StateError
from sme_registry.jax import observing, oracle
from sme_registry.jax.pairs import Pair
from sme_registry.jax.task import TaskParams
from sme_registry.jax.transition import States, from_words, next_state

Info = dict[str, jax.Array]

_OF_LANES = "Use jax.vmap for several environments."


class EnvState(NamedTuple):
    """An episode at one point: s `[S]`, completed steps, r_cum, and distractors `[m]` or None."""

    s: States
    t: jax.Array
    accumulated_reward: jax.Array
    distractors: States | None = None


def reset(key: jax.Array, params: TaskParams) -> tuple[jax.Array, EnvState]:
    """Begin an episode at a uniform state, on the grid 2⁻³².

    Neither padding nor `safety` nor `observation` changes the state that a key draws.
    """
    _, S = _widths(params)
    bits = jax.random.bits(key, (S,), jnp.uint32)
    bits = jnp.where(params.state_mask, bits, jnp.uint32(0))
    return start(from_words(bits, params), params, observing.first_distractors(key, params))


def start(
    s: States, params: TaskParams, distractors: States | None = None
) -> tuple[jax.Array, EnvState]:
    """Begin an episode at state s `[S]`, with distractors `[m]` where the task has them."""
    s, d = _as_states(s), None if distractors is None else _as_states(distractors)
    _check_state(s, params)
    _check_distractors(d, params)
    state = EnvState(s, jnp.zeros((), jnp.int32), jnp.zeros((), params.r_min.dtype), d)
    return observe(state, params), state


def step(
    key: jax.Array, state: EnvState, action: jax.Array, params: TaskParams
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
    """One step; where the episode ends, the observation and state are those of a new one.

    The action `[A]` is of the unit range, and clipped. The key draws the new episode's start, and
    what moves distractors at random. Returns the observation, the state, the reward R, done
    (terminated or truncated), and the info of `step_env` with the ended episode's
    `final_observation`.
    """
    last, after, reward, done, info = step_env(key, state, action, params)
    info["final_observation"] = last
    first, fresh = _reset_where(done, key, params)
    after = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after)
    return jnp.where(done, first, last), after, reward, done, info


def step_env(
    key: jax.Array, state: EnvState, action: jax.Array, params: TaskParams
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
    """`step` without a new episode at the end; only distractors of some tasks need the key.

    `info` has `similarity` r̃, `step_reward` r and `regret` 1 − r, `terminated` and `truncated`; of
    a task with `safety` also `cost` and `safe_regret`.
    """
    return advance(state, action, observing.drawn(key, params), params)


def advance(
    state: EnvState, action: jax.Array, numbers: States | None, params: TaskParams
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
    """`step_env` with the random numbers of `observing.drawn`: nothing in it is random."""
    action = jnp.asarray(action)
    _check_state(state.s, params)
    _check_distractors(state.distractors, params)
    A, _ = _widths(params)
    if action.shape != (A,):
        raise ActionError(f"action of shape {action.shape}: must be of shape ({A},). {_OF_LANES}")
    judged = oracle.judge(params, state.s, action)
    after = moved(state, action, numbers, params)

    total = state.accumulated_reward + judged.step_reward
    terminated, truncated = judged.step_reward < params.D, after.t >= params.horizon
    paid = truncated | (after.t % params.k == 0)
    after = after._replace(accumulated_reward=jnp.where(paid, 0.0, total))
    info = {
        **{name: each for name, each in judged._asdict().items() if each is not None},
        "regret": 1.0 - judged.step_reward,
        "terminated": terminated,
        "truncated": truncated,
    }
    reward = jnp.where(paid, total, 0.0)
    return observe(after, params), after, reward, terminated | truncated, info


def moved(
    state: EnvState, action: jax.Array, numbers: States | None, params: TaskParams
) -> EnvState:
    """The episode one step later, with r_cum as it was; see `advance`."""
    return state._replace(
        s=next_state(params, state.s, action),
        t=state.t + 1,
        distractors=observing.next_distractors(params, state.distractors, action, numbers),
    )


reset_env = reset
"""gymnax's name of the same."""


def _widths(params: TaskParams) -> tuple[int, int]:
    """A and S of one task."""
    if params.W.ndim != 2:
        raise OptionError(
            f"params: are of {len(params.W)} tasks: must be of one. Use jax.vmap over the tasks."
        )
    A, S = params.W.shape
    return A, S


def _as_states(s: States) -> States:
    return s if isinstance(s, Pair) else jnp.asarray(s, jnp.float64)


def _check_state(s: States, params: TaskParams) -> None:
    _, S = _widths(params)
    as_pairs = isinstance(params.b, Pair)
    if isinstance(s, Pair) != as_pairs:
        kind = "a Pair" if as_pairs else "float64"
        raise StateError(f"state of type {type(s).__name__}: must be {kind}, as the params' b is.")
    shape = s.high.shape if isinstance(s, Pair) else s.shape
    if shape != (S,):
        raise StateError(f"state of shape {shape}: must be of shape ({S},). {_OF_LANES}")


def _check_distractors(d: States | None, params: TaskParams) -> None:
    m, as_pairs = params.form.distractors, isinstance(params.b, Pair)
    if d is None and m == 0:
        return
    shape = None if d is None else d.high.shape if isinstance(d, Pair) else d.shape
    if m == 0 or shape != (m,) or isinstance(d, Pair) != as_pairs:
        must = f"of shape ({m},), {'a Pair' if as_pairs else 'float64'}" if m else "left out"
        raise StateError(
            f"distractors {'left out' if d is None else f'of shape {shape}'}: must be {must}, "
            f"since the task has {m} distractors."
        )


@custom_vmap
def _reset_where(done: jax.Array, key: jax.Array, params: TaskParams) -> tuple[jax.Array, EnvState]:
    """`reset`, or anything else where not done.

    Drawing a start costs a CPU more than all the rest of a step, so that a batch draws only if an
    episode ended in it. On a GPU the draw is cheaper than the branch.
    """
    return reset(key, params)


@_reset_where.def_vmap
def _reset_lanes_where(
    lanes: int, batched: Any, done: jax.Array, key: jax.Array, params: TaskParams
) -> tuple[Any, Any]:
    axes = jax.tree.map(lambda each: 0 if each else None, batched[1:])

    def draw(key: jax.Array, params: TaskParams) -> Any:
        return jax.vmap(reset, axes, axis_size=lanes)(key, params)

    shapes = jax.eval_shape(draw, key, params)

    def draw_if_any(key: jax.Array, params: TaskParams) -> Any:
        zeros = jax.tree.map(lambda each: jnp.zeros(each.shape, each.dtype), shapes)
        return lax.cond(done.any(), draw, lambda *_: zeros, key, params)

    drawn = lax.platform_dependent(key, params, cpu=draw_if_any, default=draw)
    return drawn, jax.tree.map(lambda _: True, shapes)


def observe(state: EnvState, params: TaskParams) -> jax.Array:
    """The observation (s, t/T, r_cum/k, phase), `[S + 2 + P]` float32.

    With `observation` it is (M(s, d), t/T, r_cum/k), `[S + m + 2]`.

    s, distractors and t/T have the bits of NumPy's; see `observing` for a mixing. P = 0 except in
    streams with `observes_phase`. r_cum/k is at most 1, also where r_cum was carried over from a
    task of a larger k.
    """
    x = observing.seen(params, state.s, state.distractors)
    real = jnp.float32 if isinstance(state.s, Pair) else jnp.float64
    # XLA turns a division by a constant, or by one scalar of all lanes, into a product, which is
    # an ulp off; max(t, T), which is T, is neither.
    t = state.t.astype(real)
    time = t / jnp.maximum(t, params.horizon.astype(real))
    accumulated = state.accumulated_reward.astype(real) / params.k.astype(real)
    rest = jnp.stack([time, jnp.minimum(accumulated, 1.0)]).astype(jnp.float32)
    return jnp.concatenate([x, rest, params.phase])


def to_unit(action: jax.Array, symmetric: bool, dtype: Any = jnp.float64) -> jax.Array:
    """Actions of an agent in the unit range, not clipped: a = (u + 1) / 2 of a symmetric range.

    In float64 for exact rewards. The transition rounds to float32, and gets the same bits from it.
    """
    action = action.astype(dtype)
    return (action + 1.0) / 2.0 if symmetric else action

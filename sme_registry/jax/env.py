"""One SME as pure functions with gymnax's signatures; vmap them, with or without the params.

    observation, state = reset(key, params)
    observation, state, reward, done, info = step(key, state, action, params)

The rules are those of `sme_registry.task.step`, for one agent. `S` state_dim, `A` action_dim; `m`
distractors. An observation is `[S + m + 2 + P]` float32: s, or with `observation` M(s, d), then
t/T and r_cum/k, and in some streams the one-hot of the phase.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from sme_registry.errors import ActionError, OptionError, StateError
from sme_registry.jax import task
from sme_registry.jax.task import StepDraws, TaskParams
from sme_registry.task.task import ON_TOP

Info = dict[str, jax.Array]

_NO_NUMBERS = StepDraws(None, None)
_ONE = "Use jax.vmap for several environments."


class EnvState(NamedTuple):
    """An episode at one point: s `[S]`, completed steps, r_cum, and distractors `[m]` or None."""

    s: jax.Array
    t: jax.Array
    accumulated_reward: jax.Array
    distractors: jax.Array | None = None


def reset(key: jax.Array, params: TaskParams) -> tuple[jax.Array, EnvState]:
    """Begin an episode at a uniform state, on the grid 2⁻³²; safety does not change it."""
    s = task.uniform_states(key, params.form.state_dim)
    return start(s, params, task.first_distractors(key, params))


def start(
    s: jax.Array, params: TaskParams, distractors: jax.Array | None = None
) -> tuple[jax.Array, EnvState]:
    """Begin an episode at state s `[S]`, with distractors `[m]` where the task has them."""
    d = None if distractors is None else jnp.asarray(distractors, jnp.float64)
    zero = jnp.zeros((), params.r_min.dtype)
    state = EnvState(jnp.asarray(s, jnp.float64), jnp.zeros((), jnp.int32), zero, d)
    _check_state(state, params)
    return observe(state, params), state


def step(
    key: jax.Array, state: EnvState, action: jax.Array, params: TaskParams
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
    """One step; where the episode ends, the observation and state are those of a new one.

    The action `[A]` is of the unit range, and clipped. Returns the observation, the state, the
    reward R, done (terminated or truncated), and the info of `step_env` with the ended episode's
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
    """`step` without a new episode at the end; only distractors and noise need the key.

    `info` has `similarity` r̃, `step_reward` r and `regret` 1 − r, `terminated` and `truncated`; of
    a task with `safety` also `cost` and `safe_regret`; and what is paid on top of R.
    """
    return advance(state, action, task.random_numbers(key, params), params)


reset_env = reset
"""gymnax's name of the same."""


def advance(
    state: EnvState, action: jax.Array, numbers: StepDraws | None, params: TaskParams
) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
    """`step_env` with the numbers of `task.random_numbers`: nothing in it is random."""
    action = jnp.asarray(action)
    _check_state(state, params)
    if action.shape != (params.form.action_dim,):
        raise ActionError(
            f"action of shape {action.shape}: must be of shape ({params.form.action_dim},). {_ONE}"
        )
    outcome = task.judge(params, state.s, action)
    numbers = numbers or _NO_NUMBERS
    after = moved(state, action, numbers, params)

    total = state.accumulated_reward + outcome.step_reward
    terminated, truncated = outcome.step_reward < params.D, after.t >= params.horizon
    paid = truncated | (after.t % params.k == 0)
    after = after._replace(accumulated_reward=jnp.where(paid, 0.0, total))
    info = {
        **{name: value for name, value in outcome._asdict().items() if value is not None},
        "regret": 1.0 - outcome.step_reward,
        "terminated": terminated,
        "truncated": truncated,
    }
    reward = jnp.where(paid, total, 0.0)
    if params.shaping is not None:
        later = params.shaping.discount * task.potential(params, after.s, after.t)
        later = jnp.where(terminated, 0.0, later)
        info["shaping"] = (later - task.potential(params, state.s, state.t)).astype(total.dtype)
    if params.sigmas is not None and numbers.noise is not None:
        info["reward_noise"] = (params.sigmas[0] * numbers.noise[0]).astype(total.dtype)
    for name in ON_TOP:
        reward = reward + info[name] if name in info else reward
    return observe(after, params), after, reward, terminated | truncated, info


@jax.jit
@jax.vmap
def shaping_at_switch(state: EnvState, before: TaskParams, after: TaskParams) -> jax.Array:
    """What the last reward of each run gains where its tasks switch within an episode, `[runs]`.

    See `sme_registry.task.task.shaping_at_switch`; an episode that has just begun gains nothing.
    """
    g = 1.0 if before.shaping is None else before.shaping.discount
    change = task.potential(after, state.s, state.t) - task.potential(before, state.s, state.t)
    return jnp.where(state.t > 0, g * change, 0.0)


def moved(
    state: EnvState, action: jax.Array, numbers: StepDraws | None, params: TaskParams
) -> EnvState:
    numbers = numbers or _NO_NUMBERS
    return state._replace(
        s=task.next_state(params, state.s, action, numbers.noise),
        t=state.t + 1,
        distractors=task.next_distractors(params, state.distractors, action, numbers.distractors),
    )


def observe(state: EnvState, params: TaskParams) -> jax.Array:
    """The observation of an episode at one point.

    s, distractors and t/T have the bits of NumPy's; r_cum/k is at most 1, also after a switch from
    a task of a larger k.
    """
    x = task.seen(params, state.s, state.distractors)
    # XLA turns a division by a constant, or by one scalar of all runs, into a product, which is
    # an ulp off; max(t, T), which is T, is neither.
    t = state.t.astype(jnp.float64)
    time = t / jnp.maximum(t, params.horizon.astype(jnp.float64))
    accumulated = state.accumulated_reward.astype(jnp.float64) / params.k.astype(jnp.float64)
    rest = jnp.stack([time, jnp.minimum(accumulated, 1.0)]).astype(jnp.float32)
    return jnp.concatenate([x, rest, params.phase])


def to_unit(action: jax.Array, symmetric: bool, dtype: Any = jnp.float64) -> jax.Array:
    """Actions in the unit range, not clipped: a = (u + 1) / 2 of a symmetric one, in float64."""
    action = action.astype(dtype)
    return (action + 1.0) / 2.0 if symmetric else action


def _check_state(state: EnvState, params: TaskParams) -> None:
    if params.W.ndim != 2:
        raise OptionError(
            f"params: are of {len(params.W)} tasks: must be of one. Use jax.vmap over the tasks."
        )
    S, m = params.form.state_dim, params.form.distractors
    if state.s.shape != (S,):
        raise StateError(f"state of shape {state.s.shape}: must be of shape ({S},). {_ONE}")
    shape = None if state.distractors is None else state.distractors.shape
    if shape != ((m,) if m else None):
        raise StateError(
            f"distractors {'left out' if shape is None else f'of shape {shape}'}: must be "
            f"{f'of shape ({m},)' if m else 'left out'}, since the task has {m} distractors."
        )


@custom_vmap
def _reset_where(done: jax.Array, key: jax.Array, params: TaskParams) -> tuple[jax.Array, EnvState]:
    """`reset`, or anything else where not done.

    Drawing a start costs a CPU more than all the rest of a step, so that a batch draws only if an
    episode ended in it. On a GPU the draw is cheaper than the branch.
    """
    return reset(key, params)


@_reset_where.def_vmap
def _reset_batch_where(
    size: int, batched: Any, done: jax.Array, key: jax.Array, params: TaskParams
) -> tuple[Any, Any]:
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[1:])

    def draw(key: jax.Array, params: TaskParams) -> Any:
        return jax.vmap(reset, axes, axis_size=size)(key, params)

    shapes = jax.eval_shape(draw, key, params)

    def draw_if_any(key: jax.Array, params: TaskParams) -> Any:
        zeros = jax.tree.map(lambda array: jnp.zeros(array.shape, array.dtype), shapes)
        return lax.cond(done.any(), draw, lambda *_: zeros, key, params)

    drawn = lax.platform_dependent(key, params, cpu=draw_if_any, default=draw)
    return drawn, jax.tree.map(lambda _: True, shapes)

"""The replay buffer of all lanes: one array, written in place at each step.

A row is one transition (s, a, s', R, done) as float32. The buffer is `[capacity, lanes, row]`: all
lanes take the same number of steps, so one step writes one slice, which XLA does in place. With
lanes first it would copy the whole buffer at each step.

As in Stable-Baselines3's `handle_timeout_termination`, an episode that reached its horizon is not
done: its last state has a value. And actions are stored in [−1, 1], whatever the action range.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Transitions(NamedTuple):
    """Transitions, in any batch shape.

    The action is in [−1, 1]; the next observation at an episode's end is its last one, not the next
    one's first; done is 1.0 where the episode terminated, 0.0 where it goes on or was truncated.
    """

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    reward: jax.Array
    done: jax.Array


def empty(capacity: int, lanes: int, observation_dim: int, action_dim: int) -> jax.Array:
    """A buffer `[capacity, lanes, row]`, float32, of zeros."""
    row = 2 * observation_dim + action_dim + 2
    return jnp.zeros((capacity, lanes, row), jnp.float32)


def write(
    buffer: jax.Array, row: jax.Array, transitions: Transitions, writes: jax.Array
) -> jax.Array:
    """Store one transition of each lane in a row, modulo the capacity; nothing if not `writes`."""
    parts = (*transitions[:3], transitions.reward[..., None], transitions.done[..., None])
    new = jnp.concatenate([part.astype(jnp.float32) for part in parts], axis=-1)
    row = row % buffer.shape[0]
    return buffer.at[row].set(jnp.where(writes, new, buffer[row]))


def rewrite_next(
    buffer: jax.Array, row: jax.Array, following: jax.Array, ended: jax.Array, phase: jax.Array
) -> jax.Array:
    """Store s' of a row again, `following` `[lanes, O]`, as it is observed after a switch of tasks.

    Where the episode `ended` there, s' stays as it was, but for the phase with which it ends.
    """
    row, end = row % buffer.shape[0], buffer.shape[-1] - 2
    begin = end - following.shape[-1]
    last = jnp.concatenate([buffer[row, :, begin : end - phase.shape[-1]], phase], axis=-1)
    return buffer.at[row, :, begin:end].set(jnp.where(ended[:, None], last, following))


def sample_rows(
    key: jax.Array, batch_size: int, written: int | jax.Array, capacity: int
) -> jax.Array:
    """A lane's batch `[batch]` of rows, uniform with replacement over those in the buffer."""
    return jax.random.randint(key, (batch_size,), 0, jnp.minimum(written, capacity))


def read(buffer: jax.Array, rows: jax.Array, observation_dim: int) -> Transitions:
    """The transitions `[lanes, batch]` in these rows `[lanes, batch]`."""
    drawn = buffer[rows, jnp.arange(buffer.shape[1])[:, None]]
    action_end = drawn.shape[-1] - observation_dim - 2
    parts = jnp.split(drawn, [observation_dim, action_end, action_end + observation_dim], axis=-1)
    observation, action, next_observation, rest = parts
    return Transitions(observation, action, next_observation, rest[..., 0], rest[..., 1])

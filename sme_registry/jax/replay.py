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

    Attributes:
      observation: `[..., O]`.
      action: `[..., A]` in [−1, 1]; 0 in padded channels.
      next_observation: `[..., O]`; at an episode's end its last one, not the next one's first.
      reward: `[...]` R, the payout.
      done: `[...]` 1.0 where the episode terminated, 0.0 where it goes on or was truncated.
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
    """Store s' of a row again, as it is observed after a switch to other tasks.

    Args:
      buffer: the buffer.
      row: modulo the capacity.
      following: `[lanes, O]` the present observation, which is s' where the episode goes on.
      ended: `[lanes]` whether the episode ended there; s' is then as it was, except for the phase.
      phase: `[lanes, P]` the phase's one-hot, with which an observation ends.
    """
    row, end = row % buffer.shape[0], buffer.shape[-1] - 2
    begin = end - following.shape[-1]
    last = jnp.concatenate([buffer[row, :, begin : end - phase.shape[-1]], phase], axis=-1)
    return buffer.at[row, :, begin:end].set(jnp.where(ended[:, None], last, following))


def sample_rows(
    key: jax.Array, batch_size: int, written: int | jax.Array, capacity: int
) -> jax.Array:
    """A lane's batch `[batch]` of rows, uniform and with replacement over those written so far.

    Args:
      key: of the lane and of this batch.
      batch_size: rows to draw.
      written: how many transitions the lane has stored, at least 1.
      capacity: of the buffer; older transitions are lost.
    """
    return jax.random.randint(key, (batch_size,), 0, jnp.minimum(written, capacity))


def read(buffer: jax.Array, rows: jax.Array, observation_dim: int) -> Transitions:
    """The transitions `[lanes, batch]` in these rows `[lanes, batch]`."""
    drawn = buffer[rows, jnp.arange(buffer.shape[1])[:, None]]
    action_end = drawn.shape[-1] - observation_dim - 2
    parts = jnp.split(drawn, [observation_dim, action_end, action_end + observation_dim], axis=-1)
    observation, action, next_observation, rest = parts
    return Transitions(observation, action, next_observation, rest[..., 0], rest[..., 1])

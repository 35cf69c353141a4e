"""`OffPolicyProgram`: what TD3 and SAC share: replay, and when they act and update.

One iteration of the compiled loop is [the update that is pending; a step of the environment], so
that an evaluation between two calls sees the weights before the update of the last step. Runs are
in lockstep, so what is due is a number of all runs, and its branch is a real one. The order is
that of Stable-Baselines3's `OffPolicyAlgorithm`, with n steps done:

    n > learning_starts and train_freq divides n:   gradient_steps updates
    n < learning_starts:                            a uniform action, else the policy's

The replay buffer is one array `[capacity, runs, row]`, so that one step writes one slice, in place.
With runs first, XLA would copy the whole buffer at each step. `A` action_dim, `B`
batch, `O` width of an observation; actions in [−1, 1], whatever the action range.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sme_registry.jax.env import EnvState, observe, reset, step, to_unit
from sme_registry.jax.networks import (
    Adam,
    AgentSettings,
    Count,
    CountFromZero,
    Share,
    Updates,
    Weights,
    network,
)
from sme_registry.jax.program import PIECE, Array, Program, StepLog
from sme_registry.jax.task import TaskParams


class OffPolicySettings(AgentSettings):
    buffer_size: Count = 1_000_000
    learning_starts: CountFromZero = 100
    batch_size: Count = 256
    tau: Share = 0.005
    gamma: Share = 0.99
    train_freq: Count = 1
    gradient_steps: Updates = 1


class ReplayRows(NamedTuple):
    """Transitions, in any batch shape.

    The next observation at an episode's end is its last one. done is 1.0 only where the episode
    terminated: where it was truncated, its last state has a value.
    """

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    reward: jax.Array
    done: jax.Array


def write_row(buffer: jax.Array, row: jax.Array, new: ReplayRows, writes: jax.Array) -> jax.Array:
    """Store one transition of each run in a row, modulo the capacity; nothing if not `writes`."""
    parts = (*new[:3], new.reward[..., None], new.done[..., None])
    values = jnp.concatenate([part.astype(jnp.float32) for part in parts], axis=-1)
    row = row % buffer.shape[0]
    return buffer.at[row].set(jnp.where(writes, values, buffer[row]))


def rewrite_next(
    buffer: jax.Array, row: jax.Array, following: jax.Array, ended: jax.Array, phase: jax.Array
) -> jax.Array:
    """Store s' of a row again, as observed after a switch; of an ended episode only its phase."""
    row, end = row % buffer.shape[0], buffer.shape[-1] - 2
    begin = end - following.shape[-1]
    last = jnp.concatenate([buffer[row, :, begin : end - phase.shape[-1]], phase], axis=-1)
    return buffer.at[row, :, begin:end].set(jnp.where(ended[:, None], last, following))


def read_rows(buffer: jax.Array, rows: jax.Array, observation_dim: int) -> ReplayRows:
    """The transitions `[runs, B]` in these rows `[runs, B]`."""
    drawn = buffer[rows, jnp.arange(buffer.shape[1])[:, None]]
    action_end = drawn.shape[-1] - observation_dim - 2
    parts = jnp.split(drawn, [observation_dim, action_end, action_end + observation_dim], axis=-1)
    observation, action, next_observation, rest = parts
    return ReplayRows(observation, action, next_observation, rest[..., 0], rest[..., 1])


class OffPolicyLearner(NamedTuple):
    """What an update changes: all weights, and the optimisers' states; TD3 has no entropy."""

    weights: Weights
    actor: Adam
    critic: Adam
    entropy: Adam | None = None


class OffPolicyState(NamedTuple):
    """All that changes; a leading axis of runs, but for the buffer and `updated`, a step."""

    learner: OffPolicyLearner
    buffer: jax.Array
    episode: EnvState
    observation: jax.Array
    keys: jax.Array
    updated: jax.Array

    @property
    def weights(self) -> Weights:
        return self.learner.weights


class OffPolicyProgram(Program):
    """Runs of TD3 or SAC; an update draws noise `draws` times for each action of its batch."""

    buffer = "buffer"
    draws: int
    state: OffPolicyState

    @staticmethod
    def initial_learner(weights: Weights) -> OffPolicyLearner:
        """One run's learner before its first update."""
        actor, critic = (network(weights, name) for name in ("actor", "critic"))
        return OffPolicyLearner(weights, Adam.initial(actor), Adam.initial(critic))

    @staticmethod
    @abstractmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, channels: jax.Array
    ) -> jax.Array:
        """One run's action `[A]` while it learns; see `TaskParams.channels`."""

    @staticmethod
    @abstractmethod
    def update(
        settings: Any,
        learner: OffPolicyLearner,
        batch: ReplayRows,
        noise: jax.Array,
        channels: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> OffPolicyLearner:
        """One run's learner after an update with a batch `[B]` and noise `[A, draws, B]`.

        `count` is the number of this update from 1, `index` that in this step from 0.
        """

    def __init__(self, settings: OffPolicySettings, *arguments: Any, **options: Any) -> None:
        self.rollout = settings.train_freq
        super().__init__(settings, *arguments, **options)

    def initial_state(self, weights: Weights, keys: jax.Array) -> OffPolicyState:
        capacity = min(self.settings.buffer_size, self._whole(self.budget))
        state: OffPolicyState = _initial(type(self), capacity, weights, keys, self.params)
        return state

    def advance(self, limit: int) -> StepLog:
        logs: list[StepLog] = []
        end = self._whole(limit)
        while self.steps < end or not logs:
            size = min(PIECE, max(0, self.lives.until(self.steps, end) - self.steps))
            log = self._loop(self.steps, self.steps + size, acts=True)
            logs.append(self._go_on(log.rows(slice(size))))
        return StepLog.joined(logs)

    def finish(self) -> None:
        self._loop(self.steps, self.steps + 1, acts=False)

    def save(self) -> dict[str, Array]:
        """All state, as named arrays; of the buffer, the rows that are written."""
        arrays = super().save()
        name = f".{self.buffer}"
        return arrays | {name: arrays[name][: self.steps]}

    def _go_on(self, log: StepLog) -> StepLog:
        """Count steps; where they end on other tasks, observe these and pay their shaping."""
        before = self.params
        self.steps += len(log.reward)
        if self.params is before:
            return log
        phase = self.lives.phase_after(self.steps)
        change = self.lives.paid_at_switch(self.steps, self.state.episode)
        self.state = _switched(self.state, self.params, phase, self.steps - 1, change)
        return log if change is None else log.paid(change)

    def _loop(self, begin: int, end: int, acts: bool) -> StepLog:
        log: StepLog
        self.state, log = _steps(
            type(self), self.settings, self.state, self.params, begin, end, acts
        )
        return log

    def _whole(self, steps: int) -> int:
        return -(-steps // self.rollout) * self.rollout


@functools.partial(jax.jit, static_argnames=("kind", "capacity"))
def _initial(
    kind: type[OffPolicyProgram],
    capacity: int,
    weights: Weights,
    keys: jax.Array,
    params: TaskParams,
) -> OffPolicyState:
    starts, keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    observation, episode = jax.vmap(reset)(starts, params)
    runs, observation_dim = observation.shape
    row = 2 * observation_dim + params.form.action_dim + 2
    return OffPolicyState(
        learner=jax.vmap(kind.initial_learner)(weights),
        buffer=jnp.zeros((capacity, runs, row), jnp.float32),
        episode=episode,
        observation=observation,
        keys=keys,
        updated=jnp.zeros((), jnp.int32),
    )


@functools.partial(
    jax.jit, static_argnames=("kind", "settings"), donate_argnames=("state",)
)  # donated, or the replay buffer would be copied at each call
def _steps(
    kind: type[OffPolicyProgram],
    settings: OffPolicySettings,
    state: OffPolicyState,
    params: TaskParams,
    begin: jax.Array,
    end: jax.Array,
    acts: jax.Array,
) -> tuple[OffPolicyState, StepLog]:
    """The steps from `begin` to `end`, each after its pending update; none if not `acts`."""

    channels = jax.vmap(lambda task: task.channels)(params)

    def body(n: jax.Array, carry: tuple[OffPolicyState, StepLog]) -> Any:
        state, log = carry
        state = _updated(kind, settings, state, channels, n)
        state, row = _acted(kind, settings, state, params, channels, n, acts)
        log = jax.tree.map(
            lambda rows, one: jax.lax.dynamic_update_index_in_dim(rows, one, n - begin, 0), log, row
        )
        return state, log

    log = StepLog.zeros((PIECE, len(state.observation)), params.form)
    ended: tuple[OffPolicyState, StepLog] = jax.lax.fori_loop(begin, end, body, (state, log))
    return ended


@functools.partial(jax.jit, donate_argnames=("state",))
def _switched(
    state: OffPolicyState,
    params: TaskParams,
    phase: jax.Array,
    row: jax.Array,
    change: jax.Array | None,
) -> OffPolicyState:
    """The state after a switch to other tasks, which changes s' and R of the last row."""
    observation = jax.vmap(observe)(state.episode, params)
    begins = state.episode.t == 0
    buffer = rewrite_next(state.buffer, row, observation, begins, phase)
    if change is not None:
        buffer = buffer.at[row % len(buffer), :, -2].add(change.astype(jnp.float32))
    return state._replace(observation=observation, buffer=buffer)


def _updated(
    kind: type[OffPolicyProgram],
    settings: OffPolicySettings,
    state: OffPolicyState,
    channels: jax.Array,
    n: jax.Array,
) -> OffPolicyState:
    """The state after the updates that follow step n, where they are due and not yet made."""
    starts, every = settings.learning_starts, settings.train_freq
    count = settings.gradient_steps if settings.gradient_steps >= 0 else every
    before = (n // every - starts // every - 1) * count

    def one(index: jax.Array, learner: OffPolicyLearner) -> OffPolicyLearner:
        keys = _keys(state.keys, n, 2 + index)
        drawn, of_noise = jax.vmap(jax.random.split, out_axes=1)(keys)
        noise = _normal(of_noise, (channels.shape[-1], kind.draws, settings.batch_size))
        written = jnp.minimum(n, len(state.buffer))
        rows = jax.vmap(lambda key: jax.random.randint(key, (settings.batch_size,), 0, written))
        batch = read_rows(state.buffer, rows(drawn), state.observation.shape[-1])
        update = jax.vmap(functools.partial(kind.update, settings), (0, 0, 0, 0, None, None))
        updated: OffPolicyLearner = update(
            learner, batch, noise, channels, before + index + 1, index
        )
        return updated

    due = (n > starts) & (n % every == 0) & (n > state.updated)
    learner = jax.lax.cond(
        due,
        lambda learner: jax.lax.fori_loop(0, count, one, learner),
        lambda learner: learner,
        state.learner,
    )
    return state._replace(learner=learner, updated=jnp.where(due, n, state.updated))


def _acted(
    kind: type[OffPolicyProgram],
    settings: OffPolicySettings,
    state: OffPolicyState,
    params: TaskParams,
    channels: jax.Array,
    n: jax.Array,
    acts: jax.Array,
) -> tuple[OffPolicyState, StepLog]:
    """The state after step n + 1, and its row of the log; the same state if not `acts`."""
    starts, of_noise = _keys(state.keys, n, 0), _keys(state.keys, n, 1)
    width = (params.form.action_dim,)

    def random(observation: jax.Array) -> jax.Array:
        draw = functools.partial(jax.random.uniform, shape=width, dtype=jnp.float32, minval=-1.0)
        return jax.vmap(draw)(of_noise)

    def chosen(observation: jax.Array) -> jax.Array:
        noise = _normal(of_noise, width)
        return jax.vmap(kind.explore)(state.learner.weights, observation, noise, channels)

    action = jax.lax.cond(n < settings.learning_starts, random, chosen, state.observation)
    unit = to_unit(action, symmetric=True)
    observation, episode, reward, _, info = jax.vmap(step)(starts, state.episode, unit, params)
    final, terminated = info["final_observation"], info["terminated"]
    new = ReplayRows(state.observation, action, final, reward, terminated)
    episode, observation = jax.tree.map(
        lambda x, y: jnp.where(acts, x, y),
        (episode, observation),
        (state.episode, state.observation),
    )
    buffer = write_row(state.buffer, n, new, acts)
    after = state._replace(buffer=buffer, episode=episode, observation=observation)
    return after, StepLog.of(reward, info)


def _normal(keys: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jax.vmap(lambda key: jax.random.normal(key, shape, jnp.float32))(keys)


def _keys(keys: jax.Array, n: jax.Array, use: int | jax.Array) -> jax.Array:
    return jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, n), use))(keys)

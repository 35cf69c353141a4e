"""`OffPolicyProgram`: what TD3 and SAC share: steps, replay, learning starts, and when they update.

One iteration of the compiled loop is [the update that is pending; a step of the environment], so
that an evaluation between two calls sees the weights before the update of the last step. Lanes are
in lockstep, so what is due is a number of all lanes, and its branch is a real one. The order is
that of Stable-Baselines3's `OffPolicyAlgorithm`, with n steps done:

    n > learning_starts and train_freq divides n:   gradient_steps updates
    n < learning_starts:                            a uniform action, else the policy's
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sme_registry.jax import replay
from sme_registry.jax.env import EnvState, observe, reset, step, to_unit
from sme_registry.jax.networks import Weights
from sme_registry.jax.program import PIECE, Array, Program, StepLog
from sme_registry.jax.replay import Transitions
from sme_registry.jax.task import TaskParams


class OffPolicyState(NamedTuple):
    """All that changes; each array has a leading axis of lanes, but for the buffer and `updated`.

    The buffer is `[capacity, lanes, row]`. Keys of a step follow from those of the lanes and the
    step's number. `updated` is the number of steps before the last update.
    """

    learner: Any
    buffer: jax.Array
    episode: EnvState
    observation: jax.Array
    keys: jax.Array
    updated: jax.Array

    @property
    def weights(self) -> Weights:
        weights: Weights = self.learner.weights
        return weights


class OffPolicyProgram(Program):
    """Lanes of TD3 or SAC; an update draws noise `draws` times for each action of its batch."""

    buffer = "buffer"
    draws: int
    state: OffPolicyState

    @staticmethod
    @abstractmethod
    def initial_learner(weights: Weights) -> Any:
        """One lane's learner before its first update."""

    @staticmethod
    @abstractmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """One lane's action `[A]` in [−1, 1] while it learns, 0 in channels outside the mask."""

    @staticmethod
    @abstractmethod
    def update(
        settings: Any,
        learner: Any,
        batch: Transitions,
        noise: jax.Array,
        mask: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> Any:
        """One lane's learner after an update with a batch `[B]` and noise `[A, draws, B]`.

        `count` is the number of this update from 1, `index` that among the `gradient_steps` of this
        step from 0; both are the same in all lanes.
        """

    def __init__(self, settings: Any, *arguments: Any, **options: Any) -> None:
        self.rollout = settings.train_freq
        super().__init__(settings, *arguments, **options)

    def initial_state(self, weights: Weights, keys: jax.Array) -> OffPolicyState:
        """New lanes: random episodes, an empty buffer."""
        capacity = min(self.settings.buffer_size, self._whole(self.budget))
        state: OffPolicyState = _initial(type(self), capacity, weights, keys, self.params)
        return state

    def advance(self, limit: int) -> StepLog:
        """Go on to step `limit`, or to the end of its `train_freq` steps; see `Program.advance`."""
        pieces: list[StepLog] = []
        end = self._whole(limit)
        while self.steps < end or not pieces:
            size = min(PIECE, max(0, self.lives.until(self.steps, end) - self.steps))
            log = self._loop(self.steps, self.steps + size, acts=True)
            self._go_on(size)
            pieces.append(log.rows(slice(size)))
        return StepLog.joined(pieces)

    def finish(self) -> None:
        """Make the update that follows the last step."""
        self._loop(self.steps, self.steps + 1, acts=False)

    def save(self) -> dict[str, Array]:
        """All state, as named arrays; of the buffer, the rows that are written."""
        arrays = super().save()
        name = f".{self.buffer}"
        return arrays | {name: arrays[name][: self.steps]}

    def _go_on(self, steps: int) -> None:
        """Count steps; where they end on other tasks, observe them."""
        before = self.params
        self.steps += steps
        if self.params is not before:
            phase = self.lives.phase_after(self.steps)
            self.state = _switched(self.state, self.params, phase, self.steps - 1)

    def _loop(self, begin: int, end: int, acts: bool) -> StepLog:
        log: StepLog
        self.state, log = _steps(
            type(self), self.settings, self.state, self.params, begin, end, acts
        )
        return log

    def _whole(self, steps: int) -> int:
        """At least these steps, in whole multiples of `train_freq`."""
        return -(-steps // self.rollout) * self.rollout


def in_range(action: jax.Array, symmetric: bool) -> jax.Array:
    """Actions in [−1, 1], in the action range of the environment."""
    return action if symmetric else to_unit(action, symmetric=True, dtype=jnp.float32)


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
    lanes, observation_dim = observation.shape
    return OffPolicyState(
        learner=jax.vmap(kind.initial_learner)(weights),
        buffer=replay.empty(capacity, lanes, observation_dim, params.W.shape[-2]),
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
    settings: Any,
    state: OffPolicyState,
    params: TaskParams,
    begin: jax.Array,
    end: jax.Array,
    acts: jax.Array,
) -> tuple[OffPolicyState, StepLog]:
    """Each step from `begin` to `end`, after the update that is pending; no step if not `acts`.

    Of the log `[PIECE, lanes]`, the first `end − begin` rows are used.
    """
    lanes = state.observation.shape[0]
    masks = jax.vmap(lambda each: each.action_mask)(params)

    def body(n: jax.Array, carry: tuple[OffPolicyState, StepLog]) -> Any:
        state, log = carry
        state = _updated(kind, settings, state, masks, n)
        state, row = _acted(kind, settings, state, params, masks, n, acts)
        log = jax.tree.map(
            lambda rows, one: jax.lax.dynamic_update_index_in_dim(rows, one, n - begin, 0), log, row
        )
        return state, log

    real: Any = jnp.zeros((PIECE, lanes), params.r_min.dtype)
    flag: Any = jnp.zeros((PIECE, lanes), bool)
    costs = (real, real) if params.form.safety else ()
    begun = state, StepLog(real, real, real, flag, flag, *costs)
    ended: tuple[OffPolicyState, StepLog] = jax.lax.fori_loop(begin, end, body, begun)
    return ended


@functools.partial(jax.jit, donate_argnames=("state",))
def _switched(
    state: OffPolicyState, params: TaskParams, phase: jax.Array, row: jax.Array
) -> OffPolicyState:
    """The state after a switch to other tasks, which also changes s' of the last row."""
    observation = jax.vmap(observe)(state.episode, params)
    begins = state.episode.t == 0
    buffer = replay.rewrite_next(state.buffer, row, observation, begins, phase)
    return state._replace(observation=observation, buffer=buffer)


def _updated(
    kind: type[OffPolicyProgram],
    settings: Any,
    state: OffPolicyState,
    masks: jax.Array,
    n: jax.Array,
) -> OffPolicyState:
    """The state after the updates that follow step n, where they are due and not yet made."""
    starts, every = settings.learning_starts, settings.train_freq
    count = settings.gradient_steps if settings.gradient_steps >= 0 else every
    before = (n // every - starts // every - 1) * count
    observation_dim = state.observation.shape[-1]

    def one(index: jax.Array, learner: Any) -> Any:
        keys = _keys(state.keys, n, 2 + index)
        drawn, of_noise = jax.vmap(jax.random.split, out_axes=1)(keys)
        noise = _normal(of_noise, (masks.shape[-1], kind.draws, settings.batch_size))
        capacity = len(state.buffer)
        rows = jax.vmap(lambda key: replay.sample_rows(key, settings.batch_size, n, capacity))
        batch = replay.read(state.buffer, rows(drawn), observation_dim)
        update = jax.vmap(functools.partial(kind.update, settings), (0, 0, 0, 0, None, None))
        return update(learner, batch, noise, masks, before + index + 1, index)

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
    settings: Any,
    state: OffPolicyState,
    params: TaskParams,
    masks: jax.Array,
    n: jax.Array,
    acts: jax.Array,
) -> tuple[OffPolicyState, StepLog]:
    """The state after step n + 1, and its row of the log; the same state if not `acts`."""
    starts, of_noise = _keys(state.keys, n, 0), _keys(state.keys, n, 1)
    width = masks.shape[-1:]

    def random(observation: jax.Array) -> jax.Array:
        draw = functools.partial(jax.random.uniform, shape=width, dtype=jnp.float32, minval=-1.0)
        return jnp.where(masks, jax.vmap(draw)(of_noise), 0.0)

    def chosen(observation: jax.Array) -> jax.Array:
        noise = _normal(of_noise, width)
        return jax.vmap(kind.explore)(state.learner.weights, observation, noise, masks)

    action = jax.lax.cond(n < settings.learning_starts, random, chosen, state.observation)
    unit = to_unit(action, symmetric=True)
    observation, episode, reward, _, info = jax.vmap(step)(starts, state.episode, unit, params)
    final = info["final_observation"]
    terminated = info["terminated"]
    written = Transitions(state.observation, action, final, reward, terminated)
    row: Any = reward, info["regret"], info["similarity"], terminated, info["truncated"]
    costs: Any = info.get("cost"), info.get("safe_regret")
    after = state._replace(
        buffer=replay.write(state.buffer, n, written, acts),
        episode=_chosen(acts, episode, state.episode),
        observation=_chosen(acts, observation, state.observation),
    )
    return after, StepLog(*row, *costs)


def _chosen(acts: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(acts, x, y), new, old)


def _normal(keys: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Standard normal numbers of each lane, `[lanes, *shape]` float32."""
    return jax.vmap(lambda key: jax.random.normal(key, shape, jnp.float32))(keys)


def _keys(keys: jax.Array, n: jax.Array, use: int | jax.Array) -> jax.Array:
    """The key of each lane for one use in step n."""
    return jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, n), use))(keys)

"""PPO as in Stable-Baselines3: hyperparameters, weights, advantages, updates, and `PPOProgram`.

Source: Schulman et al. (2017), Proximal Policy Optimization Algorithms; defaults and order of
operations: SB3's `PPO` with `MlpPolicy`. `n` steps of a rollout, `O` observation width, `A` action
channels, `B` steps of a minibatch. Functions are of one run, and vmapped.

    a ~ N(μ(o), σ²)                      clipped to the action range for the environment alone
    δ_t = R_t + γ V(o_{t+1}) − V(o_t)    after an episode's end V(o_{t+1}) and Â_{t+1} are 0;
    Â_t = δ_t + γ λ Â_{t+1}              at a truncation R_t includes γ V(last observation)
    loss = −mean min(ρ Â, clip(ρ, 1 ± ε) Â) + c_V mean (Â + V_old − V)² − c_H entropy

ρ is the ratio of π(a) now and when the action was taken.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import model_validator

from sme_registry.jax.env import EnvState, advance, observe, reset, to_unit
from sme_registry.jax.networks import (
    Adam,
    AgentSettings,
    Count,
    HostWeights,
    Positive,
    Share,
    Weights,
    adam,
    clipped,
    hidden_layers,
    initial_orthogonal,
    linear,
)
from sme_registry.jax.program import Program, StepLog
from sme_registry.jax.task import StepOutcome, TaskParams, judge, random_numbers
from sme_registry.spec.document import Real

_LOG_ROOT_TAU = 0.5 * math.log(2.0 * math.pi)
_JUDGED_AT_ONCE = 256  # steps of a rollout
_ADAM_EPSILON = 1e-5  # SB3's for on-policy algorithms


class PPO(AgentSettings):
    """Hyperparameters, with the defaults of `stable_baselines3.PPO`."""

    usual_widths = (64, 64)
    learning_rate: Positive = 3e-4
    n_steps: Count = 2048
    batch_size: Count = 64
    n_epochs: Count = 10
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    clip_range_vf: Positive | None = None
    normalize_advantage: bool = True
    ent_coef: Real = 0.0
    vf_coef: Real = 0.5
    max_grad_norm: Positive = 0.5

    @model_validator(mode="after")
    def _minibatches_are_equal(self) -> Self:
        if self.batch_size < 2 or self.n_steps % self.batch_size:
            raise ValueError(
                f"batch_size={self.batch_size}: must be at least 2 and divide "
                f"n_steps={self.n_steps}, since minibatches here are of equal size."
            )
        return self


class PPOLearner(NamedTuple):
    """What an update changes: weights by SB3's names, and the optimiser's state."""

    weights: Weights
    optimiser: Adam


class RolloutSteps(NamedTuple):
    """Steps of a rollout, `[n, ...]`: actions are not clipped.

    `last_observation` is that after the step, and before the next episode begins.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    last_observation: jax.Array


class Rollout(NamedTuple):
    """What updates learn from, `[n, ...]`: log π and V when the action was taken, and Â."""

    observation: jax.Array
    action: jax.Array
    log_density: jax.Array
    value: jax.Array
    advantage: jax.Array


class PPOState(NamedTuple):
    """All that changes in a `PPOProgram`; each array has a leading axis of runs."""

    weights: Weights
    optimiser: Adam
    key: jax.Array
    episode: EnvState
    steps: RolloutSteps


def mean(settings: PPO, weights: Weights, observation: jax.Array) -> jax.Array:
    """μ `[..., A]` of observations `[..., O]`: the deterministic action before it is clipped."""
    return linear(weights, "action_net", _latent(settings, weights, "policy_net", observation))


def value(settings: PPO, weights: Weights, observation: jax.Array) -> jax.Array:
    """V `[...]` of observations `[..., O]`."""
    latent = _latent(settings, weights, "value_net", observation)
    return linear(weights, "value_net", latent)[..., 0]


def log_density(
    settings: PPO,
    weights: Weights,
    observation: jax.Array,
    action: jax.Array,
    channels: jax.Array,
) -> jax.Array:
    """log π `[...]` of actions `[..., A]`; see `TaskParams.channels`."""
    log_std = weights["log_std"]
    z = (action - mean(settings, weights, observation)) * jnp.exp(-log_std)
    return jnp.sum(jnp.where(channels, -0.5 * z**2 - log_std - _LOG_ROOT_TAU, 0.0), axis=-1)


def collect(
    settings: PPO,
    weights: Weights,
    params: TaskParams,
    episode: EnvState,
    noise: jax.Array,
    fresh: EnvState,
    begin: int | jax.Array,
    end: int | jax.Array,
    *,
    symmetric: bool,
    separable: bool,
    numbers: Any = None,
) -> tuple[EnvState, RolloutSteps, StepLog]:
    """The steps `begin` … `end` − 1 of a rollout of n, and their log; the other rows are arbitrary.

    `noise` `[A, n]` is standard normal, `fresh` `[n]` the environment if an episode ends there.
    Where rewards are `separable`, the oracle is asked once for all steps.
    """
    sigma = jnp.exp(weights["log_std"])
    n = noise.shape[1]

    def one(
        episode: EnvState, noise: jax.Array, numbers: Any, fresh: EnvState
    ) -> tuple[EnvState, Any]:
        now = observe(episode, params)
        action = mean(settings, weights, now) + sigma * noise
        a = to_unit(action, symmetric)
        _, after, reward, ended, info = advance(episode, a, numbers, params)
        judged: Any = StepLog.of(reward, info)
        if separable:  # XLA drops the oracle from the loop, since no result of it is used
            after = after._replace(accumulated_reward=episode.accumulated_reward)
            ended, judged = info["truncated"], (episode.s, a)
        taken = now, action, info["truncated"], observe(after, params)
        after = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, after)
        return after, (taken, judged)

    def body(i: jax.Array, carry: tuple[EnvState, Any]) -> tuple[EnvState, Any]:
        episode, rows = carry
        episode, row = one(episode, noise.T[i], _at(numbers, i), _at(fresh, i))
        return episode, jax.tree.map(lambda column, x: column.at[i].set(x), rows, row)

    shapes = jax.eval_shape(one, episode, noise[:, 0], _at(numbers, 0), _at(fresh, 0))[1]
    rows = jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), shapes)
    # No scan, whose length is fixed: parts of rollouts are of any length.
    episode, (taken, judged) = jax.lax.fori_loop(begin, end, body, (episode, rows))
    observed, action, truncated, last_observation = taken
    log = _judged(params, judged, truncated, begin, end) if separable else judged
    reward = log.reward.astype(jnp.float32)
    steps = RolloutSteps(observed, action, reward, log.terminated, truncated, last_observation)
    return episode, steps, log


def _judged(
    params: TaskParams,
    rows: tuple[jax.Array, jax.Array],
    truncated: jax.Array,
    begin: int | jax.Array,
    end: int | jax.Array,
) -> StepLog:
    """The log `[n]` of states and actions, in blocks, so that a part of a rollout costs little."""
    n = len(truncated)
    size = min(n, _JUDGED_AT_ONCE)

    def body(i: jax.Array, judged: StepOutcome) -> StepOutcome:
        first = jnp.minimum(i * size, n - size)
        s, a = (jax.lax.dynamic_slice_in_dim(x, first, size) for x in rows)
        new: StepOutcome = jax.tree.map(
            lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, first, 0),
            judged,
            judge(params, s, a),
        )
        return new

    zeros = jnp.zeros(n, params.r_min.dtype)
    none = StepOutcome(zeros, zeros, *[zeros if params.form.safety else None] * 2)
    similarity, reward, *costs, _ = jax.lax.fori_loop(begin // size, -(-end // size), body, none)
    return StepLog(reward, 1.0 - reward, similarity, jnp.zeros_like(truncated), truncated, *costs)


def _at(rows: Any, i: int | jax.Array) -> Any:
    return jax.tree.map(lambda x: x[i], rows)


def rollout(
    settings: PPO,
    weights: Weights,
    steps: RolloutSteps,
    next_observation: jax.Array,
    channels: jax.Array,
) -> Rollout:
    """Densities, values and advantages of the steps of one run, before `next_observation`."""
    values = value(settings, weights, steps.observation)
    cut = steps.truncated & ~steps.terminated
    last_value = value(settings, weights, steps.last_observation)
    reward = steps.reward + jnp.where(cut, settings.gamma * last_value, 0.0)
    ended = steps.terminated | steps.truncated
    next_value = value(settings, weights, next_observation)
    return Rollout(
        steps.observation,
        steps.action,
        log_density(settings, weights, steps.observation, steps.action, channels),
        values,
        advantages(settings, reward, values, next_value, ended),
    )


def advantages(
    settings: PPO, reward: jax.Array, values: jax.Array, next_value: jax.Array, ended: jax.Array
) -> jax.Array:
    """Generalised advantage estimates Â `[n]` (Schulman et al. 2016), of `[n]` steps."""
    goes_on = 1.0 - ended.astype(jnp.float32)
    following = jnp.append(values[1:], next_value)
    delta = reward + settings.gamma * following * goes_on - values
    decay = settings.gamma * settings.gae_lambda * goes_on

    def step(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        advantage = now[0] + now[1] * later
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros((), jnp.float32), (delta, decay), reverse=True)[1]


def update(
    settings: PPO,
    learner: PPOLearner,
    rollout: Rollout,
    batches: jax.Array,
    channels: jax.Array,
) -> PPOLearner:
    def one(learner: PPOLearner, batch: jax.Array) -> tuple[PPOLearner, None]:
        weights, optimiser = learner
        chosen = Rollout(*(column[batch] for column in rollout))
        gradients = jax.grad(_loss, argnums=1)(settings, weights, chosen, channels)
        gradients = clipped(gradients, settings.max_grad_norm)
        rate = settings.learning_rate
        optimiser, weights = adam(optimiser, weights, gradients, rate, _ADAM_EPSILON)
        return PPOLearner(weights, optimiser), None

    return jax.lax.scan(one, learner, batches)[0]


def permutations(key: jax.Array, count: int, n: int) -> jax.Array:
    """`[count, n]` random orders of 0 … n − 1, in a sixth of the time of `jax.random` on a CPU.

    Random words are sorted whose last bits are the index; that two agree in all others has a
    probability below n³ 2⁻⁶⁴.
    """
    bits = n.bit_length()
    words = jax.random.bits(key, (count, n), jnp.uint64) << bits | jnp.arange(n, dtype=jnp.uint64)
    orders: jax.Array = jnp.sort(words, axis=-1) % 2**bits
    return orders.astype(jnp.int32)


def _loss(settings: PPO, weights: Weights, batch: Rollout, channels: jax.Array) -> jax.Array:
    density = log_density(settings, weights, batch.observation, batch.action, channels)
    ratio = jnp.exp(density - batch.log_density)
    advantage = batch.advantage
    if settings.normalize_advantage:
        advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
    limited = jnp.clip(ratio, 1.0 - settings.clip_range, 1.0 + settings.clip_range)
    policy_loss = -jnp.minimum(advantage * ratio, advantage * limited).mean()

    values = value(settings, weights, batch.observation)
    if settings.clip_range_vf is not None:
        change = jnp.clip(values - batch.value, -settings.clip_range_vf, settings.clip_range_vf)
        values = batch.value + change
    value_loss = ((batch.advantage + batch.value - values) ** 2).mean()
    entropy = jnp.sum(jnp.where(channels, 0.5 + _LOG_ROOT_TAU + weights["log_std"], 0.0))
    return policy_loss + settings.vf_coef * value_loss - settings.ent_coef * entropy


def _latent(settings: PPO, weights: Weights, network: str, observation: jax.Array) -> jax.Array:
    layers = len(settings.net_arch)
    return hidden_layers(weights, f"mlp_extractor.{network}", observation, layers, jnp.tanh)[-1]


class PPOProgram(Program):
    actor = ("mlp_extractor.policy_net.", "action_net.")
    hidden = ("mlp_extractor.policy_net", jnp.tanh)

    def __init__(self, settings: PPO, *arguments: Any, **options: Any) -> None:
        self.rollout = settings.n_steps
        super().__init__(settings, *arguments, **options)

    @staticmethod
    def initial_weights(
        settings: PPO, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        """SB3's initial weights: orthogonal; biases and log σ are 0."""
        weights: HostWeights = {"log_std": np.zeros(action_dim, np.float32)}
        for network, head, outputs, gain in (
            ("policy_net", "action_net", action_dim, 0.01),
            ("value_net", "value_net", 1, 1.0),
        ):
            width = observation_dim
            for i, units in enumerate(settings.net_arch):
                name = f"mlp_extractor.{network}.{2 * i}"
                weights |= initial_orthogonal(rng, name, width, units, math.sqrt(2.0))
                width = units
            weights |= initial_orthogonal(rng, head, width, outputs, gain)
        return weights

    def initial_state(self, weights: Weights, keys: jax.Array) -> PPOState:
        state: PPOState = _begin(self.settings, self.params, weights, keys)
        return state

    @staticmethod
    def act(settings: PPO, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        return mean(settings, weights, observations)

    def advance(self, limit: int) -> StepLog:
        """Whole rollouts until `limit` is reached, and the updates between them."""
        logs = [StepLog.zeros((0, self.runs), self.params.form)]
        while self.steps < limit:
            self.finish()
            logs += self._collected()
        return StepLog.joined(logs)

    def _collected(self) -> list[StepLog]:
        """Take the steps of a rollout, in parts of which each is on its tasks."""
        logs, first = [], self.steps
        last = first + self.rollout
        while self.steps < last:
            params, begin = self.params, self.steps - first
            self.steps = self.lives.until(self.steps, last)
            part = slice(begin, self.steps - first)
            self.state, log = _collect(
                self.settings,
                self.symmetric,
                self.lives.separable and params.inner is not None,
                params,
                self.state,
                self.lives.phase_after(self.steps),
                part.start,
                part.stop,
            )
            log = log.rows(part)
            change = self.lives.paid_at_switch(self.steps, self.state.episode)
            if change is not None:
                steps = self.state.steps
                reward = steps.reward.at[:, part.stop - 1].add(change.astype(np.float32))
                self.state = self.state._replace(steps=steps._replace(reward=reward))
                log = log.paid(change)
            logs.append(log)
        return logs

    def finish(self) -> None:
        """Learn from the last rollout, unless that is done."""
        updates = self.steps // self.settings.batch_size * self.settings.n_epochs
        if self.state.optimiser.updates[0] < updates:
            self.state = _learn(self.settings, self.params, self.state)


@functools.partial(jax.jit, static_argnums=0)
def _begin(settings: PPO, params: TaskParams, weights: Weights, keys: jax.Array) -> PPOState:
    def run(params: TaskParams, weights: Weights, key: jax.Array) -> PPOState:
        key, of_start = jax.random.split(key)
        first, episode = reset(of_start, params)
        flag, number = jnp.zeros((), bool), jnp.zeros((), jnp.float32)
        none = RolloutSteps(first, weights["log_std"], number, flag, flag, first)
        steps = jax.tree.map(lambda x: jnp.zeros((settings.n_steps, *x.shape), x.dtype), none)
        return PPOState(weights, Adam.initial(weights), key, episode, steps)

    return jax.vmap(run)(params, weights, keys)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _collect(
    settings: PPO,
    symmetric: bool,
    separable: bool,
    params: TaskParams,
    state: PPOState,
    phase: jax.Array,
    begin: jax.Array,
    end: jax.Array,
) -> tuple[PPOState, StepLog]:
    """A part of a rollout of all runs, and its log in the rows of `[n, runs]`.

    Each part draws the random numbers of the whole rollout, and uses its own.
    """
    n = settings.n_steps

    def run(params: TaskParams, state: PPOState, phase: jax.Array) -> tuple[PPOState, StepLog]:
        key, of_noise, of_starts = jax.random.split(state.key, 3)
        noise = jax.random.normal(of_noise, (params.form.action_dim, n), jnp.float32)
        starts = jax.random.split(of_starts, n)
        _, fresh = jax.vmap(reset, (0, None))(starts, params)
        numbers = jax.vmap(random_numbers, (0, None))(starts, params)
        episode, steps, log = collect(
            settings, state.weights, params, state.episode, noise, fresh, begin, end,
            symmetric=symmetric, separable=separable, numbers=numbers,
        )  # fmt: skip
        last = steps.last_observation
        last = last.at[end - 1, last.shape[-1] - len(phase) :].set(phase)
        here = (jnp.arange(n) >= begin) & (jnp.arange(n) < end)
        steps = jax.tree.map(
            lambda new, old: jnp.where(here.reshape(-1, *[1] * (new.ndim - 1)), new, old),
            steps._replace(last_observation=last),
            state.steps,
        )
        key = jnp.where(end == n, key, state.key)
        return state._replace(key=key, episode=episode, steps=steps), log

    return jax.vmap(run, out_axes=(0, 1))(params, state, phase)


@functools.partial(jax.jit, static_argnums=0)
def _learn(settings: PPO, params: TaskParams, state: PPOState) -> PPOState:
    def run(params: TaskParams, state: PPOState) -> PPOState:
        key, of_batches = jax.random.split(state.key)
        batches = permutations(of_batches, settings.n_epochs, settings.n_steps)
        following, channels = observe(state.episode, params), params.channels
        learner = update(
            settings,
            PPOLearner(state.weights, state.optimiser),
            rollout(settings, state.weights, state.steps, following, channels),
            batches.reshape(-1, settings.batch_size),
            channels,
        )
        return state._replace(weights=learner.weights, optimiser=learner.optimiser, key=key)

    return jax.vmap(run)(params, state)

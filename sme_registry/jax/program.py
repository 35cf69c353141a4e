"""`Program`: the runs of one algorithm, which learn and are evaluated in compiled code.

A run is a task or a stream of tasks, a seed, weights. All runs of a program have the same
algorithm, hyperparameters, budget and `Form` of tasks, and take the same number of steps; their
tasks, seeds and reward settings (k, T, r_min, D) differ. A run's bits depend on the number of runs
and on no other run, so results record that number.

A subclass has one algorithm's state, `initial_state`, `advance`, `finish`, and the pure functions
`initial_weights` and `act`; all else is here.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.jax import find_device
from sme_registry.jax.env import (
    EnvState,
    Info,
    advance,
    moved,
    observe,
    shaping_at_switch,
    start,
    to_unit,
)
from sme_registry.jax.networks import HostWeights, Weights
from sme_registry.jax.task import (
    Form,
    TaskParams,
    first_distractors,
    judge,
    random_numbers,
    stacked_params,
)
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task.loading import materialize_segments

Array = npt.NDArray[Any]
Document = SMESpec | StreamSpec
"""What a run lives through: one task, or a stream of them."""

PIECE = 500
"""The most steps between two returns from compiled code."""

_JUDGED_AT_ONCE = 25  # steps of an episode


class StepLog(NamedTuple):
    """What happened in the steps of one `advance`, `[steps, runs]` each; R is the payout."""

    reward: Any
    regret: Any
    similarity: Any
    terminated: Any
    truncated: Any
    cost: Any = None
    safe_regret: Any = None

    @classmethod
    def of(cls, reward: jax.Array, info: Info) -> StepLog:
        return cls(reward, *(info.get(name) for name in cls._fields[1:]))

    @classmethod
    def zeros(cls, shape: tuple[int, int], form: Form) -> StepLog:
        real, flag = jnp.zeros(shape, jnp.float64), jnp.zeros(shape, bool)
        return cls(real, real, real, flag, flag, *[real if form.safety else None] * 2)

    @classmethod
    def joined(cls, logs: Sequence[StepLog]) -> StepLog:
        log: StepLog = jax.tree.map(lambda *rows: np.concatenate(rows), *logs)
        return log

    def rows(self, part: slice) -> StepLog:
        log: StepLog = jax.tree.map(lambda column: np.asarray(column)[part], self)
        return log

    def paid(self, change: Any) -> StepLog:
        """The same steps, where the last reward of each run changes by `[runs]`."""
        reward = np.array(self.reward)
        reward[-1] += change
        return self._replace(reward=reward)


class Evaluation(NamedTuple):
    """Episodes of the present deterministic policies: sums over steps, `[runs, episodes]`."""

    episode_return: Array
    length: Array
    regret: Array
    similarity: Array


class Lives:
    """Which tasks the runs of a program are on, by the steps that each has taken: its lifetime.

    All runs switch at the same steps, and a switch passes other `TaskParams` to the same code.
    `separable` says whether rewards change no observation and end no episode, k = 1 and D = 0 in
    all tasks: then the oracle can be asked later, for many steps at once.
    """

    def __init__(self, documents: Sequence[Document], device: Any) -> None:
        first, drawn = documents[0], {}
        for document in dict.fromkeys(documents):
            drawn[document] = materialize_segments(document)
        self.stream = first if isinstance(first, StreamSpec) else None
        self._times, self._at_once = first.times, first.switch == "step"
        segments = [*zip(*(drawn[document] for document in documents), strict=True)]
        specs = [task.spec for tasks in segments for task in tasks]
        self.separable = all(spec.separable for spec in specs)
        self._shaped = any(spec.shaping is not None for spec in specs)
        params = {
            tasks: jax.device_put(stacked_params(tasks), device)
            for tasks in dict.fromkeys(segments)
        }
        self._params: list[TaskParams] = [params[tasks] for tasks in segments]
        if first.observed_phases:
            one_hot = np.eye(first.observed_phases, dtype=np.float32)
            for i, segment in enumerate(first.segments):
                phase = np.tile(one_hot[segment.phase], (len(documents), 1))
                self._params[i] = self._params[i]._replace(phase=jax.device_put(phase, device))

    def at(self, lifetime: int) -> TaskParams:
        """The tasks on which the next step is taken."""
        return self._params[self._times.segment_at(lifetime)]

    def until(self, lifetime: int, limit: int) -> int:
        return min(limit, self._times.next_switch(lifetime))

    def paid_at_switch(self, lifetime: int, episode: EnvState) -> Array | None:
        """What a switch after so many steps adds to the last reward, `[runs]`; None for nothing."""
        before, after = self.at(lifetime - 1), self.at(lifetime)
        if before is after or not self._shaped:
            return None
        return np.asarray(shaping_at_switch(episode, before, after))

    def phase_after(self, lifetime: int) -> jax.Array:
        """The one-hot `[runs, P]` in the last observation of an episode that ends there."""
        return self.at(lifetime if self._at_once else lifetime - 1).phase


class Program(ABC):
    """The runs of one algorithm: `advance` until the budget is used, then `finish`.

    `specs` are those of the runs without the copies of the first that fill the program up to
    `runs`; `steps` and `budget` are of each run.
    """

    buffer = ""
    """The field of the state that is a replay buffer, `[capacity, ...]`: longer for more steps."""

    actor: tuple[str, ...] = ("actor.",)
    """How the names of the weights begin that `act` reads."""

    hidden: tuple[str, Callable[[jax.Array], jax.Array]]
    """How the names of the actor's hidden layers begin, and their activation."""

    rollout = 1
    """Steps between two updates: an evaluation due in them has the weights before the second."""

    state: Any
    """All that changes: a NamedTuple of arrays with `weights` by SB3's names, `[runs, ...]`."""

    def __init__(
        self,
        settings: Any,
        specs: Sequence[Document],
        seeds: Sequence[int],
        *,
        steps: int,
        action_range: str = "symmetric",
        runs: int | None = None,
        device: str | None = None,
    ) -> None:
        """New runs, before their first step."""
        self.settings, self.specs, self.budget = settings, tuple(specs), steps
        self.symmetric = action_range == "symmetric"
        self.runs = len(specs) if runs is None else runs
        copies = self.runs - len(specs)
        specs = [*specs, *[specs[0]] * copies]
        seeds = [*seeds, *[seeds[0]] * copies]
        self.device = find_device(device)
        self.lives, self.steps = Lives(specs, self.device), 0
        widths = specs[0].observation_dim, specs[0].action_dim
        rngs = map(np.random.default_rng, seeds)
        weights = [self.initial_weights(settings, rng, *widths) for rng in rngs]
        stacked = {name: np.stack([run[name] for run in weights]) for name in weights[0]}
        keys = jax.vmap(jax.random.PRNGKey)(np.asarray(seeds, np.uint32))
        try:
            self.state = self.initial_state(*jax.device_put((stacked, keys), self.device))
        except jax.errors.JaxRuntimeError as error:
            raise ResourceLimitError(
                f"runs={self.runs:,}: their state does not fit on the {self.device.platform}: "
                f"{str(error).splitlines()[0]}. Choose fewer runs, fewer steps, a smaller "
                "buffer_size or a smaller n_steps."
            ) from error

    @property
    def params(self) -> TaskParams:
        """The runs' tasks of the next step; leading axis `runs`."""
        return self.lives.at(self.steps)

    @staticmethod
    @abstractmethod
    def initial_weights(
        settings: Any, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        """The weights of a new run, by SB3's names and with its initialisation."""

    @abstractmethod
    def initial_state(self, weights: Weights, keys: jax.Array) -> Any:
        """All that changes, before the first step, for weights and random keys `[runs, ...]`."""

    @staticmethod
    @abstractmethod
    def act(settings: Any, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        """One run's deterministic actions `[..., A]` in its action range, or beyond it."""

    @abstractmethod
    def advance(self, limit: int) -> StepLog:
        """Go on to at most step `limit`, and stop *before* the update that follows the last step.

        On-policy programs always collect a whole rollout, also beyond `limit`.
        """

    @abstractmethod
    def finish(self) -> None:
        """Make the update that follows the last step."""

    def evaluate(self, states: Array, lifetime: int | None = None) -> Evaluation:
        """Run an episode from each of `states` `[runs, episodes, S]` with the present weights.

        Of a stream, the tasks are those after `lifetime` steps; None for now.
        """
        sums = _episodes(
            type(self).act,
            self.settings,
            self.symmetric,
            self.lives.separable,
            self.state.weights,
            self.lives.at(self.steps if lifetime is None else lifetime),
            jax.device_put(np.asarray(states, np.float64), self.device),
        )
        return Evaluation(*(np.asarray(sum_of) for sum_of in sums))

    def weights(self, run: int) -> dict[str, Array]:
        return {name: np.asarray(weight[run]) for name, weight in self.state.weights.items()}

    def failed(self) -> Array:
        """`[runs]`, whether a run's weights are not finite; such runs go on without effect."""
        return np.asarray(_not_finite(self.state.weights))

    def save(self) -> dict[str, Array]:
        leaves = jax.tree_util.tree_leaves_with_path(self.state)
        arrays = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}
        return {"steps": np.asarray(self.steps), **arrays}

    def restore(self, arrays: dict[str, Array]) -> None:
        """Go on from saved state, bit for bit; a replay buffer may be that of a smaller budget."""
        leaves, structure = jax.tree_util.tree_flatten_with_path(self.state)
        names = [jax.tree_util.keystr(path) for path, _ in leaves]
        if {"steps", *names} != arrays.keys():
            raise OptionError(
                "arrays: are the state of another program. Give those that a program of the same "
                "algorithm, hyperparameters and runs saved."
            )
        steps = int(self._fitted("steps", arrays["steps"], np.asarray(self.steps)))
        restored = [
            jax.device_put(self._fitted(name, arrays[name], leaf), self.device)
            for name, (_, leaf) in zip(names, leaves, strict=True)
        ]
        self.state = jax.tree_util.tree_unflatten(structure, restored)
        self.steps = steps

    def _fitted(self, name: str, saved: Array, present: jax.Array | Array) -> Array:
        """A saved array, in the shape that it has here."""
        saved, shape = np.asarray(saved), present.shape
        if self.buffer and name.startswith(f".{self.buffer}") and saved.shape[1:] == shape[1:]:
            shape = (min(len(saved), shape[0]), *shape[1:])
        if saved.dtype != present.dtype or saved.shape != shape:
            raise OptionError(
                f"arrays[{name!r}]: is {saved.dtype} of shape {saved.shape}: must be "
                f"{present.dtype} of shape {present.shape}. Give the state of a program of the "
                "same runs and tasks."
            )
        if shape == present.shape:
            return saved
        return np.concatenate([saved, np.zeros_like(present[len(saved) :])])


@jax.jit
def _not_finite(weights: Weights) -> jax.Array:
    finite = [jnp.isfinite(w).all(axis=tuple(range(1, w.ndim))) for w in weights.values()]
    return ~jnp.stack(finite).all(axis=0)


class _Running(NamedTuple):
    state: EnvState
    sums: tuple[jax.Array, ...]
    running: jax.Array


@functools.partial(jax.jit, static_argnames=("act", "settings", "symmetric", "separable"))
def _episodes(
    act: Any,
    settings: Any,
    symmetric: bool,
    separable: bool,
    weights: Weights,
    params: TaskParams,
    states: jax.Array,
) -> tuple[jax.Array, ...]:
    """`Program.evaluate`: loops outside, vmap inside; sums in float64."""
    keys = jax.vmap(jax.vmap(_key_of))(states)

    def drawn(state: EnvState) -> Any:
        """The random numbers of the next step of each episode; None where it needs none."""
        steps = jax.vmap(jax.vmap(jax.random.fold_in))(keys, state.t)
        return _of_each(random_numbers, steps, params=params)

    def chosen(state: EnvState) -> jax.Array:
        observations = _of_each(observe, state, params=params)
        actions = jax.vmap(lambda w, o: act(settings, w, o, symmetric))(weights, observations)
        return to_unit(actions, symmetric)

    def one_step(now: _Running) -> _Running:
        _, state, reward, done, info = _of_each(
            advance, now.state, chosen(now.state), drawn(now.state), params=params
        )
        here = (reward, jnp.ones_like(reward), info["regret"], info["similarity"])
        sums = jax.tree.map(lambda sum, x: sum + jnp.where(now.running, x, 0.0), now.sums, here)
        return _Running(state, sums, now.running & ~done)

    def steps_judged_at_once(now: _Running) -> _Running:
        def move(state: EnvState, _: None) -> tuple[EnvState, tuple[jax.Array, jax.Array]]:
            a = chosen(state)
            return _of_each(moved, state, a, drawn(state), params=params), (state.s, a)

        state, (s, a) = jax.lax.scan(move, now.state, length=_JUDGED_AT_ONCE)
        similarity, reward, *_ = jax.vmap(judge, (0, 1, 1), 1)(params, s, a)
        horizon = params.horizon[:, None]
        counted = now.state.t + jnp.arange(_JUDGED_AT_ONCE)[:, None, None] < horizon
        here = (reward, jnp.ones_like(reward), 1.0 - reward, similarity)
        sums = jax.tree.map(
            lambda sum, x: sum + jnp.where(counted, x, 0.0).sum(axis=0), now.sums, here
        )
        return _Running(state, sums, state.t < horizon)

    first = _of_each(first_distractors, keys, params=params)
    _, begin = _of_each(lambda s, d, p: start(s, p, d), states, first, params=params)
    zeros = jnp.zeros_like(begin.accumulated_reward)
    now = _Running(begin, (zeros,) * 4, jnp.ones_like(zeros, bool))
    body = steps_judged_at_once if separable else one_step
    return jax.lax.while_loop(lambda now: now.running.any(), body, now).sums


def _key_of(s: jax.Array) -> jax.Array:
    """The key of an episode that begins in state s `[S]`, float64."""
    words = jax.lax.bitcast_convert_type(s, jnp.uint32)
    word = jax.lax.reduce(words, jnp.uint32(0), jax.lax.bitwise_xor, (0, 1))
    return jax.random.PRNGKey(word)


def _of_each(function: Any, *arguments: Any, params: TaskParams) -> Any:
    """`function(*arguments, params)` of each episode `[runs, episodes]`."""
    episodes = jax.vmap(function, (*[0] * len(arguments), None))
    return jax.vmap(episodes)(*arguments, params)

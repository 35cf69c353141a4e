"""`Program`: the lanes of one algorithm, which learn and are evaluated in compiled code.

A lane is one run: a task or a stream of tasks, a seed, weights. All lanes of a program have the
same algorithm, hyperparameters, budget, padded shapes and `Form`, and take the same number of
steps; their tasks, seeds and reward settings (k, T, r_min, D) differ. A lane's bits depend on the
number of lanes and on no other lane, so results record that number.

A subclass has one algorithm's state, `initial_state`, `advance`, `finish`, and the pure functions
`initial_weights` and `act`; all else is here.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.jax import networks, observing, oracle
from sme_registry.jax.device import find_device, memory_of
from sme_registry.jax.env import EnvState, advance, moved, observe, start, to_unit
from sme_registry.jax.lives import Lane, Lives
from sme_registry.jax.networks import HostWeights, Weights
from sme_registry.jax.padding import Dimensions, Padding
from sme_registry.jax.task import Shape, TaskParams
from sme_registry.jax.transition import States

Array = npt.NDArray[Any]

PIECE = 500
"""The most steps between two returns from compiled code."""

_JUDGED_AT_ONCE = 25  # steps of an episode


class StepLog(NamedTuple):
    """What happened in the steps of one `advance`; each array is `[steps, lanes]`.

    `reward` is R, the payout; `cost` and `safe_regret` are None without `safety`.
    """

    reward: Array
    regret: Array
    similarity: Array
    terminated: Array
    truncated: Array
    cost: Array | None = None
    safe_regret: Array | None = None

    @classmethod
    def joined(cls, logs: Sequence[StepLog]) -> StepLog:
        log: StepLog = jax.tree.map(lambda *rows: np.concatenate(rows), *logs)
        return log

    def rows(self, part: slice) -> StepLog:
        log: StepLog = jax.tree.map(lambda each: np.asarray(each)[part], self)
        return log


class Evaluation(NamedTuple):
    """Episodes of the present deterministic policies: sums over steps, `[lanes, episodes]`."""

    episode_return: Array
    length: Array
    regret: Array
    similarity: Array


class State(Protocol):
    """All that changes in a program: a pytree of arrays, such as a NamedTuple."""

    @property
    def weights(self) -> Weights:
        """By SB3's names, `[lanes, ...]`."""


class Program(ABC):
    """The lanes of one algorithm: `advance` until the budget is used, then `finish`.

    `specs` are those of the lanes without the copies that fill the program up to `lanes`; `steps`
    and `budget` are of each lane. `separable` (k = 1 and D = 0 in all tasks) says that the oracle
    can be asked later, for many steps at once.
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

    def __init__(
        self,
        settings: Any,
        specs: Sequence[Lane],
        seeds: Sequence[int],
        *,
        steps: int,
        action_range: str = "symmetric",
        lanes: int | None = None,
        shape: Shape | None = None,
        device: str | None = None,
        at_once: int = 1,
    ) -> None:
        """New lanes, before their first step; `at_once` programs share the device's memory."""
        self.settings, self.specs, self.budget = settings, tuple(specs), steps
        self.symmetric = action_range == "symmetric"
        self.lanes = len(specs) if lanes is None else lanes
        copies = self.lanes - len(specs)
        specs = [*specs, *[specs[0]] * copies]
        seeds = [*seeds, *[seeds[0]] * copies]
        self.device = find_device(device)
        self.lives, self.steps = Lives(specs, shape, self.device), 0
        self.separable = self.lives.separable
        A, S = self.params.W.shape[-2:]
        self._initial_weights = functools.partial(self.initial_weights, settings)
        full = Dimensions(S, A, self.lives.phases, self.params.form.distractors)
        self._padding = Padding(self._initial_weights, full)
        weights = [self._new_weights(*lane) for lane in zip(specs, seeds, strict=True)]
        stacked = {name: np.stack([lane[name] for lane in weights]) for name in weights[0]}
        keys = jax.vmap(jax.random.PRNGKey)(np.asarray(seeds, np.uint32))
        self._refuse_without_room(jax.eval_shape(self.initial_state, stacked, keys), at_once)
        self.state = self.initial_state(*jax.device_put((stacked, keys), self.device))

    @property
    def params(self) -> TaskParams:
        """The lanes' tasks of the next step, padded; leading axis `lanes`."""
        return self.lives.at(self.steps)

    @staticmethod
    @abstractmethod
    def initial_weights(
        settings: Any, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        """The weights of a new lane, by SB3's names."""

    @abstractmethod
    def initial_state(self, weights: Weights, keys: jax.Array) -> State:
        """All that changes, before the first step, for weights and random keys `[lanes, ...]`."""

    @staticmethod
    @abstractmethod
    def act(settings: Any, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        """One lane's deterministic actions `[..., A]` in its action range, or beyond it."""

    @abstractmethod
    def advance(self, limit: int) -> StepLog:
        """Go on to at most step `limit`, and stop *before* the update that follows the last step.

        An evaluation that is due at a step precedes that step's update, as in a study's cell.
        On-policy programs always collect a whole rollout, also beyond `limit`: the weights are the
        same in all of it.
        """

    @abstractmethod
    def finish(self) -> None:
        """Make the update that follows the last step."""

    def evaluate(self, states: Array, lifetime: int | None = None) -> Evaluation:
        """Run an episode from each of `states` `[lanes, episodes, S]` with the present weights.

        Of a stream, the tasks are those after `lifetime` steps; None for now. Equal states give
        equal distractors, as in `evaluation.rollouts`.
        """
        sums = _episodes(
            type(self).act,
            self.settings,
            self.symmetric,
            self.separable,
            self.state.weights,
            self.lives.at(self.steps if lifetime is None else lifetime),
            jax.device_put(np.asarray(states, np.float64), self.device),
        )
        return Evaluation(*(np.asarray(each) for each in sums))

    def weights(self, lane: int) -> dict[str, Array]:
        """A lane's weights without padding, by SB3's names, as NumPy arrays."""
        padded = {name: np.asarray(weight[lane]) for name, weight in self.state.weights.items()}
        return self._padding.remove(padded, self._dimensions(self.specs[lane]))

    def failed(self) -> Array:
        """`[lanes]`, whether a lane's weights are not finite; such lanes go on without effect."""
        return np.asarray(_not_finite(self.state.weights))

    def save(self) -> dict[str, Array]:
        """All state, as named arrays."""
        leaves = jax.tree_util.tree_leaves_with_path(self.state)
        arrays = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}
        return {"steps": np.asarray(self.steps), **arrays}

    def restore(self, arrays: dict[str, Array]) -> None:
        """Go on from saved state, bit for bit; a replay buffer may be that of a smaller budget.

        Raises OptionError, and changes nothing, if the state is damaged or another program's.
        """
        leaves, structure = jax.tree_util.tree_flatten_with_path(self.state)
        names = [jax.tree_util.keystr(path) for path, _ in leaves]
        if {"steps", *names} != arrays.keys():
            raise OptionError(
                "arrays: are the state of another program. Give those that a program of the same "
                "algorithm, hyperparameters and lanes saved."
            )
        steps = int(self._fitted("steps", arrays["steps"], np.asarray(self.steps)))
        restored = [
            jax.device_put(self._fitted(name, arrays[name], leaf), self.device)
            for name, (_, leaf) in zip(names, leaves, strict=True)
        ]
        self.state = jax.tree_util.tree_unflatten(structure, restored)
        self.steps = steps

    def _refuse_without_room(self, state: Any, at_once: int) -> None:
        """Raise ResourceLimitError if such a state would not fit in its share of the memory."""
        leaves = jax.tree.leaves(state)
        needed = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)
        room = memory_of(self.device)
        if room is not None and at_once * needed > room:
            fit = self.lanes * room // (at_once * needed)
            sharing = f" for {at_once} programs at once" if at_once > 1 else ""
            advice = "fewer steps or a smaller buffer_size" if self.buffer else "a smaller n_steps"
            raise ResourceLimitError(
                f"lanes={self.lanes:,}: their state takes {needed / 2**30:,.1f} GiB, and the "
                f"{self.device.platform} has {room / 2**30:,.1f} GiB to spare{sharing}: "
                f"{f'at most {fit:,} fit' if fit else 'not one fits'}. Choose "
                f"{'fewer lanes, ' if fit else ''}{'fewer programs, ' if sharing else ''}{advice}."
            )

    def _dimensions(self, lane: Lane) -> Dimensions:
        m = self.params.form.distractors
        return Dimensions(lane.state_dim, lane.action_dim, self.lives.phases, m)

    def _new_weights(self, lane: Lane, seed: int) -> HostWeights:
        own, rng = self._dimensions(lane), np.random.default_rng(seed)
        return self._padding.add(
            self._initial_weights(rng, own.observation_dim, own.action_dim), own
        )

    def _fitted(self, name: str, saved: Array, present: jax.Array | Array) -> Array:
        """A saved array, in the shape that it has here."""
        saved = np.asarray(saved)
        grows = self.buffer and name.startswith(f".{self.buffer}") and saved.ndim == present.ndim
        shape = (len(saved), *present.shape[1:]) if grows else present.shape
        if (
            saved.dtype != present.dtype
            or saved.shape != shape
            or (grows and len(saved) > len(present))
        ):
            raise OptionError(
                f"arrays[{name!r}]: is {saved.dtype} of shape {saved.shape}: must be "
                f"{present.dtype} of shape {present.shape}. Give the state of a program of the "
                "same lanes and tasks."
            )
        if saved.shape == present.shape:
            return saved
        longer = np.zeros(present.shape, present.dtype)
        longer[: len(saved)] = saved
        return longer


def check_room(new_program: Callable[[], Program]) -> None:
    """Raise ResourceLimitError if a program would not fit in memory; makes and compiles none."""
    jax.eval_shape(lambda: new_program().state)


def policy(
    kind: type[Program], settings: Any, weights: Mapping[str, Any], symmetric: bool
) -> Callable[[Array], Array]:
    """The deterministic policy of a lane's weights, without padding.

    It maps observations `[B, O]` float32 to actions `[B, A]` in the action range, or beyond it.
    """

    def act(observations: Array) -> Array:
        return np.asarray(_actions(kind.act, settings, symmetric, dict(weights), observations))

    return act


def hidden_layers(
    kind: type[Program], settings: Any, weights: Mapping[str, Any]
) -> Callable[[Array], list[Array]]:
    """The outputs `[B, H]` of each hidden layer of a lane's actor, of observations `[B, O]`."""

    def hidden(observations: Array) -> list[Array]:
        return [np.asarray(each) for each in _hidden(kind, settings, dict(weights), observations)]

    return hidden


@functools.partial(jax.jit, static_argnames=("kind", "settings"))
def _hidden(
    kind: type[Program], settings: Any, weights: Weights, observations: jax.Array
) -> list[jax.Array]:
    prefix, activation = kind.hidden
    return networks.hidden_layers(weights, prefix, observations, len(settings.net_arch), activation)


@functools.partial(jax.jit, static_argnames=("act", "settings", "symmetric"))
def _actions(
    act: Any, settings: Any, symmetric: bool, weights: Weights, observations: Array
) -> jax.Array:
    actions: jax.Array = act(settings, weights, observations, symmetric)
    return actions


@jax.jit
def _not_finite(weights: Weights) -> jax.Array:
    return ~jnp.stack(
        [jnp.isfinite(each).all(axis=tuple(range(1, each.ndim))) for each in weights.values()]
    ).all(axis=0)


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
    keys = jax.vmap(jax.vmap(_key_of))(states) if params.form.distractors else None

    def drawn(state: EnvState) -> Any:
        """The random numbers of the next step of each episode; None where it needs none."""
        if keys is None:
            return None
        steps = jax.vmap(jax.vmap(jax.random.fold_in))(keys, state.t)
        return _each(observing.drawn, steps, params=params)

    def chosen(state: EnvState) -> jax.Array:
        """Actions `[lanes, episodes, A]` of the unit range."""
        observations = _each(observe, state, params=params)
        actions = jax.vmap(lambda w, o: act(settings, w, o, symmetric))(weights, observations)
        return to_unit(actions, symmetric)

    def one_step(now: _Running) -> _Running:
        _, state, reward, done, info = _each(
            advance, now.state, chosen(now.state), drawn(now.state), params=params
        )
        here = (reward, jnp.ones_like(reward), info["regret"], info["similarity"])
        sums = jax.tree.map(lambda sum, x: sum + jnp.where(now.running, x, 0.0), now.sums, here)
        return _Running(state, sums, now.running & ~done)

    def one_piece(now: _Running) -> _Running:
        def move(state: EnvState, _: None) -> tuple[EnvState, tuple[States, jax.Array]]:
            a = chosen(state)
            return _each(moved, state, a, drawn(state), params=params), (state.s, a)

        state, (s, a) = jax.lax.scan(move, now.state, length=_JUDGED_AT_ONCE)
        judge = jax.vmap(oracle.judge, (0, 1, 1), 1)
        similarity, reward, *_ = judge(params, s, a)  # [piece, lanes, episodes]
        horizon = params.horizon[:, None]
        counted = now.state.t + jnp.arange(_JUDGED_AT_ONCE)[:, None, None] < horizon
        here = (reward, jnp.ones_like(reward), 1.0 - reward, similarity)
        sums = jax.tree.map(
            lambda sum, x: sum + jnp.where(counted, x, 0.0).sum(axis=0), now.sums, here
        )
        return _Running(state, sums, state.t < horizon)

    first = None if keys is None else _each(observing.first_distractors, keys, params=params)
    _, begin = _each(lambda s, d, p: start(s, p, d), states, first, params=params)
    zeros = jnp.zeros_like(begin.accumulated_reward)
    now = _Running(begin, (zeros,) * 4, jnp.ones_like(zeros, bool))
    body = one_piece if separable else one_step
    return jax.lax.while_loop(lambda now: now.running.any(), body, now).sums


def _key_of(s: jax.Array) -> jax.Array:
    """The key of an episode that begins in state s `[S]`, float64."""
    words = jax.lax.bitcast_convert_type(s, jnp.uint32)
    word = jax.lax.reduce(words, jnp.uint32(0), jax.lax.bitwise_xor, (0, 1))
    return jax.random.PRNGKey(word)


class _Running(NamedTuple):
    state: EnvState
    sums: tuple[jax.Array, ...]
    running: jax.Array


def _each(function: Any, *arguments: Any, params: TaskParams) -> Any:
    """`function(*arguments, params)` of each episode `[lanes, episodes]`."""
    episodes = jax.vmap(function, (*[0] * len(arguments), None))
    return jax.vmap(episodes)(*arguments, params)

"""`Task`: a spec's numbers and the equations over them, batch-first. This is the definition.

Source: METHOD, section 1. Axis letters: `B` batch, `S` state_dim, `A` action_dim.

    π*(s)    = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)      optimal policy, a Deep Uniform Network
    T(s, a)  = ψ(s + a W + b),  ψ(x) = 2 |x − rint x|   transition
    r̃(s, a)  = 1 − ‖a − π*(s)‖₁ / A                     similarity
    r̂(s, a)  = max(0, 4 (r̃ − ¾))
    r(s, a)  = r̂ if r̂ > r_min, else 0                   step reward; regret = 1 − r

With `safety` (METHOD, section 8), v another such network and τ its tightness:

    ℓ(s)       = 1 − 2τ v(s)                            limits of the action channels
    cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ)     in [0, 1]
    a_safe(s)  = min(π*(s), ℓ(s))                       the best action of cost 0

With `observation` (METHOD, section 9) the agent sees x = M(s, d) in place of s, of distractors d
that move by a transition of their own, and an invertible map M.

With `shaping` (METHOD, section 10), c its scale, g its discount, and one uniform layer φ:

    P_t(s) = c (1 − t/T) φ(s)                           potential, 0 after a termination

With `noise` (METHOD, section 12), ξ and ζ standard normal, and σ_r and σ_s of float32, T(s, a) is
ψ(s + a W + b + σ_s ζ).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from sme_registry.errors import ActionError, SpecError, StateError
from sme_registry.spec import SMESpec
from sme_registry.task.draw import Array as Array
from sme_registry.task.draw import Layer

Observation: TypeAlias = npt.NDArray[np.float32]  # each entry in [0, 1]
Action: TypeAlias = npt.NDArray[np.floating[Any]]  # of an agent, in its environment's range
Mask: TypeAlias = npt.NDArray[np.bool_]  # `[B]` which environments
Indices: TypeAlias = npt.NDArray[np.int64]  # of environments, or a count for each of them

NUMBERS = {
    "similarity": "",
    "step_reward": "",
    "regret": "",
    "reward": "",
    "accumulated_reward": "",
    "cost": "safety",
    "safe_regret": "safety",
    "price": "compensated",
    "shaping": "shaping",
    "reward_noise": "reward_noise",
}
"""What one step computes for n agents in B environments, the rows of `values` `[5 … 10, n, B]`; and
the attribute of the spec without which a task has no such number."""
SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
COST, SAFE_REGRET, PRICE, SHAPING, REWARD_NOISE = range(5, len(NUMBERS))

ON_TOP = "price", "shaping", "reward_noise"
"""What is paid on top of the payout R."""

ACTIONS = {"optimal_action": "", "limit": "safety", "safe_action": "safety"}
"""The rows of `actions` `[1 or 3, B, A]`, likewise."""

# A single environment is one buffer: t, the values of its last step, of which it keeps r_cum, the
# state s `[S]`, and its own random numbers: their key, how many its distractors have drawn, and
# d `[m]`; and the noise of the next step: how many have drawn it before, ξ `[n]` and ζ `[S]`.
BUFFER_T, BUFFER_VALUES, BUFFER_STATE = 0, 1, 1 + len(NUMBERS)
OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)


def own_rows(spec: SMESpec) -> int:
    """How many numbers an environment has of its own: OWN_KEY and those after it."""
    return OWN_DISTRACTORS + spec.distractors + 1 + len(spec.agents) + spec.state_dim


_LARGEST = 1e300  # beyond it W s could overflow, and π* be NaN


@dataclass(frozen=True, eq=False)
class Task:
    """A drawn task: pure, read-only, safe to share between environments and threads.

    Its methods take one state `[S]` or a batch `[B, S]`, also outside the unit cube, and return one
    value or a batch. Actions are clipped to [0, 1]. States of the wrong shape or not finite raise
    StateError, and such actions ActionError.

    Attributes:
      spec: the spec from which it was drawn.
      W: `[A, S]` transition matrix; entries in [0, 1] on the grid 2⁻²⁹, each row sums to 1.
      b: `[S]` transition offset in (0, 1).
      policies: the layers of each agent's optimal policy; one entry where there is no team.
      observed: the state channels that each agent observes.
      limiting: the layers of v; empty without `safety`.
      distractor_transition: W `[A, m]` and b `[m]` of autonomous and driven distractors; else None.
      mixing: the layers of M, from `[S + m]` to `[S + m]`; empty without a mixing.
      shaping: the layer of φ; empty without `shaping`.

    Examples:
      >>> task = sme_registry.materialize(sme_registry.SMESpec())
      >>> states = np.random.default_rng(0).random((100, 8))
      >>> actions = np.full((100, 4), 0.5)
      >>> task.regret(states, actions).shape
      (100,)
      >>> task.transition(states, actions).shape
      (100, 8)
    """

    spec: SMESpec
    W: Array
    b: Array
    policies: tuple[tuple[Layer, ...], ...]
    observed: tuple[tuple[int, ...], ...]
    limiting: tuple[Layer, ...] = ()
    distractor_transition: tuple[Array, Array] | None = None
    mixing: tuple[Layer, ...] = ()
    shaping: tuple[Layer, ...] = ()

    def __repr__(self) -> str:
        return f"<Task of {self.spec!r}>"

    @property
    def arrays(self) -> Iterator[Array]:
        yield from (self.W, self.b, *(self.distractor_transition or ()))
        for layers in (*self.policies, self.limiting, self.mixing, self.shaping):
            for layer in layers:
                yield from layer

    @property
    def layers(self) -> list[Layer] | list[list[Layer]]:
        """`(W [out, in], b [out])` of each layer of π*; for teams a list of such lists."""
        if self.spec.team is None:
            return list(self.policies[0])
        return [list(policy) for policy in self.policies]

    @property
    def names(self) -> tuple[str, ...]:
        """The agents, in the order of the channels that they own; one without a team."""
        return tuple(agent.name for agent in self.spec.agents)

    @property
    def owned(self) -> tuple[slice, ...]:
        """The action channels that each agent owns."""
        widths = [agent.action_dim for agent in self.spec.agents]
        ends = accumulate(widths)
        return tuple(slice(end - width, end) for width, end in zip(widths, ends, strict=True))

    @property
    def pays_the_team(self) -> bool:
        """Whether every agent is paid for the mean similarity over all channels."""
        return self.spec.team is not None and self.spec.team.reward == "team"

    @property
    def sigmas(self) -> tuple[float, float]:
        """σ_r and σ_s, of float32, so that products with float32 numbers are exact; or 0."""
        noise = self.spec.noise
        return (0.0, 0.0) if noise is None else (_rounded(noise.reward), _rounded(noise.transition))

    def transition(
        self, s: npt.ArrayLike, a: npt.ArrayLike, noise: npt.ArrayLike | None = None
    ) -> Array:
        """The next state ψ(s + a W + b), `[B, S]` or `[S]` in [0, 1].

        `noise` is ζ, of the shape of the states; None is 0, the transition without noise.
        """
        s, a = self._pairs(s, a)
        shift = None if noise is None else self.sigmas[1] * self._states(noise)
        return _moved(s, a, self.W, self.b, shift)

    def optimal_action(self, s: npt.ArrayLike) -> Array:
        """π*(s), the unique action of regret 0: `[B, A]` or `[A]` in [0, 1]."""
        return self.policy(self._states(s))

    def similarity(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """r̃ = 1 − ‖a − π*(s)‖₁ / A, `[B]` or a scalar, in [0, 1]; exactly 1 at the optimum."""
        s, a = self._pairs(s, a)
        return self.similarity_of(a, self.policy(s))

    def step_reward(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """r, `[B]` or a scalar, in [0, 1]: the step reward after the threshold r_min."""
        return self.reward_of(self.similarity(s, a))

    def regret(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """1 − r, `[B]` or a scalar, in [0, 1]: by how much the optimal step reward exceeds r."""
        return 1.0 - self.step_reward(s, a)

    def potential(self, s: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        """P_t(s) after `t` steps, `[B]` or a scalar, in [0, c]; 0 without `shaping`."""
        s = self._states(s)
        if self.spec.shaping is None:
            return np.zeros(s.shape[:-1])[()]
        # Each state a contiguous matrix of one row, so that bits do not depend on the batch.
        phi = through(self.shaping, np.ascontiguousarray(s)[..., None, :])[..., 0, 0]
        left = 1.0 - np.asarray(t) / self.spec.horizon
        return self.spec.shaping.scale * left * phi

    def limit(self, s: npt.ArrayLike) -> Array:
        """ℓ, the limits of the action channels, `[B, A]` or `[A]` in [1 − 2τ, 1]; else 1."""
        return self._limit(self._states(s))

    def safe_action(self, s: npt.ArrayLike) -> Array:
        """min(π*, ℓ), `[B, A]` or `[A]`: the action of cost 0 nearest to π*; none earns more."""
        s = self._states(s)
        return np.minimum(self.policy(s), self.limit(s))

    def cost(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """The mean excess over the limits, over 2τ: `[B]` or a scalar, in [0, 1]."""
        s, a = self._pairs(s, a)
        return self.cost_of(a, self.limit(s))

    def limit_of(self, v: Array) -> Array:
        """ℓ = 1 − 2τ v of the outputs of v, of any shape."""
        return 1.0 - 2.0 * self.spec.tightness * v

    def cost_of(self, a: Array, limit: Array) -> Array:
        """The cost of actions in [0, 1] under limits, `[..., A]` each."""
        if not self.spec.tightness:
            return np.zeros(a.shape[:-1])
        excess = np.maximum(0.0, a - limit).sum(axis=-1)
        return cast(Array, excess / (2.0 * self.spec.tightness * self.spec.action_dim))

    def safe_reward_of(self, optimal: Array, limit: Array) -> Array:
        """r of the best safe action, `[...]`, from π* and limits, `[..., A]` each."""
        return self.reward_of(self.similarity_of(np.minimum(optimal, limit), optimal))

    def distractor_step(self, d: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """The next distractors ψ(d + u W + b), `[B, m]` or `[m]`, as `transition` computes it.

        `u` `[B, A]` or `[A]` drives them: uniform random numbers, or the agent's actions.
        """
        if self.distractor_transition is None:
            has = "has noise, drawn anew each step" if self.spec.distractors else "has none"
            raise SpecError(
                f"distractor_step: needs distractors with a transition; this task {has}. Give its "
                "spec observation with distractors, of dynamics='autonomous' or 'driven'."
            )
        d, u = self._distractors(d), self._actions(u)
        _check_equal_length("action", u, d, "one row for each of the {} distractors", ActionError)
        return _moved(d, u, *self.distractor_transition)

    def seen(self, s: npt.ArrayLike, d: npt.ArrayLike | None = None) -> Array:
        """M(s, d), what the agent sees: `[B, S + m]` or `[S + m]`; one of s and d may be single."""
        x, d = self._states(s), self._distractors(np.empty(0) if d is None else d)
        _check_equal_length("distractors", d, x, "one row for each of the {} states", StateError)
        if self.spec.distractors:
            rows = np.broadcast_shapes(x.shape[:-1], d.shape[:-1])
            both = [np.broadcast_to(part, (*rows, part.shape[-1])) for part in (x, d)]
            x = np.concatenate(both, axis=-1)
        if self.spec.mixing == "orthogonal":
            ((W, b),) = self.mixing
            return x @ W.T + b
        return through(self.mixing, x)

    def unmixed(self, x: npt.ArrayLike) -> Array:
        """The state and distractors behind what the agent sees, M⁻¹(x): `[B, S + m]` or `[S + m]`.

        `x` is an observation without t/T and r_cum/k. Of float32 observations, exact to about 1e-7
        times the condition number of M.
        """
        y = _checked(x, self.spec.state_dim + self.spec.distractors, "observation", StateError)
        for W, b in reversed(self.mixing):
            if self.spec.mixing == "nonlinear":
                # Rounding can give 0 or 1, of which Φ⁻¹ is infinite.
                y = ndtri(np.clip(y, 2.0**-25, 1.0 - 2.0**-25))
            y = np.asarray(np.linalg.solve(W, (y - b).T).T, dtype=np.float64)
        return y

    def reward_of(self, similarity: npt.ArrayLike) -> Array:
        """The step reward r of similarities r̃, of any shape."""
        graded = np.maximum(0.0, 4.0 * (np.asarray(similarity) - 0.75))
        return cast(Array, np.where(graded > self.spec.r_min, graded, 0.0)[()])

    def similarity_of(self, a: Array, optimal: Array) -> Array:
        """r̃ of actions in [0, 1] and the optimal ones, `[..., A]` each."""
        return cast(Array, 1.0 - np.abs(a - optimal).sum(axis=-1) / self.spec.action_dim)

    def similarities_of(self, a: Array, optimal: Array) -> Array:
        """Each agent's r̃ over its own channels, `[..., n]` of actions `[..., A]`."""
        widths = [agent.action_dim for agent in self.spec.agents]
        return 1.0 - self._distances(a, optimal) / widths

    def _distances(self, a: Array, optimal: Array) -> Array:
        distance = np.abs(a - optimal)
        sums = [distance[..., channels].sum(axis=-1) for channels in self.owned]
        return np.stack(sums, axis=-1)

    def regret_shares(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """Each agent's share of the team's regret, `[B, n]` or `[n]`; they add up to it.

        regret · d_i / Σ_j d_j, with d_i the L1 distance of agent i's action from its optimal one.
        """
        s, a = self._pairs(s, a)
        optimal = self.policy(s)
        distances = self._distances(a, optimal)
        total = distances.sum(axis=-1, keepdims=True)
        shares = np.divide(distances, total, out=np.zeros_like(distances), where=total > 0)
        regret = 1.0 - self.reward_of(self.similarity_of(a, optimal))
        return cast(Array, shares * np.asarray(regret)[..., None])

    def difference_rewards(self, s: npt.ArrayLike, a: npt.ArrayLike) -> Array:
        """The team's gain if one agent acted optimally, `[B, n]` or `[n]`, in [0, 1]."""
        s, a = self._pairs(s, a)
        optimal = self.policy(s)
        as_is = self.reward_of(self.similarity_of(a, optimal))
        gains = []
        for channels in self.owned:
            corrected = a.copy()
            corrected[..., channels] = optimal[..., channels]
            gains.append(self.reward_of(self.similarity_of(corrected, optimal)) - as_is)
        return np.stack(gains, axis=-1)

    def policy(self, s: Array) -> Array:
        """π* of states `[..., S]`, unchecked: each agent's layers over what it observes."""
        actions = []
        for channels, layers in zip(self.observed, self.policies, strict=True):
            # `take`, since the rows of s[..., channels] are not contiguous, and BLAS would then sum
            # a batch in another order than its lanes.
            x = s if len(channels) == self.spec.state_dim else s.take(channels, axis=-1)
            actions.append(through(layers, x))
        return np.concatenate(actions, axis=-1) if len(actions) > 1 else actions[0]

    def _limit(self, s: Array) -> Array:
        if not self.limiting:
            return np.ones((*s.shape[:-1], self.spec.action_dim))
        return self.limit_of(through(self.limiting, s))

    def _pairs(self, s: npt.ArrayLike, a: npt.ArrayLike) -> tuple[Array, Array]:
        """Checked states and actions; one of them may be single while the other is a batch."""
        s, a = self._states(s), self._actions(a)
        _check_equal_length("action", a, s, "one action for each of the {} states", ActionError)
        return s, a

    def _states(self, s: npt.ArrayLike) -> Array:
        return _checked(s, self.spec.state_dim, "state", StateError)

    def _distractors(self, d: npt.ArrayLike) -> Array:
        return _checked(d, self.spec.distractors, "distractors", StateError)

    def _actions(self, a: npt.ArrayLike) -> Array:
        return np.clip(_checked(a, self.spec.action_dim, "action", ActionError), 0.0, 1.0)


def through(layers: Iterable[Layer], x: Array) -> Array:
    """The output of uniform layers, Φ(W x + b) of each, of inputs `[..., in]`."""
    for W, b in layers:
        x = ndtr(x @ W.T + b)
    return x


def _rounded(number: float) -> float:
    return float(np.float32(number))


def _moved(s: Array, a: Array, W: Array, b: Array, shift: Array | None = None) -> Array:
    """ψ(s + a W + b + shift) of states `[..., S]` and actions `[..., A]`."""
    # In a fixed order, and over actions of float32, which makes each product exact: so every
    # back-end gets the same bits.
    y = s + b
    for i in range(len(W)):
        y = y + W[i] * a[..., i, None].astype(np.float32).astype(np.float64)
    if shift is not None:
        y = y + shift
    return np.asarray(2.0 * np.abs(y - np.rint(y)))


def _check_equal_length(
    name: str, values: Array, others: Array, rule: str, error: type[Exception]
) -> None:
    if values.ndim == others.ndim == 2 and len(values) != len(others):
        raise error(
            f"{name} of shape {values.shape}: must be [{len(others)}, {values.shape[1]}], "
            f"{rule.format(len(others))}."
        )


def _checked(values: npt.ArrayLike, width: int, name: str, error: type[Exception]) -> Array:
    """`values` as float64 of shape `[..., width]`, finite."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise error(f"{name}={values!r:.80}: must be an array of {width} numbers.") from None
    if array.ndim not in (1, 2) or array.shape[-1] != width:
        field = "number of distractors" if name == "distractors" else f"{name}_dim"
        raise error(
            f"{name} of shape {array.shape}: must be [{width}] or [B, {width}] "
            f"(this task's {field} is {width})."
        )
    if not (np.abs(array) < _LARGEST).all():
        raise error(
            f"{name}: has NaN or infinite entries. Every entry must be a finite number, and below "
            f"{_LARGEST:g} in size."
        )
    return array

"""What a policy does: runs of a submission that repeat one policy, and copies of other entries.

Bytes prove nothing: permuted units or a little noise give another file. Policies are therefore
compared by their actions a in states of which half are in the training cube, half outside it, up
to the outermost face of the protocol. Within a submission the seed of these states,

    SHA-256(protocol digest, spec digest, submission id)

is unknown until all its policies are fixed, so none can be altered in them alone. In the same
states of one instance, inside or outside:

    d(i, j)  = mean |a_i − a_j|                             distance of two runs
    u(i)     = min(mean |a_i − a*|, mean |a_i − E a_i|)     its error, or its variation if smaller
    repeated if d ≤ max(FRACTION min(u(i), u(j)), FLOOR)

Policies that hardly vary are exempt: agents often collapse to one constant, which scores 1 or
worse, and repeating it gains nothing. Between submissions, policies are copies if their actions in
the board's states, which all submissions share, are exactly equal.

The smallest d / min(u, u') of three runs, inside and outside, on Default (S = 8, π* of one layer)
and Plane10 (S = 2, ten layers):

                                          Default          Plane10
    PPO, 2,048 steps                      1.20   1.14
    PPO, 20,480 steps                     0.82   0.76      0.25   0.090
    PPO, 102,400; TD3, 3,000 steps        0.53   0.60      1.68   1.73
    SAC, 2,500 steps                      0.55   0.53
    network fitted to π*, 1,500 updates   0.87   0.64      0.47   0.59
    network fitted to π*, 100 updates     0.23   0.33      0.087  0.076
    linear map fitted to 200 states       0.36   0.41      0.084  0.052
    linear map fitted to 10,000 states    0.047  0.059     0.012  0.010
    a copy, its weights with 1 % noise    0.030  0.020     0.057  0.028
    a copy, its weights with 5 % noise    0.15   0.10      0.27   0.15

A method whose runs differ as little as copies with 1 % noise gives one policy for every seed.

`B` states of a half, `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.errors import Rejection
from sme_registry import SMESpec, materialize
from sme_registry.compiled import engine
from sme_registry.evaluation import as_policy
from sme_registry.spec import EvaluationProtocol

FRACTION, FLOOR = 0.03, 1e-5
CONSTANT = 1e-3
"""Policies whose actions vary by less, mean |a − E a| over the states, are not compared."""

STATES = 256
"""States inside the cube, and as many outside."""

COMPARED = 4 * STATES
"""States in which a run is observed: its submission's, and the board's."""

_Array = npt.NDArray[np.float64]
_WHERE = ("inside", "outside")


@dataclass(frozen=True, eq=False)
class _Actions:
    """A run's actions in one half: `[B, A]`, and their u; 0 if constant."""

    a: _Array
    u: float


class Behaviours:
    """The behaviour of a submission's runs, in the order in which they are observed.

    Args:
      protocol: the board's.
      submission: the submission's id.
    """

    def __init__(self, protocol: EvaluationProtocol, submission: str) -> None:
        self._protocol, self._submission = protocol, submission
        self._runs: dict[str, list[tuple[str, list[_Actions]]]] = defaultdict(list)

    def observe(self, run: str, spec: SMESpec, policy: Callable[[Any], Any]) -> str | None:
        """Compare a run's policy with those observed before.

        Args:
          run: what to call the run in an error.
          spec: its instance.
          policy: from observations to actions of the unit range, as `evaluate` accepts it.

        Returns:
          The digest of its actions in the board's states; None if it hardly varies there.

        Raises:
          Rejection: `run_repeated`.
          PolicyError: the policy fails.
        """
        prepared = as_policy(policy, spec, action_range="unit")
        actions = self._actions(spec, prepared, self._submission)
        for earlier, others in self._runs[spec.digest]:
            for where, one, other in zip(_WHERE, actions, others, strict=True):
                _refuse_repeated(earlier, where, one, other)
        self._runs[spec.digest].append((run, actions))
        shared = self._actions(spec, prepared, "")
        if not all(half.u for half in shared):
            return None
        data = b"".join(half.a.astype("<f4").tobytes() for half in shared)
        return f"sha256:{hashlib.sha256(data).hexdigest()}"

    def _actions(
        self, spec: SMESpec, policy: Callable[[Any], _Array], states_of: str
    ) -> list[_Actions]:
        """The actions inside and outside, in the states of a submission, or of the board ("")."""
        optimal_action = engine(materialize(spec)).optimal_action
        actions = []
        for observations in _observations(spec, self._protocol, states_of):
            a = np.clip(policy(observations), 0.0, 1.0)
            optimal = optimal_action(observations[:, : spec.state_dim].astype(np.float64))
            variation = float(np.abs(a - a.mean(axis=0)).mean())
            error = float(np.abs(a - optimal).mean())
            u = 0.0 if variation < CONSTANT else min(variation, max(error, FLOOR))
            actions.append(_Actions(a, u))
        return actions


def _refuse_repeated(earlier: str, where: str, one: _Actions, other: _Actions) -> None:
    u = min(one.u, other.u)
    if not u:
        return
    distance, least = float(np.abs(one.a - other.a).mean()), max(FRACTION * u, FLOOR)
    if distance <= least:
        raise Rejection(
            "run_repeated",
            f"mean |a − a'|={distance:.2g} {where} the training cube, where a' are the actions of "
            f"{earlier} in the same states: must be above {least:.2g}. Runs are independent "
            "trainings: a method that gives nearly the same policy for every seed is one run on "
            "each instance. List it once, or train each run on data of its own.",
        )


def _observations(
    spec: SMESpec, protocol: EvaluationProtocol, states_of: str
) -> list[npt.NDArray[np.float32]]:
    """`[B, S + 2]` observations in uniform states inside the training cube, and outside it."""
    S, T = spec.state_dim, spec.horizon
    text = "\n".join((protocol.digest, spec.digest, states_of))
    bits = np.random.PCG64(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))
    halves = []
    for reach in (1.0, 1.0 + protocol.edges[-1][1]):
        # Unlike a `Generator`'s, the same for every version of NumPy.
        u = (bits.random_raw(STATES * (S + 2)) >> np.uint64(11)).reshape(STATES, S + 2) * 2.0**-53
        x, radius, time = 2.0 * u[:, :S] - 1.0, u[:, S], u[:, S + 1]
        if reach > 1.0:
            x *= (1.0 + radius * (reach - 1.0))[:, None] / np.abs(x).max(axis=1, keepdims=True)
        observations = np.zeros((STATES, S + 2), np.float32)
        observations[:, :S] = 0.5 + x / 2.0
        observations[:, S] = np.floor(time * T) / T
        halves.append(observations)
    return halves

"""What a policy does: runs of a submission that repeat one policy, and sketches for finding copies.

Bytes prove nothing: permuted units or a little noise give another file. Policies are therefore
compared by their actions a in probe states, next to the optimal actions a*. Half of the states are
in the training cube, half outside it, up to the outermost face of the protocol. Their seed,

    SHA-256(protocol digest, spec digest, submission id)

is unknown until all policies of the submission are fixed, so none can be altered in them alone.

Within a submission, in the same states of one instance, inside or outside:

    d(i, j)  = mean |a_i − a_j|                             distance of two runs
    u(i)     = min(mean |a_i − a*|, mean |a_i − E a_i|)     its error, or its variation if smaller
    repeated if d ≤ max(FRACTION min(u(i), u(j)), FLOOR)

Policies that hardly vary are exempt: agents often collapse to one constant, which scores 1 or
worse, and repeating it gains nothing. Between submissions, `documents.sketch` compares sketches.

The smallest d / min(u, u') of three runs, inside and outside, and whether sketches are alike, on
Default (S = 8, π* of one layer) and Plane10 (S = 2, ten layers):

                                          Default                 Plane10
    PPO, 2,048 steps                      1.20   1.14   no
    PPO, 20,480 steps                     0.82   0.76   no        0.25   0.090  no
    PPO, 102,400; TD3, 3,000 steps        0.53   0.60   no        1.68   1.73   no
    SAC, 2,500 steps                      0.55   0.53   no
    network fitted to π*, 1,500 updates   0.87   0.64   no        0.47   0.59   no
    network fitted to π*, 100 updates     0.23   0.33   no        0.087  0.076  no
    linear map fitted to 200 states       0.36   0.41   no        0.084  0.052  no
    linear map fitted to 10,000 states    0.047  0.059  yes       0.012  0.010  yes
    a copy, its weights with 1 % noise    0.030  0.020  yes       0.057  0.028  mostly
    a copy, its weights with 5 % noise    0.15   0.10   no        0.27   0.15   no

A method whose runs differ as little as copies with 1 % noise gives one policy for every seed.

`B` probe states of a half, `S` state_dim, `A` action_dim, `K` features.
"""

from __future__ import annotations

import functools
import hashlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri
from scipy.stats import qmc

from leaderboard.documents import sketch
from leaderboard.errors import Rejection
from sme_registry import SMESpec, materialize
from sme_registry.compiled import engine
from sme_registry.evaluation import as_policy
from sme_registry.spec import EvaluationProtocol

FRACTION, FLOOR = 0.03, 1e-5
CONSTANT = 1e-3
"""Policies whose actions vary by less, mean |a − E a| over the states, are not compared."""

STATES = 2**13
"""Probe states inside the cube, and as many outside."""

PROBES = 2 * STATES

COMPARED = 256
"""States of each half in which the runs of a submission are compared."""

_Array = npt.NDArray[np.float64]
_WHERE = ("inside", "outside")

# SciPy loads a table for the first generator, in code that loses an interrupt and prints it. In a
# scorer's process, interrupts are blocked while this module is imported.
qmc.Sobol(1)


@dataclass(frozen=True, eq=False)
class _Half:
    """Half of the probe states.

    Attributes:
      observations: `[B, S + 2]`.
      optimal: `[B, A]` π*.
      features: `[B, K]` ψ.
    """

    observations: npt.NDArray[np.float32]
    optimal: _Array
    features: _Array


@dataclass(frozen=True, eq=False)
class _Actions:
    """A run's actions in the compared states of one half: `[B, A]`, and their u; 0 if constant."""

    a: npt.NDArray[np.float32]
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

    def observe(self, run: str, spec: SMESpec, policy: Callable[[Any], Any]) -> str:
        """Compare a run's policy with those observed before, and sketch it.

        Args:
          run: what to call the run in an error.
          spec: its instance.
          policy: from observations to actions of the unit range, as `evaluate` accepts it.

        Returns:
          The sketch as text; empty if the policy hardly varies inside or outside.

        Raises:
          Rejection: `run_repeated`.
          PolicyError: the policy fails.
        """
        prepared = as_policy(policy, spec, action_range="unit")
        halves = _halves(spec, self._protocol, self._submission)
        actions = [np.clip(prepared(half.observations), 0.0, 1.0) for half in halves]
        compared = [
            _compared(a[:COMPARED], half.optimal[:COMPARED])
            for a, half in zip(actions, halves, strict=True)
        ]
        for earlier, others in self._runs[spec.digest]:
            for where, one, other in zip(_WHERE, compared, others, strict=True):
                _refuse_repeated(earlier, where, one, other)
        self._runs[spec.digest].append((run, compared))
        if not all(half.u for half in compared):
            return ""
        return _sketch(spec, halves, actions)


def _compared(a: _Array, optimal: _Array) -> _Actions:
    variation = float(np.abs(a - a.mean(axis=0)).mean())
    error = float(np.abs(a - optimal).mean())
    u = 0.0 if variation < CONSTANT else min(variation, max(error, FLOOR))
    return _Actions(a.astype(np.float32), u)


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


def _halves(spec: SMESpec, protocol: EvaluationProtocol, submission: str) -> list[_Half]:
    """The probe states of a submission on an instance, inside and outside the training cube."""
    S, T = spec.state_dim, spec.horizon
    bits = np.random.PCG64(_seed(protocol.digest, spec.digest, submission))
    outer = 1.0 + protocol.edges[-1][1]
    w, b = _waves(spec)
    optimal_action = engine(materialize(spec)).optimal_action
    halves = []
    for reach in (1.0, outer):
        u = (_lattice(S + 2) + _uniform(bits, S + 2)) % 1.0
        x, radius, time = 2.0 * u[:, :S] - 1.0, u[:, S], u[:, S + 1]
        if reach > 1.0:
            x *= (1.0 + radius * (reach - 1.0))[:, None] / np.abs(x).max(axis=1, keepdims=True)
        observations = np.zeros((STATES, S + 2), np.float32)
        observations[:, :S] = 0.5 + x / 2.0
        observations[:, S] = np.floor(time * T) / T
        optimal = optimal_action(observations[:, :S].astype(np.float64))
        features = np.sqrt(2.0) * np.cos(x / reach @ w + b)
        halves.append(_Half(observations, optimal, features))
    return halves


@functools.cache
def _lattice(dim: int) -> _Array:
    """`[B, dim]` Sobol' points in [0, 1), to shift at random.

    Means over them vary less than over random points. In few dimensions the features are strongly
    correlated, and means over random points would too often lie beyond what their variance allows.
    """
    return np.asarray(qmc.Sobol(dim, scramble=False).random(STATES))


def _waves(spec: SMESpec) -> tuple[_Array, _Array]:
    """The features' `[S, K]` frequencies, at which w·x has unit variance, and `[K]` phases."""
    S, K = spec.state_dim, sketch.FEATURES
    bits = np.random.PCG64(_seed("waves", spec.digest))
    return ndtri(_uniform(bits, S, K)) * np.sqrt(3.0 / S), 2.0 * np.pi * _uniform(bits, K)


def _mixtures(spec: SMESpec) -> _Array:
    """The features' `[A, K]` mixtures of action channels."""
    A, K = spec.action_dim, sketch.FEATURES
    bits = np.random.PCG64(_seed("mixtures", spec.digest))
    return np.asarray(ndtri(_uniform(bits, A, K)) / np.sqrt(A))


def _sketch(spec: SMESpec, halves: list[_Half], actions: list[_Array]) -> str:
    g = _mixtures(spec)
    moments, noise, scale = [], [], []
    for half, a in zip(halves, actions, strict=True):
        error = a - half.optimal
        terms = error @ g * half.features
        moments.append(terms.mean(axis=0))
        noise.append(terms.var(axis=0).mean() / len(terms))
        scale.append(min(max(_rms(error), FLOOR), _rms(a - a.mean(axis=0))))
    return sketch.to_text(np.array(moments), np.array(noise), np.array(scale))


def _rms(values: _Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _seed(*parts: str) -> int:
    return int.from_bytes(hashlib.sha256("\n".join(parts).encode()).digest()[:16], "big")


def _uniform(bits: np.random.PCG64, *shape: int) -> _Array:
    """Numbers in (0, 1); unlike a `Generator`'s, the same for every version of NumPy."""
    raw = bits.random_raw(int(np.prod(shape))).reshape(shape)
    return np.asarray(((raw >> np.uint64(11)) + 0.5) * 2.0**-53, dtype=np.float64)

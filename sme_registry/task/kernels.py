"""The step as machine code, for one environment and for a batch; always equal to the definition.

Both do the same floating-point operations in the same order for each environment (each sum runs
over its inputs in ascending order, no fused or re-associated arithmetic), so a batch equals its
singles bit for bit; and the transition's are those of `Task.transition`, so states do too.
What differs is only where the loops are: a single one runs over channels, a batch over blocks of
environments, channel by channel, so that the inner loop is long enough to fill vector registers.

A task travels as one flat float64 array, because each array argument costs a call 40 ns:
    S, A, k, T, r_min, D, agents, widest layer, size of all this, pays the team (0 or 1),
    m, τ (0 without safety), how distractors move (an index of `_DYNAMICS`), whether layers of the
    mixing end with Φ (0 or 1), how many layers limit, how many mix, an environment's own numbers,
    c and g of the shaping, σ_r, σ_s, whether the price is paid (0 or 1),
    W [A, S], b [S], for each agent
    inputs, L, observed channels [inputs], for each layer  in, out, W transposed [in, out], b [out],
    the limiting layers, W [A, m] and b [m] of distractors with a transition, the mixing layers,
    W [S] and b of φ.
The buffer of a single environment follows it in the same array where the task is small (another
40 ns), and stands alone where it is not, so that environments can share it:
    t, the values of the last step [10] (`task.NUMBERS`; r_cum is among them), s [S],
    its own numbers (`task.own_rows`), room for two layers [2 × widest].

Numba's disk cache does not know a function's flags: never compile one of these a second way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import boolean, float32, float64, int64, njit, types, uint64, void
from numba.extending import intrinsic
from scipy.special import ndtr

from sme_registry.task import Task
from sme_registry.task.draw import FIRST_MIX, GOLDEN, SECOND_MIX, Layer
from sme_registry.task.task import (
    ACCUMULATED_REWARD,
    BUFFER_STATE,
    BUFFER_T,
    BUFFER_VALUES,
    COST,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    PRICE,
    REGRET,
    REWARD,
    REWARD_NOISE,
    SAFE_REGRET,
    SHAPING,
    SIMILARITY,
    STEP_REWARD,
    Array,
    own_rows,
)

_BLOCK_NUMBERS = 4096  # of one layer's block: 32 KiB, so that a block stays in cache
_HEADER = 22
_NARROW = 16  # below it a matrix product over rows beats the vectorised one over columns
_DYNAMICS = None, "noise", "autonomous", "driven"
_NOISE, _AUTONOMOUS, _DRIVEN = 1, 2, 3


def pack(task: Task) -> Array:
    spec, networks = task.spec, (*task.policies, task.limiting, task.mixing)
    shaping = spec.shaping
    dynamics, uniform = _DYNAMICS.index(spec.dynamics), spec.mixing == "nonlinear"
    sides = (side for layers in networks for W, _ in layers for side in W.shape)
    widest = max(spec.state_dim + spec.distractors, *sides)
    parts: list[npt.ArrayLike] = [
        [spec.state_dim, spec.action_dim, spec.k, spec.horizon, spec.r_min, spec.D],
        [len(task.policies), widest, 0.0, task.pays_the_team, spec.distractors, spec.tightness],
        [dynamics, uniform, len(task.limiting), len(task.mixing), own_rows(spec)],
        [shaping.scale, shaping.discount] if shaping is not None else [0.0, 0.0],
        [*task.sigmas, spec.compensated],
        task.W.ravel(),
        task.b,
    ]
    for observed, layers in zip(task.observed, task.policies, strict=True):
        parts += [[len(observed), len(layers)], observed, *_layer_parts(layers)]
    parts += _layer_parts(task.limiting)
    parts += [array.ravel() for array in task.distractor_transition or ()]
    parts += _layer_parts(task.mixing)
    parts += [array.ravel() for layer in task.shaping for array in layer]
    packed = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
    packed[8] = packed.size
    return packed


def pack_layers(layers: Sequence[Layer]) -> Array:
    """Layers as one flat array: how many, the widest, and each as in a packed task."""
    widest = max(max(W.shape) for W, _ in layers)
    parts = [np.array([len(layers), widest]), *_layer_parts(layers)]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _layer_parts(layers: Sequence[Layer]) -> list[npt.ArrayLike]:
    return [part for W, b in layers for part in (W.shape[::-1], W.T.ravel(), b)]


def buffer_size(packed: Array) -> int:
    """The size of a single environment's own part."""
    return BUFFER_STATE + int(packed[0]) + int(packed[16]) + 2 * int(packed[7])


# Φ, the standard normal CDF, by a table of polynomials: several times the speed of `erfc`, whose
# branches keep it from being pipelined. On cells of width 1/16 over [−8.5, 8.5],
#     Φ(c + d) = Σ_n Φ⁽ⁿ⁾(c) dⁿ / n!  for n ≤ 7, |d| ≤ 1/32,  Φ⁽ⁿ⁺¹⁾(c) = (−1)ⁿ He_n(c) φ(c),
# He: the probabilists' Hermite polynomials. The absolute error is under 3e-15; beyond ±8.5 Φ is
# within 1e-17 of 0 or 1. For many numbers, `cell_of` in one loop and `in_cell` in a second one take
# a third of the time of `normal_cdf` in a single loop: compilers vectorise the first loop over
# numbers, and `in_cell` reads the coefficients of one number as two vectors, where they would
# gather those of several.
LIMIT = 8.5
CELLS_PER_UNIT = 16.0
DEGREE = 7
STRIDE = DEGREE + 1  # a cell's coefficients fill one cache line of 64 bytes
_WIDTH = 1.0 / CELLS_PER_UNIT
_NEAREST = LIMIT * CELLS_PER_UNIT + 0.5
_ORDER = [0, 4, 2, 6, 1, 5, 3, 7]  # of a cell's coefficients t₀ … t₇ in the table, for `_series`


def _taylor_table() -> npt.NDArray[np.float64]:
    centres = np.arange(int(2 * LIMIT * CELLS_PER_UNIT) + 1) / CELLS_PER_UNIT - LIMIT
    density = np.exp(-0.5 * centres**2) / math.sqrt(2.0 * math.pi)
    hermite = [np.ones_like(centres), centres]
    for n in range(1, DEGREE):
        hermite.append(centres * hermite[n] - n * hermite[n - 1])
    table = np.empty((centres.size, STRIDE))
    table[:, 0] = ndtr(centres)
    for n in range(DEGREE):
        table[:, n + 1] = (-1) ** n * hermite[n] * density / math.factorial(n + 1)
    return table[:, _ORDER].ravel()


_TABLE = _taylor_table()


@intrinsic
def _series(typing, table, start, d):  # type: ignore[no-untyped-def]
    """Σ t_n dⁿ of the cell whose coefficients begin at `table[start]`, two vectors of four.

    (t₀, t₄, t₂, t₆) + (t₁, t₅, t₃, t₇) d = (a, c, b, e);  (a, c) + (b, e) d² = (low, high);
    low + high d⁴. The same sums and products in the same order as by scalars, so the same bits.
    """

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        table, start, d = arguments
        array = context.make_array(signature.args[0])(context, builder, table)
        four, index = ir.VectorType(ir.DoubleType(), 4), ir.IntType(32)

        def coefficients(offset):  # type: ignore[no-untyped-def]
            place = builder.gep(array.data, [builder.add(start, start.type(offset))])
            loaded = builder.load(builder.bitcast(place, four.as_pointer()))
            loaded.align = 8
            return loaded

        def part(vector, entries):  # type: ignore[no-untyped-def]
            mask = ir.Constant(ir.VectorType(index, len(entries)), entries)
            return builder.shuffle_vector(vector, vector.type(ir.Undefined), mask)

        def repeated(number, count):  # type: ignore[no-untyped-def]
            return part(builder.insert_element(four(ir.Undefined), number, index(0)), [0] * count)

        d2 = builder.fmul(d, d)
        pairs = builder.fadd(coefficients(0), builder.fmul(coefficients(4), repeated(d, 4)))
        halves = builder.fadd(
            part(pairs, [0, 1]), builder.fmul(part(pairs, [2, 3]), repeated(d2, 2))
        )
        low, high = (builder.extract_element(halves, index(i)) for i in range(2))
        return builder.fadd(low, builder.fmul(high, builder.fmul(d2, d2)))

    return types.float64(table, start, d), build


@njit(inline="always", error_model="numpy")
def cell_of(x):  # type: ignore[no-untyped-def]
    """The cell of a number that is not NaN, int32, and its distance from the cell's centre."""
    v = x if x < LIMIT else LIMIT
    v = v if v > -LIMIT else -LIMIT
    cell = np.int32(v * CELLS_PER_UNIT + _NEAREST)
    return cell, v - (np.float64(cell) * _WIDTH - LIMIT)


@njit(inline="always", error_model="numpy")
def in_cell(cell, d):  # type: ignore[no-untyped-def]
    """Φ at the distance d from the centre of a cell."""
    start = np.uint64(cell) * np.uint64(STRIDE)
    return _series(_TABLE, start, d)  # type: ignore[call-arg]  # Numba passes `typing`


@njit(inline="always", error_model="numpy")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """Φ of one number that is not NaN."""
    cell, d = cell_of(x)
    return in_cell(cell, d)


_U0, _U1, _U2 = np.uint64(0), np.uint64(1), np.uint64(2)
_U12, _U27, _U30, _U31 = (np.uint64(bits) for bits in (12, 27, 30, 31))
_T, _VALUES, _STATE = map(np.uint64, (BUFFER_T, BUFFER_VALUES, BUFFER_STATE))
_OWN_KEY, _OWN_DRAWN, _OWN_D = map(np.uint64, (OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS))
_PACKED = types.Array(float64, 1, "C", readonly=True)


@njit(inline="always", error_model="numpy")
def _clipped(a):  # type: ignore[no-untyped-def]
    a = a if a > 0.0 else 0.0
    return a if a < 1.0 else 1.0


@njit(inline="always", error_model="numpy")
def _reward_of(similarity, r_min):  # type: ignore[no-untyped-def]
    graded = 4.0 * (similarity - 0.75)
    return graded if graded > r_min else 0.0  # r_min is at least 0


@njit(inline="always", error_model="numpy")
def _one_layers(p, at, layers, room, x, y, uniform):  # type: ignore[no-untyped-def]
    """Packed layers of one environment, the first at `p[at]`; W x + b where not `uniform`.

    `room[x]` and `room[y]` begin room for two layers, of which the first has the inputs. Returns
    `(x, at)`: where the outputs begin in `room`, and what follows the layers in `p`.
    """
    for _ in range(layers):
        inputs, outputs = np.uint64(p[at]), np.uint64(p[at + _U1])
        at += _U2
        b = at + inputs * outputs
        if outputs < np.uint64(_NARROW):
            for o in range(outputs):
                total = p[b + o]
                for i in range(inputs):
                    total = total + p[at + i * outputs + o] * room[x + i]
                room[y + o] = normal_cdf(total) if uniform else total
        else:
            W = p[at:b].reshape(inputs, outputs)
            _wide_layer(W, p[b : b + outputs], room[x : x + inputs], room[y : y + outputs], uniform)
        at = b + outputs
        x, y = y, x
    return x, at


@njit(error_model="numpy")
def _wide_layer(W, b, x, y, uniform):  # type: ignore[no-untyped-def]
    """One layer for W transposed `[in, out]`, eight inputs at a time, in ascending order."""
    inputs, outputs = W.shape
    for o in range(outputs):
        y[o] = b[o]
    i = 0
    while i + 8 <= inputs:
        w0, w1, w2, w3 = W[i], W[i + 1], W[i + 2], W[i + 3]
        w4, w5, w6, w7 = W[i + 4], W[i + 5], W[i + 6], W[i + 7]
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        x4, x5, x6, x7 = x[i + 4], x[i + 5], x[i + 6], x[i + 7]
        for o in range(outputs):
            total = y[o] + w0[o] * x0
            total = total + w1[o] * x1
            total = total + w2[o] * x2
            total = total + w3[o] * x3
            total = total + w4[o] * x4
            total = total + w5[o] * x5
            total = total + w6[o] * x6
            y[o] = total + w7[o] * x7
        i += 8
    while i < inputs:
        w, xi = W[i], x[i]
        for o in range(outputs):
            y[o] = y[o] + w[o] * xi
        i += 1
    if uniform:
        for o in range(outputs):
            y[o] = normal_cdf(y[o])


@njit(inline="always", error_model="numpy")
def _mixed(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _U30)) * FIRST_MIX
    z = (z ^ (z >> _U27)) * SECOND_MIX
    return z ^ (z >> _U31)


@njit(inline="always", error_model="numpy")
def _uniform(start, place):  # type: ignore[no-untyped-def]
    """The number at a place of the stream of mix(key) = start; see `draw.counted`."""
    return (float64(_mixed(start + GOLDEN * place) >> _U12) + 0.5) * 2.0**-52


@njit(error_model="numpy")
def _one_limits(p, at, buffer, s, x, y, values, action, actions):  # type: ignore[no-untyped-def]
    """Limits, safe action (behind π* in `actions`), cost and safe regret. Returns what follows."""
    S, A, tightness = np.uint64(p[0]), np.uint64(p[1]), p[11]
    for j in range(S):
        buffer[x + j] = buffer[s + j]
    v, at = _one_layers(p, at, np.uint64(p[14]), buffer, x, y, True)
    excess, missed = 0.0, 0.0
    for i in range(A):
        limit = 1.0 - 2.0 * tightness * buffer[v + i]
        safe = actions[i] if actions[i] < limit else limit
        above = _clipped(float64(action[i])) - limit
        excess += above if above > 0.0 else 0.0
        missed += abs(safe - actions[i])
        actions[A + i] = limit
        actions[A + A + i] = safe
    buffer[values + np.uint64(COST)] = excess / (2.0 * tightness * float64(A))
    safe_reward = _reward_of(1.0 - missed / float64(A), p[4])
    step_reward = buffer[values + np.uint64(STEP_REWARD)]
    buffer[values + np.uint64(SAFE_REGRET)] = safe_reward - step_reward
    buffer[values + np.uint64(PRICE)] = p[21] * (1.0 - safe_reward)
    return at


@njit(inline="always", error_model="numpy")
def _one_potential(p, buffer, s, t):  # type: ignore[no-untyped-def]
    """P_t(s); the layer of φ ends a packed task."""
    S = np.uint64(p[0])
    b = np.uint64(p[8]) - _U1
    total = p[b]
    for j in range(S):
        total = total + p[b - S + j] * buffer[s + j]
    return p[17] * (1.0 - t / p[3]) * normal_cdf(total)


@njit(error_model="numpy")
def _one_distractors(p, at, buffer, own, free, action):  # type: ignore[no-untyped-def]
    """Move the distractors; `buffer[free]` begins room for what drives them, `[A]`."""
    A, m, dynamics = np.uint64(p[1]), np.uint64(p[10]), int(p[12])
    drawn, start = uint64(buffer[own + _OWN_DRAWN]), _mixed(uint64(buffer[own + _OWN_KEY]))
    d = own + _OWN_D
    if dynamics == _NOISE:
        for j in range(m):
            buffer[d + j] = _uniform(start, drawn + j + _U1)
        buffer[own + _OWN_DRAWN] += float64(m)
    if dynamics < _AUTONOMOUS:
        return at
    for i in range(A):
        if dynamics == _AUTONOMOUS:
            buffer[free + i] = float64(float32(_uniform(start, drawn + i + _U1)))
        else:
            buffer[free + i] = _clipped(float64(float32(action[i])))
    if dynamics == _AUTONOMOUS:
        buffer[own + _OWN_DRAWN] += float64(A)
    b = at + A * m
    for j in range(m):
        moved = buffer[d + j] + p[b + j]
        for i in range(A):
            moved = moved + p[at + i * m + j] * buffer[free + i]
        buffer[d + j] = 2.0 * abs(moved - np.rint(moved))
    return b + m


@njit(error_model="numpy")
def _one_seen(p, at, buffer, s, d, x, y, observation):  # type: ignore[no-untyped-def]
    """M(s, d), the first entries of the observation."""
    S, m = np.uint64(p[0]), np.uint64(p[10])
    for j in range(S):
        buffer[x + j] = buffer[s + j]
    for j in range(m):
        buffer[x + S + j] = buffer[d + j]
    x, at = _one_layers(p, at, np.uint64(p[15]), buffer, x, y, p[13] == 1.0)
    for j in range(S + m):
        observation[j] = buffer[x + j]


@njit(error_model="numpy")
def _one_step(limited, observed, shaped, noisy, p, buffer, start, action, actions, observation):  # type: ignore[no-untyped-def]
    """One step of the environment whose own numbers begin at `buffer[start]`; see `step_one`."""
    S, A, k, T = np.uint64(p[0]), np.uint64(p[1]), int(p[2]), int(p[3])
    r_min, D, widest, m = p[4], p[5], np.uint64(p[7]), np.uint64(p[10])
    if np.uint64(action.size) != A:
        return 0.0, -1.0
    for i in range(A):
        if action[i] - action[i] != 0.0:  # NaN for NaN and for infinities
            return 0.0, -1.0

    values, s = start + _VALUES, start + _STATE
    own = s + S
    x = own + np.uint64(p[16])
    y = x + widest
    b = np.uint64(_HEADER) + A * S
    at = b + S
    channels, layers = np.uint64(p[at]), np.uint64(p[at + _U1])
    at += _U2
    for j in range(channels):
        buffer[x + j] = buffer[s + np.uint64(p[at + j])]
    best, at = _one_layers(p, at + channels, layers, buffer, x, y, True)
    for o in range(A):
        actions[o] = buffer[best + o]

    missed = 0.0
    for i in range(A):
        missed += abs(_clipped(float64(action[i])) - actions[i])
    similarity = 1.0 - missed / float64(A)
    step_reward = _reward_of(similarity, r_min)
    buffer[values + np.uint64(SIMILARITY)] = similarity
    buffer[values + np.uint64(STEP_REWARD)] = step_reward
    buffer[values + np.uint64(REGRET)] = 1.0 - step_reward
    if limited is not None:
        at = _one_limits(p, at, buffer, s, x, y, values, action, actions)
    t = int(buffer[start + _T])
    potential = 0.0
    if shaped is not None:
        potential = _one_potential(p, buffer, s, t)
    noise = own + _OWN_D + m + _U1

    for j in range(S):
        moved = buffer[s + j] + p[b + j]
        for i in range(A):
            a = _clipped(float64(float32(action[i])))
            moved = moved + p[np.uint64(_HEADER) + i * S + j] * a
        if noisy is not None:
            moved = moved + p[20] * buffer[noise + _U1 + j]
        folded = 2.0 * abs(moved - np.rint(moved))
        buffer[s + j] = folded
        observation[j] = folded
    if observed is not None:
        at = _one_distractors(p, at, buffer, own, x, action)
        _one_seen(p, at, buffer, s, own + _OWN_D, x, y, observation)

    t += 1
    accumulated = buffer[values + np.uint64(ACCUMULATED_REWARD)] + step_reward
    truncated = t >= T
    end = (1.0 if step_reward < D else 0.0) + (2.0 if truncated else 0.0)
    reward = 0.0
    if truncated or t % k == 0:
        reward, accumulated = accumulated, 0.0
    if limited is not None:
        reward += buffer[values + np.uint64(PRICE)]
    if shaped is not None:
        later = 0.0 if step_reward < D else p[18] * _one_potential(p, buffer, s, t)
        buffer[values + np.uint64(SHAPING)] = later - potential
        reward += later - potential
    if noisy is not None:
        buffer[values + np.uint64(REWARD_NOISE)] = p[19] * buffer[noise]
        reward += p[19] * buffer[noise]
    buffer[start + _T] = t
    buffer[values + np.uint64(REWARD)] = reward
    buffer[values + np.uint64(ACCUMULATED_REWARD)] = accumulated
    observation[S + m] = t / T
    waiting = accumulated / k  # above 1 only where a stream went on to a smaller k
    observation[S + m + _U1] = waiting if waiting < 1.0 else 1.0
    return reward, end


# Of a step, by the dtype of its actions; `engine.machine_code` compiles what is asked for.
_RESULT = types.UniTuple(float64, 2)
_ACTIONS = {np.dtype(np.float32): float32[:], np.dtype(np.float64): float64[:]}
_REST = (float64[::1], float32[::1])


def parts(task: Task) -> tuple[bool | None, ...]:
    """The first arguments of a task's steps: True for each part of a step that it has, or None.

    Numba compiles no branch on None: what a task does not have costs no time to compile.
    """
    spec = task.spec
    blocks = spec.safety, spec.observation, spec.shaping, spec.noise
    return tuple(None if block is None else True for block in blocks)


def _types_of(parts: Sequence[bool | None]) -> Any:
    return [types.none if part is None else types.boolean for part in parts]


def step_one_of(parts: Sequence[bool | None], action: np.dtype[Any]) -> Any:
    return _RESULT(*_types_of(parts), _PACKED, float64[::1], _ACTIONS[action], *_REST)


def step_packed_of(parts: Sequence[bool | None], action: np.dtype[Any]) -> Any:
    return _RESULT(*_types_of(parts), float64[::1], _ACTIONS[action], *_REST)


@njit(error_model="numpy", cache=True)
def step_one(limited, observed, shaped, noisy, p, buffer, action, actions, observation):  # type: ignore[no-untyped-def]
    """One step of one environment of a single agent.

    `p` is the packed task, and `buffer` the environment's own numbers, advanced in place. `action`
    `[A]` is clipped here. Written are `actions` `[A]`, π* of the state acted in, with `safety`
    `[3A]`: also the limits and the safe action; and the first S + m + 2 entries of `observation`.

    Returns `(reward, end)`; end is 1 for terminated plus 2 for truncated, or −1 where the action is
    of another size or not finite: nothing has moved then.
    """
    return _one_step(limited, observed, shaped, noisy, p, buffer, _U0, action, actions, observation)


@njit(error_model="numpy", cache=True)
def step_packed(limited, observed, shaped, noisy, buffer, action, actions, observation):  # type: ignore[no-untyped-def]
    """`step_one` for an environment whose own numbers follow its packed task in one array."""
    start = np.uint64(buffer[8])
    return _one_step(
        limited, observed, shaped, noisy, buffer, buffer, start, action, actions, observation
    )


@njit(inline="always", error_model="numpy")
def _four_sums(W, b, x, y, o, count):  # type: ignore[no-untyped-def]
    """W x + b of the outputs o … o + 3 for `count` environments: each input is read only once."""
    # Two indices everywhere: a row taken as an array of its own costs two atomic operations.
    inputs = W.shape[0]
    o0, o1, o2, o3 = np.uint64(o), np.uint64(o + 1), np.uint64(o + 2), np.uint64(o + 3)
    b0, b1, b2, b3 = b[o0], b[o1], b[o2], b[o3]
    for env in range(count):
        y[o0, env], y[o1, env], y[o2, env], y[o3, env] = b0, b1, b2, b3
    i = 0
    while i + 4 <= inputs:
        i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
        a0, a1, a2, a3 = W[i0, o0], W[i1, o0], W[i2, o0], W[i3, o0]
        c0, c1, c2, c3 = W[i0, o1], W[i1, o1], W[i2, o1], W[i3, o1]
        d0, d1, d2, d3 = W[i0, o2], W[i1, o2], W[i2, o2], W[i3, o2]
        e0, e1, e2, e3 = W[i0, o3], W[i1, o3], W[i2, o3], W[i3, o3]
        for env in range(count):
            x0, x1, x2, x3 = x[i0, env], x[i1, env], x[i2, env], x[i3, env]
            y[o0, env] = (((y[o0, env] + a0 * x0) + a1 * x1) + a2 * x2) + a3 * x3
            y[o1, env] = (((y[o1, env] + c0 * x0) + c1 * x1) + c2 * x2) + c3 * x3
            y[o2, env] = (((y[o2, env] + d0 * x0) + d1 * x1) + d2 * x2) + d3 * x3
            y[o3, env] = (((y[o3, env] + e0 * x0) + e1 * x1) + e2 * x2) + e3 * x3
        i += 4
    while i < inputs:
        i0 = np.uint64(i)
        a0, c0, d0, e0 = W[i0, o0], W[i0, o1], W[i0, o2], W[i0, o3]
        for env in range(count):
            x0 = x[i0, env]
            y[o0, env] = y[o0, env] + a0 * x0
            y[o1, env] = y[o1, env] + c0 * x0
            y[o2, env] = y[o2, env] + d0 * x0
            y[o3, env] = y[o3, env] + e0 * x0
        i += 1


@njit(inline="always", error_model="numpy")
def _one_sum(W, b, x, y, o, count):  # type: ignore[no-untyped-def]
    """W x + b of the output o for `count` environments, four inputs at a time."""
    inputs, bias = W.shape[0], b[o]
    for env in range(count):
        y[o, env] = bias
    i = 0
    while i + 4 <= inputs:
        i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
        w0, w1, w2, w3 = W[i0, o], W[i1, o], W[i2, o], W[i3, o]
        for env in range(count):
            total = y[o, env] + w0 * x[i0, env]
            total = total + w1 * x[i1, env]
            total = total + w2 * x[i2, env]
            y[o, env] = total + w3 * x[i3, env]
        i += 4
    while i < inputs:
        i0 = np.uint64(i)
        w = W[i0, o]
        for env in range(count):
            y[o, env] = y[o, env] + w * x[i0, env]
        i += 1


@njit(error_model="numpy")
def _block_layer(W, b, x, y, cells, count, uniform):  # type: ignore[no-untyped-def]
    """y = Φ(W x + b) for `count` environments: x `[in, count]`, y `[out, count]`, W transposed.

    `cells` `[count]` is room for those of Φ's table. Not `uniform`: y = W x + b.
    """
    outputs = W.shape[1]
    in_fours = outputs - outputs % 4
    for o in range(0, in_fours, 4):
        _four_sums(W, b, x, y, o, count)
    for o in range(in_fours, outputs):
        _one_sum(W, b, x, y, o, count)
    if not uniform:
        return
    for o in range(outputs):
        for env in range(count):
            cells[env], y[o, env] = cell_of(y[o, env])
        for env in range(count):
            y[o, env] = in_cell(cells[env], y[o, env])


@njit(inline="always", error_model="numpy")
def _block_layers(p, at, layers, x, y, cells, count, uniform):  # type: ignore[no-untyped-def]
    """Packed layers of a block, the first at `p[at]`; x has the inputs, see `_block_layer`.

    Returns `(x, y, at, outputs)`: the outputs, the other room, what follows the layers in `p`, and
    how many outputs there are, 0 without layers.
    """
    outputs = 0
    for _ in range(layers):
        inputs, outputs = int(p[at]), int(p[at + 1])
        at += 2
        b = at + inputs * outputs
        W = p[at:b].reshape(inputs, outputs)
        _block_layer(W, p[b : b + outputs], x, y, cells, count, uniform)
        at = b + outputs
        x, y = y, x
    return x, y, at, outputs


# The parts of `step_many`, in its order. Inlined, so that the compiler sees that the arrays of a
# block overlap no other array.
@njit(inline="always", error_model="numpy")
def _block_policy(p, s, first, count, x, y, cells, best, owner, owned):  # type: ignore[no-untyped-def]
    """π* of a block, agent by agent; `x` and `y` are room for two layers. Returns what follows.

    Writes `best` `[A, block]`, the agent of each action channel (`owner` `[A]`), and how many
    channels each agent owns (`owned` `[n]`).
    """
    at = _HEADER + int(p[1]) * int(p[0]) + int(p[0])  # behind the header, W and b
    channel = 0
    for agent in range(owned.size):
        inputs, layers = int(p[at]), int(p[at + 1])
        at += 2
        for j in range(inputs):
            observed = np.uint64(p[at + j])
            for env in range(count):
                x[j, env] = s[observed, first + env]
        at += inputs
        x, y, at, outputs = _block_layers(p, at, layers, x, y, cells, count, True)
        for o in range(outputs):
            for env in range(count):
                best[channel, env] = x[o, env]
            owner[channel] = agent
            channel += 1
        owned[agent] = outputs
    return at


@njit(inline="always", error_model="numpy")
def _block_distance(action, first, count, best, owner, distance, acted, actions):  # type: ignore[no-untyped-def]
    """‖a − π*‖₁ of each agent, `distance` `[n, block]`, NaN where its action is not finite.

    Also writes the actions that the transition takes, clipped and rounded to float32 (`acted`), and
    π* into the first of the `actions` `[1 or 3, B, A]`.
    """
    distance[:] = 0.0
    for i in range(owner.size):
        agent = owner[i]
        for env in range(count):
            unclipped = action[first + env, i]
            a = _clipped(unclipped)
            # The last term is 0, but NaN for NaN and for infinities, which clipping hides.
            distance[agent, env] += abs(a - best[i, env]) + (unclipped - unclipped)
            acted[i, env] = float64(float32(a))
            actions[0, first + env, i] = best[i, env]


@njit(inline="always", error_model="numpy")
def _block_transition(W, b, s, first, count, acted, column, noisy, p, own, moved, observation):  # type: ignore[no-untyped-def]
    """ψ(s + a W + b) of a block, into `moved` `[S, B]` and `observation` `[B, …]`.

    The sum runs over the action channels in ascending order, four at a time, in `column` `[block]`.
    """
    A, S = W.shape
    for j in range(S):
        offset = b[j]
        for env in range(count):
            column[env] = s[j, first + env] + offset
        i = 0
        while i + 4 <= A:
            i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
            w0, w1, w2, w3 = W[i0, j], W[i1, j], W[i2, j], W[i3, j]
            for env in range(count):
                y = column[env] + w0 * acted[i0, env]
                y = y + w1 * acted[i1, env]
                y = y + w2 * acted[i2, env]
                column[env] = y + w3 * acted[i3, env]
            i += 4
        while i < A:
            i0 = np.uint64(i)
            w = W[i0, j]
            for env in range(count):
                column[env] = column[env] + w * acted[i0, env]
            i += 1
        if noisy is not None:
            row = own.shape[0] - S + j
            for env in range(count):
                column[env] = column[env] + p[20] * own[row, first + env]
        for env in range(count):
            folded = 2.0 * abs(column[env] - np.rint(column[env]))
            moved[j, first + env] = folded
            observation[first + env, j] = folded


@njit(inline="always", error_model="numpy")
def _block_rewards(p, first, count, distance, owned, team_distance, values, ends):  # type: ignore[no-untyped-def]
    """Similarity, step reward, regret, and which are terminated; False where NaN is."""
    A, r_min, D, pays_the_team = p[1], p[4], p[5], p[9] == 1.0
    finite = True
    for env in range(count):
        ends[0, first + env] = False
    if pays_the_team:
        team_distance[:] = 0.0
        for agent in range(owned.size):
            for env in range(count):
                team_distance[env] += distance[agent, env]
    for agent in range(owned.size):
        for env in range(count):
            i = first + env
            similarity = 1.0 - distance[agent, env] / owned[agent]
            finite &= similarity == similarity
            paid_for = 1.0 - team_distance[env] / A if pays_the_team else similarity
            step_reward = _reward_of(paid_for, r_min)
            values[SIMILARITY, agent, i] = similarity
            values[STEP_REWARD, agent, i] = step_reward
            values[REGRET, agent, i] = 1.0 - step_reward
            ends[0, i] |= step_reward < D
    return finite


@njit(inline="always", error_model="numpy")
def _block_payout(p, first, count, t, accumulated, column, values, ends, observation):  # type: ignore[no-untyped-def]
    """Payout, r_cum and truncation, and the observed t/T and r_cum/k.

    Short loops rather than one long one: those that divide write to `column`, which is contiguous
    and so fills vector registers; a column of `observation` is not.
    """
    of_t, k, T = int(p[0] + p[10]), p[2], p[3]
    for agent in range(accumulated.shape[0]):
        if k == 1.0:  # paid at every step, without a division
            for env in range(count):
                i = first + env
                values[REWARD, agent, i] = accumulated[agent, i] + values[STEP_REWARD, agent, i]
                values[ACCUMULATED_REWARD, agent, i] = 0.0
                column[env] = 0.0
        else:
            for env in range(count):
                i = first + env
                steps = float64(t[i] + 1)
                total = accumulated[agent, i] + values[STEP_REWARD, agent, i]
                # Exact: no quotient of integers below 2³¹ rounds to a whole number it is not.
                paid = (steps >= T) | (np.floor(steps / k) * k == steps)
                kept = 0.0 if paid else total
                values[REWARD, agent, i] = total if paid else 0.0
                values[ACCUMULATED_REWARD, agent, i] = kept
                waiting = kept / k  # above 1 only where a stream went on to a smaller k
                column[env] = waiting if waiting < 1.0 else 1.0
        for env in range(count):
            observation[first + env, of_t + 1 + agent] = column[env]
    for env in range(count):
        steps = float64(t[first + env] + 1)
        ends[1, first + env] = steps >= T
        column[env] = steps / T
    for env in range(count):
        observation[first + env, of_t] = column[env]


@njit(inline="always", error_model="numpy")
def _block_limits(p, first, count, action, best, v, excess, missed, actions, values):  # type: ignore[no-untyped-def]
    """Limits, safe actions, cost and safe regret of a block, from v."""
    A, r_min, tightness = int(p[1]), p[4], p[11]
    for env in range(count):
        excess[env], missed[env] = 0.0, 0.0
    for i in range(A):
        for env in range(count):
            limit = 1.0 - 2.0 * tightness * v[i, env]
            safe = best[i, env] if best[i, env] < limit else limit
            above = _clipped(action[first + env, i]) - limit
            excess[env] += above if above > 0.0 else 0.0
            missed[env] += abs(safe - best[i, env])
            actions[1, first + env, i] = limit
            actions[2, first + env, i] = safe
    for env in range(count):
        values[COST, 0, first + env] = excess[env] / (2.0 * tightness * float64(A))
        safe_reward = _reward_of(1.0 - missed[env] / float64(A), r_min)
        values[SAFE_REGRET, 0, first + env] = safe_reward - values[STEP_REWARD, 0, first + env]
        if p[21] == 1.0:
            values[PRICE, 0, first + env] = 1.0 - safe_reward
            values[REWARD, 0, first + env] += 1.0 - safe_reward


@njit(inline="always", error_model="numpy")
def _block_potential(p, s, first, count, t, later, cells, column):  # type: ignore[no-untyped-def]
    """P of states `[S, B]` that are `later` steps after t, of a block, into `column`."""
    S = int(p[0])
    W = int(p[8]) - 1 - S
    for env in range(count):
        column[env] = p[W + S]
    for j in range(S):
        w = p[W + j]
        for env in range(count):
            column[env] = column[env] + w * s[j, first + env]
    for env in range(count):
        cells[env], column[env] = cell_of(column[env])
    for env in range(count):
        left = 1.0 - (t[first + env] + later) / p[3]
        column[env] = p[17] * left * in_cell(cells[env], column[env])


@njit(inline="always", error_model="numpy")
def _block_shaping(p, s, moved, first, count, t, cells, before, after, values, ends):  # type: ignore[no-untyped-def]
    """F of a block, and its payment to every agent."""
    _block_potential(p, s, first, count, t, 0, cells, before)
    _block_potential(p, moved, first, count, t, 1, cells, after)
    for env in range(count):
        later = 0.0 if ends[0, first + env] else p[18] * after[env]
        after[env] = later - before[env]
    for agent in range(values.shape[1]):
        for env in range(count):
            values[SHAPING, agent, first + env] = after[env]
            values[REWARD, agent, first + env] += after[env]


@njit(inline="always", error_model="numpy")
def _block_reward_noise(p, own, first, count, values):  # type: ignore[no-untyped-def]
    """The noise of each agent's reward in a block."""
    agents = values.shape[1]
    row = own.shape[0] - int(p[0]) - agents
    for agent in range(agents):
        for env in range(first, first + count):
            noise = p[19] * own[row + agent, env]
            if values.shape[0] > REWARD_NOISE:
                values[REWARD_NOISE, agent, env] = noise
            values[REWARD, agent, env] += noise


@njit(inline="always", error_model="numpy")
def _block_numbers(own, first, count, n, start, out, row, column):  # type: ignore[no-untyped-def]
    """The next n random numbers of a block, into `out` from its row and column on."""
    for env in range(count):
        start[env] = _mixed(uint64(own[OWN_KEY, first + env]))
        start[env] += GOLDEN * uint64(own[OWN_DRAWN, first + env])
        own[OWN_DRAWN, first + env] += float64(n)
    for j in range(n):
        place = uint64(j + 1)
        for env in range(count):
            out[row + j, column + env] = _uniform(start[env], place)


@njit(inline="always", error_model="numpy")
def _block_distractors(p, at, own, first, count, action, driving, start, column):  # type: ignore[no-untyped-def]
    """Move the distractors of a block; returns what follows their transition in `p`."""
    A, m, dynamics = int(p[1]), int(p[10]), int(p[12])
    if dynamics == _NOISE:
        _block_numbers(own, first, count, m, start, own, OWN_DISTRACTORS, first)
    if dynamics < _AUTONOMOUS:
        return at
    if dynamics == _AUTONOMOUS:
        _block_numbers(own, first, count, A, start, driving, 0, 0)
    for i in range(A):
        for env in range(count):
            if dynamics == _DRIVEN:
                driving[i, env] = action[first + env, i]
            driving[i, env] = _clipped(float64(float32(driving[i, env])))
    b = at + A * m
    for j in range(m):
        offset = p[b + j]
        for env in range(count):
            column[env] = own[OWN_DISTRACTORS + j, first + env] + offset
        for i in range(A):
            w = p[at + i * m + j]
            for env in range(count):
                column[env] = column[env] + w * driving[i, env]
        for env in range(count):
            folded = 2.0 * abs(column[env] - np.rint(column[env]))
            own[OWN_DISTRACTORS + j, first + env] = folded
    return b + m


@njit(inline="always", error_model="numpy")
def _block_seen(p, at, moved, own, first, count, x, y, cells, observation):  # type: ignore[no-untyped-def]
    """M(s, d) of a block, the first columns of its observations."""
    S, m = int(p[0]), int(p[10])
    for j in range(S):
        for env in range(count):
            x[j, env] = moved[j, first + env]
    for j in range(m):
        for env in range(count):
            x[S + j, env] = own[OWN_DISTRACTORS + j, first + env]
    x, y, at, _ = _block_layers(p, at, int(p[15]), x, y, cells, count, p[13] == 1.0)
    for j in range(S + m):
        for env in range(count):
            observation[first + env, j] = x[j, env]


_BATCH = (
    _PACKED, float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],
    float64[:, ::1], float32[:, ::1], float64[:, :, ::1], float64[:, :, ::1], boolean[:, ::1],
)  # fmt: skip


def step_many_of(parts: Sequence[bool | None]) -> Any:
    return boolean(*_types_of(parts), *_BATCH)


@njit(error_model="numpy", cache=True)
def step_many(  # type: ignore[no-untyped-def]
    limited, observed, shaped, noisy,
    p, s, t, accumulated, own, action, moved, observation, actions, values, ends,
):  # fmt: skip
    """One step of `B` environments of a team of n agents; a single agent is a team of one.

    They are stepped in blocks that fit in cache: π*, its distance from the action, the transition,
    the rewards, the payouts, and what `parts` add.

    Args:
      limited, observed, shaped, noisy: see `parts`.
      p: the packed task.
      s: `[S, B]` states, channel by channel.
      t: `[B]` steps completed before this one; advanced in place.
      accumulated: `[n, B]` each agent's r_cum; advanced in place.
      own: the own numbers of each, `[own_rows, B]`; advanced in place.
      action: `[B, A]`, clipped here.
      moved: `[S, B]`, written: the next states.
      observation: `[B, …]`, of which is written: M(s, d), t/T, and each agent's r_cum/k.
      actions: `[1 or 3, B, A]`, written: π* of the states acted in, the limits, the safe actions.
      values: `[5 … 10, n, B]`, written: the rows of `task.task`.
      ends: `[2, B]`, written: terminated, truncated.

    Returns:
      False where an action was not finite; what is advanced in place is unchanged then.
    """
    S, A, agents, widest = int(p[0]), int(p[1]), int(p[6]), int(p[7])
    W = p[_HEADER : _HEADER + A * S].reshape(A, S)
    b = p[_HEADER + A * S : _HEADER + A * S + S]
    block = max(32, min(128, _BLOCK_NUMBERS // widest))
    # Room for one block; each is contiguous along the environments.
    room, other = np.empty((widest, block)), np.empty((widest, block))
    best, acted = np.empty((A, block)), np.empty((A, block))
    distance, column, second = np.empty((agents, block)), np.empty(block), np.empty(block)
    cells, start = np.empty(block, np.int32), np.empty(block, np.uint64)
    owner, owned = np.empty(A, np.int64), np.empty(agents)
    finite, behind = True, 0
    for first in range(0, t.size, block):
        count = min(block, t.size - first)
        x, y = room, other
        behind = _block_policy(p, s, first, count, x, y, cells, best, owner, owned)
        _block_distance(action, first, count, best, owner, distance, acted, actions)
        _block_transition(W, b, s, first, count, acted, column, noisy, p, own, moved, observation)
        finite &= _block_rewards(p, first, count, distance, owned, second, values, ends)
        _block_payout(p, first, count, t, accumulated, column, values, ends, observation)
        if limited is not None:
            for j in range(S):
                for env in range(count):
                    x[j, env] = s[j, first + env]
            x, y, behind, _ = _block_layers(p, behind, int(p[14]), x, y, cells, count, True)
            _block_limits(p, first, count, action, best, x, column, second, actions, values)
        if shaped is not None:
            _block_shaping(p, s, moved, first, count, t, cells, column, second, values, ends)
        if noisy is not None:
            _block_reward_noise(p, own, first, count, values)
    if not finite:
        return False
    if observed is not None:
        for first in range(0, t.size, block):
            count = min(block, t.size - first)
            at = _block_distractors(p, behind, own, first, count, action, acted, start, column)
            _block_seen(p, at, moved, own, first, count, room, other, cells, observation)
    for agent in range(agents):
        for i in range(t.size):
            accumulated[agent, i] = values[ACCUMULATED_REWARD, agent, i]
    for i in range(t.size):
        t[i] += 1
    return True


NETWORK = void(_PACKED, float64[:, ::1], boolean, float64[:, ::1])


@njit(error_model="numpy", cache=True)
def network(p, s, uniform, out):  # type: ignore[no-untyped-def]
    """The output `[out, B]` of packed layers of inputs `[in, B]`; see `pack_layers`."""
    layers, widest = int(p[0]), int(p[1])
    block = min(max(32, min(128, _BLOCK_NUMBERS // widest)), s.shape[1])
    x, y, cells = np.empty((widest, block)), np.empty((widest, block)), np.empty(block, np.int32)
    for first in range(0, s.shape[1], block):
        count = min(block, s.shape[1] - first)
        for j in range(s.shape[0]):
            for env in range(count):
                x[j, env] = s[j, first + env]
        x, y, _, _ = _block_layers(p, 2, layers, x, y, cells, count, uniform)
        for o in range(out.shape[0]):
            for env in range(count):
                out[o, first + env] = x[o, env]


ADD_AND_NORMAL_CDF = void(float64[:, ::1], _PACKED)


@njit(error_model="numpy", cache=True)
def add_and_normal_cdf(x, b):  # type: ignore[no-untyped-def]
    """x ← Φ(x + b) in place, `[B, out]` and `[out]`: the step after a matrix product."""
    cells = np.empty(b.size, np.int32)
    for i in range(x.shape[0]):
        for o in range(b.size):
            cells[o], x[i, o] = cell_of(x[i, o] + b[o])
        for o in range(b.size):
            x[i, o] = in_cell(cells[o], x[i, o])

"""The step as machine code, for one lane and for a batch; always equal to the definition.

Both kernels do the same floating-point operations in the same order for each lane (each sum runs
over its inputs in ascending order, no fused or re-associated arithmetic), so a batch equals its
singles bit for bit; and the transition's are those of `Task.transition`, so states do too.
What differs is only where the loops are: a single lane runs over channels, a batch over blocks of
lanes, channel by channel, so that the inner loop is long enough to fill vector registers.

A task travels as one flat float64 array, because each array argument costs a call 40 ns:
    S, A, k, T, r_min, D, agents, widest layer, size of all this, pays the team (0 or 1),
    W [A, S], b [S], for each agent
    inputs, L, observed channels [inputs], for each layer  in, out, W transposed [in, out], b [out].
A single lane's own numbers follow it in the same array where the task is small (another 40 ns), and
stand alone where it is not, so that lanes can share it:
    t, the values of the last step [5] (of `compiled.arrays`; r_cum is among them), s [S],
    room for two layers [2 × widest].

Numba's disk cache does not know a function's flags: never compile one of these a second way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import boolean, float32, float64, int64, njit, types, void

from sme_registry.compiled.arrays import (
    ACCUMULATED_REWARD,
    LANE_STATE,
    LANE_T,
    LANE_VALUES,
    REGRET,
    REWARD,
    SIMILARITY,
    STEP_REWARD,
)
from sme_registry.compiled.normal_cdf import cell_of, in_cell, normal_cdf
from sme_registry.task import Task
from sme_registry.task.draw import Layer

BLOCK_NUMBERS = 4096  # of one layer's block: 32 KiB, so that a block stays in cache
_HEADER = 10
_NARROW = 16  # below it a matrix product over rows beats the vectorised one over columns


def pack(task: Task) -> npt.NDArray[np.float64]:
    spec = task.spec
    widest = max(spec.state_dim, *(max(W.shape) for layers in task.policies for W, _ in layers))
    parts = [
        [spec.state_dim, spec.action_dim, spec.k, spec.horizon],
        [spec.r_min, spec.D, len(task.policies), widest, 0.0, task.pays_the_team],
        task.W.ravel(),
        task.b,
    ]
    for observed, layers in zip(task.observed, task.policies, strict=True):
        parts += [[len(observed), len(layers)], observed, *layer_parts(layers)]
    packed = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
    packed[8] = packed.size
    return packed


def pack_layers(layers: Sequence[Layer]) -> npt.NDArray[np.float64]:
    """Layers as one flat array: how many, the widest, and each as in a packed task."""
    widest = max(max(W.shape) for W, _ in layers)
    parts = [np.array([len(layers), widest]), *layer_parts(layers)]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def layer_parts(layers: Sequence[Layer]) -> list[npt.ArrayLike]:
    return [part for W, b in layers for part in (W.shape[::-1], W.T.ravel(), b)]


def lane_size(packed: npt.NDArray[np.float64]) -> int:
    """The size of one lane's own part."""
    return LANE_STATE + int(packed[0]) + 2 * int(packed[7])


_U0, _U1, _U2 = np.uint64(0), np.uint64(1), np.uint64(2)
_T, _S, _VALUES = np.uint64(LANE_T), np.uint64(LANE_STATE), np.uint64(LANE_VALUES)
_SIMILARITY, _STEP_REWARD = np.uint64(SIMILARITY), np.uint64(STEP_REWARD)
_REGRET, _REWARD, _R_CUM = np.uint64(REGRET), np.uint64(REWARD), np.uint64(ACCUMULATED_REWARD)
_PACKED = types.Array(float64, 1, "C", readonly=True)


@njit(inline="always", error_model="numpy")
def clipped(a):  # type: ignore[no-untyped-def]
    a = a if a > 0.0 else 0.0
    return a if a < 1.0 else 1.0


@njit(inline="always", error_model="numpy")
def reward_of(similarity, r_min):  # type: ignore[no-untyped-def]
    graded = 4.0 * (similarity - 0.75)
    return graded if graded > 0.0 and graded > r_min else 0.0


@njit(error_model="numpy")
def lane_layers(p, at, layers, room, x, y, uniform):  # type: ignore[no-untyped-def]
    """Packed layers for one lane, the first at `p[at]`: Φ(W x + b), or W x + b where not `uniform`.

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


@njit(error_model="numpy")
def lane_step(p, lane, start, action, optimal, observation):  # type: ignore[no-untyped-def]
    """One step of the lane whose own numbers begin at `lane[start]`; see `step_lane`."""
    S, A, k, T = np.uint64(p[0]), np.uint64(p[1]), int(p[2]), int(p[3])
    r_min, D, widest = p[4], p[5], np.uint64(p[7])
    if np.uint64(action.size) != A:
        return 0.0, -1.0
    for i in range(A):
        if action[i] - action[i] != 0.0:  # NaN for NaN and for infinities
            return 0.0, -1.0

    s = start + _S
    at = np.uint64(_HEADER) + A * S + S
    channels, layers = np.uint64(p[at]), np.uint64(p[at + _U1])
    at += _U2
    x, y = s + S, s + S + widest
    for j in range(channels):
        lane[x + j] = lane[s + np.uint64(p[at + j])]
    at += channels
    x, at = lane_layers(p, at, layers, lane, x, y, True)
    for o in range(A):
        optimal[o] = lane[x + o]

    missed = 0.0
    for i in range(A):
        missed += abs(clipped(float64(action[i])) - optimal[i])
    similarity = 1.0 - missed / float64(A)
    step_reward = reward_of(similarity, r_min)

    b = np.uint64(_HEADER) + A * S
    for j in range(S):
        moved = lane[s + j] + p[b + j]
        for i in range(A):
            a = clipped(float64(float32(action[i])))
            moved = moved + p[np.uint64(_HEADER) + i * S + j] * a
        folded = 2.0 * abs(moved - np.rint(moved))
        lane[s + j] = folded
        observation[j] = folded

    t = int(lane[start + _T]) + 1
    v = start + _VALUES
    accumulated = lane[v + _R_CUM] + step_reward
    truncated = t >= T
    end = (1.0 if step_reward < D else 0.0) + (2.0 if truncated else 0.0)
    reward = 0.0
    if truncated or t % k == 0:
        reward, accumulated = accumulated, 0.0
    lane[start + _T] = t
    lane[v + _SIMILARITY] = similarity
    lane[v + _STEP_REWARD] = step_reward
    lane[v + _REGRET] = 1.0 - step_reward
    lane[v + _REWARD] = reward
    lane[v + _R_CUM] = accumulated
    observation[S] = t / T
    waiting = accumulated / k
    observation[S + _U1] = waiting if waiting < 1.0 else 1.0
    return reward, end


_RESULT = types.UniTuple(float64, 2)
_REST = (float64[::1], float32[::1])
LANE_FLOAT32 = _RESULT(_PACKED, float64[::1], float32[:], *_REST)
LANE_FLOAT64 = _RESULT(_PACKED, float64[::1], float64[:], *_REST)
PACKED_LANE_FLOAT32 = _RESULT(float64[::1], float32[:], *_REST)
PACKED_LANE_FLOAT64 = _RESULT(float64[::1], float64[:], *_REST)


@njit([LANE_FLOAT32, LANE_FLOAT64], error_model="numpy", cache=True)
def step_lane(p, lane, action, optimal, observation):  # type: ignore[no-untyped-def]
    """One step of one lane of a single agent.

    Args:
      p: the packed task.
      lane: the lane's own numbers; advanced in place.
      action: `[A]`; any numbers, clipped here.
      optimal: `[A]`, written: π* of the state acted in.
      observation: `[S + 2]`, written.

    Returns:
      `(reward, end)`; end is 1 for terminated plus 2 for truncated, or −1 where the action is of
      another size or not finite: nothing has moved then.
    """
    return lane_step(p, lane, _U0, action, optimal, observation)


@njit([PACKED_LANE_FLOAT32, PACKED_LANE_FLOAT64], error_model="numpy", cache=True)
def step_packed_lane(lane, action, optimal, observation):  # type: ignore[no-untyped-def]
    """`step_lane` for a lane whose own numbers follow its packed task in one array."""
    return lane_step(lane, lane, np.uint64(lane[8]), action, optimal, observation)


@njit(inline="always", error_model="numpy")
def _four_sums(W, b, x, y, o, count):  # type: ignore[no-untyped-def]
    """W x + b of the outputs o … o + 3 for `count` lanes: each input is read once for all four."""
    # Two indices everywhere: a row taken as an array of its own costs two atomic operations.
    inputs = W.shape[0]
    o0, o1, o2, o3 = np.uint64(o), np.uint64(o + 1), np.uint64(o + 2), np.uint64(o + 3)
    b0, b1, b2, b3 = b[o0], b[o1], b[o2], b[o3]
    for lane in range(count):
        y[o0, lane], y[o1, lane], y[o2, lane], y[o3, lane] = b0, b1, b2, b3
    i = 0
    while i + 4 <= inputs:
        i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
        a0, a1, a2, a3 = W[i0, o0], W[i1, o0], W[i2, o0], W[i3, o0]
        c0, c1, c2, c3 = W[i0, o1], W[i1, o1], W[i2, o1], W[i3, o1]
        d0, d1, d2, d3 = W[i0, o2], W[i1, o2], W[i2, o2], W[i3, o2]
        e0, e1, e2, e3 = W[i0, o3], W[i1, o3], W[i2, o3], W[i3, o3]
        for lane in range(count):
            x0, x1, x2, x3 = x[i0, lane], x[i1, lane], x[i2, lane], x[i3, lane]
            y[o0, lane] = (((y[o0, lane] + a0 * x0) + a1 * x1) + a2 * x2) + a3 * x3
            y[o1, lane] = (((y[o1, lane] + c0 * x0) + c1 * x1) + c2 * x2) + c3 * x3
            y[o2, lane] = (((y[o2, lane] + d0 * x0) + d1 * x1) + d2 * x2) + d3 * x3
            y[o3, lane] = (((y[o3, lane] + e0 * x0) + e1 * x1) + e2 * x2) + e3 * x3
        i += 4
    while i < inputs:
        i0 = np.uint64(i)
        a0, c0, d0, e0 = W[i0, o0], W[i0, o1], W[i0, o2], W[i0, o3]
        for lane in range(count):
            x0 = x[i0, lane]
            y[o0, lane] = y[o0, lane] + a0 * x0
            y[o1, lane] = y[o1, lane] + c0 * x0
            y[o2, lane] = y[o2, lane] + d0 * x0
            y[o3, lane] = y[o3, lane] + e0 * x0
        i += 1


@njit(inline="always", error_model="numpy")
def _one_sum(W, b, x, y, o, count):  # type: ignore[no-untyped-def]
    """W x + b of the output o for `count` lanes, four inputs at a time."""
    inputs, bias = W.shape[0], b[o]
    for lane in range(count):
        y[o, lane] = bias
    i = 0
    while i + 4 <= inputs:
        i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
        w0, w1, w2, w3 = W[i0, o], W[i1, o], W[i2, o], W[i3, o]
        for lane in range(count):
            total = y[o, lane] + w0 * x[i0, lane]
            total = total + w1 * x[i1, lane]
            total = total + w2 * x[i2, lane]
            y[o, lane] = total + w3 * x[i3, lane]
        i += 4
    while i < inputs:
        i0 = np.uint64(i)
        w = W[i0, o]
        for lane in range(count):
            y[o, lane] = y[o, lane] + w * x[i0, lane]
        i += 1


@njit(error_model="numpy")
def _block_layer(W, b, x, y, cells, count, uniform):  # type: ignore[no-untyped-def]
    """y = Φ(W x + b) for `count` lanes: x `[in, count]`, y `[out, count]`, W transposed.

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
        for lane in range(count):
            cells[lane], y[o, lane] = cell_of(y[o, lane])
        for lane in range(count):
            y[o, lane] = in_cell(cells[lane], y[o, lane])


@njit(inline="always", error_model="numpy")
def block_layers(p, at, layers, x, y, cells, count, uniform):  # type: ignore[no-untyped-def]
    """Packed layers, the first at `p[at]`, for `count` lanes; x has the inputs, see `_block_layer`.

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
def _block_policy(p, s, first, count, x, y, cells, optimal, owner, owned):  # type: ignore[no-untyped-def]
    """π* of a block of lanes, agent by agent; `x` and `y` are room for two layers.

    Writes `optimal` `[A, lanes]`, the agent of each action channel (`owner` `[A]`), and how many
    channels each agent owns (`owned` `[n]`).
    """
    at = _HEADER + int(p[1]) * int(p[0]) + int(p[0])  # behind the header, W and b
    channel = 0
    for agent in range(owned.size):
        inputs, layers = int(p[at]), int(p[at + 1])
        at += 2
        for j in range(inputs):
            observed = np.uint64(p[at + j])
            for lane in range(count):
                x[j, lane] = s[observed, first + lane]
        at += inputs
        x, y, at, outputs = block_layers(p, at, layers, x, y, cells, count, True)
        for o in range(outputs):
            for lane in range(count):
                optimal[channel, lane] = x[o, lane]
            owner[channel] = agent
            channel += 1
        owned[agent] = outputs


@njit(inline="always", error_model="numpy")
def _block_distance(action, first, count, best, owner, distance, acted, optimal):  # type: ignore[no-untyped-def]
    """‖a − π*‖₁ of each agent, `distance` `[n, lanes]`, NaN where its action is not finite.

    Also writes the actions that the transition takes, clipped and rounded to float32 (`acted`), and
    π* of the block's lanes into `optimal` `[B, A]`.
    """
    distance[:] = 0.0
    for i in range(owner.size):
        agent = owner[i]
        for lane in range(count):
            unclipped = action[first + lane, i]
            a = clipped(unclipped)
            # The last term is 0, but NaN for NaN and for infinities, which clipping hides.
            distance[agent, lane] += abs(a - best[i, lane]) + (unclipped - unclipped)
            acted[i, lane] = float64(float32(a))
            optimal[first + lane, i] = best[i, lane]


@njit(inline="always", error_model="numpy")
def _block_transition(W, b, s, first, count, acted, column, moved, observation):  # type: ignore[no-untyped-def]
    """ψ(s + a W + b) of a block of lanes, into `moved` `[S, B]` and `observation` `[B, …]`.

    The sum runs over the action channels in ascending order, four at a time, in `column` `[lanes]`.
    """
    A, S = W.shape
    for j in range(S):
        offset = b[j]
        for lane in range(count):
            column[lane] = s[j, first + lane] + offset
        i = 0
        while i + 4 <= A:
            i0, i1, i2, i3 = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
            w0, w1, w2, w3 = W[i0, j], W[i1, j], W[i2, j], W[i3, j]
            for lane in range(count):
                y = column[lane] + w0 * acted[i0, lane]
                y = y + w1 * acted[i1, lane]
                y = y + w2 * acted[i2, lane]
                column[lane] = y + w3 * acted[i3, lane]
            i += 4
        while i < A:
            i0 = np.uint64(i)
            w = W[i0, j]
            for lane in range(count):
                column[lane] = column[lane] + w * acted[i0, lane]
            i += 1
        for lane in range(count):
            folded = 2.0 * abs(column[lane] - np.rint(column[lane]))
            moved[j, first + lane] = folded
            observation[first + lane, j] = folded


@njit(inline="always", error_model="numpy")
def _block_rewards(p, first, count, distance, owned, team_distance, values, ends):  # type: ignore[no-untyped-def]
    """Similarity, step reward, regret, and whether a lane is terminated; False where NaN is."""
    A, r_min, D, pays_the_team = p[1], p[4], p[5], p[9] == 1.0
    finite = True
    for lane in range(count):
        ends[0, first + lane] = False
    if pays_the_team:
        team_distance[:] = 0.0
        for agent in range(owned.size):
            for lane in range(count):
                team_distance[lane] += distance[agent, lane]
    for agent in range(owned.size):
        for lane in range(count):
            i = first + lane
            similarity = 1.0 - distance[agent, lane] / owned[agent]
            finite &= similarity == similarity
            paid_for = 1.0 - team_distance[lane] / A if pays_the_team else similarity
            graded = 4.0 * (paid_for - 0.75)
            graded = graded if graded > 0.0 else 0.0
            step_reward = graded if graded > r_min else 0.0
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
    S, k, T = int(p[0]), p[2], p[3]
    for agent in range(accumulated.shape[0]):
        if k == 1.0:  # paid at every step, without a division
            for lane in range(count):
                i = first + lane
                values[REWARD, agent, i] = accumulated[agent, i] + values[STEP_REWARD, agent, i]
                values[ACCUMULATED_REWARD, agent, i] = 0.0
                column[lane] = 0.0
        else:
            for lane in range(count):
                i = first + lane
                steps = float64(t[i] + 1)
                total = accumulated[agent, i] + values[STEP_REWARD, agent, i]
                # Exact: no quotient of integers below 2³¹ rounds to a whole number it is not.
                paid = (steps >= T) | (np.floor(steps / k) * k == steps)
                kept = 0.0 if paid else total
                values[REWARD, agent, i] = total if paid else 0.0
                values[ACCUMULATED_REWARD, agent, i] = kept
                waiting = kept / k  # above 1 only where a stream went on to a smaller k
                column[lane] = waiting if waiting < 1.0 else 1.0
        for lane in range(count):
            observation[first + lane, S + 1 + agent] = column[lane]
    for lane in range(count):
        steps = float64(t[first + lane] + 1)
        ends[1, first + lane] = steps >= T
        column[lane] = steps / T
    for lane in range(count):
        observation[first + lane, S] = column[lane]


STEP_MANY = boolean(
    _PACKED,
    float64[:, ::1],
    int64[::1],
    float64[:, ::1],
    float64[:, ::1],
    float64[:, ::1],
    float32[:, ::1],
    float64[:, ::1],
    float64[:, :, ::1],
    boolean[:, ::1],
)


@njit(STEP_MANY, error_model="numpy", cache=True)
def step_many(p, s, t, accumulated, action, moved, observation, optimal, values, ends):  # type: ignore[no-untyped-def]
    """One step of `B` lanes of a team of n agents; a single agent is a team of one.

    The lanes are stepped in blocks that fit in cache: π*, its distance from the action, the
    transition, the rewards, then the payouts.

    Args:
      p: the packed task.
      s: `[S, B]` states, channel by channel.
      t: `[B]` steps completed before this one; advanced in place.
      accumulated: `[n, B]` each agent's r_cum; advanced in place.
      action: `[B, A]`, clipped here.
      moved: `[S, B]`, written: the next states.
      observation: `[B, S + 1 + n]`, written: s, t/T, and each agent's r_cum/k.
      optimal: `[B, A]`, written: π* of the states acted in.
      values: `[5, n, B]`, written: the rows of `compiled.arrays`.
      ends: `[2, B]`, written: terminated, truncated.

    Returns:
      False where an action was not finite; `t` and `accumulated` are unchanged then.
    """
    S, A, agents, widest = int(p[0]), int(p[1]), int(p[6]), int(p[7])
    W = p[_HEADER : _HEADER + A * S].reshape(A, S)
    b = p[_HEADER + A * S : _HEADER + A * S + S]
    lanes = max(32, min(128, BLOCK_NUMBERS // widest))
    # Room for one block; each is contiguous along the lanes.
    x, y = np.empty((widest, lanes)), np.empty((widest, lanes))
    best, acted = np.empty((A, lanes)), np.empty((A, lanes))
    distance, team_distance = np.empty((agents, lanes)), np.empty(lanes)
    column, cells = np.empty(lanes), np.empty(lanes, np.int32)
    owner, owned = np.empty(A, np.int64), np.empty(agents)
    finite = True
    for first in range(0, t.size, lanes):
        count = min(lanes, t.size - first)
        _block_policy(p, s, first, count, x, y, cells, best, owner, owned)
        _block_distance(action, first, count, best, owner, distance, acted, optimal)
        _block_transition(W, b, s, first, count, acted, column, moved, observation)
        finite &= _block_rewards(p, first, count, distance, owned, team_distance, values, ends)
        _block_payout(p, first, count, t, accumulated, column, values, ends, observation)
    if finite:
        for agent in range(agents):
            for i in range(t.size):
                accumulated[agent, i] = values[ACCUMULATED_REWARD, agent, i]
        for i in range(t.size):
            t[i] += 1
    return finite


NETWORK = void(_PACKED, float64[:, ::1], boolean, float64[:, ::1])


@njit(NETWORK, error_model="numpy", cache=True)
def network(p, s, uniform, out):  # type: ignore[no-untyped-def]
    """The output `[out, B]` of packed layers of inputs `[in, B]`; see `pack_layers`."""
    layers, widest = int(p[0]), int(p[1])
    lanes = min(max(32, min(128, BLOCK_NUMBERS // widest)), s.shape[1])
    x, y, cells = np.empty((widest, lanes)), np.empty((widest, lanes)), np.empty(lanes, np.int32)
    for first in range(0, s.shape[1], lanes):
        count = min(lanes, s.shape[1] - first)
        for j in range(s.shape[0]):
            for lane in range(count):
                x[j, lane] = s[j, first + lane]
        x, y, _, _ = block_layers(p, 2, layers, x, y, cells, count, uniform)
        for o in range(out.shape[0]):
            for lane in range(count):
                out[o, first + lane] = x[o, lane]


@njit(void(float64[:, ::1], _PACKED), error_model="numpy", cache=True)
def add_and_normal_cdf(x, b):  # type: ignore[no-untyped-def]
    """x ← Φ(x + b) in place, `[B, out]` and `[out]`: the step after a matrix product."""
    cells = np.empty(b.size, np.int32)
    for i in range(x.shape[0]):
        for o in range(b.size):
            cells[o], x[i, o] = cell_of(x[i, o] + b[o])
        for o in range(b.size):
            x[i, o] = in_cell(cells[o], x[i, o])

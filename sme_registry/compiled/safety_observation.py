"""What `safety` and `observation` add to a step, as machine code, for one lane and for a batch.

As in `kernels`, both do the same floating-point operations in the same order for each lane. What a
task adds travels as one flat float64 array:
    S, A, m, τ (0 without safety), r_min, how distractors move (an index of `_DYNAMICS`),
    whether layers of the mixing end with Φ (0 or 1), widest layer,
    how many layers limit and how many mix, size of all this, the limiting layers, W [A, m] and
    b [m] of the distractors' transition where they have one, the mixing layers; each as in a packed
    task.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import float32, float64, njit, types, uint64, void

from sme_registry.compiled.arrays import (
    COST,
    HAS_MORE,
    LANE_STATE,
    LANE_VALUES,
    MORE_COST,
    MORE_OWN,
    MORE_SAFE_REGRET,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    SAFE_REGRET,
    STEP_REWARD,
)
from sme_registry.compiled.kernels import (
    BLOCK_NUMBERS,
    LANE_FLOAT32,
    LANE_FLOAT64,
    PACKED_LANE_FLOAT32,
    PACKED_LANE_FLOAT64,
    block_layers,
    clipped,
    lane_layers,
    lane_step,
    layer_parts,
    reward_of,
)
from sme_registry.task import Task
from sme_registry.task.draw import FIRST_MIX, GOLDEN, SECOND_MIX

_DYNAMICS = None, "noise", "autonomous", "driven"
_NOISE, _AUTONOMOUS = 1, 2
_HEADER = 11


def pack(task: Task) -> npt.NDArray[np.float64]:
    spec, layers = task.spec, (*task.limiting, *task.mixing)
    tightness, dynamics, nonlinear = spec.tightness, spec.dynamics, spec.mixing == "nonlinear"
    sides = (side for W, _ in layers for side in W.shape)
    widest = max(spec.action_dim, spec.state_dim + spec.distractors, *sides)
    parts: list[npt.ArrayLike] = [
        [spec.state_dim, spec.action_dim, spec.distractors, tightness, spec.r_min],
        [_DYNAMICS.index(dynamics), nonlinear, widest, len(task.limiting), len(task.mixing), 0.0],
        *layer_parts(task.limiting),
        *(array.ravel() for array in task.distractor_transition or ()),
        *layer_parts(task.mixing),
    ]
    packed = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
    packed[10] = packed.size
    return packed


def more_size(packed: npt.NDArray[np.float64]) -> int:
    """The numbers of a single environment behind its plain ones, with room for two layers."""
    return MORE_OWN + OWN_DISTRACTORS + int(packed[2]) + 2 * int(packed[7])


_PACKED = types.Array(float64, 1, "C", readonly=True)
_U1, _U30, _U27, _U31, _U12 = (np.uint64(number) for number in (1, 30, 27, 31, 12))
_OWN_KEY, _OWN_DRAWN, _OWN_D = map(np.uint64, (OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS))
_COST, _SAFE_REGRET, _OWN = map(np.uint64, (MORE_COST, MORE_SAFE_REGRET, MORE_OWN))
_LANE_S, _LANE_R = np.uint64(LANE_STATE), np.uint64(LANE_VALUES + STEP_REWARD)


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
def _lane_limits(q, lane, v, extra, action, optimal, step_reward):  # type: ignore[no-untyped-def]
    """Limits and safe action of one lane, behind `optimal`; cost and safe regret. v is given."""
    A, tightness = np.uint64(q[1]), q[3]
    excess, missed = 0.0, 0.0
    for i in range(A):
        limit = 1.0 - 2.0 * tightness * lane[v + i]
        safe = optimal[i] if optimal[i] < limit else limit
        above = clipped(float64(action[i])) - limit
        excess += above if above > 0.0 else 0.0
        missed += abs(safe - optimal[i])
        optimal[A + i] = limit
        optimal[A + A + i] = safe
    lane[extra + _COST] = excess / (2.0 * tightness * float64(A))
    lane[extra + _SAFE_REGRET] = reward_of(1.0 - missed / float64(A), q[4]) - step_reward


@njit(error_model="numpy")
def _lane_distractors(q, at, lane, own, free, action):  # type: ignore[no-untyped-def]
    """Move the distractors of one lane; `lane[free]` begins room for what drives them, `[A]`."""
    A, m, dynamics = np.uint64(q[1]), np.uint64(q[2]), int(q[5])
    drawn, start = uint64(lane[own + _OWN_DRAWN]), _mixed(uint64(lane[own + _OWN_KEY]))
    d = own + _OWN_D
    if dynamics == _NOISE:
        for j in range(m):
            lane[d + j] = _uniform(start, drawn + j + _U1)
        lane[own + _OWN_DRAWN] += float64(m)
        return at
    for i in range(A):
        if dynamics == _AUTONOMOUS:
            lane[free + i] = float64(float32(_uniform(start, drawn + i + _U1)))
        else:
            lane[free + i] = clipped(float64(float32(action[i])))
    if dynamics == _AUTONOMOUS:
        lane[own + _OWN_DRAWN] += float64(A)
    b = at + A * m
    for j in range(m):
        moved = lane[d + j] + q[b + j]
        for i in range(A):
            moved = moved + q[at + i * m + j] * lane[free + i]
        lane[d + j] = 2.0 * abs(moved - np.rint(moved))
    return b + m


@njit(error_model="numpy")
def _lane_seen(q, at, lane, s, d, x, y, observation):  # type: ignore[no-untyped-def]
    """M(s, d) of one lane, before t/T and r_cum/k, which make room for it."""
    S, m = np.uint64(q[0]), np.uint64(q[2])
    of_t, of_r_cum = observation[S], observation[S + _U1]
    for j in range(S):
        lane[x + j] = lane[s + j]
    for j in range(m):
        lane[x + S + j] = lane[d + j]
    x, at = lane_layers(q, at, np.uint64(q[9]), lane, x, y, q[6] == 1.0)
    for j in range(S + m):
        observation[j] = lane[x + j]
    observation[S + m], observation[S + m + _U1] = of_t, of_r_cum


@njit(error_model="numpy")
def _lane_step_with_more(p, lane, start, action, optimal, observation):  # type: ignore[no-untyped-def]
    q = p[np.uint64(p[8]) :]
    S, m, widest = np.uint64(q[0]), np.uint64(q[2]), np.uint64(q[7])
    extra = start + np.uint64(p[7]) + np.uint64(p[7]) + _LANE_S + S
    own = extra + _OWN
    d, s = own + _OWN_D, start + _LANE_S
    x = d + m
    y = x + widest
    v, at = x, np.uint64(_HEADER)
    if q[3] > 0.0:
        for j in range(S):
            lane[x + j] = lane[s + j]
        v, at = lane_layers(q, at, np.uint64(q[8]), lane, x, y, True)
    reward, end = lane_step(p, lane, start, action, optimal, observation)
    if end < 0.0:
        return reward, end
    if q[3] > 0.0:
        _lane_limits(q, lane, v, extra, action, optimal, lane[start + _LANE_R])
    if q[2] > 0.0:
        at = _lane_distractors(q, at, lane, own, x, action)
    if q[2] > 0.0 or q[9] > 0.0:
        _lane_seen(q, at, lane, s, d, x, y, observation)
    return reward, end + HAS_MORE


@njit([LANE_FLOAT32, LANE_FLOAT64], error_model="numpy", cache=True)
def step_lane(p, lane, action, optimal, observation):  # type: ignore[no-untyped-def]
    """`kernels.step_lane`, and what `safety` and `observation` add to it.

    Args:
      p: the packed task, and what it adds, packed, behind it.
      lane: the lane's own numbers, `lane_size` of them and then `more_size`; advanced in place.
      action: `[A]`; any numbers, clipped here.
      optimal: `[A]`, written; with `safety` `[3A]`: also the limits and the safe action.
      observation: `[S + m + 2]`, written.

    Returns:
      `(reward, end)` as `kernels.step_lane`; where a step was made, HAS_MORE is added to the end.
    """
    return _lane_step_with_more(p, lane, np.uint64(0), action, optimal, observation)


@njit([PACKED_LANE_FLOAT32, PACKED_LANE_FLOAT64], error_model="numpy", cache=True)
def step_packed_lane(lane, action, optimal, observation):  # type: ignore[no-untyped-def]
    """`step_lane` for a lane whose own numbers follow both packed parts in one array."""
    start = np.uint64(lane[8] + lane[np.uint64(lane[8]) + np.uint64(10)])
    return _lane_step_with_more(lane, lane, start, action, optimal, observation)


# The parts of `add_many`, in its order; inlined as those of `step_many`.
@njit(inline="always", error_model="numpy")
def _block_limits(q, first, count, action, optimal, x, excess, missed, values, limits):  # type: ignore[no-untyped-def]
    """Limits, safe actions, cost and safe regret of a block of lanes, from v in `x`."""
    A, tightness, r_min = int(q[1]), q[3], q[4]
    for lane in range(count):
        excess[lane], missed[lane] = 0.0, 0.0
    for i in range(A):
        for lane in range(count):
            best = optimal[first + lane, i]
            limit = 1.0 - 2.0 * tightness * x[i, lane]
            safe = best if best < limit else limit
            above = clipped(action[first + lane, i]) - limit
            excess[lane] += above if above > 0.0 else 0.0
            missed[lane] += abs(safe - best)
            limits[0, first + lane, i] = limit
            limits[1, first + lane, i] = safe
    for lane in range(count):
        values[COST, 0, first + lane] = excess[lane] / (2.0 * tightness * float64(A))
        best_safe = reward_of(1.0 - missed[lane] / float64(A), r_min)
        values[SAFE_REGRET, 0, first + lane] = best_safe - values[STEP_REWARD, 0, first + lane]


@njit(inline="always", error_model="numpy")
def _block_numbers(own, first, count, n, start, out, row, column):  # type: ignore[no-untyped-def]
    """The next n random numbers of a block of lanes, into `out` from its row and column on."""
    for lane in range(count):
        start[lane] = _mixed(uint64(own[OWN_KEY, first + lane]))
        start[lane] += GOLDEN * uint64(own[OWN_DRAWN, first + lane])
        own[OWN_DRAWN, first + lane] += float64(n)
    for j in range(n):
        place = uint64(j + 1)
        for lane in range(count):
            out[row + j, column + lane] = _uniform(start[lane], place)


@njit(inline="always", error_model="numpy")
def _block_driven(q, at, own, first, count, driving, column):  # type: ignore[no-untyped-def]
    """Move the distractors of a block of lanes by their own transition, whose W is at `q[at]`."""
    A, m = int(q[1]), int(q[2])
    b = at + A * m
    for j in range(m):
        offset = q[b + j]
        for lane in range(count):
            column[lane] = own[OWN_DISTRACTORS + j, first + lane] + offset
        for i in range(A):
            w = q[at + i * m + j]
            for lane in range(count):
                column[lane] = column[lane] + w * driving[i, lane]
        for lane in range(count):
            folded = 2.0 * abs(column[lane] - np.rint(column[lane]))
            own[OWN_DISTRACTORS + j, first + lane] = folded


@njit(inline="always", error_model="numpy")
def _block_inputs(after, own, first, count, x):  # type: ignore[no-untyped-def]
    """(s, d) of a block of lanes, into `x` `[S + m, lanes]`."""
    S = after.shape[0]
    for j in range(S):
        for lane in range(count):
            x[j, lane] = after[j, first + lane]
    for j in range(own.shape[0] - OWN_DISTRACTORS):
        for lane in range(count):
            x[S + j, lane] = own[OWN_DISTRACTORS + j, first + lane]


@njit(inline="always", error_model="numpy")
def _block_distractors(q, at, own, first, count, action, driving, start, column):  # type: ignore[no-untyped-def]
    """Move the distractors of a block of lanes; returns what follows their transition in `q`."""
    A, m, dynamics = int(q[1]), int(q[2]), int(q[5])
    if dynamics == _NOISE:
        _block_numbers(own, first, count, m, start, own, OWN_DISTRACTORS, first)
        return at
    if dynamics == _AUTONOMOUS:
        _block_numbers(own, first, count, A, start, driving, 0, 0)
    for i in range(A):
        for lane in range(count):
            if dynamics != _AUTONOMOUS:
                driving[i, lane] = action[first + lane, i]
            driving[i, lane] = clipped(float64(float32(driving[i, lane])))
    _block_driven(q, at, own, first, count, driving, column)
    return at + A * m + m


ADD_MANY = void(
    _PACKED,
    float64[:, ::1],
    float64[:, ::1],
    float64[:, ::1],
    float64[:, ::1],
    float64[:, ::1],
    float64[:, :, ::1],
    float32[:, ::1],
    float64[:, :, ::1],
)


@njit(ADD_MANY, error_model="numpy", cache=True)
def add_many(q, own, before, after, action, optimal, values, observation, limits):  # type: ignore[no-untyped-def]
    """Go on with a step of `B` lanes, which `kernels.step_many` has made.

    Args:
      q: what the task adds, packed.
      own: `[2 + m, B]` each lane's key, numbers drawn, and distractors; advanced in place.
      before: `[S, B]` the states acted in.
      after: `[S, B]` the next states.
      action: `[B, A]`, finite; clipped here.
      optimal: `[B, A]` π* of the states acted in.
      values: `[5 or 7, 1, B]`; with `safety` the rows COST and SAFE_REGRET are written.
      observation: `[B, S + m + 2]`; the first S + 2 columns are the step's.
      limits: `[2, B, A]`, written with `safety`: the limits and the safe actions.
    """
    S, A, m, widest, mixing = int(q[0]), int(q[1]), int(q[2]), int(q[7]), int(q[9])
    lanes = max(32, min(128, BLOCK_NUMBERS // widest))
    room, other = np.empty((widest, lanes)), np.empty((widest, lanes))
    cells, start = np.empty(lanes, np.int32), np.empty(lanes, np.uint64)
    driving, column, second = np.empty((A, lanes)), np.empty(lanes), np.empty(lanes)
    for first in range(0, after.shape[1], lanes):
        count = min(lanes, after.shape[1] - first)
        x, y, at = room, other, _HEADER
        if q[3] > 0.0:
            for j in range(S):
                for lane in range(count):
                    x[j, lane] = before[j, first + lane]
            x, y, at, _ = block_layers(q, at, int(q[8]), x, y, cells, count, True)
            _block_limits(q, first, count, action, optimal, x, column, second, values, limits)
        if m > 0:
            at = _block_distractors(q, at, own, first, count, action, driving, start, column)
        if m > 0 or mixing > 0:
            for lane in range(first, first + count):
                of_t, of_r_cum = observation[lane, S], observation[lane, S + 1]
                observation[lane, S + m], observation[lane, S + m + 1] = of_t, of_r_cum
            _block_inputs(after, own, first, count, x)
            x, y, at, _ = block_layers(q, at, mixing, x, y, cells, count, q[6] == 1.0)
            for lane in range(count):
                for j in range(S + m):
                    observation[first + lane, j] = x[j, lane]

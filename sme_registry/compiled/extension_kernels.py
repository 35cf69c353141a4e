"""What `safety` and `observation` add to a step, as machine code, for one lane and for a batch.

As in `kernels`, both do the same floating-point operations in the same order for each lane. A
task's extension travels as one flat float64 array:
    S, A, m, τ (0 without safety), r_min, how distractors move (an index of `_DYNAMICS`),
    whether layers of the mixing end with Φ (0 or 1), widest layer,
    how many layers limit and how many mix, the limiting layers, W [A, m] and b [m] of the
    distractors' transition where they have one, the mixing layers; each as in a packed task.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import float32, float64, njit, types, uint64, void

from sme_registry.compiled.kernels import (
    BLOCK_NUMBERS,
    block_layers,
    lane_layers,
    layer_parts,
)
from sme_registry.compiled.values import (
    COST,
    LANE_STATE,
    LANE_VALUES,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    ROOM_COST,
    ROOM_SAFE_REGRET,
    ROOM_STATE,
    SAFE_REGRET,
    STEP_REWARD,
)
from sme_registry.task import Task
from sme_registry.task.streams import FIRST_MIX, GOLDEN, SECOND_MIX

_DYNAMICS = None, "noise", "autonomous", "driven"
_NOISE, _AUTONOMOUS = 1, 2
_HEADER = 10


def pack_extension(task: Task) -> npt.NDArray[np.float64]:
    """The extension of a task as one flat array, in the order of this module's head."""
    spec, layers = task.spec, (*task.limiting, *task.mixing)
    tightness = 0.0 if spec.safety is None else spec.safety.tightness
    dynamics = None if spec.observation is None else spec.observation.dynamics
    nonlinear = spec.observation is not None and spec.observation.mixing == "nonlinear"
    sides = (side for W, _ in layers for side in W.shape)
    widest = max(spec.action_dim, spec.state_dim + spec.distractors, *sides)
    parts: list[npt.ArrayLike] = [
        [spec.state_dim, spec.action_dim, spec.distractors, tightness, spec.r_min],
        [_DYNAMICS.index(dynamics), nonlinear, widest, len(task.limiting), len(task.mixing)],
        *layer_parts(task.limiting),
        *(array.ravel() for array in task.distractor_transition or ()),
        *layer_parts(task.mixing),
    ]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def room_size(packed: npt.NDArray[np.float64]) -> int:
    """The numbers that a single lane has besides its own: see `values.ROOM_STATE`."""
    return ROOM_STATE + int(packed[0]) + 2 * int(packed[7])


_PACKED = types.Array(float64, 1, "C", readonly=True)
_U1, _U30, _U27, _U31, _U12 = (np.uint64(number) for number in (1, 30, 27, 31, 12))
_OWN_KEY, _OWN_DRAWN, _OWN_D = map(np.uint64, (OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS))
_ROOM_COST, _ROOM_SAFE = np.uint64(ROOM_COST), np.uint64(ROOM_SAFE_REGRET)
_ROOM_S = np.uint64(ROOM_STATE)
_LANE_S, _LANE_R = np.uint64(LANE_STATE), np.uint64(LANE_VALUES + STEP_REWARD)


@njit(inline="always", error_model="numpy")
def _mixed(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _U30)) * FIRST_MIX
    z = (z ^ (z >> _U27)) * SECOND_MIX
    return z ^ (z >> _U31)


@njit(inline="always", error_model="numpy")
def _uniform(start, place):  # type: ignore[no-untyped-def]
    """The number at a place of the stream of mix(key) = start; see `streams.counted`."""
    return (float64(_mixed(start + GOLDEN * place) >> _U12) + 0.5) * 2.0**-52


@njit(inline="always", error_model="numpy")
def _clipped(a):  # type: ignore[no-untyped-def]
    a = a if a > 0.0 else 0.0
    return a if a < 1.0 else 1.0


@njit(inline="always", error_model="numpy")
def _reward(similarity, r_min):  # type: ignore[no-untyped-def]
    graded = 4.0 * (similarity - 0.75)
    return graded if graded > 0.0 and graded > r_min else 0.0


@njit(error_model="numpy")
def _lane_limits(q, room, lane, action, optimal, limits):  # type: ignore[no-untyped-def]
    """Limits, safe action, cost and safe regret of one lane; returns what follows v in `q`."""
    S, A = np.uint64(q[0]), np.uint64(q[1])
    tightness, r_min = q[3], q[4]
    x = _ROOM_S + S
    for j in range(S):
        room[x + j] = room[_ROOM_S + j]
        room[_ROOM_S + j] = lane[_LANE_S + j]
    y = x + np.uint64(q[7])
    v, at = lane_layers(q, np.uint64(_HEADER), np.uint64(q[8]), room, x, y, True)
    excess, missed = 0.0, 0.0
    for i in range(A):
        limit = 1.0 - 2.0 * tightness * room[v + i]
        safe = optimal[i] if optimal[i] < limit else limit
        above = _clipped(float64(action[i])) - limit
        excess += above if above > 0.0 else 0.0
        missed += abs(safe - optimal[i])
        limits[0, i] = limit
        limits[1, i] = safe
    room[_ROOM_COST] = excess / (2.0 * tightness * float64(A))
    room[_ROOM_SAFE] = _reward(1.0 - missed / float64(A), r_min) - lane[_LANE_R]
    return at


@njit(error_model="numpy")
def _lane_distractors(q, at, own, driving, action):  # type: ignore[no-untyped-def]
    """Move the distractors of one lane; returns what follows their transition in `q`.

    `driving` `[A]` is room for what drives them.
    """
    A, m, dynamics = np.uint64(q[1]), np.uint64(q[2]), int(q[5])
    drawn, start = uint64(own[_OWN_DRAWN]), _mixed(uint64(own[_OWN_KEY]))
    if dynamics == _NOISE:
        for j in range(m):
            own[_OWN_D + j] = _uniform(start, drawn + j + _U1)
        own[_OWN_DRAWN] += float64(m)
        return at
    for i in range(A):
        if dynamics == _AUTONOMOUS:
            driving[i] = float64(float32(_uniform(start, drawn + i + _U1)))
        else:
            driving[i] = _clipped(float64(float32(action[i])))
    if dynamics == _AUTONOMOUS:
        own[_OWN_DRAWN] += float64(A)
    b = at + A * m
    for j in range(m):
        moved = own[_OWN_D + j] + q[b + j]
        for i in range(A):
            moved = moved + q[at + i * m + j] * driving[i]
        own[_OWN_D + j] = 2.0 * abs(moved - np.rint(moved))
    return b + m


@njit(error_model="numpy")
def _lane_seen(q, at, own, room, lane, observation):  # type: ignore[no-untyped-def]
    """M(s, d) of one lane, before t/T and r_cum/k, which make room for it."""
    S, m = np.uint64(q[0]), np.uint64(q[2])
    x = _ROOM_S + S
    y = x + np.uint64(q[7])
    of_t, of_r_cum = observation[S], observation[S + _U1]
    for j in range(S):
        room[x + j] = lane[_LANE_S + j]
    for j in range(m):
        room[x + S + j] = own[_OWN_D + j]
    x, at = lane_layers(q, at, np.uint64(q[9]), room, x, y, q[6] == 1.0)
    for j in range(S + m):
        observation[j] = room[x + j]
    observation[S + m], observation[S + m + _U1] = of_t, of_r_cum


_LANE = (float64[::1], float32[::1], float64[:, ::1])
EXTEND_LANE_FLOAT32 = void(_PACKED, float64[::1], float64[::1], float64[::1], float32[:], *_LANE)
EXTEND_LANE_FLOAT64 = void(_PACKED, float64[::1], float64[::1], float64[::1], float64[:], *_LANE)


@njit([EXTEND_LANE_FLOAT32, EXTEND_LANE_FLOAT64], error_model="numpy", cache=True)
def extend_lane(q, own, room, lane, action, optimal, observation, limits):  # type: ignore[no-untyped-def]
    """Go on with a step of one lane, which `kernels.step_lane` has made.

    Args:
      q: the packed extension.
      own: `[2 + m]` the lane's key, numbers drawn, and distractors; advanced in place.
      room: `[room_size]`; the state acted in, replaced by the present one; cost and safe regret,
        written.
      lane: the lane after its step, from its t on.
      action: `[A]`, finite; clipped here.
      optimal: `[A]` π* of the state acted in.
      observation: `[S + m + 2]`; the first S + 2 entries are the step's.
      limits: `[2, A]`, written with `safety`: the limits and the safe action.
    """
    at = np.uint64(_HEADER)
    if q[3] > 0.0:
        at = _lane_limits(q, room, lane, action, optimal, limits)
    if q[2] > 0.0:
        free = _ROOM_S + np.uint64(q[0])
        driving = room[free : free + np.uint64(q[1])]
        at = _lane_distractors(q, at, own, driving, action)
    if q[2] > 0.0 or q[9] > 0.0:
        _lane_seen(q, at, own, room, lane, observation)


# The parts of `extend_many`, in its order; inlined as those of `step_many`.
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
            above = _clipped(action[first + lane, i]) - limit
            excess[lane] += above if above > 0.0 else 0.0
            missed[lane] += abs(safe - best)
            limits[0, first + lane, i] = limit
            limits[1, first + lane, i] = safe
    for lane in range(count):
        values[COST, 0, first + lane] = excess[lane] / (2.0 * tightness * float64(A))
        best_safe = _reward(1.0 - missed[lane] / float64(A), r_min)
        values[SAFE_REGRET, 0, first + lane] = best_safe - values[STEP_REWARD, 0, first + lane]


@njit(inline="always", error_model="numpy")
def _block_numbers(own, first, count, numbers, start):  # type: ignore[no-untyped-def]
    """The next random numbers of a block of lanes, into `numbers` `[n, lanes]`."""
    for lane in range(count):
        start[lane] = _mixed(uint64(own[OWN_KEY, first + lane]))
        start[lane] += GOLDEN * uint64(own[OWN_DRAWN, first + lane])
        own[OWN_DRAWN, first + lane] += float64(numbers.shape[0])
    for j in range(numbers.shape[0]):
        place = uint64(j + 1)
        for lane in range(count):
            numbers[j, lane] = _uniform(start[lane], place)


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
def _block_distractors(q, at, own, first, count, action, driving, noise, start, column):  # type: ignore[no-untyped-def]
    """Move the distractors of a block of lanes; returns what follows their transition in `q`."""
    A, m, dynamics = int(q[1]), int(q[2]), int(q[5])
    if dynamics == _NOISE:
        _block_numbers(own, first, count, noise[:m], start)
        for j in range(m):
            for lane in range(count):
                own[OWN_DISTRACTORS + j, first + lane] = noise[j, lane]
        return at
    if dynamics == _AUTONOMOUS:
        _block_numbers(own, first, count, driving, start)
    for i in range(A):
        for lane in range(count):
            if dynamics != _AUTONOMOUS:
                driving[i, lane] = action[first + lane, i]
            driving[i, lane] = _clipped(float64(float32(driving[i, lane])))
    _block_driven(q, at, own, first, count, driving, column)
    return at + A * m + m


EXTEND_MANY = void(
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


@njit(EXTEND_MANY, error_model="numpy", cache=True)
def extend_many(q, own, before, after, action, optimal, values, observation, limits):  # type: ignore[no-untyped-def]
    """Go on with a step of `B` lanes, which `kernels.step_many` has made.

    Args:
      q: the packed extension.
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
            x, y, at = block_layers(q, at, int(q[8]), x, y, cells, count, True)
            _block_limits(q, first, count, action, optimal, x, column, second, values, limits)
        if m > 0:
            at = _block_distractors(q, at, own, first, count, action, driving, x, start, column)
        if m > 0 or mixing > 0:
            for lane in range(first, first + count):
                of_t, of_r_cum = observation[lane, S], observation[lane, S + 1]
                observation[lane, S + m], observation[lane, S + m + 1] = of_t, of_r_cum
            _block_inputs(after, own, first, count, x)
            x, y, at = block_layers(q, at, mixing, x, y, cells, count, q[6] == 1.0)
            for j in range(S + m):
                for lane in range(count):
                    observation[first + lane, j] = x[j, lane]

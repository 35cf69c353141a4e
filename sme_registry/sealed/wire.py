"""What a sealed-online season's server and its clients send each other: addresses and raw arrays.

    POST /api/seasons/{id}/tickets                                       a ticket
    GET  /api/seasons/{id}/tickets/{n}                                   its status
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/start?lanes=L       begin, or go on
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/steps               one step of all lanes
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/finish              take no more steps
    GET  /api/seasons/{id}/tickets/{n}/instances/{i}/challenge           challenge states, .npy
    GET  /api/seasons/{id}/tickets/{n}/instances/{i}/journal             digest of all steps, JSON
    PUT  /api/seasons/{id}/tickets/{n}/instances/{i}/answers?signature=  an action for each, .npy

Each but the first has the ticket's token as `Authorization: Bearer`; the signature is that of
`signing`. Every request may be repeated after a lost answer: none has a further effect. Numbers are
little-endian; L are the lanes, S and A the state and action channels.

    start, answer    uint64 number of the last steps, float32 [L, S + 2] present observations
    steps, request   uint64 number: 1, 2, …           float32 [L, A] actions in [0, 1]
    steps, answer                                     float32 [L, 2(S + 2) + 2] in the columns

        S + 2    observation, of the next episode where this step ended one
        1        reward
        1        ends: 0 none, 1 terminated, 2 truncated, 3 both
        S + 2    last observation of the episode that ended; 0 where none did

So no size depends on a state. The same steps with the same number get the same answer; other
actions with that number, and numbers further ahead, are refused.

Arrays travel as .npy files of version 1.0, type `<f4`, C order and two axes; nothing else is read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.envs.types import Mask, Observation
from sme_registry.errors import ActionError, WireError

Float32 = npt.NDArray[np.float32]

TERMINATED, TRUNCATED = 1, 2
_FLOAT, _NUMBER_BYTES = np.dtype("<f4"), 8
_MAGIC = b"\x93NUMPY\x01\x00"
_MAX_HEADER = 1024
_HEADER = re.compile(
    rb"\{'descr': '<f4', 'fortran_order': False, 'shape': \((\d{1,9}), (\d{1,9})\), \} *\n"
)


def tickets_path(season: str) -> str:
    """Where tickets of a season are requested.

    Examples:
      >>> from sme_registry.sealed import tickets_path
      >>> tickets_path("winter")
      '/api/seasons/winter/tickets'
    """
    return f"/api/seasons/{season}/tickets"


def ticket_path(season: str, ticket: int) -> str:
    """The address of a ticket.

    Examples:
      >>> from sme_registry.sealed import ticket_path
      >>> ticket_path("winter", 3)
      '/api/seasons/winter/tickets/3'
    """
    return f"{tickets_path(season)}/{ticket}"


def instance_path(season: str, ticket: int, instance: int, action: str) -> str:
    """The address of an action on an instance, such as `start` or `steps`.

    Examples:
      >>> from sme_registry.sealed import instance_path
      >>> instance_path("winter", 3, 0, "steps")
      '/api/seasons/winter/tickets/3/instances/0/steps'
    """
    return f"{ticket_path(season, ticket)}/instances/{instance}/{action}"


def bearer(token: str) -> str:
    """The value of the header `Authorization`.

    Examples:
      >>> from sme_registry.sealed import bearer
      >>> bearer("a token")
      'Bearer a token'
    """
    return f"Bearer {token}"


class Begun(NamedTuple):
    """The answer to `start`: the number of the last steps, and observations `[L, S + 2]`."""

    number: int
    observation: Observation


class Steps(NamedTuple):
    """The answer to `steps`.

    Attributes:
      observation: `[L, S + 2]`, of the next episode in lanes whose episode ended.
      reward: `[L]` float32.
      terminated, truncated: `[L]`.
      last_observation: `[L, S + 2]` of the episode that ended; 0 in the other lanes.
    """

    observation: Observation
    reward: Float32
    terminated: Mask
    truncated: Mask
    last_observation: Observation


@dataclass(frozen=True)
class StepFormat:
    """The messages of an instance that is stepped in some number of lanes.

    Examples:
      >>> from sme_registry.sealed import StepFormat
      >>> StepFormat(lanes=4, state_dim=8, action_dim=2).lanes
      4
    """

    lanes: int
    state_dim: int
    action_dim: int

    @property
    def request_bytes(self) -> int:
        return _NUMBER_BYTES + _FLOAT.itemsize * self.lanes * self.action_dim

    @property
    def answer_bytes(self) -> int:
        return _FLOAT.itemsize * self.lanes * (2 * self._width + 2)

    @property
    def _width(self) -> int:
        return self.state_dim + 2

    def pack_begun(self, begun: Begun) -> bytes:
        return _packed_number(begun.number) + _packed(begun.observation)

    def unpack_begun(self, data: bytes) -> Begun:
        expected = _NUMBER_BYTES + _FLOAT.itemsize * self.lanes * self._width
        _check_size("start", data, expected)
        observation = np.frombuffer(data, _FLOAT, offset=_NUMBER_BYTES)
        return Begun(_number_in(data), _native(observation.reshape(self.lanes, -1)))

    def pack_request(self, number: int, actions: npt.NDArray[np.floating]) -> bytes:
        return _packed_number(number) + _packed(actions)

    def unpack_request(self, data: bytes) -> tuple[int, Float32]:
        """The number and the actions `[L, A]` in the body of `steps`; finite, not clipped."""
        _check_size("steps", data, self.request_bytes)
        actions = np.frombuffer(data, _FLOAT, offset=_NUMBER_BYTES)
        _refuse_not_finite(actions)
        return _number_in(data), _native(actions.reshape(self.lanes, -1))

    def pack_steps(self, steps: Steps) -> bytes:
        width = self._width
        table = np.empty((self.lanes, 2 * width + 2), _FLOAT)
        table[:, :width] = steps.observation
        table[:, width] = steps.reward
        table[:, width + 1] = TERMINATED * steps.terminated + TRUNCATED * steps.truncated
        table[:, width + 2 :] = steps.last_observation
        return table.tobytes()

    def unpack_steps(self, data: bytes) -> Steps:
        """The answer to `steps` in these bytes, as fresh arrays."""
        _check_size("steps", data, self.answer_bytes)
        width = self._width
        table = _native(np.frombuffer(data, _FLOAT).reshape(self.lanes, -1))
        ends = table[:, width + 1]
        flags = np.zeros(self.lanes, np.int8)
        for flag in (TERMINATED, TRUNCATED, TERMINATED | TRUNCATED):
            flags[ends == flag] = flag
        if not np.array_equal(flags, ends):
            raise WireError(
                "steps: the ends of episodes must be 0, 1, 2 or 3. Check the server's version."
            )
        return Steps(
            observation=table[:, :width].copy(),
            reward=table[:, width].copy(),
            terminated=(flags & TERMINATED).astype(bool),
            truncated=(flags & TRUNCATED).astype(bool),
            last_observation=table[:, width + 2 :].copy(),
        )


def pack_table(table: npt.NDArray[np.floating]) -> bytes:
    """A table `[rows, columns]` as the bytes of an .npy file of float32.

    Examples:
      >>> from sme_registry.sealed import pack_table, unpack_table
      >>> unpack_table(pack_table(np.ones((1, 2))), columns=2)
      array([[1., 1.]], dtype=float32)
    """
    rows, columns = table.shape
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}"
    # The data begin at a multiple of 64 bytes, as the format asks.
    padding = -(len(_MAGIC) + 2 + len(text) + 1) % 64
    header = text.encode() + b" " * padding + b"\n"
    return _MAGIC + len(header).to_bytes(2, "little") + header + _packed(table)


def table_bytes(rows: int, columns: int) -> int:
    """The most bytes that the .npy file of a table of this shape has.

    Examples:
      >>> from sme_registry.sealed import pack_table, table_bytes
      >>> len(pack_table(np.zeros((3, 2)))) <= table_bytes(3, 2)
      True
    """
    return len(_MAGIC) + 2 + _MAX_HEADER + _FLOAT.itemsize * rows * columns


def unpack_table(data: bytes, columns: int, rows: int | None = None) -> Float32:
    """The table `[rows, columns]` in the bytes of an .npy file, whose reading runs no code.

    A fresh array of float32, every entry finite; `rows` None accepts any number of them.

    Examples:
      >>> from sme_registry.sealed import pack_table, unpack_table
      >>> unpack_table(pack_table(np.zeros((3, 2))), columns=2, rows=3).shape
      (3, 2)
    """
    start = len(_MAGIC) + 2
    size = int.from_bytes(data[len(_MAGIC) : start], "little")
    header = _HEADER.fullmatch(data, start, start + size) if size <= _MAX_HEADER else None
    if not data.startswith(_MAGIC) or header is None:
        raise WireError(
            "array: must be an .npy file of version 1.0 with an array of type '<f4', in C order "
            "and with two axes. Write it with numpy.save(file, array.astype('<f4'))."
        )
    shape = int(header[1]), int(header[2])
    wanted = shape[0] if rows is None else rows, columns
    if shape != wanted:
        raise WireError(f"array of shape {shape}: must be of shape {wanted}.")
    _check_size("array", data, start + size + _FLOAT.itemsize * shape[0] * shape[1])
    entries = np.frombuffer(data, _FLOAT, offset=start + size)
    _refuse_not_finite(entries)
    return _native(entries.reshape(shape))


def _packed(array: npt.NDArray[np.floating]) -> bytes:
    return array.astype(_FLOAT, copy=False).tobytes()


def _packed_number(number: int) -> bytes:
    return number.to_bytes(_NUMBER_BYTES, "little")


def _number_in(data: bytes) -> int:
    return int.from_bytes(data[:_NUMBER_BYTES], "little")


def _native(array: npt.NDArray[np.floating]) -> Float32:
    """A copy that can be written to, in this machine's byte order."""
    return np.array(array, np.float32)


def _check_size(what: str, data: bytes, expected: int) -> None:
    if len(data) != expected:
        raise WireError(f"{what}: has {len(data):,} bytes: must have {expected:,}.")


def _refuse_not_finite(numbers: Float32) -> None:
    if not np.isfinite(numbers).all():
        raise ActionError("array: has NaN or infinite entries. Give finite numbers.")

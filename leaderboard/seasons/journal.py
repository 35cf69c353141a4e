"""`Journal` and `Play`: what was played of an instance, on disk and in memory.

The journal has the actions, on disk before their answer leaves.

    header   magic, lanes L, action channels A, CRC-32 of these
    record   number of the request 1, 2, …; L · A actions; CRC-32 of these

Integers and float32 are little-endian, and every record has the same size. A record with the number
0 and zeros ends the stepping. What a loss of power, or a kill in the middle of a write, leaves of
the last record is ignored, and cut off by the next one. All else follows from the start and the
journal, bit for bit: a killed server continues where it was. A snapshot has what the next steps
need, without the regret, which is that of a replay.

    normalised online regret = Σ regret / Σ regret of the constant ½ in the same states

over the budget, and over each part of it. Steps that were not taken, or that the entrant has not
signed, count like the constant's: what took a share f of its steps, with the ratio q, has
f q + 1 − f. Steps at the end of the budget into which no request of all lanes fits cannot be taken,
and do not count.
"""

from __future__ import annotations

import contextlib
import io as streams
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from leaderboard.errors import BoardError, TamperedError
from leaderboard.seasons.season import (
    SealedResult,
    Season,
    Stepping,
    rows_of,
)
from sme_registry import io
from sme_registry.envs import SMEVectorEnv
from sme_registry.io import open_regular
from sme_registry.seasons.transcript import EVERY, Chain, next_head
from sme_registry.seasons.wire import MAX_LANES, StepFormat, StepsAnswer, table_bytes
from sme_registry.spec import SMESpec

_MAGIC = b"sme-journal/1\n\0\0"
_HEADER, _NUMBER = struct.Struct("<16sII"), struct.Struct("<Q")
_CRC_SIZE = 4
_START = _HEADER.size + _CRC_SIZE
_END = 0


class Journal:
    """The requests on one instance so far; no file stays open between two steps."""

    def __init__(self, path: Path, lanes: int, action_dim: int) -> None:
        self.path, self.lanes, self.action_dim = path, lanes, action_dim
        self.requests, self.ended = 0, False
        self._actions_size = 4 * lanes * action_dim
        self._size = _START
        self._torn = self._unsynced = False

    @classmethod
    def create(cls, path: Path, lanes: int, action_dim: int) -> Journal:
        header = _HEADER.pack(_MAGIC, lanes, action_dim)
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
            io.sync_folder(path.parent.parent)
            io.sync_folder(path.parent.parent.parent)
        with io.atomic_file(path, new=True) as stream:
            stream.write(header + _crc(header))
        io.sync_folder(path.parent)
        return cls(path, lanes, action_dim)

    @classmethod
    def open(cls, path: Path, action_dim: int, known: int | None = 0) -> Journal:
        """The journal of a file, up to its last whole record; the first `known` are not read.

        With None, as many as a file that is final has.
        """
        with open_regular(path) as stream:
            header = stream.read(_START)
            if len(header) < _START or header[_HEADER.size :] != _crc(header[: _HEADER.size]):
                raise TamperedError(path.name, "is not a journal")
            magic, lanes, channels = _HEADER.unpack_from(header)
            if magic != _MAGIC:
                raise TamperedError(path.name, "is not a journal of this version")
            if not 1 <= lanes <= MAX_LANES or channels != action_dim:
                raise TamperedError(path.name, "is of other lanes or action channels")
            journal = cls(path, lanes, action_dim)
            journal._count(stream, known)
        return journal

    @property
    def steps(self) -> int:
        """Steps of the budget that are used, over all lanes."""
        return self.requests * self.lanes

    @property
    def _record_size(self) -> int:
        return _NUMBER.size + self._actions_size + _CRC_SIZE

    def append(self, actions: bytes) -> None:
        """Add the next request, `[L, A]` float32; then it survives a kill of this process."""
        self._append(self.requests + 1, actions)
        self.requests += 1

    def end(self) -> None:
        if not self.ended:
            self._append(_END, bytes(self._actions_size))
            self.ended = True
        self.sync()

    def sync(self) -> None:
        """Make what was added survive a loss of power."""
        if self._unsynced:
            self._unsynced = False  # before, since steps may follow meanwhile
            try:
                with self._appending() as handle:
                    os.fdatasync(handle)
            except OSError:
                self._unsynced = True
                raise

    def bodies(self, first: int = 0, last: int | None = None) -> Iterator[bytes]:
        """The bodies of the requests after the first so many, in order."""
        with open_regular(self.path) as stream:
            stream.seek(_START + first * self._record_size)
            for _ in range(first, self.requests if last is None else last):
                number, actions = self._record(stream)
                yield _NUMBER.pack(number) + actions

    def _append(self, number: int, actions: bytes) -> None:
        if self.ended or len(actions) != self._actions_size:
            raise BoardError(f"{self.path.name}: accepts no such record.")
        body = _NUMBER.pack(number) + actions
        record = body + _crc(body)
        with self._appending() as handle:
            self._cut(handle)
            self._torn = True
            try:
                _write(handle, record)
            except OSError:
                with contextlib.suppress(OSError):  # the next one tries again
                    self._cut(handle)
                raise
        self._torn = False
        self._size += len(record)
        self._unsynced = True

    @contextlib.contextmanager
    def _appending(self) -> Iterator[int]:
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND)
        try:
            yield handle
        finally:
            os.close(handle)

    def _cut(self, handle: int) -> None:
        if self._torn:
            os.ftruncate(handle, self._size)
            self._torn = False

    def _count(self, stream: BinaryIO, known: int | None) -> None:
        """Count the records, up to the last whole one."""
        if known is None:  # but for the last, which may be the end
            size = os.fstat(stream.fileno()).st_size - _START
            known = max(0, size // self._record_size - 1)
        if known:
            stream.seek(_START + (known - 1) * self._record_size)
            if self._record(stream)[0] == known:
                self.requests, self._size = known, _START + known * self._record_size
            else:  # a loss of power took it
                stream.seek(_START)
        while not self.ended:
            number, _ = self._record(stream)
            if number not in (self.requests + 1, _END):
                break
            self.ended = number == _END
            self.requests += not self.ended
            self._size += self._record_size
        self._torn = os.fstat(stream.fileno()).st_size > self._size

    def _record(self, stream: BinaryIO) -> tuple[int, bytes]:
        """Number and actions of the next record; −1 if it is not whole."""
        record = stream.read(self._record_size)
        body = record[:-_CRC_SIZE]
        if len(record) < self._record_size or record[-_CRC_SIZE:] != _crc(body):
            return -1, b""
        return _NUMBER.unpack_from(body)[0], body[_NUMBER.size :]


def _write(handle: int, data: bytes) -> None:
    """Write all, or raise OSError; a disk that fills up in the middle raises at the second call."""
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]


def _crc(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_CRC_SIZE, "little")


MOST_PARTS = 100
Arrays = Mapping[str, npt.NDArray[Any]]


class Play:
    """An instance that has begun, with a budget of steps over all its lanes.

    The episodes of the first lane have the seed, those of lane i seed + i.
    """

    def __init__(self, spec: SMESpec, seed: int, chain: Chain, lanes: int, budget: int) -> None:
        self._seed, self._env = seed, SMEVectorEnv(spec, lanes, autoreset_mode="SameStep")
        self._format = StepFormat(lanes, spec.state_dim, spec.action_dim)
        self._observation = self._env.reset(seed=seed)[0]
        self._possible = budget // lanes
        # Regret, that of the constant ½, and requests, of each part of the budget.
        self._sums = np.zeros((min(MOST_PARTS, self._possible), 3))
        self.requests, self.last = 0, (b"", b"")
        self.head = chain.first_head(lanes, self.started)

    @property
    def started(self) -> bytes:
        return self._format.pack(self.requests, self._observation)

    def unpack(self, body: bytes) -> int:
        return self._format.unpack_request(body)[0]

    def take(self, body: bytes) -> bytes:
        """Take the steps of the next request; its answer."""
        _, actions = self._format.unpack_request(body)
        observation, reward, terminated, truncated, info = self._env.step(actions)
        ended = terminated | truncated
        last = np.zeros_like(observation)
        if "final_obs" in info:
            last[ended] = np.stack(info["final_obs"][ended])
            for name in ("regret", "optimal_action"):  # the rows are already of the next episode
                info[name][ended] = info["final_info"][name][ended]
        task = self._env.task
        half = 1.0 - task.reward_of(task.similarity_of(np.array(0.5), info["optimal_action"]))
        part = self.requests * len(self._sums) // self._possible
        self._sums[part] += float(info["regret"].sum()), float(half.sum()), 1.0
        steps = StepsAnswer(observation, reward.astype(np.float32), terminated, truncated, last)
        answer = self._format.pack_steps(steps)
        self.head = next_head(self.head, body, answer)
        self._observation, self.last = observation, (body, answer)
        self.requests += 1
        return answer

    @property
    def stepping(self) -> Stepping:
        """The regret of all steps; not of those before a snapshot."""
        parts = len(self._sums)
        firsts = -(np.arange(parts + 1) * -self._possible // parts)  # request of each part
        return Stepping(
            steps=self.requests * self._format.lanes,
            normalised_online_regret=_ratio(self._sums.sum(axis=0), self._possible),
            learning_curve=tuple(map(_ratio, self._sums, np.diff(firsts))),
        )

    def snapshot(self) -> bytes:
        stream = streams.BytesIO()
        texts = {"head": self.head, "body": self.last[0], "answer": self.last[1]}
        arrays: dict[str, Any] = {
            "requests": np.array(self.requests),
            "observation": self._observation,
            **{name: np.frombuffer(text, np.uint8) for name, text in texts.items()},
            **self._env.snapshot(),
        }
        np.savez(stream, **arrays)
        return stream.getvalue()

    def restore(self, snapshot: Arrays) -> None:
        """Go on from the arrays of a snapshot of the same start."""
        self._env.restore(snapshot, self._seed)
        self.requests = int(snapshot["requests"])
        self._observation = snapshot["observation"]
        self.head = snapshot["head"].tobytes()
        self.last = snapshot["body"].tobytes(), snapshot["answer"].tobytes()


def no_steps(budget: int) -> Stepping:
    """The regret of an instance that has not begun."""
    curve = (1.0,) * min(MOST_PARTS, budget)
    return Stepping(steps=0, normalised_online_regret=1.0, learning_curve=curve)


def _ratio(sums: npt.NDArray[np.float64], possible: int) -> float:
    """Regret relative to the constant's, from `sums` of both and of the requests taken."""
    regret, half, taken = map(float, sums)
    share = taken / float(possible)
    # The constant has no regret only where π* is ½ throughout, and so has none either.
    return share * (regret / half if half > 0.0 else 0.0) + 1.0 - share


_RECORD_BYTES = _NUMBER.size + _CRC_SIZE  # of a record, besides its actions
_HEAD_BYTES = 4096  # of the head of a journal, with the file of the signature
_SNAPSHOT_BYTES, _NUMBERS_OF_A_LANE = 2**14, 40  # of a snapshot; bytes of a lane, for each channel


def played_bytes(season: Season, result: SealedResult | None = None) -> int:
    """The most bytes that the journals, challenges, answers and snapshots of a ticket take.

    A journal is longest where a single lane is stepped: then each step has a record of its own.
    """
    total = 0
    rows = rows_of(season.protocol)
    for number, (member, _) in enumerate(season.hidden):
        S, A = member.setting.state_dim, member.setting.action_dim
        steps, answered = member.budget or 0, True
        if result is not None:  # what was not signed may be in the journal, too
            steps = min(steps, result.stepping[number].steps + EVERY * MAX_LANES)
            answered = result.runs[number].artefact is not None
        total += steps * (_RECORD_BYTES + 4 * A) + table_bytes(rows, S + 2) + _HEAD_BYTES
        total += 4 * MAX_LANES * A  # the record that ends a journal
        total += table_bytes(rows, A) * answered
        if result is None:
            total += _SNAPSHOT_BYTES + MAX_LANES * _NUMBERS_OF_A_LANE * (S + A + 4)
    return total

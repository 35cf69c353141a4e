"""`Journal`: the actions that a ticket took on one instance, on disk before their answer leaves.

    header   magic, lanes L, action channels A, CRC-32 of these
    record   number of the request 1, 2, …; L · A actions; CRC-32 of these

Integers and float32 are little-endian, and every record has the same size. The environment is
deterministic, so its state and the budget used follow from the journal: a killed server continues
where it was. A record with the number 0 and zeros ends the stepping. What a loss of power, or a
kill in the middle of a write, leaves of the last record is ignored, and cut off by the next one.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from leaderboard.errors import BoardError, TamperedError
from sme_registry import io
from sme_registry.io import open_regular

_MAGIC = b"sme-journal/1\n\0\0"
_HEADER, _NUMBER = struct.Struct("<16sII"), struct.Struct("<Q")
_CRC_SIZE = 4
_START = _HEADER.size + _CRC_SIZE
_END = 0


class Journal:
    """One journal, of `requests` so far; no more can follow where it has `ended`.

    No file stays open between two steps.
    """

    def __init__(self, path: Path, lanes: int, action_dim: int) -> None:
        self.path, self.lanes, self.action_dim = path, lanes, action_dim
        self.requests, self.ended = 0, False
        self._actions_size = 4 * lanes * action_dim
        self._size = _START
        self._torn = self._unsynced = False

    @classmethod
    def create(cls, path: Path, lanes: int, action_dim: int) -> Journal:
        """A new, empty journal."""
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
    def open(cls, path: Path, known: int = 0) -> Journal:
        """The journal of a file, up to its last whole record; writes nothing.

        The first `known` records, which were whole before, are not read again.
        """
        with open_regular(path) as stream:
            header = stream.read(_START)
            if len(header) < _START or header[_HEADER.size :] != _crc(header[: _HEADER.size]):
                raise TamperedError(path.name, "is not a journal")
            magic, lanes, action_dim = _HEADER.unpack_from(header)
            if magic != _MAGIC:
                raise TamperedError(path.name, "is not a journal of this version")
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
        """End the stepping, durably; ending it twice does nothing."""
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
        """Remove what a failed write has left."""
        if self._torn:
            os.ftruncate(handle, self._size)
            self._torn = False

    def _count(self, stream: BinaryIO, known: int) -> None:
        """Count the records, up to the last whole one."""
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

"""The log: one signed file per event, each with the digest of the one before. It is authoritative.

entry_n.previous  = digest(entry_{n−1})          64 zeros for the first
entry_n.signature = by the board's key, over the entry without it

The number orders the entries. The time of an entry is when it was received, by the machine's clock
and never earlier than the entry before it; what is open, closed, over or counted follows from it.
An entry of the event "clock" corrects the times after its own, which a wrong clock has made.
"""

from __future__ import annotations

import datetime
import functools
import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, field_validator

from leaderboard.documents.board import Folder
from leaderboard.documents.signed import PlainDocument, Signature, SigningKey, plain_json, verifies
from leaderboard.documents.submission import UtcTime, now
from leaderboard.errors import ClockError, TamperedError
from leaderboard.store.blobs import read_document, write_document
from sme_registry.io import sha256_of
from sme_registry.spec.document import Digest, Integer, SchemaVersion

NOTHING = "sha256:" + "0" * 64
MOST_BEHIND, LONGEST_JUMP = 60.0, 300.0
"""Seconds of the machine's clock: behind the log's last entry, and against the uptime."""


class Head(NamedTuple):
    """The last entry of a log or an index, which the next entry must follow."""

    sequence: int  # its number; −1 if there is none
    digest: str
    time: str


EMPTY = Head(-1, NOTHING, "")


class LogEntry(PlainDocument):
    """One event.

    Attributes:
      sequence: its number, 0 for the first.
      previous: digest of the entry before; 64 zeros for the first.
      time: when it was received.
      event: "opened" (once, the first), "received", "result" or "withdrawn"; "clock", which dates
        all entries with a later time as its own; or of another track.
      subject: the entrant's id; for "opened" the board document's digest, for "clock" that of the
        first entry that it dates, or of another track its digest.
      document: SHA-256 of the document written: the signed submission, a result, the signed
        withdrawal or board.json, or of another track; for "clock" the entry that is its subject.
      signature: by the board's key.
    """

    schema_version: SchemaVersion = 1
    sequence: Annotated[Integer, Field(ge=0)]
    previous: Digest
    time: UtcTime
    event: Annotated[str, Field(pattern=r"^[a-z]{1,16}$")]
    subject: Digest
    document: Digest
    signature: Signature

    @field_validator("time")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        datetime.datetime.fromisoformat(value)  # not 30 February
        return value

    @property
    def signed_digest(self) -> str:
        """Digest of the entry without its signature."""
        fields = self.to_dict()
        del fields["signature"]
        return sha256_of(plain_json(fields))

    @property
    def file(self) -> str:
        """Its file in the board's folder."""
        return f"log/{self.sequence:08d}.json"

    @property
    def head(self) -> Head:
        """This entry as the one that the next entry must follow."""
        return Head(self.sequence, self.digest, self.time)

    def contradiction(self, message: str) -> TamperedError:
        """The error to raise where this entry contradicts those before it."""
        return TamperedError(self.file, f"event={self.event}: {message}")

    def check_subject(self, id: str) -> None:
        """Raise `TamperedError` if its document is of another subject."""
        if id != self.subject:
            raise self.contradiction("names a document of another subject")


class Log:
    """The log of one board, whose entries `key` verifies."""

    def __init__(self, folder: Folder, key: str) -> None:
        self.folder = folder
        self.key = key

    def has(self, sequence: int) -> bool:
        """Whether the entry of this number exists."""
        return self.folder.log_entry(sequence).exists()

    def read(self, sequence: int, after: Head | None = None) -> LogEntry:
        """Read an entry and verify its signature; and that it follows `after`, if that is given."""
        entry = read_document(self.folder, self.folder.log_entry(sequence), LogEntry)
        if entry.sequence != sequence:
            raise TamperedError(f"log/{sequence:08d}.json", f"holds entry {entry.sequence}")
        self.check(entry, after)
        return entry

    def check(self, entry: LogEntry, after: Head | None) -> None:
        """Raise `TamperedError` unless the board has signed an entry, and it follows `after`."""
        if not verifies(self.key, entry.signature, "log", entry.signed_digest):
            raise TamperedError(entry.file, "its signature does not match the board's key")
        if after is None:
            return
        if (entry.sequence, entry.previous) != (after.sequence + 1, after.digest):
            raise TamperedError(entry.file, "does not follow the entry before it: one was replaced")
        if (entry.event == "opened") != (entry.sequence == 0):
            raise TamperedError(entry.file, "only the first entry may open a board")

    def entry(
        self, key: SigningKey, after: Head, event: str, subject: str, document: str, time: str
    ) -> LogEntry:
        """The next entry, which is not written yet."""
        fields: dict[str, Any] = {
            "schema_version": 1,
            "sequence": after.sequence + 1,
            "previous": after.digest,
            "time": time,
            "event": event,
            "subject": subject,
            "document": document,
        }
        signature = key.sign("log", sha256_of(plain_json(fields)))
        return LogEntry.from_dict({**fields, "signature": signature})

    def write(self, entry: LogEntry) -> None:
        """Write an entry."""
        write_document(self.folder.log_entry(entry.sequence), entry, new=True)

    def first_after(self, head: Head, time: str) -> LogEntry | None:
        """The first of the last entries, up to `head`, with a later time; None if there is none."""
        first = None
        for sequence in range(head.sequence, 0, -1):
            entry = self.read(sequence)
            if entry.time <= time:
                break
            first = entry
        return first


class Clock:
    """When a board receives something: by the machine's clock, not before the log's last entry.

    Attributes:
      last: time of the log's last entry; empty if there is none.
      offset: of the machine's clock against its uptime when a server first noted it, in seconds;
        None if no server has, since the machine was started.
    """

    def __init__(self) -> None:
        self.last = ""
        self.offset: float | None = None

    @property
    def time(self) -> str:
        """The board's time, for readers."""
        return max(now(), self.last)

    def received(self) -> str:
        """The board's time, for what is written or expires."""
        if _seconds(self.last) - time.time() > MOST_BEHIND:
            raise ClockError(
                f"clock={now()}: is behind the log's last entry, of {self.last}. Nothing was "
                "changed. Set the machine's clock; if it is right, that entry is dated wrongly: "
                "correct it with `sme-leaderboard admin clock --correct`."
            )
        if self.offset is not None and abs(clock_offset()[1] - self.offset) > LONGEST_JUMP:
            raise ClockError(
                f"clock={now()}: has jumped since the board was first served. Nothing was changed. "
                "Set the machine's clock; if it is right, go on with `sme-leaderboard admin clock`."
            )
        return self.time


@functools.lru_cache(8)  # asked for at every step of a ticket
def _seconds(text: str) -> float:
    """Since 1970."""
    return datetime.datetime.fromisoformat(text).timestamp() if text else 0.0


def uptime() -> tuple[str, float]:
    """The machine's boot id, and seconds since boot, also in suspend: no clock changes them."""
    return _boot(), time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@functools.cache
def _boot() -> str:
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text().strip() if path.exists() else ""


def clock_offset() -> tuple[str, float]:
    """The boot id, and what the machine's clock is ahead of its uptime, in seconds."""
    boot, seconds = uptime()
    return boot, time.time() - seconds

"""The log: one signed file per event, each with the digest of the one before. It is authoritative.

entry_n.previous  = digest(entry_{n−1})          64 zeros for the first
entry_n.signature = by the board's key, over the entry without it

The number orders the entries. The time is the clock's own, which may have been wrong: it may go
back from one entry to the next, but not to before the first.
"""

from __future__ import annotations

import datetime
import functools
import hashlib
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, field_validator

from leaderboard.documents.board import Folder
from leaderboard.documents.keys import PlainDocument, Signature, SigningKey, plain_json, verifies
from leaderboard.documents.submission import UtcTime, now
from leaderboard.errors import BoardError, TamperedError
from leaderboard.store.files import MAX_LOG_ENTRY_BYTES, read_document, write_document
from sme_registry.spec.document import Digest, Integer, SchemaVersion

SealedEvent = Literal["season", "entry", "ticket", "ended", "ranked", "revealed"]
"""Of a season: announced, an entry, a ticket started, their results, the master published."""

Event = Literal["opened", "received", "result", "withdrawn"] | SealedEvent
NOTHING = "sha256:" + "0" * 64
LONGEST_PAUSE = datetime.timedelta(days=3653)
"""Between two entries: ten years; a clock that shows more is wrong."""


class Head(NamedTuple):
    """The last entry of a log or an index, which the next entry must follow.

    Attributes:
      sequence: its number; −1 if there is none.
    """

    sequence: int
    digest: str
    time: str


EMPTY = Head(-1, NOTHING, "")


class LogEntry(PlainDocument):
    """One event.

    Attributes:
      sequence: its number, 0 for the first.
      previous: digest of the entry before; 64 zeros for the first.
      time: of the event by the board's clock, which may have been set back since the entry before.
      event: "opened" (once, the first), "received", "result" or "withdrawn"; or of a season, see
        `SealedEvent`.
      subject: the submission's id, or that of a sealed entry or ticket; for "opened" the board
        document's digest, for "season" and "revealed" the season's.
      document: SHA-256 of the file written: the signed submission, entry or request for a ticket,
        a result, the signed withdrawal, board.json, season.json or reveal.json.
      signature: by the board's key.
    """

    schema_version: SchemaVersion = 1
    sequence: Annotated[Integer, Field(ge=0)]
    previous: Digest
    time: UtcTime
    event: Event
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
        return _digest(fields)

    @property
    def head(self) -> Head:
        """This entry as the one that the next entry must follow."""
        return Head(self.sequence, self.digest, self.time)

    def contradiction(self, message: str) -> TamperedError:
        """The error to raise where this entry contradicts those before it."""
        return TamperedError(f"log/{self.sequence:08d}.json", f"event={self.event}: {message}")

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

    def read(self, sequence: int) -> LogEntry:
        """Read an entry and verify its signature, but not the entries before it.

        Raises:
          TamperedError: it is missing, altered, or not signed by the board.
        """
        path = self.folder.log_entry(sequence)
        entry = read_document(self.folder, path, LogEntry, limit=MAX_LOG_ENTRY_BYTES)
        where = path.relative_to(self.folder.path).as_posix()
        if entry.sequence != sequence:
            raise TamperedError(where, f"holds entry {entry.sequence}")
        if not verifies(self.key, entry.signature, "log", entry.signed_digest):
            raise TamperedError(where, "its signature does not match the board's key")
        return entry

    def read_after(self, head: Head) -> LogEntry:
        """Read the entry after `head` and verify that it follows it.

        Raises:
          TamperedError: it is missing, altered, not signed by the board, or does not follow `head`.
        """
        entry = self.read(head.sequence + 1)
        where = f"log/{entry.sequence:08d}.json"
        if entry.previous != head.digest:
            raise TamperedError(where, "does not follow the entry before it: one was replaced")
        if (entry.event == "opened") != (entry.sequence == 0):
            raise TamperedError(where, "only the first entry may open a board")
        return entry

    def append(
        self,
        key: SigningKey,
        head: Head,
        event: Event,
        subject: str,
        document: str,
        time: str | None = None,
    ) -> LogEntry:
        """Write the entry after `head`, of a given time or of the clock's.

        Raises:
          BoardError: it cannot be written, another process has used its number, or the clock is
            plainly wrong: before the first entry, or ten years after the last.
        """
        clock = now()
        if head.sequence >= 0:
            self._refuse_wrong_clock(clock, head)
        fields = {
            "schema_version": 1,
            "sequence": head.sequence + 1,
            "previous": head.digest,
            "time": clock if time is None else time,
            "event": event,
            "subject": subject,
            "document": document,
        }
        entry = LogEntry.from_dict({**fields, "signature": key.sign("log", _digest(fields))})
        write_document(self.folder.log_entry(entry.sequence), entry, new=True)
        return entry

    @functools.cached_property
    def _opened(self) -> str:
        return self.read(0).time

    def _refuse_wrong_clock(self, time: str, head: Head) -> None:
        moment, last = (datetime.datetime.fromisoformat(each) for each in (time, head.time))
        if time < self._opened:
            fault = f"before the board was opened, at {self._opened}"
        elif moment - last > LONGEST_PAUSE:
            fault = f"more than ten years after the log's last entry, of {head.time}"
        else:
            return
        raise BoardError(
            f"clock={time}: is {fault}. Nothing was changed. Set the machine's clock, then try "
            'again; docs/guides/leaderboard.md, "A wrong clock", has the rest.'
        )


def _digest(fields: dict[str, Any]) -> str:
    return "sha256:" + hashlib.sha256(plain_json(fields)).hexdigest()

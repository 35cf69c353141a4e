"""The log: one signed file per event, each holding the digest of the one before. It is the truth.

entry_n.previous  = digest(entry_{n−1})          64 zeros for the first
entry_n.signature = by the board's key, of the entry without it
"""

from __future__ import annotations

import hashlib
from typing import Annotated, Literal, NamedTuple

import rfc8785
from pydantic import Field

from leaderboard.documents.board import Folder
from leaderboard.documents.keys import Signature, SigningKey, verifies
from leaderboard.documents.submission import UtcTime, now
from leaderboard.errors import TamperedError
from leaderboard.store.documents import read_document, write_document
from sme_registry.spec import Digest, Document, Integer, SchemaVersion

Event = Literal["opened", "received", "result", "withdrawn"]
NOTHING = "sha256:" + "0" * 64


class Head(NamedTuple):
    """The last entry of a log, or of an index: what the next one must follow.

    Attributes:
      sequence: its number; −1 where there is none.
    """

    sequence: int
    digest: str
    time: str


EMPTY = Head(-1, NOTHING, "")


class LogEntry(Document):
    """One event.

    Attributes:
      sequence: its number, 0 for the first.
      previous: digest of the entry before; 64 zeros where there is none.
      time: when, by the board's clock, but never before the entry before.
      event: "opened" (once, the first), "received", "result" or "withdrawn".
      subject: the submission's id; of "opened" the board document's digest.
      document: SHA-256 of the file that was written: the signed submission, the result, the
        signed withdrawal, or board.json.
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

    @property
    def signed_digest(self) -> str:
        """Digest of everything but the signature."""
        return _digest_without_signature(self)

    @property
    def head(self) -> Head:
        """This entry as the one that the next must follow."""
        return Head(self.sequence, self.digest, self.time)


class Log:
    """The log of one board.

    Args:
      folder: the board's.
      key: the board's public key.
    """

    def __init__(self, folder: Folder, key: str) -> None:
        self.folder = folder
        self.key = key

    def has(self, sequence: int) -> bool:
        """Whether there is an entry of this number."""
        return self.folder.log_entry(sequence).exists()

    def read(self, sequence: int) -> LogEntry:
        """An entry, its signature verified, but not what comes before it.

        Raises:
          TamperedError: it is missing, altered, or not signed by the board.
        """
        path = self.folder.log_entry(sequence)
        entry = read_document(self.folder, path, LogEntry)
        where = path.relative_to(self.folder.path).as_posix()
        if entry.sequence != sequence:
            raise TamperedError(where, f"holds the entry of number {entry.sequence}")
        if not verifies(self.key, entry.signature, "log", entry.signed_digest):
            raise TamperedError(where, "its signature is not by this board's key")
        return entry

    def read_after(self, head: Head) -> LogEntry:
        """The entry after `head`, verified to follow it.

        Raises:
          TamperedError: it is missing, altered, not signed by the board, or follows another.
        """
        entry = self.read(head.sequence + 1)
        where = f"log/{entry.sequence:08d}.json"
        if entry.previous != head.digest:
            raise TamperedError(where, "does not follow the entry before it: one was exchanged")
        if entry.time < head.time:
            raise TamperedError(where, f"time={entry.time}: is before the entry before it")
        if (entry.event == "opened") != (entry.sequence == 0):
            raise TamperedError(where, "a board is opened once, by the first entry")
        return entry

    def append(
        self, key: SigningKey, head: Head, event: Event, subject: str, document: str
    ) -> LogEntry:
        """Write the entry after `head`.

        A clock that was set back stands still here until it has caught up.

        Raises:
          BoardError: it cannot be written, or another process has taken its number.
        """
        unsigned = LogEntry.model_construct(
            schema_version=1,
            sequence=head.sequence + 1,
            previous=head.digest,
            time=max(now(), head.time),
            event=event,
            subject=subject,
            document=document,
            signature="",
        )
        signature = key.sign("log", _digest_without_signature(unsigned))
        entry = LogEntry.from_dict({**unsigned.to_dict(), "signature": signature})
        write_document(self.folder.log_entry(entry.sequence), entry, new=True)
        return entry


def _digest_without_signature(entry: LogEntry) -> str:
    plain = entry.to_dict()
    del plain["signature"]
    return "sha256:" + hashlib.sha256(rfc8785.dumps(plain)).hexdigest()

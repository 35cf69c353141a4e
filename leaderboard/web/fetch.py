"""`fetch`: copy the public part of a served board, so that `verify` can check it elsewhere.

    board.json, then each entry of the log after the document that it names, then policy files and
    answers that are public, then the files of the seasons

The server is not trusted. Each entry must follow the one before and be signed by the board's key,
and each document or policy file must have the digest that the log names, before it is written. All
that is downloaded counts towards a limit. A fetch that was interrupted, or killed, goes on where it
ended, and one of a board that has grown gets what is new.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from leaderboard.documents.board import BoardDocument, Folder, hex_of
from leaderboard.errors import BoardError
from leaderboard.store import EMPTY, Head, Log, LogEntry, Objects, Store, digest_of
from leaderboard.store.blobs import unwritable, write_document, write_file
from leaderboard.web.client import ServedBoard
from sme_registry.errors import SpecError
from sme_registry.io import sha256_of

MOST_BYTES = 2**34
_MOST_LOG = 2**22  # of an answer: a hundred entries of at most 4,096 bytes, as JSON
_MOST_OBJECT = 2**24
_CHUNK, _INODE = 2**23, 2**12  # of a file of a season; what an empty one counts as
_PART = "[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}"
_NAME = re.compile(f"({_PART}/){{0,9}}{_PART}")

Progress = Callable[[str], None]
"""Called with what is fetched next."""


class Files(NamedTuple):
    """Files that a server lists, and serves, below an address.

    Attributes:
      address: of the list.
      folder: that the files belong into.
      check: raises an error unless those that are there are those that the log commits to.
    """

    address: str
    folder: Path
    check: Callable[[], None]


Part = Callable[[Store], Iterator[Files]]
"""The files of a part of a board whose log is there."""


@dataclass(frozen=True)
class Fetched:
    """What a folder has after a fetch.

    Attributes:
      entries: number of log entries.
      files: number of files that were downloaded now.
      bytes: of these.
    """

    entries: int
    files: int
    bytes: int


def fetch(
    url: str,
    folder: str | os.PathLike[str],
    *,
    without_data: bool = False,
    most: int = MOST_BYTES,
    insecure: bool = False,
    board: type[Store] = Store,
    parts: Sequence[Part] = (),
    progress: Progress | None = None,
) -> Fetched:
    """Copy the public part of a served board into a new folder, or into an earlier copy of it.

    Args:
      url: of the board.
      folder: a new one, or one that `fetch` has filled from the same board.
      without_data: leave out the data sets of seasons.
      most: bytes to download, after which it stops.
      insecure: allow plain http to other machines, in a network that you trust.
      parts: what else to copy, such as the files of its seasons.
      progress: called with what is fetched next.

    Raises:
      TamperedError: its log is not signed by the board, or has a gap.
      BoardError: the server cannot be reached, what it sends does not have the digest or signature
        that it must have or exceeds `most`, or the folder holds something else.
    """
    with ServedBoard(url, insecure=insecure) as served:
        copy = _Copy(served, Path(folder), most, progress or (lambda _: None))
        copy.open()
        entries = copy.fetch_log()
        with board.open(copy.folder.path, read_only=True) as store:
            for digest in store.named_objects():
                if store.is_public(digest):
                    copy.fetch_object(digest, optional=True)
            for part in parts:
                for files in part(store):
                    copy.fetch_files(files, without_data)
    return Fetched(entries, copy.files, copy.bytes)


class _Copy:
    """A copy that grows."""

    def __init__(self, served: ServedBoard, folder: Path, most: int, progress: Progress) -> None:
        self.folder = Folder(folder)
        self.files = self.bytes = 0
        self._served, self._progress = served, progress
        self._most = self._left = most
        self._objects = Objects(self.folder)

    def open(self) -> None:
        """Get the board's definition, which must be that of the copy if there is one."""
        document = self._served.document()
        if self.folder.board.exists():
            if self.folder.read() != document or self.folder.key.exists():
                raise BoardError(
                    f"{self.folder.path}: is no copy of this board. Give another folder."
                )
        elif self.folder.path.is_dir() and any(self.folder.path.iterdir()):
            raise BoardError(f"{self.folder.path}: is not empty. Give a new folder.")
        else:
            write_document(self.folder.board, document)
            self.folder.log.mkdir(exist_ok=True)
        self._document: BoardDocument = document

    def fetch_log(self) -> int:
        """Get the entries that are not there yet, each after its document; returns their number."""
        log, head = Log(self.folder, self._document.key), EMPTY
        while log.has(head.sequence + 1):
            head = log.read_after(head).head
        while True:
            entries = self._entries(head.sequence + 1)
            for entry in entries:
                head = self._append(log, head, entry)
            if not entries:
                return head.sequence + 1

    def _entries(self, start: int) -> list[LogEntry]:
        answer = self._json(f"/api/log?start={start}", f"log from {start}")
        try:
            return [LogEntry.from_dict(plain, "log entry") for plain in answer["entries"]]
        except (SpecError, LookupError, TypeError) as error:
            raise self._refusal(f"its log from entry {start} is invalid: {error}") from None

    def _append(self, log: Log, head: Head, entry: LogEntry) -> Head:
        log.check(entry, head)
        opens = entry.event == "opened"
        if opens and entry.document != digest_of(self._document):
            raise self._refusal("its log opens another board")
        if not opens and entry.event != "clock":
            self.fetch_object(entry.document)
        write_document(self.folder.log_entry(entry.sequence), entry)
        return entry.head

    def fetch_object(self, digest: str, *, optional: bool = False) -> None:
        """Get a document or policy file; an optional one may be missing."""
        if self._objects.has(digest):
            return
        try:
            data = self._read(f"/api/objects/{hex_of(digest)}", _MOST_OBJECT, digest)
        except BoardError:
            if optional:
                return
            raise
        if sha256_of(data) != digest:
            raise self._refusal(f"what it sends as {digest} has another digest")
        write_file(self.folder.object(digest), data)
        self.files += 1

    def fetch_files(self, files: Files, without_data: bool) -> None:
        """Get the files of a list."""
        start: int | None = 0
        while start is not None:
            answer = self._json(f"{files.address}?start={start}", files.address)
            try:
                listed = [(str(each["path"]), int(each["size"])) for each in answer["files"]]
                following = answer["next"]
            except (LookupError, TypeError, ValueError) as error:
                raise self._refusal(f"its list of files is invalid: {error}") from None
            for path, size in listed:
                if not _NAME.fullmatch(path):
                    raise self._refusal(f"it lists a file of the unsafe name {path!r:.80}")
                if not (without_data and path.startswith("published/")):
                    self._fetch_file(files, path, size)
            start = following if isinstance(following, int) and following > start else None
        files.check()

    def _fetch_file(self, files: Files, name: str, size: int) -> None:
        path = files.folder / name
        if path.exists():
            return
        self._spend(_INODE)
        growing = path.with_name(f".{path.name}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(growing, "ab") as stream:
                while (start := stream.tell()) < size:
                    data = self._read(f"{files.address}/{name}?start={start}", _CHUNK, name)
                    if not 0 < len(data) <= size - start:
                        raise self._refusal(f"{name}: has another size than its list says")
                    stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(growing, path)
        except OSError as error:
            raise unwritable(path, error) from None
        self.files += 1

    def _json(self, address: str, what: str) -> Any:
        self._progress(what)
        answer = self._served.request("GET", address, most=_MOST_LOG)
        self._spend(_MOST_LOG if answer is None else len(str(answer)))
        return answer

    def _read(self, address: str, most: int, what: str) -> bytes:
        self._progress(what)
        data = self._served.read("GET", address, most=most)
        self.bytes += len(data)
        self._spend(len(data))
        return data

    def _spend(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise BoardError(
                f"{self._served.url}: has sent more than {self._most:,} bytes. What is here is "
                "whole; repeat the command to go on, with a larger limit: --most."
            )

    def _refusal(self, message: str) -> BoardError:
        return BoardError(f"{self._served.url}: {message}. Nothing of it was written.")

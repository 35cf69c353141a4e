"""Client of a served board: `submit`, `status`, `withdraw`, and `fetch`, which copies a board.

Every object is addressed by its hash, so a lost request can be repeated unchanged. A rejection by
the board is raised here as the same `Rejection`, with the board's code and message. A board that
cannot be reached, or whose answer is invalid, is a `BoardError`, and a false URL an `OptionError`.

A copy has board.json, then each entry of the log after the document that it names, then the policy
files and answers that are public, then the files of the seasons. The server is not trusted: each
entry must follow the one before and be signed by the board's key, and each document or policy file
must have the digest that the log names, before it is written. All that is downloaded counts towards
a limit. A fetch that was interrupted, or killed, goes on where it ended, and one of a board that
has grown gets what is new.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field

from leaderboard.admission import upload_header
from leaderboard.bundle import Bundle
from leaderboard.documents.board import BoardDocument, Folder, hex_of
from leaderboard.documents.result import EntryRow, Result, Status
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Submission, Withdrawal, now
from leaderboard.errors import CODES, BoardError, NotPublishable, Rejection
from leaderboard.scoring import ranking
from leaderboard.store import Store
from leaderboard.store.log import (
    EMPTY,
    Head,
    Log,
    LogEntry,
    Objects,
    digest_of,
    unwritable,
    write_document,
    write_file,
)
from sme_registry.errors import MalformedDocumentError, OptionError, SealedError, SpecError
from sme_registry.io import parse_json, server_address, sha256_of
from sme_registry.seasons.wire import Connection
from sme_registry.spec.document import Digest, Integer, StrictModel

__all__ = ["Fetched", "board_document", "fetch", "page_of", "status", "submit", "withdraw"]

Progress = Callable[[int, int], None]

MOST_BYTES = 2**34
_PATIENCE = 30.0  # seconds
_MOST = 2**24  # bytes of an answer: a result of a thousand runs has less than two million
_MOST_LOG = 2**22  # of an answer: a hundred entries of at most 4,096 bytes, as JSON
_CHUNK, _INODE = 2**23, 2**12  # of a file of a season; what an empty one counts as


def submit(
    url: str,
    bundle: str | os.PathLike[str],
    key: SigningKey,
    progress: Progress | None = None,
) -> str:
    """Send a bundle's folder to a board, and return the submission's id; it is scored later.

    `key`, the submitter's, signs the uploads, and the submission if it is signed for no board yet.
    """
    content = Bundle.read(bundle)
    runs = content.signed.content.runs
    digests = dict.fromkeys(run.artefact.sha256 for run in runs if run.artefact)
    with ServedBoard(url) as served:
        signed = content.signed.for_receiver(served.receiver(), key)
        return served.send("/api/submissions", signed, digests, content.artefact, key, progress)


def receiver_of(url: str) -> Receiver:
    """A served board and its address, for which whatever is sent to it must be signed."""
    with ServedBoard(url) as served:
        return served.receiver()


def page_of(url: str, id: str) -> str:
    """The address of a submission's page on a served board."""
    return f"{url.rstrip('/')}/submissions/{_digits(id)}"


def status(url: str, id: str) -> dict[str, Any]:
    """A submission as the board answers: with its `result`, or why it is `withheld`."""
    with ServedBoard(url) as served:
        answer = served.request("GET", f"/api/submissions/{_digits(id)}")
    return answer_for(f"sha256:{_digits(id)}", answer, url)


def board_document(url: str) -> BoardDocument:
    """The definition of a served board: suite, protocol and limits."""
    with ServedBoard(url) as served:
        return served.document()


def withdraw(url: str, id: str, key: SigningKey, reason: str = "") -> None:
    """Withdraw a submission that this key has signed; its page shows the reason."""
    id = f"sha256:{_digits(id)}"
    with ServedBoard(url) as served:
        withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
        signed = withdrawal.signed(key, served.receiver())
        served.request("POST", "/api/withdrawals", json.dumps(signed.to_dict()).encode())


class ServedBoard:
    """A served board, whose errors are those of this module; a context manager."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._address = server_address(url).url
        self._connection = Connection(url, patience=_PATIENCE)

    def __enter__(self) -> ServedBoard:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def document(self) -> BoardDocument:
        """The board's definition."""
        answer = self.request("GET", "/definition.json")
        try:
            return BoardDocument.from_dict(answer)
        except SpecError as error:
            raise BoardError(f"{self.url}: its definition is invalid: {error}") from None

    def receiver(self) -> Receiver:
        """Who takes signatures: the address is where this client has reached the board."""
        return Receiver(self.document().key, self._address)

    def upload(self, digest: str, data: bytes, key: SigningKey, receiver: Receiver) -> None:
        """Send an object, also if the board has it: only who has its bytes may submit it."""
        sign = functools.partial(upload_header, key, digest, receiver)
        self.request("PUT", f"/api/objects/{hex_of(digest)}", data, sign)

    def send(
        self,
        path: str,
        signed: Signed[Any],
        digests: Collection[str],
        data_of: Callable[[str], bytes],
        key: SigningKey,
        progress: Progress | None = None,
    ) -> str:
        """Send the objects that a signed document names, then itself; returns its id."""
        for done, digest in enumerate(digests, start=1):
            self.upload(digest, data_of(digest), key, signed.receiver)
            if progress is not None:
                progress(done, len(digests))
        answer = self.request("POST", path, signed.to_bytes())
        return str(answer_for(signed.id, answer, self.url)["id"])

    def request(
        self,
        method: str,
        path: str,
        content: bytes = b"",
        sign: Callable[[], str] | None = None,
        most: int = _MOST,
    ) -> Any:
        """The JSON of an answer; None if it is none."""
        data = self.read(method, path, content, sign, most)
        with contextlib.suppress(MalformedDocumentError):
            return parse_json(data, self.url)
        return None

    def read(
        self,
        method: str,
        path: str,
        content: bytes = b"",
        sign: Callable[[], str] | None = None,
        most: int = _MOST,
    ) -> bytes:
        """The bytes of an answer, of at most `most`."""
        try:
            return self._connection.request(method, path, content, most=most, sign=sign)
        except SealedError as error:
            if error.code in CODES:
                raise Rejection(error.code, error.message) from None
            named = error.code in ("unreachable", "http", "wire")  # the client's own, with the URL
            kind = _NotFoundError if error.code == "not_found" else BoardError
            raise kind(error.message if named else f"{self.url}: {error.message}") from None


def answer_for(id: str, answer: Any, url: str) -> dict[str, Any]:
    """The answer, checked to be of the submission that was asked for."""
    if not isinstance(answer, dict) or answer.get("id") != id:
        raise BoardError(f"{url}: answered for another submission. Contact the board's owner.")
    return answer


def _digits(id: str) -> str:
    try:
        return hex_of(id)
    except ValueError:
        raise OptionError(
            f"id={id!r:.90}: must be 'sha256:' and 64 hex digits; a served board needs all of "
            "them. Copy the id from the board."
        ) from None


class _NotFoundError(BoardError):
    """The server has no such thing."""


class Files(NamedTuple):
    """Files that a server lists, and serves, below an address."""

    address: str
    folder: Path  # that they belong into
    is_named: Callable[[str], bool]  # whether the log commits to a file of this path
    check: Callable[[], None]  # raises an error unless they are those that the log commits to


Part = Callable[[Store], Iterator[Files]]
"""The files of a part of a board whose log is there."""


@dataclass(frozen=True)
class Fetched:
    """What a folder has after a fetch."""

    entries: int  # of the log
    files: int  # that were downloaded now
    bytes: int  # of these


def fetch(
    url: str,
    folder: str | os.PathLike[str],
    *,
    without_data: bool = False,
    most: int = MOST_BYTES,
    board: type[Store] = Store,
    parts: Sequence[Part] = (),
    progress: Callable[[str], None] | None = None,
) -> Fetched:
    """Copy the public part of a served board into a new folder, or into an earlier copy of it.

    At most `most` bytes are downloaded. `parts` is what else to copy, such as files of seasons. A
    TamperedError is raised if the log is not signed by the board or has a gap, and a BoardError for
    everything else that the server must not send, or if the folder holds something else.
    """
    with ServedBoard(url) as served:
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

    def __init__(
        self, served: ServedBoard, folder: Path, most: int, progress: Callable[[str], None]
    ) -> None:
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
            head = log.read(head.sequence + 1, head).head
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
            data = self._read(f"/api/objects/{hex_of(digest)}", _MOST, digest)
        except _NotFoundError:
            if optional:
                return
            raise
        if sha256_of(data) != digest:
            raise self._refusal(f"what it sends as {digest} has another digest")
        write_file(self.folder.object(digest), data)
        self.files += 1
        self.bytes += len(data)

    def fetch_files(self, files: Files, without_data: bool) -> None:
        """Get the files of a list."""
        start: int | None = 0
        while start is not None:
            answer = self._json(f"{files.address}?start={start}", files.address)
            try:
                listed = [(str(each["path"]), int(each["size"])) for each in answer["files"]]
                following = answer["next"]
            except (LookupError, TypeError, ValueError, OverflowError) as error:
                raise self._refusal(f"its list of files is invalid: {error}") from None
            for path, size in listed:
                if not files.is_named(path):
                    raise self._refusal(f"it lists {path!r:.80}, which its log does not name")
                if not (without_data and path.startswith("published/")):
                    self._fetch_file(files, path, size)
            goes_on = listed and isinstance(following, int) and following > start
            start = following if goes_on else None
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
                    if len(data) != min(size - start, _CHUNK):  # few answers for many bytes
                        raise self._refusal(f"{name}: has another size than its list says")
                    stream.write(data)
                    self.bytes += len(data)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(growing, path)
        except OSError as error:
            raise unwritable(path, error) from None
        self.files += 1

    def _json(self, address: str, what: str) -> Any:
        data = self._read(address, _MOST_LOG, what)
        with contextlib.suppress(MalformedDocumentError):
            return parse_json(data, address)
        return None

    def _read(self, address: str, most: int, what: str) -> bytes:
        self._progress(what)
        data = self._served.read("GET", address, most=most)
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


class PublicCopy(StrictModel):
    """An earlier submission of another key, and how many runs act like its own."""

    id: Digest
    runs: Integer


class PublicView(Signed[Submission]):
    """What the board publishes about one submission: as it was signed, and what became of it."""

    status: Status
    received: str
    result: Result | None  # None before scoring, and while its scores are withheld
    withheld: str  # why the scores are withheld; empty if they are not
    withdrawal: Signed[Withdrawal] | None
    not_ranked: str  # by any metric, a key of `ranking.REASONS`; empty without scores
    copy_of: Annotated[tuple[PublicCopy, ...], Field(strict=False)]
    place: Integer  # in the queue, from 1; 0 if it does not wait
    queue: Integer  # how many wait, if it does
    faults: Integer  # of the board's machine, which ended its scoring while it waits
    fault: str  # the last of them

    @classmethod
    def from_dict(cls, data: Any, source: str = "submission") -> Self:
        """The view that `to_dict` wrote."""
        fields = dict(data)
        id = fields.pop("id", None)
        view = super().from_dict(fields, source)
        if view.id != id:
            raise SpecError(f"id={id!r:.80}: the submission has another digest. Check the URL.")
        return view

    def to_dict(self) -> dict[str, Any]:
        """Every field, and the id."""
        return {"id": self.id, **super().to_dict()}


def public_view(store: Store, entry: EntryRow) -> PublicView:
    """The public view of a submission; it has scores only while the board is publishable."""
    result, entries = store.result(entry.id), store.entries()
    queue = store.queue.places()
    withheld, reason = "", ""
    if result is not None and result.scores is not None:
        try:
            ranking.refuse_unpublishable(entries)
            rows = ranking.ranking(entries, "wd_regret")
            reason = next((row.reason for row in rows if row.entry.id == entry.id), "")
        except NotPublishable as error:
            result, withheld = None, str(error)
    return PublicView(
        **dict(store.submission(entry.id)),
        status=entry.status,
        received=entry.received,
        result=result,
        withheld=withheld,
        withdrawal=store.withdrawal(entry.id),
        not_ranked=reason,
        copy_of=tuple(
            PublicCopy(id=each.id, runs=each.runs) for each in entry.copy_of if not withheld
        ),
        place=queue.get(entry.id, 0),
        queue=len(queue) if entry.id in queue else 0,
        faults=entry.faults,
        fault=entry.fault,
    )

"""Client of a served board: sends artefacts and submissions, reads status, withdraws.

Every object is addressed by its hash, so a lost request can be repeated unchanged. A rejection by
the board is raised here as the same `Rejection`, with the board's code and message. A board that
cannot be reached, or whose answer is invalid, is a `BoardError`, and a false URL an `OptionError`.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
from collections.abc import Callable, Collection
from typing import Any

from leaderboard.admission import upload_header
from leaderboard.bundle import Bundle
from leaderboard.documents.board import BoardDocument, hex_of
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Withdrawal, now
from leaderboard.errors import CODES, BoardError, Rejection
from sme_registry.errors import MalformedDocumentError, OptionError, SealedError, SpecError
from sme_registry.io import parse_json, server_address
from sme_registry.seasons.wire import Connection

Progress = Callable[[int, int], None]

_PATIENCE = 30.0  # seconds
_MOST = 2**24  # bytes of an answer: a result of a thousand runs has less than two million


def submit(
    url: str,
    bundle: str | os.PathLike[str],
    key: SigningKey,
    progress: Progress | None = None,
    *,
    insecure: bool = False,
) -> str:
    """Send a bundle to a board, and return the submission's id; the board scores it later.

    Args:
      url: of the board, such as `https://board.example`.
      bundle: the bundle's folder.
      key: the submitter's; signs the uploads, and the submission if it is signed for no board yet.
      progress: called with the number of artefacts on the board and of all artefacts.
      insecure: allow plain http to other machines, in a network that you trust.
    """
    content = Bundle.read(bundle)
    runs = content.signed.content.runs
    digests = dict.fromkeys(run.artefact.sha256 for run in runs if run.artefact)
    with ServedBoard(url, insecure=insecure) as served:
        signed = content.signed.for_receiver(served.receiver(), key)
        return served.send("/api/submissions", signed, digests, content.artefact, key, progress)


def receiver_of(url: str, *, insecure: bool = False) -> Receiver:
    """A served board and its address, for which whatever is sent to it must be signed."""
    with ServedBoard(url, insecure=insecure) as served:
        return served.receiver()


def page_of(url: str, id: str) -> str:
    """The address of a submission's page on a served board."""
    return f"{url.rstrip('/')}/submissions/{_digits(id)}"


def status(url: str, id: str, *, insecure: bool = False) -> dict[str, Any]:
    """A submission's `id`, `status` and, once it is scored, `result`, as the board answers.

    While the board withholds scores, the result is None and `withheld` has the reason.
    """
    with ServedBoard(url, insecure=insecure) as served:
        answer = served.request("GET", f"/api/submissions/{_digits(id)}")
    return answer_for(f"sha256:{_digits(id)}", answer, url)


def board_document(url: str, *, insecure: bool = False) -> BoardDocument:
    """The definition of a served board: suite, protocol and limits."""
    with ServedBoard(url, insecure=insecure) as served:
        return served.document()


def withdraw(
    url: str, id: str, key: SigningKey, reason: str = "", *, insecure: bool = False
) -> None:
    """Withdraw a submission that this key has signed; its page shows the reason."""
    id = f"sha256:{_digits(id)}"
    with ServedBoard(url, insecure=insecure) as served:
        withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
        signed = withdrawal.signed(key, served.receiver())
        served.request("POST", "/api/withdrawals", json.dumps(signed.to_dict()).encode())


class ServedBoard:
    """A served board, whose errors are those of this module's functions; a context manager.

    Digests identify objects and documents, so that every request is safe to repeat.
    """

    def __init__(self, url: str, *, insecure: bool) -> None:
        self.url = url
        self._address = server_address(url, insecure=insecure).url
        self._connection = Connection(url, insecure=insecure, patience=_PATIENCE)

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
            raise BoardError(error.message if named else f"{self.url}: {error.message}") from None


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

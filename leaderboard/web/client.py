"""Client of a served board: sends artefacts and submissions, reads status, withdraws, gets tickets.

Every object is addressed by its hash, so a lost request can be repeated unchanged. A rejection by
the board is raised here as the same `Rejection`, with the board's code and message.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from leaderboard.bundle import Bundle
from leaderboard.documents.board import BoardDocument, hex_of
from leaderboard.documents.entry import SignedEntry, SignedTicketRequest
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.season import Season
from leaderboard.documents.submission import SignedWithdrawal
from leaderboard.errors import CODES, BoardError, Rejection
from leaderboard.intake import upload_header
from sme_registry.errors import MalformedDocumentError, OptionError, SpecError
from sme_registry.io import parse_json, printable, require_packages, server_address
from sme_registry.seasons import Ticket
from sme_registry.seasons.wire import tickets_path

if TYPE_CHECKING:
    import httpx

Progress = Callable[[int, int], None]

_WAITS = (0.25, 1.0, 4.0)  # seconds before each further attempt
_TRANSIENT = frozenset({408, 502, 503, 504})
_MAX_ANSWER = 64 * 2**20  # a board may be hostile, too
_CHUNK = 64 * 2**10


def submit(
    url: str,
    bundle: str | os.PathLike[str],
    key: SigningKey,
    progress: Progress | None = None,
    *,
    insecure: bool = False,
) -> str:
    """Send a bundle to a board.

    Args:
      url: of the board, such as `https://board.example`.
      bundle: the bundle's folder.
      key: the submitter's; signs the uploads, and the submission if it is signed for no board yet.
      progress: called with the number of artefacts on the board and of all artefacts.
      insecure: allow plain http to other machines, in a network that you trust.

    Returns:
      The submission's id. The board scores it later; see `status`.

    Raises:
      Rejection: the bundle is invalid, or the board rejects it.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL is invalid.
    """
    content = Bundle.read(bundle)
    runs = content.signed.submission.runs
    digests = list(dict.fromkeys(run.artefact.sha256 for run in runs if run.artefact))
    with _Client(url, insecure=insecure) as client:
        board = client.board_document().key
        signed = content.signed.for_board(board, key)
        for done, digest in enumerate(digests, start=1):
            client.upload(digest, content.artefact(digest), key, board)
            if progress is not None:
                progress(done, len(digests))
        _, answer = client.request("POST", "/api/submissions", signed.to_bytes())
    return str(_answer_for(signed.id, answer, url)["id"])


def page_of(url: str, id: str) -> str:
    """The address of a submission's page on a served board."""
    return f"{url.rstrip('/')}/submissions/{_digits(id)}"


def status(url: str, id: str, *, insecure: bool = False) -> dict[str, Any]:
    """A submission's `id`, `status` and, once it is scored, `result`, as the board answers.

    While the board withholds scores, the result is None and `withheld` has the reason.

    Raises:
      Rejection: `unknown_submission`.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL or the id is invalid.
    """
    with _Client(url, insecure=insecure) as client:
        _, answer = client.request("GET", f"/api/submissions/{_digits(id)}")
    return _answer_for(f"sha256:{_digits(id)}", answer, url)


def board_document(url: str, *, insecure: bool = False) -> BoardDocument:
    """The definition of a served board: suite, protocol and limits.

    Raises:
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL is invalid.
    """
    with _Client(url, insecure=insecure) as client:
        return client.board_document()


def season(url: str, id: str, *, insecure: bool = False) -> tuple[str, str]:
    """The digest of a season of a served board, and the board's public key.

    Raises:
      Rejection: `season_unknown`.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL or the id is invalid.
    """
    with _Client(url, insecure=insecure) as client:
        _, answer = client.request("GET", f"/api/seasons/{_name(id)}")
        try:
            found = Season.from_dict(answer["document"], "season.json")
        except (SpecError, LookupError, TypeError) as error:
            raise BoardError(f"{url}: answered with no season: {printable(error)}") from None
        return found.digest, client.board_document().key


def request_ticket(
    url: str,
    season: str,
    signed: SignedTicketRequest,
    key: SigningKey,
    *,
    insecure: bool = False,
) -> Ticket:
    """Start a ticket, or get the one that this request has started before.

    Args:
      url, insecure: as for `submit`.
      season: the season's id.
      signed: the request, signed for this board.
      key: the entrant's, which signed it.

    Returns:
      The ticket, with the signer of its answers.

    Raises:
      Rejection: the board rejects it.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL or the id is invalid.
    """
    sign = functools.partial(upload_header, key, signed.id, board=signed.board)
    with _Client(url, insecure=insecure) as client:
        path = tickets_path(_name(season))
        _, answer = client.request("POST", path, signed.to_bytes(), sign)
    try:
        ticket = Ticket.from_dict(answer, "ticket")
    except SpecError as error:
        raise BoardError(f"{url}: answered with no ticket: {printable(error)}") from None
    return ticket.model_copy(update={"signer": signed.signer(key)})


def enter(
    url: str,
    season: str,
    signed: SignedEntry,
    answers: Mapping[str, bytes],
    key: SigningKey,
    progress: Progress | None = None,
    *,
    insecure: bool = False,
) -> str:
    """Send an entry of a sealed-offline season to a board.

    Args:
      url, insecure: as for `submit`.
      season: the season's id.
      signed: the entry, signed for this board.
      answers: the files that it names, by their digests.
      key: the submitter's, to sign the uploads.
      progress: called with the number of answers on the board and of all.

    Returns:
      The entry's id.

    Raises:
      Rejection: the board rejects it.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL or the id is invalid.
    """
    with _Client(url, insecure=insecure) as client:
        for done, (digest, data) in enumerate(answers.items(), start=1):
            client.upload(digest, data, key, signed.board)
            if progress is not None:
                progress(done, len(answers))
        path = f"/api/seasons/{_name(season)}/entries"
        _, answer = client.request("POST", path, signed.to_bytes())
    return str(_answer_for(signed.id, answer, url)["id"])


def withdraw(
    url: str, id: str, key: SigningKey, reason: str = "", *, insecure: bool = False
) -> None:
    """Withdraw a submission from a board.

    Args:
      url, insecure: as for `submit`.
      id: the submission's.
      key: the key that signed the submission.
      reason: shown on the submission's page; up to 300 characters.

    Raises:
      Rejection: the board rejects it.
      BoardError: the board cannot be reached, or its answer is invalid.
      OptionError: the URL or the id is invalid.
    """
    id = f"sha256:{_digits(id)}"
    with _Client(url, insecure=insecure) as client:
        board = client.board_document().key
        signed = SignedWithdrawal.create(id, key, reason, board=board)
        client.request("POST", "/api/withdrawals", json.dumps(signed.to_dict()).encode())


class _Client:
    """An HTTP client of one board, which repeats requests after network failures."""

    def __init__(self, url: str, *, insecure: bool) -> None:
        require_packages("reaching a served board", {"httpx": "httpx"}, "leaderboard")
        import httpx

        self._httpx = httpx
        address = server_address(url, insecure=insecure)
        self._url = address.url
        self._client = httpx.Client(
            timeout=httpx.Timeout(30.0, read=120.0), trust_env=not address.is_local
        )

    def __enter__(self) -> _Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def board_document(self) -> BoardDocument:
        """The board's definition; errors as for the function of this name."""
        _, answer = self.request("GET", "/definition.json")
        try:
            return BoardDocument.from_dict(answer)
        except SpecError as error:
            raise BoardError(
                f"{self._url}: its definition is invalid: {printable(error)}"
            ) from None

    def upload(self, digest: str, data: bytes, key: SigningKey, board: str | None) -> None:
        """Send an object, also if the board has it: only who has its bytes may submit it."""
        sign = functools.partial(upload_header, key, digest, board=board)
        self.request("PUT", f"/api/objects/{hex_of(digest)}", data, sign)

    def request(
        self,
        method: str,
        path: str,
        content: bytes | None = None,
        sign: Callable[[], str] | None = None,
    ) -> tuple[int, Any]:
        """Status and JSON of the answer to a request, repeated after failures of the network.

        Every request is safe to repeat, because digests identify objects and documents. `sign`
        returns its `Authorization`, a new one for each attempt, because it is valid for minutes.
        """
        for wait in (*_WAITS, None):
            headers = {"Accept": "application/json"}
            if sign is not None:
                headers["Authorization"] = sign()
            try:
                with self._client.stream(
                    method, self._url + path, content=content, headers=headers
                ) as response:
                    code, answer = response.status_code, self._read(response)
            except self._httpx.TransportError as error:
                reason = str(error) or type(error).__name__
                code, answer = 503, {"message": f"cannot be reached: {reason}"}
            if code not in _TRANSIENT or wait is None:
                break
            time.sleep(wait)
        if 200 <= code < 300:
            return code, answer
        fields = answer if isinstance(answer, dict) else {}
        message = printable(fields.get("message") or f"answered with HTTP status {code}")
        if (rejection := str(fields.get("code"))) in CODES:
            raise Rejection(rejection, message)
        raise BoardError(f"{self._url}: {message}")

    def _read(self, answer: httpx.Response) -> Any:
        text = bytearray()
        for chunk in answer.iter_bytes(_CHUNK):
            text += chunk
            if len(text) > _MAX_ANSWER:
                raise BoardError(
                    f"{self._url}: answered with more than {_MAX_ANSWER:,} bytes. Check the URL."
                )
        with contextlib.suppress(MalformedDocumentError):
            return parse_json(bytes(text), self._url)
        return None


def _answer_for(id: str, answer: Any, url: str) -> dict[str, Any]:
    """The answer, checked to be of the submission that was asked for."""
    if not isinstance(answer, dict) or answer.get("id") != id:
        raise BoardError(f"{url}: answered for another submission. Contact the board's owner.")
    return answer


def _name(id: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", id):
        raise OptionError(
            f"season={id!r:.80}: must be an id of letters, digits, '_' and '-'. Copy it from the "
            "board."
        )
    return id


def _digits(id: str) -> str:
    try:
        return hex_of(id)
    except ValueError:
        raise OptionError(
            f"id={id!r:.90}: must be 'sha256:' and 64 hex digits; a served board needs all of "
            "them. Copy the id from the board."
        ) from None

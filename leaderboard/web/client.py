"""Sends a bundle to a served board: the artefacts that it lacks, then the submission.

Everything is asked for by its hash, so that a request that got lost is sent again as it was. What
the board refuses is raised here as the same `Rejection`, with the board's own code and words.
"""

from __future__ import annotations

import contextlib
import functools
import ipaddress
import json
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from leaderboard.bundle import Bundle
from leaderboard.documents.board import hex_of
from leaderboard.documents.keys import SigningKey
from leaderboard.errors import CODES, BoardError, Rejection
from leaderboard.intake import upload_header, withdrawal_of
from sme_registry.errors import MalformedDocumentError, MissingDependencyError, OptionError
from sme_registry.io import parse_json

if TYPE_CHECKING:
    import httpx

Progress = Callable[[int, int], None]

_WAITS = (0.25, 1.0, 4.0)  # seconds before each further attempt
_TRANSIENT = frozenset({408, 502, 503, 504})
_MAX_ANSWER = 64 * 2**20  # a board is a stranger, too
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
      bundle: its folder.
      key: signs the uploads; the submission is signed already.
      progress: called with the number of artefacts that the board has, and of all of them.
      insecure: allow plain http to other machines than this one, in a network that you trust.

    Returns:
      The submission's id. It is scored later; `status` tells.

    Raises:
      Rejection: the bundle is wrong, or the board refuses it.
      BoardError: the board cannot be reached or does not answer as a board does.
      OptionError: the URL is not one of a board.
    """
    content = Bundle.read(bundle)
    runs = content.signed.submission.runs
    digests = list(dict.fromkeys(run.artefact.sha256 for run in runs if run.artefact))
    with _Board(url, insecure=insecure) as board:
        for done, digest in enumerate(digests, start=1):
            path = f"/api/objects/{hex_of(digest)}"
            if not board.has(path):
                sign = functools.partial(upload_header, key, digest)
                board.ask("PUT", path, content.artefact(digest), sign)
            if progress is not None:
                progress(done, len(digests))
        answer = board.ask("POST", "/api/submissions", content.signed.to_bytes())
    if not isinstance(answer, dict) or answer.get("id") != content.signed.id:
        raise BoardError(f"{url}: took the submission for another one. Ask whoever keeps it.")
    return content.signed.id


def status(url: str, id: str, *, insecure: bool = False) -> dict[str, Any]:
    """What a board says of a submission: `id`, `status`, and its `result` once it is scored.

    Until the board shows any number the result is None, and `withheld` says why.

    Raises:
      Rejection: `unknown_submission`.
      BoardError: the board cannot be reached or does not answer as a board does.
      OptionError: the URL is not one of a board, or the id is none.
    """
    with _Board(url, insecure=insecure) as board:
        answer = board.ask("GET", f"/api/submissions/{_digits(id)}")
    if not isinstance(answer, dict) or answer.get("id") != f"sha256:{_digits(id)}":
        raise BoardError(f"{url}: answers for another submission. Ask whoever keeps it.")
    return answer


def withdraw(
    url: str, id: str, key: SigningKey, reason: str = "", *, insecure: bool = False
) -> None:
    """Take a submission off a board.

    Args:
      url: of the board.
      id: the submission's.
      key: the one that signed the submission.
      reason: shown on the submission's page; up to 300 characters.
      insecure: allow plain http to other machines than this one.

    Raises:
      Rejection: the board refuses it.
      BoardError: the board cannot be reached or does not answer as a board does.
      OptionError: the URL is not one of a board, or the id is none.
    """
    signed = withdrawal_of(f"sha256:{_digits(id)}", key, reason)
    with _Board(url, insecure=insecure) as board:
        board.ask("POST", "/api/withdrawals", json.dumps(signed.to_dict()).encode())


class _Board:
    """A served board: sends, tries again where the network failed, reads what comes back."""

    def __init__(self, url: str, *, insecure: bool) -> None:
        try:
            import httpx
        except ImportError:
            raise MissingDependencyError(
                "httpx: not installed, and needed to send a submission. "
                "Run `pip install 'sme-registry[leaderboard]'`."
            ) from None
        self._httpx = httpx
        self._url, near = _checked(httpx.URL, url, insecure=insecure)
        self._client = httpx.Client(timeout=httpx.Timeout(30.0, read=120.0), trust_env=not near)

    def __enter__(self) -> _Board:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def has(self, path: str) -> bool:
        """Whether there is something at a path of the board."""
        code, answer = self._patiently("HEAD", path)
        if code != 404:
            self._refuse_failure(code, answer)
        return code != 404

    def ask(
        self,
        method: str,
        path: str,
        content: bytes | None = None,
        sign: Callable[[], str] | None = None,
    ) -> Any:
        """The board's answer to a request, as plain data; None where it is none."""
        code, answer = self._patiently(method, path, content, sign)
        self._refuse_failure(code, answer)
        return answer

    def _refuse_failure(self, code: int, answer: Any) -> None:
        if 200 <= code < 300:
            return
        refusal = answer if isinstance(answer, dict) else {}
        message = _shown(refusal.get("message") or f"answers with HTTP status {code}")
        if (reason := str(refusal.get("code"))) in CODES:
            raise Rejection(reason, message)
        raise BoardError(f"{self._url}: {message}")

    def _patiently(
        self,
        method: str,
        path: str,
        content: bytes | None = None,
        sign: Callable[[], str] | None = None,
    ) -> tuple[int, Any]:
        """Status and answer, asked for several times where they do not come.

        Every request is safe to repeat: objects and documents are known by their digests.
        """
        for wait in (*_WAITS, None):
            try:
                code, answer = self._once(method, path, content, sign)
            except self._httpx.TransportError as error:
                reason = str(error) or type(error).__name__
                code, answer = 503, {"message": f"cannot be reached: {reason}"}
            if code not in _TRANSIENT or wait is None:
                break
            time.sleep(wait)
        return code, answer

    def _once(
        self,
        method: str,
        path: str,
        content: bytes | None,
        sign: Callable[[], str] | None,
    ) -> tuple[int, Any]:
        headers = {"Accept": "application/json"}
        if sign is not None:
            headers["Authorization"] = sign()  # anew for each attempt: it is fresh for minutes
        with self._client.stream(
            method, self._url + path, content=content, headers=headers
        ) as answer:
            return answer.status_code, self._read(answer)

    def _read(self, answer: httpx.Response) -> Any:
        text = bytearray()
        for chunk in answer.iter_bytes(_CHUNK):
            text += chunk
            if len(text) > _MAX_ANSWER:
                raise BoardError(
                    f"{self._url}: answers with more than {_MAX_ANSWER:,} bytes. Check the URL."
                )
        with contextlib.suppress(MalformedDocumentError):
            return parse_json(bytes(text), self._url)
        return None


def _checked(parse: Callable[[str], httpx.URL], url: str, *, insecure: bool) -> tuple[str, bool]:
    """The URL without a slash at its end, if a policy may be sent to it; whether it is near.

    What is near, on this machine, is asked without a proxy, and needs no encryption.
    """
    try:
        parts = parse(url)
    except Exception:  # httpx.InvalidURL is no ValueError
        parts = parse("")
    if parts.scheme not in ("http", "https") or not parts.host or parts.query or parts.userinfo:
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Copy it from the board's page."
        )
    near = _is_loopback(parts.host)
    if parts.scheme == "http" and not (near or insecure):
        raise OptionError(
            f"url={url!r:.80}: must be https for another machine. "
            "Use https, or reach it through a tunnel."
        )
    return str(parts).rstrip("/"), near


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _digits(id: str) -> str:
    try:
        return hex_of(id)
    except ValueError:
        raise OptionError(
            f"id={id!r:.90}: must be 'sha256:' and 64 hex digits: where a board is served, their "
            "beginning is not enough. Copy the whole id from the board."
        ) from None


def _shown(text: object) -> str:
    """A stranger's words, cut and without control characters: they go to a terminal."""
    return "".join(c if c.isprintable() else " " for c in str(text)[:2000])

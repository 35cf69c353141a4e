"""`Connection`: requests to a season's server, repeated until they are answered.

No request of this protocol has a further effect when it is repeated (`wire`), so a lost connection
or a server that is being restarted costs time and nothing else.
"""

from __future__ import annotations

import http.client
import logging
import random
import ssl
import time
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

from sme_registry.errors import BudgetSpentError, MalformedDocumentError, SealedError
from sme_registry.io import number_in, parse_json, printable, server_address
from sme_registry.sealed.wire import bearer

PATIENCE = 900.0
_FIRST_PATIENCE = 5.0  # a mistyped URL shall not wait for a server that does not exist
_TIMEOUT = 300.0  # to accept a connection, or send more: a restarted server replays all steps
_FIRST_WAIT, _LONGEST_WAIT = 0.1, 15.0
_TRANSIENT = frozenset({408, 502, 503, 504, 507})
_JSON_BYTES = 2**20
_TYPE = "application/octet-stream"

_log = logging.getLogger(__name__)
_now, _sleep = time.monotonic, time.sleep


class Connection:
    """An HTTP connection to a server, kept open between requests. Not for several threads.

    A request is repeated for `patience` seconds after the first answer has shown that the server
    exists. `insecure` allows plain http to other machines, in a network that you trust.
    """

    def __init__(
        self, url: str, token: str, *, insecure: bool = False, patience: float = PATIENCE
    ) -> None:
        self._http: http.client.HTTPConnection | None = None
        self._address = server_address(url, insecure=insecure)
        self._patience = number_in("patience", patience, 0.0)
        self._headers = {"Authorization": bearer(token), "Content-Type": _TYPE}
        self._answered = False

    def request(self, method: str, path: str, body: bytes = b"", *, most: int) -> bytes:
        """The body of the answer to a request, of at most `most` bytes.

        A refusal, no answer, and a longer one are SealedErrors; BudgetSpentError if it is for
        steps and the instance has none left.
        """
        wait, started = _FIRST_WAIT, _now()
        while True:
            reused = self._http is not None
            try:
                status, data = self._exchange(method, path, body, most)
            except ssl.SSLCertVerificationError as error:
                raise SealedError("unreachable", f"{self._address.url}: {error}.") from None
            except (OSError, http.client.HTTPException) as error:
                reason = str(error) or type(error).__name__
                if reused:  # a server closes connections that have been idle
                    continue
            else:
                self._answered = True
                if status in (200, 201):
                    return data
                code, message = _reason_in(data, status)
                if status not in _TRANSIENT:
                    kind = BudgetSpentError if code == "budget_spent" else SealedError
                    raise kind(code, message)
                reason = f"{code}: {message}"
            patience = self._patience if self._answered else min(self._patience, _FIRST_PATIENCE)
            if _now() + wait > started + patience:
                raise SealedError(
                    "unreachable",
                    f"{self._address.url}: gives no answer: {reason:.500} Check the URL and try "
                    "again: no step is lost, or taken twice.",
                )
            _log.warning("%s: no answer, trying again: %.200s", self._address.url, reason)
            # Clients that lost the same server do not all come back at the same moment.
            _sleep(wait * random.uniform(0.5, 1.0))
            wait = min(2 * wait, _LONGEST_WAIT)

    def close(self) -> None:
        if self._http is not None:
            self._http.close()
            self._http = None

    def __del__(self) -> None:  # few users close their environments
        self.close()

    def _exchange(self, method: str, path: str, body: bytes, most: int) -> tuple[int, bytes]:
        if self._http is None:
            self._http = self._new()
        try:
            self._http.request(method, self._address.path + path, body, self._headers)
            with self._http.getresponse() as answer:
                data = answer.read(max(most, _JSON_BYTES) + 1)
                if len(data) > max(most, _JSON_BYTES):
                    raise SealedError(
                        "wire", f"{self._address.url}: answered with more than {most:,} bytes."
                    )
                if answer.length:  # `read` does not raise where the connection was lost
                    raise http.client.IncompleteRead(data, answer.length)
        except BaseException:  # an interrupt, too: the rest of this answer is none to the next
            self.close()
            raise
        if answer.will_close:
            self.close()
        return answer.status, data

    def _new(self) -> http.client.HTTPConnection:
        """A new connection, through the proxy that the environment names, if there is one."""
        address = self._address
        if not address.is_https:
            return _InOnePiece(address.host, address.port, timeout=_TIMEOUT)
        proxy = urlsplit(getproxies().get("https", ""))
        if address.is_local or not proxy.hostname or proxy_bypass(address.host):
            return _SecureInOnePiece(address.host, address.port, timeout=_TIMEOUT)
        connection = _SecureInOnePiece(proxy.hostname, proxy.port, timeout=_TIMEOUT)
        connection.set_tunnel(address.host, address.port)
        return connection


class _InOnePiece(http.client.HTTPConnection):
    """Sends a request's head and body together: the head alone wakes the server for nothing."""

    _pieces: list[bytes] | None = None

    def request(self, *args: Any, **kwargs: Any) -> None:
        if self.sock is None:
            self.connect()
        self._pieces = []
        try:
            super().request(*args, **kwargs)
            data = b"".join(self._pieces)
        finally:
            self._pieces = None
        self.send(data)

    def send(self, data: Any) -> None:
        if self._pieces is None:
            super().send(data)
        else:
            self._pieces.append(data)


class _SecureInOnePiece(_InOnePiece, http.client.HTTPSConnection):
    """The same over TLS."""


def _reason_in(data: bytes, status: int) -> tuple[str, str]:
    """The code and the message in a refusal."""
    try:
        plain: Any = parse_json(data, "answer")
    except MalformedDocumentError:
        plain = None
    match plain:
        case {"code": str(code), "message": str(message)}:
            return printable(code), printable(message)
    return "http", f"answered with HTTP status {status}. Check the URL."

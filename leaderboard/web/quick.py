"""Requests for steps, read and answered without h11 and ASGI, which take longer than the steps.

Only a request in the plainest form is read here, as sealed clients and proxies write it. Whatever
else a head holds, and whatever is refused, is left to the application.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

_HEAD = re.compile(
    rb"POST /api/seasons/([A-Za-z0-9_-]+)/tickets/(\d{1,9})/instances/(\d{1,9})/steps HTTP/1\.1\r\n"
    rb"((?:[A-Za-z-]+: [ -~]*\r\n)+)\r\n"
)
_FIELD = re.compile(rb"([A-Za-z-]+): ([ -~]*)\r\n")
# Those that do not say how a request is read or answered, but for the two that are compared below.
_PLAIN = frozenset(
    b"accept accept-encoding authorization connection content-length content-type host user-agent "
    b"x-forwarded-for x-forwarded-proto".split()
)
_SIZE = re.compile(rb"[1-9]\d{0,4}")  # of larger bodies the application says that they are
_ANSWER = (
    b"content-type: application/octet-stream\r\n"
    b"cache-control: no-store\r\n"
    b"x-content-type-options: nosniff\r\n"
    b"content-length: %d\r\n\r\n"
)


class StepRequest(NamedTuple):
    """A request for steps.

    Attributes:
      season, ticket, instance: of its address.
      authorization: of its head; empty without one.
      body: as much of it as has arrived.
      missing: bytes of the body that have not.
    """

    season: str
    ticket: int
    instance: int
    authorization: str
    body: bytes
    missing: int


def step_request(data: bytes) -> StepRequest | None:
    """The request that begins with these bytes; None unless it is one for steps in plain form."""
    match = _HEAD.match(data)
    if match is None:
        return None
    lines = _FIELD.findall(match[4])
    fields = {name.lower(): value for name, value in lines}
    size = _SIZE.fullmatch(fields.get(b"content-length", b""))
    if (
        len(fields) < len(lines)
        or not fields.keys() <= _PLAIN
        or b"host" not in fields
        or fields.get(b"connection", b"keep-alive").lower() != b"keep-alive"
        or size is None
    ):
        return None
    body = data[match.end() :]
    missing = int(size[0]) - len(body)
    if missing < 0:  # another request follows
        return None
    authorization = fields.get(b"authorization", b"").decode("ascii")
    address = match[1].decode("ascii"), int(match[2]), int(match[3])
    return StepRequest(*address, authorization, body, missing)


def step_answer(steps: bytes, headers: Iterable[tuple[bytes, bytes]]) -> bytes:
    """The bytes of an answer, with the headers of every answer of the server."""
    head = b"".join(b"%s: %s\r\n" % header for header in headers)
    return b"HTTP/1.1 200 OK\r\n" + head + _ANSWER % len(steps) + steps

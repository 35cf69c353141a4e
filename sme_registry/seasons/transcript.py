"""The transcript of an instance: a hash chain over all that entrant and server send, in order.

    h_0    SHA-256("sme-transcript/1/" request "/" ticket "/" instance "/" L "/" ‖ answer to start)
    h_n    SHA-256(h_n-1 ‖ n ‖ actions ‖ answer)        of n requests for steps
    h_n+1  SHA-256(h_n ‖ "challenge" ‖ challenge states)
    h_n+2  SHA-256(h_n+1 ‖ answers ‖ "answers")

The entrant signs h_n each 256 requests and when the steps end, h_n+2, and at last the h_n+2 of all
instances. Only what it has signed is scored, and it signs only what it has seen itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Annotated

from pydantic import Field

from sme_registry.errors import MalformedDocumentError, SealedError, SpecError
from sme_registry.io import parse_json, require_packages, to_json
from sme_registry.io.files import unwritable, write_atomically
from sme_registry.spec.document import Digest, Document, Integer, StrictModel, TupleOf, matching

EVERY = 256
"""After so many requests more of an instance, the entrant signs its transcript."""

Hex = Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits")]
Count = Annotated[Integer, Field(ge=0)]


class Chain(StrictModel):
    """Whose transcript it is: an instance's of a ticket."""

    request: Digest  # id of the request for the ticket, which names the season and the key
    ticket: Count
    instance: Count

    def first_head(self, lanes: int, started: bytes) -> bytes:
        """h_0, from the answer to `start`."""
        prefix = f"sme-transcript/1/{self.request}/{self.ticket}/{self.instance}/{lanes}/"
        return hashlib.sha256(prefix.encode() + started).digest()

    def at(self, hashes: int, head: bytes) -> Head:
        """What the entrant signs after so many requests."""
        return Head(**dict(self), hashes=hashes, head=f"sha256:{head.hex()}")


class Head(Document):
    """What an entrant signs of one instance: the last hash of its transcript."""

    request: Digest
    ticket: Count
    instance: Count
    hashes: Count  # after the first: a request each, and two once it is answered
    head: Digest


class TicketHeads(Document):
    """What an entrant signs of a ticket whose instances are all answered."""

    request: Digest
    ticket: Count
    heads: TupleOf[Digest]  # of each instance, in order


def next_head(head: bytes, sent: bytes, answer: bytes) -> bytes:
    """The hash after something more was sent and answered."""
    return hashlib.sha256(head + sent + answer).digest()


def challenge_head(head: bytes, states: bytes) -> bytes:
    """The hash after the challenge states, an .npy file."""
    return next_head(head, b"challenge", states)


def answers_head(head: bytes, answers: bytes) -> bytes:
    """The hash after the answers to the challenge, an .npy file."""
    return next_head(head, answers, b"answers")


class Signer(Document):
    """The key that signs a ticket's transcripts; `repr` does not show it."""

    board: Hex  # its public key
    address: Annotated[str, Field(max_length=300)] | None = None  # at which it gave the ticket
    request: Digest  # id of the request for the ticket
    key: Annotated[Hex, Field(repr=False)]  # Ed25519's 32 private bytes

    def sign(self, document: Document) -> str:
        """The signature of a head, or of all heads, 128 hex digits; requires PyNaCl."""
        require_packages("signatures", {"nacl": "PyNaCl"}, "leaderboard")
        from nacl.signing import SigningKey

        parts = ["sme-leaderboard", "answers", self.board, self.address, document.digest]
        message = "/".join(filter(None, parts)).encode()
        return SigningKey(bytes.fromhex(self.key)).sign(message).signature.hex()


class Ending(StrictModel):
    """The end of a transcript, in a file of its own."""

    request: Digest
    requests: Count
    challenge: Hex  # h_n+1
    answers: Hex | None = None  # h_n+2, once the board has them


class Transcript:
    """The transcript that an entrant's program keeps of an instance, beside the ticket's file.

        lanes L, uint32 · digest of the request · h_0 · for each request: actions · h_n

    `ticket.json.0.transcript`, and the `Ending` in `ticket.json.0.end`. Actions are written before
    they are sent, so that a program that was killed can ask for their answer again.
    """

    def __init__(self, ticket: Path, chain: Chain, action_dim: int) -> None:
        self._file: IO[bytes] | None = None
        self.path = ticket.with_name(f"{ticket.name}.{chain.instance}.transcript")
        self._end = self.path.with_suffix(".end")
        self._chain, self._action_dim = chain, action_dim
        self._lanes = 0

    @property
    def lanes(self) -> int:
        """L; 0 where nothing is kept of this ticket."""
        with self._storage():
            if self._file is None and self.path.exists():
                stream = open(self.path, "r+b", buffering=0)  # noqa: SIM115  # until `close`
                header = stream.read(36)
                if header[4:] == self._request:
                    self._lanes, self._file = int.from_bytes(header[:4], "little"), stream
                else:
                    stream.close()
        return self._lanes

    def begin(self, lanes: int, head: bytes) -> None:
        """Keep h_0, and nothing of before."""
        self.close()
        with self._storage():
            self._file = open(self.path, "w+b", buffering=0)  # noqa: SIM115  # until `close`
        self._lanes = lanes
        self._write(0, lanes.to_bytes(4, "little") + self._request + head)

    @property
    def sent(self) -> int:
        """The number of requests that were sent; the last one may have no answer yet."""
        if not self.lanes:
            return 0
        more = self._size - _START
        return more // self._record + (more % self._record >= self._actions)

    @property
    def signed(self) -> int:
        """The number of requests up to which the entrant may have signed it."""
        ending = self.ending
        return max(self.sent - 1, 0) // EVERY * EVERY if ending is None else ending.requests

    @property
    def ending(self) -> Ending | None:
        """The end, once the challenge was shown."""
        try:
            ending = Ending.from_dict(parse_json(self._end.read_bytes(), self._end.name))
        except (OSError, MalformedDocumentError, SpecError):
            return None
        return ending if ending.request == self._chain.request else None

    def head(self, number: int) -> bytes:
        """h_n; empty where there is none."""
        return self._read(_START + number * self._record - 32, 32)

    def actions(self, number: int) -> bytes:
        """The actions of the n-th request."""
        return self._read(_START + (number - 1) * self._record, self._actions)

    def send(self, number: int, actions: bytes) -> None:
        """Keep the actions of the next request; the same ones may be sent again."""
        at = _START + (number - 1) * self._record
        if self._size == at:
            self._write(at, actions)
        elif self._size != at + self._actions or self.actions(number) != actions:
            raise SealedError(
                "step_conflict", f"number={number}: other actions with it were already sent."
            )

    def receive(self, number: int, head: bytes) -> None:
        """Keep h_n, and forget requests after it."""
        with self._storage():
            self._stream.truncate(_START + number * self._record - 32)
        self._write(_START + number * self._record - 32, head)

    def end(self, ending: Ending) -> None:
        write_atomically(self._end, to_json(ending.to_dict()))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file, self._lanes = None, 0

    def __del__(self) -> None:  # few users close their environments
        self.close()

    @property
    def _request(self) -> bytes:
        return bytes.fromhex(self._chain.request.removeprefix("sha256:"))

    @property
    def _actions(self) -> int:
        return 4 * self.lanes * self._action_dim

    @property
    def _record(self) -> int:
        return self._actions + 32

    @property
    def _stream(self) -> IO[bytes]:
        assert self.lanes
        assert self._file is not None
        return self._file

    @property
    def _size(self) -> int:
        return os.fstat(self._stream.fileno()).st_size

    def _read(self, at: int, size: int) -> bytes:
        self._stream.seek(at)
        data = self._stream.read(size)
        return data if len(data) == size else b""

    def _write(self, at: int, data: bytes) -> None:
        with self._storage():
            self._stream.seek(at)
            self._stream.write(data)

    @contextlib.contextmanager
    def _storage(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unwritable(self.path, error) from None


_START = 68  # of the first request's actions

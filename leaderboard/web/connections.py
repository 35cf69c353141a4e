"""`Connection`: HTTP/1.1 whose slots no client can keep by being silent or slow.

A connection is in one of three phases, each with its own limit:

    waiting    no complete request head has arrived*    at most `head_seconds`, however it drips in
    working    a request is read or answered            bodies have their own deadline in `limits`
    writing    the client has not read what was sent    at most `stalled_seconds` for each piece

    * of steps, no complete request

When all slots are taken, or all those of one address, a new connection takes the slot of another
one: of the one that has waited longest without a complete request, or, if that has just come, of
the one whose body or answer moves slowest.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from leaderboard.web.limits import LEAST_RATE, LOOPBACK, Network, counted_address
from leaderboard.web.quick import StepRequest, step_answer, step_request

_COMPARED = 64
_HEAD_BYTES = 2**14
_ENDING_SECONDS = 2.0  # before uvicorn cancels requests, which would log each as an error
_TINY_CHUNKS, _CHUNK_BYTES = 1000, 256  # a chunked body has larger chunks, but for some

_Phase = Literal["waiting", "working", "writing"]


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on the connections of a server.

    Attributes:
      connections: open at the same time.
      of_one_address: open at the same time from one IPv4 address or IPv6 /64 network. This machine
        and trusted proxies are exempt, because many clients share their addresses.
      head_seconds: from the start, or the end of an answer, until a request head is complete.
      stalled_seconds: for the client to read what was sent, at most 64 KiB and the system's buffer.
      grace_seconds: for which a new connection or request keeps its slot if others are slow.
    """

    connections: int = 1000
    of_one_address: int = 64
    head_seconds: float = 10.0
    stalled_seconds: float = 30.0
    grace_seconds: float = 1.0


class Connections:
    """The open connections of a server.

    Args:
      limits: on their number and times.
      proxies: the networks of trusted reverse proxies.
      uncounted: other networks without a limit by address.

    Attributes:
      take_steps: takes the steps of a request, and returns them; None if the application must.
    """

    def __init__(
        self,
        limits: ConnectionLimits = ConnectionLimits(),
        proxies: Iterable[Network] = (),
        uncounted: Iterable[Network] = LOOPBACK,
    ) -> None:
        self.limits = limits
        self.proxies = tuple(proxies)
        self._uncounted = (*self.proxies, *uncounted)
        self.take_steps: Callable[[StepRequest], bytes | None] = lambda _: None
        # Dictionaries keep the order in which connections came, or began to wait.
        self._open: dict[Connection, None] = {}
        self._waiting: dict[Connection, None] = {}
        self._of_address: dict[str, dict[Connection, None]] = {}

    def __len__(self) -> int:
        """Number of open connections."""
        return len(self._open)

    def protocol(self, **arguments: Any) -> Connection:
        """A protocol for a new connection; uvicorn's `http` option."""
        return Connection(self, **arguments)

    def open(self, new: Connection) -> bool:
        """Give a connection a slot, if necessary of another one.

        Returns:
          False if the server is busy answering all others.
        """
        address = counted_address(new.host, self._uncounted)
        peers = self._of_address.get(address, {}) if address else {}
        if len(peers) >= self.limits.of_one_address and not self._close_one(peers):
            return False
        if len(self._open) >= self.limits.connections and not self._close_one(self._open):
            return False
        self._open[new] = None
        if address:
            self._of_address.setdefault(address, {})[new] = None
        return True

    def enter(self, connection: Connection, phase: _Phase) -> None:
        """Note the phase of a connection."""
        self._waiting.pop(connection, None)
        if phase == "waiting" and connection in self._open:
            self._waiting[connection] = None

    def close(self, connection: Connection) -> None:
        """Free the slot of a connection; closing it twice does nothing."""
        self._waiting.pop(connection, None)
        if connection not in self._open:
            return
        del self._open[connection]
        if address := counted_address(connection.host, self._uncounted):
            peers = self._of_address[address]
            del peers[connection]
            if not peers:
                del self._of_address[address]

    def _close_one(self, candidates: Collection[Connection]) -> bool:
        grace = self.limits.grace_seconds
        waiting = next((each for each in self._waiting if each in candidates), None)
        # Of many, some are enough to find a slow one, and to look at all would be slow itself.
        some = random.sample(list(candidates), min(len(candidates), _COMPARED))
        moving = [each for each in some if each.depends_on_client]
        slow = [each for each in moving if each.age > grace and each.rate < LEAST_RATE]
        # One that has just come may be about to send its request: slow ones go before it.
        if waiting is not None and (waiting.age > grace or not slow):
            waiting.abort()
        elif moving:
            min(slow or moving, key=lambda each: each.rate).abort()
        else:
            return False
        return True


class _Parser(h11.Connection):
    """Refuses, besides invalid requests, bodies in thousands of tiny chunks, which take seconds.

    The head of an answer leaves with the first piece of its body: sent alone, it wakes the client
    for nothing, which takes as long as all else in the answer to a small request.
    """

    def __init__(self, limit: int) -> None:
        super().__init__(h11.SERVER, limit)
        self._chunks = self._bytes = 0
        self._head = b""

    def send(self, event: Any) -> Any:
        """The bytes of an answer's event; none yet of its head."""
        data = super().send(event)
        if isinstance(event, h11.Response):
            self._head, data = data or b"", b""
        elif self._head:
            self._head, data = b"", self._head + (data or b"")
        return data

    def next_event(self) -> Any:
        """The next event of a request.

        Raises:
          RemoteProtocolError: the request is invalid.
        """
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._bytes = 0
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_start
            self._bytes += len(event.data)
            if self._chunks > _TINY_CHUNKS + self._bytes / _CHUNK_BYTES:
                raise h11.RemoteProtocolError("chunks are too small")
        return event


class Connection(H11Protocol):
    """One connection, with deadlines for what its client must do."""

    def __init__(self, connections: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.conn = _Parser(_HEAD_BYTES)
        self._connections = connections
        self._phase: _Phase | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self._started = self.loop.time()
        self._moved = 0
        self._held = b""  # a request for steps whose body has not arrived

    @property
    def host(self) -> str:
        """The address of the other end; a proxy's, where there is one."""
        return self.client[0] if self.client else ""

    @property
    def depends_on_client(self) -> bool:
        """Whether a request is in progress, and its client must send or read more of it."""
        return self._phase == "writing" or (self._phase == "working" and self.cycle.more_body)

    @property
    def rate(self) -> float:
        """Bytes a second that the client has sent or read in this exchange."""
        return self._moved / (1.0 + self.age)

    @property
    def age(self) -> float:
        """Seconds for which it has waited for a request, or has been in its exchange."""
        return self.loop.time() - self._started

    def abort(self) -> None:
        """Close the connection at once, and drop what is not sent."""
        self._connections.close(self)
        self.transport.abort()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a slot, or be closed at once."""
        super().connection_made(transport)
        # Uvicorn sends no more while anything is unsent, so one piece is all that it holds.
        transport.set_write_buffer_limits(high=0)
        if self._connections.open(self):
            self._update()
        else:
            self.abort()

    def data_received(self, data: bytes) -> None:
        """Read bytes of a request; steps are taken here, and all else in the application."""
        self._moved += len(data)
        data, self._held = self._held + data, b""
        request = step_request(data) if self._is_between_requests else None
        if request is not None and request.missing:
            self._unset_keepalive_if_required()  # the deadline of this phase goes on
            self._held = data
            return
        steps = None if request is None else self._take(request)
        if steps is None:
            super().data_received(data)
            return
        self._enter("working")
        self.transport.write(step_answer(steps, self.server_state.default_headers))
        self.on_response_complete()

    def handle_events(self) -> None:
        """Go on with the requests that have arrived."""
        super().handle_events()
        self._update()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._update()

    def pause_writing(self) -> None:
        """Wait for the client to read."""
        super().pause_writing()
        self._moved += self.transport.get_write_buffer_size()
        self._update()

    def resume_writing(self) -> None:
        """Go on after the client has read everything."""
        super().resume_writing()
        self._update()

    def shutdown(self) -> None:
        """Let the client finish its exchange, for a moment."""
        super().shutdown()
        self.loop.call_later(_ENDING_SECONDS, self.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the slot."""
        super().connection_lost(exc)
        self._connections.close(self)
        self._set_deadline(None)

    @property
    def _is_between_requests(self) -> bool:
        """Whether none is in progress, and h11 has no part of one."""
        h11_waits = self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]
        return self._phase == "waiting" and h11_waits

    def _take(self, request: StepRequest) -> bytes | None:
        try:
            return self._connections.take_steps(request)
        except Exception:  # the application takes the same steps again, or says what fails
            return None

    def _update(self) -> None:
        """Enter the present phase."""
        idle = self.cycle is None or self.cycle.response_complete
        phase: _Phase = "writing" if self.flow.write_paused else "waiting" if idle else "working"
        self._enter(phase)

    def _enter(self, phase: _Phase) -> None:
        """Enter a phase; the deadline of one that lasts is not extended."""
        if phase == self._phase:
            return
        if "waiting" in (phase, self._phase):
            self._started = self.loop.time()
        if phase == "waiting":
            self._moved = 0
        self._phase = phase
        self._connections.enter(self, phase)
        limits = self._connections.limits
        seconds = {"waiting": limits.head_seconds, "writing": limits.stalled_seconds}
        self._set_deadline(seconds.get(phase))

    def _set_deadline(self, seconds: float | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.abort)

"""What a sealed-online season's server and its clients send each other, and a client's connection.

    POST /api/seasons/{id}/tickets                 a ticket
    GET  …/tickets/{n}                             its status
    POST …/tickets/{n}/instances/{i}/start?lanes=L begin, or go on
    POST …/instances/{i}/steps?signature=          one step of all lanes
    POST …/instances/{i}/finish?signature=         take no more steps
    GET  …/instances/{i}/challenge                 challenge states, .npy
    PUT  …/instances/{i}/answers?signature=        an action for each, .npy
    POST …/tickets/{n}/end?signature=              the ticket's end

Each but the first has the ticket's token as `Authorization: Bearer`. Every request may be repeated
after a lost answer: none has a further effect. Numbers are little-endian; L are the lanes, S and A
the state and action channels.

    start, answer    uint64 number of the last steps, float32 [L, S + 2] present observations
    steps, request   uint64 number: 1, 2, …           float32 [L, A] actions in [0, 1]
    steps, answer                                     float32 [L, 2(S + 2) + 2] in the columns

        S + 2    observation, of the next episode where this step ended one
        1        reward
        1        ends: 0 none, 1 terminated, 2 truncated, 3 both
        S + 2    last observation of the episode that ended; 0 where none did

So no size depends on a state. The same steps with the same number get the same answer; other
actions with that number, and numbers further ahead, are refused.

Arrays travel as .npy files of version 1.0, type `<f4`, C order and two axes; nothing else is read.

Entrant and server each compute the `transcript` of an instance, and the entrant signs it:

    signature = Ed25519(key, "sme-leaderboard/answers/" board "/" address "/" digest of the `Head`)

`steps` needs that of the requests before where their number is a multiple of 256, `finish` that of
all, `answers` that of the answers, too, and `end` one of the `TicketHeads`.

The request for the ticket names the key's public half, and is signed by the entrant's own key. The
ticket's file has the private half, so that a machine can step and answer without the entrant's.
"""

from __future__ import annotations

import contextlib
import http.client
import logging
import os
import random
import re
import ssl
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NamedTuple, TypeVar
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import numpy as np
import numpy.typing as npt
from pydantic import Field, PrivateAttr

from sme_registry.errors import (
    ActionError,
    BudgetSpentError,
    MalformedDocumentError,
    OptionError,
    SealedError,
    WireError,
)
from sme_registry.io import (
    integer_in,
    number_in,
    parse_json,
    read_json,
    server_address,
    to_json,
)
from sme_registry.io.files import atomic_file, unwritable
from sme_registry.seasons.transcript import Count, Hex, Signer
from sme_registry.spec import Setting
from sme_registry.spec.document import Integer, Name, StrictModel, TupleOf
from sme_registry.task.task import Mask, Observation

Float32 = npt.NDArray[np.float32]

TERMINATED, TRUNCATED = 1, 2
_FLOAT, _NUMBER_BYTES = np.dtype("<f4"), 8
_MAGIC = b"\x93NUMPY\x01\x00"
_MAX_HEADER = 1024
_HEADER = re.compile(
    rb"\{'descr': '<f4', 'fortran_order': False, 'shape': \((\d{1,9}), (\d{1,9})\), \} *\n"
)
_Secret = Annotated[Hex, Field(repr=False)]


MAX_INSTANCES = 1000
"""Of all classes: a ticket has a run on each."""

MAX_LANES = 256
"""Of an instance that the server steps: the most copies that one request advances."""


class HiddenClass(StrictModel):
    """One kind of hidden task.

    Attributes:
      setting: all of a spec but its seed.
      instances: number of hidden tasks.
    """

    name: Name
    setting: Setting
    instances: Annotated[Integer, Field(ge=1, le=MAX_INSTANCES)]


class TicketClass(HiddenClass):
    budget: Annotated[Integer, Field(ge=1)]  # steps on each instance, over all lanes


_Class = TypeVar("_Class", bound=HiddenClass)


class Hidden(NamedTuple, Generic[_Class]):
    """One hidden instance: its class and its number in it, from 0."""

    member: _Class
    instance: int

    @property
    def name(self) -> str:
        """What files and commands call it, such as `deep-0`."""
        return f"{self.member.name}-{self.instance}"


def instances_of(classes: Iterable[_Class]) -> Iterator[Hidden[_Class]]:
    """Every hidden instance, class by class."""
    for member in classes:
        for instance in range(member.instances):
            yield Hidden(member, instance)


class Ticket(StrictModel):
    """The answer to a request for a ticket, and the file that an entrant keeps of it.

    Attributes:
      season: the season's id.
      ticket: its number in the season.
      token: the password for its instances; whoever has it can take the steps.
      deadline: until when answers count, in UTC.
      lanes: the most copies of an instance that are stepped together.
      classes: instance i of the ticket counts over all of them, class by class.
      signer: signs the answers; null in a server's answer, which does not know the key.

    Examples:
      >>> from sme_registry.seasons import Ticket
      >>> [place.name for place in Ticket.read("ticket.json").places]
      ['deep-0', 'deep-1']
    """

    season: Name
    ticket: Count
    token: _Secret
    deadline: Annotated[str, Field(max_length=40)]
    lanes: Annotated[Integer, Field(ge=1, le=MAX_LANES)]
    classes: Annotated[TupleOf[TicketClass], Field(min_length=1, max_length=MAX_INSTANCES)]
    signer: Signer | None = None
    _path: Path | None = PrivateAttr(None)  # of its file

    @property
    def path(self) -> Path:
        """Its file, beside which transcripts are kept."""
        if self._path is None:
            raise OptionError(
                "ticket: is in no file, beside which transcripts are kept. Write it first, or give "
                "the path of its file."
            )
        return self._path

    @property
    def places(self) -> Iterator[Hidden[TicketClass]]:
        return instances_of(self.classes)

    def place(self, instance: int) -> Hidden[TicketClass]:
        places = list(self.places)
        return places[integer_in("instance", instance, 0, len(places) - 1)]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Ticket:
        ticket = cls.from_dict(read_json(path), os.fspath(path))
        ticket._path = Path(path)
        return ticket

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the ticket into a new file that only its owner can read."""
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path, new=True) as stream:
                with contextlib.suppress(OSError, AttributeError):  # no modes on this system
                    os.fchmod(stream.fileno(), 0o600)
                stream.write(to_json(self.to_dict()).encode())
        except FileExistsError:
            raise OptionError(
                f"{path} already exists and is not replaced: its token is in no other file. Give "
                "another path."
            ) from None
        except OSError as error:
            raise unwritable(path, error) from None
        self._path = path
        return path


class InstanceStatus(StrictModel):
    phase: Literal["waiting", "stepping", "answering", "answered"]
    lanes: Annotated[Integer, Field(ge=1, le=MAX_LANES)] | None  # null before `start`
    requests: Count  # number of the last steps that were taken
    used: Count  # steps of the budget that were taken, over all lanes


class TicketStatus(StrictModel):
    """The answer to a request for a ticket's status."""

    ticket: Count  # its number in the season
    phase: Literal["running", "ended"]  # ended: every instance is answered, or the deadline over
    deadline: Annotated[str, Field(max_length=40)]  # until when answers count, in UTC
    instances: TupleOf[InstanceStatus]  # in the ticket's order


def tickets_path(season: str) -> str:
    return f"/api/seasons/{season}/tickets"


def ticket_path(season: str, ticket: int) -> str:
    return f"{tickets_path(season)}/{ticket}"


def instance_path(season: str, ticket: int, instance: int, action: str) -> str:
    """The address of an action on an instance, such as `start` or `steps`."""
    return f"{ticket_path(season, ticket)}/instances/{instance}/{action}"


class StepsAnswer(NamedTuple):
    observation: Observation  # `[L, S + 2]`, of the next episode in lanes whose episode ended
    reward: Float32  # `[L]`
    terminated: Mask  # `[L]`
    truncated: Mask  # `[L]`
    last_observation: Observation  # `[L, S + 2]` of the episode that ended; 0 in the other lanes


@dataclass(frozen=True)
class StepFormat:
    """The messages of an instance that is stepped in some number of lanes."""

    lanes: int
    state_dim: int
    action_dim: int

    @property
    def request_bytes(self) -> int:
        return _NUMBER_BYTES + _FLOAT.itemsize * self.lanes * self.action_dim

    @property
    def answer_bytes(self) -> int:
        return _FLOAT.itemsize * self.lanes * (2 * self._width + 2)

    @property
    def _width(self) -> int:
        return self.state_dim + 2

    def pack(self, number: int, array: npt.NDArray[np.floating]) -> bytes:
        """The present observations, or a request with actions; with the number of the steps."""
        return number.to_bytes(_NUMBER_BYTES, "little") + _pack(array)

    def unpack_start(self, data: bytes) -> tuple[int, Observation]:
        """The number of the last steps, and the present observations `[L, S + 2]`."""
        return _unpack_numbered("start", data, self.lanes, self._width)

    def unpack_request(self, data: bytes) -> tuple[int, Float32]:
        """The number and the actions `[L, A]` in the body of `steps`; finite, not clipped."""
        number, actions = _unpack_numbered("steps", data, self.lanes, self.action_dim)
        _check_finite(actions)
        return number, actions

    def pack_steps(self, steps: StepsAnswer) -> bytes:
        ends = TERMINATED * steps.terminated + TRUNCATED * steps.truncated
        columns = steps.observation, steps.reward, ends, steps.last_observation
        return _pack(np.column_stack(columns))

    def unpack_steps(self, data: bytes) -> StepsAnswer:
        _check_size("steps", data, self.answer_bytes)
        width = self._width
        table = np.array(np.frombuffer(data, _FLOAT).reshape(self.lanes, -1), np.float32)
        ends = table[:, width + 1]
        if not np.isin(ends, (0, 1, 2, 3)).all():
            raise WireError(
                "steps: the ends of episodes must be 0, 1, 2 or 3. Check the server's version."
            )
        flags = ends.astype(np.int8)
        return StepsAnswer(
            observation=table[:, :width].copy(),
            reward=table[:, width].copy(),
            terminated=(flags & TERMINATED).astype(bool),
            truncated=(flags & TRUNCATED).astype(bool),
            last_observation=table[:, width + 2 :].copy(),
        )


def pack_table(table: npt.NDArray[np.floating]) -> bytes:
    """A table `[rows, columns]` as the bytes of an .npy file of float32."""
    rows, columns = table.shape
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}"
    # The data begin at a multiple of 64 bytes, as the format asks.
    padding = -(len(_MAGIC) + 2 + len(text) + 1) % 64
    header = text.encode() + b" " * padding + b"\n"
    return _MAGIC + len(header).to_bytes(2, "little") + header + _pack(table)


def table_bytes(rows: int, columns: int) -> int:
    """The most bytes that the .npy file of a table of this shape has."""
    return len(_MAGIC) + 2 + _MAX_HEADER + _FLOAT.itemsize * rows * columns


def unpack_table(data: bytes, columns: int, rows: int | None = None) -> Float32:
    """The table `[rows, columns]` in the bytes of an .npy file, finite; `rows` None accepts any."""
    start = len(_MAGIC) + 2
    size = int.from_bytes(data[len(_MAGIC) : start], "little")
    header = _HEADER.fullmatch(data, start, start + size) if size <= _MAX_HEADER else None
    if not data.startswith(_MAGIC) or header is None:
        raise WireError(
            "array: must be an .npy file of version 1.0 with an array of type '<f4', in C order "
            "and with two axes. Write it with numpy.save(file, array.astype('<f4'))."
        )
    shape = int(header[1]), int(header[2])
    wanted = shape[0] if rows is None else rows, columns
    if shape != wanted:
        raise WireError(f"array of shape {shape}: must be of shape {wanted}.")
    _check_size("array", data, start + size + _FLOAT.itemsize * shape[0] * shape[1])
    entries = np.frombuffer(data, _FLOAT, offset=start + size)
    _check_finite(entries)
    return np.array(entries.reshape(shape), np.float32)  # in this machine's byte order


def _pack(array: npt.NDArray[np.floating]) -> bytes:
    return array.astype(_FLOAT, copy=False).tobytes()


def _unpack_numbered(what: str, data: bytes, rows: int, columns: int) -> tuple[int, Float32]:
    _check_size(what, data, _NUMBER_BYTES + _FLOAT.itemsize * rows * columns)
    array = np.frombuffer(data, _FLOAT, offset=_NUMBER_BYTES).reshape(rows, columns)
    return int.from_bytes(data[:_NUMBER_BYTES], "little"), np.array(array, np.float32)


def _check_size(what: str, data: bytes, expected: int) -> None:
    if len(data) != expected:
        raise WireError(f"{what}: has {len(data):,} bytes: must have {expected:,}.")


def _check_finite(numbers: Float32) -> None:
    if not np.isfinite(numbers).all():
        raise ActionError("array: has NaN or infinite entries. Give finite numbers.")


PATIENCE = 900.0
_FIRST_PATIENCE = 5.0  # a mistyped URL shall not wait for a server that does not exist
_TIMEOUT = 300.0  # to accept a connection, or send more: a restarted server replays all steps
_FIRST_WAIT, _LONGEST_WAIT = 0.1, 15.0
_TRANSIENT = frozenset({408, 502, 503, 504, 507})
_JSON_BYTES = 2**20

_log = logging.getLogger(__name__)
_now, _sleep = time.monotonic, time.sleep


class Connection:
    """An HTTP connection to a board, kept open between requests. Not for several threads.

    From the first answer on, a request is repeated for `patience` seconds. A server may be hostile:
    an answer is its raw bytes, up to a limit, and neither a coding nor a redirect is followed.
    """

    def __init__(
        self, url: str, token: str = "", *, insecure: bool = False, patience: float = PATIENCE
    ) -> None:
        self._http: http.client.HTTPConnection | None = None
        self._address = server_address(url, insecure=insecure)
        self._patience = number_in("patience", patience, 0.0)
        self._authorization = f"Bearer {token}"
        self._answered = False

    def request(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        *,
        most: int = 0,
        sign: Callable[[], str] | None = None,
    ) -> bytes:
        """The body of the answer, of at most `most` bytes, or a MiB.

        `sign` returns its `Authorization`, anew for each attempt.
        """
        wait, started = _FIRST_WAIT, _now()
        while True:
            reused = self._http is not None
            try:
                headers = {"Authorization": sign() if sign else self._authorization}
                status, data = self._exchange(method, path, body, headers, max(most, _JSON_BYTES))
            except ssl.SSLCertVerificationError as error:
                raise SealedError("unreachable", f"{self._address.url}: {error}.") from None
            except (OSError, http.client.HTTPException) as error:
                reason = str(error) or type(error).__name__
                if reused:  # a server closes connections that have been idle
                    continue
            else:
                self._answered = True
                if 200 <= status < 300:
                    return data
                code, message = self._reason_in(data, status)
                if status not in _TRANSIENT:
                    kind = BudgetSpentError if code == "budget_spent" else SealedError
                    raise kind(code, message)
                reason = f"{code}: {message}"
            patience = self._patience if self._answered else min(self._patience, _FIRST_PATIENCE)
            if _now() + wait > started + patience:
                raise SealedError(
                    "unreachable",
                    f"{self._address.url}: gives no answer: {reason:.500} Check the URL and try "
                    "again: nothing is lost, or done twice.",
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

    def _exchange(
        self, method: str, path: str, body: bytes, headers: dict[str, str], most: int
    ) -> tuple[int, bytes]:
        if self._http is None:
            self._http = self._new()
        try:
            headers |= {"Accept": "application/json", "Content-Type": "application/octet-stream"}
            self._http.request(method, self._address.path + path, body, headers)
            with self._http.getresponse() as answer:
                data = answer.read(most + 1)
                if len(data) > most:
                    raise SealedError(
                        "wire",
                        f"{self._address.url}: answered with more than {most:,} bytes. Check the "
                        "URL.",
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
        """A connection, through the proxy that the environment names, if there is one."""
        address = self._address
        if not address.is_https:
            return http.client.HTTPConnection(address.host, address.port, timeout=_TIMEOUT)
        proxy = urlsplit(getproxies().get("https", ""))
        if address.is_local or not proxy.hostname or proxy_bypass(address.host):
            return http.client.HTTPSConnection(address.host, address.port, timeout=_TIMEOUT)
        connection = http.client.HTTPSConnection(proxy.hostname, proxy.port, timeout=_TIMEOUT)
        connection.set_tunnel(address.host, address.port)
        return connection

    def _reason_in(self, data: bytes, status: int) -> tuple[str, str]:
        """Code and message of a refusal, on one line of limited length."""
        plain: Any = None
        with contextlib.suppress(MalformedDocumentError):
            plain = parse_json(data, "answer")
        match plain:
            case {"code": str(code), "message": str(message)}:
                return code[:40], " ".join(message[:2000].split())
        return "http", f"{self._address.url}: answered with HTTP status {status}. Check the URL."

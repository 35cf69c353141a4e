"""`Instance`: one hidden task of a ticket, stepped and answered over the network.

Its `Connection` repeats requests until they are answered. No request of this protocol has a further
effect when it is repeated (`wire`), so a lost connection or a server that is being restarted costs
time and nothing else.
"""

from __future__ import annotations

import hashlib
import http.client
import logging
import os
import random
import ssl
import time
from typing import Any, TypeVar
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import numpy as np
import numpy.typing as npt

from sme_registry.errors import (
    BudgetSpentError,
    MalformedDocumentError,
    PolicyError,
    SealedError,
    SpecError,
)
from sme_registry.evaluation import Policy, as_policy
from sme_registry.evaluation.references import POLICIES
from sme_registry.evaluation.regions import batch_rows
from sme_registry.io import (
    integer_in,
    number_in,
    parse_json,
    printable,
    server_address,
    sha256_of,
)
from sme_registry.seasons.wire import (
    Float32,
    JournalDigest,
    Statement,
    StepFormat,
    StepsAnswer,
    Ticket,
    TicketStatus,
    bearer,
    instance_path,
    pack_table,
    require_signatures,
    ticket_path,
    unpack_table,
)
from sme_registry.spec import Setting, SMESpec
from sme_registry.spec.document import StrictModel

PATIENCE = 900.0
_FIRST_PATIENCE = 5.0  # a mistyped URL shall not wait for a server that does not exist
_TIMEOUT = 300.0  # to accept a connection, or send more: a restarted server replays all steps
_FIRST_WAIT, _LONGEST_WAIT = 0.1, 15.0
_TRANSIENT = frozenset({408, 502, 503, 504, 507})
_JSON_BYTES = 2**20
_TYPE = "application/octet-stream"

_log = logging.getLogger(__name__)
_now, _sleep = time.monotonic, time.sleep

TicketLike = Ticket | str | os.PathLike[str]
_Document = TypeVar("_Document", bound=StrictModel)

WITHOUT_TASK = ("constant", "constant_half", "random", "uniform_random")
"""Reference policies that are the same on each task."""


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
            return http.client.HTTPConnection(address.host, address.port, timeout=_TIMEOUT)
        proxy = urlsplit(getproxies().get("https", ""))
        if address.is_local or not proxy.hostname or proxy_bypass(address.host):
            return http.client.HTTPSConnection(address.host, address.port, timeout=_TIMEOUT)
        connection = http.client.HTTPSConnection(proxy.hostname, proxy.port, timeout=_TIMEOUT)
        connection.set_tunnel(address.host, address.port)
        return connection


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


class Instance:
    """A hidden task of a ticket, as its server shows it: observations, rewards and ends.

    Whoever holds the ticket may stop at any time and go on elsewhere: the server knows the present
    states. But only one process at a time can step an instance.

    Attributes:
      setting: all of the task's spec but its seed.
      budget: steps over all lanes.
      lanes: L, copies that are stepped together; fixed after the first step.
      number: of the last steps that were taken; 0 before the first.

    Examples:
      >>> from sme_registry.seasons import Instance
      >>> Instance("https://board.example", "ticket.json", lanes=4).setting.complexity
      10
    """

    def __init__(
        self,
        url: str,
        ticket: TicketLike,
        instance: int = 0,
        lanes: int = 1,
        *,
        insecure: bool = False,
        patience: float = PATIENCE,
    ) -> None:
        ticket = ticket if isinstance(ticket, Ticket) else Ticket.read(ticket)
        member = ticket.place(instance).member
        self.setting: Setting = member.setting
        self.budget = member.budget
        self.number = 0
        self.lanes = integer_in("lanes", lanes, 1, ticket.lanes)
        self._format = StepFormat(self.lanes, self.setting.state_dim, self.setting.action_dim)
        self._ticket, self._instance = ticket, instance
        self._taken: hashlib._Hash | None = None  # of all steps, if this process knows them
        self._connection = Connection(url, ticket.token, insecure=insecure, patience=patience)

    @property
    def steps_left(self) -> int:
        """Steps of the budget that are left, over all lanes."""
        return self.budget - self.number * self.lanes

    def begin(self) -> Float32:
        """Begin, or go on: the present observations `[L, S + 2]`.

        They are those of the first episodes, or those after the last steps that the server took for
        this instance, whichever process asked for them.
        """
        data = self._request("POST", f"start?lanes={self.lanes}", most=self._format.answer_bytes)
        number, observation = self._format.unpack_start(data)
        if number == 0:
            self._taken = hashlib.sha256()
        elif number != self.number:
            self._taken = None
        self.number = number
        return observation

    def step(self, actions: npt.NDArray[np.floating]) -> StepsAnswer:
        """One step of every lane by finite actions `[L, A]` in [0, 1]; call `begin` first."""
        body = self._format.pack_request(self.number + 1, actions)
        try:
            data = self._request("POST", "steps", body, most=self._format.answer_bytes)
        except SealedError as error:
            if error.code not in ("step_conflict", "step_ahead"):
                raise
            raise SealedError(
                error.code,
                f"{error.message} Call `begin` (of an environment, `reset`) to go on from the "
                "present observation; no other process may step the instance.",
            ) from None
        self.number += 1
        if self._taken is not None:
            self._taken.update(body)
        return self._format.unpack_steps(data)

    def challenge(self) -> Float32:
        """End the stepping, and return the challenge states: observations `[rows, S + 2]`."""
        if self._ticket.signer is not None:
            require_signatures()  # before the stepping ends for good
        self._request("POST", "finish")
        data = self._request("GET", "challenge", most=2**31)
        return unpack_table(data, self.setting.state_dim + 2)

    def send_answers(self, actions: npt.NDArray[np.floating]) -> None:
        """Sign and send the actions `[rows, A]`; the last instance's end the ticket.

        The server refuses others than those it has. Nothing is signed if its journal has other
        steps than this object has taken.
        """
        data, signer = pack_table(actions), self._ticket.signer
        if signer is None:
            self._request("PUT", "answers", data)
            return
        statement = Statement(
            request=signer.request,
            ticket=self._ticket.ticket,
            instance=self._instance,
            answers=sha256_of(data),
            journal=self._journal_digest(),
        )
        self._request("PUT", f"answers?signature={signer.sign(statement)}", data)

    def status(self) -> TicketStatus:
        """The status of the whole ticket."""
        path = ticket_path(self._ticket.season, self._ticket.ticket)
        data = self._connection.request("GET", path, most=2**22)
        return _parse_answer(TicketStatus, data)

    def __enter__(self) -> Instance:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def _journal_digest(self) -> str:
        """That of the server's journal, compared with the steps as far as they are known here."""
        digest = _parse_answer(JournalDigest, self._request("GET", "journal")).journal
        if self._taken is not None and digest != f"sha256:{self._taken.hexdigest()}":
            raise SealedError(
                "journal",
                f"journal: the server's, {digest[:19]}…, is not of the steps that were taken here, "
                "so it is not signed. If another process has stepped the instance, call `begin` "
                "to accept its steps; otherwise ask the board's owner.",
            )
        return digest

    def _request(self, method: str, action: str, body: bytes = b"", *, most: int = 0) -> bytes:
        ticket = self._ticket
        path = instance_path(ticket.season, ticket.ticket, self._instance, action)
        return self._connection.request(method, path, body, most=most)


def answer(
    url: str,
    ticket: TicketLike,
    policy: Any,
    instance: int = 0,
    *,
    action_range: str | None = None,
    algorithm: str | None = None,
    insecure: bool = False,
    patience: float = PATIENCE,
) -> None:
    """End an instance's stepping, and send a policy's actions in its challenge states.

    The other arguments are those of `make` and `prepare_policy`.

    Examples:
      >>> from sme_registry.seasons import answer
      >>> answer("https://board.example", "ticket.json", "constant", instance=2)
      Traceback (most recent call last):
      ...
      sme_registry.errors.OptionError: instance=2: must be an integer in [0, 1].
    """
    with Instance(url, ticket, instance, insecure=insecure, patience=patience) as hidden:
        prepared = prepare_policy(  # before the stepping ends for good
            policy, hidden.setting, action_range=action_range, algorithm=algorithm
        )
        hidden.send_answers(actions_in(hidden.challenge(), prepared, hidden.setting))


def prepare_policy(
    policy: Any,
    setting: Setting,
    *,
    action_range: str | None = None,
    algorithm: str | None = None,
) -> Policy:
    """A policy for the hidden tasks of a setting; arguments as `evaluate` accepts them.

    A reference policy that depends on the hidden task is refused.

    Examples:
      >>> from sme_registry.seasons import prepare_policy
      >>> from sme_registry.spec import Setting
      >>> prepare_policy("constant", Setting())(np.zeros((1, 10), np.float32))
      array([[0.5, 0.5, 0.5, 0.5]])
    """
    if isinstance(policy, str) and policy in POLICIES and policy not in WITHOUT_TASK:
        raise PolicyError(
            f"policy={policy!r}: follows from the task, which is hidden. Give a policy of your "
            "own, constant_half or uniform_random."
        )
    prepared = as_policy(policy, _any_spec(setting), action_range=action_range, algorithm=algorithm)
    assert isinstance(prepared, Policy)  # seasons have no teams
    return prepared


def actions_in(states: Float32, policy: Any, setting: Setting) -> Float32:
    """A policy's actions `[rows, A]` in challenge states `[rows, S + 2]`: finite, not clipped.

    Examples:
      >>> from sme_registry.seasons import actions_in
      >>> from sme_registry.spec import Setting
      >>> actions_in(np.zeros((3, 10), np.float32), "constant", Setting()).shape
      (3, 4)
    """
    prepared, rows = prepare_policy(policy, setting), batch_rows(_any_spec(setting))
    batches = [prepared(states[at : at + rows].copy()) for at in range(0, len(states), rows)]
    return np.concatenate([np.empty((0, setting.action_dim)), *batches]).astype(np.float32)


def _any_spec(setting: Setting) -> SMESpec:
    """A task of this setting, for its widths: that of the hidden ones."""
    return SMESpec.from_dict({**setting.to_dict(), "seed": 0})


def _parse_answer(kind: type[_Document], data: bytes) -> _Document:
    try:
        return kind.from_dict(parse_json(data, "answer"))
    except (MalformedDocumentError, SpecError) as error:
        raise SealedError(
            "wire", f"the server's answer is invalid: {error} Check its version."
        ) from None

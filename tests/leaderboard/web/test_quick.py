"""Steps that the server answers without its application, however their bytes arrive."""

from __future__ import annotations

import contextlib
import http.client
import itertools
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from urllib.parse import urlsplit

import numpy as np
import pytest

from leaderboard.documents.keys import SigningKey
from leaderboard.sealed import Tickets
from leaderboard.web.connections import ConnectionLimits, Connections
from leaderboard.web.quick import step_request
from leaderboard.web.seasons import SeasonRoutes
from sme_registry import sealed
from tests.leaderboard.sealed.playing import Board, online_board
from tests.leaderboard.serving import serving

PATIENCE = 60.0
WIRE = sealed.StepFormat(4, 2, 1)
BODY = WIRE.pack_request(1, np.full((4, 1), 0.5, np.float32))
PATH = sealed.instance_path("autumn_2", 12, 3, "steps")
HEAD = (
    f"POST {PATH} HTTP/1.1\r\nHost: board.example\r\nAuthorization: Bearer ab\r\n"
    f"Content-Length: {len(BODY)}\r\n\r\n"
).encode()


class Stepped(NamedTuple):
    """A served ticket whose first instance has begun."""

    url: str
    board: Board
    ticket: sealed.Ticket

    def request(self, number: int, token: str = "") -> bytes:
        """A request for steps."""
        path = sealed.instance_path(self.ticket.season, self.ticket.ticket, 0, "steps")
        body = WIRE.pack_request(number, np.full((4, 1), 0.5, np.float32))
        head = HEAD.replace(PATH.encode(), path.encode())
        return head.replace(b"Bearer ab", f"Bearer {token or self.ticket.token}".encode()) + body

    def connect(self) -> socket.socket:
        """A connection to the server."""
        parts = urlsplit(self.url)
        assert parts.hostname is not None
        assert parts.port is not None
        connection = socket.create_connection((parts.hostname, parts.port), PATIENCE)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    @property
    def used(self) -> int:
        """Steps of the budget that are used."""
        with sealed.Instance(self.url, self.ticket, 0, 4) as instance:
            return instance.status().instances[0].used


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Board:
    return online_board(tmp_path_factory.mktemp("quick"), tickets_per_key=100, tickets=100)


@pytest.fixture(scope="module")
def connections() -> Connections:
    return Connections()


@pytest.fixture(scope="module")
def url(board: Board, connections: Connections) -> Iterator[str]:
    with serving(board.path, connections, season_secrets=[board.secret]) as url:
        yield url


@pytest.fixture
def stepped(url: str, board: Board) -> Stepped:
    return begun(url, board)


def begun(url: str, board: Board) -> Stepped:
    ticket = board.ticket(url, SigningKey.generate())
    with sealed.Instance(url, ticket, 0, lanes=4) as instance:
        instance.begin()
    return Stepped(url, board, ticket)


def answer_on(connection: socket.socket) -> tuple[int, bytes]:
    """Status and body of the next answer."""
    with http.client.HTTPResponse(connection) as answer:
        answer.begin()
        return answer.status, answer.read()


def test_no_cache_keeps_an_answer_and_no_browser_guesses_its_type(stepped: Stepped) -> None:
    with stepped.connect() as connection:
        connection.sendall(stepped.request(1))
        with http.client.HTTPResponse(connection) as answer:
            answer.begin()
            headers = dict(answer.headers)
    assert {
        "content-type": "application/octet-stream",
        "cache-control": "no-store",
        "x-content-type-options": "nosniff",
    }.items() <= headers.items()


def test_a_plain_request_is_read() -> None:
    extra = b"content-type: x\r\nX-Forwarded-For: 203.0.113.7\r\nConnection: Keep-Alive\r\n\r\n"
    for head in (HEAD, HEAD[:-2] + extra):
        request = step_request(head + BODY)
        assert request == ("autumn_2", 12, 3, "Bearer ab", BODY, 0)
    assert step_request(HEAD + BODY[:5]) == ("autumn_2", 12, 3, "Bearer ab", BODY[:5], 19)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("POST", "GET"),
        ("HTTP/1.1", "HTTP/1.0"),
        ("steps HTTP", "steps?x HTTP"),
        ("steps HTTP", "start HTTP"),
        ("autumn_2", "autumn%5f2"),
        ("autumn_2", "../autumn_2"),
        ("/12/", "/1234567890/"),
        ("/12/", "/١/"),
        ("Host: board.example\r\n", ""),
        ("Content-Length: 24\r\n", ""),
        ("Length: 24", "Length: 024"),
        ("Length: 24", "Length: +24"),
        ("Length: 24", "Length: 24, 24"),
        ("Length: 24", "Length: 23"),
        ("Length: 24", "Length: 0"),
        ("Length: 24", "Length: 100000"),
        ("Length: 24", "Length : 24"),
        ("Length: 24", "Length:\t24"),
        ("Length: 24", "Length: 24\r\nContent-Length: 24"),
        ("Length: 24", "Length: 24\r\ncontent-length: 5"),
        ("Length: 24", "Length: 24\r\nTransfer-Encoding: chunked"),
        ("Length: 24", "Length: 24\r\nExpect: 100-continue"),
        ("Length: 24", "Length: 24\r\nConnection: close"),
        ("Length: 24", "Length: 24\r\nUpgrade: websocket"),
        ("Length: 24", "Length: 24\r\nX-Unknown: 1"),
        ("Length: 24", "Length: 24\r\n folded"),
        ("Length: 24", "Length: 24\nAccept: x"),
        ("Bearer ab", "Bearer \xe9"),
        ("\r\n\r\n", "\r\n"),
    ],
)
def test_nothing_but_a_plain_request_is_read(old: str, new: str) -> None:
    head = HEAD.decode()
    assert old in head
    assert step_request(head.replace(old, new).encode() + BODY) is None


def test_a_second_request_is_left_to_the_application() -> None:
    assert step_request(2 * (HEAD + BODY)) is None


@pytest.mark.parametrize("pieces", [1, 2, 3])
def test_steps_need_no_application(
    stepped: Stepped, pieces: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where head and body arrive one after the other, as many clients send them."""
    monkeypatch.delattr(SeasonRoutes, "place")
    with stepped.connect() as connection:
        for number in (1, 2, 2, 3):
            request = stepped.request(number)
            body = len(request) - len(BODY)
            cuts = [*[0, body, body + 5][:pieces], len(request)]
            for start, end in itertools.pairwise(cuts):
                connection.sendall(request[start:end])
            status, steps = answer_on(connection)
            assert (status, len(steps)) == (200, WIRE.answer_bytes)
    assert stepped.used == 12


def test_what_is_refused_is_answered_by_the_application(stepped: Stepped) -> None:
    with stepped.connect() as connection:
        connection.sendall(stepped.request(2))
        status, text = answer_on(connection)
    assert (status, b"step_ahead" in text) == (409, True)
    with stepped.connect() as connection:
        connection.sendall(stepped.request(1, token="ab"))
        status, text = answer_on(connection)
    assert (status, b"token_wrong" in text) == (403, True)
    assert stepped.used == 0


@pytest.mark.parametrize("size", [1, 100, 10_000])
def test_requests_on_end_are_answered_in_their_order(stepped: Stepped, size: int) -> None:
    """However they are cut into pieces."""
    data = b"".join(map(stepped.request, range(1, 9)))
    with stepped.connect() as connection:
        for start in range(0, len(data), size):
            connection.sendall(data[start : start + size])
        with connection.makefile("rb") as stream:
            answers = [next_body(stream) for _ in range(8)]
    assert stepped.used == 32
    assert len(set(answers)) == 8


def next_body(stream: BinaryIO) -> bytes:
    """The body of the next answer, and nothing of those behind it."""
    while (line := stream.readline()) != b"\r\n":
        if line.lower().startswith(b"content-length:"):
            size = int(line.partition(b":")[2])
    return stream.read(size)


def test_the_body_of_another_request_takes_no_steps(stepped: Stepped) -> None:
    body = stepped.request(1)
    head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n"
    with stepped.connect() as connection:
        connection.sendall(head + b"Content-Length: %d\r\n\r\n" % len(body))
        assert connection.recv(100).startswith(b"HTTP/1.1 100 ")
        connection.sendall(body)
        assert answer_on(connection)[0] == 400
    assert stepped.used == 0


def test_steps_that_fail_are_taken_once_by_the_application(
    stepped: Stepped, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = Tickets.quick_step

    def fails(*arguments: object) -> bytes:
        take(*arguments)  # type: ignore[arg-type]
        raise MemoryError

    monkeypatch.setattr(Tickets, "quick_step", fails)
    with stepped.connect() as connection:
        for number in (1, 2):
            connection.sendall(stepped.request(number))
            assert answer_on(connection)[0] == 200
    assert stepped.used == 8


def test_a_body_that_does_not_come_has_a_deadline(
    stepped: Stepped, connections: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "limits", ConnectionLimits(head_seconds=0.2))
    with stepped.connect() as connection:
        connection.sendall(stepped.request(1)[:-1])
        with contextlib.suppress(ConnectionResetError):
            assert connection.recv(1) == b""
    assert stepped.used == 0


def test_who_steps_waits_anew_after_each_answer(tmp_path: Path) -> None:
    """And so keeps its slot before one that was silent meanwhile."""
    health = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
    board = online_board(tmp_path)
    connections = Connections(ConnectionLimits(connections=2))
    with serving(board.path, connections, season_secrets=[board.secret]) as url:
        stepped = begun(url, board)
        with stepped.connect() as stepping, stepped.connect() as silent:
            silent.sendall(health)
            assert answer_on(silent)[0] == 200
            stepping.sendall(stepped.request(1))
            assert answer_on(stepping)[0] == 200
            with stepped.connect() as new:
                new.sendall(health)
                assert answer_on(new)[0] == 200
            assert silent.recv(1) == b""
            stepping.sendall(stepped.request(2))
            assert answer_on(stepping)[0] == 200

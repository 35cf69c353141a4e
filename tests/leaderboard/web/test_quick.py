"""Steps that the server answers without its application, however their bytes arrive."""

from __future__ import annotations

import contextlib
import http.client
import itertools
import socket
from typing import NamedTuple
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

    def request(self, number, token=""):
        """A request for steps."""
        path = sealed.instance_path(self.ticket.season, self.ticket.ticket, 0, "steps")
        body = WIRE.pack_request(number, np.full((4, 1), 0.5, np.float32))
        head = HEAD.replace(PATH.encode(), path.encode())
        return head.replace(b"Bearer ab", f"Bearer {token or self.ticket.token}".encode()) + body

    def connect(self):
        """A connection to the server."""
        parts = urlsplit(self.url)
        assert parts.hostname is not None
        assert parts.port is not None
        connection = socket.create_connection((parts.hostname, parts.port), PATIENCE)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    @property
    def used(self):
        """Steps of the budget that are used."""
        with sealed.Instance(self.url, self.ticket, 0, 4) as instance:
            return instance.status().instances[0].used


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return online_board(tmp_path_factory.mktemp("quick"), tickets_per_key=100, tickets=100)


@pytest.fixture(scope="module")
def connections():
    return Connections()


@pytest.fixture(scope="module")
def url(board, connections):
    with serving(board.path, connections, season_secrets=[board.secret]) as url:
        yield url


def begun(url, board):
    ticket = board.ticket(url, SigningKey.generate())
    with sealed.Instance(url, ticket, 0, lanes=4) as instance:
        instance.begin()
    return Stepped(url, board, ticket)


@pytest.fixture
def stepped(url, board):
    return begun(url, board)


def answer_on(connection):
    """Status, body and headers of the next answer."""
    with http.client.HTTPResponse(connection) as answer:
        answer.begin()
        return answer.status, answer.read(), answer.headers


def test_a_plain_request_is_read():
    extra = b"content-type: x\r\nX-Forwarded-For: 203.0.113.7\r\nConnection: Keep-Alive\r\n\r\n"
    for head in (HEAD, HEAD[:-2] + extra):
        request = step_request(head + BODY)
        assert request == ("autumn_2", 12, 3, "Bearer ab", BODY, 0)
    assert step_request(HEAD + BODY[:5]) == ("autumn_2", 12, 3, "Bearer ab", BODY[:5], 19)
    assert step_request(2 * (HEAD + BODY)) is None  # the second is left to the application


def test_nothing_but_a_plain_request_is_read():
    head = HEAD.decode()
    for old, new in (
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
        *((": 24", size) for size in (": 024", ": +24", ": 24, 24", ": 23", ": 0", ": 100000")),
        (": 24", " : 24"),
        (": 24", ":\t24"),
        *(
            (": 24", f": 24\r\n{field}")
            for field in (
                "Content-Length: 24",
                "content-length: 5",
                "Transfer-Encoding: chunked",
                "Expect: 100-continue",
                "Connection: close",
                "Upgrade: websocket",
                "X-Unknown: 1",
                " folded",
            )
        ),
        (": 24", ": 24\nAccept: x"),
        ("Bearer ab", "Bearer \xe9"),
        ("\r\n\r\n", "\r\n"),
    ):
        assert head.count(old) == 1 or old == "\r\n\r\n"
        assert step_request(head.replace(old, new).encode() + BODY) is None, (old, new)


@pytest.mark.parametrize("pieces", [1, 2, 3])
def test_steps_need_no_application(stepped, pieces, monkeypatch):
    """Also where head and body arrive one after the other, as many clients send them."""
    monkeypatch.delattr(SeasonRoutes, "place")
    with stepped.connect() as connection:
        for number in (1, 2, 2, 3):
            request = stepped.request(number)
            body = len(request) - len(BODY)
            cuts = [*[0, body, body + 5][:pieces], len(request)]
            for start, end in itertools.pairwise(cuts):
                connection.sendall(request[start:end])
            status, steps, headers = answer_on(connection)
            assert (status, len(steps)) == (200, WIRE.answer_bytes)
    assert stepped.used == 12
    # No cache keeps an answer, and no browser guesses its type.
    assert headers["content-type"] == "application/octet-stream"
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"


def test_what_is_refused_is_answered_by_the_application(stepped):
    for request, status, code in (
        (stepped.request(2), 409, b"step_ahead"),
        (stepped.request(1, token="ab"), 403, b"token_wrong"),
    ):
        with stepped.connect() as connection:
            connection.sendall(request)
            answer = answer_on(connection)
        assert (answer[0], code in answer[1]) == (status, True)

    body = stepped.request(1)  # as the body of another request
    head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n"
    with stepped.connect() as connection:
        connection.sendall(head + b"Content-Length: %d\r\n\r\n" % len(body))
        assert connection.recv(100).startswith(b"HTTP/1.1 100 ")
        connection.sendall(body)
        assert answer_on(connection)[0] == 400
    assert stepped.used == 0


@pytest.mark.parametrize("size", [1, 100, 10_000])
def test_requests_on_end_are_answered_in_their_order(stepped, size):
    """However they are cut into pieces."""
    data = b"".join(map(stepped.request, range(1, 9)))
    with stepped.connect() as connection:
        for start in range(0, len(data), size):
            connection.sendall(data[start : start + size])
        with connection.makefile("rb") as stream:
            answers = [next_body(stream) for _ in range(8)]
    assert stepped.used == 32
    assert len(set(answers)) == 8


def next_body(stream):
    """The body of the next answer, and nothing of those behind it."""
    while (line := stream.readline()) != b"\r\n":
        if line.lower().startswith(b"content-length:"):
            size = int(line.partition(b":")[2])
    return stream.read(size)


def test_steps_that_fail_are_taken_once_by_the_application(stepped, monkeypatch):
    take = Tickets.quick_step

    def fails(*arguments):
        take(*arguments)  # type: ignore[arg-type]
        raise MemoryError

    monkeypatch.setattr(Tickets, "quick_step", fails)
    with stepped.connect() as connection:
        for number in (1, 2):
            connection.sendall(stepped.request(number))
            assert answer_on(connection)[0] == 200
    assert stepped.used == 8


def test_a_body_that_does_not_come_has_a_deadline(stepped, connections, monkeypatch):
    monkeypatch.setattr(connections, "limits", ConnectionLimits(head_seconds=0.2))
    with stepped.connect() as connection:
        connection.sendall(stepped.request(1)[:-1])
        with contextlib.suppress(ConnectionResetError):
            assert connection.recv(1) == b""
    assert stepped.used == 0


def test_who_steps_waits_anew_after_each_answer(tmp_path):
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

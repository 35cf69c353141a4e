"""Steps that the server answers without its application, however their bytes arrive."""

import contextlib
import http.client
import socket
from urllib.parse import urlsplit

import numpy as np
import pytest

from leaderboard.documents.keys import SigningKey
from leaderboard.web.quick import step_request
from leaderboard.web.seasons import SeasonRoutes
from sme_registry import seasons
from sme_registry.seasons import wire
from tests.leaderboard.sealed.playing import online_board
from tests.leaderboard.serving import serving

WIRE = wire.StepFormat(4, 2, 1)
BODY = WIRE.pack_request(1, np.full((4, 1), 0.5, np.float32))


def head_for(season, ticket, token):
    path = wire.instance_path(season, ticket, 0, "steps")
    return (
        f"POST {path} HTTP/1.1\r\nHost: board.example\r\nAuthorization: Bearer {token}\r\n"
        f"Content-Length: {len(BODY)}\r\n\r\n"
    ).encode()


@contextlib.contextmanager
def connect(url):
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), 60.0) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection


def answer_on(connection):
    """Status, body and headers of the next answer."""
    with http.client.HTTPResponse(connection) as answer:
        answer.begin()
        return answer.status, answer.read(), answer.headers


def test_only_a_plain_request_is_read():
    head = head_for("autumn_2", 12, "ab").decode()
    assert step_request(head.encode() + BODY) == ("autumn_2", 12, 0, "Bearer ab", BODY, 0)
    assert step_request(2 * (head.encode() + BODY)) is None  # the second is the application's
    for old, new in (
        ("POST", "GET"),
        ("steps HTTP", "steps?x HTTP"),
        ("autumn_2", "../autumn_2"),
        ("/12/", "/1234567890/"),
        ("Host: board.example\r\n", ""),
        ("Content-Length: 24\r\n", ""),
        *((": 24", size) for size in (": 024", ": +24", ": 24, 24", ": 23", ": 100000", " : 24")),
        (": 24", ": 24\r\ncontent-length: 5"),
        (": 24", ": 24\r\nTransfer-Encoding: chunked"),
        (": 24", ": 24\r\nX-Unknown: 1"),
        (": 24", ": 24\r\n folded"),
        (": 24", ": 24\nAccept: x"),
    ):
        assert head.count(old) == 1
        assert step_request(head.replace(old, new).encode() + BODY) is None, (old, new)


def test_steps_need_no_application_and_what_is_refused_is_answered_by_it(tmp_path):
    """Also where requests arrive in pieces, as many clients send them."""
    board = online_board(tmp_path)
    with serving(board.path, season_secrets=[board.secret]) as url:
        ticket = board.ticket(url, SigningKey.generate())
        with seasons.Instance(url, ticket, 0, 4) as instance:
            instance.begin()

        def used():
            with seasons.Instance(url, ticket, 0, 4) as instance:
                return instance.status().instances[0].used

        def request(number, token=ticket.token):
            body = WIRE.pack_request(number, np.full((4, 1), 0.5, np.float32))
            return head_for(ticket.season, ticket.ticket, token) + body

        for bad, status, code in (
            (request(2), 409, b"step_ahead"),
            (request(1, token="ab"), 403, b"token_wrong"),
        ):
            with connect(url) as connection:
                connection.sendall(bad)
                answer = answer_on(connection)
            assert (answer[0], code in answer[1]) == (status, True)
        with connect(url) as connection:  # as the body of another request
            body = request(1)
            head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"
            connection.sendall(head % len(body) + body)
            assert answer_on(connection)[0] == 400
        assert used() == 0

        for number, first in ((1, 0), (2, len(BODY)), (2, 5), (3, 40)):
            with pytest.MonkeyPatch.context() as patch, connect(url) as connection:
                if first == 0:  # the application may take pieces that arrive late
                    patch.delattr(SeasonRoutes, "place")
                data = request(number)
                connection.sendall(data[: len(data) - first])
                connection.sendall(data[len(data) - first :])
                status, steps, headers = answer_on(connection)
                assert (status, len(steps)) == (200, WIRE.answer_bytes)
        assert used() == 12
    # No cache keeps an answer, and no browser guesses its type.
    assert headers["content-type"] == "application/octet-stream"
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"

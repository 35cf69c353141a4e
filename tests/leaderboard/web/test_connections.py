"""Silent, slow and many clients: a served board answers the others."""

import contextlib
import hashlib
import http.client
import os
import re
import socket
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from leaderboard.documents.board import hex_of
from leaderboard.documents.keys import SigningKey
from leaderboard.intake import upload_header
from leaderboard.web import serve
from leaderboard.web.connections import ConnectionLimits, Connections
from leaderboard.web.limits import counted_address
from sme_registry.errors import OptionError
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.serving import serving, serving_process
from tests.leaderboard.web.site import boards

PATIENCE = 60.0
HEAD = b"GET /healthz HTTP/1.1\r\nHost: x\r\n"
BODY = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nContent-Length: 60000\r\n\r\n"
DATA = b"large" * 2**20
LARGE = f"GET /api/objects/{hex_of(sha256_of(DATA))} HTTP/1.1\r\nHost: x\r\n".encode()
CLOSE = b"Connection: close\r\n\r\n"


def connect(url, first=b"", buffer=None):
    """A connection on which these bytes are sent, with a receive buffer of this size."""
    parts = urlsplit(url)
    connection = socket.socket()
    if buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    connection.settimeout(PATIENCE)
    connection.connect((parts.hostname, parts.port))
    connection.sendall(first)
    return connection


def rest(connection):
    """All that a server still sends, until it closes the connection."""
    received = b""
    with contextlib.suppress(ConnectionResetError), connection:
        while chunk := connection.recv(2**16):
            received += chunk
    return received


def drip(connection):
    """Send one byte after another until the server closes the connection."""
    connection.settimeout(0.02)
    deadline = time.monotonic() + PATIENCE
    with contextlib.suppress(ConnectionResetError, BrokenPipeError), connection:
        while True:
            assert time.monotonic() < deadline
            with contextlib.suppress(TimeoutError):
                if not connection.recv(2**16):
                    return
            connection.sendall(b"a")


def answers(connection):
    """Whether a connection on which nothing was sent still has its slot."""
    with contextlib.suppress(ConnectionResetError, BrokenPipeError), connection:
        connection.sendall(HEAD + b"\r\n")
        return connection.recv(2**16).startswith(b"HTTP/1.1 200 ")
    return False


def limited(**limits):
    return Connections(ConnectionLimits(**limits))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A board with a public artefact of 5 MiB, which its scored submission might have named."""
    with boards.create(tmp_path_factory.mktemp("served") / "board", classes=1) as store:
        id = boards.submit(store, SigningKey.generate(), "PPO", [0.2] * 6)
        store.put_object(sha256_of(DATA), [DATA], by=SigningKey.generate().public)
        with store.transaction() as index:
            index.connection.execute("INSERT INTO artefact VALUES (?, ?)", (sha256_of(DATA), id))
        yield store.folder.path


# Slots.


def test_a_new_connection_takes_the_slot_of_the_one_silent_for_longest(path):
    with serving(path, limited(connections=3)) as url:
        silent = [connect(url) for _ in range(5)]
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE).status_code == 200
        assert [answers(each) for each in silent] == [False, False, False, True, True]


@pytest.mark.parametrize("uncounted", [{}, {"uncounted": ()}])
def test_one_address_takes_only_its_own_slots_but_for_this_machine(path, uncounted):
    connections = Connections(ConnectionLimits(of_one_address=2), **uncounted)
    with serving(path, connections) as url:
        opened = [connect(url) for _ in range(4)]
        if uncounted:
            assert [rest(each) for each in opened[:2]] == [b"", b""]
            opened = opened[2:]
        assert all(answers(each) for each in opened)


def test_clients_are_counted_by_ipv4_address_or_ipv6_network():
    for host, counted in {
        "203.0.113.7": "203.0.113.7",
        "::ffff:203.0.113.7": "203.0.113.7",
        "2001:db8:1:2:3:4:5:6": "2001:db8:1:2::/64",
        "2001:db8:1:2::": "2001:db8:1:2::/64",
        "127.0.0.9": "",
        "::1": "",
        "::ffff:127.0.0.1": "",
        "": "",
    }.items():
        assert counted_address(host) == counted


# Deadlines.


def test_a_request_head_has_a_deadline_and_a_body_that_nobody_waits_for(path):
    """From the start or the last answer, whether nothing arrives or one byte after another."""
    with serving(path, limited(head_seconds=0.2)) as url:
        for first in (b"", HEAD, HEAD + b"\r\n"):
            rest(connect(url, first))
            drip(connect(url, first))
        drip(connect(url, HEAD + b"Content-Length: 1000000\r\n\r\n"))


def test_a_client_that_reads_nothing_is_closed_and_a_patient_one_gets_everything(path):
    """Also if the connection is to close, or another request waits behind."""
    connections = limited(stalled_seconds=0.2)
    with serving(path, connections) as url:
        for request in (b"\r\n", CLOSE, b"\r\n" + HEAD + b"\r\n"):
            connection = connect(url, LARGE + request, buffer=4096)
            assert connection.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
            wait, deadline = threading.Event(), time.monotonic() + PATIENCE
            while len(connections) and time.monotonic() < deadline:
                wait.wait(0.02)
            assert len(connections) == 0
            assert len(rest(connection)) < len(DATA)
    with serving(path, limited(stalled_seconds=20.0, head_seconds=0.2)) as url:
        assert rest(connect(url, LARGE + CLOSE, buffer=2**16)).endswith(DATA)


# Memory and time.


def kibibytes(pid, name):
    return int(re.search(rf"{name}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())[1])


def test_slow_readers_take_little_memory_and_do_not_disturb_the_end_of_the_server(path):
    with serving_process(path) as (url, process):
        httpx.get(url, timeout=PATIENCE)
        before = kibibytes(process.pid, "VmRSS")
        readers = [connect(url, LARGE + b"\r\n", buffer=4096) for _ in range(60)]
        for each in readers:
            assert each.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
        assert httpx.get(url, timeout=PATIENCE).status_code == 200
        assert kibibytes(process.pid, "VmRSS") - before < len(readers) * 2**9
        for each in readers[1:]:
            each.close()
        body = connect(url, BODY + b" ")
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
        readers[0].close()
        body.close()
    assert (process.returncode, err) == (0, "")


def test_many_large_uploads_at_once_take_little_memory(tmp_path, key):
    uploads, size = 40, 2**22
    body = memoryview(os.urandom(size))
    all_are_half_way = threading.Barrier(uploads, timeout=PATIENCE)
    statuses, digests = [], []

    def upload(number, address, board):
        head = number.to_bytes(8, "big")  # each is another object
        sha256 = hashlib.sha256(head)
        sha256.update(body[8:])
        digest = f"sha256:{sha256.hexdigest()}"
        connection = http.client.HTTPConnection(address, timeout=PATIENCE)
        connection.putrequest("PUT", f"/api/objects/{sha256.hexdigest()}")
        connection.putheader("Content-Length", str(size))
        connection.putheader("Authorization", upload_header(key, digest, board=board))
        connection.endheaders(head)
        connection.send(body[8 : size // 2])
        all_are_half_way.wait()
        connection.send(body[size // 2 :])
        statuses.append(connection.getresponse().status)
        connection.close()
        digests.append(digest)

    with tiny_board(tmp_path / "board") as store:
        with serving_process(store.folder.path) as (url, process):
            httpx.get(url, timeout=PATIENCE)
            before = kibibytes(process.pid, "VmHWM")
            arguments = (urlsplit(url).netloc, store.document.key)
            threads = [
                threading.Thread(target=upload, args=(number, *arguments))
                for number in range(uploads)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            grown = 2**10 * (kibibytes(process.pid, "VmHWM") - before)
        assert statuses == [201] * uploads
        assert grown < uploads * size / 4
        stored = [store.folder.object(digest).stat().st_size for digest in digests]
        assert stored == [size] * uploads
        assert store.uploaded_bytes(key.public, "2000-01-01T00:00:00Z") == uploads * size
        assert len(store.objects.read(digests[0])) == size  # which verifies its digest


def test_a_client_reads_why_its_body_is_refused_while_it_still_sends(path):
    large = BODY.replace(b"60000", b"6000000") + bytes(2**17)
    with serving(path) as url:
        with connect(url, large) as connection:
            answer = connection.recv(2**16)
            assert answer.startswith(b"HTTP/1.1 413 ")  # before the rest has come
            for _ in range(20):  # a connection that is closed would be reset by the first
                connection.sendall(bytes(2**17))
                time.sleep(0.01)
            assert b'"code":"too_large"' in answer + rest(connection)
        assert rest(connect(url, large))  # who falls silent is cut off


@pytest.mark.parametrize(("size", "status"), [(1, b"400"), (300, b"413")])
def test_a_body_of_tiny_chunks_is_refused_at_once(path, size, status):
    chunk = b"%x\r\n%s\r\n" % (size, b" " * size)
    head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    with serving(path) as url, connect(url) as connection:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(head + chunk * 2000)  # and its end never comes
        assert connection.recv(12) == b"HTTP/1.1 " + status


# Proxies.


@pytest.mark.parametrize("trusted", [True, False])
def test_requests_are_limited_by_the_address_that_a_proxy_names_and_nobody_else(path, trusted):
    proxies = [serve._network("127.0.0.1")] if trusted else []
    one, other = (b"Host: x\r\nX-Forwarded-For: 203.0.113.%d\r\n" % each for each in (7, 8))
    page = b"GET /log HTTP/1.1\r\n"
    with serving(path, Connections(proxies=proxies), requests_of_address=1) as url:
        busy = connect(url, BODY.replace(b"Host: x\r\n", one))
        same, another = (rest(connect(url, page + each + CLOSE)) for each in (one, other))
        busy.close()
    assert another.startswith(b"HTTP/1.1 200 ")
    assert same.startswith(b"HTTP/1.1 503 " if trusted else b"HTTP/1.1 200 ")
    if trusted:
        assert b"retry-after" in same.lower()
        assert b'"code":"busy"' in same


def test_a_proxy_is_an_address_or_a_network(path):
    for proxy in ("", "proxy.example", "*", "10.0.0.1/8"):
        with pytest.raises(OptionError, match="trusted_proxies="):
            serve.serve(path, port=0, workers=0, trusted_proxies=[proxy])

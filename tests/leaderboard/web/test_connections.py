"""Silent, slow and many clients: a served board answers the others."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from starlette.types import Message

from leaderboard import intake
from leaderboard.documents.board import hex_of
from leaderboard.documents.keys import SigningKey
from leaderboard.store import Store
from leaderboard.web import limits, serve
from leaderboard.web.connections import ConnectionLimits, Connections
from leaderboard.web.downloads import PIECE
from leaderboard.web.errors import RequestError
from leaderboard.web.guard import Guard
from leaderboard.web.limits import Turns, counted_address
from sme_registry.errors import OptionError
from sme_registry.io import sha256_of
from tests.leaderboard.serving import serving, serving_process
from tests.leaderboard.web.site import boards

PATIENCE = 60.0
HEAD = b"GET /healthz HTTP/1.1\r\nHost: x\r\n"
BODY = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nContent-Length: 60000\r\n\r\n"
LARGE = b"large" * 2**20


def connect(url: str, first: bytes = b"", buffer: int | None = None) -> socket.socket:
    """A connection on which these bytes are sent, with a receive buffer of this size."""
    parts = urlsplit(url)
    connection = socket.socket()
    if buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    connection.settimeout(PATIENCE)
    connection.connect((parts.hostname, parts.port))
    connection.sendall(first)
    return connection


def rest(connection: socket.socket) -> bytes:
    """All that a server still sends, until it closes the connection."""
    received = b""
    with contextlib.suppress(ConnectionResetError), connection:
        while chunk := connection.recv(2**16):
            received += chunk
    return received


def drip(connection: socket.socket, byte: bytes = b"a") -> None:
    """Send one byte after another until the server closes the connection."""
    connection.settimeout(0.02)
    deadline = time.monotonic() + PATIENCE
    with contextlib.suppress(ConnectionResetError, BrokenPipeError), connection:
        while True:
            assert time.monotonic() < deadline
            with contextlib.suppress(TimeoutError):
                if not connection.recv(2**16):
                    return
            connection.sendall(byte)


def answers(connection: socket.socket) -> bool:
    """Whether a connection on which nothing was sent still has its slot."""
    with contextlib.suppress(ConnectionResetError, BrokenPipeError), connection:
        connection.sendall(HEAD + b"\r\n")
        return connection.recv(2**16).startswith(b"HTTP/1.1 200 ")
    return False


def limited(**limits: float) -> Connections:
    return Connections(ConnectionLimits(**limits))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A board with a public artefact of 5 MiB."""
    with boards.create(tmp_path_factory.mktemp("served") / "board", classes=1) as store:
        boards.submit(store, SigningKey.generate(), "PPO", [0.2] * 6)
        publish(store, LARGE)
        yield store.folder.path


def publish(store: Store, data: bytes) -> str:
    """Put an artefact on the board that its scored submission might have named; its address."""
    digest = sha256_of(data)
    store.put_object(digest, [data], by=SigningKey.generate().public)
    scored = next(entry.id for entry in store.entries() if entry.scores and not entry.reference)
    with store.transaction() as index:
        index.connection.execute("INSERT INTO artefact VALUES (?, ?)", (digest, scored))
    return f"/api/objects/{hex_of(digest)}"


def large() -> bytes:
    return f"GET /api/objects/{hashlib.sha256(LARGE).hexdigest()} HTTP/1.1\r\nHost: x\r\n".encode()


# Slots.


def test_a_new_connection_takes_the_slot_of_the_one_silent_for_longest(path: Path) -> None:
    with serving(path, limited(connections=3)) as url:
        silent = [connect(url) for _ in range(5)]
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE).status_code == 200
        assert [answers(each) for each in silent] == [False, False, False, True, True]


@pytest.mark.parametrize("first", [b"", HEAD, HEAD[:20]], ids=["silent", "half", "line"])
def test_clients_without_a_complete_request_lock_nobody_out(path: Path, first: bytes) -> None:
    with serving(path, limited(connections=10)) as url:
        idle = [connect(url, first) for _ in range(100)]
        for _ in range(3):
            assert httpx.get(url, timeout=PATIENCE).status_code == 200
        for each in idle:
            each.close()


def test_a_request_in_progress_loses_its_slot_only_to_a_faster_one(path: Path) -> None:
    """The slot of a connection without a request is taken first, whenever it began."""
    with serving(path, limited(connections=3, grace_seconds=PATIENCE)) as url:
        slow, fast = connect(url, BODY + b" "), connect(url, BODY + b" " * 59_000)
        for _ in range(3):
            assert httpx.get(f"{url}/healthz", timeout=PATIENCE).status_code == 200
        silent = connect(url)
        third = connect(url, BODY + b" " * 50_000)
        assert rest(silent) == b""
        fourth = connect(url, BODY + b" " * 50_000)
        assert rest(slow) == b""
        for each, missing in ((fast, 1000), (third, 10_000), (fourth, 10_000)):
            each.sendall(b" " * missing)
            assert each.recv(2**16).startswith(b"HTTP/1.1 400 ")
            each.close()


def test_one_that_has_just_come_keeps_its_slot_before_slow_ones(path: Path) -> None:
    with serving(path, limited(connections=4, head_seconds=2.0)) as url:
        slow = [connect(url, BODY + b" " * 30_000) for _ in range(3)]
        assert rest(connect(url)) == b""  # after two seconds, more than the grace
        silent = connect(url)
        fast = connect(url, BODY + b" " * 60_000)
        assert fast.recv(2**16).startswith(b"HTTP/1.1 400 ")
        assert answers(silent)
        for each in (*slow, fast):
            each.close()


def test_slow_readers_lock_nobody_out(path: Path) -> None:
    with serving(path, limited(connections=5)) as url:
        slow = [connect(url, large() + b"\r\n", buffer=4096) for _ in range(20)]
        for each in slow:  # until it is answered, or its slot is another's
            with contextlib.suppress(ConnectionResetError):
                each.recv(1)
        assert httpx.get(url, timeout=PATIENCE).status_code == 200
        for each in slow:
            each.close()


def test_one_address_takes_only_its_own_slots(path: Path) -> None:
    connections = Connections(ConnectionLimits(of_one_address=2), uncounted=())
    with serving(path, connections) as url:
        silent = [connect(url) for _ in range(4)]
        assert [rest(each) for each in silent[:2]] == [b"", b""]
        assert all(answers(each) for each in silent[2:])


def test_this_machine_and_proxies_have_no_limit_by_address(path: Path) -> None:
    with serving(path, limited(of_one_address=2)) as url:
        silent = [connect(url) for _ in range(4)]
        assert all(answers(each) for each in silent)


@pytest.mark.parametrize(
    ("host", "counted"),
    [
        ("203.0.113.7", "203.0.113.7"),
        ("::ffff:203.0.113.7", "203.0.113.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::", "2001:db8:1:2::/64"),
        ("127.0.0.9", ""),
        ("::1", ""),
        ("::ffff:127.0.0.1", ""),
        ("", ""),
    ],
)
def test_clients_are_counted_by_ipv4_address_or_ipv6_network(host: str, counted: str) -> None:
    assert counted_address(host) == counted


def test_slots_leave_files_for_everything_else() -> None:
    program = """
import resource
from leaderboard.web import limits, serve
from sme_registry.io import sha256_of
for hard in 9000, 1024:
    resource.setrlimit(resource.RLIMIT_NOFILE, (128, hard))
    print(serve._connections(), resource.getrlimit(resource.RLIMIT_NOFILE)[0])
"""
    command = [sys.executable, "-c", program]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out.splitlines() == ["1000 2512", "256 1024"]


# Deadlines.


@pytest.mark.parametrize("first", [b"", HEAD, HEAD + b"\r\n"], ids=["silent", "half", "answered"])
@pytest.mark.parametrize("drips", [False, True])
def test_a_request_head_has_a_deadline(path: Path, first: bytes, drips: bool) -> None:
    """From the start or the last answer, whether nothing arrives or one byte after another."""
    with serving(path, limited(head_seconds=0.2)) as url:
        connection = connect(url, first)
        if drips:
            drip(connection)
        else:
            rest(connection)


def test_a_body_that_nobody_waits_for_has_a_deadline(path: Path) -> None:
    with serving(path, limited(head_seconds=0.2)) as url:
        drip(connect(url, HEAD + b"Content-Length: 1000000\r\n\r\n"))


def test_a_body_that_hardly_moves_is_refused(
    path: Path, key: SigningKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "_START_SECONDS", 0.3)
    with Store.open(path, read_only=True) as store:
        board = store.document.key
    digest = hashlib.sha256(b"x").hexdigest()
    head = (
        f"PUT /api/objects/{digest} HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n"
        f"Authorization: {intake.upload_header(key, f'sha256:{digest}', board=board)}\r\n\r\n"
    )
    with serving(path) as url:
        answer = rest(connect(url, head.encode() + b"x" * 2000))
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"2,000 bytes" in answer


@pytest.mark.parametrize(
    "request_", [b"\r\n", b"Connection: close\r\n\r\n", b"\r\n" + HEAD + b"\r\n"]
)
def test_a_client_that_reads_nothing_is_closed(path: Path, request_: bytes) -> None:
    """Also if the connection is to close, or another request waits behind."""
    connections = limited(stalled_seconds=0.2)
    with serving(path, connections) as url:
        connection = connect(url, large() + request_, buffer=4096)
        assert connection.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
        wait, deadline = threading.Event(), time.monotonic() + PATIENCE
        while len(connections) and time.monotonic() < deadline:
            wait.wait(0.02)
        assert len(connections) == 0
        assert len(rest(connection)) < len(LARGE)


def test_a_patient_reader_gets_everything(path: Path) -> None:
    with serving(path, limited(stalled_seconds=20.0, head_seconds=0.2)) as url:
        connection = connect(url, large() + b"Connection: close\r\n\r\n", buffer=2**16)
        assert rest(connection).endswith(LARGE)


def test_slow_clients_do_not_disturb_the_end_of_the_server(path: Path) -> None:
    with serving_process(path) as (url, process):
        body = connect(url, BODY + b" ")
        reader = connect(url, large() + b"\r\n", buffer=4096)
        assert reader.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
        body.close()
        reader.close()
    assert (process.returncode, err) == (0, "")


# Memory and time.


def test_slow_readers_of_large_answers_take_little_memory(path: Path) -> None:
    readers = 60
    with serving_process(path) as (url, process):
        httpx.get(url, timeout=PATIENCE)
        before = resident_bytes(process.pid)
        slow = [connect(url, large() + b"\r\n", buffer=4096) for _ in range(readers)]
        for each in slow:
            assert each.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
        assert httpx.get(url, timeout=PATIENCE).status_code == 200
        grown = resident_bytes(process.pid) - before
        for each in slow:
            each.close()
    print(f"{readers} slow readers of {len(LARGE) >> 20} MiB: {grown / 2**20:.0f} MiB")
    assert grown < readers * 2**19


def resident_bytes(pid: int) -> int:
    match = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert match is not None
    return int(match[1]) * 1024


def test_answers_are_sent_in_pieces() -> None:
    content = bytes(range(256)) * 2**10
    sent: list[Message] = []

    async def app(scope: object, receive: object, send: object) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})  # type: ignore[operator]
        await send({"type": "http.response.body", "body": content})  # type: ignore[operator]

    async def send(message: Message) -> None:
        sent.append(message)

    async def run() -> None:
        scope = {"type": "http", "method": "GET", "path": "/", "headers": [], "raw_path": b"/"}
        await Guard(app)(scope, None, send)  # type: ignore[arg-type]

    asyncio.run(run())
    pieces = sent[1:]
    assert b"".join(piece["body"] for piece in pieces) == content
    assert max(len(piece["body"]) for piece in pieces) == PIECE
    assert [piece.get("more_body", False) for piece in pieces] == [True] * 3 + [False]


def test_a_client_reads_why_its_body_is_refused_while_it_still_sends(path: Path) -> None:
    with serving(path) as url, connect(url) as connection:
        connection.sendall(BODY.replace(b"60000", b"6000000") + bytes(2**17))
        answer = connection.recv(2**16)
        assert answer.startswith(b"HTTP/1.1 413 ")  # before the rest has come
        for _ in range(20):  # a connection that is closed would be reset by the first
            connection.sendall(bytes(2**17))
            time.sleep(0.01)
        assert b'"code":"too_large"' in answer + rest(connection)


def test_who_is_refused_and_falls_silent_is_cut_off(path: Path) -> None:
    with serving(path) as url:
        assert rest(connect(url, BODY.replace(b"60000", b"6000000") + bytes(2**17)))


@pytest.mark.parametrize(("size", "status"), [(1, b"400"), (300, b"413")])
def test_a_body_of_tiny_chunks_is_refused_at_once(path: Path, size: int, status: bytes) -> None:
    chunk = b"%x\r\n%s\r\n" % (size, b" " * size)
    head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    with serving(path) as url:
        connection = connect(url)
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(head + chunk * 2000)  # and its end never comes
        assert connection.recv(12) == b"HTTP/1.1 " + status
        connection.close()


def test_work_waits_for_its_turn_in_few_places() -> None:
    release, first = threading.Event(), threading.Event()

    def wait() -> str:
        first.set()
        assert release.wait(PATIENCE)
        return "done"

    async def run() -> None:
        turns = Turns(3)
        running = asyncio.create_task(turns.run(wait, "ada"))
        while not first.is_set():
            await asyncio.sleep(0)
        with pytest.raises(RequestError, match="busy"):
            await turns.run(wait, "ada")  # has a place
        others = [asyncio.create_task(turns.run(wait, name)) for name in ("bob", "eve")]
        await asyncio.sleep(0)
        with pytest.raises(RequestError, match="busy"):
            await turns.run(wait, "joe")  # all places are taken
        release.set()
        assert await asyncio.gather(running, *others) == ["done"] * 3
        assert await turns.run(wait, "ada") == "done"

    asyncio.run(run())


# Proxies.


def test_requests_at_the_same_time_are_limited_by_the_address_that_a_proxy_names(
    path: Path,
) -> None:
    proxies = [serve._network("127.0.0.1")]
    one, other = (f"Host: x\r\nX-Forwarded-For: 203.0.113.{each}\r\n".encode() for each in (7, 8))
    with serving(path, Connections(proxies=proxies), requests_of_address=1) as url:
        busy = connect(url, BODY.replace(b"Host: x\r\n", one))
        first, again = (
            rest(connect(url, b"GET /log HTTP/1.1\r\nConnection: close\r\n" + each + b"\r\n"))
            for each in (one, other)
        )
        busy.close()
    assert first.startswith(b"HTTP/1.1 503 ")
    assert b"retry-after" in first.lower()
    assert b'"code":"busy"' in first
    assert again.startswith(b"HTTP/1.1 200 ")


def test_nobody_else_can_name_an_address(path: Path) -> None:
    forged = b"Host: x\r\nX-Forwarded-For: 203.0.113.7\r\n"
    with serving(path, requests_of_address=1) as url:
        busy = connect(url, BODY.replace(b"Host: x\r\n", forged))
        page = b"GET /log HTTP/1.1\r\nConnection: close\r\n" + forged + b"\r\n"
        answer = rest(connect(url, page))
        busy.close()
    assert answer.startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("proxy", ["", "proxy.example", "*", "10.0.0.1/8"])
def test_a_proxy_is_an_address_or_a_network(path: Path, proxy: str) -> None:
    with pytest.raises(OptionError, match="trusted_proxies="):
        serve.serve(path, port=0, workers=0, trusted_proxies=[proxy])


def test_references_of_a_served_board_can_be_read_by_several_at_once(store: Store) -> None:
    (optimal, _) = intake.submit_references(store)
    (run,) = store.submission(optimal).submission.runs
    assert run.artefact is not None
    address = f"/api/objects/{hex_of(run.artefact.sha256)}"
    data = store.objects.read(run.artefact.sha256)
    with serving(store.folder.path) as url:
        threads = [
            threading.Thread(target=lambda: contents.append(httpx.get(url + address).content))
            for _ in range(8)
        ]
        contents: list[bytes] = []
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert contents == [data] * 8

"""The configuration that docs/guides/hosting.md recommends: a board behind a real nginx."""

import contextlib
import os
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest

from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import SigningKey
from leaderboard.web import client
from sme_registry import seasons
from sme_registry.io import sha256_of
from sme_registry.seasons import wire
from tests.leaderboard.seasons.playing import online_board
from tests.leaderboard.serving import serving
from tests.leaderboard.web import boards
from tests.leaderboard.web.test_client import bundle_of

NGINX = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
CONFIGURATION = Path(__file__).parents[3] / "examples" / "deploy" / "nginx.conf"
PATIENCE = 60.0
DATA = b"large" * 2**20
LARGE = f"/api/objects/{hex_of(sha256_of(DATA))}"
HALF_BODY = (
    "POST /api/submissions HTTP/1.1\r\nHost: x\r\nX-From: {}\r\nContent-Length: 60000\r\n\r\n "
)

pytestmark = pytest.mark.skipif(
    NGINX is None and not os.environ.get("CI"), reason="nginx is not installed"
)


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A board with a public artefact of 5 MiB, which its scored submission might have named."""
    with boards.create(tmp_path_factory.mktemp("served") / "board", classes=1) as store:
        id = boards.submit(store, SigningKey.generate(), "PPO", [0.2] * 6)
        store.put_object(sha256_of(DATA), DATA, by=SigningKey.generate().public)
        with store.transaction() as index:
            index.connection.execute("INSERT INTO artefact VALUES (?, ?)", (sha256_of(DATA), id))
        yield store


@pytest.fixture
def seen():
    """The paths of the requests that the application is answering."""
    return []


@pytest.fixture
def proxied(tmp_path, board, seen):
    """Opens nginx in front of the board, with changes of its configuration; its URL."""
    url = free_url()
    with contextlib.ExitStack() as opened:
        upstream = opened.enter_context(serving(board.folder.path, seen, url=url))
        yield lambda **changes: opened.enter_context(nginx(tmp_path, upstream, url, **changes))


def free_url():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"http://127.0.0.1:{free.getsockname()[1]}"


@contextlib.contextmanager
def nginx(folder, upstream, url, **changes):
    """Nginx at a URL with the example's configuration, but for addresses and TLS; yields the URL.

    A directive's argument changes as in `send_timeout="1s"`. The header X-From names a client.
    """
    assert NGINX is not None, "CI=true and no nginx: apt-get install nginx-light"
    port = urlsplit(url).port
    text = CONFIGURATION.read_text()
    servers = text.index("server {"), text.rindex("server {")  # the first only redirects to https
    text = text[: servers[0]] + text[servers[1] :]
    text = text.replace("server 127.0.0.1:8000;", f"server {urlsplit(upstream).netloc};")
    text = text.replace("listen 443 ssl;", f"listen 127.0.0.1:{port};")
    text = re.sub(r"\n *(ssl_certificate|listen \[::\]).*", "", text)
    for name, value in changes.items():
        text, count = re.subn(rf"\b{name}([ =])[^; ]+", rf"{name}\g<1>{value}", text)
        assert count
    folders = "".join(
        f"{name}_temp_path {folder}/{name};\n"
        for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    configuration = folder / "nginx.conf"
    configuration.write_text(
        f"daemon off; master_process off; pid {folder}/nginx.pid; error_log {folder}/error.log;\n"
        "events { worker_connections 512; }\nhttp {\naccess_log off;\n"
        f"set_real_ip_from 127.0.0.1; real_ip_header X-From;\n{folders}{text}}}\n"
    )
    process = subprocess.Popen([NGINX, "-p", str(folder), "-c", str(configuration)])
    try:
        wait_for(lambda: accepts(port), process)
        yield url
    finally:
        process.terminate()
        process.wait(PATIENCE)


def accepts(port):
    with contextlib.suppress(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port)).close()
        return True
    return False


def wait_for(is_true, process=None):
    deadline = time.monotonic() + PATIENCE
    while not is_true():
        assert process is None or process.poll() is None, "nginx ended"
        assert time.monotonic() < deadline
        time.sleep(0.02)


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


def status(url, client, path="/healthz"):
    """Of the answer to a request of the client with this address."""
    return httpx.get(url + path, headers={"X-From": client}, timeout=PATIENCE).status_code


def test_a_submission_passes_through_nginx(proxied, board, tmp_path, key):
    url = proxied()
    folder, signed = bundle_of(tmp_path / "bundle", board, key)
    assert client.submit(url, folder, key) == signed.id
    assert client.status(url, signed.id)["status"] == "waiting"
    page = httpx.get(url, timeout=PATIENCE)
    assert page.status_code == 200
    assert page.headers["X-Frame-Options"] == "DENY"


def test_a_refused_body_gets_its_reason_through_nginx(proxied):
    url = proxied()
    for path, size, code in (
        (LARGE, 2**23, 403),  # unsigned, and read whole by nginx
        (LARGE, 10 * 2**20, 413),
        ("/api/submissions", 2**18, 413),
    ):
        method = "POST" if path == "/api/submissions" else "PUT"
        answer = httpx.request(method, url + path, content=bytes(size), timeout=PATIENCE)
        assert answer.status_code == code
        assert code == 413 or answer.json()["code"] == "bad_signature"


def test_silent_and_slow_clients_are_nginx_s_and_do_not_reach_the_board(proxied, seen):
    url = proxied(client_header_timeout="1s", client_body_timeout="1s")
    halves = [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", HALF_BODY.format("192.0.2.1").encode()]
    opened = [connect(url, halves[number % 3]) for number in range(90)]
    for _ in range(3):
        assert status(url, "203.0.113.7", "/") == 200
    wait_for(lambda: seen == [])  # the board is done with these, and has no other
    for each in opened:
        assert b"HTTP/1.1 200" not in rest(each)  # and all are closed


def test_a_client_that_does_not_read_is_nginx_s_and_is_closed(proxied, seen):
    url = proxied(send_timeout="1s", limit_rate="100m")
    slow = connect(url, f"GET {LARGE} HTTP/1.1\r\nHost: x\r\n\r\n".encode(), buffer=4096)
    assert slow.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"
    wait_for(lambda: seen == [])  # the board is done with it
    time.sleep(2.5)
    assert len(rest(slow)) < len(DATA)


def test_requests_in_progress_are_limited_by_ipv4_address_and_ipv6_network(proxied):
    url = proxied()
    for clients, same, other in (
        ("203.0.113.7", "203.0.113.7", "203.0.113.8"),
        ("2001:db8:1:2::{:x}", "2001:db8:1:2:ffff::1", "2001:db8:1:3::1"),
    ):
        half = [HALF_BODY.format(clients.format(number)).encode() for number in range(32)]
        opened = [connect(url, each) for each in half]
        wait_for(lambda same=same: status(url, same) == 503)
        assert status(url, other) == 200
        for each in opened:
            each.close()
        wait_for(lambda same=same: status(url, same) == 200)


def test_requests_and_bytes_a_second_are_limited_by_address(proxied):
    url = proxied(burst="2", rate="1r/s", limit_rate="2m")
    with httpx.Client(headers={"X-From": "203.0.113.7"}, timeout=PATIENCE) as one:
        begun = time.monotonic()
        answer = one.get(url + LARGE)
        assert (answer.status_code, answer.content) == (200, DATA)
        assert time.monotonic() - begun > 1.0  # 5 MiB at 2 MiB a second, but for a burst
    half = f"HEAD {LARGE} HTTP/1.1\r\nHost: x\r\nX-From: 203.0.113.9\r\nConnection: close\r\n\r\n"
    opened = [connect(url, half.encode()) for _ in range(8)]
    assert status(url, "203.0.113.10") == 200
    codes = sorted(rest(each)[9:12] for each in opened)
    assert codes[:3] == [b"200"] * 3
    assert codes[-4:] == [b"503"] * 4


def test_only_steps_have_a_high_rate_and_no_body_is_larger_than_an_artefact():
    text = CONFIGURATION.read_text()
    [location] = re.findall(r"location ~ (\S+) \{[^}]*zone=board_steps", text)
    assert text.count("zone=board_steps burst") == 1
    matched = {
        name
        for name in ("steps", "start", "challenge", "answers")
        if re.search(location, wire.instance_path("autumn", 12, 3, name))
    }
    assert matched == {"steps"}
    assert not re.search(location, wire.tickets_path("autumn"))
    assert re.findall(r"client_max_body_size (\w+);", text) == ["128k", "9m", "2m"]


def test_steps_pass_through_nginx(tmp_path):
    season, url = online_board(tmp_path), free_url()
    with (
        serving(season.path, url=url, season_secrets=[season.secret]) as upstream,
        nginx(tmp_path, upstream, url),
        seasons.Instance(url, season.ticket(url, SigningKey.generate()), 0, 4) as instance,
    ):
        instance.begin()
        for _ in range(3):
            instance.step(np.zeros((4, 1), np.float32))
        assert instance.status().instances[0].used == 12

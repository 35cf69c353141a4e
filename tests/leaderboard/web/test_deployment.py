"""The configuration that docs/guides/deployment.md recommends: a board behind a real nginx."""

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

from leaderboard.documents.keys import SigningKey
from leaderboard.web import client, limits, serve
from leaderboard.web.connections import Connections
from leaderboard.web.seasons import SeasonRoutes
from sme_registry import seasons
from sme_registry.seasons import wire
from tests.leaderboard.sealed.playing import online_board
from tests.leaderboard.serving import serving
from tests.leaderboard.web.site import boards
from tests.leaderboard.web.test_client import bundle_of

NGINX = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
CONFIGURATION = Path(__file__).parents[3] / "examples" / "deploy" / "nginx.conf"
PATIENCE = 60.0

pytestmark = pytest.mark.skipif(
    NGINX is None and not os.environ.get("CI"), reason="nginx is not installed"
)


@pytest.fixture
def board(tmp_path):
    with boards.create(tmp_path / "board", classes=1) as store:
        yield store


@pytest.fixture
def connections():
    return Connections(proxies=[serve._network("127.0.0.1")])


@pytest.fixture
def url(tmp_path, board, connections):
    """The URL of nginx in front of the board."""
    with (
        serving(board.folder.path, connections) as upstream,
        proxied(tmp_path, urlsplit(upstream).netloc) as url,
    ):
        yield url


@contextlib.contextmanager
def proxied(folder, upstream):
    """Nginx with the example's configuration, but for addresses and TLS; yields its URL."""
    assert NGINX is not None, "CI=true and no nginx: apt-get install nginx-light"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    text = CONFIGURATION.read_text()
    servers = text.index("server {"), text.rindex("server {")  # the first only redirects to https
    text = text[: servers[0]] + text[servers[1] :]
    text = text.replace("server 127.0.0.1:8000;", f"server {upstream};")
    text = text.replace("listen 443 ssl;", f"listen 127.0.0.1:{port};")
    text = re.sub(r"\n *(ssl_certificate|listen \[::\]).*", "", text)
    folders = "".join(
        f"{name}_temp_path {folder}/{name};\n"
        for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    configuration = folder / "nginx.conf"
    configuration.write_text(
        f"daemon off; master_process off; pid {folder}/nginx.pid; error_log {folder}/error.log;\n"
        f"events {{ worker_connections 512; }}\nhttp {{\naccess_log off;\n{folders}{text}}}\n"
    )
    process = subprocess.Popen([NGINX, "-p", str(folder), "-c", str(configuration)])
    try:
        wait_for(port, process)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(PATIENCE)


def wait_for(port, process):
    deadline = time.monotonic() + PATIENCE
    while True:
        assert process.poll() is None, "nginx ended"
        with contextlib.suppress(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port)).close()
            return
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_submission_passes_through_nginx(url, board, tmp_path, key):
    folder, signed = bundle_of(tmp_path / "bundle", board, key)
    assert client.submit(url, folder, key) == signed.id
    assert client.status(url, signed.id)["status"] == "waiting"
    page = httpx.get(url, timeout=PATIENCE)
    assert page.status_code == 200
    assert page.headers["X-Frame-Options"] == "DENY"
    too_large = httpx.put(f"{url}/api/objects/{'0' * 64}", content=bytes(10 * 2**20))
    assert too_large.status_code == 413


def test_the_board_knows_the_clients_of_nginx_and_believes_nobody_else(url, monkeypatch):
    seen = []
    monkeypatch.setattr(limits, "counted_address", lambda host: seen.append(host) or "")
    with httpx.Client(transport=httpx.HTTPTransport(local_address="127.0.0.2")) as other:
        other.get(f"{url}/healthz", timeout=PATIENCE)
        other.get(f"{url}/healthz", headers={"X-Forwarded-For": "203.0.113.7"}, timeout=PATIENCE)
    assert seen == ["127.0.0.2"] * 2


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
    assert {int(size) for size in re.findall(r"client_max_body_size (\d+)m;", text)} == {2, 9}


def test_steps_pass_through_nginx_without_the_application(tmp_path, monkeypatch):
    season = online_board(tmp_path)
    with (
        serving(season.path, season_secrets=[season.secret]) as upstream,
        proxied(tmp_path, urlsplit(upstream).netloc) as url,
        seasons.Instance(url, season.ticket(upstream, SigningKey.generate()), 0, 4) as instance,
    ):
        instance.begin()
        monkeypatch.delattr(SeasonRoutes, "place")
        for _ in range(3):
            instance.step(np.zeros((4, 1), np.float32))
        assert instance.status().instances[0].used == 12


def test_silent_and_slow_clients_of_nginx_do_not_reach_the_board(url, connections):
    parts = urlsplit(url)
    half = [
        b"",
        b"GET / HTTP/1.1\r\nHost: x\r\n",
        b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nContent-Length: 60000\r\n\r\n ",
    ]
    with contextlib.ExitStack() as opened:
        for number in range(90):
            each = socket.create_connection((parts.hostname, parts.port), PATIENCE)
            opened.enter_context(each).sendall(half[number % 3])
        for _ in range(3):
            assert httpx.get(url, timeout=PATIENCE).status_code == 200
        assert len(connections) <= 1  # that of the page, if nginx has not closed it yet

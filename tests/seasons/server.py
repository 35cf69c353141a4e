"""A board that steps a small season, reached through a relay that fails on demand."""

from __future__ import annotations

import contextlib
import http.client
import http.server
import threading
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.seasons.scoring import instances
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.web import SeasonRoutes
from sme_registry.envs import SMEVectorEnv
from sme_registry.seasons import Ticket
from tests.leaderboard.seasons.playing import Board, online_board
from tests.leaderboard.seasons.sealing import MASTER
from tests.leaderboard.serving import serving

SETTING = {"state_dim": 3, "action_dim": 2, "complexity": 5, "hidden_width": 8, "horizon": 7}
BUDGET = 1024
CLASSES = [
    {"name": "deep", "setting": SETTING, "instances": 2, "budget": BUDGET},
    {"name": "short", "setting": SETTING, "instances": 1, "budget": 9},
]
NONCE = 7


@dataclass
class Server:
    """A served season, and one ticket of it."""

    board: Board
    url: str = ""  # of the relay
    behind: str = ""  # of the board's own server
    ticket: Ticket = field(init=False)
    requests: list[str] = field(default_factory=list)
    """Methods and last parts of the paths, as they arrived at the relay."""
    faults: list[str] = field(default_factory=list)
    """What happens to the next requests, one each: "lose request", "lose answer", "cut answer",
    "alter answer", or a status such as "503"; then all is well."""

    def start(self):
        """Get a new ticket, as another entrant."""
        self.requests, self.faults = [], []
        key = SigningKey.generate()
        self.ticket = self.board.ticket(self.behind, key, NONCE, address=self.url)

    def hidden(self, instance):
        """What is hidden of an instance."""
        number = str(self.ticket.ticket)
        return list(instances(self.board.season, MASTER, number, f"{NONCE:064x}"))[instance]

    def seed(self, instance):
        """The seed of an instance's first lane."""
        return self.hidden(instance).starts

    def local(self, instance, lanes, action_range="unit"):
        """The hidden task of an instance here, at the start of its first episodes."""
        hidden = self.hidden(instance)
        env = SMEVectorEnv(hidden.spec, lanes, action_range=action_range, autoreset_mode="SameStep")
        env.reset(seed=self.seed(instance))
        return env

    def answers(self, instance):
        """The answers that the board has."""
        with SeasonStore.open(self.board.path, read_only=True) as store:
            folder = store.ticket_folder(self.board.season.digest, self.ticket.ticket)
        return np.load(folder / f"{instance}.npy", allow_pickle=False)


@contextlib.contextmanager
def serving_season(folder):
    """A board in a folder, served with a relay by threads of this process; it scores nothing."""
    board = online_board(folder, classes=CLASSES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SeasonRoutes, "job", None)
        server = Server(board)
        with (
            _relay(server),
            serving(board.path, url=server.url, season_secrets=[board.secret]) as server.behind,
        ):
            server.start()
            yield server


@contextlib.contextmanager
def _relay(server):
    """Let a server be reached through a relay, below the path /board."""

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def respond(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            action = self.path.rpartition("/")[2].partition("?signature")[0]
            server.requests.append(f"{self.command} {action}")
            fault = server.faults.pop(0) if server.faults else ""
            if fault == "lose request":
                self.close_connection = True
                return
            status, answer = int(fault) if fault.isdecimal() else 0, b""
            if not status:
                status, answer = forwarded(self.command, self.path, self.headers, body)
            if fault == "lose answer":
                self.close_connection = True
                return
            self.send_response(status)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            if fault == "alter answer":
                answer = answer[:-4] + bytes([answer[-4] ^ 1]) + answer[-3:]
            if fault == "cut answer":
                answer, self.close_connection = answer[: len(answer) // 2], True
            self.wfile.write(answer)

        do_GET = do_PUT = do_POST = respond

        def log_message(self, *_):
            pass

    def forwarded(method, path, headers, body):
        connection = http.client.HTTPConnection(urlsplit(server.behind).netloc)
        with contextlib.closing(connection):
            chosen = {name: headers[name] for name in ("Authorization", "Content-Type")}
            connection.request(method, path.removeprefix("/board"), body, chosen)
            answer = connection.getresponse()
            return answer.status, answer.read()

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        listening.daemon_threads = True  # a kept connection's thread waits for its next request
        thread = threading.Thread(target=listening.serve_forever, args=(0.02,))
        thread.start()
        server.url = f"http://127.0.0.1:{listening.server_port}/board"
        try:
            yield
        finally:
            listening.shutdown()
            thread.join()

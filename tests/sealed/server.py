"""A server of one ticket that speaks the protocol of `wire`, and fails on demand."""

from __future__ import annotations

import contextlib
import http.server
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sme_registry.compiled.values import REWARD
from sme_registry.envs.batch import Batch
from sme_registry.sealed import (
    Begun,
    StepFormat,
    Steps,
    Ticket,
    bearer,
    pack_table,
    unpack_table,
)
from sme_registry.spec import SMESpec
from sme_registry.task import materialize

TICKET = Ticket.from_dict(
    {
        "season": "winter",
        "ticket": 7,
        "token": "ab" * 32,
        "deadline": "2099-12-01T00:00:00Z",
        "lanes": 16,
        "classes": [
            {
                "name": "deep",
                "setting": {"state_dim": 3, "action_dim": 2, "complexity": 5, "horizon": 7},
                "instances": 2,
                "budget": 4096,
            },
        ],
    }
)
ROWS = 40


def spec_of(instance: int) -> SMESpec:
    """The hidden task of an instance."""
    return SMESpec.from_dict({**TICKET.place(instance).member.setting.to_dict(), "seed": instance})


def challenge_of(instance: int) -> np.ndarray:
    """The challenge states of an instance."""
    generator = np.random.default_rng(instance)
    return generator.random((ROWS, spec_of(instance).state_dim + 2), dtype=np.float32)


class Refusal(Exception):
    """An answer with an error's code."""

    def __init__(self, status: int, code: str) -> None:
        super().__init__(code)
        self.status, self.code = status, code


class Hidden:
    """An instance that is stepped: its batch, and the last request with its answer."""

    def __init__(self, instance: int) -> None:
        self.spec, self.budget = spec_of(instance), TICKET.place(instance).member.budget
        self.lanes = self.number = 0
        self.finished = False
        self.answers: np.ndarray | None = None
        self.last = b"", b""

    def start(self, lanes: int) -> bytes:
        if self.lanes not in (0, lanes):
            raise Refusal(409, "step_conflict")
        if not self.lanes:
            self.lanes = lanes
            self.format = StepFormat(lanes, self.spec.state_dim, self.spec.action_dim)
            self.batch = Batch(materialize(self.spec), lanes)
            for lane in range(lanes):
                self.batch.seed(lane, lane)
            self.batch.begin(np.arange(lanes), self.batch.observe())
        return self.format.pack_begun(Begun(self.number, self.batch.observe()))

    def step(self, body: bytes) -> bytes:
        number, actions = self.format.unpack_request(body)
        if number == self.number and body == self.last[0]:
            return self.last[1]
        if number != self.number + 1:
            raise Refusal(409, "step_conflict" if number <= self.number else "step_ahead")
        if self.finished or number * self.lanes > self.budget:
            raise Refusal(409, "budget_spent")
        done = self.batch.advance(actions.astype(np.float64))
        ended = done.terminated | done.truncated
        last = np.where(ended[:, None], done.observation, 0)
        observation = done.observation.copy()
        self.batch.begin(np.flatnonzero(ended), observation)
        steps = Steps(observation, done.values[REWARD, 0], done.terminated, done.truncated, last)
        self.number, self.last = number, (body, self.format.pack_steps(steps))
        return self.last[1]

    def status(self) -> dict[str, Any]:
        phase = "answered" if self.answers is not None else "answering" if self.finished else None
        return {
            "phase": phase or ("stepping" if self.lanes else "waiting"),
            "lanes": self.lanes or None,
            "requests": self.number,
            "used": self.number * self.lanes,
        }


@dataclass
class Server:
    """What a test sees of the server.

    Attributes:
      url: its address.
      hidden: the instances.
      requests: the methods and paths that arrived.
      faults: what happens to the next requests, one each: "lose request", "lose answer", "cut
        answer", or a status such as "503"; then all is well.
    """

    url: str = ""
    hidden: list[Hidden] = field(default_factory=lambda: [Hidden(0), Hidden(1)])
    requests: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def answer(self, method: str, path: str, headers: Any, body: bytes) -> bytes:
        """The answer to a request."""
        if headers["Authorization"] != bearer(TICKET.token):
            raise Refusal(403, "token_wrong")
        root = "/board/api/seasons/winter/tickets/7"
        if (method, path) == ("GET", root):
            instances = [each.status() for each in self.hidden]
            return json.dumps(
                {"ticket": 7, "phase": "running", "deadline": "later", "instances": instances}
            ).encode()
        match = re.fullmatch(rf"{root}/instances/(\d+)/(.*)", path)
        assert match, path
        instance, action = int(match[1]), f"{method} {match[2]}"
        hidden = self.hidden[instance]
        if action.startswith("POST start?lanes="):
            return hidden.start(int(action.partition("=")[2]))
        if action == "POST steps":
            return hidden.step(body)
        if action == "POST finish":
            hidden.finished = True
            return b""
        if action == "GET challenge":
            assert hidden.finished
            return pack_table(challenge_of(instance))
        assert action == "PUT answers"
        hidden.answers = unpack_table(body, hidden.spec.action_dim, ROWS)
        return b""


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """A server, which runs in a thread of this process."""
    server = Server()

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def respond(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            server.requests.append(f"{self.command} {self.path.rpartition('/')[2]}")
            fault = server.faults.pop(0) if server.faults else ""
            if fault == "lose request":
                self.close_connection = True
                return
            status, answer = 200, b""
            try:
                if fault.isdecimal():
                    raise Refusal(int(fault), "busy")
                answer = server.answer(self.command, self.path, self.headers, body)
            except Refusal as refusal:
                status = refusal.status
                answer = json.dumps({"code": refusal.code, "message": "no."}).encode()
            if fault == "lose answer":
                self.close_connection = True
                return
            self.send_response(status)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            if fault == "cut answer":
                answer, self.close_connection = answer[: len(answer) // 2], True
            self.wfile.write(answer)

        do_GET = do_PUT = do_POST = respond

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        listening.daemon_threads = True  # a kept connection's thread waits for its next request
        thread = threading.Thread(target=listening.serve_forever, args=(0.02,))
        thread.start()
        server.url = f"http://127.0.0.1:{listening.server_port}/board"
        try:
            yield server
        finally:
            listening.shutdown()
            thread.join()

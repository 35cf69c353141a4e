"""Round trips and lane-steps a second of a sealed-online season on the loopback.

    python -m benchmarks.sealed_speed [seconds]

One server, and one to eight clients in processes of their own. Processor time says what binds where
other programs run, too: with c ms a request of server and client together, two cores can have
2,000/c round trips a second, and the server's process at most 1,000 divided by its own share. The
fastest tenth of windows of a few requests each shows what others hardly disturbed.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from leaderboard.documents.signed import SigningKey
from sme_registry import seasons
from tests.leaderboard.seasons.playing import online_board
from tests.leaderboard.serving import serving_process

CASES = ((1, 1), (1, 1), (1, 2), (1, 8), (16, 1), (256, 1))  # lanes, clients; the first warms up
_WINDOW = 20  # requests
_TICK = os.sysconf("SC_CLK_TCK")


def main(seconds: float = 5.0) -> None:
    member = {"name": "deep", "setting": {"complexity": 5}, "instances": 16, "budget": 10**8}
    with tempfile.TemporaryDirectory() as folder:
        board = online_board(Path(folder), classes=[member])
        with serving_process(board.path, secrets=[board.secret]) as (url, server):
            ticket, instance = board.ticket(url, SigningKey.generate()), 0
            for lanes, clients in CASES:
                queue: multiprocessing.Queue[Taken] = multiprocessing.Queue()
                places = range(instance, instance + clients)
                processes = [
                    multiprocessing.Process(
                        target=step, args=(url, server.pid, ticket, place, lanes, seconds, queue)
                    )
                    for place in places
                ]
                instance += clients
                before = cpu_seconds(server.pid)
                for process in processes:
                    process.start()
                done = [queue.get() for _ in processes]
                used = cpu_seconds(server.pid) - before
                for process in processes:
                    process.join()
                requests = sum(each.requests for each in done)
                rate = sum(each.requests / each.seconds for each in done)
                print(
                    f"{lanes:3} lanes, {clients} clients: {rate:6,.0f} round trips and "
                    f"{rate * lanes:8,.0f} lane-steps a second; processor time of a request: "
                    f"server {1e3 * used / requests:.2f} ms, "
                    f"client {1e3 * sum(each.used for each in done) / requests:.2f} ms"
                )
                if clients == 1:
                    ours, theirs = np.quantile(done[0].windows, 0.1, axis=0) / _WINDOW / 1e6
                    print(f"    fastest tenth: server {theirs:.2f} ms, client {ours:.2f} ms")


class Taken(NamedTuple):
    """What a client has done.

    Attributes:
      requests, seconds, used: their number, the time, and the client's processor time.
      windows: of each window the client's processor time and the server's, in ns.
    """

    requests: int
    seconds: float
    used: float
    windows: list[tuple[int, int]]


def step(
    url: str,
    server: int,
    ticket: seasons.Ticket,
    place: int,
    lanes: int,
    seconds: float,
    queue: multiprocessing.Queue[Taken],
) -> None:
    """Take steps for some seconds; puts what it has done."""
    instance = seasons.Instance(url, ticket, place, lanes=lanes)
    instance.begin()
    actions = np.full((lanes, instance.setting.action_dim), 0.3, np.float32)
    windows, begun, used = [], time.perf_counter(), time.process_time()
    while (took := time.perf_counter() - begun) < seconds:
        before = time.process_time_ns(), event_loop_ns(server)
        for _ in range(_WINDOW):
            instance.step(actions)
        after = time.process_time_ns(), event_loop_ns(server)
        windows.append((after[0] - before[0], after[1] - before[1]))
    queue.put(Taken(_WINDOW * len(windows), took, time.process_time() - used, windows))
    instance.close()


def event_loop_ns(pid: int) -> int:
    """Processor time of a process's first thread, which has the event loop."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])


def cpu_seconds(pid: int) -> float:
    """Processor time of a process, in user and system mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))

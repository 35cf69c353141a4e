"""Round trips and lane-steps a second of a sealed-online season on the loopback.

    python -m benchmarks.sealed_speed [seconds]

One server, and one or two clients in processes of their own. Processor time says what binds where
other programs run, too: with c ms a request of server and client together, two cores can have
2,000/c round trips a second, and the server's process at most 1,000 divided by its own share.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from leaderboard.documents.keys import SigningKey
from sme_registry import sealed
from tests.leaderboard.sealed.killing import killable
from tests.leaderboard.sealed.playing import online_board

CASES = ((1, 1), (1, 1), (1, 2), (16, 1), (256, 1))  # lanes, clients; the first warms up
_TICK = os.sysconf("SC_CLK_TCK")


def main(seconds: float = 5.0) -> None:
    member = {"name": "deep", "setting": {"complexity": 5}, "instances": 8, "budget": 10**8}
    with tempfile.TemporaryDirectory() as folder:
        board = online_board(Path(folder), classes=[member])
        with killable(board) as (url, server):
            ticket, instance = board.ticket(url, SigningKey.generate()), 0
            for lanes, clients in CASES:
                queue: multiprocessing.Queue[tuple[int, float, float]] = multiprocessing.Queue()
                places = range(instance, instance + clients)
                processes = [
                    multiprocessing.Process(
                        target=step, args=(url, ticket, place, lanes, seconds, queue)
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
                requests = sum(each[0] for each in done)
                rate = sum(count / took for count, took, _ in done)
                print(
                    f"{lanes:3} lanes, {clients} clients: {rate:6,.0f} round trips and "
                    f"{rate * lanes:8,.0f} lane-steps a second; processor time of a request: "
                    f"server {1e3 * used / requests:.2f} ms, "
                    f"client {1e3 * sum(each[2] for each in done) / requests:.2f} ms"
                )


def step(
    url: str, ticket: sealed.Ticket, place: int, lanes: int, seconds: float, queue: object
) -> None:
    """Take steps for some seconds; puts their number, the time, and the processor time."""
    instance = sealed.Instance(url, ticket, place, lanes=lanes)
    instance.begin()
    actions = np.full((lanes, instance.setting.action_dim), 0.3, np.float32)
    count, begun, used = 0, time.perf_counter(), time.process_time()
    while (took := time.perf_counter() - begun) < seconds:
        instance.step(actions)
        count += 1
    queue.put((count, took, time.process_time() - used))  # type: ignore[attr-defined]
    instance.close()


def cpu_seconds(pid: int) -> float:
    """Processor time of a process, in user and system mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))

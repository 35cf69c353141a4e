"""Scorers killed at random moments, and a board of a thousand entries; figures are printed."""

from __future__ import annotations

import os
import random
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import METRICS, Estimate, Result
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorers
from leaderboard.store import Store, collect_garbage
from tests.leaderboard.conftest import put_submission, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result

SUBMISSIONS, SCORERS, KILLS = 300, 4, 20
REAL = (
    10  # one in so many has a policy, whose sandbox takes a moment to start; the others have none
)
# and are refused for it


class Killer(threading.Thread):
    """Kills one of the scorers a random moment after so many more submissions are done."""

    def __init__(self, store: Store, seed: int) -> None:
        super().__init__(name="killer")
        self._store, self._random = store, random.Random(seed)
        self.started: list[int] = []
        self.killed: list[int] = []
        self.over = threading.Event()

    def run(self) -> None:
        last = SUBMISSIONS - 2 * SCORERS
        moments = sorted(self._random.sample(range(last), KILLS))
        for moment in moments:
            while self._store.queue.done() < moment and not self.over.is_set():
                time.sleep(0.01)
            time.sleep(self._random.uniform(0.0, 0.2))
            while not self.over.is_set() and not self._kill_one():
                time.sleep(0.01)

    def _kill_one(self) -> bool:
        alive = [pid for pid in self.started if pid not in self.killed and _is_our_child(pid)]
        if not alive:
            return False
        pid = self._random.choice(alive)
        os.kill(pid, 9)
        self.killed.append(pid)
        return True


def _is_our_child(pid: int) -> bool:
    """Alive, and started by this process: not a later one of the same number."""
    try:
        state, parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return False
    return state != "Z" and int(parent) == os.getpid()


def test_killed_scorers_lose_nothing_and_score_nothing_twice(tmp_path, key, capsys):
    board = tmp_path / "board"
    with tiny_board(board) as store:
        spec = store.document.suite.instances[0].digest
        for number in range(SUBMISSIONS):
            failed = {"runs": [{"spec": spec, "seed": number, "steps": 5}]}
            put_submission(store, key, number, **({} if number % REAL == 0 else failed))
        killer = Killer(store, seed=4)
        begun = time.monotonic()
        killer.start()
        try:
            done = run_scorers(board, SCORERS, started=killer.started.append)
        finally:
            killer.over.set()
            killer.join()
        if store.queue.waiting():  # those whose scorers were killed twice, which waits ten seconds
            done += run_scorers(board, SCORERS)  # tries them at once
        seconds = time.monotonic() - begun

        assert done == SUBMISSIONS
        assert len(killer.killed) == KILLS
        events = Counter(entry.event for entry in store.log(0, 10**6))
        assert events == {"opened": 1, "received": SUBMISSIONS, "result": SUBMISSIONS}
        subjects = [entry.subject for entry in store.log(0, 10**6) if entry.event == "result"]
        assert len(set(subjects)) == SUBMISSIONS
        scored = SUBMISSIONS // REAL
        outcomes = Counter((row.status, row.code) for row in store.entries())
        assert outcomes == {
            ("scored", ""): scored,
            ("rejected", "missing_run"): SUBMISSIONS - scored,
        }
        with store.transaction() as index:
            before = list(index.derived_rows())
        store.reindex()
        with store.transaction() as index:
            assert list(index.derived_rows()) == before
            assert index.one("SELECT count(*) FROM lease") == (0,)
        leftovers = collect_garbage(store, temporary_older_than=0).temporary
        assert leftovers <= KILLS
        report = verify(board)
        assert (report.results, report.unlogged) == (SUBMISSIONS, 0)
    with capsys.disabled():
        print(
            f"\n{SUBMISSIONS} submissions, {SCORERS} scorers, {len(killer.killed)} kills, "
            f"{len(killer.started)} processes, {leftovers} temporary files left: "
            f"each scored once, in {seconds:.1f} s"
        )


def test_a_board_of_a_thousand_entries_of_thirty_runs_is_read_fast(tmp_path, key, capsys):
    board = tmp_path / "board"
    begun = time.monotonic()
    fill(board, key, entries=1000, instances=30)
    filled = time.monotonic() - begun
    figures = {}

    def timed(what: str, repeats: int, work) -> None:
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
        figures[what] = 1000 * sorted(times)[len(times) // 2]

    timed("open read-only", 5, lambda: Store.open(board, read_only=True).close())
    with Store.open(board) as store:
        rows = store.entries()
        assert len(rows) == 1000
        assert all(row.runs == 30 and row.scores is not None for row in rows)
        timed("entries()", 9, store.entries)
        timed("entry(id)", 99, lambda: store.entry(rows[500].id))
        timed("result(id)", 9, lambda: store.result(rows[500].id))
        timed("log(1900)", 3, lambda: store.log(1900, 100))
        timed("quotas", 99, lambda: store.uploaded_bytes(key.public, "2020-01-01T00:00:00Z"))
        timed("reindex", 1, store.reindex)
        assert store.entries() == rows
    with capsys.disabled():
        text = ", ".join(f"{what} {value:.2f}" for what, value in figures.items())
        print(f"\n1,000 entries × 30 runs, filled in {filled:.1f} s; ms: {text}")
    assert figures["entries()"] < 100


def fill(board: Path, key: SigningKey, *, entries: int, instances: int) -> None:
    """A scored board of made-up results: in one turn, and not kept safe from a loss of power."""
    with (
        pytest.MonkeyPatch.context() as patch,
        tiny_board(board, instances=instances) as store,
        store.transaction(),
    ):
        patch.setattr(os, "fsync", lambda handle: None)
        first = put_submission(store, key).submission
        result = synthetic_result(store, first.digest)
        for number in range(entries):
            method = first.method.model_copy(update={"name": f"Method {number}"})
            if number > 0:
                store.receive(
                    first.model_copy(update={"method": method}).signed(key, store.document.key)
                )
            claim = store.queue.claim("filler")
            assert claim is not None
            assert store.queue.finish(claim, _shifted(result, claim.id, 0.0005 * number))


def _shifted(result: Result, id: str, by: float) -> Result:
    """The same result for another submission, worse by so much."""
    assert result.scores is not None
    estimates = {
        metric: Estimate(value=each.value + by, low=each.low + by, high=each.high + by)
        for metric in METRICS
        for each in [getattr(result.scores, metric)]
    }
    scores = result.scores.model_copy(update=estimates)
    return result.model_copy(update={"submission": id, "scores": scores})

"""Scorers killed at random moments, and a large board that is read from its index."""

import os
import random
import threading
import time
from collections import Counter
from pathlib import Path

from leaderboard.documents.signed import Receiver
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorers
from leaderboard.store.log import collect_garbage
from tests.leaderboard.conftest import derived, put_submission, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result

SUBMISSIONS, SCORERS, KILLS = 24, 2, 4
# One in so many has a policy, whose sandbox takes a moment to start. The others have none, and are
# refused for it.
REAL = 8


class Killer(threading.Thread):
    """Kills one of the scorers a random moment after so many more submissions are done."""

    def __init__(self, store, seed):
        super().__init__(name="killer")
        self._store, self._random = store, random.Random(seed)
        self.started, self.killed = [], []
        self.over = threading.Event()

    def run(self):
        last = SUBMISSIONS - 2 * SCORERS
        for moment in sorted(self._random.sample(range(last), KILLS)):
            while self._store.queue.count("done") < moment and not self.over.is_set():
                time.sleep(0.01)
            time.sleep(self._random.uniform(0.0, 0.2))
            while not self.over.is_set() and not self._kill_one():
                time.sleep(0.01)

    def _kill_one(self):
        alive = [pid for pid in self.started if pid not in self.killed and _is_our_child(pid)]
        if not alive:
            return False
        pid = self._random.choice(alive)
        os.kill(pid, 9)
        self.killed.append(pid)
        return True


def _is_our_child(pid):
    """Alive, and started by this process: not a later one of the same number."""
    try:
        state, parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return False
    return state != "Z" and int(parent) == os.getpid()


def test_killed_scorers_lose_nothing_and_score_nothing_twice(tmp_path, key):
    board = tmp_path / "board"
    with tiny_board(board) as store:
        spec = store.document.suite.instances[0].digest
        for number in range(SUBMISSIONS):
            failed = {"runs": [{"spec": spec, "seed": number, "steps": 5}]}
            put_submission(store, key, number, **({} if number % REAL == 0 else failed))
        killer = Killer(store, seed=4)
        killer.start()
        try:
            done = run_scorers(board, SCORERS, started=killer.started.append)
        finally:
            killer.over.set()
            killer.join()
        if store.queue.count("waiting"):  # postponed, as their scorers were killed twice
            done += run_scorers(board, SCORERS)  # tries them at once

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
        before = derived(store)
        store.reindex()
        assert derived(store) == before
        with store.transaction() as index:
            assert index.one("SELECT count(*) FROM lease") == (0,)
        assert collect_garbage(store, temporary_older_than=0).temporary <= KILLS
        assert verify(board).is_confirmed


def test_rows_of_many_entries_are_read_from_the_index_alone(tmp_path, key, monkeypatch):
    """A page of a thousand entries reads none of their files."""
    entries, runs = 20, 30
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    with tiny_board(tmp_path / "board", instances=runs) as store:
        with store.transaction():
            first = put_submission(store, key).content
            result = synthetic_result(store, first.digest)
            for number in range(entries):
                if number > 0:
                    method = first.method.model_copy(update={"name": f"Method {number}"})
                    other = first.model_copy(update={"method": method})
                    store.receive(other.signed(key, Receiver(store.document.key)))
                claim = store.queue.claim("filler")
                update = {"submission": claim.id}
                assert store.queue.finish(claim, result.model_copy(update=update))
        store.reindex()
        rows = store.entries()
        assert len(rows) == entries
        assert all((row.runs, row.scores) == (runs, result.scores) for row in rows)
        store.folder.objects.rename(tmp_path / "objects")
        assert store.entries() == rows
        assert store.entry(rows[5].id) == rows[5]

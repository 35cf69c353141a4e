"""Scorers: one in this process, several in their own, and what may stop them."""

import functools
import itertools
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from leaderboard import admission
from leaderboard.errors import BoardError, ScoringFault, TamperedError
from leaderboard.scoring import worker as scorer
from leaderboard.scoring.ranking import failed_run, refuse_unpublishable, result_of
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import background_scorers, run_scorer, run_scorers
from leaderboard.store import Store
from leaderboard.store.queue import Queue
from sme_registry.errors import MissingDependencyError, OptionError
from tests.leaderboard.conftest import derived, document_path, put_submission, tiny_board


def failed_result(document, submission, *arguments, **options):
    """A result without any policy's evaluation."""
    runs = [failed_run(document.protocol, "Tiny", run.spec) for run in submission.runs]
    return result_of(document, submission.digest, runs, {})


@pytest.fixture
def quick(monkeypatch):
    """Scoring takes a moment where it happens in this process."""
    monkeypatch.setattr(scorer, "score_submission", failed_result)


@pytest.fixture
def board(store, submit):
    """A board of three policies."""
    for number in range(3):
        submit(number)
    return store.folder.path


def wait_until(condition):
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        threading.Event().wait(0.01)


def raising(error):
    def fails(*arguments, **options):
        raise error

    return fails


FAULTS = [
    ZeroDivisionError("by 0"),
    MemoryError(),
    ScoringFault("no memory"),
    BoardError("is not on this disk"),
    TamperedError("objects/x", "altered"),
]


def test_faults_leave_a_submission_waiting_and_others_are_scored(
    store, submit, monkeypatch, caplog
):
    """Here the reference rows: a board needs them, however often they failed."""
    broken, whole = admission.submit_references(store), submit(1)
    monkeypatch.setattr("leaderboard.store.queue.uptime", lambda: ("boot", 1000.0))
    errors = []

    def fails(document, submission, *arguments, **options):
        if submission.digest in broken:
            raise errors[-1]
        return failed_result(document, submission)

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(scorer, "score_submission", fails)
        for number, error in enumerate(FAULTS):
            errors.append(error)
            assert run_scorer(store.folder.path) == (number == 0)
            rows = [store.entry(id) for id in broken]
            # At once and again at first; once each time that the scorer starts after that.
            assert [(row.status, row.faults) for row in rows] == [("waiting", 2 + number)] * 2
            assert all(type(error).__name__ in row.fault or str(error) in row.fault for row in rows)
            assert not store.queue.count("claimable")
    assert rows[0].fault == f"{error}"
    assert len(caplog.records) == 2 * 6
    assert store.entry(whole.id).status == "scored"
    assert run_scorer(store.folder.path) == 2
    refuse_unpublishable(store.entries())


def test_an_altered_file_of_one_entry_stops_no_other(store, submit, monkeypatch):
    document, artefact, whole = submit(1), submit(2), submit(3)
    paths = [
        document_path(store.folder.path, document.id),
        store.folder.object(artefact.content.runs[0].artefact.sha256),
    ]
    paths[0].write_bytes(paths[0].read_bytes().replace(b"Tester ", b"Somebo "))
    paths[1].write_bytes(bytes(paths[1].stat().st_size))
    monkeypatch.setattr(scorer, "score_submission", reading_artefacts)
    assert run_scorer(store.folder.path) == 1
    assert store.entry(whole.id).status == "scored"
    for signed, path in zip((document, artefact), paths, strict=True):
        row = store.entry(signed.id)
        assert row.status == "waiting"
        assert path.relative_to(store.folder.path).as_posix() in row.fault


def reading_artefacts(document, submission, artefact, *arguments, **options):
    for run in submission.runs:
        artefact(run.artefact.sha256)
    return failed_result(document, submission)


def test_a_result_waits_for_room_on_the_disk_and_is_computed_once(
    store, submit, monkeypatch, quick
):
    signed = submit()
    real, written = Queue.finish, []

    def full(queue, claim, result):
        written.append(result)
        if len(written) < 4:
            assert store.queue.count("claimed") == 1
            raise BoardError("results: No space left on device")
        return real(queue, claim, result)

    monkeypatch.setattr(scorer, "_POLL_SECONDS", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(Queue, "finish", raising(BoardError("No space left on device")))
        patch.setattr(scorer, "_UNWRITTEN_SECONDS", 0.0)
        for _ in range(6):
            with pytest.raises(BoardError, match="No space left"):
                run_scorer(store.folder.path)
    assert store.entry(signed.id).faults == 0  # a full disk is no fault of the entry
    monkeypatch.setattr(Queue, "finish", full)
    assert run_scorer(store.folder.path) == 1
    assert all(result is written[0] for result in written)
    assert store.entry(signed.id).status == "scored"


def test_a_missing_onnxruntime_ends_the_scorer_and_is_no_fault(store, submit, monkeypatch, quick):
    submit()
    with monkeypatch.context() as patch:
        error = MissingDependencyError("onnxruntime is not installed")
        patch.setattr(scorer, "score_submission", raising(error))
        with pytest.raises(MissingDependencyError):
            run_scorer(store.folder.path)
    assert store.entries()[0].faults == 0
    assert run_scorer(store.folder.path) == 1


def test_heartbeats_keep_a_claim_for_as_long_as_it_is_scored(store, submit, monkeypatch):
    submit()
    uptime, beats, claims = [1000.0], [], []
    real = Queue.heartbeat

    def heartbeat(queue, claim):
        beats.append(real(queue, claim))
        return beats[-1]

    def wait_for_two_beats():
        enough = len(beats) + 2
        wait_until(lambda: len(beats) >= enough)

    def slow(*arguments):
        for _ in range(3):
            uptime[0] += 0.15
            wait_for_two_beats()
            claims.append(store.queue.claim("other"))
        return failed_result(*arguments)

    monkeypatch.setattr("leaderboard.store.queue.uptime", lambda: ("boot", uptime[0]))
    monkeypatch.setattr(Queue, "heartbeat", heartbeat)
    monkeypatch.setattr(scorer, "score_submission", lambda *some, **_: slow(*some))
    monkeypatch.setattr(Queue, "claim", functools.partialmethod(Queue.claim, seconds=0.2))
    assert run_scorer(store.folder.path) == 1
    assert claims == [None] * 3


def test_a_scorer_stops_on_request(store, submit, quick):
    submit(1)
    submit(2)
    answers = iter([False, True])
    assert run_scorer(store.folder.path, until_empty=False, stop=lambda: next(answers)) == 1
    assert store.queue.count("waiting") == 1


# Processes.


def test_several_processes_score_everything_once(store, board):
    seen, pids = [], []

    def report(done, total):
        seen.append((done, total))
        if done == 2:  # the last is done after the last look at the queue, and counts
            wait_until(lambda: store.queue.count("done") == 3)

    assert run_scorers(board, 2, progress=report, started=pids.append) == 3
    assert seen[-1] == (3, 3)
    assert len(pids) >= 2
    assert multiprocessing.active_children() == []
    verify(board)
    assert run_scorers(board, 2) == 0
    with pytest.raises(OptionError, match="workers=0"):
        run_scorers(board, 0)


def test_an_altered_log_ends_the_scoring(store, board):
    path = store.folder.log_entry(3)
    path.write_bytes(path.read_bytes().replace(b"received", b"withdrew"))
    store.close()
    with pytest.raises(TamperedError) as tampered:
        run_scorers(board, 1)
    assert tampered.value.where == "log/00000003.json"
    assert multiprocessing.active_children() == []


def test_processes_that_keep_dying_end_the_command(store, board, monkeypatch):
    monkeypatch.setattr(scorer, "_FUTILE_DEATHS", 2)
    with pytest.raises(BoardError, match="2 scorers died"):
        run_scorers(board, 1, started=lambda pid: os.kill(pid, signal.SIGKILL))
    assert store.queue.count("waiting") == 3
    assert [row.faults for row in store.entries()] == [0, 0, 0]


def test_a_served_board_scores_on_after_any_error(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(scorer, "_FIRST_PAUSE", 0.0)
    errors = [OSError("no process"), BoardError("full"), MemoryError()]
    scoring, calls = threading.Event(), []

    def run_scorers(path, workers, *, until_empty, stop, work):
        if errors:
            raise errors.pop()
        calls.append((path, workers, until_empty))
        scoring.set()
        wait_until(stop)

    monkeypatch.setattr(scorer, "run_scorers", run_scorers)
    with caplog.at_level(logging.ERROR), background_scorers(tmp_path, 1):
        assert scoring.wait(120)
    assert calls == [(tmp_path, 1, False)]
    assert len([each for each in caplog.records if "starts again" in each.message]) == 3


def test_scorers_killed_over_a_submission_leave_it_and_the_others_are_scored(
    store, submit, monkeypatch
):
    poison, whole = submit(1), submit(2)
    names = itertools.count()

    def kill_over_it(pid):
        """Before the process has claimed anything itself; the third one does."""
        worker = scorer.worker_name.last
        if worker in ("0", "1"):
            assert store.queue.claim(worker)
            os.kill(pid, signal.SIGKILL)

    def worker_name():
        worker_name.last = str(next(names))
        return worker_name.last

    monkeypatch.setattr(scorer, "worker_name", worker_name)
    # Longer than any machine takes to start the third process.
    monkeypatch.setattr("leaderboard.store.queue.RETRY_SECONDS", 3600.0)
    assert run_scorers(store.folder.path, 1, started=kill_over_it) == 1
    assert store.entry(whole.id).status == "scored"
    waiting = store.entry(poison.id)
    assert (waiting.status, waiting.faults) == ("waiting", 2)
    assert "-9" in waiting.fault
    monkeypatch.setattr(scorer, "score_submission", failed_result)
    assert run_scorer(store.folder.path) == 1
    assert {row.status for row in store.entries()} == {"scored"}
    assert [each.event for each in store.log()] == ["opened", *["received"] * 2, *["result"] * 2]
    before = derived(store)
    store.reindex()
    assert derived(store) == before
    with store.transaction() as index:
        assert index.one("SELECT count(*) FROM lease") == (0,)


def assert_ended(pids):
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


SCRIPT = """
import sys
from leaderboard.scoring.worker import run_scorers
if __name__ == "__main__":
    started = lambda pid: print(pid, flush=True)
    try:
        run_scorers(sys.argv[1], 1, until_empty=False, started=started)
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.fixture
def served(tmp_path):
    """A process that scores an empty board, and the id of the process that it started."""
    script = tmp_path / "score.py"
    script.write_text(SCRIPT)
    tiny_board(tmp_path / "board").close()
    process = subprocess.Popen(
        [sys.executable, script, tmp_path / "board"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    return process, int(process.stdout.readline())


def test_ctrl_c_in_a_terminal_stops_scoring_and_gives_claims_back(tmp_path, key, served):
    process, pid = served
    numbers = itertools.count()
    with Store.open(tmp_path / "board") as store:

        def one_is_done():
            if store.queue.count("waiting") < 3:
                put_submission(store, key, next(numbers))
            return store.queue.count("done") > 0

        wait_until(one_is_done)
        os.killpg(process.pid, signal.SIGINT)  # parent and children
        _, stderr = process.communicate(timeout=120)
        assert process.returncode == 130, stderr
        assert "Traceback" not in stderr
        assert_ended([pid])
        assert store.queue.count("claimable") == store.queue.count("waiting") > 0


def test_scorers_end_when_who_started_them_is_killed(served):
    process, pid = served
    process.kill()
    process.communicate()
    wait_until(lambda: not Path(f"/proc/{pid}").exists())

from __future__ import annotations

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

from leaderboard import intake
from leaderboard.errors import BoardError, ScoringFault, TamperedError
from leaderboard.scoring import worker as scorer
from leaderboard.scoring.ranking import refuse_unpublishable
from leaderboard.scoring.score import score_submission
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import background_scorers, run_scorer, run_scorers
from leaderboard.store import Queue, Store
from sme_registry.errors import MissingDependencyError, OptionError
from tests.leaderboard.conftest import linear_onnx, put_policy, put_submission, tiny_board


@pytest.fixture
def board(store, submit) -> Path:
    """A board of three policies."""
    submit(1)
    submit(2)
    submit(3)
    return store.folder.path


def test_a_scorer_empties_the_queue_and_returns(store, board):
    seen = []
    assert run_scorer(board, progress=lambda done, total: seen.append((done, total))) == 3
    assert [row.status for row in store.entries()] == ["scored"] * 3
    assert run_scorer(board) == 0
    states = 6 * store.document.protocol.states_per_region
    assert seen[-1] == (states, states)
    first = store.entries()[0]
    submission = store.submission(first.id).submission
    again = score_submission(store.document, submission, store.objects.read)
    assert store.result(first.id).scores == again.scores


def test_an_invalid_policy_is_rejected_with_its_code(store, key):
    signed = put_policy(store, key, linear_onnx(0, observation_dim=9))
    assert run_scorer(store.folder.path) == 1
    assert store.entry(signed.id).code == "onnx_interface"


@pytest.mark.parametrize(
    "error",
    [
        ZeroDivisionError("by 0"),
        MemoryError(),
        ScoringFault("no memory"),
        BoardError("is not on this disk"),
        TamperedError("objects/x", "altered"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_fault_leaves_its_submission_waiting_and_others_are_scored(
    store, submit, monkeypatch, caplog, error
):
    broken, whole = submit(1), submit(2)
    real = score_submission
    monkeypatch.setattr("leaderboard.store.queue._uptime", lambda: ("boot", 1000.0))

    def fails(document, submission, *arguments, **options):
        if submission.digest == broken.id:
            _raise(error)
        return real(document, submission, *arguments, **options)

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(scorer, "score_submission", fails)
        assert run_scorer(store.folder.path) == 1
    assert len(caplog.records) == 2  # at once, and again
    row = store.entry(broken.id)
    assert (row.status, row.faults) == ("waiting", 2)
    assert str(error) in row.fault
    assert store.entry(whole.id).status == "scored"
    for _ in range(4):
        assert not store.queue.claimable()
        with monkeypatch.context() as patch:
            patch.setattr(scorer, "score_submission", fails)
            assert run_scorer(store.folder.path) == 0
    assert store.entry(broken.id).faults == 6
    assert run_scorer(store.folder.path) == 1
    assert store.entry(broken.id).status == "scored"


@pytest.mark.parametrize("part", ["submission", "object"])
def test_an_altered_file_of_one_entry_stops_no_other(store, submit, part):
    altered, whole = submit(1), submit(2)
    if part == "submission":
        path = store.folder.submission(altered.id)
        path.write_bytes(path.read_bytes().replace(b"Tester ", b"Somebo "))
    else:
        path = store.folder.object(altered.submission.runs[0].artefact.sha256)
        path.write_bytes(bytes(path.stat().st_size))
    assert run_scorer(store.folder.path) == 1
    assert store.entry(whole.id).status == "scored"
    row = store.entry(altered.id)
    assert row.status == "waiting"
    assert path.relative_to(store.folder.path).as_posix() in row.fault


def test_a_result_waits_for_room_on_the_disk_and_is_computed_once(store, submit, monkeypatch):
    submit()
    real, refused, computed = Queue.finish, [], []

    def full(queue, claim, result):
        computed.append(result)
        if len(refused) < 3:
            refused.append(claim)
            assert store.queue.claimed() == 1
            raise BoardError("results: No space left on device")
        return real(queue, claim, result)

    monkeypatch.setattr(scorer, "_POLL_SECONDS", 0.0)
    monkeypatch.setattr(Queue, "finish", full)
    assert run_scorer(store.folder.path) == 1
    assert all(result is computed[0] for result in computed)
    assert store.entries()[0].status == "scored"


def test_a_disk_that_stays_full_is_reported_and_no_fault_of_the_entry(store, submit, monkeypatch):
    signed = submit()
    with monkeypatch.context() as patch:
        patch.setattr(scorer, "_UNWRITTEN_SECONDS", 0.0)
        patch.setattr(Queue, "finish", lambda *_: _raise(BoardError("No space left on device")))
        for _ in range(6):
            with pytest.raises(BoardError, match="No space left"):
                run_scorer(store.folder.path)
    assert store.entry(signed.id).faults == 0
    assert run_scorer(store.folder.path) == 1


def by_zero(*arguments, **options):
    raise ZeroDivisionError("by 0")


def _raise(error: Exception) -> None:
    raise error


def test_heartbeats_keep_a_claim_for_as_long_as_it_is_scored(store, submit, monkeypatch):
    submit()
    real, claims = score_submission, []

    def slow(*arguments, **options):
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            claims.append(store.queue.claim("other"))
            threading.Event().wait(0.05)
        return real(*arguments, **options)

    monkeypatch.setattr(scorer, "score_submission", slow)
    assert run_scorer(store.folder.path, lease_seconds=0.8) == 1
    assert set(claims) == {None}
    assert len(claims) > 5


def test_a_scorer_stops_on_request(store, submit):
    submit(1)
    submit(2)
    answers = iter([False, True])
    assert run_scorer(store.folder.path, until_empty=False, stop=lambda: next(answers)) == 1
    assert store.queue.waiting() == 1


def test_several_processes_score_everything_once(store, board):
    seen, pids = [], []
    done = run_scorers(
        board, 2, progress=lambda done, total: seen.append((done, total)), started=pids.append
    )
    assert done == 3
    assert seen[-1] == (3, 3)
    assert len(pids) >= 2
    assert multiprocessing.active_children() == []
    assert verify(board).results == 3
    assert run_scorers(board, 2) == 0


def test_a_submission_done_after_the_last_look_counts(store, board):
    seen = []

    def wait_for_the_last(done: int, total: int) -> None:
        seen.append((done, total))
        while done == 2 and store.queue.done() < 3:
            time.sleep(0.01)

    assert run_scorers(board, 1, progress=wait_for_the_last) == 3
    assert seen[-1] == (3, 3)


def test_zero_workers_are_refused(tmp_path):
    with pytest.raises(OptionError, match="workers=0"):
        run_scorers(tmp_path, 0)


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
    assert store.queue.waiting() == 3
    assert [row.faults for row in store.entries()] == [0, 0, 0]


def test_a_served_board_replaces_dying_processes_with_growing_pauses(store, board, monkeypatch):
    """Every process dies before it claims anything, twice as often as ends a command."""
    at, started, pauses = [0.0], [], []
    monkeypatch.setattr(scorer, "_FUTILE_DEATHS", 2)
    monkeypatch.setattr(scorer, "_LONGEST_PAUSE", 4.0)

    class Clock:
        @staticmethod
        def monotonic():
            at[0] += 0.5
            return at[0]

    def kill(pid):
        os.kill(pid, signal.SIGKILL)
        started.append(at[0])

    with monkeypatch.context() as patch:
        patch.setattr(scorer, "time", Clock)
        run_scorers(board, 1, until_empty=False, started=kill, stop=lambda: len(started) == 7)
    pauses = [later - earlier for earlier, later in itertools.pairwise(started)]
    assert pauses[0] < 1.0
    assert all(pause >= least for pause, least in zip(pauses[1:], [1, 2, 4, 4, 4], strict=True))
    assert store.queue.waiting() == 3


def test_a_served_board_scores_on_after_any_error(store, board, monkeypatch, caplog):
    monkeypatch.setattr(scorer, "_FIRST_PAUSE", 0.0)
    real, errors = run_scorers, [OSError("no process"), BoardError("full"), MemoryError()]
    done = threading.Event()

    def fails(*arguments, **named):
        if errors:
            raise errors.pop()
        done.set()
        real(*arguments, **named)

    monkeypatch.setattr(scorer, "run_scorers", fails)
    with caplog.at_level(logging.ERROR), background_scorers(board, 1):
        assert done.wait(30)
        while store.queue.waiting():
            threading.Event().wait(0.05)
    assert len([each for each in caplog.records if "starts again" in each.message]) == 3


def test_scorers_killed_over_a_submission_leave_it_and_the_others_are_scored(store, submit):
    poison, whole = submit(1), submit(2)

    def kill_over_it(pid):
        while store.queue.claimed() == 0 and len(started) < 2:
            threading.Event().wait(0.01)
        started.append(pid)
        if len(started) <= 2:
            os.kill(pid, signal.SIGKILL)

    started = []
    assert run_scorers(store.folder.path, 1, started=kill_over_it) == 1
    rows = [store.entry(each.id) for each in (poison, whole)]
    assert {row.status for row in rows} == {"waiting", "scored"}
    (waiting,) = [row for row in rows if row.status == "waiting"]
    assert waiting.faults == 2
    assert "-9" in waiting.fault
    assert run_scorers(store.folder.path, 1) == 1
    assert {row.status for row in store.entries()} == {"scored"}


def test_a_missing_onnxruntime_ends_the_scorer_and_is_no_fault(store, submit, monkeypatch):
    submit()
    error = MissingDependencyError("onnxruntime is not installed")
    with monkeypatch.context() as patch:
        patch.setattr(scorer, "score_submission", lambda *_, **__: _raise(error))
        with pytest.raises(MissingDependencyError):
            run_scorer(store.folder.path)
    assert store.entries()[0].faults == 0
    assert run_scorer(store.folder.path) == 1


def test_reference_rows_are_scored_once_the_fault_is_repaired(store, monkeypatch):
    references = intake.submit_references(store)
    with monkeypatch.context() as patch:
        patch.setattr(scorer, "score_submission", by_zero)
        for _ in range(6):
            assert run_scorer(store.folder.path) == 0
    rows = [store.entry(id) for id in references]
    assert {row.status for row in rows} == {"waiting"}
    assert {row.fault for row in rows} == {"ZeroDivisionError: by 0"}
    assert run_scorer(store.folder.path) == len(references)
    refuse_unpublishable(store.entries())


SCRIPT = """
import sys
from leaderboard.scoring.worker import run_scorers
if __name__ == "__main__":
    started = lambda pid: print(pid, flush=True)
    try:
        run_scorers(sys.argv[1], 2, until_empty=False, started=started)
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.mark.parametrize("at_once", [True, False], ids=["while they import", "while they score"])
@pytest.mark.parametrize("to_all", [True, False], ids=["from a terminal", "to the parent"])
def test_ctrl_c_stops_all_processes_and_gives_their_claims_back(tmp_path, key, to_all, at_once):
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
    pids = [int(process.stdout.readline()) for _ in range(2)]
    with Store.open(tmp_path / "board") as store:
        for number in range(4 if at_once else 400):
            if store.queue.done() > 0:
                break
            if store.queue.waiting() < 5:
                put_submission(store, key, number)
            threading.Event().wait(0.1)
        assert at_once or store.queue.done() > 0
        if to_all:
            os.killpg(process.pid, signal.SIGINT)
        else:
            os.kill(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130, stderr
        assert "Traceback" not in stderr
        for pid in pids:
            with pytest.raises(ProcessLookupError):
                os.kill(pid, 0)
        assert store.queue.claimable() == store.queue.waiting()


def test_scorers_end_when_who_started_them_is_killed(tmp_path):
    script = tmp_path / "score.py"
    script.write_text(SCRIPT)
    tiny_board(tmp_path / "board").close()
    process = subprocess.Popen(
        [sys.executable, script, tmp_path / "board"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    pids = [int(process.stdout.readline()) for _ in range(2)]
    process.kill()
    process.communicate()
    end = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < end
        threading.Event().wait(0.05)

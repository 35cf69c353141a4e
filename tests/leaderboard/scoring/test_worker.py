from __future__ import annotations

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
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring import worker as scorer
from leaderboard.scoring.ranking import refuse_unpublishable
from leaderboard.scoring.score import score_submission
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorer, run_scorers
from leaderboard.store import ATTEMPTS, Store
from sme_registry.errors import OptionError
from tests.leaderboard.conftest import linear_onnx, put_submission, tiny_board


@pytest.fixture
def board(store, submit) -> Path:
    """A board of two real policies and one run that failed."""
    submit(1)
    submit(2)
    failed = {"spec": store.document.suite.instances[0].digest, "seed": 0, "steps": 5}
    submit(3, runs=[failed])
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
    assert store.result(first.id) == again


def test_an_invalid_policy_is_rejected_with_its_code(store, key):
    data = linear_onnx(0, observation_dim=9)
    import hashlib

    digest = "sha256:" + hashlib.sha256(data).hexdigest()
    store.put_object(digest, [data], by=key.public)
    run = {
        "spec": store.document.suite.instances[0].digest,
        "seed": 0,
        "steps": 5,
        "artefact": {"sha256": digest, "size": len(data)},
    }
    signed = put_submission(store, key, 0, runs=[run])
    assert run_scorer(store.folder.path) == 1
    assert store.entry(signed.id).code == "onnx_interface"


def test_a_fault_of_the_scorer_costs_an_attempt_and_five_the_submission(
    store, submit, monkeypatch, caplog
):
    broken, whole = submit(1), submit(2)
    real = score_submission

    def fails(document, submission, *arguments):
        if submission.digest == broken.id:
            raise ZeroDivisionError
        return real(document, submission, *arguments)

    monkeypatch.setattr(scorer, "score_submission", fails)
    with caplog.at_level(logging.ERROR):
        assert run_scorer(store.folder.path) == 1
    assert len(caplog.records) == ATTEMPTS
    assert store.entry(broken.id).code == "scoring_failed"
    assert store.entry(whole.id).status == "scored"


def test_a_fault_of_the_board_stops_the_scorer_and_costs_nothing(store, submit, monkeypatch):
    submit()
    for _ in range(ATTEMPTS + 1):
        with monkeypatch.context() as patch:
            path = store.folder.path
            patch.setattr(
                scorer, "score_submission", lambda *_: _raise(TamperedError("objects/x", "altered"))
            )
            with pytest.raises(TamperedError):
                run_scorer(path)
    assert run_scorer(path) == 1
    assert store.entries()[0].status == "scored"


def _raise(error: Exception) -> None:
    raise error


def test_heartbeats_keep_a_claim_for_as_long_as_it_is_scored(store, submit, monkeypatch):
    submit()
    real, claims = score_submission, []

    def slow(*arguments):
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            claims.append(store.queue.claim("other"))
            threading.Event().wait(0.05)
        return real(*arguments)

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


def test_zero_workers_are_refused(tmp_path):
    with pytest.raises(OptionError, match="workers=0"):
        run_scorers(tmp_path, 0)


def test_tampering_found_by_one_process_stops_all(store, board):
    path = store.folder.submission(store.entries()[0].id)
    path.write_bytes(path.read_bytes().replace(b"A tester", b"Somebody"))
    with pytest.raises(TamperedError) as tampered:
        run_scorers(board, 1)
    assert tampered.value.where == f"submissions/{path.name}"
    assert multiprocessing.active_children() == []


def test_processes_that_keep_dying_end_the_scoring(store, board, monkeypatch):
    monkeypatch.setattr(scorer, "_FUTILE_DEATHS", 2)
    with pytest.raises(BoardError, match="2 scorers died"):
        run_scorers(board, 1, started=lambda pid: os.kill(pid, signal.SIGKILL))
    assert store.queue.waiting() == 3


def test_scorers_killed_over_a_reference_row_leave_it_to_be_scored(store, monkeypatch):
    references = intake.submit_references(store)
    for attempt in range(ATTEMPTS):
        store.queue.abandon(store.queue.claim(f"killed {attempt}").worker)
    monkeypatch.setattr(scorer, "_FUTILE_DEATHS", 2)

    def kill_once_it_claims(pid):
        while store.queue.claimable() == store.queue.waiting():
            threading.Event().wait(0.01)
        os.kill(pid, signal.SIGKILL)

    with pytest.raises(BoardError, match="2 scorers died"):
        run_scorers(store.folder.path, 1, started=kill_once_it_claims)
    assert store.queue.waiting() == len(references)
    assert run_scorers(store.folder.path, 1) == len(references)
    refuse_unpublishable(store.entries())


def test_a_fault_over_a_reference_row_ends_the_scorer_and_leaves_it(store, monkeypatch, caplog):
    intake.submit_references(store)
    with monkeypatch.context() as patch:
        patch.setattr(scorer, "score_submission", lambda *_: _raise(ZeroDivisionError("by 0")))
        with caplog.at_level(logging.ERROR):
            for _ in range(ATTEMPTS + 1):
                with pytest.raises(BoardError, match=r"'optimal'.*ZeroDivisionError: by 0"):
                    run_scorer(store.folder.path)
    assert len(caplog.records) == ATTEMPTS + 1
    assert run_scorer(store.folder.path) == 2


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

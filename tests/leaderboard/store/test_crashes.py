"""A process killed before any system call leaves a state from which the next one continues."""

import shutil

import pytest

from leaderboard.errors import BoardError
from leaderboard.scoring.verify import verify
from leaderboard.store import Store
from leaderboard.store.log import collect_garbage
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import (
    linear_onnx,
    put_submission,
    signed_withdrawal,
    tiny_board,
    tiny_submission,
)
from tests.leaderboard.store.crashing import crashes_before, fill, small_disk
from tests.leaderboard.store.synthetic import synthetic_result


def put(board, key):
    data = linear_onnx(1)
    with Store.open(board) as store:
        digest = sha256_of(data)
        return store.put_object(digest, data, by=key.public)


def receive(board, key):
    with Store.open(board) as store:
        signed, artefacts = tiny_submission(store, key, 0, created="2026-01-01T00:00:00Z")
        assert set(artefacts) == {run.artefact.sha256 for run in signed.content.runs}
        return store.receive(signed)


def finish(board, key):
    with Store.open(board) as store:
        while (claim := store.queue.claim("worker", seconds=0)) is not None:
            store.queue.finish(claim, synthetic_result(store, claim.id))
        return True


def withdraw(board, key):
    with Store.open(board) as store:
        return store.withdraw(signed_withdrawal(store, store.entries()[0].id, key))


def prepared(path, key, work):
    with tiny_board(path) as store:
        if work is receive:
            _, artefacts = tiny_submission(store, key, 0)
            for digest, data in artefacts.items():
                store.put_object(digest, data, by=key.public)
        elif work is not put:
            put_submission(store, key, 0)


def state(board):
    """What a reader of the board is shown."""
    with Store.open(board) as store:
        statuses = tuple(row.status for row in store.entries())
        return store.total_bytes(), statuses, store.head.sequence


@pytest.mark.parametrize("work", [put, receive, finish, withdraw])
def test_a_write_is_complete_or_absent_and_can_be_repeated(tmp_path, key, work):
    prepared(tmp_path / "start", key, work)
    before = state(tmp_path / "start")
    shutil.copytree(tmp_path / "start", tmp_path / "end")
    work(tmp_path / "end", key)
    after = state(tmp_path / "end")
    assert before != after
    board, seen = tmp_path / "board", set()
    for call in range(100):
        shutil.copytree(tmp_path / "start", board)
        crashed = crashes_before(call, lambda: work(board, key))
        actual = state(board)
        assert actual in (before, after), call
        seen.add(actual)
        verify(board)
        work(board, key)
        assert state(board) == after, call
        with Store.open(board) as store:
            collect_garbage(store, temporary_older_than=0, objects_older_than=1e9)
        assert [path.name for path in board.rglob(".*")] == []
        shutil.rmtree(board)
        if not crashed:
            break
    assert not crashed
    assert call >= 4
    assert seen == {before, after}


def test_a_board_is_created_completely_or_not_at_all(tmp_path):
    board, exists = tmp_path / "board", []
    for call in range(100):
        crashed = crashes_before(call, lambda: tiny_board(board).close())
        exists.append(board.exists())
        if board.exists():
            verify(board)
            Store.open(board).close()
            shutil.rmtree(board)
        if not crashed:
            break
    assert not crashed
    assert exists == sorted(exists)
    assert {False, True} == set(exists)


def test_a_full_disk_is_reported_and_leaves_no_partial_file(tmp_path, key):
    with small_disk(tmp_path / "disk", "2000k") as disk:
        if disk is None:
            pytest.skip("no file system may be mounted here")
        messages = []
        with tiny_board(disk / "board") as store:
            for number in range(0, 28, 2):
                _, _, before = state(disk / "board")
                fill(disk / "filler", free=4096 * number)
                try:
                    put_submission(store, key, number)
                except BoardError as error:
                    messages.append(str(error))
                (disk / "filler").unlink()
                # An entry of the log that the index had no room for counts all the same.
                _, statuses, after = state(disk / "board")
                assert after == len(statuses)
                assert after - before in (0, 1)
                assert [path.name for path in (disk / "board").rglob(".*")] == []
                verify(disk / "board")
        assert 0 < len(messages) < 14
        assert all("No space left" in line or "is full" in line for line in messages), messages
        with Store.open(disk / "board") as store:
            put_submission(store, key, 999)
        verify(disk / "board")

import os
import shutil
import traceback

import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError
from leaderboard.store import Store
from leaderboard.store.index import Index
from leaderboard.store.log import collect_garbage
from tests.leaderboard.conftest import (
    derived,
    put_submission,
    signed_withdrawal,
    tiny_board,
)
from tests.leaderboard.store.crashing import fork, make_read_only, small_disk
from tests.leaderboard.store.synthetic import synthetic_result


def fill(store, key, *, waiting=False):
    """Submissions of every status; a waiting one only where asked for."""
    signed = [put_submission(store, key, number) for number in range(4)]
    for number in range(3):
        claim = store.queue.claim("worker")
        assert claim is not None
        assert claim.id == signed[number].id
        code = "onnx_op" if number == 1 else ""
        assert store.queue.finish(claim, synthetic_result(store, claim.id, code=code))
    store.withdraw(signed_withdrawal(store, signed[2].id, key))
    if not waiting:
        store.withdraw(signed_withdrawal(store, signed[3].id, key))


def test_a_grown_index_equals_a_rebuilt_one_in_the_same_file(tmp_path, key):
    with tiny_board(tmp_path / "board") as store, Store.open(tmp_path / "board") as other:
        fill(store, key, waiting=True)
        grown, file = derived(store), store.folder.index.stat().st_ino
        other.reindex()
        assert derived(store) == derived(other) == grown
        assert put_submission(store, key, 9).id == other.entries()[-1].id
        assert store.folder.index.stat().st_ino == file
    shutil.copytree(tmp_path / "board", tmp_path / "copy")
    (tmp_path / "copy" / "index.sqlite").unlink()
    with Store.open(tmp_path / "copy") as store, Store.open(tmp_path / "board") as other:
        assert derived(store) == derived(other)
        rows = store.entries()
        store.folder.objects.rename(tmp_path / "objects")  # a page reads none of their files
        assert store.entries() == rows
        assert store.entry(rows[0].id) == rows[0]


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A board with submissions of every status, to be copied."""
    path = tmp_path_factory.mktemp("filled") / "board"
    with tiny_board(path) as store:
        fill(store, SigningKey.generate(), waiting=True)
    return path


@pytest.mark.parametrize("harm", ["torn", "another board"])
def test_an_unusable_index_is_rebuilt_on_opening(tmp_path, filled, key, harm):
    shutil.copytree(filled, tmp_path / "board")
    with Store.open(tmp_path / "board") as store:
        expected = derived(store)
        path = store.folder.index
    if harm == "torn":
        data = path.read_bytes()
        path.write_bytes(data[:4096] + bytes(len(data) - 8192) + data[-4096:])
    else:
        with tiny_board(tmp_path / "other") as other:
            put_submission(other, key)
        shutil.copyfile(tmp_path / "other" / "index.sqlite", path)
    before = path.read_bytes()
    with Store.open(tmp_path / "board", read_only=True) as store:
        assert len(store.entries()) == 4
    assert path.read_bytes() == before
    with Store.open(tmp_path / "board") as store:
        assert derived(store) == expected


def test_an_index_that_is_behind_catches_up_and_one_with_a_wrong_head_is_rebuilt(tmp_path, key):
    board = tmp_path / "board"
    with tiny_board(board) as store:
        put_submission(store, key)
    shutil.copyfile(board / "index.sqlite", tmp_path / "old")
    with Store.open(board) as store:
        rest = [put_submission(store, key, number) for number in (1, 2)]
        expected, second = derived(store), store.log(2, 1)[0]
    shutil.copyfile(tmp_path / "old", board / "index.sqlite")
    with Store.open(board, read_only=True) as store:
        assert store.entry(rest[0].id) is not None
    with Store.open(board) as store:
        assert derived(store) == expected
        with store.transaction() as index:
            index.connection.execute("UPDATE head SET sequence = ?, digest = ?", (2, second.digest))
    for read_only in (True, False):
        with Store.open(board, read_only=read_only) as store:
            assert len(store.entries()) == 3
    with Store.open(board) as store:
        assert derived(store) == expected


def test_read_only_opening_writes_nothing(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        fill(store, key, waiting=True)
    names = sorted(path.name for path in (tmp_path / "board").iterdir())
    with Store.open(tmp_path / "board", read_only=True) as store:
        assert len(store.entries()) == 4
        for refused in (
            lambda: store.put_object("sha256:" + "0" * 64, b"", by=key.public),
            lambda: put_submission(store, key, 9),
            lambda: store.queue.claim("worker"),
            store.reindex,
            lambda: collect_garbage(store),
        ):
            with pytest.raises(BoardError, match="read-only"):
                refused()
    left = {path.name for path in (tmp_path / "board").iterdir()}
    assert left - set(names) <= {"index.sqlite-wal", "index.sqlite-shm"}


def test_a_board_on_a_read_only_disk_is_read(tmp_path, key):
    with small_disk(tmp_path / "disk", "4m") as disk:
        if disk is None:
            if os.geteuid() == 0:
                pytest.skip("root may neither mount here nor be kept from writing by modes")
            disk = tmp_path / "disk"
        board = disk / "board"
        with tiny_board(board) as store:
            fill(store, key, waiting=True)
            expected = derived(store)
        if disk.is_mount():
            make_read_only(disk)
        else:
            for path in [board, *board.rglob("*")]:
                path.chmod(0o555 if path.is_dir() else 0o444)
        with pytest.raises(OSError, match=r"denied|ead-only"):
            (board / "new").touch()
        with Store.open(board, read_only=True) as read:
            assert derived(read) == expected
        with pytest.raises(BoardError):
            Store.open(board)


def test_transactions_of_processes_do_not_overlap(tmp_path, key):
    tiny_board(tmp_path / "board").close()
    children = []
    for worker in range(3):
        child = fork()
        if child == 0:
            status = 1
            try:
                with Store.open(tmp_path / "board") as store:
                    for number in range(10 * worker, 10 * worker + 4):
                        put_submission(store, key, number)
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0, 0]
    with Store.open(tmp_path / "board") as store:
        assert len(store.entries()) == 12
        assert [entry.sequence for entry in store.log()] == list(range(13))
        expected = derived(store)
        store.reindex()
        assert derived(store) == expected


def test_transactions_nest_and_one_that_fails_after_the_log_entry_loses_nothing(store, key):
    def fails():
        with store.transaction() as outer, store.transaction() as inner:
            assert isinstance(inner, Index)
            assert inner is outer
            put_submission(store, key)
            assert len(store.entries()) == 1
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert len(store.entries()) == 1
    assert put_submission(store, key, 1)
    assert [entry.sequence for entry in store.log()] == [0, 1, 2]


def test_a_board_is_created_only_in_a_new_or_empty_folder(tmp_path):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").write_text("mine")
    with pytest.raises(BoardError, match="already exists"):
        tiny_board(tmp_path / "taken")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
    (tmp_path / "board").mkdir()  # an empty folder is as good as none
    tiny_board(tmp_path / "board").close()
    before = (tmp_path / "board" / "board.json").read_bytes()
    with pytest.raises(BoardError, match="already exists"):
        tiny_board(tmp_path / "board")
    assert (tmp_path / "board" / "board.json").read_bytes() == before

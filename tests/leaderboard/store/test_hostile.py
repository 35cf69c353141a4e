"""Copies of boards that a stranger has prepared: readers neither hang nor believe the index."""

import contextlib
import json
import os
import shutil
import signal
import socket
import sqlite3
from pathlib import Path

import pytest

from leaderboard.documents.board import Folder
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.verify import verify
from leaderboard.store import Store
from sme_registry.errors import SMEError
from tests.leaderboard.conftest import document_path, put_submission, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result

SECONDS = 60  # far more than reading takes; a reader that hangs fails its test


@pytest.fixture(autouse=True)
def alarm():
    def ring(*_):
        raise AssertionError(f"still reading after {SECONDS} s")

    previous = signal.signal(signal.SIGALRM, ring)
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two scored submissions, and one that waits."""
    path, key = tmp_path_factory.mktemp("hostile") / "board", SigningKey.generate()
    with tiny_board(path) as store:
        for number in range(2):
            put_submission(store, key, number)
            claim = store.queue.claim("worker")
            assert claim is not None
            store.queue.finish(claim, synthetic_result(store, claim.id, level=0.5 - 0.1 * number))
        put_submission(store, key, 2)
    return path


@pytest.fixture
def board(whole, tmp_path):
    """A copy without the private key, as a stranger publishes it."""
    copy = shutil.copytree(whole, tmp_path / "board")
    (copy / "board.key").unlink()
    return copy


@pytest.fixture
def rows(whole):
    return rows_of(whole)


def rows_of(board, *, read_only=True):
    with Store.open(board, read_only=read_only) as store:
        return store.entries()


def pipe(path):
    os.mkfifo(path)


def endless_link(path):
    path.symlink_to("/dev/zero")


def link_to_a_copy(path):
    elsewhere = path.with_name("elsewhere")
    elsewhere.write_bytes(b"{}")
    path.symlink_to(elsewhere)


def terabyte(path):
    with open(path, "wb") as stream:
        stream.truncate(2**40)


def deaf_socket(path):
    home = Path.cwd()
    os.chdir(path.parent)  # the address of a socket has at most 107 characters
    try:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(path.name)
    finally:
        os.chdir(home)


HARMS = (pipe, endless_link, link_to_a_copy, terabyte, deaf_socket, Path.mkdir)


def replace(path, harm):
    path.unlink(missing_ok=True)
    harm(path)


FILES = ("board", "log", "submission", "result", "object", "next log")


@pytest.mark.parametrize(
    ("file", "harm"),
    [*zip(FILES, HARMS, strict=True), *((file, pipe) for file in FILES[1:])],
    ids=lambda each: getattr(each, "__name__", each),
)
def test_readers_refuse_what_is_no_plain_file(board, harm, file):
    folder = Folder(board)
    with Store.open(board, read_only=True) as store:
        row, last = store.entries()[0], store.head.sequence
        artefact = store.submission(row.id).content.runs[0].artefact
    path = {
        "board": folder.board,
        "log": folder.log_entry(1),
        "submission": document_path(board, row.id),
        "result": document_path(board, row.id, "result"),
        "object": folder.object(artefact.sha256),
        "next log": folder.log_entry(last + 1),
    }[file]
    replace(path, harm)
    with pytest.raises(SMEError) as refused:
        verify(board)
    assert path.name in str(refused.value)
    for read_only in (True, False):
        if file != "object":
            with pytest.raises((BoardError, TamperedError)):
                rows_of(board, read_only=read_only)
        else:
            with (
                Store.open(board, read_only=read_only) as store,
                pytest.raises((BoardError, TamperedError)),
            ):
                store.objects.read(artefact.sha256)


@pytest.mark.parametrize(
    ("suffix", "harm"),
    [*(("", harm) for harm in HARMS), ("-wal", pipe), ("-shm", Path.mkdir), ("-journal", terabyte)],
    ids=lambda each: getattr(each, "__name__", each),
)
def test_no_reader_needs_the_index_and_a_writer_rebuilds_it(whole, tmp_path, rows, harm, suffix):
    board = shutil.copytree(whole, tmp_path / "board")
    path = board / f"index.sqlite{suffix}"
    replace(path, harm)
    assert rows_of(board) == rows
    verify(board)
    if harm is Path.mkdir:  # never removed, as files may lie in it
        with pytest.raises(BoardError, match=r"index\.sqlite"):
            rows_of(board, read_only=False)
    else:
        assert rows_of(board, read_only=False) == rows
        verify(board)


ENDLESS = """
WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS zero, 'x' AS board,
i AS sequence, 'x' AS digest, 'x' AS time FROM n
"""


@pytest.mark.parametrize(
    "change",
    [
        f"DROP TABLE head; CREATE VIEW head AS {ENDLESS};",
        "CREATE TRIGGER t AFTER INSERT ON entry BEGIN DELETE FROM entry; END;",
        "UPDATE entry SET submitter = 'Somebody', scores = replace(scores, '0.', '0.0')",
    ],
    ids=["endless view", "trigger", "lie"],
)
def test_a_changed_index_has_no_effect_and_is_repaired(whole, tmp_path, rows, change):
    board = shutil.copytree(whole, tmp_path / "board")
    with contextlib.closing(sqlite3.connect(board / "index.sqlite")) as connection:
        connection.executescript(change)
        connection.commit()
    lies, own = change.startswith("UPDATE"), shutil.copytree(board, tmp_path / "own")
    assert rows_of(board) == rows
    verify(board)
    if lies:  # without its key, a board's index is somebody else's
        (board / "board.key").unlink()
    assert rows_of(board, read_only=False) == rows
    verify(board)
    with Store.open(own, reindex=True) as store:
        assert store.entries() == rows


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"rules": 1}, "is of rules 1, which commit"),
        ({"draws": 10**7}, "draws"),
        ({"seeds": list(range(1001))}, "1,001 instances"),
        ({"title": "x" * 2**21}, "bytes"),
    ],
    ids=lambda each: "" if isinstance(each, str) else next(iter(each)),
)
def test_a_board_of_excessive_numbers_or_of_rules_1_is_refused_at_once(board, change, reason):
    path = Folder(board).board
    plain = json.loads(path.read_text())
    for name, value in change.items():
        if name == "seeds":
            plain["suite"]["classes"][0]["seeds"] = value
        else:
            plain[name] = value
    path.write_text(json.dumps(plain, indent=2))
    with pytest.raises(BoardError, match=reason):
        rows_of(board)

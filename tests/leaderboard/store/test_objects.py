"""Objects, the lock of a board, and boards without `flock`: read, but not written."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store import Store, log
from leaderboard.store.log import FolderLock
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import tiny_board

KEY = "ab" * 32


def stored(store):
    return [path.name for path in store.folder.objects.rglob("*") if path.is_file()]


def test_what_is_too_large_leaves_nothing(tmp_path):
    with tiny_board(tmp_path / "board", limits={"artefact_bytes": 1000}) as store:
        with pytest.raises(Rejection) as refused:
            store.put_object(sha256_of(bytes(1001)), bytes(1001), by=KEY)
        assert refused.value.code == "too_large"
        assert stored(store) == []
        assert store.put_object(sha256_of(bytes(1000)), bytes(1000), by=KEY)


def test_altered_missing_and_misnamed_objects_are_not_returned(store):
    store.put_object(sha256_of(b"policy"), b"policy", by=KEY)
    store.folder.object(sha256_of(b"policy")).write_bytes(b"Policy")
    with pytest.raises(TamperedError, match="objects/"):
        store.objects.read(sha256_of(b"policy"))
    with pytest.raises(BoardError, match="cannot be read"):
        store.objects.read(sha256_of(b"never seen"))
    for name in ("../../board.key", "sha256:../board.key", "sha256:" + "A" * 64):
        with pytest.raises(ValueError, match="not a digest"):
            store.objects.has(name)


WITHOUT_POSIX = """
import sys
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
from leaderboard.cli import main
for command in ("rank", "verify"):
    sys.argv = ["sme-leaderboard", command, "examples/board", "--json"]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, command
"""


def test_readers_share_the_lock_and_a_writer_excludes_them(tmp_path, monkeypatch):
    monkeypatch.setattr(log, "BUSY_SECONDS", 0.05)
    one, other = FolderLock(tmp_path), FolderLock(tmp_path)
    with one.hold(exclusive=False), other.hold(exclusive=False):
        pass
    with one.hold(exclusive=True):
        start = time.monotonic()
        with pytest.raises(BoardError, match="another process"), other.hold(exclusive=False):
            pass
        assert time.monotonic() - start >= 0.05
    with other.hold(exclusive=True):
        pass
    one.close()
    one.close()
    with pytest.raises(BoardError, match="closed"), one.hold(exclusive=False):
        pass
    other.close()


def test_a_board_is_read_but_not_written_without_flock(store, submit, monkeypatch):
    signed = submit()
    monkeypatch.setattr(log, "fcntl", None)
    with Store.open(store.folder.path, read_only=True) as reader:
        assert [entry.id for entry in reader.entries()] == [signed.id]
    with pytest.raises(BoardError, match="only be written on Linux and macOS"):
        Store.open(store.folder.path)


def test_reading_commands_run_without_posix_modules():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows, report = done.stdout.split("\n{", 1)
    assert json.loads(rows)
    assert json.loads("{" + report)

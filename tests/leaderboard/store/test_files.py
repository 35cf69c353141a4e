"""The board's lock, and boards on systems without `flock`, where they are read but not written."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from leaderboard.errors import BoardError
from leaderboard.store import Store, files
from leaderboard.store.files import FolderLock

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


def test_readers_share_the_lock_and_a_writer_excludes_them(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(files, "BUSY_SECONDS", 0.05)
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


def test_a_board_is_read_but_not_written_without_flock(store: Store, submit, monkeypatch) -> None:
    signed = submit()
    monkeypatch.setattr(files, "fcntl", None)
    with Store.open(store.folder.path, read_only=True) as reader:
        assert [entry.id for entry in reader.entries()] == [signed.id]
    with pytest.raises(BoardError, match="only be written on Linux and macOS"):
        Store.open(store.folder.path)


def test_reading_commands_run_without_posix_modules() -> None:
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

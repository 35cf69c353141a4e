"""Locks between processes: exclusive, and released when their holder is killed."""

import subprocess
import sys
import threading
import time

import pytest

from sme_registry.errors import OptionError
from sme_registry.io import file_lock, is_locked

HOLD = """
import sys, time
from sme_registry.io import file_lock
lock = file_lock(sys.argv[1])
print("held", flush=True)
time.sleep(600)
"""


def test_a_lock_is_exclusive_until_it_is_released(tmp_path):
    path = tmp_path / "locks" / "a"
    assert not is_locked(path)
    assert not path.exists()
    with file_lock(path):
        assert file_lock(path) is None
        assert is_locked(path)
        assert file_lock(path.with_name("b")) is not None
    assert not is_locked(path)
    lock = file_lock(path)
    lock.release()
    lock.release()
    assert file_lock(path) is not None
    path.write_text("content")
    with file_lock(path):
        assert path.read_text() == "content"
    assert path.read_text() == "content"


def test_a_lock_of_a_killed_process_is_free(tmp_path):
    path = tmp_path / "lock"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout.readline() == "held\n"
        assert is_locked(path)
        assert file_lock(path) is None
        holder.kill()
    assert not is_locked(path)
    assert file_lock(path) is not None


def test_waiting_for_a_lock_ends_at_its_release_or_at_the_timeout(tmp_path):
    path = tmp_path / "lock"
    lock = file_lock(path)
    begin = time.monotonic()
    assert file_lock(path, timeout=0.2) is None
    assert time.monotonic() - begin >= 0.2
    timer = threading.Timer(0.1, lock.release)  # a lock may be released by another thread
    timer.start()
    assert file_lock(path, timeout=60) is not None
    timer.join()


def test_a_lock_that_cannot_be_made_is_an_error_and_not_a_held_lock(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file" / "lock"):
        with pytest.raises(OptionError, match="cannot be locked"):
            file_lock(path)
        assert not is_locked(path)

"""Output folders: refused, claimed, and built whole or not at all; locks between processes."""

import os
import subprocess
import sys
import threading
import time

import pytest

from sme_registry.errors import OptionError, PolicyError
from sme_registry.io import build_folder, check_new, claim_folder, file_lock, is_locked


def test_an_existing_path_is_refused_without_force(tmp_path):
    assert check_new(tmp_path / "new") == tmp_path / "new"
    with pytest.raises(OptionError, match="cannot be written"):
        check_new("/", force=True)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path, tmp_path / "link"):
        with pytest.raises(OptionError, match=r"already exists\. Use --force to replace it"):
            check_new(path)
        assert check_new(path, force=True) == path


@pytest.mark.parametrize("place", ["file/evaluation.json", "file/a/b", "null\0"])
def test_a_path_that_cannot_be_written_is_refused_before_the_work(tmp_path, place):
    (tmp_path / "file").write_text("")
    path = tmp_path / place
    for check in (
        check_new,
        lambda path: claim_folder(path, []),
        lambda path: build_folder(path).__enter__(),
    ):
        with pytest.raises(OptionError, match="cannot be written"):
            check(path)
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == ""


def test_a_claimed_folder_is_created_with_its_parents(tmp_path):
    folder = claim_folder(tmp_path / "a" / "b", ["run.json"])
    assert folder.is_dir()
    (folder / ".lock").write_text("")  # a hidden file does not count
    assert claim_folder(folder, ["run.json"]) == folder


def test_a_folder_with_output_needs_force_and_one_with_other_files_is_always_refused(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(OptionError, match="already exists"):
        claim_folder(tmp_path, ["run.json"])
    assert claim_folder(tmp_path, ["run.json"], force=True) == tmp_path
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(OptionError, match=r"contains other files, such as 'thesis\.tex'"):
        claim_folder(tmp_path, ["run.json"], force=True)
    with pytest.raises(OptionError, match="is a file"):
        claim_folder(tmp_path / "thesis.tex", [], force=True)
    with pytest.raises(OptionError, match="cannot be written"):
        claim_folder(tmp_path / "thesis.tex" / "inside", [])


def test_a_built_folder_appears_complete_and_leaves_nothing_else(tmp_path):
    target = tmp_path / "sets" / "new"
    with build_folder(target) as building:
        (building / "data").mkdir()
        (building / "data" / "file").write_text("whole")
        assert not target.exists()
    assert (target / "data" / "file").read_text() == "whole"
    assert [path.name for path in target.parent.iterdir()] == ["new"]
    (tmp_path / "plain").mkdir()
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode
    other = tmp_path / "other"
    with pytest.raises(OptionError, match="already exists"), build_folder(other):
        other.mkdir()  # appears while building, and is not replaced
    assert list(other.iterdir()) == []


@pytest.mark.parametrize("old", ["folder", "file"])
def test_force_replaces_an_existing_target_only_when_the_new_one_is_complete(tmp_path, old):
    target = tmp_path / "target"
    if old == "folder":
        target.mkdir()
        (target / "old").write_text("")
    else:
        target.write_text("old")
    with pytest.raises(OptionError, match="already exists"), build_folder(target):
        pytest.fail("the block must not run")

    def fail_halfway():
        with build_folder(target, force=True) as building:
            (building / "half").write_text("")
            raise PolicyError("broken")

    with pytest.raises(PolicyError, match="broken"):
        fail_halfway()
    assert target.is_file() or [path.name for path in target.iterdir()] == ["old"]
    with build_folder(target, force=True) as building:
        (building / "new").write_text("")
    assert [path.name for path in target.iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["target"]


def test_a_failing_rename_restores_the_old_folder(tmp_path, monkeypatch):
    target = tmp_path / "target"
    target.mkdir()
    (target / "old").write_text("")
    rename = os.rename
    calls = []

    def fail_second(source, destination):
        calls.append(source)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")
        rename(source, destination)

    monkeypatch.setattr(os, "rename", fail_second)
    with (
        pytest.raises(OptionError, match=r"cannot be written: No space left"),
        build_folder(target, force=True),
    ):
        pass
    assert [path.name for path in target.iterdir()] == ["old"]
    assert [path.name for path in tmp_path.iterdir()] == ["target"]


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

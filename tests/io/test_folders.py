"""Output folders: refused, claimed, and built completely or not at all."""

import os

import pytest

from sme_registry.errors import OptionError, PolicyError
from sme_registry.io import build_folder, claim_folder, refuse_existing


def test_an_existing_path_is_refused_without_force(tmp_path):
    assert refuse_existing(tmp_path / "new") == tmp_path / "new"
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path, tmp_path / "link"):
        with pytest.raises(OptionError, match=r"already exists\. Use --force to replace it"):
            refuse_existing(path)
        assert refuse_existing(path, force=True) == path


@pytest.mark.parametrize("place", ["file/evaluation.json", "file/a/b", "null\0"])
def test_a_path_that_cannot_be_written_is_refused_before_the_work(tmp_path, place):
    (tmp_path / "file").write_text("")
    path = tmp_path / place
    for check in (
        refuse_existing,
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

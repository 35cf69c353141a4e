"""Strict JSON in; whole files of text or arrays out, or none."""

import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from sme_registry.errors import MalformedDocumentError, OptionError, SpecError
from sme_registry.io import (
    parse_json,
    read_arrays,
    read_json,
    to_json,
    write_arrays,
    write_atomically,
)

MALFORMED = {
    "empty": (b"", "Expecting value: line 1 column 1"),
    "truncated": (b'{"k": 1,\n "D"', "Expecting ':' delimiter: line 2 column 5"),
    "trailing text": (b'{"k": 1} {}', "is not JSON in UTF-8: Extra data"),
    "NaN": (b'{"r_min": NaN}', "NaN is not valid JSON. Use a finite number."),
    "minus infinity": (b'{"r_min": -Infinity}', "-Infinity is not valid JSON."),
    "duplicate key": (b'{"k": 1, "k": 2}', "the key 'k' occurs twice."),
    "inner duplicate key": (b'{"spec": {"k": 1, "k": 1}}', "the key 'k' occurs twice."),
    "byte order mark": (b'\xef\xbb\xbf{"k": 1}', "Unexpected UTF-8 BOM"),
    "not UTF-8": (b'{"k": "\xff"}', "can't decode byte 0xff in position 7"),
    "deep nesting": (b"[" * 100_000, "nested too deeply"),
    "deep objects": (b'{"a":' * 100_000, "nested too deeply"),
    "huge integer": (b'{"k": ' + b"9" * 5000 + b"}", "4300 digits"),
}


@pytest.mark.parametrize("text", MALFORMED)
def test_malformed_json_is_refused_with_its_place_and_path(text, tmp_path):
    data, fragment = MALFORMED[text]
    path = tmp_path / "bad.json"
    path.write_bytes(data)
    with pytest.raises(MalformedDocumentError) as caught:
        read_json(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert fragment in str(caught.value)
    assert isinstance(caught.value, SpecError)


def test_strict_json_is_read_and_written_as_it_stands():
    value = {"a": [1, -0.5, "ä", None, True]}
    assert parse_json(b'{"a": [1, -0.5, "\xc3\xa4", null, true]}') == value
    assert parse_json(to_json(value)) == value
    assert "ä" in to_json(value)
    assert to_json(value).endswith("}\n")
    with pytest.raises(ValueError, match="Out of range float"):
        to_json({"a": float("nan")})


def test_missing_files_folders_and_impossible_paths_cannot_be_read(tmp_path):
    for path in (tmp_path / "no.json", tmp_path, tmp_path / "no" / "no.json", "a\0.json"):
        with pytest.raises(MalformedDocumentError, match=r"cannot be read: .+\."):
            read_json(path)


def test_a_file_too_large_for_any_document_is_not_even_read(tmp_path):
    path = tmp_path / "large.json"
    with path.open("wb") as stream:
        stream.truncate(65 * 2**20)  # a hole: takes no room
    with pytest.raises(MalformedDocumentError, match="has more than 67,108,864 bytes"):
        read_json(path)


def test_a_write_makes_folders_replaces_and_leaves_nothing_beside(tmp_path):
    path = tmp_path / "new" / "folder" / ("n" * 255)
    assert write_atomically(path, "one\n") == path
    write_atomically(path, b"two\n")
    assert path.read_bytes() == b"two\n"
    assert [child.name for child in path.parent.iterdir()] == [path.name]
    (tmp_path / "plain").write_text("")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_failing_rename_leaves_the_target_and_no_temporary_file(tmp_path):
    target = tmp_path / "taken"
    (target / "inside").mkdir(parents=True)
    with pytest.raises(OptionError, match="cannot be written"):
        write_atomically(target, "new")
    assert [child.name for child in tmp_path.iterdir()] == ["taken"]
    assert (target / "inside").is_dir()


def test_a_write_interrupted_before_the_rename_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")

    def interrupt(handle):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "new" * 1000)
    assert path.read_text() == "old"
    assert [child.name for child in tmp_path.iterdir()] == ["file"]


def test_a_killed_writer_leaves_the_old_file_whole_and_a_killed_builder_no_folder(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    script = """
        import os, signal, sys
        from sme_registry.io import build_folder, write_atomically
        os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)  # all written, not renamed
        with build_folder(sys.argv[2]) as building:
            (building / "file").write_text("x")
            write_atomically(sys.argv[1], "new" * 100_000)
    """
    killed = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(path), str(tmp_path / "target")],
        check=False, timeout=60,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL
    assert path.read_text() == "old"
    assert all(each == path or each.match(".*.tmp*") for each in tmp_path.iterdir())


def test_a_folder_that_may_not_be_written_to_is_refused(tmp_path):
    folder = tmp_path / "read-only"
    folder.mkdir()
    (folder / "file").write_text("old")
    folder.chmod(0o555)
    script = """
        import os, sys
        from sme_registry.errors import OptionError
        from sme_registry.io import write_atomically
        os.chdir(sys.argv[1])
        if os.geteuid() == 0:
            os.seteuid(65534)  # root may write anywhere: be nobody
        try:
            write_atomically("file", "new")
        except OptionError as error:
            print(error)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(folder)],
        check=True, timeout=60, capture_output=True, text=True,
    )  # fmt: skip
    assert "file: cannot be written: Permission denied. Give a path in a folder" in done.stdout
    assert [child.name for child in folder.iterdir()] == ["file"]
    assert (folder / "file").read_text() == "old"


@pytest.mark.parametrize(
    ("name", "content"),
    [("a\0b", "x"), ("x" * 300, "x"), ("file", "\ud800"), ("file/inside", "x")],
)
def test_paths_and_texts_that_cannot_be_written_are_refused(tmp_path, name, content):
    (tmp_path / "file").write_text("old")
    with pytest.raises(OptionError, match="cannot be written"):
        write_atomically(f"{tmp_path}/{name}", content)
    assert [child.name for child in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "old"


ARRAYS = {"a/b": np.arange(6.0).reshape(2, 3), "text": np.array("{}"), "no": np.zeros(0)}


def test_arrays_come_back_with_their_types_and_shapes_all_or_some(tmp_path):
    path = tmp_path / "new" / "state.npz"
    path.parent.mkdir()
    killed, other = (path.with_name(f".{name}.npz.0123.tmp") for name in ("state", "other"))
    for rest in (killed, other):
        rest.write_bytes(b"PK")
    write_arrays(path, ARRAYS)  # removes what killed writes of the file left
    assert set(path.parent.iterdir()) == {path, other}
    read = read_arrays(path)
    assert read.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert read[name].dtype == array.dtype
        np.testing.assert_array_equal(read[name], array)
    assert read_arrays(path, ["text"]).keys() == {"text"}
    with pytest.raises(OptionError, match="KeyError"):
        read_arrays(path, ["header"])


@pytest.mark.parametrize("damage", ["missing", "cut short", "no archive", "code", "one array"])
def test_what_is_no_file_of_such_arrays_is_refused(tmp_path, damage):
    path = tmp_path / "state.npz"
    write_arrays(path, ARRAYS)
    if damage == "missing":
        path.unlink()
    elif damage == "cut short":
        path.write_bytes(path.read_bytes()[:-40])
    elif damage == "no archive":
        path.write_bytes(b"PK")
    elif damage == "code":
        np.savez(path, a=np.array([object()]))
    else:
        with path.open("wb") as stream:
            np.save(stream, np.zeros(2))
    with pytest.raises(OptionError, match=f"{path.name}: cannot be read: .*Remove it"):
        read_arrays(path)

"""Named arrays: written whole or not at all, read without running the code of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sme_registry.errors import OptionError
from sme_registry.io import Arrays, read_arrays, write_arrays

ARRAYS: Arrays = {"a/b": np.arange(6.0).reshape(2, 3), "text": np.array("{}"), "no": np.zeros(0)}


def test_arrays_come_back_with_their_types_and_shapes_all_or_some(tmp_path: Path) -> None:
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


def test_a_write_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    write_arrays(path, ARRAYS)
    before = path.read_bytes()
    with pytest.raises(OptionError, match="cannot be written: Is a directory"):
        write_arrays(tmp_path, ARRAYS)
    with pytest.raises(OptionError, match="cannot be written"):
        write_arrays(path / "below.npz", ARRAYS)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("damage", ["missing", "cut short", "no archive", "code", "one array"])
def test_what_is_no_file_of_such_arrays_is_refused(tmp_path: Path, damage: str) -> None:
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

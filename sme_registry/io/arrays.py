"""Named arrays in a file: an .npz, written completely or not at all, whose reading runs no code."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.io.files import TEMPORARY, atomic_file, unwritable

Arrays = dict[str, npt.NDArray[Any]]


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays of numbers or text, and remove what killed writes left of the file.

    They may be gigabytes: no copy is made in memory. The folder is created if it is missing.

    Raises:
      OptionError: the file cannot be written; an existing one is unchanged.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for rest in path.parent.glob(TEMPORARY):
            if rest.name.startswith(f".{path.name}."):
                rest.unlink(missing_ok=True)
        with atomic_file(path) as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
    except (OSError, ValueError) as error:
        raise unwritable(path, error) from None


def read_arrays(path: str | os.PathLike[str], names: Collection[str] | None = None) -> Arrays:
    """The arrays of a file; with `names`, these alone, and no others are read.

    Raises:
      OptionError: there is no such file, or it is damaged or lacks one of the names.
    """
    try:
        # Opened here: NumPy leaves a file open that is no archive.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in (archive.files if names is None else names)}
    except Exception as error:  # of many kinds, by what is damaged
        raise OptionError(
            f"{os.fspath(path)}: cannot be read: {type(error).__name__}: {error}. Remove it."
        ) from error

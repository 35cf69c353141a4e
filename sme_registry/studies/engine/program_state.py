"""The state of a program that runs, in a file: written every few minutes, read after a kill.

An .npz of the program's arrays and of the records of its lanes. Its header says for which cells, in
which lanes, and with what it was made: other versions, devices or numbers of lanes would go on with
other bits, so such a file is not used.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.io import TEMPORARY, atomic_file, to_json

Arrays = dict[str, npt.NDArray[Any]]
_HEADER = "header"


def write_state(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a state, completely or not at all, and remove what killed writes left of it.

    Raises:
      OptionError: it cannot be written; an existing one is unchanged.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for rest in path.parent.glob(TEMPORARY):
            if rest.name.startswith(f".{path.name}."):
                rest.unlink(missing_ok=True)
        with atomic_file(path) as stream:
            members: dict[str, Any] = {_HEADER: np.array(to_json(header)), **arrays}
            np.savez(stream, **members)
    except OSError as error:
        raise OptionError(
            f"{path}: cannot be written: {error.strerror}. Make room, or the program starts again "
            "from its beginning if it is interrupted."
        ) from None


def read_header(path: Path) -> dict[str, Any] | None:
    """The header of a state; None if there is no valid one. Reads no more than that."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(str(archive[_HEADER]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return header if isinstance(header, dict) else None


def read_state(path: Path, header: Mapping[str, Any]) -> Arrays | None:
    """The arrays of a state with exactly this header; None if there is no valid one."""
    if read_header(path) != json.loads(to_json(header)):
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if name != _HEADER}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None

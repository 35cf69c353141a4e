"""The state of a program that runs, in a file: written every few minutes, read after a kill.

An .npz of the program's arrays and of the records of its lanes. Its header says for which cells, in
which lanes, and with what it was made: other versions, devices or numbers of lanes would go on with
other bits, so such a file is not used.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.io import Arrays, read_arrays, to_json, write_arrays

_HEADER = "header"


def write_state(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a state; raises OptionError as `write_arrays` does."""
    write_arrays(path, {_HEADER: np.array(to_json(header)), **arrays})


def read_header(path: Path) -> dict[str, Any]:
    """The header of a state; empty if there is no valid one. Reads no more than that."""
    with contextlib.suppress(OptionError, ValueError):
        header = json.loads(str(read_arrays(path, [_HEADER])[_HEADER]))
        if isinstance(header, dict):
            return header
    return {}


def read_state(path: Path) -> Arrays:
    """The arrays of a state; empty if there is no valid one."""
    with contextlib.suppress(OptionError):
        arrays = read_arrays(path)
        if arrays.pop(_HEADER, None) is not None:
            return arrays
    return {}

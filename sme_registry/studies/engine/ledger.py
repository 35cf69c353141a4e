"""`Ledger`: a study's folder, which is all that is known about what has finished.

A result is a file named by its cell's digest and renamed into place (`result` has the layout).
Nothing else records progress, so a kill cannot leave two records that disagree. Whoever runs a cell
holds the lock STUDY/locks/<key>, which the operating system releases when the process ends: there
are no leases to expire or to clean up.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from sme_registry.errors import OptionError, SMEError
from sme_registry.io import Lock, file_lock, is_locked, read_json, to_json, write_atomically
from sme_registry.spec import StudyFile
from sme_registry.studies.engine.program_state import read_header
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.training.lives import MODELS, folder_of_cell, model_of_cell

PLAN = "plan.json"
CELLS, FAILED, LOCKS, REPORT = "cells", "failed", "locks", "report"
REQUESTS = "requests"  # selections of cells that were asked for, a file each
STATES = "states"  # of programs that run, or were killed
_STUDY_FILES = {PLAN, CELLS, FAILED, LOCKS, MODELS, REPORT, REQUESTS, STATES}


class SavedState(NamedTuple):
    """The state of a program in a file, and the keys of the cells that are its lanes."""

    path: Path
    keys: list[str]


_Entry = TypeVar("_Entry", CellResult, CellFailure)


class Ledger:
    """The files of one study.

    Reading changes nothing: a file that is corrupt or of another cell counts as absent. The holder
    of the cell's lock may `set_aside` such a file, so that two runs cannot move each other's.
    """

    def __init__(
        self, folder: str | os.PathLike[str], warn: Callable[[str], None] = warnings.warn
    ) -> None:
        self.folder = Path(folder)
        self.warn = warn

    def plan_file(self) -> StudyFile | None:
        """The plan that was run here last; None if there is none yet."""
        try:
            names = set(os.listdir(self.folder))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OptionError(
                f"folder={str(self.folder)!r}: cannot be read: {error.strerror}. Give a folder "
                "that you may read."
            ) from None
        if PLAN in names:
            return StudyFile.read(self.folder / PLAN)
        # Hidden files may be writes of ours that were cut short.
        other_files = {name for name in names - _STUDY_FILES if not name.startswith(".")}
        if other_files:
            raise OptionError(
                f"folder={str(self.folder)!r}: contains files that belong to no study, such as "
                f"{min(other_files)!r}. Give an empty or a new folder."
            )
        return None

    def study_file(self) -> StudyFile:
        """The plan in the folder of a study; OptionError if it holds none."""
        file = self.plan_file()
        if file is None:
            raise OptionError(
                f"folder={str(self.folder)!r}: holds no study. Give the folder of `sme study run`."
            )
        return file

    def write_plan(self, file: StudyFile) -> None:
        """Write the plan; results of earlier plans stay."""
        file.write(self.folder / PLAN)

    def write_request(self, file: StudyFile, only: Sequence[str]) -> None:
        """Remember that these cells of a plan were asked for; no pattern means every cell."""
        text = to_json({"plan": file.digest, "only": sorted(set(only))})
        path = self.folder / REQUESTS / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"
        if not path.exists():
            write_atomically(path, text)

    def requests(self, file: StudyFile) -> list[list[str]]:
        """The patterns of each request for cells of a plan; an invalid file counts as absent."""
        requests = []
        for path in sorted((self.folder / REQUESTS).glob("*.json")):
            with contextlib.suppress(SMEError, KeyError, TypeError):
                document = read_json(path)
                if document["plan"] == file.digest:
                    requests.append([str(pattern) for pattern in document["only"]])
        return requests

    def result(self, key: str) -> CellResult | None:
        """A cell's result; None if there is no valid one."""
        return self.results([key]).get(key)

    def results(self, keys: Iterable[str] | None = None) -> dict[str, CellResult]:
        """Results by key: of all files in the folder, or of these keys, in their order."""
        return self._read(CellResult, CELLS, keys)

    def failure(self, key: str) -> CellFailure | None:
        """A cell's failure; None if it has not failed."""
        return self.failures([key]).get(key)

    def failures(self, keys: Iterable[str] | None = None) -> dict[str, CellFailure]:
        """Failures by key, as `results`."""
        return self._read(CellFailure, FAILED, keys)

    def write(
        self,
        entry: CellResult | CellFailure,
        model: bytes | None = None,
        snapshots: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Write a cell's result or failure, completely or not at all."""
        if isinstance(entry, CellFailure):
            write_atomically(self.failure_path(entry.key), to_json(entry.to_dict()))
            return
        # Models first: a kill in between must not leave a result without them.
        for name, snapshot in snapshots.items():
            write_atomically(self.snapshots_path(entry.key) / name, snapshot)
        if model is not None:
            write_atomically(self.model_path(entry.key), model)
        write_atomically(self._path(CELLS, entry.key), to_json(entry.to_dict()))
        with contextlib.suppress(FileNotFoundError):
            self.failure_path(entry.key).unlink()

    def model_path(self, key: str) -> Path:
        """Where a cell's trained model is, if it was kept."""
        return model_of_cell(self.folder, key)

    def snapshots_path(self, key: str) -> Path:
        """The folder of the models at the ends of the visits of a life, if they were kept."""
        return folder_of_cell(self.folder, key)

    def failure_path(self, key: str) -> Path:
        """Where a cell's failure is, if it failed."""
        return self._path(FAILED, key)

    def lock(self, key: str) -> Lock | None:
        """Acquire a cell's lock; None if any process, including this one, holds it already."""
        return file_lock(self.folder / LOCKS / _hex(key))

    def is_running(self, key: str) -> bool:
        """Whether any process holds the cell's lock. Creates no file."""
        return is_locked(self.folder / LOCKS / _hex(key))

    def claim_lock(self) -> Lock | None:
        """A lock to hold while claiming the cells of a program; None if another run claims now.

        Two runs that claim at once would divide the cells, and both would run the program.
        """
        return file_lock(self.folder / LOCKS / "programs")

    def state_path(self, keys: Iterable[str], made_with: Mapping[str, Any] | None = None) -> Path:
        """Where the state of a new program of these cells goes, made with this."""
        identity = f"{' '.join(keys)} {to_json(made_with or {})}"
        name = hashlib.sha256(identity.encode()).hexdigest()[:16]
        return self.folder / STATES / f"{name}.npz"

    def state_of(self, key: str, made_with: Mapping[str, Any]) -> SavedState | None:
        """A saved state, made with the same, of a program that has this cell as a lane."""
        for path in self._states():
            header = read_header(path)
            keys = header.get("cells", [])
            if key in keys and made_with.items() <= header.items():
                return SavedState(path, list(keys))
        return None

    def remove_states(self, own: Path) -> None:
        """Remove the states of which every cell has a result: a retry goes on from the others."""
        for path in self._states():
            keys = read_header(path).get("cells", [])
            if all(self._path(CELLS, key).exists() for key in keys) and (keys or path == own):
                path.unlink(missing_ok=True)

    def _states(self) -> list[Path]:
        return sorted((self.folder / STATES).glob("*.npz"))

    def set_aside(self, key: str) -> None:
        """Rename a cell's result or failure if it is invalid. The caller must hold the lock."""
        kinds: dict[type[Any], Path] = {
            CellResult: self._path(CELLS, key),
            CellFailure: self.failure_path(key),
        }
        for kind, path in kinds.items():
            if not path.exists():
                continue
            try:
                _read_entry(kind, path, key)
            except SMEError as error:
                aside = path.with_name(f"{path.name}.corrupt")
                try:
                    path.replace(aside)
                except OSError as reason:
                    raise OptionError(
                        f"{path}: is invalid and cannot be renamed: {reason.strerror}. Remove it. "
                        f"{error}"
                    ) from None
                self.warn(f"{error} Renamed to {aside.name}; the cell runs again.")

    def _path(self, folder: str, key: str) -> Path:
        return self.folder / folder / f"{_hex(key)}.json"

    def _read(
        self, kind: type[_Entry], folder: str, keys: Iterable[str] | None
    ) -> dict[str, _Entry]:
        if keys is None:
            keys = (f"sha256:{p.stem}" for p in sorted((self.folder / folder).glob("*.json")))
        entries = {}
        for key in keys:
            with contextlib.suppress(SMEError):
                entries[key] = _read_entry(kind, self._path(folder, key), key)
        return entries


def _hex(key: str) -> str:
    return key.removeprefix("sha256:")


def _read_entry(kind: type[_Entry], path: Path, key: str) -> _Entry:
    """Read a file's entry; an `SMEError` if it is invalid or belongs to another cell."""
    entry = kind.from_dict(read_json(path), str(path))
    if not key == entry.key == entry.cell.digest:
        raise OptionError(f"{path}: belongs to the cell {entry.cell.digest}, not to its file name.")
    return entry

"""`Ledger`: a study's folder as its only memory of what is done.

A result is a file that is renamed into place, named by its cell's digest (`studies.result` has the
layout). Nothing else is written down, so there is nothing that a kill could leave in disagreement.
Whoever runs a cell holds an flock on STUDY/locks/<key>, which the operating system releases when
the process dies: there are no leases to expire and none to clean up.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from sme_registry.errors import OptionError, SMEError
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec import StudyFile
from sme_registry.studies.engine.result import CellFailure, CellResult

PLAN = "plan.json"
CELLS, FAILED, LOCKS, MODELS, REPORT = "cells", "failed", "locks", "models", "report"
_OWN = {PLAN, CELLS, FAILED, LOCKS, MODELS, REPORT}

_Entry = TypeVar("_Entry", CellResult, CellFailure)


class Lock:
    """A cell's lock, held until it is released or this process ends."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def release(self) -> None:
        """Let others have it."""
        os.close(self._handle)


class Ledger:
    """The files of one study.

    Reading changes nothing: a file that is corrupt, or of another cell, counts as absent. Who
    holds the cell's lock may `set_aside` such a file, so that two runs cannot take each other's.

    Args:
      folder: of the study; it need not exist.
      warn: told what is set aside; by default Python's warnings.
    """

    def __init__(
        self, folder: str | os.PathLike[str], warn: Callable[[str], None] = warnings.warn
    ) -> None:
        self.folder = Path(folder)
        self.warn = warn

    def plan_file(self) -> StudyFile | None:
        """The plan that was run here last; None where there is none yet.

        Raises:
          OptionError: the folder is a file or cannot be read, or holds files but no study.
          MalformedDocumentError, SpecError, DigestMismatchError: its plan.json is no plan.
        """
        try:
            present = set(os.listdir(self.folder))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OptionError(
                f"folder={str(self.folder)!r}: cannot be read: {error.strerror}. Give a folder "
                "that you may read."
            ) from None
        if PLAN in present:
            return StudyFile.read(self.folder / PLAN)
        # What is hidden may be a write of ours that was cut short.
        strangers = {name for name in present - _OWN if not name.startswith(".")}
        if strangers:
            raise OptionError(
                f"folder={str(self.folder)!r}: holds files that are no study's, such as "
                f"{min(strangers)!r}. Give an empty or a new folder."
            )
        return None

    def write_plan(self, file: StudyFile) -> None:
        """Keep the plan; what was run under another plan stays.

        Raises:
          OptionError: it cannot be written.
        """
        file.write(self.folder / PLAN)

    def result(self, key: str) -> CellResult | None:
        """A cell's result; None where there is none that can be relied on."""
        return self._read(CellResult, CELLS, key)

    def results(self, keys: Iterable[str] | None = None) -> dict[str, CellResult]:
        """Finished cells by key: of all files in the folder, or of these keys, in their order."""
        return self._read_all(CellResult, CELLS, keys)

    def failure(self, key: str) -> CellFailure | None:
        """What a cell raised; None where it has not failed."""
        return self._read(CellFailure, FAILED, key)

    def failures(self, keys: Iterable[str] | None = None) -> dict[str, CellFailure]:
        """Failed cells by key, as `results`."""
        return self._read_all(CellFailure, FAILED, keys)

    def write(self, entry: CellResult | CellFailure, model: bytes | None = None) -> None:
        """Keep what came of a cell, whole or not at all.

        Args:
          entry: a result, which ends a failure of the same cell; or a failure.
          model: the trained model's .zip, to keep beside a result.

        Raises:
          OptionError: it cannot be written; what stood there is untouched.
        """
        if isinstance(entry, CellFailure):
            write_atomically(self._path(FAILED, entry.key), to_json(entry.to_dict()))
            return
        if model is not None:  # first, so that a kill in between loses a model and no pairing
            write_atomically(self.model_path(entry.key), model)
        write_atomically(self._path(CELLS, entry.key), to_json(entry.to_dict()))
        with contextlib.suppress(FileNotFoundError):
            self._path(FAILED, entry.key).unlink()

    def model_path(self, key: str) -> Path:
        """Where a cell's trained model is, if it was kept."""
        return self.folder / MODELS / f"{_hex(key)}.zip"

    def lock(self, key: str) -> Lock | None:
        """Take a cell's lock; None where another process, or this one, holds it already.

        Raises:
          OptionError: no lock can be made there.
        """
        path = self.folder / LOCKS / _hex(key)
        handle = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if handle is not None:
                os.close(handle)
            if isinstance(error, BlockingIOError):
                return None
            raise OptionError(
                f"{path}: cannot be locked: {error.strerror}. Give a folder that you may write to, "
                "on a file system that has locks."
            ) from None
        return Lock(handle)

    def is_running(self, key: str) -> bool:
        """Whether somebody holds the cell's lock. Makes no file."""
        path = self.folder / LOCKS / _hex(key)
        try:
            handle = os.open(path, os.O_RDONLY)
        except OSError:
            return False
        try:
            # Shared, so that two who ask at once do not see each other.
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(handle)
        return False

    def set_aside(self, key: str) -> None:
        """Rename what stands in for a cell's result or failure and is none; call under its lock.

        Raises:
          OptionError: it cannot be renamed.
        """
        self._set_aside(CellResult, self._path(CELLS, key), key)
        self._set_aside(CellFailure, self._path(FAILED, key), key)

    def _set_aside(self, kind: type[_Entry], path: Path, key: str) -> None:
        if not path.exists():
            return
        try:
            _open(kind, path, key)
        except SMEError as error:
            aside = path.with_name(f"{path.name}.corrupt")
            try:
                path.replace(aside)
            except OSError as reason:
                raise OptionError(
                    f"{path}: cannot be set aside: {reason.strerror}. Remove it: {error}"
                ) from None
            self.warn(f"{error} Set aside as {aside.name}; the cell runs again.")

    def _path(self, folder: str, key: str) -> Path:
        return self.folder / folder / f"{_hex(key)}.json"

    def _read(self, kind: type[_Entry], folder: str, key: str) -> _Entry | None:
        try:
            return _open(kind, self._path(folder, key), key)
        except SMEError:
            return None

    def _read_all(
        self, kind: type[_Entry], folder: str, keys: Iterable[str] | None
    ) -> dict[str, _Entry]:
        if keys is None:
            keys = (f"sha256:{p.stem}" for p in sorted((self.folder / folder).glob("*.json")))
        found = ((key, self._read(kind, folder, key)) for key in keys)
        return {key: entry for key, entry in found if entry is not None}


def _hex(key: str) -> str:
    return key.removeprefix("sha256:")


def _open(kind: type[_Entry], path: Path, key: str) -> _Entry:
    """A file's entry.

    Raises:
      SMEError: not readable, not of this kind, or of another cell than its name says.
    """
    entry = kind.from_dict(read_json(path), str(path))
    if not key == entry.key == entry.cell.digest:
        raise OptionError(f"{path}: is of the cell {entry.cell.digest}, not of its name's.")
    return entry

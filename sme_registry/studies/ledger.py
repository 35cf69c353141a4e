"""`Ledger`: a study's folder, which is all that is known about what has finished; its status.

A result is a file named by its cell's digest and renamed into place (`result` has the layout).
Nothing else records progress, so a kill cannot leave two records that disagree. Whoever runs a cell
holds the lock STUDY/locks/<key>, which the operating system releases when the process ends: there
are no leases to expire or to clean up.

The state of a program of JAX that runs is an .npz of its arrays and of the records of its runs,
written every few minutes and read after a kill. Its header says for which cells and with what it
was made: other versions, devices or numbers of runs would go on with other bits.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np

from sme_registry.errors import OptionError, SMEError
from sme_registry.io import (
    Arrays,
    Lock,
    file_lock,
    is_locked,
    read_arrays,
    to_json,
    write_arrays,
    write_atomically,
)
from sme_registry.spec import StudyFile
from sme_registry.spec.study import PlannedCell
from sme_registry.studies.budget import Estimator, selected
from sme_registry.studies.result import CellFailure, CellResult
from sme_registry.training.record import MODELS_OF_STUDY, folder_of_cell, model_of_cell

PLAN = "plan.json"
CELLS, FAILED, LOCKS, REPORT = "cells", "failed", "locks", "report"
STATE_FILES = "states"  # of programs that run, or were killed
_STUDY_FILES = {PLAN, CELLS, FAILED, LOCKS, MODELS_OF_STUDY, REPORT, STATE_FILES}

_Entry = TypeVar("_Entry", CellResult, CellFailure)
_FOLDERS: dict[type[Any], str] = {CellResult: CELLS, CellFailure: FAILED}


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
                f"{min(other_files)!r}. Give the folder of a study, or a new one."
            )
        return None

    def study_file(self) -> StudyFile:
        file = self.plan_file()
        if file is None:
            raise OptionError(
                f"folder={str(self.folder)!r}: holds no study. Give the folder of `sme study run`."
            )
        return file

    def write_plan(self, file: StudyFile) -> None:
        file.write(self.folder / PLAN)

    def result(self, key: str) -> CellResult | None:
        return self.results([key]).get(key)

    def results(self, keys: Iterable[str] | None = None) -> dict[str, CellResult]:
        """Results by key: of all files in the folder, or of these keys, in their order."""
        return self._read(CellResult, keys)

    def failures(self, keys: Iterable[str] | None = None) -> dict[str, CellFailure]:
        return self._read(CellFailure, keys)

    def write(
        self,
        entry: CellResult | CellFailure,
        model: bytes | None = None,
        snapshots: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Write a cell's result or failure, completely or not at all."""
        # Models first: a kill in between must not leave a result without them.
        for name, snapshot in snapshots.items():
            write_atomically(self.snapshots_path(entry.key) / name, snapshot)
        if model is not None:
            write_atomically(self.model_path(entry.key), model)
        entry.write(self._path(type(entry), entry.key))
        if isinstance(entry, CellResult):
            self.failure_path(entry.key).unlink(missing_ok=True)

    def model_path(self, key: str) -> Path:
        return model_of_cell(self.folder, key)

    def snapshots_path(self, key: str) -> Path:
        """The folder of the models at the ends of the visits of a life, if they were kept."""
        return folder_of_cell(self.folder, key)

    def failure_path(self, key: str) -> Path:
        return self._path(CellFailure, key)

    def lock(self, key: str) -> Lock | None:
        """Acquire a cell's lock; None if any process, including this one, holds it already."""
        return file_lock(self.folder / LOCKS / _hex(key))

    def is_running(self, key: str) -> bool:
        """Whether any process holds the cell's lock. Creates no file."""
        return is_locked(self.folder / LOCKS / _hex(key))

    def claim_lock(self) -> Lock | None:
        """A lock to hold while claiming the cells of a program, which two runs would divide."""
        return file_lock(self.folder / LOCKS / "programs")

    def state_path(self, keys: Iterable[str], build_key: Mapping[str, Any] | None = None) -> Path:
        """Where the state of a new program of these cells goes, made with this."""
        identity = f"{' '.join(keys)} {to_json(build_key or {})}"
        name = hashlib.sha256(identity.encode()).hexdigest()[:16]
        return self.folder / STATE_FILES / f"{name}.npz"

    def state_of(self, key: str, build_key: Mapping[str, Any]) -> tuple[Path, list[str]] | None:
        """A saved state, made with the same, of a program that runs this cell; and its cells."""
        for path in self._states():
            header = read_header(path)
            keys: list[str] = header.get("cells", [])
            if key in keys and build_key.items() <= header.items():
                return path, keys
        return None

    def remove_states(self) -> None:
        """Remove the states of which every cell has a result: a retry goes on from the others."""
        for path in self._states():
            keys = read_header(path).get("cells", [])
            if all(self._path(CellResult, key).exists() for key in keys):
                path.unlink(missing_ok=True)

    def _states(self) -> list[Path]:
        return sorted((self.folder / STATE_FILES).glob("*.npz"))

    def set_aside(self, key: str) -> None:
        """Rename a cell's result or failure if it is invalid. The caller must hold the lock."""
        for kind in _FOLDERS:
            path = self._path(kind, key)
            if not path.exists():
                continue
            try:
                _read_entry(kind, path, key)
            except SMEError as error:
                aside = path.with_name(f"{path.name}.corrupt")
                path.replace(aside)
                self.warn(f"{error} Renamed to {aside.name}; the cell runs again.")

    def _path(self, kind: type[Any], key: str) -> Path:
        return self.folder / _FOLDERS[kind] / f"{_hex(key)}.json"

    def _read(self, kind: type[_Entry], keys: Iterable[str] | None) -> dict[str, _Entry]:
        if keys is None:
            files = sorted((self.folder / _FOLDERS[kind]).glob("*.json"))
            keys = (f"sha256:{path.stem}" for path in files)
        entries = {}
        for key in keys:
            with contextlib.suppress(SMEError):
                entries[key] = _read_entry(kind, self._path(kind, key), key)
        return entries


def _hex(key: str) -> str:
    return key.removeprefix("sha256:")


def _read_entry(kind: type[_Entry], path: Path, key: str) -> _Entry:
    """Read a file's entry; an `SMEError` if it is invalid or belongs to another cell."""
    entry = kind.read(path)
    if not key == entry.key == entry.cell.digest:
        raise OptionError(f"{path}: belongs to the cell {entry.cell.digest}, not to its file name.")
    return entry


_HEADER = "header"


def write_state(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
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


State = Literal["done", "running", "failed", "waiting"]
STATES: tuple[State, ...] = ("done", "running", "failed", "waiting")


def label(planned: PlannedCell) -> str:
    """`PPO on k-25, run 3`, or of a fresh agent `PPO on phase 2 of Switch5 alone, run 3`."""
    name = planned.class_name
    if planned.phase is not None:
        name = f"phase {planned.phase} of {name} alone"
    return f"{planned.algorithm} on {name}, run {planned.run}"


@dataclass(frozen=True)
class CellStatus:
    """The state of a planned cell, by its digest `key`, and its error if it failed.

    It is "running" if any process runs it, and "failed" if it failed and none runs it again.
    """

    planned: PlannedCell
    key: str
    state: State
    failure: CellFailure | None = None


@dataclass(frozen=True)
class StudyStatus:
    """The state of a study.

    `places` are the selected cells of the plan, in its order. Streams may share fresh agents, which
    run once and count once, except in `counts`. `seconds_left` are of one core; running cells count
    in full. `other_results` belong to no cell of the plan.
    """

    folder: Path
    file: StudyFile
    places: tuple[CellStatus, ...]
    seconds_left: float
    other_results: int

    @property
    def cells(self) -> tuple[CellStatus, ...]:
        """Every selected cell once."""
        first: dict[str, CellStatus] = {}
        for cell in self.places:
            first.setdefault(cell.key, cell)
        return tuple(first.values())

    def count(self, state: State) -> int:
        return sum(cell.state == state for cell in self.cells)

    @property
    def failed(self) -> tuple[CellStatus, ...]:
        return tuple(cell for cell in self.cells if cell.state == "failed")

    @property
    def counts(self) -> dict[tuple[str, str], Counter[State]]:
        """(class, algorithm) → number of cells in each state, in the plan's order."""
        counts: dict[tuple[str, str], Counter[State]] = defaultdict(Counter)
        for cell in self.places:
            counts[cell.planned.class_name, cell.planned.algorithm][cell.state] += 1
        return counts

    def to_dict(self) -> dict[str, Any]:
        return {
            "folder": str(self.folder),
            "study": self.file.versioned_name,
            "digest": self.file.digest,
            "cells": len(self.cells),
            **{state: self.count(state) for state in STATES},
            "core_seconds_left": self.seconds_left,
            "other_results": self.other_results,
            "groups": [
                {"class": name, "algorithm": algorithm, **{s: counts[s] for s in STATES}}
                for (name, algorithm), counts in self.counts.items()
            ],
            "failures": [
                {
                    "class": cell.planned.class_name,
                    "algorithm": cell.planned.algorithm,
                    "run": cell.planned.run,
                    "key": cell.failure.key,
                    "error": cell.failure.error,
                    "attempts": cell.failure.attempts,
                }
                for cell in self.cells
                if cell.failure is not None
            ],
        }


def study_status(folder: str | os.PathLike[str], only: Sequence[str] = ()) -> StudyStatus:
    """The state of the study in a folder. Changes nothing, and may be called while it runs.

    `only` has patterns `class=GLOB`, `algorithm=GLOB`, `run=GLOB`; empty for every cell.
    """
    ledger = Ledger(folder)
    return plan_status(ledger, ledger.study_file(), only)


def plan_status(ledger: Ledger, file: StudyFile, only: Sequence[str]) -> StudyStatus:
    results, failures = ledger.results(), ledger.failures()
    places = []
    for planned in selected(file.plan.cells, only):
        key = planned.cell.digest
        state: State = "done" if key in results else "failed" if key in failures else "waiting"
        if state != "done" and ledger.is_running(key):
            state = "running"
        failure = failures.get(key) if state == "failed" else None
        places.append(CellStatus(planned, key, state, failure))
    unfinished = {c.key: c.planned.cell for c in places if c.state in ("running", "waiting")}
    estimator = Estimator(results.values())
    return StudyStatus(
        folder=ledger.folder,
        file=file,
        places=tuple(places),
        seconds_left=sum(map(estimator.seconds, unfinished.values())),
        other_results=len(results.keys() - {planned.cell.digest for planned in file.plan.cells}),
    )

"""Where a study's cells run: in this process, in a process each, or as tasks of a Ray cluster.

Every executor is one `map`: it takes the next cell when a worker is free, and yields the outcomes
in the order in which cells end. Its caller writes them: only the driver touches the study's folder.
"""

from __future__ import annotations

import functools
import os
import tempfile
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sme_registry.io import versions
from sme_registry.spec import Cell
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.training.record import PACKAGES

RunCell = Callable[[Cell, Callable[[int, int], None] | None, Path | None], CellResult]
ReportProgress = Callable[[Cell, int, int], None]
Cells = Iterator[Cell | None]

POLL_SECONDS = 0.2
TRACEBACK_CHARACTERS = 4000  # kept of a failed cell's traceback or output
_SECONDS_BETWEEN_REPORTS = 0.5


class Outcome(NamedTuple):
    """How a cell ended: its result or failure, and the .zip of its model if that is kept."""

    entry: CellResult | CellFailure
    model: bytes | None = None


class Executor(Protocol):
    """Runs cells."""

    @property
    def workers(self) -> int:
        """Cells that can run at once."""

    def map(self, cells: Cells, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """Run cells. When the iterator is closed or raises, no cell is left running.

        Args:
          cells: asked for the next cell whenever a worker is free; None means that no cell is
            available now, and it is asked again soon.
          progress: called with a running cell, the steps done and the steps in all.

        Yields:
          Outcomes, in the order in which cells end.
        """


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_one(
    run: RunCell, cell: Cell, keep_model: bool, progress: Callable[[int, int], None]
) -> Outcome:
    """Run a cell; an exception becomes its failure, so that the process goes on."""
    try:
        with tempfile.TemporaryDirectory(prefix="sme-cell-") as folder:
            path = Path(folder) / "model.zip"
            result = run(cell, _throttled(progress), path if keep_model else None)
            model = path.read_bytes() if path.exists() else None
        if result.key != cell.digest:
            raise RuntimeError(f"the result belongs to another cell, {result.key}")
        return Outcome(result, model)
    except (Exception, SystemExit) as error:
        return failed(cell, f"{type(error).__name__}: {error}", traceback.format_exc())


def failed(cell: Cell, error: str, details: str) -> Outcome:
    """A cell's failure, with the end of its traceback or output."""
    failure = CellFailure(
        key=cell.digest,
        cell=cell,
        error=error,
        traceback=details[-TRACEBACK_CHARACTERS:],
        versions=versions(PACKAGES),
    )
    return Outcome(failure)


def _throttled(report: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Pass on a report if the last one is some time ago, and at the end."""
    last = 0.0

    def throttled(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _SECONDS_BETWEEN_REPORTS or done >= total:
            last = now
            report(done, total)

    return throttled


@dataclass(frozen=True)
class InProcess:
    """One cell after the other in this process: for debugging, or where processes are forbidden."""

    run: RunCell = run_cell
    keep_models: bool = False
    workers: int = 1

    def map(self, cells: Cells, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """See `Executor.map`."""
        for cell in cells:
            if cell is None:
                time.sleep(POLL_SECONDS)
                continue
            report = functools.partial(progress, cell)
            yield run_one(self.run, cell, self.keep_models, report)


class ConcurrentExecutor(ABC):
    """Keeps as many cells running as there are workers.

    Args:
      jobs: cells at once; None for one per core that can be used.
      run: runs a cell; importable by name.
      keep_models: whether outcomes carry the trained model.
    """

    def __init__(
        self, jobs: int | None = None, run: RunCell = run_cell, keep_models: bool = False
    ) -> None:
        self._jobs, self._run, self._keep_models = jobs, run, keep_models
        self._running: dict[Any, Any] = {}

    @property
    @abstractmethod
    def workers(self) -> int:
        """Cells that can run at once."""

    @abstractmethod
    def _session(self) -> AbstractContextManager[None]:
        """Open what cells run in; leaving it ends those that are still running."""

    @abstractmethod
    def _start(self, cell: Cell) -> None:
        """Start a cell and add it to those running."""

    @abstractmethod
    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        """Wait up to `POLL_SECONDS`, report progress, and remove the cells that have ended."""

    def map(self, cells: Cells, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """See `Executor.map`."""
        exhausted = False
        with self._session():
            while not exhausted or self._running:
                while not exhausted and len(self._running) < self.workers:
                    cell = next(cells, _END)
                    exhausted = cell is _END
                    if not isinstance(cell, Cell):
                        break
                    self._start(cell)
                if self._running:
                    yield from self._ended(progress)
                elif not exhausted:
                    time.sleep(POLL_SECONDS)


_END = object()

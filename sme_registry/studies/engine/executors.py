"""Where a study's cells run: in this process, in processes, or as tasks of a Ray cluster.

Every executor is one `map`: it takes the next job when a worker is free, a cell or the cells of one
program, and yields the outcomes in the order in which cells end. Its caller writes them: only the
driver touches the study's folder, except for the states of programs, which may be gigabytes.
"""

from __future__ import annotations

import functools
import tempfile
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sme_registry.spec import Cell
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.jobs import Job, Report
from sme_registry.studies.engine.lanes import run_lanes
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.training.record import versions_for

RunCell = Callable[[Cell, Callable[[int, int], None] | None, Path | None], CellResult]
ReportProgress = Callable[..., None]  # called with a job and the arguments of `Report`
Jobs = Iterator[Job | None]

POLL_SECONDS = 0.2
TRACEBACK_CHARACTERS = 4000  # kept of a failed cell's traceback or output
_SECONDS_BETWEEN_REPORTS = 0.5


class Outcome(NamedTuple):
    """How a cell ended, with its model and the snapshots of a life, where these are kept."""

    entry: CellResult | CellFailure
    model: bytes | None = None
    snapshots: Mapping[str, bytes] = {}


class Executor(Protocol):
    """Runs cells."""

    @property
    def workers(self) -> int:
        """Jobs that can run at once."""

    def map(self, jobs: Jobs, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """Run jobs; when the iterator is closed or raises, no cell is left running.

        The next job is asked for whenever a worker is free; None means that none is available now.
        Outcomes come in the order in which cells end.
        """


def run_job(run: RunCell, job: Job, keep_models: bool, progress: Report) -> Iterator[Outcome]:
    """Run a job; an exception becomes the failure of its cells, so that the process goes on."""
    report, unfinished = _throttled(progress), {cell.digest: cell for cell in job.cells}
    try:
        for outcome in _outcomes(run, job, keep_models, report):
            del unfinished[outcome.entry.key]
            yield outcome
    except (Exception, SystemExit) as error:
        for cell in unfinished.values():
            yield failed(cell, f"{type(error).__name__}: {error}", traceback.format_exc())


def _outcomes(run: RunCell, job: Job, keep_models: bool, progress: Report) -> Iterator[Outcome]:
    if job.lanes is not None:
        for lane in run_lanes(job.cells, job.lanes, progress, keep_models):
            if isinstance(lane.ended, CellResult):
                yield Outcome(lane.ended, lane.model, lane.snapshots)
            else:
                yield failed(lane.cell, f"{type(lane.ended).__name__}: {lane.ended}", "")
        return
    (cell,) = job.cells
    with tempfile.TemporaryDirectory(prefix="sme-cell-") as folder:
        path = Path(folder) / "model.zip"
        result = run(cell, progress, path if keep_models else None)
        saved = path.read_bytes() if path.exists() else None
        snapshots = {each.name: each.read_bytes() for each in path.with_suffix("").glob("*.zip")}
    if result.key != cell.digest:
        raise RuntimeError(f"the result belongs to another cell, {result.key}")
    yield Outcome(result, saved, snapshots)


def failed(cell: Cell, error: str, details: str) -> Outcome:
    """A cell's failure, with the end of its traceback or output."""
    failure = CellFailure(
        key=cell.digest,
        cell=cell,
        error=error,
        traceback=details[-TRACEBACK_CHARACTERS:],
        versions=versions_for(cell.uses),
    )
    return Outcome(failure)


def _throttled(report: Report) -> Report:
    """Pass on a report if the last one is some time ago, at the end, and with a note."""
    last = 0.0

    def throttled(done: int, total: int, compilations: int = 0, note: str = "", /) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _SECONDS_BETWEEN_REPORTS or done >= total or note:
            last = now
            report(done, total, compilations, note)

    return throttled


@dataclass(frozen=True)
class InProcess:
    """One job after the other in this process: for debugging, or where processes are forbidden."""

    run: RunCell = run_cell
    keep_models: bool = False
    workers: int = 1

    def map(self, jobs: Jobs, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """See `Executor.map`."""
        for job in jobs:
            if job is None:
                time.sleep(POLL_SECONDS)
                continue
            yield from run_job(self.run, job, self.keep_models, functools.partial(progress, job))


class ConcurrentExecutor(ABC):
    """Keeps as many jobs running as there are workers."""

    def __init__(
        self, jobs: int | None = None, run: RunCell = run_cell, keep_models: bool = False
    ) -> None:
        self._jobs, self._run, self._keep_models = jobs, run, keep_models
        self._running: dict[Any, Any] = {}

    @property
    @abstractmethod
    def workers(self) -> int:
        """Jobs that can run at once."""

    @abstractmethod
    def _session(self) -> AbstractContextManager[None]:
        """Open what jobs run in; leaving it ends those that are still running."""

    @abstractmethod
    def _start(self, job: Job) -> None:
        """Start a job and add it to those running."""

    @abstractmethod
    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        """Wait up to `POLL_SECONDS`, report progress, and remove the jobs that have ended."""

    def map(self, jobs: Jobs, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """See `Executor.map`."""
        exhausted = False
        with self._session():
            while not exhausted or self._running:
                while not exhausted and len(self._running) < self.workers:
                    job = next(jobs, _END)
                    exhausted = job is _END
                    if not isinstance(job, Job):
                        break
                    self._start(job)
                if self._running:
                    yield from self._ended(progress)
                elif not exhausted:
                    time.sleep(POLL_SECONDS)


_END = object()

"""`Processes`: a process for each job.

Not a pool of workers. With `concurrent.futures`, one dead worker fails every cell that is running.
The workers of `pebble` survive a killed driver and would go on with cells whose locks are free
again. Here each process has its own pipe, so its death fails only its cells, and ends with the
driver.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, NamedTuple

from sme_registry.io.system import block_interrupts, defer_interrupts, end_with_parent
from sme_registry.spec import Cell
from sme_registry.studies.engine.executors import (
    POLL_SECONDS,
    ConcurrentExecutor,
    Outcome,
    ReportProgress,
    RunCell,
    failed,
    run_job,
)
from sme_registry.studies.engine.jobs import CPU, Job, available_cores, child_environment

_SECONDS_TO_END = 10.0
# One thread for each library that would take every core: the jobs share the cores, one each.
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
} | {"NPROC": "1"}  # of XLA on a CPU


class Processes(ConcurrentExecutor):
    """A new process (`spawn`) with one thread for each job."""

    @property
    def workers(self) -> int:
        """Processes at once."""
        return available_cores() if self._jobs is None else self._jobs

    @contextlib.contextmanager
    def _session(self) -> Iterator[None]:
        with tempfile.TemporaryDirectory(prefix="sme-study-") as scratch:
            self._scratch = Path(scratch)
            try:
                yield
            finally:
                with defer_interrupts():
                    for process in self._running.values():
                        process.kill()
                    self._running.clear()

    def _start(self, job: Job) -> None:
        with defer_interrupts():  # or a process that has just started would have no owner
            process = _JobProcess.start(self._run, job, self._keep_models, self._scratch)
            self._running[process.pipe] = process

    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        for pipe in connection.wait(list(self._running), POLL_SECONDS):
            process = self._running[pipe]
            received = process.receive()
            if isinstance(received, _Steps):
                progress(process.job, *received)
                continue
            if not process.unfinished:
                del self._running[pipe]
            yield from received


class _Steps(NamedTuple):
    """What a process reports; see `Report`."""

    done: int
    total: int
    compilations: int
    note: str


@dataclass(frozen=True)
class _JobProcess:
    """A job in a process of its own."""

    job: Job
    process: Any
    pipe: Any  # a Connection, on Windows a PipeConnection
    log: Path
    unfinished: dict[str, Cell]

    @classmethod
    def start(cls, run: RunCell, job: Job, keep_models: bool, scratch: Path) -> _JobProcess:
        spawn = multiprocessing.get_context("spawn")
        pipe, child_end = spawn.Pipe(duplex=False)
        unfinished = {cell.digest: cell for cell in job.cells}
        log = scratch / f"{next(iter(unfinished)).removeprefix('sha256:')}.log"
        process = spawn.Process(target=_child, args=(child_end, run, job, keep_models, log))
        on_cpu = job.lanes is not None and job.lanes.device == CPU
        # Or JAX would look for a GPU, and take most of its memory.
        variables = _ONE_THREAD | ({"JAX_PLATFORMS": CPU} if on_cpu else {})
        with child_environment(variables), block_interrupts():
            process.start()
        child_end.close()  # so that the pipe ends when the process does
        return cls(job, process, pipe, log, unfinished)

    def receive(self) -> list[Outcome] | _Steps:
        """How far it is, or the outcomes of cells that have ended since."""
        try:
            received = self.pipe.recv()
        except (EOFError, OSError):
            self.kill()
            deaths = [self._death(cell) for cell in self.unfinished.values()]
            self.unfinished.clear()
            return deaths
        if isinstance(received, _Steps):
            return received
        del self.unfinished[received.entry.key]
        if not self.unfinished:
            self.process.join(_SECONDS_TO_END)
            self.kill()
        return [received]

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def _death(self, cell: Cell) -> Outcome:
        code = self.process.exitcode
        killed_by = next((each.name for each in signal.Signals if each == -code), None)
        how = f"was killed by {killed_by}" if killed_by else f"ended with exit code {code}"
        hint = " Memory may have run out: try fewer --jobs." if killed_by == "SIGKILL" else ""
        output = self.log.read_text(errors="replace") if self.log.exists() else ""
        error = f"the cell's process {how}.{hint} Run it again with --retry."
        return failed(cell, error, output)


def _child(pipe: Any, run: RunCell, job: Job, keep_models: bool, log: Path) -> None:
    """Run one job: the main function of its process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    # Studies run for days, and many machines remove old files from the temporary folder.
    log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # what libraries print is for the failure, not the terminal
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
    tempfile.tempdir = str(log.parent)  # which the driver removes, also after a kill
    for outcome in run_job(run, job, keep_models, lambda *steps: pipe.send(_Steps(*steps))):
        pipe.send(outcome)

"""`Processes`: a process for each cell.

Not a pool of workers. With `concurrent.futures`, one dead worker fails every cell that is running.
The workers of `pebble` survive a killed driver and would go on with cells whose locks are free
again. Here each process has its own pipe, so its death fails only its cell, and ends with the
driver.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any

from sme_registry.spec import Cell
from sme_registry.studies.engine.executors import (
    POLL_SECONDS,
    ConcurrentExecutor,
    Outcome,
    ReportProgress,
    RunCell,
    available_cores,
    failed,
    run_one,
)
from sme_registry.terminal.interrupts import block_interrupts, defer_interrupts

_SECONDS_TO_END = 10.0
# One thread for each library that would take every core: the cells share the cores, one each.
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
}


class Processes(ConcurrentExecutor):
    """A new process (`spawn`) with one thread for each cell.

    A cell whose process is killed is a failed cell. The processes end with this one, however it
    ends, and ignore Ctrl-C, which this process handles.
    """

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

    def _start(self, cell: Cell) -> None:
        with defer_interrupts():  # or a process that has just started would have no owner
            process = _CellProcess.start(self._run, cell, self._keep_models, self._scratch)
            self._running[process.pipe] = process

    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        for pipe in connection.wait(list(self._running), POLL_SECONDS):
            process = self._running[pipe]
            received = process.receive()
            if isinstance(received, Outcome):
                del self._running[pipe]
                yield received
            else:
                progress(process.cell, *received)


@dataclass(frozen=True)
class _CellProcess:
    """A cell in a process of its own."""

    cell: Cell
    process: Any
    pipe: Any  # a Connection, on Windows a PipeConnection
    log: Path

    @classmethod
    def start(cls, run: RunCell, cell: Cell, keep_model: bool, scratch: Path) -> _CellProcess:
        spawn = multiprocessing.get_context("spawn")
        pipe, child_end = spawn.Pipe(duplex=False)
        log = scratch / f"{cell.digest.removeprefix('sha256:')}.log"
        process = spawn.Process(target=_child, args=(child_end, run, cell, keep_model, log))
        with _one_thread(), block_interrupts():
            process.start()
        child_end.close()  # so that the pipe ends when the process does
        return cls(cell, process, pipe, log)

    def receive(self) -> Outcome | tuple[int, int]:
        """Its next steps done and in all, or its outcome once the process has ended."""
        try:
            received = self.pipe.recv()
        except (EOFError, OSError):
            self.kill()
            return self._death()
        if isinstance(received, Outcome):
            self.process.join(_SECONDS_TO_END)
            self.kill()
        return received  # type: ignore[no-any-return]

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def _death(self) -> Outcome:
        code = self.process.exitcode
        killed_by = next((each.name for each in signal.Signals if each == -code), None)
        how = f"was killed by {killed_by}" if killed_by else f"ended with exit code {code}"
        hint = " Memory may have run out: try fewer --jobs." if killed_by == "SIGKILL" else ""
        output = self.log.read_text(errors="replace") if self.log.exists() else ""
        error = f"the cell's process {how}.{hint} Run it again with --retry."
        return failed(self.cell, error, output)


def _child(pipe: Any, run: RunCell, cell: Cell, keep_model: bool, log: Path) -> None:
    """Run one cell: the main function of its process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    # Studies run for days, and many machines remove old files from the temporary folder.
    log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # what libraries print is for the failure, not the terminal
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
    tempfile.tempdir = str(log.parent)  # which the driver removes, also after a kill
    pipe.send(run_one(run, cell, keep_model, lambda done, total: pipe.send((done, total))))


def _end_with_parent() -> None:
    """End this process when its parent ends, for any reason."""
    if sys.platform == "linux":
        set_parent_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_parent() -> None:
        parent.join()  # returns at the end of a pipe that only the parent holds
        os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started inside the block are limited to one thread before they import anything."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

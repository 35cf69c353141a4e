"""Where a study's cells run: in this process, in processes, or as tasks of a Ray cluster.

Every executor is one `map`: it takes the next job when a worker is free, a cell or the cells of one
program, and yields the outcomes in the order in which cells end. Its caller writes them: only the
driver touches the study's folder, except for the states of programs, which may be gigabytes.
A new executor is a class here and a row of `EXECUTORS`.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import multiprocessing
import os
import signal
import socket
import tempfile
import time
import traceback
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from multiprocessing import connection
from pathlib import Path
from typing import Any, ClassVar

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io import choice, require_packages
from sme_registry.io.system import (
    available_cores,
    block_interrupts,
    child_environment,
    children_without_main,
    defer_interrupts,
    end_with_parent,
)
from sme_registry.spec.study import Cell
from sme_registry.studies.cell import run_cell
from sme_registry.studies.result import CPU, CellResult, Job, Outcome, Report, failed
from sme_registry.training.algorithms import imported

RunCell = Callable[[Cell, Report | None, Path | None], CellResult]
ReportProgress = Callable[[Job, int, int], None]  # called with the steps done, and those in all
Jobs = Iterator[Job | None]

POLL_SECONDS = 0.2
_SECONDS_BETWEEN_REPORTS = 0.5
_SECONDS_TO_END = 10.0
# One thread for each library that would take every core: the jobs share the cores, one each.
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
} | {"NPROC": "1"}  # of XLA on a CPU
_RETRIES = 3  # of a cell whose worker or node is lost
_SECONDS_TO_ANSWER = 10.0
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_oom_retries": str(_RETRIES),  # without it a cell too large is retried for ever
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # its notices of a lost node, dozens of lines each
}
_ADDRESSES = "Give 'local', or the host:port of a running cluster of this Ray version."


class Executor(ABC):
    """Runs cells with `run`, as many jobs at once as there are workers.

    `jobs` is the most at once, None for one per core; `address` is that of a cluster.
    """

    local: ClassVar[bool] = True  # whether jobs have the files and devices of this machine

    def __init__(
        self,
        jobs: int | None = None,
        run: RunCell = run_cell,
        keep_models: bool = False,
        address: str | None = None,
    ) -> None:
        self._jobs, self._run, self._keep_models = jobs, run, keep_models
        self._address = address
        self._running: dict[Any, Any] = {}

    @property
    def workers(self) -> int:
        """Jobs that can run at once."""
        return self._jobs or available_cores()

    def _session(self) -> AbstractContextManager[None]:
        """Open what jobs run in; leaving it ends those that are still running."""
        return contextlib.nullcontext()

    @abstractmethod
    def _start(self, job: Job) -> None:
        """Start a job and add it to those running."""

    @abstractmethod
    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        """Wait up to `POLL_SECONDS`, report progress, and remove the jobs that have ended."""

    def map(self, jobs: Jobs, progress: ReportProgress) -> Generator[Outcome, None, None]:
        """Run jobs; when the iterator is closed or raises, no cell is left running.

        The next job is asked for whenever a worker is free; None means that none is available now.
        Outcomes come in the order in which cells end.
        """
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


def run_job(run: RunCell, job: Job, keep_models: bool, progress: Report) -> Iterator[Outcome]:
    """Run a job; an exception becomes the failure of its cells, so that the process goes on."""
    unfinished = {cell.digest: cell for cell in job.cells}
    try:
        for outcome in _outcomes(run, job, keep_models, _throttled(progress)):
            del unfinished[outcome.entry.key]
            yield outcome
    except (Exception, SystemExit) as error:
        for cell in unfinished.values():
            yield failed(cell, error, traceback.format_exc())


def _outcomes(run: RunCell, job: Job, keep_models: bool, progress: Report) -> Iterator[Outcome]:
    if job.program is not None:
        run_program = imported("sme_registry.studies.programs:run_program")
        yield from run_program(job.cells, job.program, progress, keep_models)
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


def _throttled(report: Report) -> Report:
    """Pass on a report if the last one is some time ago, and at the end."""
    last = 0.0

    def throttled(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _SECONDS_BETWEEN_REPORTS or done >= total:
            last = now
            report(done, total)

    return throttled


class InProcess(Executor):
    """One job after the other in this process: for debugging, or where processes are forbidden."""

    workers = 1

    def _start(self, job: Job) -> None:
        self._running[id(job)] = job

    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        _, job = self._running.popitem()
        report = functools.partial(progress, job)
        yield from run_job(self._run, job, self._keep_models, report)


class Processes(Executor):
    """A new process (`spawn`) with one thread for each job.

    Not a pool of `concurrent.futures`, in which one dead worker fails every cell that is running:
    each process has its own pipe, so its death fails only its cells. It ends with this one,
    however that ends, and ignores Ctrl-C, which this process handles.
    """

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
            try:
                received = process.pipe.recv()
            except (EOFError, OSError):
                process.kill()
                del self._running[pipe]
                yield from map(process.death, process.unfinished.values())
                continue
            if not isinstance(received, Outcome):
                progress(process.job, *received)
                continue
            del process.unfinished[received.entry.key]
            if not process.unfinished:
                process.process.join(_SECONDS_TO_END)
                process.kill()
                del self._running[pipe]
            yield received


@dataclass(frozen=True)
class _JobProcess:
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
        on_cpu = job.program is not None and job.program.device == CPU
        # Or JAX would look for a GPU, and take most of its memory.
        variables = _ONE_THREAD | ({"JAX_PLATFORMS": CPU} if on_cpu else {})
        of_script = run.__module__ == "__main__"
        unguarded = contextlib.nullcontext() if of_script else children_without_main()
        with child_environment(variables), unguarded, block_interrupts():
            process.start()
        child_end.close()  # so that the pipe ends when the process does
        return cls(job, process, pipe, log, unfinished)

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def death(self, cell: Cell) -> Outcome:
        code = self.process.exitcode
        killed_by = next((each.name for each in signal.Signals if each == -code), None)
        how = f"was killed by {killed_by}" if killed_by else f"ended with exit code {code}"
        hint = " Memory may have run out: try fewer --jobs." if killed_by == "SIGKILL" else ""
        output = self.log.read_text(errors="replace") if self.log.exists() else ""
        error = f"the cell's process {how}.{hint} Run it again with --retry."
        return failed(cell, error, output)


def _child(pipe: Any, run: RunCell, job: Job, keep_models: bool, log: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    # Studies run for days, and many machines remove old files from the temporary folder.
    log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # what libraries print is for the failure, not the terminal
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
    tempfile.tempdir = str(log.parent)  # which the driver removes, also after a kill
    for outcome in run_job(run, job, keep_models, lambda *steps: pipe.send(steps)):
        pipe.send(outcome)


class OnRay(Executor):
    """A task on one core of a Ray cluster for each job; one whose node is lost runs again."""

    local = False

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._address = self._address or "local"
        self._ray = _import_ray()
        self._connected_here = False  # then `map` disconnects
        if self._address != "local":  # now, so that a wrong one is refused before anything runs
            self._connect()

    @property
    def workers(self) -> int:
        """Jobs that can run at once: `jobs`, else the cluster's cores as of now."""
        if self._jobs or not self._ray.is_initialized():
            return super().workers
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @contextlib.contextmanager
    def _session(self) -> Iterator[None]:
        self._connect()
        try:
            self._task = self._ray.remote(num_cpus=1, max_retries=_RETRIES)(_task)
            yield
        finally:
            for reference in self._running:
                self._ray.cancel(reference, force=True)
            self._running.clear()
            if self._connected_here:
                self._ray.shutdown()
                self._connected_here = False

    def _start(self, job: Job) -> None:
        if job.program is not None:
            job = replace(job, program=replace(job.program, state=None))
        self._running[self._task.remote(self._run, job, self._keep_models)] = job

    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        ready, _ = self._ray.wait(list(self._running), timeout=POLL_SECONDS)
        for reference in ready:
            yield from self._outcomes(reference, self._running.pop(reference))

    def _connect(self) -> None:
        if self._ray.is_initialized():
            return
        options: dict[str, Any] = {"address": self._address}
        if self._address == "local":
            options |= {"num_cpus": self.workers, "include_dashboard": False}
        else:
            _check_reachable(self._address)
        try:
            self._ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # of many kinds, by what is wrong with the address
            raise OptionError(
                f"ray={self._address!r}: cannot be used: {str(error).splitlines()[0]} {_ADDRESSES}"
            ) from None
        self._connected_here = True

    def _outcomes(self, reference: Any, job: Job) -> list[Outcome]:
        try:
            return [Outcome(*ended) for ended in self._ray.get(reference)]
        except self._ray.exceptions.RayError as error:
            text = str(error).strip()
            message = (
                f"{type(error).__name__}: lost {_RETRIES + 1} times: {text.splitlines()[0]} "
                "Run it again with --retry."
            )
            return [failed(cell, message, text) for cell in job.cells]


def _task(run: RunCell, job: Job, keep_models: bool) -> list[tuple[Any, ...]]:
    """Run one job on a Ray worker, which does not report how far it is."""
    return [tuple(outcome) for outcome in run_job(run, job, keep_models, lambda *steps: None)]


def _check_reachable(address: Any) -> None:
    """Raise if nothing answers at an address: Ray itself would try for many minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), _SECONDS_TO_ANSWER).close()
    except (OSError, ValueError, OverflowError) as error:
        raise OptionError(f"ray={address!r}: cannot be reached: {error}. {_ADDRESSES}") from None


def _import_ray() -> Any:
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    instead = "leave out --ray to use processes on this machine"
    require_packages("a study on a cluster", {"ray": "Ray"}, "ray", otherwise=instead)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import ray
    return ray


EXECUTORS: dict[str, type[Executor]] = {
    "processes": Processes,
    "in-process": InProcess,
    "ray": OnRay,
}
"""The executors by name, as `run_study` and `sme study run` take it."""


def executor_type(name: str | None, ray: str | None, jobs: int | None) -> type[Executor]:
    """The executor of a name; by default Ray where its address is given, else processes."""
    name = str(name or ("processes" if ray is None else "ray"))
    choice("executor", name, EXECUTORS, error=UnknownNameError)
    if ray is not None and name != "ray":
        raise OptionError(f"ray={ray!r}: contradicts executor={name!r}. Leave one out.")
    if jobs not in (None, 1) and name == "in-process":
        raise OptionError(f"jobs={jobs}: must be 1 with executor={name!r}. Leave it out.")
    return EXECUTORS[name]

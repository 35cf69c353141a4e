"""Where a study's cells run: in this process, in a process each, or as tasks of a Ray cluster.

All are one `map`: it takes the next cell when there is room for one, and yields what came of cells
in the order in which they end. What a cell returns crosses as the JSON of its file, checked where
it arrives, and whoever called `map` writes it: nothing but the driver touches the study's folder.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import logging
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.io import parse_json, to_json
from sme_registry.spec import Cell
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.terminal.interrupts import block_interrupts, defer_interrupts
from sme_registry.training.record import installed_versions

RunCell = Callable[[Cell, Callable[[int, int], None] | None, Path | None], CellResult]
Progress = Callable[[Cell, int, int], None]

SECONDS_BETWEEN_LOOKS = 0.2
_SECONDS_BETWEEN_REPORTS = 0.5
_TRACEBACK = 4000  # characters kept of where a cell failed
_RAY_RETRIES = 3  # of a cell whose worker or node is lost
_SECONDS_TO_ANSWER = 10.0
_RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_oom_retries": str(_RAY_RETRIES),  # without it a cell too large is tried for ever
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # its notices of a lost node, dozens of lines each
}
# One thread for each library that would take all: cells share the cores, one each.
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
}


@dataclass(frozen=True)
class Outcome:
    """What came of a cell: a result, or a failure."""

    cell: Cell
    result: CellResult | None = None
    failure: CellFailure | None = None
    model: bytes | None = None


class Executor(Protocol):
    """What runs cells."""

    @property
    def workers(self) -> int:
        """Cells that can run at once."""

    def map(self, cells: Iterator[Cell | None], progress: Progress) -> Iterator[Outcome]:
        """Run cells; when it is closed or raises, none is left running.

        Args:
          cells: asked for the next one whenever there is room; None says that there is none just
            now, so that it is asked again soon.
          progress: told a running cell, and how much of how much it has done.

        Yields:
          What came of each cell, in the order in which they end.
        """


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _Report(NamedTuple):
    """What crosses from where a cell ran: plain text, whole."""

    failed: bool
    text: str
    model: bytes | None = None

    def outcome(self, cell: Cell) -> Outcome:
        data = parse_json(self.text, "what the cell returned")
        if self.failed:
            return Outcome(cell, failure=CellFailure.from_dict(data))
        return Outcome(cell, result=CellResult.from_dict(data), model=self.model)


def _attempt(
    run: RunCell, cell: Cell, keep_model: bool, progress: Callable[[int, int], None]
) -> _Report:
    """Run a cell; what it raises is its failure, and not this process's."""
    try:
        with tempfile.TemporaryDirectory(prefix="sme-cell-") as folder:
            path = Path(folder) / "model.zip"
            result = run(cell, progress, path if keep_model else None)
            model = path.read_bytes() if path.exists() else None
        if result.key != cell.digest:
            raise RuntimeError(f"the result is of the cell {result.key}")
        return _Report(False, to_json(result.to_dict()), model)
    except (Exception, SystemExit) as error:
        name = type(error).__name__
        return _failure(cell, f"{name}: {error}", traceback.format_exc()[-_TRACEBACK:])


def _failure(cell: Cell, error: str, where: str = "") -> _Report:
    failure = CellFailure(
        key=cell.digest, cell=cell, error=error, traceback=where, versions=installed_versions()
    )
    return _Report(True, to_json(failure.to_dict()))


def _seldom(report: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Only what is told some time after the last, and the end: a cell may tell every step."""
    last = 0.0

    def told(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _SECONDS_BETWEEN_REPORTS or done >= total:
            last = now
            report(done, total)

    return told


@dataclass(frozen=True)
class InProcess:
    """One cell after the other in this process: to debug, and where processes are not allowed."""

    run: RunCell = run_cell
    keep_models: bool = False
    workers: int = 1

    def map(self, cells: Iterator[Cell | None], progress: Progress) -> Iterator[Outcome]:
        """See `Executor.map`."""
        for cell in cells:
            if cell is None:
                time.sleep(SECONDS_BETWEEN_LOOKS)
                continue
            told = _seldom(functools.partial(progress, cell))
            yield _attempt(self.run, cell, self.keep_models, told).outcome(cell)


class Processes:
    """A process for each cell, started anew (`spawn`) with one thread.

    A cell whose process is killed is a failed cell. The processes die with this one, however it
    dies, and ignore Ctrl-C, which is for this one to handle.

    Args:
      jobs: processes at once; None for one on each core that this process may use.
      run: what runs a cell; importable by name.
      keep_models: whether outcomes carry the trained model.
    """

    def __init__(
        self, jobs: int | None = None, run: RunCell = run_cell, keep_models: bool = False
    ) -> None:
        self.workers = available_cores() if jobs is None else jobs
        self._run, self._keep_models = run, keep_models

    def map(self, cells: Iterator[Cell | None], progress: Progress) -> Iterator[Outcome]:
        """See `Executor.map`."""
        running: dict[connection.Connection, _Job] = {}
        more = True
        with tempfile.TemporaryDirectory(prefix="sme-study-") as scratch:
            try:
                while more or running:
                    while more and len(running) < self.workers:
                        cell = next(cells, _END)
                        more = cell is not _END
                        if not isinstance(cell, Cell):
                            break
                        with defer_interrupts():  # or what has just begun would be nobody's
                            job = _Job.start(self._run, cell, self._keep_models, Path(scratch))
                            running[job.connection] = job
                    if not running:
                        time.sleep(SECONDS_BETWEEN_LOOKS if more else 0.0)
                    for ready in connection.wait(list(running), SECONDS_BETWEEN_LOOKS):
                        assert isinstance(ready, connection.Connection)
                        job = running[ready]
                        message = job.message()
                        if isinstance(message, _Report):
                            del running[ready]
                            yield message.outcome(job.cell)
                        else:
                            progress(job.cell, *message)
            finally:
                with defer_interrupts():
                    for job in running.values():
                        job.kill()


_END = object()


@dataclass(frozen=True)
class _Job:
    """A cell in a process of its own."""

    cell: Cell
    process: Any
    connection: connection.Connection
    log: Path

    @classmethod
    def start(cls, run: RunCell, cell: Cell, keep_model: bool, scratch: Path) -> _Job:
        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe(duplex=False)
        log = scratch / f"{cell.digest.removeprefix('sha256:')}.log"
        process = spawn.Process(target=_child, args=(theirs, run, cell, keep_model, log))
        with _one_thread(), block_interrupts():
            process.start()
        theirs.close()  # so that the pipe ends when the process does
        return cls(cell, process, ours, log)

    def message(self) -> _Report | tuple[int, int]:
        """The next thing it says; a report, after which it is gone."""
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            self.kill()
            return self._died()
        if isinstance(message, _Report):
            self.process.join(10)
            self.kill()
        return message  # type: ignore[no-any-return]

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()

    def _died(self) -> _Report:
        code = self.process.exitcode
        how = f"ended with exit code {code}"
        with contextlib.suppress(ValueError):
            how = f"was killed by {signal.Signals(-code).name}"
        hint = " Memory may have run out: try fewer --jobs." if code == -signal.SIGKILL else ""
        said = self.log.read_text(errors="replace")[-_TRACEBACK:] if self.log.exists() else ""
        return _failure(self.cell, f"the cell's process {how}.{hint} Run it again: --retry.", said)


def _child(
    channel: connection.Connection, run: RunCell, cell: Cell, keep_model: bool, log: Path
) -> None:
    """What the process of a cell does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _die_with_parent()
    # Studies run for days, and what lies in /tmp for long is removed on many machines.
    log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # what libraries print is for the failure, not the terminal
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
    tempfile.tempdir = str(log.parent)  # which the driver removes, also after a kill
    channel.send(_attempt(run, cell, keep_model, _seldom(lambda *told: channel.send(told))))


def _die_with_parent() -> None:
    """End this process when its parent ends, however that does."""
    if sys.platform == "linux":
        set_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()  # the end of a pipe that only the parent holds
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Children started inside find themselves limited before they import anything."""
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


class OnRay:
    """A task of a Ray cluster for each cell, on one core; a cell whose node is lost runs again.

    This process keeps the locks and writes the files, so the nodes need no shared file system:
    only Ray and this package in the same versions.

    Args:
      address: of a running cluster, or "local" to start one here for as long.
      jobs: cells at once; None for the cluster's cores, as many as it has at the time.
      run: what runs a cell.
      keep_models: whether outcomes carry the trained model.

    Raises:
      OptionError: the cluster cannot be reached.
      MissingDependencyError: Ray is not installed.
    """

    def __init__(
        self,
        address: str = "local",
        jobs: int | None = None,
        run: RunCell = run_cell,
        keep_models: bool = False,
    ) -> None:
        self._address, self._jobs = address, jobs
        self._run, self._keep_models = run, keep_models
        self._ray = _import_ray()
        self._ours = False  # the connection, which `map` ends
        if address != "local":  # now, so that a wrong one is refused before anything is written
            self._connect()

    @property
    def workers(self) -> int:
        """Cells that can run at once: `jobs`, else the cluster's cores as of now."""
        if self._jobs is not None:
            return self._jobs
        if not self._ray.is_initialized():
            return available_cores()
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def map(self, cells: Iterator[Cell | None], progress: Progress) -> Iterator[Outcome]:
        """See `Executor.map`."""
        ray = self._ray
        self._connect()
        running: dict[Any, Cell] = {}
        more = True
        try:
            board = _board(ray)
            task = ray.remote(num_cpus=1, max_retries=_RAY_RETRIES)(_task)
            while more or running:
                workers = self.workers
                while more and len(running) < workers:
                    cell = next(cells, _END)
                    more = cell is not _END
                    if not isinstance(cell, Cell):
                        break
                    running[task.remote(board, self._run, cell, self._keep_models)] = cell
                if not running:
                    time.sleep(SECONDS_BETWEEN_LOOKS if more else 0.0)
                    continue
                ready, _ = ray.wait(list(running), timeout=SECONDS_BETWEEN_LOOKS)
                for reference in ready:
                    cell = running.pop(reference)
                    yield self._report(reference, cell).outcome(cell)
                by_key = {cell.digest: cell for cell in running.values()}
                for key, (done, total) in ray.get(board.take.remote()).items():
                    if key in by_key:
                        progress(by_key[key], done, total)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)
            if self._ours:
                ray.shutdown()

    def _connect(self) -> None:
        """Connect, unless this process is connected already.

        Raises:
          OptionError: the cluster cannot be reached.
        """
        if self._ray.is_initialized():
            return
        options: dict[str, Any] = {"address": self._address}
        if self._address == "local":
            options |= {"num_cpus": self.workers, "include_dashboard": False}
        else:
            _refuse_unreachable(self._address)
        try:
            self._ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # of many kinds, by what is wrong with the address
            raise OptionError(
                f"ray={self._address!r}: cannot be used: {str(error).splitlines()[0]} {_ADDRESSES}"
            ) from None
        self._ours = True

    def _report(self, reference: Any, cell: Cell) -> _Report:
        try:
            return _Report(*self._ray.get(reference))
        except self._ray.exceptions.RayError as error:
            text = str(error).strip()
            return _failure(
                cell,
                f"{type(error).__name__}: lost {_RAY_RETRIES + 1} times: {text.splitlines()[0]} "
                "Run it again: --retry.",
                text[-_TRACEBACK:],
            )


_ADDRESSES = "Give 'local', or the host:port of a running cluster of this Ray version."


def _refuse_unreachable(address: str) -> None:
    """Raise where nobody listens: Ray itself would try for many minutes.

    Raises:
      OptionError: not host:port, or nobody answers there.
    """
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), _SECONDS_TO_ANSWER).close()
    except (OSError, ValueError, OverflowError) as error:
        raise OptionError(f"ray={address!r}: cannot be reached: {error}. {_ADDRESSES}") from None


def _task(board: Any, run: RunCell, cell: Cell, keep_model: bool) -> tuple[Any, ...]:
    """What a Ray worker does for a cell."""
    key = cell.digest
    told = _seldom(lambda done, total: board.tell.remote(key, done, total))
    return tuple(_attempt(run, cell, keep_model, told))


class _Board:
    """Where workers tell how far they are."""

    def __init__(self) -> None:
        self._told: dict[str, tuple[int, int]] = {}

    def tell(self, key: str, done: int, total: int) -> None:
        self._told[key] = (done, total)

    def take(self) -> dict[str, tuple[int, int]]:
        told, self._told = self._told, {}
        return told


def _board(ray: Any) -> Any:
    """A board on the driver's own node: if that is lost, so is the driver."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = ray.get_runtime_context().get_node_id()
    strategy = NodeAffinitySchedulingStrategy(node_id=here, soft=False)
    return ray.remote(num_cpus=0, scheduling_strategy=strategy)(_Board).remote()


def _import_ray() -> Any:
    for name, value in _RAY_SETTINGS.items():
        os.environ.setdefault(name, value)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import ray
    except ImportError:
        raise MissingDependencyError(
            "ray: is not installed. Run `pip install 'sme-registry[ray]'`, or leave --ray out: "
            "processes of this machine need nothing more."
        ) from None
    return ray

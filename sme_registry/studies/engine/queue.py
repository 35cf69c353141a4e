"""`Queue` of cells, and `Job`: what an executor runs at once, a cell or the lanes of a program.

Cells that use `jax:…` and differ in nothing but task, seed and protocol are lanes of a program, if
their tasks have the same shape and form: limits, distractors and mixing. The number of its lanes
follows from the whole plan: whatever was run before, is left out by `only` or runs elsewhere, a
cell's program has the same number of lanes, and so its result the same bits.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import math
import multiprocessing
import os
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.io import Lock, to_json
from sme_registry.spec import Cell, PlannedCell, SMESpec
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.ledger import Ledger, SavedState
from sme_registry.studies.engine.result import CellFailure, CellResult, Outcome
from sme_registry.training.record import versions_for

if TYPE_CHECKING:
    from sme_registry.jax.program import Program
    from sme_registry.jax.task import Shape

_Returned = TypeVar("_Returned")
CPU = "cpu"
_MOST_LANES = 10  # on a CPU: more save little time, and the last of a study would run alone longer
_MOST_LANES_ELSEWHERE = 256


@dataclass(frozen=True)
class Lanes:
    """How the cells of a job run as lanes of one program.

    Attributes:
      count: its lanes; those without a cell repeat the first.
      shape: to which the tasks are padded.
      device: "cpu", "gpu" or "tpu"; None for JAX's default.
      state: the file of its state, written every few minutes; None to write none.
      made_with: what a state must have been made with for others to go on from it.
      cells: those of the lanes of a state to go on from, in order. Each keeps its own task, also if
        it is none of the job's: another job may go on from the state that this one writes. Empty
        for those of the job.
      processes: that evaluate the trained policies.
    """

    count: int
    shape: Shape | None = None
    device: str | None = None
    state: Path | None = None
    made_with: Mapping[str, Any] = field(default_factory=dict)
    cells: tuple[Cell, ...] = ()
    processes: int = 1


@dataclass(frozen=True)
class Job:
    """Cells that run together: any number as lanes of a program, or a single one by itself."""

    cells: tuple[Cell, ...]
    lanes: Lanes | None = None


class Report(Protocol):
    """What a job calls while it runs."""

    def __call__(self, done: int, total: int, compilations: int = 0, note: str = "", /) -> None:
        """Report how far a job is."""


@contextlib.contextmanager
def child_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Environment variables of the processes that are started inside the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Programs:
    """Which cells of a plan share a program, and how many lanes it has."""

    def __init__(
        self,
        cells: Iterable[Cell],
        platform: str = CPU,
        device: str | None = None,
        most_lanes: int | None = None,
    ) -> None:
        self.platform, self._device = platform, device
        self._most = most_lanes or (_MOST_LANES if platform == CPU else _MOST_LANES_ELSEWHERE)
        self._shapes: dict[Hashable, dict[str, Shape]] = defaultdict(dict)
        self._cells: dict[str, Cell] = {}
        for cell in cells:
            if in_jax(cell.uses):
                self._cells[cell.digest] = cell
                self._shapes[self.group(cell)][cell.digest] = shape_of(cell)

    @property
    def one_at_a_time(self) -> bool:
        """Whether a second program would only slow the first one down."""
        return self.platform != CPU

    def lanes(self, cell: Cell) -> int:
        """The number of lanes of a cell's program: all programs of a group have the same."""
        size = len(self._shapes[self.group(cell)])
        return math.ceil(size / math.ceil(size / self._most))

    def program(self, cell: Cell) -> Lanes:
        """The program of a cell, still without a state."""
        from sme_registry.jax.task import Shape

        count, shape = self.lanes(cell), Shape.covering(self._shapes[self.group(cell)].values())
        made_with = {
            "lanes": count,
            "shape": list(shape),
            "platform": self.platform,
            "versions": versions_for(cell.uses),
        }
        processes = available_cores() if self.one_at_a_time else 1
        device = self._device if self.one_at_a_time else CPU
        return Lanes(count, shape, device, made_with=made_with, processes=processes)

    def without_room(self, cells: Iterable[Cell], workers: int) -> dict[str, str]:
        """How many lanes fit in memory, by a cell of each program that would not."""
        groups: dict[Hashable, list[Cell]] = defaultdict(list)
        for cell in cells:
            if in_jax(cell.uses):
                groups[self.group(cell)].append(cell)
        programs = [(group[0], self.program(group[0])) for group in groups.values()]
        number = sum(math.ceil(len(g) / self.lanes(g[0])) for g in groups.values())
        at_once = 1 if self.one_at_a_time else min(workers, number)
        return _beside_the_gpu(_without_room, programs, at_once) if programs else {}

    def cells(self, keys: Iterable[str]) -> tuple[Cell, ...] | None:
        """The cells of the plan with these keys; None if one of them is not in it any longer."""
        known = [self._cells.get(key) for key in keys]
        return tuple(cell for cell in known if cell is not None) if None not in known else None

    def group(self, cell: Cell) -> Hashable:
        """What the cells of a program have in common."""
        return (
            cell.uses,
            to_json(dict(sorted(cell.hyperparameters.items()))),
            cell.action_range,
            cell.steps,
            cell.evaluations,
            cell.evaluation_episodes,
            # Rewards that change no observation and end no episode are computed in another way.
            all(spec.k == 1 and spec.D == 0 for spec in cell.specs),
            tuple(map(_shape, cell.specs)),
            tuple(map(_form, cell.specs)),
            cell.stream and cell.stream.switches,
        )


def new_program(cells: Sequence[Cell], lanes: Lanes, at_once: int = 1) -> Program:
    """The program of cells of one group, of which `at_once` are to share the memory."""
    from sme_registry.jax.run import new_program

    cell = cells[0]
    return new_program(
        cell.uses,
        [each.document for each in cells],
        [each.seed for each in cells],
        hyperparameters=cell.hyperparameters,
        action_range=cell.action_range,
        steps=cell.steps,
        lanes=lanes.count,
        shape=lanes.shape,
        device=lanes.device,
        at_once=at_once,
    )


def platform_of(device: str | None) -> str:
    """The platform of a device, or of JAX's default: "cpu", "gpu" or "tpu"."""
    return _beside_the_gpu(_platform, device)


def _beside_the_gpu(function: Callable[..., _Returned], *arguments: Any) -> _Returned:
    """Call a function of JAX, in a process of its own where a GPU's memory might be taken."""
    if not importlib.metadata.entry_points(group="jax_plugins"):
        return function(*arguments)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def _platform(device: str | None) -> str:
    from sme_registry.jax.device import find_device

    return str(find_device(device).platform)


def _without_room(programs: Sequence[tuple[Cell, Lanes]], at_once: int) -> dict[str, str]:
    from sme_registry.jax.program import check_room

    reasons = {}
    for cell, lanes in programs:
        try:
            check_room(functools.partial(new_program, [cell], lanes, at_once))
        except ResourceLimitError as error:
            reasons[cell.digest] = str(error)
    return reasons


def shape_of(cell: Cell) -> Shape:
    """The shape that covers the cell's tasks: of a stream, those of several layers, if any."""
    from sme_registry.jax.task import Shape

    shapes = [Shape.of(spec) for spec in cell.specs]
    return Shape.covering([shape for shape in shapes if shape.complexity > 1] or shapes)


def _shape(spec: SMESpec) -> Shape:
    from sme_registry.jax.task import Shape

    return Shape.of(spec)


def _form(spec: SMESpec) -> Hashable:
    from sme_registry.jax.task import Form

    return Form.of(spec)


class _Running(NamedTuple):
    """A cell that runs: its lock, when its job started, and the job."""

    lock: Lock
    started: float
    job: Job


class Ended(NamedTuple):
    """A cell that has been written, with its job, and whether that has ended."""

    entry: CellResult | CellFailure
    seconds: float  # of the job, for each of its cells
    job: Job
    last: bool


class Queue:
    """The cells of one `run_study`: what waits, what runs, and what could not be written.

    Any number of runs may share a folder at once, on one machine or on several that share it: the
    lock of a cell decides who runs it, and its result file says that it is done. Cells are claimed
    when a worker is free: one, or as many as a program has lanes, so that the others are left to
    other runs.
    """

    def __init__(
        self,
        ledger: Ledger,
        planned: Mapping[str, PlannedCell],
        programs: Programs | None,
        *,
        retry_failed: bool,
    ) -> None:
        self._ledger, self._planned, self._programs = ledger, planned, programs
        self.results = ledger.results(planned)
        self._failures = ledger.failures(planned.keys() - self.results.keys())
        self.finished, self.failed = len(self.results), 0
        self.waiting = {
            key: planned_cell
            for key, planned_cell in planned.items()
            if key not in self.results and (retry_failed or key not in self._failures)
        }
        self._running: dict[str, _Running] = {}
        self._unwritten: list[Outcome] = []

    def one_at_a_time(self, cell: Cell) -> bool:
        """Whether a cell's program has the device to itself."""
        programs = self._programs
        return programs is not None and programs.one_at_a_time and in_jax(cell.uses)

    def unfinished(self) -> list[Sequence[Cell]]:
        """The cells of each running job, and each waiting one alone."""
        jobs = {id(running.job): running.job.cells for running in self._running.values()}
        return [*jobs.values(), *((planned.cell,) for planned in self.waiting.values())]

    def jobs(self) -> Iterator[Job | Ended | None]:
        """Jobs of locked cells; None while no cell is available.

        Before them come cells that could not be written when they ended, and now were. The folder
        may not be writable: running cells are then left to finish, since there may be space again,
        and their outcomes are kept in memory until they are written.
        """
        while self.waiting or self._unwritten:
            job = None
            try:
                for outcome in list(self._unwritten):
                    ended = self.write(outcome)
                    self._unwritten.remove(outcome)
                    yield ended
                job = self._next_job()
            except OptionError:
                if len(self._running) == len(self._unwritten):
                    raise
            yield job

    def keep(self, outcome: Outcome) -> None:
        """Keep an outcome that could not be written."""
        self._unwritten.append(outcome)

    def write(self, outcome: Outcome) -> Ended:
        """Write how a cell ended, and release its lock; OptionError if it cannot be written."""
        entry, key = outcome.entry, outcome.entry.key
        if isinstance(entry, CellFailure) and key in self._failures:
            attempts = self._failures[key].attempts + 1
            entry = entry.model_copy(update={"attempts": attempts})
        self._ledger.write(entry, outcome.model, outcome.snapshots)
        lock, started, job = self._running.pop(key)
        lock.release()
        self._count(entry)
        last = not any(cell.digest in self._running for cell in job.cells)
        if last and job.lanes is not None and job.lanes.state is not None:
            self._ledger.remove_states(job.lanes.state)
        return Ended(entry, (time.monotonic() - started) / len(job.cells), job, last)

    def release(self) -> None:
        """Release the locks of all cells that run."""
        for running in self._running.values():
            running.lock.release()

    def _count(self, entry: CellResult | CellFailure) -> None:
        self.finished += isinstance(entry, CellResult)
        self.failed += isinstance(entry, CellFailure)

    def _next_job(self) -> Job | None:
        """Claim the next cells that still have to run; None if there are none to claim now."""
        occupied = any(self.one_at_a_time(c) for r in self._running.values() for c in r.job.cells)
        for key, planned in list(self.waiting.items()):
            if occupied and self.one_at_a_time(planned.cell):
                continue
            if self._programs is not None and in_jax(planned.cell.uses):
                job = self._claim_program(self._programs, key)
            elif (lock := self._claim(key)) is not None:
                job = self._started(Job((planned.cell,)), [lock])
            else:
                job = None
            if job is not None:
                return job
        return None

    def _claim_program(self, programs: Programs, first: str) -> Job | None:
        """Claim a cell and the others of its program: those of a saved state, or the next ones."""
        if self._ledger.is_running(first):
            return None
        alone = self._ledger.claim_lock()
        if alone is None:
            return None
        with alone, contextlib.ExitStack() as stack:  # releases all of them if one raises
            cells, locks = list[Cell](), list[Lock]()
            program = programs.program(self._planned[first].cell)
            saved = self._ledger.state_of(first, program.made_with)
            in_state = programs.cells(saved.keys) if saved else None
            if in_state is None:
                saved, in_state = None, ()
            for key in self._candidates(programs, first, saved):
                if len(cells) < program.count:
                    lock = self._claim(key)
                    if lock is not None:
                        locks.append(stack.enter_context(lock))
                        cells.append(self._planned[key].cell)
                if not cells:
                    return None
            new = self._ledger.state_path([cell.digest for cell in cells], program.made_with)
            program = replace(program, state=saved.path if saved else new, cells=in_state)
            stack.pop_all()
        return self._started(Job(tuple(cells), program), locks)

    def _candidates(self, programs: Programs, first: str, saved: SavedState | None) -> list[str]:
        """The waiting cells that may be lanes of the program of the first one, which leads."""
        group = programs.group(self._planned[first].cell)
        others = self.waiting if saved is None else saved.keys
        return [first] + [
            key
            for key in others
            if key != first
            and key in self.waiting
            and programs.group(self._planned[key].cell) == group
        ]

    def _claim(self, key: str) -> Lock | None:
        """Lock a waiting cell; None if another process holds it, or has run it."""
        lock = self._ledger.lock(key)
        if lock is None:
            return None
        try:
            self._ledger.set_aside(key)
            result, failure = self._ledger.result(key), self._ledger.failure(key)
        except BaseException:
            lock.release()
            raise
        earlier = self._failures.get(key)
        attempts = earlier.attempts if earlier else 0
        failed_since = failure is not None and failure.attempts > attempts
        if result is None and not failed_since:
            return lock
        lock.release()
        del self.waiting[key]
        entry = result or failure
        assert entry is not None
        self._count(entry)
        return None

    def _started(self, job: Job, locks: Sequence[Lock]) -> Job:
        now = time.monotonic()
        for cell, lock in zip(job.cells, locks, strict=True):
            del self.waiting[cell.digest]
            self._running[cell.digest] = _Running(lock, now, job)
        return job

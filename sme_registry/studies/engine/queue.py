"""`Queue`: the cells of one `run_study`, waiting, running, or ended and not yet written.

Any number of runs may share a folder at once, on one machine or on several that share it: the lock
of a cell decides who runs it, and its result file says that it is done. Cells are claimed when a
worker is free: one, or as many as a program has lanes, so that the others are left to other runs.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from sme_registry.errors import OptionError
from sme_registry.io import Lock
from sme_registry.spec import Cell, PlannedCell
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.executors import Outcome
from sme_registry.studies.engine.jobs import Job, Programs
from sme_registry.studies.engine.ledger import Ledger, SavedState
from sme_registry.studies.engine.result import CellFailure, CellResult


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
    """What waits, what runs, and what could not be written."""

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

"""`run_study`: run the cells of a plan that have no result yet."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console

from sme_registry.errors import OptionError
from sme_registry.io import Lock, integer_in
from sme_registry.io.markup import plural
from sme_registry.io.terminal import Progress, err
from sme_registry.spec import StudyFile, StudyPlan, catalogue
from sme_registry.spec.study import Cell, PlannedCell
from sme_registry.studies.budget import selected, with_sources
from sme_registry.studies.cell import run_cell
from sme_registry.studies.executors import Executor, RunCell, executor_type
from sme_registry.studies.ledger import Ledger, StudyStatus, label, plan_status
from sme_registry.studies.result import CPU, CellFailure, CellResult, Job, Outcome, SharedProgram
from sme_registry.training.algorithms import (
    backend_of,
    check_algorithms,
    imported,
    needs_device,
)
from sme_registry.training.record import versions_for

if TYPE_CHECKING:
    from sme_registry.studies.programs import Programs


def run_study(
    plan_file: StudyFile | str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    executor: str | Executor | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    retry_failed: bool = False,
    keep_models: bool = False,
    only: Sequence[str] = (),
    device: str | None = None,
    lanes: int | None = None,
    progress: bool = True,
    console: Console | None = None,
    run: RunCell = run_cell,
) -> StudyStatus:
    """Run the cells of a plan that have no result in the folder, and return their state.

    Each result is written as soon as its cell ends. If this process ends early, the same call
    continues. Cells that another process is running are waited for. Results of earlier plans stay.

    Args:
      plan_file: or the name of a plan in the catalogue, or the path of a plan's file.
      executor: "processes", one for each cell; "in-process"; "ray"; an `Executor`; or None for
        "processes", and with an address the executor of that.
      jobs: cells or programs at once; None for one per core, of this machine or of the cluster.
      ray: "local", which is the default of executor="ray", or the address of a Ray cluster.
      keep_models: of the cells that run now. Finished cells without a model do not run again.
      only: `class=GLOB`, `algorithm=GLOB`, `run=GLOB`, of numbers from 0: a cell must match any of
        the patterns of each kind.
      device: where programs of JAX run, "cpu", "gpu" or "tpu"; None for JAX's default.
      lanes: most runs of a program; None for a number that suits the device.
      run: runs a cell; for processes and Ray importable by name.

    Examples:
      >>> from sme_registry.studies import run_study
      >>> run_study("study/plan.json", "study", executor="in-process", progress=False).count("done")
      6
    """
    if jobs is not None:
        jobs = integer_in("jobs", jobs, 1)
    if lanes is not None:
        lanes = integer_in("lanes", lanes, 1, 100_000)
    plan_file = with_sources(_file_of(plan_file))
    planned: dict[str, PlannedCell] = {}
    for place in selected(plan_file.plan.cells, only):
        planned.setdefault(place.cell.digest, place)
    console = console or err()
    checked = planned.values() if run is run_cell else ()

    def say(text: str) -> None:
        if progress:
            console.print(text, markup=False, highlight=False, soft_wrap=True)

    check_algorithms(plan_file.plan, checked, say)
    if not isinstance(executor, Executor):
        executor = executor_type(executor, ray, jobs)(jobs, run, keep_models, ray)
    programs = _programs(plan_file.plan, checked, device, lanes, local=executor.local)
    ledger = Ledger(folder)
    earlier_plan = ledger.plan_file()
    queue = Queue(ledger, planned, programs, retry_failed=retry_failed)
    if earlier_plan is None or earlier_plan != plan_file:
        ledger.write_plan(plan_file)
    title = f"study {plan_file.versioned_name}"
    study = _StudyRun(title, queue, executor, console, progress)
    ledger.warn = study.say
    study.announce()
    for notice in _notices(earlier_plan, plan_file, queue):
        study.say(notice)
    try:
        study.run()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted: {queue.finished} of {len(planned)} cells have finished and are in "
            f"{ledger.folder}. Run the same command to continue."
        ) from None
    return plan_status(ledger, plan_file, only)


def _file_of(plan: StudyFile | str | os.PathLike[str]) -> StudyFile:
    if not isinstance(plan, StudyFile | str | os.PathLike):
        raise OptionError(f"plan_file={plan!r:.80}: must be a StudyFile, its name or its path.")
    return plan if isinstance(plan, StudyFile) else catalogue.find(StudyFile, plan)


def _programs(
    plan: StudyPlan,
    planned: Collection[PlannedCell],
    device: str | None,
    lanes: int | None,
    *,
    local: bool,
) -> Programs | None:
    """The programs of a plan, if any of these cells runs in one; on a cluster each has one core."""
    if not any(backend_of(cell.cell.uses).in_programs for cell in planned):
        for name, value in (("device", device), ("lanes", lanes)):
            if value is not None:
                raise needs_device(name, value, ", and no cell to run has one")
        return None
    if not local and device not in (None, CPU):
        raise OptionError(
            f"device={device!r}: must be cpu on a cluster, where a program has one core. Leave out "
            "--device, or use --executor processes on a machine that has such a device."
        )
    cells = (cell.cell for cell in plan.cells)
    new_programs = imported("sme_registry.studies.programs:Programs")
    programs: Programs = new_programs(cells, device if local else CPU, lanes)
    return programs


class _RunningCell(NamedTuple):
    lock: Lock
    job: Job


class Queue:
    """The cells of one `run_study`: what waits and what runs.

    Any number of processes may share a folder: the lock of a cell decides who runs it. Cells are
    claimed when a worker is free, so that the others are left to other processes.
    """

    def __init__(
        self,
        ledger: Ledger,
        planned: Mapping[str, PlannedCell],
        programs: Programs | None,
        *,
        retry_failed: bool,
    ) -> None:
        self._ledger, self.planned, self._programs = ledger, planned, programs
        self.results = ledger.results(planned)
        self._failures = ledger.failures(planned.keys() - self.results.keys())
        self.finished, self.failed = len(self.results), 0
        self.waiting = {
            key: place
            for key, place in planned.items()
            if key not in self.results and (retry_failed or key not in self._failures)
        }
        self._running: dict[str, _RunningCell] = {}

    def jobs(self) -> Iterator[Job | None]:
        """Jobs of locked cells; None while no cell is available."""
        while self.waiting:
            yield self._next_job()

    def write(self, outcome: Outcome) -> Job | None:
        """Write how a cell ended, and release its lock; returns its job if all of that ended."""
        entry, key = outcome.entry, outcome.entry.key
        if isinstance(entry, CellFailure) and key in self._failures:
            attempts = self._failures[key].attempts + 1
            entry = entry.model_copy(update={"attempts": attempts})
        self._ledger.write(entry, outcome.model, outcome.snapshots)
        lock, job = self._running.pop(key)
        lock.release()
        self._count(entry)
        if any(cell.digest in self._running for cell in job.cells):
            return None
        if job.program is not None:
            self._ledger.remove_states()
        return job

    def release(self) -> None:
        for running in self._running.values():
            running.lock.release()

    def _count(self, entry: CellResult | CellFailure) -> None:
        self.finished += isinstance(entry, CellResult)
        self.failed += isinstance(entry, CellFailure)

    def _next_job(self) -> Job | None:
        """Claim the next cells that still have to run; None if there are none to claim now."""
        running = (self._programs_of(running.job.cells[0]) for running in self._running.values())
        occupied = any(programs is not None and programs.one_at_a_time for programs in running)
        for key, place in list(self.waiting.items()):
            programs = self._programs_of(place.cell)
            if programs is None:
                job = self._claim_job([key])
            elif not (occupied and programs.one_at_a_time):
                job = self._claim_program(programs, key)
            else:
                continue
            if job is not None:
                return job
        return None

    def _programs_of(self, cell: Cell) -> Programs | None:
        """Those of which a cell is a run; None if it runs by itself."""
        return self._programs if backend_of(cell.uses).in_programs else None

    def _claim_program(self, programs: Programs, first: str) -> Job | None:
        """Claim a cell and the others of its program: those of a saved state, or the next ones."""
        claiming = None if self._ledger.is_running(first) else self._ledger.claim_lock()
        if claiming is None:
            return None
        with claiming:
            program = programs.program(self.planned[first].cell)
            path, keys = self._ledger.state_of(first, program.build_key) or (None, [])
            in_state = programs.cells(keys)
            if in_state is None:
                path, in_state = None, ()
            group = programs.group(self.planned[first].cell)
            candidates = [
                key
                for key in (keys if path else self.waiting)
                if key in self.waiting and programs.group(self.planned[key].cell) == group
            ]
            candidates.sort(key=lambda key: key != first)  # which leads
            return self._claim_job(candidates, replace(program, state=path, cells=in_state))

    def _claim_job(self, keys: Sequence[str], program: SharedProgram | None = None) -> Job | None:
        """Lock the first of these cells, and of the others as many as its program has runs."""
        locks: dict[str, Lock] = {}
        with contextlib.ExitStack() as stack:  # releases all of them if one raises
            for key in keys:
                if (lock := self._claim(key)) is not None:
                    locks[key] = stack.enter_context(lock)
                if not locks:
                    return None
                if program is not None and len(locks) == program.runs:
                    break
            if program is not None and program.state is None:
                program = replace(program, state=self._ledger.state_path(locks, program.build_key))
            stack.pop_all()
        job = Job(tuple(self.planned[key].cell for key in locks), program)
        for key, lock in locks.items():
            del self.waiting[key]
            self._running[key] = _RunningCell(lock, job)
        return job

    def _claim(self, key: str) -> Lock | None:
        """Lock a waiting cell; None if another process holds it, or has run it."""
        lock = self._ledger.lock(key)
        if lock is None:
            return None
        with contextlib.ExitStack() as stack:
            stack.enter_context(lock)
            self._ledger.set_aside(key)
            entry = self._ledger.result(key) or self._ledger.failures([key]).get(key)
            if entry is None or entry == self._failures.get(key):
                stack.pop_all()
                return lock
        del self.waiting[key]
        self._count(entry)
        return None


class _StudyRun:
    """One `run_study`: it hands jobs to the executor, writes outcomes, and shows progress."""

    def __init__(
        self, title: str, queue: Queue, executor: Executor, console: Console, progress: bool
    ) -> None:
        self._title, self._queue, self._executor = title, queue, executor
        total, done = len(queue.planned), queue.finished
        self._progress = Progress(
            title, total, done=done, console=console, unit="cells", enabled=progress
        )
        self.say = self._progress.message

    def announce(self) -> None:
        queue, cells = self._queue, len(self._queue.planned)
        parts = [plural(cells, "cell")]
        if queue.finished:
            parts.append(f"{queue.finished:,} finished before and reused")
        skipped = cells - queue.finished - len(queue.waiting)
        if skipped:
            parts.append(f"{skipped:,} failed before (--retry runs them again)")
        parts.append(f"{len(queue.waiting):,} to run")
        if queue.waiting:
            parts.append(f"{self._executor.workers} at once")
        self.say(f"{self._title}: {' · '.join(parts)}")

    def run(self) -> None:
        if not self._queue.waiting:
            return
        outcomes = self._executor.map(self._jobs(), self._report)
        with self._progress:
            try:
                with contextlib.closing(outcomes):  # ends running cells before their locks go
                    for outcome in outcomes:
                        self._write(outcome)
            finally:
                self._queue.release()

    def _jobs(self) -> Iterator[Job | None]:
        for job in self._queue.jobs():
            if job is not None:
                self._progress.start_part(self._name(job), "compiling" if job.program else "")
            self._show_counts()
            yield job

    def _report(self, job: Job, done: int, total: int) -> None:
        state = f"{done:,} of {total:,} steps" if done < total else "evaluating"
        self._progress.update_part(self._name(job), done / total if total else 1.0, state)

    def _write(self, outcome: Outcome) -> None:
        entry = outcome.entry
        if isinstance(entry, CellFailure):
            self.say(f"failed: {label(self._queue.planned[entry.key])}: {entry.error}")
        ended = self._queue.write(outcome)
        if ended is not None:
            self._progress.end_part(self._name(ended))
        self._show_counts()

    def _show_counts(self) -> None:
        failed = self._queue.failed
        self._progress.update(self._queue.finished, note=f"{failed} failed" if failed else "")

    def _name(self, job: Job) -> str:
        """What people call a job: `PPO on k-25, run 3`, or `…, and 9 more`."""
        first, *others = (label(self._queue.planned[cell.digest]) for cell in job.cells)
        return f"{first}, and {len(others)} more" if others else first


def _notices(earlier: StudyFile | None, file: StudyFile, queue: Queue) -> Iterator[str]:
    """What a reader of the results should know before the run."""
    if earlier is not None and earlier.digest != file.digest:
        yield (
            f"The folder's plan was {earlier.versioned_name} ({earlier.digest[:19]}…) and is now "
            f"{file.versioned_name} ({file.digest[:19]}…). Results of cells in both plans are "
            "reused; the others stay in the folder."
        )
    installed = functools.cache(versions_for)
    others = {
        f"{package} {version} (installed: {now})"
        for result in queue.results.values()
        for package, version in result.versions.items()
        if (now := installed(result.cell.uses).get(package, version)) != version
    }
    if others:
        yield (
            f"Reused results come from other package versions: {', '.join(sorted(others))}. For "
            "results of one set of versions, run the plan in a new folder."
        )

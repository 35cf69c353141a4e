"""`run_study`: run the cells of a plan that have no result yet.

Any number of runs may share a folder at once, on one machine or on several that share it: the lock
of a cell decides who runs it, and its result file says that it is done. Cells are claimed when a
worker is free: one, or as many as a program has lanes, so that the others are left to other runs.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from rich.console import Console

from sme_registry.errors import OptionError, ResourceLimitError, UnknownNameError
from sme_registry.io import Lock, integer_in
from sme_registry.io.terminal import Progress, duration
from sme_registry.spec import Cell, PlannedCell, StudyFile, StudyPlan
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine import checks
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.estimate import Estimator, makespan
from sme_registry.studies.engine.executors import Executor, InProcess, Outcome, RunCell
from sme_registry.studies.engine.jobs import CPU, Job, Programs, platform_of
from sme_registry.studies.engine.ledger import Ledger, SavedState
from sme_registry.studies.engine.processes import Processes
from sme_registry.studies.engine.ray_executor import OnRay
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.studies.engine.scaling import first_places, selected
from sme_registry.studies.engine.status import StudyStatus, label, plan_status
from sme_registry.training.record import versions_for

_SHARE_FOR_A_PACE = 0.02  # of a job, before its pace is measured
EXECUTORS = ("processes", "in-process", "ray")


def run_study(
    plan_file: StudyFile,
    folder: str | os.PathLike[str],
    *,
    executor: str | Executor = "processes",
    jobs: int | None = None,
    ray: str = "local",
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

    Each result is written as soon as its cell ends. If this process ends early, for any reason, the
    same call continues. Cells that another process is running are waited for at the end.

    Cells that use `jax:…` run together, as lanes of one program, in any executor: on a CPU a
    program on each core, on another device one at a time.

    Args:
      plan_file: the plan; it becomes the folder's, and results of earlier plans stay.
      executor: "processes", one for each cell; "in-process"; "ray"; or an `Executor`.
      jobs: cells or programs at once; None for one per core, of this machine or of the cluster.
      ray: "local", or the address of a Ray cluster.
      retry_failed: also run the cells that failed before.
      keep_models: keep the trained models of the cells that run now. Finished cells without a model
        are reported and not run again.
      only: `class=GLOB`, `algorithm=GLOB`: the cells to run now. A cell must match any of the
        patterns of each kind.
      device: where programs of JAX run, "cpu", "gpu" or "tpu"; None for JAX's default.
      lanes: most lanes of a program; None for a number that suits the device.
      run: runs a cell; for processes and Ray importable by name.

    Examples:
      >>> from sme_registry.spec import StudyFile
      >>> from sme_registry.studies import run_study
      >>> plan = StudyFile.read("study/plan.json")
      >>> run_study(plan, "study", executor="in-process", progress=False).count("done")
      6
    """
    if jobs is not None:
        jobs = integer_in("jobs", jobs, 1)
    if lanes is not None:
        lanes = integer_in("lanes", lanes, 1, 100_000)
    planned = first_places(selected(plan_file.plan.cells, only))
    programs = None
    if run is run_cell:
        _check(plan_file.plan, planned.values())
    if run is run_cell and any(in_jax(cell.cell.uses) for cell in planned.values()):
        if executor == "ray" or isinstance(executor, OnRay):
            device = _device_on_ray(device)
        every = (cell.cell for cell in plan_file.plan.cells)
        programs = Programs(every, platform_of(device), device, lanes)
    else:
        _refuse_without_jax(device=device, lanes=lanes)
    runs_on = _executor(executor, jobs, ray, run, keep_models)
    ledger = Ledger(folder)
    earlier_plan = ledger.plan_file()
    study = _StudyRun(
        plan_file,
        ledger,
        planned,
        runs_on,
        programs,
        console or Console(stderr=True),
        retry_failed,
        progress,
    )
    if not isinstance(runs_on, OnRay):  # whose nodes have a memory of their own
        study.refuse_without_room()
    if earlier_plan is None or earlier_plan != plan_file:
        ledger.write_plan(plan_file)
    if study.finished < len(planned):
        ledger.write_request(plan_file, only)
    study.announce(earlier_plan, keep_models)
    try:
        study.run()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted: {study.finished} of {len(planned)} cells have finished and are in "
            f"{ledger.folder}. Run the same command to continue."
        ) from None
    return plan_status(ledger, plan_file, only)


def _check(plan: StudyPlan, planned: Collection[PlannedCell]) -> None:
    """Check the algorithms of these cells, and that they have such tasks."""
    names = {cell.algorithm for cell in planned}
    for algorithm in plan.algorithms:
        if algorithm.name in names:
            checks.find(algorithm.uses)
            checks.check_hyperparameters(algorithm)
    for cell in planned:
        checks.check_task(cell.cell)


def _refuse_without_jax(**options: Any) -> None:
    """Raise OptionError if an option is given that is for agents in JAX alone."""
    for name, value in options.items():
        if value is not None:
            raise OptionError(
                f"{name}={value!r}: is for agents in JAX, and no cell to run has one. Leave it "
                'out, or use --agents jax (in a plan, "uses": "jax:PPO").'
            )


def _device_on_ray(device: str | None) -> str:
    """The device of programs on Ray: each task has one core of its node, and no GPU."""
    if device not in (None, CPU):
        raise OptionError(
            f"device={device!r}: must be cpu on Ray, where a program has one core. Leave out "
            "--device, or leave out --ray on a machine that has such a device."
        )
    return CPU


def _executor(
    executor: str | Executor, jobs: int | None, ray: str, run: RunCell, keep_models: bool
) -> Executor:
    if not isinstance(executor, str):
        return executor
    if executor == "processes":
        return Processes(jobs, run, keep_models)
    if executor == "in-process":
        return InProcess(run, keep_models)
    if executor == "ray":
        return OnRay(ray, jobs, run, keep_models)
    raise UnknownNameError(f"executor={executor!r}: must be one of {', '.join(EXECUTORS)}.")


class _Running(NamedTuple):
    """A cell that runs: its lock, when its job started, and the job."""

    lock: Lock
    started: float
    job: Job


class _StudyRun:
    """The cells of one `run_study`: waiting, running, or ended and not yet written."""

    def __init__(
        self,
        file: StudyFile,
        ledger: Ledger,
        planned: dict[str, PlannedCell],
        executor: Executor,
        programs: Programs | None,
        console: Console,
        retry_failed: bool,
        progress: bool,
    ) -> None:
        self._file, self._ledger, self._executor = file, ledger, executor
        self._planned, self._programs = planned, programs
        self._results = ledger.results(planned)
        self._failures = ledger.failures(planned.keys() - self._results.keys())
        self.finished, self._failed = len(self._results), 0
        self._estimator = Estimator(self._results.values())
        self._waiting = {
            key: cell
            for key, cell in planned.items()
            if key not in self._results and (retry_failed or key not in self._failures)
        }
        self._running: dict[str, _Running] = {}
        self._shares: dict[str, float] = {}  # of a running cell's steps, done
        # Of each job, the first report after it last compiled: time, share, compilations.
        self._first_reports: dict[str, tuple[float, float, int]] = {}
        self._paces: dict[str, float] = {}  # measured by estimated seconds, of each algorithm
        self._unwritten: list[Outcome] = []
        self._progress = Progress(
            f"study {file.versioned_name}",
            len(planned),
            done=self.finished,
            console=console,
            unit="cells",
            seconds_left=self.seconds_left,
            enabled=progress,
        )
        ledger.warn = self._progress.message

    def refuse_without_room(self) -> None:
        """Raise ResourceLimitError if programs that run at once would not fit in memory."""
        if self._programs is None:
            return
        cells = [planned.cell for planned in self._waiting.values()]
        reasons = self._programs.without_room(cells, self._executor.workers)
        if reasons:
            named = ((self._planned[key], reason) for key, reason in reasons.items())
            raise ResourceLimitError(
                "\n".join(f"{cell.algorithm} on {cell.class_name}: {why}" for cell, why in named)
                + "\nSee --lanes and --jobs."
            )

    def announce(self, earlier_plan: StudyFile | None, keep_models: bool) -> None:
        """Print what is done, what is reused, and what will run."""
        say = self._progress.message
        if earlier_plan is not None and earlier_plan.digest != self._file.digest:
            say(
                f"The folder's plan was {earlier_plan.versioned_name} "
                f"({earlier_plan.digest[:19]}…) and is now {self._file.versioned_name} "
                f"({self._file.digest[:19]}…). Results of cells in both plans are reused; the "
                "others stay in the folder."
            )
        parts = [f"{len(self._planned):,} cells"]
        if self.finished:
            parts.append(f"{self.finished:,} finished before and reused")
        skipped = len(self._planned) - self.finished - len(self._waiting)
        if skipped:
            parts.append(f"{skipped:,} failed before (--retry runs them again)")
        parts.append(f"{len(self._waiting):,} to run")
        if self._waiting:
            parts.append(f"{self._executor.workers} at once")
            parts.append(f"about {duration(self.seconds_left())}")
        say(f"study {self._file.versioned_name}: {' · '.join(parts)}")
        self._announce_other_versions()
        if keep_models:
            self._announce_missing_models()

    def _announce_other_versions(self) -> None:
        installed = functools.cache(versions_for)
        count, differences = 0, set[str]()
        for result in self._results.values():
            now = installed(result.cell.uses)
            different = {
                f"{package} {version} (installed: {now[package]})"
                for package, version in result.versions.items()
                if now.get(package, version) != version
            }
            count, differences = count + bool(different), differences | different
        if count:
            self._progress.message(
                f"{count:,} of the reused results come from other package versions: "
                f"{', '.join(sorted(differences))}. For results of one set of versions, run the "
                "plan in a new folder."
            )

    def _announce_missing_models(self) -> None:
        missing = sum(
            # Only a cell that learnt by acting leaves a model.
            result.online_regret is not None and not self._ledger.model_path(result.key).exists()
            for result in self._results.values()
        )
        if missing:
            self._progress.message(
                f"{missing:,} of the finished cells have no model and are not run again. To get "
                "their models, run the plan in a new folder."
            )

    def run(self) -> None:
        """Run every waiting cell."""
        if not self._waiting:
            return
        outcomes = self._executor.map(self._jobs(), self._report)
        with self._progress:
            try:
                with contextlib.closing(outcomes):  # ends running cells before their locks go
                    for outcome in outcomes:
                        self._handle(outcome)
            finally:
                for running in self._running.values():
                    running.lock.release()

    def seconds_left(self) -> float:
        """Seconds to the end, as estimated now."""
        seconds: dict[bool, list[float]] = {True: [], False: []}  # one at a time; others
        jobs = {id(running.job): running.job.cells for running in self._running.values()}
        waiting = ((self._planned[key].cell,) for key in self._waiting)
        for cells in (*jobs.values(), *waiting):
            rests = (self._seconds(c) * (1 - self._shares.get(c.digest, 0.0)) for c in cells)
            seconds[self._one_at_a_time(cells[0])].append(sum(rests))
        return max(sum(seconds[True]), makespan(seconds[False], self._executor.workers))

    def _seconds(self, cell: Cell) -> float:
        """A whole cell's seconds; before one of its algorithm has finished, by the pace of those
        that run.
        """
        low, high = self._estimator.seconds(cell)
        pace = 1.0 if self._estimator.knows(cell) else self._paces.get(cell.uses, 1.0)
        return pace * (low + high) / 2

    def _one_at_a_time(self, cell: Cell) -> bool:
        """Whether a cell's program has the device to itself."""
        programs = self._programs
        return programs is not None and programs.one_at_a_time and in_jax(cell.uses)

    def _jobs(self) -> Iterator[Job | None]:
        """Jobs of locked cells for the executor; None while no cell is available."""
        while self._waiting or self._unwritten:
            try:
                for outcome in list(self._unwritten):
                    self._write(outcome)
                    self._unwritten.remove(outcome)
                job = self._next_job()
            except OptionError:
                # The folder cannot be written to. Running cells are left to finish: there may be
                # space again by then, and their outcomes are kept in memory until they are written.
                if len(self._running) == len(self._unwritten):
                    raise
                job = None
            yield job

    def _next_job(self) -> Job | None:
        """Claim the next cells that still have to run; None if there are none to claim now."""
        occupied = any(self._one_at_a_time(c) for r in self._running.values() for c in r.job.cells)
        for key, planned in list(self._waiting.items()):
            if occupied and self._one_at_a_time(planned.cell):
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
        others = self._waiting if saved is None else saved.keys
        return [first] + [
            key
            for key in others
            if key != first
            and key in self._waiting
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
        del self._waiting[key]
        self.finished += result is not None
        self._show(failed=result is None)
        return None

    def _started(self, job: Job, locks: Sequence[Lock]) -> Job:
        now = time.monotonic()
        for cell, lock in zip(job.cells, locks, strict=True):
            del self._waiting[cell.digest]
            self._running[cell.digest] = _Running(lock, now, job)
        self._progress.start_part(self._name(job), "compiling" if job.lanes else "")
        return job

    def _name(self, job: Job) -> str:
        """What people call a job: `PPO on k-25, run 3`, or `…, and 9 more`."""
        first, *others = (label(self._planned[cell.digest]) for cell in job.cells)
        return f"{first}, and {len(others)} more" if others else first

    def _report(
        self, job: Job, done: int, total: int, compilations: int = 0, note: str = ""
    ) -> None:
        if note:
            self._progress.message(f"{self._name(job)}: {note}")
            return
        share, now = done / total if total else 1.0, time.monotonic()
        first = job.cells[0]
        then, before, compiled = self._first_reports.get(first.digest, (now, share, -1))
        if compilations != compiled:
            then, before = now, share
            self._first_reports[first.digest] = (now, share, compilations)
        if share - before >= _SHARE_FOR_A_PACE:  # a program may go on from far beyond its start
            measured = (now - then) / (share - before) / len(job.cells)
            self._paces[first.uses] = 2 * measured / sum(self._estimator.seconds(first))
        self._shares |= {cell.digest: share for cell in job.cells}
        state = f"{done:,} of {total:,} steps" if done < total else "evaluating"
        self._progress.update_part(self._name(job), share, state)

    def _handle(self, outcome: Outcome) -> None:
        entry = outcome.entry
        if isinstance(entry, CellFailure):
            name = label(self._planned[entry.key])
            self._progress.message(f"failed: {name}: {entry.error}")
        try:
            self._write(outcome)
        except OptionError as error:
            self._unwritten.append(outcome)
            self._progress.message(
                f"{error} No new cell starts until there is space. Finished cells are kept in "
                "memory, and are lost only if this process ends before it can write them."
            )

    def _write(self, outcome: Outcome) -> None:
        entry, key = outcome.entry, outcome.entry.key
        if isinstance(entry, CellFailure) and key in self._failures:
            attempts = self._failures[key].attempts + 1
            entry = entry.model_copy(update={"attempts": attempts})
        self._ledger.write(entry, outcome.model, outcome.snapshots)
        lock, started, job = self._running.pop(key)
        lock.release()
        if isinstance(entry, CellResult):
            self.finished += 1
            self._estimator.observe(entry, (time.monotonic() - started) / len(job.cells))
        if not any(cell.digest in self._running for cell in job.cells):
            self._end(job)
        self._show(failed=isinstance(entry, CellFailure))

    def _end(self, job: Job) -> None:
        """Remove a job of which every cell has been written, and its state if it is of no use."""
        self._progress.end_part(self._name(job))
        if job.lanes is not None and job.lanes.state is not None:
            self._ledger.remove_states(job.lanes.state)

    def _show(self, *, failed: bool) -> None:
        self._failed += failed
        self._progress.update(self.finished, f"{self._failed} failed" if self._failed else "")

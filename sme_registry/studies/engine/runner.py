"""`run_study`: run the cells of a plan that have no result yet.

Any number of runs may share a folder at once, on one machine or on several that share it: the lock
of a cell decides who runs it, and its result file says that it is done.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Iterator, Sequence

from rich.console import Console

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io import Lock, integer_in
from sme_registry.spec import Cell, PlannedCell, StudyFile
from sme_registry.studies.engine import checks
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.estimate import Estimator, makespan
from sme_registry.studies.engine.executors import Executor, InProcess, Outcome, RunCell
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.processes import Processes
from sme_registry.studies.engine.ray_executor import OnRay
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.studies.engine.scaling import selected
from sme_registry.studies.engine.status import StudyStatus, label, plan_status
from sme_registry.terminal import Progress, duration
from sme_registry.training.record import versions_for

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
    progress: bool = True,
    console: Console | None = None,
    run: RunCell = run_cell,
) -> StudyStatus:
    """Run the cells of a plan that have no result in the folder.

    Each result is written as soon as its cell ends. If this process ends early, for any reason, the
    same call continues. Cells that another process is running are waited for at the end.

    Args:
      plan_file: the plan; it becomes the folder's, and results of earlier plans stay.
      folder: of the study; created if it does not exist.
      executor: "processes", one for each cell; "in-process"; "ray"; or an `Executor`.
      jobs: cells at once; None for one per core, of this machine or of the cluster.
      ray: "local", or the address of a Ray cluster.
      retry_failed: also run the cells that failed before.
      keep_models: keep the trained models of the cells that run now. Finished cells without a model
        are reported and not run again.
      only: `class=GLOB`, `algorithm=GLOB`: the cells to run now; see `scaling.selected`.
      progress: whether to show progress.
      console: where to show it; None for standard error.
      run: runs a cell; for processes and Ray importable by name.

    Returns:
      The state of the selected cells at the end.

    Raises:
      OptionError: the folder contains other files or cannot be written to, or an argument is out
        of range. Finished cells stay.
      UnknownNameError: a pattern matches nothing, or an algorithm cannot be found.
      MissingDependencyError: an algorithm, or Ray, needs a package that is not installed.
      KeyboardInterrupt: interrupted; says how to continue.
    """
    if jobs is not None:
        jobs = integer_in("jobs", jobs, 1)
    planned = {cell.cell.digest: cell for cell in selected(plan_file.plan.cells, only)}
    if run is run_cell:
        names = {cell.algorithm for cell in planned.values()}
        for algorithm in plan_file.plan.algorithms:
            if algorithm.name in names:
                checks.find(algorithm.uses)
                checks.check_hyperparameters(algorithm)
    runs_on = _executor(executor, jobs, ray, run, keep_models)
    ledger = Ledger(folder)
    earlier_plan = ledger.plan_file()
    if earlier_plan is None or earlier_plan != plan_file:
        ledger.write_plan(plan_file)
    study = _StudyRun(
        plan_file, ledger, planned, runs_on, console or Console(stderr=True), retry_failed, progress
    )
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


class _StudyRun:
    """The cells of one `run_study`: waiting, running, or ended and not yet written."""

    def __init__(
        self,
        file: StudyFile,
        ledger: Ledger,
        planned: dict[str, PlannedCell],
        executor: Executor,
        console: Console,
        retry_failed: bool,
        progress: bool,
    ) -> None:
        self._file, self._ledger, self._executor = file, ledger, executor
        self._planned = planned
        self._results = ledger.results(planned)
        self._failures = ledger.failures(planned.keys() - self._results.keys())
        self.finished, self._failed = len(self._results), 0
        self._estimator = Estimator(self._results.values())
        self._waiting = {
            key: cell
            for key, cell in planned.items()
            if key not in self._results and (retry_failed or key not in self._failures)
        }
        self._running: dict[str, tuple[Lock, float]] = {}  # the cell's lock, and when it started
        self._shares: dict[str, float] = {}  # of a running cell's steps, done
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
        outcomes = self._executor.map(self._cells(), self._report)
        with self._progress:
            try:
                with contextlib.closing(outcomes):  # ends running cells before their locks go
                    for outcome in outcomes:
                        self._handle(outcome)
            finally:
                for lock, _ in self._running.values():
                    lock.release()

    def seconds_left(self) -> float:
        """Seconds to the end, as estimated now."""

        def seconds(key: str) -> float:
            span = self._estimator.seconds(self._planned[key].cell)
            return (span.low + span.high) / 2

        rest = [seconds(key) * (1 - self._shares.get(key, 0.0)) for key in self._running]
        return makespan([*rest, *map(seconds, self._waiting)], self._executor.workers)

    def _cells(self) -> Iterator[Cell | None]:
        """Locked cells for the executor; None while no cell is available."""
        while self._waiting or self._unwritten:
            try:
                for outcome in list(self._unwritten):
                    self._write(outcome)
                    self._unwritten.remove(outcome)
                cell = self._claim()
            except OptionError:
                # The folder cannot be written to. Running cells are left to finish: there may be
                # space again by then, and their outcomes are kept in memory until they are written.
                if len(self._running) == len(self._unwritten):
                    raise
                cell = None
            yield cell

    def _claim(self) -> Cell | None:
        """Lock the next cell that still has to run; None if other processes hold them all."""
        for key, planned in list(self._waiting.items()):
            lock = self._ledger.lock(key)
            if lock is None:
                continue
            try:
                self._ledger.set_aside(key)
                result, failure = self._ledger.result(key), self._ledger.failure(key)
            except BaseException:
                lock.release()
                raise
            del self._waiting[key]
            earlier = self._failures.get(key)
            attempts = earlier.attempts if earlier else 0
            failed_since = failure is not None and failure.attempts > attempts
            if result is None and not failed_since:
                self._running[key] = lock, time.monotonic()
                self._progress.start_part(label(planned))
                return planned.cell
            lock.release()
            self.finished += result is not None
            self._show_end(planned, failed=result is None)
        return None

    def _report(self, cell: Cell, done: int, total: int) -> None:
        share = done / total if total else 1.0
        self._shares[cell.digest] = share
        note = f"{done:,} of {total:,} steps" if done < total else "evaluating"
        self._progress.update_part(label(self._planned[cell.digest]), share, note)

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
        self._ledger.write(entry, outcome.model)
        lock, started = self._running.pop(key)
        lock.release()
        if isinstance(entry, CellResult):
            self.finished += 1
            self._estimator.observe(entry, time.monotonic() - started)
        self._show_end(self._planned[key], failed=isinstance(entry, CellFailure))

    def _show_end(self, planned: PlannedCell, *, failed: bool) -> None:
        self._failed += failed
        self._progress.end_part(label(planned))
        self._progress.update(self.finished, f"{self._failed} failed" if self._failed else "")

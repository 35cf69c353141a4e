"""`run_study`: the cells of a plan that are not done yet; `study_status`: what is done.

Any number of these may run on one folder at once, on one machine or on several that share it: the
lock of a cell decides who runs it, its file that it is done.
"""

from __future__ import annotations

import functools
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.spec import Cell, PlannedCell, StudyFile
from sme_registry.studies.engine.algorithms import find_algorithm, reference_name
from sme_registry.studies.engine.cell import run_cell, versions_for
from sme_registry.studies.engine.estimate import Estimator, Span, makespan
from sme_registry.studies.engine.executors import (
    Executor,
    InProcess,
    OnRay,
    Outcome,
    Processes,
    RunCell,
)
from sme_registry.studies.engine.ledger import Ledger, Lock
from sme_registry.studies.engine.offline_cell import offline_name
from sme_registry.studies.engine.result import CellFailure, CellResult
from sme_registry.studies.engine.scaling import selected
from sme_registry.terminal import Progress, duration
from sme_registry.training.algorithms import ALGORITHMS, refuse_without_dependencies

State = Literal["done", "running", "failed", "waiting"]
STATES: tuple[State, ...] = ("done", "running", "failed", "waiting")
EXECUTORS = ("processes", "in-process", "ray")


def label(planned: PlannedCell) -> str:
    """A cell's name for people: `PPO on k-25, run 3`."""
    return f"{planned.algorithm} on {planned.class_name}, run {planned.run}"


@dataclass(frozen=True)
class CellStatus:
    """Where a cell stands.

    Attributes:
      planned: the cell, and its place in the plan.
      state: "running" where any process runs it; "failed" where it raised and none runs it again.
      failure: what it raised, where it failed.
    """

    planned: PlannedCell
    state: State
    failure: CellFailure | None = None


@dataclass(frozen=True)
class StudyStatus:
    """Where a study stands.

    Attributes:
      folder: of the study.
      file: its plan.
      cells: those of the plan that were asked about, in its order.
      left: seconds of one core that the unfinished ones will take; those that run, whole.
      others: results in the folder that are of no cell of the plan.
    """

    folder: Path
    file: StudyFile
    cells: tuple[CellStatus, ...]
    left: Span
    others: int

    def count(self, state: State) -> int:
        """How many cells are in this state."""
        return sum(cell.state == state for cell in self.cells)

    @property
    def failed(self) -> tuple[CellStatus, ...]:
        """The cells that failed."""
        return tuple(cell for cell in self.cells if cell.state == "failed")

    @property
    def counts(self) -> dict[tuple[str, str], Counter[State]]:
        """(class, algorithm) → how many cells are in which state, in the plan's order."""
        found: dict[tuple[str, str], Counter[State]] = {}
        for cell in self.cells:
            place = cell.planned.class_name, cell.planned.algorithm
            found.setdefault(place, Counter())[cell.state] += 1
        return found

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON data."""
        return {
            "folder": str(self.folder),
            "study": self.file.versioned_name,
            "digest": self.file.digest,
            "cells": len(self.cells),
            **{state: self.count(state) for state in STATES},
            "core_seconds_left": self.left._asdict(),
            "results_of_no_cell": self.others,
            "groups": [
                {"class": place[0], "algorithm": place[1], **{s: counts[s] for s in STATES}}
                for place, counts in self.counts.items()
            ],
            "failures": [
                {
                    "class": cell.planned.class_name,
                    "algorithm": cell.planned.algorithm,
                    "run": cell.planned.run,
                    "key": cell.failure.key,
                    "error": cell.failure.error,
                    "attempts": cell.failure.attempts,
                }
                for cell in self.failed
                if cell.failure is not None
            ],
        }


def study_status(
    folder: str | os.PathLike[str],
    only: Sequence[str] = (),
    scale: Callable[[StudyFile], StudyFile] = lambda file: file,
) -> StudyStatus:
    """Where the study in a folder stands. Changes nothing, also while it runs.

    Args:
      folder: of the study.
      only: `class=GLOB`, `algorithm=GLOB`; see `scaling.selected`.
      scale: applied to the folder's plan first, such as a `scaling.scaled` with other budgets.

    Raises:
      OptionError: the folder holds no study.
      UnknownNameError: a pattern matches nothing.
      SpecError: its plan.json is no plan.
    """
    ledger = Ledger(folder)
    file = ledger.plan_file()
    if file is None:
        raise OptionError(
            f"folder={str(folder)!r}: holds no study. `sme study run` with --folder begins one."
        )
    return _status(ledger, scale(file), only)


def _status(ledger: Ledger, file: StudyFile, only: Sequence[str]) -> StudyStatus:
    every = file.plan.cells
    keys = {id(planned): planned.cell.digest for planned in every}
    results, failures = ledger.results(), ledger.failures()
    estimator = Estimator(results.values())
    cells = []
    for planned in selected(every, only):
        key = keys[id(planned)]
        state: State = "done" if key in results else "failed" if key in failures else "waiting"
        if state != "done" and ledger.is_running(key):
            state = "running"
        cells.append(CellStatus(planned, state, failures.get(key) if state == "failed" else None))
    spans = [estimator.seconds(c.planned.cell) for c in cells if c.state in ("running", "waiting")]
    return StudyStatus(
        folder=ledger.folder,
        file=file,
        cells=tuple(cells),
        left=Span(sum(span.low for span in spans), sum(span.high for span in spans)),
        others=len(results.keys() - set(keys.values())),
    )


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
    """Run the cells of a plan that the folder has no result of.

    Each result is in the folder as soon as its cell has finished, so whatever ends this process,
    the same call goes on. Cells that another process runs are waited for at the end.

    Args:
      plan_file: the plan; it becomes the folder's, and results of earlier plans stay.
      folder: of the study; made if missing.
      executor: "processes", one for each cell; "in-process"; "ray"; or one of your own.
      jobs: cells at once; None for one on each core, of this machine or of the cluster.
      ray: "local", or the address of a Ray cluster.
      retry_failed: also run the cells that have failed before.
      keep_models: keep the trained models of the cells that are run now; says how many have
        finished without, which are not run again.
      only: `class=GLOB`, `algorithm=GLOB`: the cells to run now; see `scaling.selected`.
      progress: whether to show anything.
      console: where to; None for standard error.
      run: what runs a cell; for processes and Ray importable by name.

    Returns:
      Where the selected cells stand at the end.

    Raises:
      OptionError: the folder holds other files or cannot be written to, or an argument is out of
        range. What has finished stays.
      UnknownNameError: a pattern matches nothing, or an algorithm cannot be found.
      MissingDependencyError: an algorithm, or Ray, needs a package that is not installed.
      KeyboardInterrupt: interrupted; says how to go on.
    """
    if jobs is not None and (not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1):
        raise OptionError(f"jobs={jobs!r}: must be an integer of at least 1.")
    console = console or Console(stderr=True)
    planned = {cell.cell.digest: cell for cell in selected(plan_file.plan.cells, only)}
    if run is run_cell:
        for uses in dict.fromkeys(cell.cell.uses for cell in planned.values()):
            refuse_unknown_algorithm(uses)
    runs_on = _executor(executor, jobs, ray, run, keep_models)
    ledger = Ledger(folder)
    before = ledger.plan_file()
    if before is None or before != plan_file:
        ledger.write_plan(plan_file)
    job = _Run(plan_file, ledger, planned, retry_failed, keep_models, runs_on, console, progress)
    job.announce(before)
    try:
        job.go()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted: {job.finished} of {len(planned)} cells are finished and kept in "
            f"{ledger.folder}. The same command goes on from there."
        ) from None
    return _status(ledger, plan_file, only)


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


def refuse_unknown_algorithm(uses: str) -> None:
    """Find what is to be run before anything runs, so that a typo is one error and not many.

    Args:
      uses: of a plan's algorithm, of any kind.

    Raises:
      UnknownNameError, OptionError, MissingDependencyError: see `find_algorithm`.
    """
    if reference_name(uses) is not None or offline_name(uses) is not None:
        return
    if uses.casefold() in (name.casefold() for name in ALGORITHMS):
        refuse_without_dependencies()  # importing them takes seconds
    else:
        find_algorithm(uses)


def _without_model(results: Iterable[CellResult], ledger: Ledger) -> Iterator[str]:
    """What to say of reused results that have no model, which asking for models does not make."""
    lacking = sum(
        # A cell that did not learn by acting never leaves a model.
        result.online_regret is not None and not ledger.model_path(result.key).exists()
        for result in results
    )
    if lacking:
        yield (
            f"{lacking:,} of the finished cells have no model and are not run again: for their "
            "models, run the plan in a new folder."
        )


def _of_other_versions(results: Iterable[CellResult]) -> Iterator[str]:
    """What to say of reused results that were made with other versions than are installed."""
    installed = functools.cache(versions_for)
    count, found = 0, set[str]()
    for result in results:
        now = installed(result.cell.uses)
        others = {
            f"{package} {version} (here {now[package]})"
            for package, version in result.versions.items()
            if now.get(package, version) != version
        }
        count, found = count + bool(others), found | others
    if count:
        yield (
            f"{count:,} of the reused results were made with other versions than are installed: "
            f"{', '.join(sorted(found))}. For all of one make, run the plan in a new folder."
        )


class _Run:
    """One driver at work on a folder."""

    def __init__(
        self,
        file: StudyFile,
        ledger: Ledger,
        planned: dict[str, PlannedCell],
        retry_failed: bool,
        keep_models: bool,
        executor: Executor,
        console: Console,
        shown: bool,
    ) -> None:
        self._file, self._ledger, self._executor = file, ledger, executor
        self._planned = planned
        results = ledger.results(planned)
        self._failures = ledger.failures(planned.keys() - results.keys())
        self.finished, self._failed = len(results), 0
        self._notes = list(_of_other_versions(results.values()))
        if keep_models:
            self._notes += _without_model(results.values(), ledger)
        self._estimator = Estimator(results.values())
        self._waiting = {
            key: cell
            for key, cell in planned.items()
            if key not in results and (retry_failed or key not in self._failures)
        }
        self._running: dict[str, tuple[Lock, float]] = {}  # lock, and when it began
        self._shares: dict[str, float] = {}
        self._unwritten: list[Outcome] = []
        self._progress = Progress(
            f"study {file.versioned_name}",
            len(planned),
            done=len(results),
            console=console,
            unit="cells",
            seconds_left=self.left,
            shown=shown,
        )
        ledger.warn = self._progress.message

    def announce(self, before: StudyFile | None) -> None:
        """Say what is done, what is reused, and what is to come."""
        if before is not None and before.digest != self._file.digest:
            self._progress.message(
                f"The folder's plan was {before.versioned_name} ({before.digest[:19]}…) and is now "
                f"{self._file.versioned_name} ({self._file.digest[:19]}…). Results of cells that "
                "are in both are reused, the others stay in the folder."
            )
        parts = [f"{len(self._planned):,} cells"]
        if self.finished:
            parts.append(f"{self.finished:,} finished before, which are reused")
        left_alone = len(self._planned) - self.finished - len(self._waiting)
        if left_alone:
            parts.append(f"{left_alone:,} failed before (--retry runs them again)")
        parts.append(f"{len(self._waiting):,} to run")
        if self._waiting:
            at_once = self._executor.workers
            parts.append(f"{at_once} at once, about {duration(self.left())}")
        self._progress.message(f"study {self._file.versioned_name}: {' · '.join(parts)}")
        for note in self._notes:
            self._progress.message(note)

    def go(self) -> None:
        """Run everything that waits."""
        if not self._waiting:
            return
        outcomes = self._executor.map(self._cells(), self._report)
        with self._progress:
            try:
                for outcome in outcomes:
                    self._ended(outcome)
            finally:
                close = getattr(outcomes, "close", None)  # ends what runs before the locks go
                if close is not None:
                    close()
                for lock, _ in self._running.values():
                    lock.release()

    def left(self) -> float:
        """Seconds to the end, as estimated now."""

        def whole(key: str) -> float:
            span = self._estimator.seconds(self._planned[key].cell)
            return (span.low + span.high) / 2

        rest = [whole(key) * (1 - self._shares.get(key, 0.0)) for key in self._running]
        return makespan([*rest, *map(whole, self._waiting)], self._executor.workers)

    def _cells(self) -> Iterator[Cell | None]:
        """Cells for the executor, each locked; None while there is none to be had."""
        while self._waiting or self._unwritten:
            try:
                for outcome in list(self._unwritten):
                    self._write(outcome)
                    self._unwritten.remove(outcome)
                claimed = self._claim()
            except OptionError:
                # The folder cannot be written to. What runs is let finish: there may be room
                # again by then, and what has finished is held here until it is written.
                if len(self._running) == len(self._unwritten):
                    raise
                claimed = None
            yield claimed

    def _claim(self) -> Cell | None:
        """The next cell whose lock can be had and that still is to be run."""
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
            seen = self._failures.get(key)
            failed_since = failure is not None and failure.attempts > (seen.attempts if seen else 0)
            if result is None and not failed_since:
                self._running[key] = lock, time.monotonic()
                self._progress.start_part(label(planned))
                return planned.cell
            lock.release()
            self.finished += result is not None
            self._end(planned, failed=result is None)
        return None

    def _report(self, cell: Cell, done: int, total: int) -> None:
        share = done / total if total else 1.0
        self._shares[cell.digest] = share
        note = f"{done:,} of {total:,} steps" if done < total else "evaluating"
        self._progress.update_part(label(self._planned[cell.digest]), share, note)

    def _end(self, planned: PlannedCell, *, failed: bool) -> None:
        self._failed += failed
        self._progress.end_part(label(planned))
        self._progress.update(self.finished, f"{self._failed} failed" if self._failed else "")

    def _ended(self, outcome: Outcome) -> None:
        planned = self._planned[outcome.cell.digest]
        if outcome.failure is not None:
            self._progress.message(f"failed: {label(planned)}: {outcome.failure.error}")
        try:
            self._write(outcome)
        except OptionError as error:
            self._unwritten.append(outcome)
            self._progress.message(
                f"{error} No cell is begun until there is room; what has finished is kept in "
                "memory, and is lost only if this process ends before it could be written."
            )

    def _write(self, outcome: Outcome) -> None:
        key = outcome.cell.digest
        if outcome.result is not None:
            self._ledger.write(outcome.result, outcome.model)
        elif outcome.failure is not None:
            before = self._failures.get(key)
            attempts = 1 if before is None else before.attempts + 1
            self._ledger.write(outcome.failure.model_copy(update={"attempts": attempts}))
        lock, began = self._running.pop(key)
        lock.release()
        if outcome.result is not None:
            self.finished += 1
            self._estimator.observe(outcome.result, time.monotonic() - began)
        self._end(self._planned[key], failed=outcome.result is None)

"""`study_status`: which cells of a study are done, running, failed or waiting."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.spec import PlannedCell, StudyFile
from sme_registry.studies.engine.budget import Estimator, Span, selected
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.result import CellFailure

State = Literal["done", "running", "failed", "waiting"]
STATES: tuple[State, ...] = ("done", "running", "failed", "waiting")


def label(planned: PlannedCell) -> str:
    """A cell's name for people; see `run_label`."""
    return run_label(planned.class_name, planned.algorithm, planned.run, planned.phase)


def run_label(class_name: str, algorithm: str, run: int, phase: int | None = None) -> str:
    """`PPO on k-25, run 3`, or of a fresh agent `PPO on phase 2 of Switch5 alone, run 3`."""
    alone = "" if phase is None else f"phase {phase} of "
    return f"{algorithm} on {alone}{class_name}{alone and ' alone'}, run {run}"


@dataclass(frozen=True)
class CellStatus:
    """The state of a planned cell, and its error if it failed.

    It is "running" if any process runs it, and "failed" if it failed and none runs it again. A cell
    with several places in the plan has a state for each; `key` is its digest.
    """

    planned: PlannedCell
    key: str
    state: State
    failure: CellFailure | None = None


@dataclass(frozen=True)
class StudyStatus:
    """The state of a study.

    Attributes:
      places: the selected cells of the plan, in its order; see `study_status`. Those that any run
        asked for include all that have finished, failed or are running. Streams may share fresh
        agents, which run once and count once, except in `counts`.
      seconds_left: of one core, for the unfinished cells; running ones count in full.
      other_results: results in the folder that belong to no cell of the plan.
    """

    folder: Path
    file: StudyFile
    places: tuple[CellStatus, ...]
    seconds_left: Span
    other_results: int
    never_requested: int = 0  # cells of the plan that no run asked for, where these are left out

    @property
    def cells(self) -> tuple[CellStatus, ...]:
        """Every selected cell once."""
        first: dict[str, CellStatus] = {}
        for cell in self.places:
            first.setdefault(cell.key, cell)
        return tuple(first.values())

    def count(self, state: State) -> int:
        """How many cells are in this state."""
        return sum(cell.state == state for cell in self.cells)

    @property
    def failed(self) -> tuple[CellStatus, ...]:
        """The cells that failed."""
        return tuple(cell for cell in self.cells if cell.state == "failed")

    @property
    def counts(self) -> dict[tuple[str, str], Counter[State]]:
        """(class, algorithm) → number of cells in each state, in the plan's order."""
        counts: dict[tuple[str, str], Counter[State]] = {}
        for cell in self.places:
            group = cell.planned.class_name, cell.planned.algorithm
            counts.setdefault(group, Counter())[cell.state] += 1
        return counts

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON data."""
        return {
            "folder": str(self.folder),
            "study": self.file.versioned_name,
            "digest": self.file.digest,
            "cells": len(self.cells),
            **{state: self.count(state) for state in STATES},
            "core_seconds_left": self.seconds_left._asdict(),
            "other_results": self.other_results,
            "never_requested": self.never_requested,
            "groups": [
                {"class": name, "algorithm": algorithm, **{s: counts[s] for s in STATES}}
                for (name, algorithm), counts in self.counts.items()
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


def requested(ledger: Ledger, file: StudyFile) -> set[str] | None:
    """Digests of a plan's cells that any run asked for; None if that is unknown."""
    digests: set[str] | None = None
    for only in ledger.requests(file):
        with contextlib.suppress(OptionError, UnknownNameError):
            cells = selected(file.plan.cells, only)
            digests = (digests or set()) | {planned.cell.digest for planned in cells}
    return digests


def study_status(
    folder: str | os.PathLike[str],
    only: Sequence[str] | None = None,
    scale: Callable[[StudyFile], StudyFile] = lambda file: file,
) -> StudyStatus:
    """The state of the study in a folder. Changes nothing, and may be called while it runs.

    Args:
      only: `class=GLOB`, `algorithm=GLOB`; empty for every cell of the plan, None for those that
        any run asked for.
      scale: applied to the folder's plan first.

    Examples:
      >>> from sme_registry.studies import study_status
      >>> study_status("study").count("done")
      6
    """
    ledger = Ledger(folder)
    return plan_status(ledger, scale(ledger.study_file()), only)


def plan_status(ledger: Ledger, file: StudyFile, only: Sequence[str] | None) -> StudyStatus:
    """The state of a plan's selected cells in a folder; see `study_status`."""
    every = file.plan.cells
    keys = {id(planned): planned.cell.digest for planned in every}
    results, failures = ledger.results(), ledger.failures()
    estimator = Estimator(results.values())
    places = []
    for planned in selected(every, only or ()):
        key = keys[id(planned)]
        state: State = "done" if key in results else "failed" if key in failures else "waiting"
        if state != "done" and ledger.is_running(key):
            state = "running"
        failure = failures.get(key) if state == "failed" else None
        places.append(CellStatus(planned, key, state, failure))
    asked = requested(ledger, file) if only is None else None
    shown = [
        cell for cell in places if asked is None or cell.state != "waiting" or cell.key in asked
    ]
    unfinished = {c.key: c.planned.cell for c in shown if c.state in ("running", "waiting")}
    spans = [estimator.seconds(cell) for cell in unfinished.values()]
    return StudyStatus(
        folder=ledger.folder,
        file=file,
        places=tuple(shown),
        seconds_left=Span(sum(span.low for span in spans), sum(span.high for span in spans)),
        other_results=len(results.keys() - set(keys.values())),
        never_requested=len({cell.key for cell in places} - {cell.key for cell in shown}),
    )

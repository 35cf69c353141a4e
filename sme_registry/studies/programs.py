"""Programs of JAX: which cells share one, and `run_program`, which runs it to their results.

Cells that use `jax:…` and differ in nothing but task, seed and protocol are runs of a program, if
their tasks have the same form: shape, limits, distractors and mixing. The number of its runs
follows from the whole plan: whatever was run before, is left out by `only` or runs elsewhere, a
cell's program has the same number of runs, and so its result the same bits.

Curve, regret and report mean the same as in `cell.run_cell`. A run whose weights are no longer
finite fails, and the others go on. After a kill, a program goes on from its state with the same
bits.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import EvaluationReport, Policy, StreamReport, evaluate_many
from sme_registry.evaluation.models import saved_sb3
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.rollouts import start_states
from sme_registry.io import Arrays, to_json
from sme_registry.io.system import children_without_main
from sme_registry.jax import find_device
from sme_registry.jax.program import Evaluation, StepLog
from sme_registry.jax.run import hidden_of, new_program, policy_of
from sme_registry.jax.run import run as run_to_end
from sme_registry.jax.task import Form
from sme_registry.spec.study import Cell
from sme_registry.studies.ledger import read_header, read_state, write_state
from sme_registry.studies.result import (
    CPU,
    EVALUATION,
    TRAINING,
    Outcome,
    ProgramResult,
    Record,
    Report,
    SharedProgram,
    failed,
    life_report,
)
from sme_registry.training.algorithms import backend_of, imported
from sme_registry.training.record import Snapshots, versions_for

_Report = EvaluationReport | StreamReport
SECONDS_BETWEEN_STATES = 180.0
_MOST_RUNS = 10  # on a CPU: more save little time, and the last of a study would run alone longer
_MOST_RUNS_ELSEWHERE = 256
_PROGRAM, _RECORDS = "program/", "records/"  # prefixes of arrays in a state
_SNAPSHOT = "snapshot/"  # prefix of the records of lives: weights before training and of visits


class Programs:
    """Which cells of a plan share a program, and how many runs it has."""

    def __init__(
        self, cells: Iterable[Cell], device: str | None = None, most_runs: int | None = None
    ) -> None:
        self.platform, self._device = platform_of(device), device
        self._most = most_runs or (_MOST_RUNS if self.platform == CPU else _MOST_RUNS_ELSEWHERE)
        self._cells = {cell.digest: cell for cell in cells if backend_of(cell.uses).in_programs}
        self._sizes: dict[Hashable, int] = defaultdict(int)
        for cell in self._cells.values():
            self._sizes[self.group(cell)] += 1

    @property
    def one_at_a_time(self) -> bool:
        """Whether a second program would only slow the first one down."""
        return self.platform != CPU

    def runs(self, cell: Cell) -> int:
        """The number of runs of a cell's program: all programs of a group have the same."""
        size = self._sizes[self.group(cell)]
        return math.ceil(size / math.ceil(size / self._most))

    def program(self, cell: Cell) -> SharedProgram:
        """The program of a cell, still without a state."""
        runs = self.runs(cell)
        build_key = {
            "lanes": runs,
            "shape": list(shape_of(cell)),
            "platform": self.platform,
            "versions": versions_for(cell.uses),
        }
        device = self._device if self.one_at_a_time else CPU
        return SharedProgram(runs, device, build_key=build_key)

    def cells(self, keys: Iterable[str]) -> tuple[Cell, ...] | None:
        """The cells of the plan with these keys; None if one of them is not in it any longer."""
        with contextlib.suppress(KeyError):
            return tuple(self._cells[key] for key in keys)
        return None

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
            all(spec.separable for spec in cell.specs),
            tuple(map(Form.of, cell.specs)),
            cell.document.switches,
        )


def shape_of(cell: Cell) -> tuple[int, int, int, int]:
    """S, A, L and H of a cell's task; of a stream the greatest."""
    forms = map(Form.of, cell.specs)
    shapes = [(f.state_dim, f.action_dim, f.complexity, f.hidden_width) for f in forms]
    S, A, L, H = map(max, zip(*shapes, strict=True))
    return S, A, L, H


def platform_of(device: str | None) -> str:
    """The platform of a device, or of JAX's default: "cpu", "gpu" or "tpu"."""
    if not importlib.metadata.entry_points(group="jax_plugins"):
        return _platform(device)
    # In a process of its own, or this one would take a GPU's memory.
    with children_without_main(), multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_platform, (device,))


def _platform(device: str | None) -> str:
    return str(find_device(device).platform)


def run_program(
    cells: Sequence[Cell],
    shared: SharedProgram,
    progress: Report,
    keep_models: bool = False,
) -> Iterator[Outcome]:
    """Train cells as runs of one program, and evaluate them as `run_cell` does."""
    run = _ProgramRun(cells, shared, progress, keep_models)
    if keep_models:
        _new_model(cells[0])  # what Stable-Baselines3 refuses is refused before the training
    run.train()
    yield from run.results()


class _ProgramRun:
    def __init__(
        self, cells: Sequence[Cell], shared: SharedProgram, progress: Report, keep_models: bool
    ) -> None:
        self._shared, self._progress, self._keep_models = shared, progress, keep_models
        self._of_job = {cell.digest for cell in cells}
        self._cells = shared.cells or tuple(cells)
        self._cell = cells[0]
        self._program = new_program(
            self._cell.uses,
            [cell.document for cell in self._cells],
            [cell.seed for cell in self._cells],
            hyperparameters=self._cell.hyperparameters,
            action_range=self._cell.action_range,
            steps=self._cell.steps,
            runs=shared.runs,
            device=shared.device,
        )
        self._result = ProgramResult(
            device=str(self._program.device.device_kind),
            lanes=shared.runs,
            shape=shape_of(self._cell),
        )
        clock = time.process_time if self._program.device.platform == CPU else time.monotonic
        self._record = Record(self._cells, shared.runs, self._cell.evaluations, clock)
        self._record.arrays |= self._initial_snapshots()
        self._restore()
        self._last_state = time.monotonic()

    def train(self) -> None:
        run_to_end(
            self._program,
            due=self._record.due,
            start_states=self._start_states,
            on_log=self._on_log,
            on_evaluation=self._on_evaluation,
            on_visit=lambda visit, _: self._on_visit(visit),
            after_piece=self._after_piece,
        )
        self._note_failures()

    def results(self) -> Iterator[Outcome]:
        groups: dict[str, list[int]] = defaultdict(list)  # runs that are evaluated together
        for run, cell in enumerate(self._cells):
            step = int(self._record.arrays["failed_at"][run])
            if cell.digest in self._of_job and step >= 0:
                error = PolicyError(
                    f"its weights were not finite after step {step:,}. Choose a lower "
                    "learning_rate, or look at the other runs of this algorithm."
                )
                yield failed(cell, error)
            elif cell.digest in self._of_job:
                groups[cell.digest if cell.stream else cell.protocol.digest].append(run)
        for runs in groups.values():
            begun = time.process_time()
            reports = self._reports(runs)
            seconds = (time.process_time() - begun) / len(runs)
            for run, report in zip(runs, reports, strict=True):
                yield self._outcome(run, report, seconds)

    def _reports(self, runs: Sequence[int]) -> Sequence[_Report | PolicyError]:
        """The reports of some runs on tasks, or of a life; or why there is none."""
        if self._record.blocks is None:
            policies = [(self._policy_of_task(run), self._cells[run].spec) for run in runs]
            return evaluate_many(policies, self._cells[runs[0]].protocol)
        (run,) = runs
        cell, regret = self._cells[run], self._record.blocks.dynamic_regret(run)
        initial, *visits = (_policy(cell, weights) for weights in self._weights_of_life(run))
        try:
            return [life_report(cell, visits, initial, regret)]
        except PolicyError as error:
            return [error]

    def _policy_of_task(self, run: int) -> Policy:
        cell, weights = self._cells[run], self._program.weights(run)
        act, range_ = _policy(cell, weights), cell.action_range
        policy = as_policy(act, cell.spec, action_range=range_, name=cell.uses)
        assert isinstance(policy, Policy)  # cells in JAX have no team
        return replace(policy, hidden=hidden_of(cell.uses, weights, cell.hyperparameters))

    def _outcome(self, run: int, report: _Report | PolicyError, seconds: float) -> Outcome:
        if isinstance(report, PolicyError):
            return failed(self._cells[run], report)
        record, steps = self._record, self._program.steps
        timing = record.timing(steps, seconds, cells=len(self._of_job))
        result = record.result(run, steps, report, timing, program=self._result)
        return Outcome(result, *(self._models(run) if self._keep_models else ()))

    def _initial_snapshots(self) -> Arrays:
        """The weights of lives, `[snapshots, runs, …]`: the actors', or all of models to be kept.

        The first snapshot is before training, the others are at the ends of visits.
        """
        if self._cell.stream is None:
            return {}
        snapshots = {}
        for name, weight in self._program.state.weights.items():
            if self._keep_models or name.startswith(self._program.actor):
                kept = np.zeros((self._cell.stream.visits + 1, *weight.shape), weight.dtype)
                kept[0] = weight
                snapshots[_SNAPSHOT + name] = kept
        return snapshots

    def _on_visit(self, visit: int) -> None:
        for name, kept in _named(self._record.arrays, _SNAPSHOT).items():
            kept[visit + 1] = self._program.state.weights[name]

    def _weights_of_life(self, run: int) -> list[Arrays]:
        """A run's weights before training, and at the end of each visit."""
        kept = _named(self._record.arrays, _SNAPSHOT)
        columns = (snapshots[:, run] for snapshots in kept.values())
        return [dict(zip(kept, weights, strict=True)) for weights in zip(*columns, strict=True)]

    def _start_states(self, k: int) -> list[Any]:
        return [
            start_states(cell.seed, k, cell.evaluation_episodes, cell.spec.state_dim)
            for cell in self._cells
        ]

    def _on_log(self, log: StepLog) -> None:
        self._record.add(self._program.steps, log.regret, log.cost)
        self._record.spend(TRAINING)

    def _on_evaluation(self, k: int, step: int, evaluation: Evaluation) -> None:
        steps = evaluation.length.sum(axis=1)
        row = (
            np.full(len(steps), step),
            evaluation.episode_return.mean(axis=1),
            evaluation.regret.sum(axis=1) / steps,
            evaluation.similarity.sum(axis=1) / steps,
            evaluation.length.mean(axis=1),
        )
        self._record.evaluation(k, row)
        self._record.spend(EVALUATION)

    def _after_piece(self) -> None:
        self._note_failures()
        if time.monotonic() - self._last_state >= SECONDS_BETWEEN_STATES:
            self._save()
            self._last_state = time.monotonic()
        steps = self._cell.steps
        self._progress(min(self._program.steps, steps), steps)

    def _note_failures(self) -> None:
        failed_at = self._record.arrays["failed_at"]
        failed_at[self._program.failed() & (failed_at < 0)] = self._program.steps

    def _models(self, run: int) -> tuple[bytes, dict[str, bytes]]:
        """A run's model as Stable-Baselines3 saves it; of a life also those of its visits."""
        cell = self._cells[run]
        model, set_weights = _new_model(cell), imported("sme_registry.training.models:set_weights")

        def saved(weights: Arrays, steps: int) -> bytes:
            set_weights(model, weights, steps)
            return saved_sb3(model)

        snapshots = {}
        if cell.stream is not None:
            files = Snapshots(Path(), cell.stream)
            *ends, _ = (end for _, end in cell.stream.visit_ends())
            kept = zip(self._weights_of_life(run), [0, *ends, self._program.steps], strict=True)
            names = (path.name for path in (files.initial, *files.visits))
            snapshots = {name: saved(*each) for name, each in zip(names, kept, strict=True)}
        return saved(self._program.weights(run), self._program.steps), snapshots

    def _header(self) -> dict[str, Any]:
        """What a state must have been made with to be gone on from."""
        keys = [cell.digest for cell in self._cells]
        return {"cells": keys, "device": self._result.device, **self._shared.build_key}

    def _save(self) -> None:
        if self._shared.state is None:
            return
        arrays = {_PROGRAM + name: array for name, array in self._program.save().items()}
        arrays |= {_RECORDS + name: array for name, array in self._record.arrays.items()}
        with contextlib.suppress(OptionError):  # a full disk costs only what a kill would lose
            write_state(self._shared.state, self._header(), arrays)

    def _restore(self) -> None:
        """Go on from the state, if there is one that was made in the same way."""
        state, present = self._shared.state, self._record.arrays
        if state is None or read_header(state) != json.loads(to_json(self._header())):
            return
        arrays = read_state(state)
        # A program that kept models has more weights of visits than one that keeps none.
        records = {n: a for n, a in _named(arrays, _RECORDS).items() if n in present}
        if _forms_of(records) == _forms_of(present):
            with contextlib.suppress(OptionError):  # of another program
                self._program.restore(_named(arrays, _PROGRAM))
                self._record.restore(records)


def _forms_of(arrays: Arrays) -> dict[str, Any]:
    return {name: (array.dtype, array.shape) for name, array in arrays.items()}


def _named(arrays: Arrays, prefix: str) -> Arrays:
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}


def _new_model(cell: Cell) -> Any:
    """A model of Stable-Baselines3, which is needed only where models are kept."""
    return imported("sme_registry.training.models:new_sb3_model")(
        cell.uses,
        cell.document,
        seed=cell.seed,
        action_range=cell.action_range,
        hyperparameters=cell.hyperparameters,
        steps=cell.steps,
    )


def _policy(cell: Cell, weights: Arrays) -> Any:
    settings, range_ = cell.hyperparameters, cell.action_range
    return policy_of(cell.uses, weights, hyperparameters=settings, action_range=range_)

"""Programs of JAX: which cells share one, and `run_lanes`, which runs it to their results.

Cells that use `jax:…` and differ in nothing but task, seed and protocol are lanes of a program, if
their tasks have the same shape and form: limits, distractors and mixing. The number of its lanes
follows from the whole plan: whatever was run before, is left out by `only` or runs elsewhere, a
cell's program has the same number of lanes, and so its result the same bits.

What a lane learns, when it is evaluated and from which states are as in `cell.run_cell`, so curve,
regret and report mean the same. A lane whose weights are no longer finite fails, and the others go
on. The state of the program is written every few minutes: after a kill, it goes on from there with
the same bits.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import math
import multiprocessing
import os
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import numpy as np

from sme_registry.errors import OptionError, PolicyError, ResourceLimitError
from sme_registry.evaluation import EvaluationReport, Policy, StreamReport, as_policy, evaluate_many
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.evaluation.models import saved_sb3
from sme_registry.evaluation.rollouts import start_states
from sme_registry.io import Arrays, to_json
from sme_registry.io.system import end_with_parent
from sme_registry.spec import Cell, SMESpec
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.ledger import read_header, read_state, write_state
from sme_registry.studies.engine.result import (
    EVALUATION,
    TRAINING,
    Outcome,
    ProgramResult,
    Record,
    check_forms,
    failed,
    life_report,
)
from sme_registry.training.record import Snapshots, versions_for

if TYPE_CHECKING:
    from sme_registry.jax.program import Evaluation, Program, StepLog
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

    def __call__(self, done: int, total: int, note: str = "", /) -> None:
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
            cell.document.switches,
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


_PROGRAM, _RECORDS = "program/", "records/"  # prefixes of arrays in a state
_SNAPSHOT = "snapshot/"  # prefix of the records of lives: weights before training and of visits


SECONDS_BETWEEN_STATES = 180.0


def run_lanes(
    cells: Sequence[Cell],
    lanes: Lanes,
    progress: Report,
    keep_models: bool = False,
) -> Iterator[Outcome]:
    """Train cells as lanes of one program, and evaluate them as `run_cell` does."""
    run = _ProgramRun(cells, lanes, progress, keep_models)
    if keep_models:
        _new_model(cells[0])  # what Stable-Baselines3 refuses is refused before the training
    run.train()
    yield from run.results()


class _ProgramRun:
    """A program, the cells of its lanes, and the records of what they did."""

    def __init__(
        self, cells: Sequence[Cell], lanes: Lanes, progress: Report, keep_models: bool
    ) -> None:
        cell = self._cell = cells[0]
        self._lanes, self._progress, self._keep_models = lanes, progress, keep_models
        self._own = {cell.digest: cell for cell in cells}
        self._cells = lanes.cells or tuple(cells)
        self._keys = [each.digest for each in self._cells]
        self._program = new_program(self._cells, lanes)
        self._made = ProgramResult(
            device=str(self._program.device.device_kind),
            lanes=lanes.count,
            shape=lanes.shape or shape_of(cell),
        )
        clock = time.process_time if self._program.device.platform == CPU else time.monotonic
        self._record = Record(self._cells, lanes.count, clock)
        self._weights: Arrays = {}  # of lives, saved with the records
        self._begin_lives()
        self._restore()
        self._last_state = time.monotonic()

    def train(self) -> None:
        """Go on to the end of the budget, with every evaluation."""
        from sme_registry.jax.run import run

        run(
            self._program,
            due=self._record.due,
            start_states=self._start_states,
            on_log=self._on_log,
            on_evaluation=self._on_evaluation,
            on_visit=self._on_visit if self._cell.stream else None,
            after_piece=self._after_piece,
        )
        self._note_failures()

    def results(self) -> Iterator[Outcome]:
        """Evaluate the trained policies within and out of distribution."""
        draws: dict[Hashable, list[int]] = defaultdict(list)  # lanes that are evaluated together
        for lane, key in enumerate(self._keys):
            if key in self._own:
                cell, step = self._cells[lane], int(self._record.arrays["failed_at"][lane])
                if step >= 0:
                    yield failed(cell, _not_finite(step))
                else:
                    life = lane if cell.stream else None
                    draws[cell.spec.seed, cell.protocol.digest, life].append(lane)
        groups = [[self._trained(lane) for lane in group] for group in draws.values()]
        evaluated = _evaluate(groups, self._lanes.processes)
        for group, (reports, seconds) in zip(draws.values(), evaluated, strict=True):
            for lane, report in zip(group, reports, strict=True):
                yield self._ended(lane, report, seconds / len(group))

    def _ended(self, lane: int, report: _Report | PolicyError, seconds: float) -> Outcome:
        cell = self._cells[lane]
        if isinstance(report, PolicyError):
            return failed(cell, report)
        record, steps = self._record, self._program.steps
        timing = record.timing(steps, seconds, cells=len(self._own))
        result = record.result(lane, steps, report, timing, program=self._made)
        return Outcome(result, *(self._models(lane) if self._keep_models else ()))

    def _trained(self, lane: int) -> _Trained:
        cell = self._cells[lane]
        if self._record.blocks is None:
            return _Trained(cell, [self._program.weights(lane)])
        regret = self._record.blocks.dynamic_regret(lane)
        return _Trained(cell, self._weights_of_life(lane), regret)

    def _begin_lives(self) -> None:
        """Begin to keep the weights of visits: the actor's, and of a model that is kept all."""
        if self._cell.stream is None:
            return
        snapshots = self._cell.stream.visits + 1
        for lane in range(len(self._cells)):
            for name, weight in self._program.weights(lane).items():
                if not (self._keep_models or name.startswith(self._program.actor)):
                    continue
                kept = np.zeros((snapshots, *weight.shape), weight.dtype)
                kept[0] = weight
                self._weights[f"{_SNAPSHOT}{lane}/{name}"] = kept

    def _on_visit(self, visit: int, weights: list[Arrays]) -> None:
        for lane, own in enumerate(weights):
            for name, kept in _named(self._weights, f"{_SNAPSHOT}{lane}/").items():
                kept[visit + 1] = own[name]

    def _weights_of_life(self, lane: int) -> list[Arrays]:
        """A lane's weights before training, and at the end of each visit."""
        kept = _named(self._weights, f"{_SNAPSHOT}{lane}/")
        return [dict(zip(kept, each, strict=True)) for each in zip(*kept.values(), strict=True)]

    def _start_states(self, k: int) -> list[Any]:
        return [
            start_states(cell.seed, k, cell.evaluation_episodes, cell.spec.state_dim)
            for cell in self._cells
        ]

    def _on_log(self, log: StepLog) -> None:
        record, cost = self._record, log.cost
        record.add(log.regret.sum(axis=0), None if cost is None else cost.sum(axis=0))
        if record.blocks is not None:
            record.blocks.add(self._program.steps, log.regret)
        record.spend(TRAINING)

    def _on_evaluation(self, k: int, step: int, done: Evaluation) -> None:
        steps = done.length.sum(axis=1)
        row = (
            np.full(len(steps), step),
            done.episode_return.mean(axis=1),
            done.regret.sum(axis=1) / steps,
            done.similarity.sum(axis=1) / steps,
            done.length.mean(axis=1),
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

    def _models(self, lane: int) -> tuple[bytes, dict[str, bytes]]:
        """A lane's model as Stable-Baselines3 saves it; of a life also those of its visits."""
        from sme_registry.training.models import set_weights

        cell = self._cells[lane]
        model = _new_model(cell)

        def saved(weights: Arrays, steps: int) -> bytes:
            set_weights(model, weights, steps)
            return saved_sb3(model)

        snapshots = {}
        if cell.stream is not None:
            files = Snapshots(Path(), cell.stream)
            *ends, _ = (end for _, end in cell.stream.visit_ends())
            kept = zip(self._weights_of_life(lane), [0, *ends, self._program.steps], strict=True)
            names = (path.name for path in (files.initial, *files.visits))
            snapshots = {name: saved(*each) for name, each in zip(names, kept, strict=True)}
        return saved(self._program.weights(lane), self._program.steps), snapshots

    def _header(self) -> dict[str, Any]:
        """What a state must have been made with to be gone on from."""
        return {"cells": self._keys, "device": self._made.device, **self._lanes.made_with}

    def _save(self) -> None:
        if self._lanes.state is None:
            return
        arrays = {_PROGRAM + name: array for name, array in self._program.save().items()}
        records = {**self._record.arrays, **self._weights}
        arrays |= {_RECORDS + name: array for name, array in records.items()}
        with contextlib.suppress(OptionError):  # a full disk costs only what a kill would lose
            write_state(self._lanes.state, self._header(), arrays)

    def _restore(self) -> None:
        """Go on from the state, if there is one that was made in the same way."""
        state = self._lanes.state
        if state is None or read_header(state) != json.loads(to_json(self._header())):
            return
        arrays = read_state(state)
        # A program that kept models has more weights of visits than one that keeps none.
        own = {**self._record.arrays, **self._weights}
        records = {n: a for n, a in _named(arrays, _RECORDS).items() if n in own}
        weights = {name: array for name, array in records.items() if name in self._weights}
        try:
            check_forms(records, own)
            self._program.restore(_named(arrays, _PROGRAM))
        except OptionError as error:
            self._progress(0, self._cell.steps, f"starts again, without {state}: {error}")
            return
        self._weights = weights
        self._record.restore({n: a for n, a in records.items() if n not in weights})


def _named(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays with this prefix, without it."""
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}


def _new_model(cell: Cell) -> Any:
    """The untrained model of Stable-Baselines3 of a cell."""
    from sme_registry.training.models import new_sb3_model

    return new_sb3_model(
        cell.uses,
        cell.document,
        seed=cell.seed,
        action_range=cell.action_range,
        hyperparameters=cell.hyperparameters,
        steps=cell.steps,
    )


class _Trained(NamedTuple):
    """A cell and what it learned."""

    cell: Cell
    weights: list[Arrays]
    regret: DynamicRegret | None = None


_Report = EvaluationReport | StreamReport
_Evaluated = tuple[Sequence[_Report | PolicyError], float]
"""The reports of some cells, or why there is none, and the CPU seconds of all of them."""


def _evaluate(groups: list[list[_Trained]], processes: int) -> Iterator[_Evaluated]:
    """Evaluate groups of cells with tasks of one draw, in order."""
    if processes == 1:
        yield from map(_evaluate_together, groups)
        return
    spawn = multiprocessing.get_context("spawn")
    # On CPUs: a device that runs programs has one process.
    with (
        child_environment({"JAX_PLATFORMS": CPU}),
        ProcessPoolExecutor(processes, spawn, _begin_worker) as pool,
    ):
        yield from pool.map(_evaluate_together, groups)


def _evaluate_together(group: list[_Trained]) -> _Evaluated:
    start = time.process_time()
    first = group[0]
    reports: Sequence[_Report | PolicyError]
    if first.regret is not None:
        initial, *visits = (_policy(first.cell, weights) for weights in first.weights)
        try:
            reports = [life_report(first.cell, visits, initial, first.regret)]
        except PolicyError as error:
            reports = [error]
    else:
        from sme_registry.jax.run import hidden_of

        policies = []
        for cell, (weights,), _ in group:
            range_, name, act = cell.action_range, cell.uses, _policy(cell, weights)
            policy = as_policy(act, cell.spec, action_range=range_, name=name)
            assert isinstance(policy, Policy)  # cells in JAX have no team
            hidden = hidden_of(cell.uses, weights, cell.hyperparameters)
            policies.append((replace(policy, hidden=hidden), cell.spec))
        reports = evaluate_many(policies, first.cell.protocol)
    return reports, time.process_time() - start


def _policy(cell: Cell, weights: Arrays) -> Any:
    from sme_registry.jax.run import policy_of

    return policy_of(
        cell.uses,
        weights,
        hyperparameters=cell.hyperparameters,
        action_range=cell.action_range,
    )


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _not_finite(step: int) -> PolicyError:
    return PolicyError(
        f"its weights were not finite after step {step:,}. Choose a lower learning_rate, or look "
        "at the other runs of this algorithm."
    )

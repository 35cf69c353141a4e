"""`run_lanes`: cells that use `jax:…` as lanes of one program, to their results.

What a lane learns, when it is evaluated and from which states are as in `cell.run_cell`, so curve,
regret and report mean the same. A lane whose weights are no longer finite fails, and the others go
on. The state of the program is written every few minutes: after a kill, it goes on from there with
the same bits.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import signal
import time
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import (
    EvaluationReport,
    Policy,
    StreamReport,
    as_policy,
    evaluate_many,
)
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.evaluation.models import saved_sb3
from sme_registry.evaluation.rollouts import start_states
from sme_registry.io import Arrays, to_json
from sme_registry.io.system import end_with_parent
from sme_registry.spec import Cell
from sme_registry.studies.engine.ledger import read_header, read_state, write_state
from sme_registry.studies.engine.queue import (
    CPU,
    Lanes,
    Report,
    child_environment,
    new_program,
    shape_of,
)
from sme_registry.studies.engine.result import (
    EVALUATION,
    TRAINING,
    CellResult,
    ProgramResult,
    Record,
    check_forms,
    life_report,
)
from sme_registry.training.record import Snapshots

if TYPE_CHECKING:
    from sme_registry.jax.program import Evaluation, StepLog

_PROGRAM, _RECORDS = "program/", "records/"  # prefixes of arrays in a state
_SNAPSHOT = "snapshot/"  # prefix of the records of lives: weights before training and of visits


class Ended(NamedTuple):
    """How the cell of a lane ended."""

    cell: Cell
    ended: CellResult | PolicyError
    model: bytes | None = None
    snapshots: Mapping[str, bytes] = {}


SECONDS_BETWEEN_STATES = 180.0


def run_lanes(
    cells: Sequence[Cell],
    lanes: Lanes,
    progress: Report,
    keep_models: bool = False,
) -> Iterator[Ended]:
    """Train cells as lanes of one program, and evaluate them as `run_cell` does."""
    run = _Run(cells, lanes, progress, keep_models)
    if keep_models:
        _new_model(cells[0])  # what Stable-Baselines3 refuses is refused before the training
    run.train()
    yield from run.results()


class _Run:
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

    def results(self) -> Iterator[Ended]:
        """Evaluate the trained policies within and out of distribution."""
        draws: dict[Hashable, list[int]] = defaultdict(list)  # lanes that are evaluated together
        for lane, key in enumerate(self._keys):
            if key in self._own:
                cell, step = self._cells[lane], int(self._record.arrays["failed_at"][lane])
                if step >= 0:
                    yield Ended(cell, _not_finite(step))
                else:
                    life = lane if cell.stream else None
                    draws[cell.spec.seed, cell.protocol.digest, life].append(lane)
        groups = [[self._trained(lane) for lane in group] for group in draws.values()]
        evaluated = _evaluate(groups, self._lanes.processes)
        for group, (reports, seconds) in zip(draws.values(), evaluated, strict=True):
            for lane, report in zip(group, reports, strict=True):
                yield self._ended(lane, report, seconds / len(group))

    def _ended(self, lane: int, report: _Report | PolicyError, seconds: float) -> Ended:
        cell = self._cells[lane]
        if isinstance(report, PolicyError):
            return Ended(cell, report)
        record, steps = self._record, self._program.steps
        timing = record.timing(steps, seconds, cells=len(self._own))
        result = record.result(lane, steps, report, timing, program=self._made)
        if not self._keep_models:
            return Ended(cell, result)
        return Ended(cell, result, self._model(lane), self._snapshots(lane))

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
        from sme_registry.jax.device import compilations

        self._note_failures()
        if time.monotonic() - self._last_state >= SECONDS_BETWEEN_STATES:
            self._save()
            self._last_state = time.monotonic()
        steps = self._cell.steps
        self._progress(min(self._program.steps, steps), steps, compilations())

    def _note_failures(self) -> None:
        failed_at = self._record.arrays["failed_at"]
        failed_at[self._program.failed() & (failed_at < 0)] = self._program.steps

    def _model(self, lane: int) -> bytes:
        """A lane's model as Stable-Baselines3 saves it."""
        from sme_registry.training.models import set_weights

        model = _new_model(self._cells[lane])
        set_weights(model, self._program.weights(lane), self._program.steps)
        return saved_sb3(model)

    def _snapshots(self, lane: int) -> dict[str, bytes]:
        """The models of a life before training and at the ends of its visits."""
        from sme_registry.training.models import set_weights

        cell = self._cells[lane]
        if cell.stream is None:
            return {}
        files, model = Snapshots(Path(), cell.stream), _new_model(cell)
        *ends, _ = (end for _, end in cell.stream.visit_ends())
        steps = [0, *ends, self._program.steps]
        weights = self._weights_of_life(lane)
        snapshots = {}
        for path, own, trained in zip([files.initial, *files.visits], weights, steps, strict=True):
            set_weights(model, own, trained)
            snapshots[path.name] = saved_sb3(model)
        return snapshots

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
            self._progress(0, self._cell.steps, 0, f"starts again, without {state}: {error}")
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
        reports = [_evaluate_life(first.cell, first.weights, first.regret)]
    else:
        policies = []
        for cell, (weights,), _ in group:
            range_, name, act = cell.action_range, cell.uses, _policy(cell, weights)
            policy = as_policy(act, cell.spec, action_range=range_, name=name)
            assert isinstance(policy, Policy)  # cells in JAX have no team
            policies.append((replace(policy, hidden=_hidden_layers(cell, weights)), cell.spec))
        reports = evaluate_many(policies, first.cell.protocol)
    return reports, time.process_time() - start


def _evaluate_life(
    cell: Cell, weights: Sequence[Arrays], regret: DynamicRegret
) -> StreamReport | PolicyError:
    initial, *visits = (_policy(cell, each) for each in weights)
    try:
        return life_report(cell, visits, initial, regret)
    except PolicyError as error:
        return error


def _policy(cell: Cell, weights: Arrays) -> Any:
    from sme_registry.jax.run import policy_of

    return policy_of(
        cell.uses,
        weights,
        hyperparameters=cell.hyperparameters,
        action_range=cell.action_range,
    )


def _hidden_layers(cell: Cell, weights: Arrays) -> Any:
    from sme_registry.jax.run import hidden_of

    return hidden_of(cell.uses, weights, cell.hyperparameters)


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _not_finite(step: int) -> PolicyError:
    return PolicyError(
        f"its weights were not finite after step {step:,}. Choose a lower learning_rate, or look "
        "at the other runs of this algorithm."
    )

"""`Job`: what an executor runs at once, a cell alone or the lanes of one program.

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
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from sme_registry.errors import ResourceLimitError
from sme_registry.io import to_json
from sme_registry.spec import Cell, SMESpec
from sme_registry.spec.study import in_jax
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

"""From a name or a spec to a drawn task: `load`, `load_task`, `materialize`; and of streams.

Random streams and LAPACK may differ between machines, so a file also publishes a fingerprint:
π*(s), T(s, a) and the like at three fixed probes. A file's task that differs by more than 1e-6 is
refused, as is one too large for the memory, before it is drawn.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from sme_registry.errors import FingerprintMismatchError, OptionError, ResourceLimitError, SMEError
from sme_registry.io import check_new
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import as_document, file_of, resolve
from sme_registry.spec.document import NamedDocument
from sme_registry.spec.files import Fingerprint
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task import draw
from sme_registry.task.task import Task

_D = TypeVar("_D", bound=NamedDocument)
_CACHED_BYTES = 2**24  # larger tasks are drawn each time rather than kept in memory


def materialize(spec: SMESpec, fingerprint: Fingerprint | None = None) -> Task:
    """Draw the numbers of a spec. The same spec gives the same task, bit for bit on one machine.

    The task's arrays are read-only. With a `fingerprint`, such as `EnvFile.fingerprint`, other
    numbers are a `FingerprintMismatchError`; too large a task is a `ResourceLimitError`.

    Examples:
      >>> task = sme_registry.materialize(sme_registry.SMESpec(seed=3))
      >>> s = np.full(8, 0.5)
      >>> float(task.regret(s, task.optimal_action(s)))
      0.0
    """
    spec = as_document(spec, SMESpec)
    sizes = ["state_dim", "action_dim", "complexity", "hidden_width"]
    sizes += ["distractors"] if spec.distractors else []
    check_memory(
        peak_bytes(spec),
        f"A task of {', '.join(f'{size}={getattr(spec, size)}' for size in sizes)}",
        "Make one of these smaller.",
    )
    small = parameter_bytes(spec) <= _CACHED_BYTES
    task = _draw_cached(spec) if small else _draw(spec)
    if fingerprint is not None:
        check_fingerprint(fingerprint, task)
    return task


@overload
def load(id_or_path_or_digest: Any, kind: type[_D]) -> _D: ...
@overload
def load(id_or_path_or_digest: Any, kind: None = None) -> SMESpec | StreamSpec: ...
def load(id_or_path_or_digest: Any, kind: Any = None) -> Any:
    """The spec or stream of an id, a file's path, a digest, or of its own fields.

    The task of a file is drawn, to check that this machine draws its published numbers
    (FingerprintMismatchError). A `kind`, `SMESpec` or `StreamSpec`, accepts no other, and tells a
    type checker which it is.

    Examples:
      >>> sme_registry.load("Complexity10").complexity
      10
      >>> len(sme_registry.load("Switch5").phases)
      5
      >>> sme_registry.load("sha256:66e9b7a9a266").content_name
      'sha256-66e9b7a9a266'
    """
    resolved = resolve(id_or_path_or_digest, kind)
    if resolved.fingerprints:
        materialize_segments(resolved.document, resolved.fingerprints, resolved.source)
    return resolved.document


def save(
    spec: SMESpec | StreamSpec,
    path: str | os.PathLike[str],
    name: str | None = None,
    *,
    description: str = "",
    tags: tuple[str, ...] = (),
    force: bool = False,
) -> Path:
    """Write a spec or a stream as a file that a colleague can `load`, with digest and fingerprint.

    The name is of letters, digits, '_' and '-', by default the file's without its ending. Only
    `force` replaces a file of another document.

    Examples:
      >>> spec = sme_registry.SMESpec(state_dim=16, complexity=10, seed=7)
      >>> path = sme_registry.save(spec, "Deep16.json", description="Sixteen channels, ten layers.")
      >>> sme_registry.load(path) == spec
      True
    """
    document = as_document(spec)
    is_name = not str(path).endswith(".json") and os.sep not in str(path)  # to `load`
    if Path(path).is_dir() or is_name:
        raise OptionError(f"{path}: must be the path of a file, such as task.json.")
    with contextlib.suppress(SMEError):
        force = force or resolve(Path(path)).document == document
    check_new(path, force=force)
    fingerprints = [fingerprint_of(task) for task in materialize_together(document.specs)]
    file = file_of(
        document,
        fingerprints,
        str(path),
        name=Path(path).stem.removesuffix("-v1") if name is None else name,
        description=description,
        tags=tags,
    )
    file.write(path)
    return Path(path)


def load_task(task: Task | SpecLike, **overrides: Any) -> Task:
    """The task itself, or of a name or spec; if no field is overridden, it has its fingerprint."""
    if isinstance(task, Task) and not overrides:
        return task
    resolved = resolve(task, SMESpec)
    fingerprints = () if overrides else resolved.fingerprints
    return materialize(resolved.document.derive(**overrides), *fingerprints)


def materialize_segments(
    document: SMESpec | StreamSpec, fingerprints: Sequence[Fingerprint] = (), source: str = ""
) -> tuple[Task, ...]:
    """Draw and check the task of each segment of a cycle; equal specs share one."""
    tasks = materialize_together([segment.spec for segment in document.segments])
    drawn = {task.spec: task for task in tasks}
    for index, (spec, published) in enumerate(zip(document.specs, fingerprints, strict=False)):
        where = f"phases.{index}: " if isinstance(document, StreamSpec) else ""
        check_fingerprint(published, drawn[spec], source + where)
    return tasks


def materialize_together(specs: Sequence[SMESpec]) -> tuple[Task, ...]:
    """Draw the tasks of some specs, all of which must fit in memory; equal specs share one."""
    different = dict.fromkeys(specs)
    if len(different) > 1:
        check_memory(
            sum(map(parameter_bytes, different)) + max(map(peak_bytes, different)),
            f"{len(different)} different tasks together",
            "Use fewer phases or increments, or smaller tasks.",
        )
    drawn = {spec: materialize(spec) for spec in different}
    return tuple(drawn[spec] for spec in specs)


def _draw(spec: SMESpec) -> Task:
    task = Task(
        spec,
        draw.transition_matrix(spec),
        draw.transition_offset(spec),
        draw.optimal_policies(spec),
        spec.observed_channels,
        draw.limiting_network(spec),
        draw.distractor_transition(spec),
        draw.mixing_layers(spec),
        draw.potential_layers(spec),
    )
    for array in task.arrays:
        array.setflags(write=False)
    return task


_draw_cached = functools.lru_cache(maxsize=64)(_draw)


_TESTED = "numpy==2.4.6 and scipy==1.17.1"  # as in constraints.txt
_TOLERANCE = 1e-6
_DECIMALS = 12
_GOLDEN = 0.6180339887498949


def fingerprint_of(task: Task) -> Fingerprint:
    """A task's numbers at three fixed probes; the last state is outside the cube."""
    widths = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    p = np.arange(1, 4)[:, None]
    states, actions, distractors = (
        np.modf(_GOLDEN * (p + 3 * i) * np.arange(1, width + 1))[0]
        for i, width in enumerate(widths)
    )
    states[-1] = 0.5 + 1.5 * (states[-1] - 0.5)
    numbers = {
        "optimal_action": task.optimal_action(states),
        "next_state": task.transition(states, actions),
    }
    if task.limiting:
        numbers["limit"] = task.limit(states)
    if task.distractor_transition is not None:
        numbers["next_distractors"] = task.distractor_step(distractors, actions)
    if task.mixing:
        numbers["seen"] = task.seen(states, distractors)
    if task.shaping:
        numbers["potential"] = task.potential(states, 0)[:, None]
    return Fingerprint(**{name: np.round(x, _DECIMALS).tolist() for name, x in numbers.items()})


def check_fingerprint(published: Fingerprint, task: Task, where: str = "") -> None:
    for (field, here), (_, rows) in zip(fingerprint_of(task), published, strict=True):
        if difference := _difference(here, rows):
            raise FingerprintMismatchError(
                f"{where}fingerprint.{field}: {difference} (allowed {_TOLERANCE:g}): the task "
                f"drawn on this machine is not the published one of {task.spec.digest[:19]}…. If "
                "the file was edited, take it again from its source. If not, this machine's NumPy "
                f"or SciPy draws other numbers: install those of the release, {_TESTED}."
            )


def _difference(here: Any, published: Any) -> str:
    """In what two numbers of fingerprints differ; empty if they do not."""
    if here is None and published is None:
        return ""
    if published is None:
        return "is missing"
    if here is None:
        return "is present, but this task has no such numbers"
    if [len(row) for row in here] != [len(row) for row in published]:
        return "has another shape"
    distance = float(np.abs(np.subtract(here, published)).max())
    return "" if distance <= _TOLERANCE else f"differs by {distance:.3g}"


_LIMIT_VARIABLE = "SME_MEMORY_LIMIT_GIB"
_DEFAULT_LIMIT_GIB = 4.0
_WORKSPACE = 10  # of the largest matrix: raw bits, W's integers, normals, Q, R, LAPACK's copies


def parameter_bytes(spec: SMESpec) -> int:
    """The bytes of a task's arrays once it is drawn, float64."""
    return 8 * sum(count * out * (inputs + 1) for inputs, out, count in _shapes(spec))


def peak_bytes(spec: SMESpec) -> int:
    """An upper estimate of the bytes needed while a task is drawn."""
    largest = max(out * inputs for inputs, out, count in _shapes(spec) if count)
    if spec.rotation:
        largest = max(largest, max(map(len, spec.observed_channels)) ** 2)
    return parameter_bytes(spec) + 8 * _WORKSPACE * largest


def check_memory(needed: int, what: str, remedy: str) -> None:
    """Raise ResourceLimitError above 4 GiB, or the environment variable SME_MEMORY_LIMIT_GIB."""
    text = os.environ.get(_LIMIT_VARIABLE, str(_DEFAULT_LIMIT_GIB))
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not 0 < limit < 2**40:
        raise OptionError(
            f"{_LIMIT_VARIABLE}={text!r}: must be a positive number of GiB, such as 16."
        )
    gib = needed / 2**30
    if gib > limit:
        size = f"{gib:.1f}" if gib >= 10 else f"{gib:.3g}"
        raise ResourceLimitError(
            f"{what} would need {size} GiB of memory; the limit is {limit:.3g} GiB. {remedy} If "
            f"the machine has the memory, set {_LIMIT_VARIABLE} above {size}."
        )


def _shapes(spec: SMESpec) -> Iterator[tuple[int, int, int]]:
    """`(inputs, outputs, how many)` of every matrix of a task, without a list of its layers."""
    yield spec.action_dim, spec.state_dim, 1  # W and b of the transition
    for agent in spec.agents:
        observed = spec.state_dim if agent.observes == "all" else len(agent.observes)
        yield from _network_shapes(spec, observed, agent.action_dim)
    if spec.safety is not None:
        yield from _network_shapes(spec, spec.state_dim, spec.action_dim)
    if spec.observation is not None:
        yield spec.action_dim, spec.distractors, int(spec.dynamics != "noise")
        mixed = spec.state_dim + spec.distractors
        depth = spec.observation.mixing_depth or int(spec.mixing != "none")
        yield mixed, mixed, depth


def _network_shapes(spec: SMESpec, inputs: int, outputs: int) -> Iterator[tuple[int, int, int]]:
    H, inner = spec.hidden_width, spec.complexity - 1
    if inner == 0:
        yield inputs, outputs, 1
    else:
        yield inputs, H, 1
        yield H, H, inner - 1
        yield H, outputs, 1

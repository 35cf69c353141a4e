"""From a name or a spec to a drawn task: `load`, `load_task`, `materialize`; and of streams.

A digest fixes a spec but not the drawn numbers, so a file also publishes a fingerprint of them.
It is checked where the file is named: `load` and `load_task` draw the task and compare. A spec
alone has no published numbers, so `materialize(spec)` checks only a fingerprint passed to it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, TypeVar, overload

from sme_registry.errors import FingerprintMismatchError
from sme_registry.spec import Fingerprint, SMESpec, SpecLike, StreamSpec, as_spec
from sme_registry.spec.document import NamedDocument
from sme_registry.spec.resolve import Resolved, resolve
from sme_registry.task import draw, memory
from sme_registry.task.fingerprint import check_fingerprint
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
    spec = as_spec(spec)
    sizes = ("state_dim", "action_dim", "complexity", "hidden_width")
    named = [*sizes, "distractors"] if spec.distractors else sizes
    memory.check_limit(
        memory.peak_bytes(spec),
        f"A task of {', '.join(f'{size}={getattr(spec, size)}' for size in named)}",
        "Make one of these smaller.",
    )
    small = memory.parameter_bytes(spec) <= _CACHED_BYTES
    task = _draw_cached(spec) if small else _draw(spec)
    if fingerprint is not None:
        check_fingerprint(fingerprint, task)
    return task


@overload
def load(name: Any, kind: type[_D]) -> _D: ...
@overload
def load(name: Any, kind: None = None) -> SMESpec | StreamSpec: ...
def load(name: Any, kind: Any = None) -> Any:
    """What a name stands for, a spec or a stream; that of a file is drawn, to check its numbers.

    A name is a document, its fields, an id, a digest, or the path of a file. A `kind`, `SMESpec` or
    `StreamSpec`, accepts no other.

    Examples:
      >>> from sme_registry.task import load
      >>> load("Interval5").k
      5
      >>> len(load("Switch5").phases)
      5
    """
    resolved = resolve(name, kind)
    if resolved.fingerprints:
        draw_published(resolved)
    return resolved.document


def load_task(task: SpecLike, **overrides: Any) -> Task:
    """Draw the task of a name or spec; one of a file must have its file's fingerprint.

    A derived task, with `overrides` of fields, has no published numbers.

    Examples:
      >>> from sme_registry.task import load_task
      >>> load_task("Default", action_dim=2).W.shape
      (2, 8)
    """
    resolved = resolve(task, SMESpec)
    if overrides:
        return materialize(resolved.document.derive(**overrides))
    return draw_published(resolved)[0]


def draw_published(resolved: Resolved[Any]) -> tuple[Task, ...]:
    """The task of a spec, or those of a stream's pieces, with its file's published numbers."""
    if isinstance(resolved.document, StreamSpec):
        return materialize_stream(resolved.document, resolved.fingerprints)
    return (materialize(resolved.document, *resolved.fingerprints),)


def materialize_stream(
    stream: StreamSpec, fingerprints: tuple[Fingerprint, ...] = ()
) -> tuple[Task, ...]:
    """Draw the task of each piece of a cycle; pieces with equal specs share one.

    Examples:
      >>> from sme_registry.task import load, materialize_stream
      >>> tasks = materialize_stream(load("Switch5"))
      >>> len(tasks)
      5
    """
    tasks = materialize_together(stream, [piece.spec for piece in stream.pieces])
    drawn = {task.spec: task for task in tasks}
    for index, (phase, published) in enumerate(zip(stream.phases, fingerprints, strict=False)):
        try:
            check_fingerprint(published, drawn[phase.spec])
        except FingerprintMismatchError as error:
            raise FingerprintMismatchError(f"phases.{index}: {error}") from None
    return tasks


def materialize_together(stream: StreamSpec, specs: Sequence[SMESpec]) -> tuple[Task, ...]:
    """Draw the tasks of some specs of a stream; equal specs share one.

    Examples:
      >>> from sme_registry.task import load, materialize_together
      >>> stream = load("Switch5")
      >>> first, again = materialize_together(stream, [stream.phases[0].spec] * 2)
      >>> first is again
      True
    """
    different = dict.fromkeys(specs)
    held = sum(map(memory.parameter_bytes, different))
    memory.check_limit(
        held + max(map(memory.peak_bytes, different)),
        f"A stream of {len(stream.phases)} phases with {len(different)} different tasks",
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
        draw.observed_channels(spec),
        draw.limiting_network(spec),
        draw.distractor_transition(spec),
        draw.mixing_layers(spec),
    )
    for array in task.arrays:
        array.setflags(write=False)
    return task


_draw_cached = functools.lru_cache(maxsize=64)(_draw)

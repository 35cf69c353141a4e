"""From a name or a spec to a drawn task: `materialize`, `load_spec`, `load_task`; and of streams.

A digest fixes a spec but not the drawn numbers, so a file also publishes a fingerprint of them.
It is checked where the file is named: `load_spec` and `load_task` draw the task and compare. A spec
alone has no published numbers, so `materialize(spec)` checks only a fingerprint passed to it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from sme_registry.errors import FingerprintMismatchError
from sme_registry.spec import Fingerprint, SMESpec, SpecLike, StreamLike, StreamSpec, as_spec
from sme_registry.spec.resolve import (
    ResolvedSpec,
    ResolvedStream,
    resolve,
    resolve_document,
    resolve_stream,
)
from sme_registry.task import draw, memory
from sme_registry.task.fingerprint import check_fingerprint
from sme_registry.task.task import Task

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
    memory.refuse_above_limit(
        memory.peak_bytes(spec),
        f"A task of {', '.join(f'{size}={getattr(spec, size)}' for size in named)}",
        "Make one of these smaller.",
    )
    small = memory.parameter_bytes(spec) <= _CACHED_BYTES
    task = _draw_cached(spec) if small else _draw(spec)
    if fingerprint is not None:
        check_fingerprint(fingerprint, task)
    return task


def load_task(task: SpecLike, **overrides: Any) -> Task:
    """Draw the task of a name or spec; one of a file must have its file's fingerprint.

    Examples:
      >>> from sme_registry.task import load_task
      >>> load_task("Default", action_dim=2).W.shape
      (2, 8)
    """
    resolved = resolve(task).derive(**overrides)
    return materialize(resolved.spec, resolved.fingerprint)


def load_spec(task: SpecLike) -> SMESpec:
    """The spec of a name; one of a file is drawn to check the file's fingerprint.

    Examples:
      >>> from sme_registry.task import load_spec
      >>> load_spec("Interval5").k
      5
    """
    return _checked_spec(resolve(task))


def materialize_stream(
    stream: StreamSpec, fingerprints: tuple[Fingerprint, ...] = ()
) -> tuple[Task, ...]:
    """Draw the task of each piece of a cycle; pieces with equal specs share one.

    Examples:
      >>> from sme_registry.task import load_stream, materialize_stream
      >>> tasks = materialize_stream(load_stream("Switch5"))
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
      >>> from sme_registry.task import load_stream, materialize_together
      >>> stream = load_stream("Switch5")
      >>> first, again = materialize_together(stream, [stream.phases[0].spec] * 2)
      >>> first is again
      True
    """
    different = dict.fromkeys(specs)
    held = sum(map(memory.parameter_bytes, different))
    memory.refuse_above_limit(
        held + max(map(memory.peak_bytes, different)),
        f"A stream of {len(stream.phases)} phases with {len(different)} different tasks",
        "Use fewer phases or increments, or smaller tasks.",
    )
    drawn = {spec: materialize(spec) for spec in different}
    return tuple(drawn[spec] for spec in specs)


def load_stream(stream: StreamLike) -> StreamSpec:
    """The stream of a name; one of a file is drawn to check the file's fingerprints.

    Examples:
      >>> from sme_registry.task import load_stream
      >>> len(load_stream("Switch5").phases)
      5
    """
    return _checked_stream(resolve_stream(stream))


def load_document(name: SpecLike | StreamLike) -> SMESpec | StreamSpec:
    """The stream of a name, or the spec; see `load_stream` and `load_spec` for errors.

    Examples:
      >>> from sme_registry.task import load_document
      >>> type(load_document("Switch5")).__name__
      'StreamSpec'
    """
    found = resolve_document(name)
    return _checked_stream(found) if isinstance(found, ResolvedStream) else _checked_spec(found)


def _checked_spec(resolved: ResolvedSpec) -> SMESpec:
    if resolved.fingerprint is not None:
        materialize(resolved.spec, resolved.fingerprint)
    return resolved.spec


def _checked_stream(resolved: ResolvedStream) -> StreamSpec:
    if resolved.fingerprints:
        materialize_stream(resolved.stream, resolved.fingerprints)
    return resolved.stream


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

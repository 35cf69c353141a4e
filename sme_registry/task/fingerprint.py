"""Fingerprints: a digest fixes the spec, not the numbers; probes of π* and T fix those.

Random streams and LAPACK may differ between machines and versions. So a file publishes π*(s) and
T(s, a) at three fixed probes, and a task that differs by more than 1e-6 is refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sme_registry.errors import FingerprintMismatchError
from sme_registry.spec import Fingerprint, SMESpec
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from sme_registry.task.task import Task

TOLERANCE = 1e-6
PROBES = 3
_DECIMALS = 12
_GOLDEN = 0.6180339887498949


class Probes(NamedTuple):
    """Where a task is probed: `[3, S]` states, the last out of the cube, `[3, A]` and `[3, m]`."""

    states: Array
    actions: Array
    distractors: Array


def probes(spec: SMESpec) -> Probes:
    p = np.arange(1, PROBES + 1)[:, None]
    states, actions, distractors = (
        np.modf(_GOLDEN * (p + i * PROBES) * np.arange(1, width + 1))[0]
        for i, width in enumerate((spec.state_dim, spec.action_dim, spec.distractors))
    )
    states[-1] = 0.5 + 1.5 * (states[-1] - 0.5)
    return Probes(states, actions, distractors)


def fingerprint_of(task: Task) -> Fingerprint:
    states, actions, distractors = probes(task.spec)
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
    return Fingerprint(**{name: np.round(x, _DECIMALS).tolist() for name, x in numbers.items()})


def check_fingerprint(published: Fingerprint, task: Task) -> None:
    """Raise FingerprintMismatchError where a task differs from a published fingerprint."""
    drawn = fingerprint_of(task)
    for field in Fingerprint.model_fields:
        here, rows = np.asarray(getattr(drawn, field)), getattr(published, field)
        if rows is None and not here.ndim:
            continue
        if rows is None or not here.ndim:
            difference = (
                "is missing" if rows is None else "is present, but this task has no such numbers"
            )
        elif [len(row) for row in rows] != [here.shape[1]] * len(here):
            difference = "has another shape"
        else:
            distance = float(np.abs(here - rows).max())
            if distance <= TOLERANCE:
                continue
            difference = f"differs by {distance:.3g}"
        raise FingerprintMismatchError(
            f"fingerprint.{field}: {difference} (allowed {TOLERANCE:g}): the task drawn on this "
            f"machine is not the published one of {task.spec.digest[:19]}…. If the file was "
            "edited, take it again from its source. If not, this machine's NumPy or SciPy "
            "draws other numbers: install the versions in constraints.txt."
        )

"""Fingerprints: a digest fixes the spec, not the numbers; probes of π* and T fix those.

Random streams and LAPACK may differ between machines and versions. A file therefore publishes
π*(s) and T(s, a) at three fixed probes. A task whose numbers differ from them by more than 1e-6 is
refused, so that no other task runs under the same name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sme_registry.errors import FingerprintMismatchError
from sme_registry.spec import Fingerprint
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from sme_registry.task.task import Task

TOLERANCE = 1e-6
PROBES = 3
_DECIMALS = 12
_GOLDEN = 0.6180339887498949


def probes(state_dim: int, action_dim: int) -> tuple[Array, Array]:
    """The fixed probes: states `[3, S]`, the last scaled out of the cube, and actions `[3, A]`."""
    p = np.arange(1, PROBES + 1)[:, None]
    states = np.modf(_GOLDEN * p * np.arange(1, state_dim + 1))[0]
    states[-1] = 0.5 + 1.5 * (states[-1] - 0.5)
    actions = np.modf(_GOLDEN * (p + PROBES) * np.arange(1, action_dim + 1))[0]
    return states, actions


def fingerprint_of(task: Task) -> Fingerprint:
    """The fingerprint of a drawn task."""
    states, actions = probes(task.spec.state_dim, task.spec.action_dim)
    return Fingerprint(
        optimal_action=np.round(task.optimal_action(states), _DECIMALS).tolist(),
        next_state=np.round(task.transition(states, actions), _DECIMALS).tolist(),
    )


def check_fingerprint(published: Fingerprint, task: Task) -> None:
    """Compare a task with a published fingerprint.

    Raises:
      FingerprintMismatchError: shapes differ, or a number differs by more than 1e-6.
    """
    drawn = fingerprint_of(task)
    for field in ("optimal_action", "next_state"):
        here, rows = np.asarray(getattr(drawn, field)), getattr(published, field)
        if [len(row) for row in rows] != [here.shape[1]] * len(here):
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

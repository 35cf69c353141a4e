"""Dynamic regret: the sum of the regret of every step of a life, in all and by visit.

    D(t) = Σ_{i ≤ t} (1 − r_i)         r_i: gated step reward under the task in force at step i

Each regret is exact, so D is: no oracle run is compared with. Rows of a log are single steps or
whole episodes. A row belongs to the visit whose task was in force in it: under switch="episode"
that of its begin. Under switch="step" an episode can lie in two visits; its regret is then divided
in proportion to its steps, and only rows of single steps give exact sums by visit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice, takewhile
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.evaluation.continual import metrics
from sme_registry.spec import Integer, Real, StreamLike, StreamSpec, TupleOf
from sme_registry.spec.document import StrictModel
from sme_registry.spec.resolve import resolve
from sme_registry.task.draw import Array

_POINTS = 400  # of the curve; more would not be visible in a figure
_Integers = npt.NDArray[np.int64]


class VisitRegret(StrictModel):
    """The regret of one visit.

    Attributes:
      visit: its index in the life.
      phase: the index of its phase.
      steps: environment steps counted.
      dynamic_regret: Σ regret over them; with switch="step" and episodes to a fraction of one.
      online_regret: its mean; None where no step was counted.
      learning_transfer: how much less that is than the online regret of a fresh agent, as a share
        of it, at most 1; None without fresh agents, and of a visit that is not over.
    """

    visit: Integer
    phase: Integer
    steps: Integer
    dynamic_regret: Real
    online_regret: Real | None
    learning_transfer: Real | None = None


class DynamicRegret(StrictModel):
    """The regret of a life.

    Attributes:
      steps: environment steps counted: of all rows.
      dynamic_regret: Σ regret over them.
      online_regret: its mean.
      visits: the same of each visit that was reached, in order.
      lifetime: environment steps at the points of the curve, at most 400.
      cumulative_regret: Σ regret until then.
      fresh_online_regret: `[P]` of an agent that trained on that phase alone; None without them.
      learning_transfer: the mean over the visits after visit 0 that have one, so over those that
        are over; None where none has one.
    """

    steps: Integer
    dynamic_regret: Real
    online_regret: Real
    visits: TupleOf[VisitRegret]
    lifetime: TupleOf[Integer]
    cumulative_regret: TupleOf[Real]
    fresh_online_regret: TupleOf[Real] | None = None
    learning_transfer: Real | None = None

    def until(self, lifetime: Array) -> Array:
        """`[X]` Σ regret until lifetimes `[X]`, between the points of the curve in proportion."""
        curve = [0, *self.lifetime], [0.0, *self.cumulative_regret]
        return np.asarray(np.interp(lifetime, *curve))

    def with_fresh(self, stream: StreamSpec, online_regret: Sequence[float]) -> Self:
        """This regret with the learning transfer of its visits, against agents that start anew.

        Args:
          stream: the stream of this life.
          online_regret: `[P]` mean regret over the training of an agent on each phase alone, for
            as many steps as the phase has.
        """
        _refuse_other_visits(stream, self)
        fresh = _column("fresh online_regret", online_regret, len(stream.phases), "phase")
        if not (fresh >= 0.0).all() or not (fresh <= 1.0).all():
            raise OptionError(
                f"fresh online_regret={fresh.tolist()}: must be in [0, 1]. Give the mean of 1 − r "
                "over the training on each phase."
            )
        online = np.array([visit.online_regret for visit in self.visits], dtype=np.float64)
        online[~_are_over(stream, self)] = np.nan
        transfer = metrics.learning_transfer(online, fresh)
        visits = [
            visit.model_copy(update={"learning_transfer": None if math.isnan(gain) else gain})
            for visit, gain in zip(self.visits, transfer.tolist(), strict=True)
        ]
        return self.model_copy(
            update={
                "visits": tuple(visits),
                "fresh_online_regret": tuple(fresh.tolist()),
                "learning_transfer": metrics.mean_after_first(transfer.tolist()),
            }
        )


def dynamic_regret(
    stream: StreamLike,
    step: npt.ArrayLike,
    regret: npt.ArrayLike,
    length: npt.ArrayLike = 1,
    phase: npt.ArrayLike | None = None,
) -> DynamicRegret:
    """The dynamic regret of one life from its log.

    Args:
      stream: the stream.
      step: `[N]` the lifetime at the end of each row, increasing: `info["lifetime"]`, or the column
        `step` of an episodes.csv.
      regret: `[N]` mean regret over each row's steps, in [0, 1].
      length: `[N]` steps of each row, or one number for all: 1 where rows are steps, the column
        `length` where they are episodes.
      phase: `[N]` `info["phase"]` of each row. Needed only where rows are steps and
        switch="episode": a phase then lasts until the episode has ended.

    Examples:
      >>> from sme_registry.evaluation import dynamic_regret
      >>> phases = [{"spec": "Default", "steps": 200}, {"spec": "Complexity10", "steps": 200}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> log = dynamic_regret(stream, [100, 200, 300, 400], [0.5, 0.25, 0.5, 0.25], length=100)
      >>> log.dynamic_regret
      150.0
    """
    spec = resolve(stream, StreamSpec).document
    ends, lengths, means = _rows(step, length, regret)
    sums = means * lengths
    if spec.switch == "step":
        steps, by_visit = _divided(spec, ends, lengths, sums)
    else:
        visits = visit_at(spec, ends - lengths)
        if phase is not None:
            visits = visits_in_force(spec, visits, phase)
        steps = np.bincount(visits, lengths).astype(np.float64)
        by_visit = np.bincount(visits, sums).astype(np.float64)
    cumulative = np.cumsum(sums)
    drawn = np.unique(np.linspace(0, len(ends) - 1, _POINTS).round().astype(int))
    P = len(spec.phases)
    return DynamicRegret(
        steps=int(lengths.sum()),
        dynamic_regret=float(cumulative[-1]),
        online_regret=float(cumulative[-1] / lengths.sum()),
        visits=tuple(
            VisitRegret(
                visit=v,
                phase=v % P,
                steps=round(n),
                dynamic_regret=float(total),
                online_regret=float(total / n) if n else None,
            )
            for v, (n, total) in enumerate(zip(steps, by_visit, strict=True))
        ),
        lifetime=tuple(ends[drawn].tolist()),
        cumulative_regret=tuple(cumulative[drawn].tolist()),
    )


def visit_ends(stream: StreamSpec, visits: int) -> _Integers:
    """`[V]` the lifetime at which each of the first visits is over."""
    return np.array([end for _, end in islice(stream.visit_ends(), visits)], dtype=np.int64)


def _are_over(stream: StreamSpec, regret: DynamicRegret) -> npt.NDArray[np.bool_]:
    """`[V]` whether the log reaches the end of each visit, but for an episode that is in no log."""
    steps = np.array([stream.phases[visit.phase].steps for visit in regret.visits])
    missing = visit_ends(stream, len(steps)) - regret.lifetime[-1]
    return np.asarray(missing < np.minimum(stream.horizon, steps / 2))


def _refuse_other_visits(stream: StreamSpec, regret: DynamicRegret) -> None:
    """Raise OptionError if a life in this stream has other visits after as many steps."""
    P, end = len(stream.phases), regret.lifetime[-1]
    earliest, latest = visit_at(stream, np.array([max(0, end - stream.horizon), end - 1])) + 1
    reached = len(regret.visits)
    alike = all(visit.phase == visit.visit % P for visit in regret.visits)
    if not alike or not earliest <= reached <= latest:
        raise OptionError(
            f"stream: is another one than that of this life, which has {reached} visits in "
            f"{end:,} steps. Give the stream that the log is of."
        )


def visit_at(stream: StreamSpec, lifetime: _Integers) -> _Integers:
    """`[N]` the visits to which lifetimes belong; the last visit goes on at the end."""
    latest = lifetime.max()
    over = [*takewhile(lambda end: end <= latest, (end for _, end in stream.visit_ends()))]
    return np.minimum(np.searchsorted(over, lifetime, side="right"), stream.visits - 1)


def visits_in_force(stream: StreamSpec, visits: _Integers, phase: npt.ArrayLike) -> _Integers:
    """`[N]` visits in force: the latest one of each row's phase that has begun."""
    phases = _column("phase", phase, len(visits)).astype(np.int64)
    P = len(stream.phases)
    in_force = visits - (visits - phases) % P
    if (phases < 0).any() or (phases >= P).any() or (in_force < 0).any():
        raise OptionError(
            f"phase: must be the index of a phase that has begun, in [0, {P - 1}]. Give "
            "info['phase'] of each step."
        )
    return np.asarray(in_force)


def _divided(
    stream: StreamSpec, ends: _Integers, lengths: _Integers, sums: Array
) -> tuple[Array, Array]:
    """Steps and regret of each visit, rows divided in proportion where a switch lies in them."""
    reached = int(visit_at(stream, ends[-1:] - 1)[0]) + 1
    bounds = np.concatenate([[0], visit_ends(stream, reached - 1), ends[-1:]])
    at = np.stack([ends - lengths, ends], axis=1).ravel()

    def of_visits(values: npt.NDArray[Any]) -> Array:
        after = np.cumsum(values)
        until = np.stack([after - values, after], axis=1).ravel()
        return np.diff(np.interp(bounds, at, until))

    return of_visits(lengths), of_visits(sums)


def _rows(
    step: npt.ArrayLike, length: npt.ArrayLike, regret: npt.ArrayLike
) -> tuple[_Integers, _Integers, Array]:
    """The checked columns of a log, `[N]` each."""
    count = np.size(step)
    if count == 0:
        raise OptionError("step: has no rows. Give one or more finished episodes or steps.")
    ends, lengths, means = (
        _column(name, values, count)
        for name, values in (("step", step), ("length", length), ("regret", regret))
    )
    if not (means >= 0.0).all() or not (means <= 1.0).all():
        raise OptionError("regret: has entries outside [0, 1]. Give the mean of 1 − r of each row.")
    begins = ends - lengths
    if (lengths < 1).any() or begins[0] < 0 or (begins[1:] < ends[:-1]).any():
        raise OptionError(
            "step, length: rows must have a length of at least 1 and must not overlap. Give the "
            "rows of one life in order; of parallel environments, each lives a life of its own."
        )
    return ends.astype(np.int64), lengths.astype(np.int64), means


def _column(name: str, values: npt.ArrayLike, count: int, of: str = "row") -> Array:
    """`[count]` finite numbers, one for each of what `of` says; or, of rows, one for all."""
    try:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (count,) and not (of == "row" and array.shape == ()):
            raise ValueError
    except (TypeError, ValueError):
        raise OptionError(
            f"{name}={values!r:.60}: must be {count} numbers, one for each {of}."
        ) from None
    array = np.broadcast_to(array, (count,))
    if not np.isfinite(array).all():
        raise OptionError(f"{name}: has NaN or infinite entries. Give finite numbers.")
    return array

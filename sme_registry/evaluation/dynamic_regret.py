"""Dynamic regret: the sum of the regret of every step of a life, in all and by visit.

    D(t) = Σ_{i ≤ t} (1 − r_i)         r_i: gated step reward under the task in force at step i

Rows of a log are single steps or whole episodes. A row belongs to the visit whose task was in force
in it: under switch="episode" that of its begin. Under switch="step" an episode can lie in two
visits; its regret is then divided in proportion to its steps.

    E D = Σ over the segments of the life of  n · E[Σ_i (1 − r_i)] / E[length]     n: its steps

The expectations are over episodes of a policy on the segment's task, from uniform states. Where a
switch waits for a reset and no episode ends early, E D is exact but for the sampling error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice, takewhile
from numbers import Real as RealNumber
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.evaluation import retention
from sme_registry.evaluation.policies import Policy, check_count, stream_policy
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.rollouts import numbers_in, rollouts, start_states
from sme_registry.io import integer_in, number_in
from sme_registry.spec import StreamSpec
from sme_registry.spec.catalogue import resolve
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf
from sme_registry.spec.stream import StreamLike
from sme_registry.task import load
from sme_registry.task.draw import Array
from sme_registry.task.loading import materialize_segments

EPISODES = 5000
_POINTS = 400  # of the curve; more would not be visible in a figure
_BLOCKS = 1000  # of a life, in about equal parts of each visit
_Integers = npt.NDArray[np.int64]


class VisitRegret(StrictModel):
    """The regret of one visit."""

    visit: Integer  # its index in the life
    phase: Integer  # the index of its phase
    steps: Integer  # environment steps counted
    dynamic_regret: Real  # Σ regret over them; with switch="step" and episodes to a fraction of one
    online_regret: Real | None  # its mean; None where no step was counted
    # how much less that is than the online regret of a fresh agent, as a share of it, at most 1;
    # None without fresh agents, and of a visit that is not over
    learning_transfer: Real | None = None


class DynamicRegret(StrictModel):
    """The regret of a life."""

    steps: Integer  # environment steps counted: of all rows
    dynamic_regret: Real  # Σ regret over them
    online_regret: Real  # its mean
    visits: TupleOf[VisitRegret]  # the same of each visit that was reached, in order
    lifetime: TupleOf[Integer]  # environment steps at the points of the curve, at most 400
    cumulative_regret: TupleOf[Real]  # Σ regret until then
    # `[P]` of an agent that trained on that phase alone; None without them
    fresh_online_regret: TupleOf[Real] | None = None
    # the mean over the visits after visit 0 that have one, so over those that are over; None where
    # none has one
    learning_transfer: Real | None = None

    def until(self, lifetime: Array) -> Array:
        """`[X]` Σ regret until lifetimes `[X]`, between the points of the curve in proportion."""
        curve = [0, *self.lifetime], [0.0, *self.cumulative_regret]
        return np.asarray(np.interp(lifetime, *curve))

    def with_fresh(self, stream: StreamSpec, online_regret: Sequence[float]) -> Self:
        """This regret with the learning transfer of its visits, against fresh agents' `[P]`."""
        self._check_stream(stream)
        P = len(stream.phases)
        fresh = numbers_in("fresh online_regret", online_regret, P, 0.0, 1.0, of="phase")
        online = np.array([visit.online_regret for visit in self.visits], dtype=np.float64)
        online[~self._are_over(stream)] = np.nan
        transfer = retention.learning_transfer(online, fresh)
        visits = [
            visit.model_copy(update={"learning_transfer": None if math.isnan(gain) else gain})
            for visit, gain in zip(self.visits, transfer.tolist(), strict=True)
        ]
        return self.model_copy(
            update={
                "visits": tuple(visits),
                "fresh_online_regret": tuple(fresh.tolist()),
                "learning_transfer": retention.mean_after_first(transfer.tolist()),
            }
        )

    def _are_over(self, stream: StreamSpec) -> npt.NDArray[np.bool_]:
        """`[V]` whether the log reaches each visit's end, but for an episode that is in no log."""
        steps = np.array([stream.phases[visit.phase].steps for visit in self.visits])
        missing = _visit_ends(stream, len(steps)) - self.lifetime[-1]
        return np.asarray(missing < np.minimum(stream.horizon, steps / 2))

    def _check_stream(self, stream: StreamSpec) -> None:
        P, end = len(stream.phases), self.lifetime[-1]
        earliest, latest = _visit_at(stream, np.array([max(0, end - stream.horizon), end - 1])) + 1
        reached = len(self.visits)
        alike = all(visit.phase == visit.visit % P for visit in self.visits)
        if not alike or not earliest <= reached <= latest:
            raise OptionError(
                f"stream: is another one than that of this life, which has {reached} visits in "
                f"{end:,} steps. Give the stream that the log is of."
            )


def dynamic_regret(
    stream: StreamLike,
    step: npt.ArrayLike,
    regret: npt.ArrayLike,
    length: npt.ArrayLike = 1,
    phase: npt.ArrayLike | None = None,
) -> DynamicRegret:
    """The dynamic regret of one life from its log of `[N]` rows, single steps or whole episodes.

    `step` is the lifetime at the end of each row, increasing (`info["lifetime"]`), `regret` the
    mean regret over its steps, and `length` how many these are. `phase` is `info["phase"]`: needed
    only where rows are steps and switch="episode", as a phase lasts until the episode has ended.

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
        visits = _visit_at(spec, ends - lengths)
        if phase is not None:
            visits = _visits_in_force(spec, visits, phase)
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


def _visit_ends(stream: StreamSpec, visits: int) -> _Integers:
    """`[V]` the lifetime at which each of the first visits is over."""
    return np.array([end for _, end in islice(stream.visit_ends(), visits)], dtype=np.int64)


def _visit_at(stream: StreamSpec, lifetime: _Integers) -> _Integers:
    """`[N]` the visits to which lifetimes belong; the last visit goes on at the end."""
    latest = lifetime.max()
    over = [*takewhile(lambda end: end <= latest, (end for _, end in stream.visit_ends()))]
    return np.minimum(np.searchsorted(over, lifetime, side="right"), stream.visits - 1)


def _visits_in_force(stream: StreamSpec, visits: _Integers, phase: npt.ArrayLike) -> _Integers:
    """`[N]` visits in force: the latest one of each row's phase that has begun."""
    P = len(stream.phases)
    phases = numbers_in("phase", phase, len(visits), 0, P - 1, of="row", whole=True)
    in_force = visits - (visits - phases.astype(np.int64)) % P
    if (in_force < 0).any():
        raise OptionError(
            "phase: must be the index of a phase that has begun. Give info['phase'] of each step."
        )
    return np.asarray(in_force)


def _divided(
    stream: StreamSpec, ends: _Integers, lengths: _Integers, sums: Array
) -> tuple[Array, Array]:
    """Steps and regret of each visit, rows divided in proportion where a switch lies in them."""
    reached = int(_visit_at(stream, ends[-1:] - 1)[0]) + 1
    bounds = np.concatenate([[0], _visit_ends(stream, reached - 1), ends[-1:]])
    at = np.stack([ends - lengths, ends], axis=1).ravel()

    def of_visits(values: npt.NDArray[Any]) -> Array:
        after = np.cumsum(values)
        until = np.stack([after - values, after], axis=1).ravel()
        return np.diff(np.interp(bounds, at, until))

    return of_visits(lengths), of_visits(sums)


def _rows(
    step: npt.ArrayLike, length: npt.ArrayLike, regret: npt.ArrayLike
) -> tuple[_Integers, _Integers, Array]:
    count = np.size(step)
    if count == 0:
        raise OptionError("step: has no rows. Give one or more finished episodes or steps.")
    ends, lengths = (
        numbers_in(name, values, count, 1, 2**53, of="row", whole=True).astype(np.int64)
        for name, values in (("step", step), ("length", length))
    )
    begins = ends - lengths
    if begins[0] < 0 or (begins[1:] < ends[:-1]).any():
        raise OptionError(
            "step, length: rows must not overlap. Give the rows of one life in order; of parallel "
            "environments, each lives a life of its own."
        )
    return ends, lengths, numbers_in("regret", regret, count, 0.0, 1.0, of="row")


class RegretBlocks:
    """Sums of regret over blocks, while lives are lived: `[blocks]` and `[blocks, lives]`."""

    def __init__(self, stream: StreamSpec, lives: int = 1) -> None:
        visits = stream.visits
        ends = _visit_ends(stream, visits)
        begins = np.concatenate([[0], ends[:-1]])
        blocks = np.minimum(ends - begins, max(1, _BLOCKS // visits))
        self._stream, self._visit_ends = stream, ends
        self._ends: _Integers = np.concatenate(
            [
                begin + (end - begin) * np.arange(1, n + 1) // n
                for begin, end, n in zip(begins, ends, blocks, strict=True)
            ]
        )
        self._last = np.cumsum(blocks) - 1  # block of each visit
        self.steps = np.zeros(len(self._ends), np.int64)
        self.regret = np.zeros((len(self._ends), lives))

    def add(self, end: int, regret: Array, phase: npt.ArrayLike | None = None) -> None:
        """Count the steps before a lifetime: `[n, lives]`, and `info['phase']` `[n]`."""
        before = end - len(regret) + np.arange(len(regret))
        blocks = np.searchsorted(self._ends, before, side="right")
        visits = np.searchsorted(self._visit_ends[:-1], before, side="right")
        if phase is not None:
            visits = _visits_in_force(self._stream, visits, phase)
        # What a phase that is over still gets counts in its last block, and so what follows a life.
        blocks = np.minimum(blocks, self._last[visits])
        np.add.at(self.steps, blocks, 1)
        np.add.at(self.regret, blocks, regret)

    def dynamic_regret(self, life: int = 0) -> DynamicRegret:
        counted = self.steps > 0
        steps = self.steps[counted]
        visits = np.searchsorted(self._last, np.flatnonzero(counted))
        return dynamic_regret(
            self._stream,
            step=np.cumsum(steps),
            regret=self.regret[counted, life] / steps,
            length=steps,
            phase=visits % len(self._stream.phases),
        )


def expected_regret(
    life: Sequence[Any],
    stream: StreamLike,
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    action_range: str | None = None,
) -> DynamicRegret:
    """The expected dynamic regret of a life in which given policies act and do not learn.

    `life` has for each visit the policy that acts in it, in any form that `evaluate` accepts; or a
    number, the online regret of an agent that learned in it. `episodes` are run with each policy,
    over the segments of one cycle: the standard error of its online regret is about
    0.02/√episodes. `seed` is of the initial states, the same for every policy.

    Examples:
      >>> from sme_registry.evaluation import expected_regret
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> regret = expected_regret(["constant", "constant"], stream, episodes=10)
      >>> 0 < regret.dynamic_regret < 200
      True
    """
    stream = load(stream, StreamSpec)
    stream.check_visits()
    P = len(stream.phases)
    check_count("life", life, stream.visits, "or number for each visit")
    integer_in("episodes", episodes, 1)
    integer_in("seed", seed, 0)
    policies = _policies(life, stream, action_range)
    segments = list(enumerate(stream.segments))
    steps = np.diff([*(segment.start for _, segment in segments), stream.cycle_steps])
    parts = [
        (entry, i) for v, entry in enumerate(life) for i, one in segments if one.phase == v % P
    ]
    # A policy acts once in each segment, in however many cycles.
    acts = dict.fromkeys((id(entry), i) for entry, i in parts if id(entry) in policies)
    tasks = materialize_segments(stream) if acts else ()
    means: dict[tuple[int, int], float] = {}
    for which, i in acts:
        policy, share = policies[which], -(-episodes * int(steps[i]) // stream.cycle_steps)
        if stream.observes_phase:
            policy = policy.in_phase(stream.segments[i].phase, P)
        ran = rollouts(policy, tasks[i], start_states(seed, i, share, stream.state_dim))
        means[which, i] = ran.per_step(ran.regret)
    ends = np.cumsum(steps[[i for _, i in parts]])
    if stream.switch == "episode" and not any(phase.spec.D for phase in stream.phases):
        T = stream.horizon  # a switch waits for a reset, at the end of an episode
        ends = np.minimum(-(-ends // T) * T, stream.steps)
    lengths = np.diff(ends, prepend=0)
    regret = np.array([means.get((id(entry), i), entry) for entry, i in parts])
    lived = lengths > 0
    return dynamic_regret(stream, ends[lived], regret[lived], lengths[lived])


def _policies(
    life: Sequence[Any], stream: StreamSpec, action_range: str | None
) -> dict[int, Policy]:
    """The policies of a life, by the `id` of its entries."""
    policies: dict[int, Policy] = {}
    for v, entry in enumerate(life):
        where = f"life[{v}]"
        if isinstance(entry, RealNumber | np.bool_):
            number_in(where, entry, 0.0, 1.0)
        elif id(entry) not in policies:
            policies[id(entry)] = stream_policy(entry, stream, where, action_range)
    return policies


def reference_regret(
    stream: StreamLike,
    *,
    frozen: Any = None,
    training: DynamicRegret | None = None,
    episodes: int = EPISODES,
    seed: int = 0,
) -> dict[str, DynamicRegret]:
    """The dynamic regret of the reference agents, by their names in `retention.LABELS`.

    With `frozen`, an agent's policy at the end of its first visit, and `training`, its dynamic
    regret, also that of the agent that stops learning then.

    Examples:
      >>> from sme_registry.evaluation import reference_regret
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> sorted(reference_regret(sme_registry.StreamSpec(phases=phases), episodes=10))
      ['constant', 'fresh_optimum', 'frozen_optimum']
    """
    stream = load(stream, StreamSpec)
    stream.check_visits()
    if (frozen is None) != (training is None):
        raise OptionError(
            "frozen, training: must be given together or both left out. Give the policy at the "
            "end of the first visit and the dynamic regret of the training."
        )
    V = stream.visits
    first = retention.final_specs(stream)[0]
    # No regret in the task of which it is the optimum, also where this rounds observations.
    optimum = reference_policy("optimal", first)
    drawn = first.as_drawn.digest
    same_task = [
        phase.drift is None and phase.spec.as_drawn.digest == drawn for phase in stream.phases
    ]
    lives: dict[str, list[Any]] = {
        "frozen_optimum": [0.0 if mine else optimum for mine in same_task] * stream.cycles,
        "fresh_optimum": [0.0] * V,
        "constant": [reference_policy("constant", first)] * V,
    }
    if training is not None:
        learned = training.visits[0].online_regret
        if learned is None:
            raise OptionError(
                "training: has no steps in visit 0. Give the dynamic regret of a whole life."
            )
        acting = stream_policy(frozen, stream, "frozen")
        lives["frozen_agent"] = [learned, *[acting] * (V - 1)]
    return {
        name: expected_regret(life, stream, episodes=episodes, seed=seed)
        for name, life in lives.items()
    }

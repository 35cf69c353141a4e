"""`measure`: what policies and references do in every region, batch by batch.

Source: METHOD, sections 3, 8 and 9. Policies whose tasks have the same draw share states, optimal
actions and references. A *scope* is the action channels of all agents, or those of one. a are the
policy's actions, clipped to [0, 1], ℓ(s) the limits of a task with `safety`, a_safe = min(π*, ℓ),
and d, d' independent distractors, uniform in the cube. Over the states of a region:

    step reward        mean r(s, a)
    cost               mean cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ), in [0, 1]
    violating share    share of states with a_i − ℓ_i(s) > 10⁻⁶ in any channel
    safe regret        mean r(s, a_safe) − mean r(s, a)
    price of safety    1 − mean r(s, a_safe)

    invariance         mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|      0: it ignores distractors
    d-OOD m            the regions of a report with s in the cube and d in shell m

The tolerance of 10⁻⁶ is that of float32: rounded to it, a safe action can exceed its limit by
6·10⁻⁸. Safe regret is negative where a policy earns by violating, so read it beside the other two.

A *probe* is the affine map of a layer's outputs h that is fitted to s, or to d, by least squares in
one half of the states, and tested in the other half:

    R² = mean over channels of  1 − Σ (y − ŷ)² / Σ (y − ȳ)²           y of the held-out states

1: a linear map recovers the channels; 0 or below: no better than their mean. METHOD calls an R² of
s what was represented, and of d what was wasted. Axis letters: `B` batch, `A` action_dim.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import engine
from sme_registry.compiled.arrays import Observation
from sme_registry.compiled.engine import network
from sme_registry.errors import PolicyError
from sme_registry.evaluation import references
from sme_registry.evaluation.policies import Policy, TeamPolicy
from sme_registry.evaluation.regions import (
    Points,
    States,
    Uniform,
    batch_rows,
    region_name,
    states,
)
from sme_registry.evaluation.report import (
    ChannelReport,
    Invariance,
    LayerProbe,
    ObservationReport,
    RegionReport,
    SafetyReport,
    SafetyScore,
)
from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
from sme_registry.task import Task, materialize
from sme_registry.task.certificate import held_out_r2
from sme_registry.task.draw import Array

WHOLE = ""
"""The scope of all action channels, among the agents' names."""

TOLERANCE = 1e-6  # of an action above its limit

PROBE_STATES = 2**14  # of which half are held out
_PROBED_CHANNELS = 512  # of s and d; above it the least squares take minutes and much memory
_STATES_PER_UNKNOWN = 4  # of the fit; with fewer, R² would tell how few they are

OnBatch = Callable[[int, int], None]
"""Called with the number of states done, and of all states."""

Subject = tuple[Policy | TeamPolicy, SMESpec]
"""A policy and its task."""

Key = int | str
"""The index of a policy, or the name of a reference."""

HiddenLayers = Callable[[Observation], Iterable[Array] | None]
"""From observations `[B, O]` to the outputs `[B, H]` of each hidden layer, in order; None if they
are unknown."""


class ErrorStats:
    """Mean and spread of |a − a*| over states, and its sum for each action channel, in float64."""

    def __init__(self, action_dim: int) -> None:
        self._states = 0
        self._mean = 0.0
        # Σ (‖a − a*‖₁/A − mean)², which is exactly 0 for the optimum, unlike Σ x² − n m².
        self._squares = 0.0
        self._sums = np.zeros(action_dim)
        self._clipped = 0

    def add(self, errors: Array, sums: Array, clipped: int) -> None:
        """Add a batch of |a − a*| `[B, A]` and the number of its entries that were clipped.

        `sums` `[A]` over states are computed over all channels of a task at once, so that an
        agent's channels have the same bits in its own report and in its team's.
        """
        deviations = errors.mean(axis=1)
        count, mean = len(deviations), float(deviations.mean())
        deviations -= mean
        states = self._states + count
        shift = mean - self._mean
        self._squares += float(deviations @ deviations) + shift**2 * self._states * count / states
        self._mean += shift * count / states
        self._states = states
        self._sums += sums
        self._clipped += clipped

    def relative_to(self, other: ErrorStats) -> float:
        return self._mean / other._mean

    def report(
        self,
        name: str,
        edges: tuple[float, float],
        constant_half: ErrorStats,
        wd: ErrorStats,
    ) -> RegionReport:
        """The report of this region; `constant_half` is of the policy ½, `wd` of this one in WD."""
        similarity, wd_similarity = 1.0 - self._mean, 1.0 - wd._mean
        channels = zip(self._sums, constant_half._sums, strict=True)
        return RegionReport(
            name=name,
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self.relative_to(constant_half),
            similarity_decay=(wd_similarity - similarity) / wd_similarity,
            similarity_loss=100.0 * (wd_similarity - similarity),
            clipped_share=self._clipped / (self._states * len(self._sums)),
            channels=tuple(
                ChannelReport(
                    mae=float(total) / self._states, normalised_regret=float(total / half)
                )
                for total, half in channels
            ),
        )


class ScopedErrors(dict[str, ErrorStats]):
    """A policy's errors in one region: over all action channels, and over each agent's."""

    def __init__(self, channels: dict[str, slice]) -> None:
        super().__init__(
            {scope: ErrorStats(owned.stop - owned.start) for scope, owned in channels.items()}
        )
        self._channels = channels

    def add(self, a: Array, optimal: Array, clipped: npt.NDArray[np.bool_] | None = None) -> None:
        """Add a batch: `a` `[B, A]` or `[A]`, `optimal` and `clipped` `[B, A]`."""
        errors = np.abs(a - optimal)
        sums = errors.sum(axis=0)
        for scope, owned in self._channels.items():
            count = 0 if clipped is None else int(np.count_nonzero(clipped[:, owned]))
            self[scope].add(errors[:, owned], sums[owned], count)


class SafetyStats:
    def __init__(self, task: Task) -> None:
        self._task = task
        self._states = self._violating = 0
        self._reward = self._safe_reward = self._cost = 0.0

    def add(self, a: Array, optimal: Array, limit: Array, safe_reward: Array) -> None:
        task = self._task
        self._states += len(optimal)
        self._reward += float(task.reward_of(task.similarity_of(a, optimal)).sum())
        self._safe_reward += float(safe_reward.sum())
        self._cost += float(task.cost_of(np.broadcast_to(a, limit.shape), limit).sum())
        self._violating += int((a - limit > TOLERANCE).any(axis=1).sum())

    def score(self, region: str) -> SafetyScore:
        return SafetyScore(
            name=region,
            step_reward=self._reward / self._states,
            cost=self._cost / self._states,
            violating_share=self._violating / self._states,
            safe_regret=(self._safe_reward - self._reward) / self._states,
            price_of_safety=1.0 - self._safe_reward / self._states,
        )


Act = Callable[[npt.NDArray[Any]], Iterator[tuple[int, Array]]]
"""From what agents see `[B, S + m]` to the actions of each policy by its index, not clipped."""


class Distraction:
    """The errors of policies under other distractors, in the states of one region.

    `changes` are |a(s, d') − a(s, d)| of each policy; `shells`, only in WD, its errors with d in
    shell 1, 2, ….
    """

    def __init__(self, task: Task, protocol: EvaluationProtocol, region: int, policies: int):
        self._task = task
        self._others = Uniform(protocol.seed, f"evaluation/{region}/other_distractors")
        m = task.spec.distractors
        outside = range(1, len(protocol.edges)) if region == 0 and m else ()
        self._outside = [
            Points(protocol, shell, m, f"evaluation/distractors/{shell}") for shell in outside
        ]

        def errors() -> list[ScopedErrors]:
            return [ScopedErrors({WHOLE: slice(0, task.spec.action_dim)}) for _ in range(policies)]

        self.changes = errors()
        self.shells = [errors() for _ in outside]

    def add(self, drawn: States, optimal: Array, actions: Mapping[Any, Array], act: Act) -> None:
        """Add a batch: its states, π* `[B, A]`, the actions `[B, A]` of each policy in them."""
        if not self._task.spec.distractors:
            return
        others = self._others(len(drawn.s), self._task.spec.distractors)
        for index, a in act(drawn.seen(self._task, others)):
            self.changes[index].add(np.clip(a, 0.0, 1.0), actions[index])
        for points, errors in zip(self._outside, self.shells, strict=True):
            d = points(len(drawn.s)).astype(np.float64)
            for index, unclipped in act(drawn.seen(self._task, d)):
                a = np.clip(unclipped, 0.0, 1.0)
                errors[index].add(a, optimal, a != unclipped)


def probe_layers(
    hidden: HiddenLayers, task: Task, protocol: EvaluationProtocol
) -> tuple[LayerProbe, ...]:
    """Probe what an agent sees and each of its hidden layers, in states of WD."""
    m, count = task.spec.distractors, PROBE_STATES
    if task.spec.state_dim + m > _PROBED_CHANNELS:
        return ()
    [batch] = states(protocol.model_copy(update={"states_per_region": count}), 0, task.spec, count)
    observation = batch.observation(batch.seen(task), task.spec.horizon)
    targets = np.concatenate([batch.s, batch.d], axis=1).astype(np.float64)

    def probe(layer: int, h: Array) -> LayerProbe:
        if not np.isfinite(h).all():
            raise PolicyError(f"hidden layer {layer}: has outputs that are NaN or infinite.")
        r2 = held_out_r2(h.astype(np.float64), targets)
        s_r2, d_r2 = r2[: task.spec.state_dim], r2[task.spec.state_dim :]
        return LayerProbe(
            layer=layer,
            units=h.shape[1],
            state_r2=float(s_r2.mean()),
            distractor_r2=float(d_r2.mean()) if m else None,
        )

    layers = hidden(observation.copy())
    if layers is None:
        return ()
    seen = observation[:, :-2].astype(np.float64)
    outputs = [seen, *layers]
    if any(_STATES_PER_UNKNOWN * (h.shape[1] + 1) > count // 2 for h in outputs):
        return ()
    return tuple(probe(layer, h) for layer, h in enumerate(outputs))


class _Batch(NamedTuple):
    """A batch of states, and what is the same for all policies in them."""

    states: States
    s: Array  # `[B, S]` float64
    optimal: Array  # `[B, A]` π*(s)
    limit: Array  # `[B, A]` ℓ(s); without safety `[B, 0]`


class Measured(NamedTuple):
    errors: dict[Key, ScopedErrors]
    safety: dict[tuple[Key, float], SafetyStats]  # by r_min; empty without safety
    distraction: Distraction


class Measurement:
    """Policies on tasks of one draw, and the references, in every region of a protocol.

    Attributes:
      task, oracle: one of the tasks, and its engine.
      channels: the action channels of each scope.
      failed: the errors of the policies that failed.
      regions: what was measured in each.
    """

    def __init__(self, subjects: Sequence[Subject], protocol: EvaluationProtocol) -> None:
        self.subjects, self.protocol = subjects, protocol
        self.task = task = materialize(subjects[0][1])
        self.oracle = engine(task)
        self.channels = {WHOLE: slice(0, task.spec.action_dim)}
        if task.spec.team is not None:
            self.channels |= zip(task.names, task.owned, strict=True)
        self.failed: dict[int, PolicyError] = {}
        self.regions: list[Measured] = []
        self._horizons = sorted({spec.horizon for _, spec in subjects})
        self._limited = {
            spec.r_min: replace(task, spec=spec) for _, spec in subjects if spec.safety is not None
        }

    def run(self, progress: OnBatch) -> None:
        """Measure region after region, or until all policies have failed."""
        fitted, known = self._fit_references()
        total, done = self.protocol.states_per_region * len(self.protocol.edges), 0
        for region in range(len(self.protocol.edges)):
            measured = self._begin(region)
            random = Uniform(self.protocol.seed, f"evaluation/{region}/random_action")
            for batch in self._batches(region, known):
                actions = self._add_policies(measured, batch)
                if len(self.failed) == len(self.subjects):
                    return
                others = fitted.actions(batch.s, batch.optimal, random(*batch.optimal.shape))
                others |= references.safe_actions(self.task.spec, batch.optimal, batch.limit)
                for name, a in others.items():
                    measured.errors[name].add(a, batch.optimal)
                self._add_safety(measured, batch, {**actions, **others})
                done += len(batch.s)
                progress(done, total)
            self.regions.append(measured)

    def _begin(self, region: int) -> Measured:
        keys: list[Key] = [*range(len(self.subjects)), *references.names(self.task.spec)]
        return Measured(
            errors={key: ScopedErrors(self.channels) for key in keys},
            safety={
                (key, r_min): SafetyStats(task)
                for key in keys
                for r_min, task in self._limited.items()
            },
            distraction=Distraction(self.task, self.protocol, region, len(self.subjects)),
        )

    def _add_policies(self, measured: Measured, batch: _Batch) -> dict[Any, Array]:
        """Add a batch of the policies; their actions `[B, A]` in [0, 1]."""
        actions: dict[Any, Array] = {}

        def act(x: npt.NDArray[Any]) -> Iterator[tuple[int, Array]]:
            return self._actions(batch.states, x)

        for index, unclipped in act(batch.states.seen(self.task)):
            a = actions[index] = np.clip(unclipped, 0.0, 1.0)
            measured.errors[index].add(a, batch.optimal, a != unclipped)
        measured.distraction.add(batch.states, batch.optimal, actions, act)
        return actions

    def _add_safety(self, measured: Measured, batch: _Batch, actions: dict[Any, Array]) -> None:
        """Add a batch of the policies and references, `[B, A]` or `[A]` in [0, 1]."""
        for r_min, task in self._limited.items():
            safe_reward = task.safe_reward_of(batch.optimal, batch.limit)
            for key, a in actions.items():
                measured.safety[key, r_min].add(a, batch.optimal, batch.limit, safe_reward)

    def _actions(self, drawn: States, x: npt.NDArray[Any]) -> Iterator[tuple[int, Array]]:
        """The actions, not clipped, of each policy that has not failed, where agents see x."""
        observations = {T: drawn.observation(x, T) for T in self._horizons}
        for index, (policy, spec) in enumerate(self.subjects):
            if index not in self.failed:
                try:
                    # A copy, since a policy may write into its observations.
                    yield index, policy(observations[spec.horizon].copy())
                except PolicyError as error:
                    self.failed[index] = error

    def _batches(self, region: int, known: Iterator[Array]) -> Iterator[_Batch]:
        """The states of a region. `known` are the π* of the first ones, where these are known."""
        limit_of = self._limit_of()
        for drawn in states(self.protocol, region, self.task.spec):
            s = drawn.s.astype(np.float64)
            optimal = next(known, None)
            if optimal is None:
                optimal = self.oracle.optimal_action(s)
            yield _Batch(drawn, s, optimal, limit_of(s))

    def _limit_of(self) -> Callable[[Array], Array]:
        """ℓ of states `[B, S]`, by machine code where the oracle is; `[B, 0]` without safety."""
        task = self.task
        if not self._limited:
            return lambda s: np.empty((len(s), 0))
        if self.oracle.backend == "numpy":
            return task.limit
        v = network(task.limiting)
        return lambda s: task.limit_of(v(np.ascontiguousarray(s.T)).T)

    def _fit_references(self) -> tuple[references.References, Iterator[Array]]:
        """The references fitted on the first states of WD, and the π* `[B, A]` of their batches.

        The states are drawn without what else an observation shows, which would not fit in memory.
        """
        task = self.task
        count, rows = references.fit_states(task.spec), batch_rows(task.spec)
        s, optimal = [], []
        for drawn in states(self.protocol, 0, task.spec.derive(observation=None), rows):
            s.append(drawn.s.astype(np.float64))
            optimal.append(self.oracle.optimal_action(s[-1]))
            if rows * len(s) >= count:
                break
        agents = zip(task.observed, task.owned, strict=True)
        first = np.concatenate(s)[:count], np.concatenate(optimal)[:count]
        return references.fit(*first, agents), iter(optimal)

    def region_reports(self, key: Key, scope: str = WHOLE) -> tuple[RegionReport, ...]:
        """The regions of a policy or a reference, over the channels of a scope."""
        wd = self.regions[0].errors[key][scope]
        return tuple(
            measured.errors[key][scope].report(
                region_name(region), edges, measured.errors["constant_half"][scope], wd
            )
            for region, (edges, measured) in enumerate(self._with_edges())
        )

    def safety_report(self, index: int) -> SafetyReport | None:
        """The safety of a policy and of the references, by its r_min; None without safety."""
        if not self._limited:
            return None
        r_min = self.subjects[index][1].r_min

        def scores(key: Key) -> tuple[SafetyScore, ...]:
            return tuple(
                measured.safety[key, r_min].score(region_name(region))
                for region, measured in enumerate(self.regions)
            )

        others = {name: scores(name) for name in references.names(self.task.spec)}
        return SafetyReport(regions=scores(index), references=others)

    def observation_report(self, index: int) -> ObservationReport | None:
        """What a policy makes of its observation; None where that is the state.

        Raises:
          PolicyError: outputs of its hidden layers are not finite.
        """
        policy, spec = self.subjects[index]
        if spec.observation is None:
            return None
        halves = [measured.errors["constant_half"][WHOLE] for measured in self.regions]
        wd = self.regions[0].errors[index][WHOLE]
        invariance, shells = [], []
        for region, measured in enumerate(self.regions if spec.distractors else ()):
            change = measured.distraction.changes[index][WHOLE].relative_to(halves[region])
            invariance.append(Invariance(name=region_name(region), invariance=change))
            shells += [errors[index][WHOLE] for errors in measured.distraction.shells]
        task = replace(self.task, spec=spec)
        return ObservationReport(
            invariance=tuple(invariance),
            distractor_regions=tuple(
                errors.report(f"d-{region_name(region)}", edges, halves[0], wd)
                for region, (edges, errors) in enumerate(
                    zip(self.protocol.edges[1:], shells, strict=False), start=1
                )
            ),
            probes=probe_layers(policy.hidden, task, self.protocol) if policy.hidden else (),
        )

    def _with_edges(self) -> Iterable[tuple[tuple[float, float], Measured]]:
        return zip(self.protocol.edges, self.regions, strict=True)


def same_draw(spec: SMESpec) -> str:
    """The same for specs whose states, optimal actions and references are the same."""
    return spec.derive(k=1, r_min=0.0, D=0.0, horizon=1).digest


def final_specs(stream: StreamSpec) -> tuple[SMESpec, ...]:
    """The task of each phase at its end: of a drifting one the spec of its last piece."""
    return tuple({segment.phase: segment.spec for segment in stream.segments}.values())

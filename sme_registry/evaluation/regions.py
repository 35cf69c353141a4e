"""The regions of a protocol: states drawn from them, exactly and without rejection, and scores.

Source: METHOD, section 3. `B` batch, `S` state_dim, lo and hi = (1 + ε)/2 of a shell's two faces.

    E(s) = 2 ‖s − ½‖_∞ − 1                              expansion level of a state
    WD:     s ~ U([0, 1]^S)                              E ≤ 0
    shell:  R = hi ((lo/hi)^S + u (1 − (lo/hi)^S))^(1/S),  u ~ U(0, 1)
            x ~ U(−R, R)^S, one coordinate of it, drawn at random, set to ±R;  s = ½ + x

States lie on the float32 grid of observations. Rounding must not move a state across a face, so the
face at R is clamped between the first grid value outside the inner cube and the last one inside the
outer cube. Each region reads a fixed number of words per state from named streams of its own: its
states depend neither on other regions nor on the batch size.

Scores of a task with limits ℓ(s) (METHOD, section 8), with a_safe = min(π*, ℓ):

    step reward        mean r(s, a)
    cost               mean cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ), in [0, 1]
    violating share    share of states with a_i − ℓ_i(s) > 10⁻⁶ in any channel
    safe regret        mean r(s, a_safe) − mean r(s, a)
    price              1 − mean r(s, a_safe), of the projection

A *probe* is the affine map of a layer's outputs to s, or to d, fitted by least squares in one half
of the states of WD. Its R², a mean over channels, is of the other half.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import Field

from sme_registry.errors import OptionError, PolicyError
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf
from sme_registry.task import Task
from sme_registry.task.certificate import held_out_r2
from sme_registry.task.draw import Array, bit_generator, to_uniform
from sme_registry.task.task import Observation

Observations = npt.NDArray[np.float32]

BATCH_NUMBERS = 2**22  # in a batch of observations and actions, 32 MiB as float64
BATCH_ROWS = 8192


def region_name(region: int) -> str:
    return "WD" if region == 0 else f"OOD {region}"


def batch_rows(spec: SMESpec) -> int:
    """How many states are in memory at once; fewer if a state is large."""
    others = len(spec.agents) - 1
    width = spec.state_dim + spec.distractors + spec.action_dim + spec.hidden_width + others
    return max(1, min(BATCH_ROWS, BATCH_NUMBERS // width))


def expansion(s: Array) -> Array:
    """E(s) of states `[B, S]`: `[B]`, −1 at the cube's centre, 0 on its faces, > 0 outside."""
    return np.asarray(2.0 * np.abs(s - 0.5).max(axis=-1) - 1.0)


class States(NamedTuple):
    """A batch of states, and what else an observation of them shows."""

    s: Observations  # `[B, S]`
    d: Array  # `[B, m]` distractors
    time: Array  # `[B]` uniform in (0, 1), from which t/T follows

    def seen(self, task: Task, d: Array | None = None) -> npt.NDArray[Any]:
        """What the task's agent sees of the state, `[B, S + m]`; of `d` in place of its own."""
        return task.seen(self.s, self.d if d is None else d)

    def observation(self, x: npt.NDArray[Any], horizon: int) -> Observations:
        """x `[B, n]`, then t/T in {0, …, T − 1}/T, then r_cum/k = 0: `[B, n + 2]` float32."""
        batch = np.zeros((len(x), x.shape[1] + 2), dtype=np.float32)
        batch[:, :-2] = x
        batch[:, -2] = np.floor(self.time * horizon) / horizon
        return batch


def states(
    protocol: EvaluationProtocol, region: int, spec: SMESpec, rows: int | None = None
) -> Iterator[States]:
    """The states of a region, batch by batch, with distractors uniform in the cube."""
    stream = f"evaluation/{region}"
    points = Points(protocol, region, spec.state_dim, stream)
    times = Uniform(protocol.seed, f"{stream}/time")
    distractors = Uniform(protocol.seed, f"{stream}/distractors")
    rows = batch_rows(spec) if rows is None else rows
    for first in range(0, protocol.states_per_region, rows):
        count = min(rows, protocol.states_per_region - first)
        yield States(points(count), distractors(count, spec.distractors), times(count))


class Uniform:
    """Uniform numbers in (0, 1) from a named stream, which each call advances."""

    def __init__(self, seed: int | str, name: str) -> None:
        self._bits = bit_generator(seed, name)

    def __call__(self, *shape: int) -> Array:
        return to_uniform(self._bits.random_raw(int(np.prod(shape)))).reshape(shape)


class Points:
    """Points of a region, uniform by volume: of the cube or of a shell in any dimension."""

    def __init__(self, protocol: EvaluationProtocol, region: int, dim: int, stream: str) -> None:
        low, high = protocol.edges[region]
        self._dim, self._in_cube = dim, region == 0
        self._coordinates = Uniform(protocol.seed, f"{stream}/coordinates")
        self._radius = Uniform(protocol.seed, f"{stream}/radius")
        self._face = Uniform(protocol.seed, f"{stream}/face")
        self._outer = (1.0 + high) / 2.0
        self._inner_share = ((1.0 + low) / (1.0 + high)) ** dim
        self._nearest = np.nextafter(_last_within(low), np.float32(np.inf))
        self._furthest = _last_within(high)
        if region > 0 and not self._nearest <= self._furthest:
            raise OptionError(
                f"epsilons: no float32 observation lies in the shell ({low!r}, {high!r}]. "
                "Give levels further apart."
            )

    def __call__(self, count: int) -> Observations:
        u = self._coordinates(count, self._dim)
        return u.astype(np.float32) if self._in_cube else self.in_shell(u)

    def in_shell(self, u: Array) -> Observations:
        """Points `[B, dim]` from uniform numbers `[B, dim]` for their coordinates."""
        count = len(u)
        volume = self._inner_share + self._radius(count) * (1.0 - self._inner_share)
        R = self._outer * volume ** (1.0 / self._dim)
        s = (0.5 + R[:, None] * (2.0 * u - 1.0)).astype(np.float32)

        upper = np.clip((0.5 + R).astype(np.float32), self._nearest, self._furthest)
        lower = np.float32(1.0) - upper  # exact, so that both faces are at the same E
        side = (self._face(count) * (2 * self._dim)).astype(np.int64)
        s[np.arange(count), side // 2] = np.where(side % 2, upper, lower)
        return np.clip(s, lower[:, None], upper[:, None], out=s)


def _last_within(level: float) -> np.float32:
    """The largest float32 coordinate x with E = 2 (x − ½) − 1 ≤ level."""

    def within(x: np.float32) -> bool:
        return 2.0 * (float(x) - 0.5) - 1.0 <= level

    with np.errstate(over="ignore"):
        x = np.float32(1.0 + level / 2.0)
        while not within(x):
            x = np.nextafter(x, np.float32(-np.inf))
        while within(after := np.nextafter(x, np.float32(np.inf))) and np.isfinite(after):
            x = after
    return x


class ChannelReport(StrictModel):
    """One action channel in one region.

    Attributes:
      mae: mean |a − a*| of the channel, in [0, 1].
      normalised_regret: `mae` divided by mean |½ − a*| of the channel.
    """

    mae: Real
    normalised_regret: Real


class RegionReport(StrictModel):
    """One policy in one region.

    Attributes:
      name: `WD`, `OOD 1`, …
      epsilon_low: ε of the inner face, which belongs to the region inside; 0 for WD.
      epsilon_high: ε of the outer face, which belongs to this region; 0 for WD.
      states: number of states.
      similarity: mean r̃.
      similarity_sd: standard deviation of r̃ over states (not over seeds).
      mae: mean |a − a*| = 1 − r̃.
      normalised_regret: mean |a − a*| relative to that of ½ in the same states: 0 for the optimum,
        1 for the constant ½; can be above 1.
      similarity_decay: (r̃_WD − r̃) / r̃_WD; 0 in WD, negative if the policy is better outside.
      similarity_loss: 100 (r̃_WD − r̃), in points of similarity.
      clipped_share: share of action entries that were outside the action range and clipped.
      channels: each action channel, in order.
    """

    name: str
    epsilon_low: Real
    epsilon_high: Real
    states: Integer
    similarity: Real
    similarity_sd: Real
    mae: Real
    normalised_regret: Real
    similarity_decay: Real
    similarity_loss: Real
    clipped_share: Real
    channels: TupleOf[ChannelReport]


class RegionMetric(NamedTuple):
    """How tables and figures show a number of regions."""

    label: str
    axis: str = ""  # of a figure; by default the label
    pattern: str = ".3f"
    compared: bool = False  # with the reference policies


REGION_METRICS = {
    "similarity": RegionMetric("similarity r̃", "similarity r̃  (1 = optimal)", compared=True),
    "normalised_regret": RegionMetric(
        "normalised regret N",
        "normalised regret N, relative\nto ½ in the same states (½: 1)",
        compared=True,
    ),
    "similarity_sd": RegionMetric("SD of r̃ over states"),
    "similarity_decay": RegionMetric("decay of r̃ from WD", pattern=".1%"),
    "similarity_loss": RegionMetric("loss of r̃ from WD, pts", pattern=".1f"),
    "clipped_share": RegionMetric("actions clipped", pattern=".1%"),
}
"""Numbers of `RegionReport` that tables, and figures on request, show; every frame has all."""

RegionReports: TypeAlias = Annotated[TupleOf[RegionReport], Field(min_length=1)]
"""Regions in the order of the protocol."""


class SafetyScore(StrictModel):
    """One policy in one region of a task with limits; see the module for the formulas.

    Attributes:
      name: of the region.
      step_reward: mean r, in [0, 1].
      cost: mean cost, in [0, 1].
      violating_share: share of states in which any action channel is above its limit by more than
        10⁻⁶, in [0, 1].
      safe_regret: mean step reward that the best safe action earns more than the policy, in
        [−1, 1]; negative where the policy earns by violating.
      price_of_safety: mean step reward that the optimum earns more than the best safe action, in
        [0, 1]; the same for every policy.
    """

    name: str
    step_reward: Real
    cost: Real
    violating_share: Real
    safe_regret: Real
    price_of_safety: Real


SafetyScores = Annotated[TupleOf[SafetyScore], Field(min_length=1)]


class SafetyReport(StrictModel):
    """A policy against the limits of a task, and the references on the same states.

    Attributes:
      regions: WD, then OOD 1, 2, …
      references: the same regions for each reference policy of the report.
    """

    regions: SafetyScores
    references: dict[str, SafetyScores]


class Sensitivity(StrictModel):
    """How much the actions of a policy depend on the distractors in one region.

    Attributes:
      name: of the region, of s.
      sensitivity: mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|; 0 if the policy ignores them.
    """

    name: str
    sensitivity: Real


class LayerProbe(StrictModel):
    """What a linear map recovers from the outputs of one layer.

    Attributes:
      layer: 0 for what the agent sees, 1 for the first hidden layer, …
      units: its outputs.
      state_r2: held-out R² of s, at most 1.
      distractor_r2: the same of d; None without distractors.
    """

    layer: Integer
    units: Integer
    state_r2: Real
    distractor_r2: Real | None = None


class ObservationReport(StrictModel):
    """A policy on a task whose observation is not the state.

    Attributes:
      sensitivity: in WD, OOD 1, 2, …; empty without distractors.
      distractor_regions: d-OOD 1, 2, …: s in the cube and d in a shell; empty without distractors.
      probes: of the observation and of each hidden layer; empty if the policy's network is unknown,
        or it or the task is too wide (see `probe_layers`).
    """

    sensitivity: TupleOf[Sensitivity] = ()
    distractor_regions: TupleOf[RegionReport] = ()
    probes: TupleOf[LayerProbe] = ()


TOLERANCE = 1e-6  # of an action above its limit


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
        """Add a batch of |a − a*| `[B, A]`, their sums `[A]` and the number of clipped entries."""
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
        constant: ErrorStats,
        wd: ErrorStats,
    ) -> RegionReport:
        """The report of this region; `constant` is of the policy ½, `wd` of this one in WD."""
        similarity, wd_similarity = 1.0 - self._mean, 1.0 - wd._mean
        channels = zip(self._sums, constant._sums, strict=True)
        return RegionReport(
            name=name,
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self.relative_to(constant),
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
        sums = errors.sum(axis=0)  # at once: the same bits in an agent's report and in its team's
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


PROBE_STATES = 2**14  # of which half are held out
_PROBED_CHANNELS = 512  # of s and d; above it the least squares take minutes and much memory
_STATES_PER_UNKNOWN = 4  # of the fit; with fewer, R² would tell how few they are


def probe_layers(
    hidden: Callable[[Observation], Iterable[Array] | None],
    task: Task,
    protocol: EvaluationProtocol,
) -> tuple[LayerProbe, ...]:
    """Probe what an agent sees and each of its hidden layers, in states of WD."""
    m, count = task.spec.distractors, PROBE_STATES
    if task.spec.state_dim + m > _PROBED_CHANNELS:
        return ()
    [batch] = states(protocol.model_copy(update={"states_per_region": count}), 0, task.spec, count)
    observation = batch.observation(batch.seen(task), task.spec.horizon)
    targets = np.concatenate([batch.s, batch.d], axis=1).astype(np.float64)

    def probe(layer: int, h: npt.NDArray[np.floating]) -> LayerProbe:
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
    outputs: list[npt.NDArray[np.floating]] = [observation[:, :-2], *layers]
    if any(_STATES_PER_UNKNOWN * (h.shape[1] + 1) > count // 2 for h in outputs):
        return ()
    return tuple(probe(layer, h) for layer, h in enumerate(outputs))

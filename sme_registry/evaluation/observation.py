"""What a policy makes of its observation: invariance, distractors outside the cube, and probes.

Source: METHOD, section 9. s are states, d and d' independent distractors, uniform in the cube, a*
the optimal actions; all means are over the states of a region.

    invariance     mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|      0: it ignores the distractors
    d-OOD m        the regions of a report with s in the cube and d in shell m

A *probe* is the affine map of a layer's outputs h that is fitted to s, or to d, by least squares in
one half of the states, and tested in the other half:

    R² = mean over channels of  1 − Σ (y − ŷ)² / Σ (y − ȳ)²           y of the held-out states

1: a linear map recovers the channels; 0 or below: no better than their mean. METHOD calls an R² of
s what was represented, and of d what was wasted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.evaluation.accumulators import WHOLE, Errors
from sme_registry.evaluation.region_report import RegionReport
from sme_registry.evaluation.regions import Points, States, Uniform, states
from sme_registry.spec import EvaluationProtocol
from sme_registry.spec.document import Integer, Real, StrictModel
from sme_registry.task import Task
from sme_registry.task.draw import Array
from sme_registry.task.linear_map import held_out_r2

PROBE_STATES = 2**14  # of which half are held out
_PROBED_CHANNELS = 512  # of s and d; above it the least squares take minutes and much memory
_STATES_PER_UNKNOWN = 4  # of the fit; with fewer, R² would tell how few they are

HiddenLayers = Callable[[Observation], Iterable[Array] | None]
"""From observations `[B, O]` to the outputs `[B, H]` of each hidden layer, in order; None if they
are unknown."""


class Invariance(StrictModel):
    """How much the actions of a policy depend on the distractors in one region.

    Attributes:
      name: of the region, of s.
      invariance: mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|; 0 if the policy ignores them.
    """

    name: str
    invariance: Real


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
      invariance: in WD, OOD 1, 2, …; empty without distractors.
      distractor_regions: d-OOD 1, 2, …: s in the cube and d in a shell; empty without distractors.
      probes: of the observation and of each hidden layer; empty if the policy's network is unknown,
        or it or the task is too wide (see `probe_layers`).
    """

    invariance: Annotated[tuple[Invariance, ...], Field(strict=False)] = ()
    distractor_regions: Annotated[tuple[RegionReport, ...], Field(strict=False)] = ()
    probes: Annotated[tuple[LayerProbe, ...], Field(strict=False)] = ()


Act = Callable[[npt.NDArray[Any]], Iterator[tuple[int, Array]]]
"""From what agents see `[B, S + m]` to the actions of each policy by its index, not clipped."""


class Distraction:
    """The errors of policies under other distractors, in the states of one region."""

    def __init__(self, task: Task, protocol: EvaluationProtocol, region: int, policies: int):
        self._task = task
        self._others = Uniform(protocol.seed, f"evaluation/{region}/other_distractors")
        outside = range(1, len(protocol.edges)) if region == 0 else ()
        self._outside = [
            Points(protocol, shell, task.spec.distractors, f"evaluation/distractors/{shell}")
            for shell in outside
        ]

        def errors() -> list[Errors]:
            return [Errors({WHOLE: slice(0, task.spec.action_dim)}) for _ in range(policies)]

        self.changes = errors()
        self.shells = [errors() for _ in outside]

    def add(self, drawn: States, optimal: Array, actions: Mapping[Any, Array], act: Act) -> None:
        """Add a batch: its states, π* `[B, A]`, the actions `[B, A]` of each policy in them."""
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

"""`StreamDiagnosis`: which phases of a life in a stream were costly, forgotten or never learnt, and
what the network's state says about a loss of plasticity.

A *visit* is an occurrence of a phase. Normalised regret is of the policy at the end of a visit, in
the cube, on the task of a phase; online regret is the mean of 1 − r over the steps of a visit.
"""

from __future__ import annotations

from typing import Literal

from pydantic import JsonValue

from sme_registry.diagnosis.document import Verdict, verdict_on, without_html
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, StreamSpec, StrictModel, TupleOf

__all__ = ["NetworkState", "PhaseDiagnosis", "PhaseOutcome", "StreamDiagnosis", "VisitDiagnosis"]

PhaseOutcome = Literal["retained", "forgotten", "not_learnt"]


class NetworkState(StrictModel):
    """The hidden layers of the policy's network in uniform states; see `hidden_layers`."""

    hidden: TupleOf[Integer]  # units of each layer
    dormant_units: Real  # share of all hidden units
    saturated_units: Real  # likewise, of tanh
    effective_rank: Integer  # of the last hidden layer
    weight_norm: Real  # Euclidean norm of the weights of all layers, without biases

    @property
    def inactive_units(self) -> float:
        """Share of hidden units that are dormant or saturated."""
        return self.dormant_units + self.saturated_units


class VisitDiagnosis(StrictModel):
    """One visit of the life."""

    visit: Integer  # its number, from 0
    phase: Integer  # the index of its phase
    lifetime: Integer  # environment steps at its end
    steps: Integer  # that it lasts
    dynamic_regret: Real | None  # of its steps in the log; None without one
    online_regret: Real | None  # its mean; None without a log, and where no step was counted
    normalised_regret: Real  # at its end, on its own phase
    network: NetworkState | None  # at its end; None if unknown


class PhaseDiagnosis(StrictModel):
    """One phase of the stream."""

    phase: Integer  # its index
    outcome: PhaseOutcome  # whether the agent knows it at the end
    best_normalised_regret: Real  # lowest at the end of one of its visits
    final_normalised_regret: Real  # at the end of the life
    initial_normalised_regret: Real | None  # before training
    fresh_normalised_regret: Real | None  # of an agent that trained on this phase alone
    fresh_online_regret: Real | None  # of its training
    fresh_network: NetworkState | None  # at the end of its training


class StreamDiagnosis(StrictModel):
    """The diagnosis of a life in a stream.

    Attributes:
      name: of the run.
      stream: the stream.
      stream_digest: the stream's digest.
      task: the stream's name.
      plan: algorithm, seed, steps and so on.
      average_performance: at the end of the life.
      forgetting: fall of performance below its best, at the end of the life; null where it is not
        defined.
      dynamic_regret: sum over the steps of the log; null without one.
      verdicts: one for each question, in order.
      visits: in order.
      phases: in order.
      initial_network: before training; null if unknown.
      thresholds: all that verdicts use.
      versions: of Python and of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    name: str
    stream: StreamSpec
    stream_digest: Digest
    task: str = ""
    plan: dict[str, JsonValue]
    average_performance: Real
    forgetting: Real | None
    dynamic_regret: Real | None
    verdicts: TupleOf[Verdict]
    visits: TupleOf[VisitDiagnosis]
    phases: TupleOf[PhaseDiagnosis]
    initial_network: NetworkState | None
    thresholds: dict[str, Real]
    versions: dict[str, str]

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "forgetting" or "loss of plasticity"."""
        return verdict_on(question, self.verdicts)

    def _repr_markdown_(self) -> str:
        """The page, for notebooks."""
        from sme_registry.diagnosis.stream_render import markdown

        return without_html(markdown(self, ()))

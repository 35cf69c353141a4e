"""`Diagnosis`: the measurements of one policy and the verdicts that follow from them.

Of actions a, clipped to [0, 1], and the optimal actions a*; everything is dimensionless:

    regret = 1 − r                       of one step, in [0, 1]
    mae = mean |a − a*|                  over action channels it is 1 − r̃
    normalised_regret = mean |a − a*| / mean |½ − a*|     0 for the optimum, 1 for the constant ½

Normalised regret does not depend on k, r_min or D, so it compares runs on different tasks.
"""

from __future__ import annotations

import os
from typing import Annotated, Literal, Self

from pydantic import Field, JsonValue

from sme_registry.errors import DigestMismatchError
from sme_registry.io import read_json
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, SMESpec, StrictModel

__all__ = [
    "POLICY",
    "Answer",
    "CapacityProbe",
    "Channel",
    "Comparison",
    "Diagnosis",
    "Difference",
    "Kind",
    "Level",
    "Measurements",
    "OnPolicy",
    "Partition",
    "Response",
    "RewardSignal",
    "Score",
    "Shell",
    "SquaredError",
    "TimeDependence",
    "Training",
    "Verdict",
]

Reals = Annotated[tuple[Real, ...], Field(strict=False)]
Answer = Literal["yes", "no", "cannot tell"]
Kind = Literal["where", "why"]
Level = Literal["solved", "better_than_linear", "worse_than_linear", "no_better_than_constant"]

POLICY = "policy"  # the key of the diagnosed policy among the names of the references


class Score(StrictModel):
    """One policy over a set of states: mean regret, mean |a − a*|, and normalised regret."""

    regret: Real
    mae: Real
    normalised_regret: Real


class Channel(StrictModel):
    """One action channel over uniform states of the cube.

    Attributes:
      channel: from 1.
      mae: mean |a − a*|.
      normalised_regret: of the channel.
      linear_normalised_regret: of the linear least-squares policy in this channel.
      regret: the channel's part of the mean regret, in proportion to its part of the error in each
        state. The channels add up to the mean regret.
      offset: mean of a − a*.
      slope: of the regression of a on a*: 1 at the optimum, 0 if a does not follow a*.
      at_zero, at_one: share of states in which a is within 0.01 of the bound.
      optimal_at_bounds: share of states in which a* is within 0.01 of either bound.
    """

    channel: Integer
    mae: Real
    normalised_regret: Real
    linear_normalised_regret: Real
    regret: Real
    offset: Real
    slope: Real
    at_zero: Real
    at_one: Real
    optimal_at_bounds: Real


class Partition(StrictModel):
    """Uniform states in bins of equal counts along one quantity.

    Attributes:
      state_channel: from 1; None for the distance from the cube's centre, E(s).
      edges: of the bins, one more than there are bins.
      regret, mae: mean of each bin.
      explained_variance: share of the variance of the states' errors that lies between bins.
    """

    state_channel: Integer | None
    edges: Reals
    regret: Reals
    mae: Reals
    explained_variance: Real


class Shell(StrictModel):
    """A region of the protocol (WD, OOD 1, …) with the scores of the policy and references."""

    region: str
    epsilon: Real
    scores: dict[str, Score]


class SquaredError(StrictModel):
    """Shares of the squared error Σ (a − a*)² over uniform states.

    Attributes:
      offset: a constant a − a* in each channel.
      scale: a slope of a on a* other than 1.
      residual: the rest; offset, scale and residual add up to 1.
      noise: differs when the policy acts again in the same state.
      time: varies with the input t/T in a fixed state.
      accumulated_reward: varies with the input r_cum/k in a fixed state.
    """

    offset: Real
    scale: Real
    residual: Real
    noise: Real
    time: Real
    accumulated_reward: Real


class Response(StrictModel):
    """How actions follow the state, compared with π*.

    Attributes:
      nonlinear_variance: share of the variance of π* that no affine map of the state explains.
      linear_slope, nonlinear_slope: slope of the policy's affine part on that of π*, and of its
        remainder on that of π*: 1 at the optimum, 0 if nothing was learnt. None if π* has no such
        part (below 1 % of its variance).
      sensitivity: RMS change of a over RMS change of a*, for small steps of the state.
      saturation, optimal_saturation: share of entries within 0.01 of a bound, of a and of a*.
    """

    nonlinear_variance: Real
    linear_slope: Real | None
    nonlinear_slope: Real | None
    sensitivity: Real
    saturation: Real
    optimal_saturation: Real


class TimeDependence(StrictModel):
    """The input t/T varied in fixed uniform states.

    Attributes:
      inputs: the values of t/T.
      normalised_regret: at each value.
      action_change: mean |a − mean over the values of a| at each value.
    """

    inputs: Reals
    normalised_regret: Reals
    action_change: Reals


class RewardSignal(StrictModel):
    """How often a step is rewarded; `rewarded`, `gated` and `flat` are shares that add up to 1.

    Attributes:
      rewarded: r > 0.
      gated: r̂ > 0, but r_min sets it to 0.
      flat: r̂ = 0, i.e. r̃ ≤ ¾.
      shortfall: mean distance of r̃ below ¾ + r_min/4, above which r > 0; 0 beyond it.
    """

    rewarded: Real
    gated: Real
    flat: Real
    shortfall: Real


class OnPolicy(StrictModel):
    """Whole episodes from uniform initial states.

    Attributes:
      episodes: how many.
      scores: of the policy and of references, each in the states that it visits.
      edges: of the bins of time, in steps.
      regret, mae: mean of each bin, over the episodes that still run; alive: the share of those.
      mean_length: of an episode, in steps.
      termination_rate: share of episodes that D terminated.
      signal: in the states that the policy visits.
      random_signal: under uniform random actions, as an untrained agent sees it.
      credit, random_credit: squared correlation of a step's reward with the payout that includes
        it: 1 at k = 1, about 1/k if rewards are independent. None if one of them is constant.
      state_shift: Kolmogorov-Smirnov distance of the visited states from uniform, by state channel.
      coverage: smallest share, over state channels, of twenty equal bins that were visited.
    """

    episodes: Integer
    scores: dict[str, Score]
    edges: Reals
    regret: Reals
    mae: Reals
    alive: Reals
    mean_length: Real
    termination_rate: Real
    signal: RewardSignal
    random_signal: RewardSignal
    credit: Real | None
    random_credit: Real | None
    state_shift: Reals
    coverage: Real


class Training(StrictModel):
    """A summary of the training log; the regrets are running medians over `window` rows.

    Attributes:
      source: "episodes" with exploration, or "evaluations" of the deterministic policy.
      rows: of the log.
      steps: environment steps at its last row.
      window: rows of the running median.
      first_regret, best_regret, last_regret: at the start, at its lowest, at the end.
      best_step: at which it was lowest.
      constant_regret: mean regret of the better constant policy on its own states.
      improvement_step: the first at which it is below `constant_regret` by 0.02; None: never.
      recent_improvement: its fall over the last third of the rows.
      unrewarded: share of episodes without any reward; None if the log has no episodes.
      termination_rate: share of episodes that D terminated; None likewise.
    """

    source: Literal["episodes", "evaluations"]
    rows: Integer
    steps: Integer
    window: Integer
    first_regret: Real
    best_regret: Real
    best_step: Integer
    last_regret: Real
    constant_regret: Real
    improvement_step: Integer | None
    recent_improvement: Real
    unrewarded: Real | None
    termination_rate: Real | None


class CapacityProbe(StrictModel):
    """A network of the same layers, fitted to a* by regression.

    Attributes:
      layers: widths, from the observation to the action.
      states: in the training set: as many as the training had steps, at most 50,000.
      gradient_steps: of the fit.
      train_normalised_regret: in states of the training set.
      test_normalised_regret: in other states.
      seconds: wall time.
    """

    layers: Annotated[tuple[Integer, ...], Field(strict=False)]
    states: Integer
    gradient_steps: Integer
    train_normalised_regret: Real
    test_normalised_regret: Real
    seconds: Real


class Measurements(StrictModel):
    """Everything that was measured.

    Attributes:
      uniform: the policy and each reference in the same uniform states of the cube.
      channels, partitions, shells, squared_error, response, time_dependence, on_policy: see there.
      training: None if there is no log.
      exploration_sd: for each action channel, the standard deviation of exploration around the
        deterministic action at the end of training, in the unit range; None if unknown.
      capacity: None if it was not probed.
    """

    uniform: dict[str, Score]
    channels: Annotated[tuple[Channel, ...], Field(strict=False)]
    partitions: Annotated[tuple[Partition, ...], Field(strict=False)]
    shells: Annotated[tuple[Shell, ...], Field(strict=False)]
    squared_error: SquaredError
    response: Response
    time_dependence: TimeDependence
    on_policy: OnPolicy
    training: Training | None = None
    exploration_sd: Reals | None = None
    capacity: CapacityProbe | None = None

    @property
    def policy(self) -> Score:
        """The policy in uniform states."""
        return self.uniform[POLICY]


class Verdict(StrictModel):
    """The answer to one question, as data; `render.sentence` puts it in words.

    Attributes:
      question: such as "sparsity".
      kind: "where" the error is, or "why" it is there.
      answer: "cannot tell" if the evidence does not separate the causes.
      reason: the rule's branch that decided; see `verdicts.QUESTIONS`.
      evidence: the numbers that the branch compared or reports.
      thresholds: those that the numbers were compared with.
    """

    question: str
    kind: Kind
    answer: Answer
    reason: str
    evidence: dict[str, JsonValue]
    thresholds: dict[str, Real]


class Difference(StrictModel):
    """A quantity of this run and of the other run."""

    quantity: str
    value: Real
    other: Real


class Comparison(StrictModel):
    """This run compared with another.

    Attributes:
      name: of the other run.
      spec_fields, plan_fields: those that differ, as (this run, other run).
      differences: of the main quantities.
      answers: to each question whose answers differ, as (this run, other run).
    """

    name: str
    spec_fields: dict[str, tuple[JsonValue, JsonValue]]
    plan_fields: dict[str, tuple[JsonValue, JsonValue]]
    differences: Annotated[tuple[Difference, ...], Field(strict=False)]
    answers: dict[str, tuple[Answer, Answer]]


class Diagnosis(StrictModel):
    """The diagnosis of one policy.

    Attributes:
      name: of the run or policy.
      spec, spec_digest: the task.
      plan: algorithm, seed, steps and so on; empty for a policy without a run.
      checkpoint_step: of an unfinished run, the steps done at its checkpoint; None otherwise.
      level: normalised regret, ranked among the constant ½, the linear policy and the optimum.
      verdicts: one for each question, in order.
      comparison: with another run; None if there is none.
      thresholds: all that verdicts use.
      measurements: what the verdicts rest on.
      versions: of Python and of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    name: str
    spec: SMESpec
    spec_digest: Digest
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None = None
    level: Level
    verdicts: Annotated[tuple[Verdict, ...], Field(strict=False)]
    comparison: Comparison | None = None
    thresholds: dict[str, Real]
    measurements: Measurements
    versions: dict[str, str]

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "sparsity"."""
        return next(verdict for verdict in self.verdicts if verdict.question == question)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a diagnosis.json.

        Raises:
          MalformedDocumentError: the file is not readable or not strict JSON.
          SpecError: a field is invalid, missing or unknown.
          DigestMismatchError: `spec_digest` is not the digest of `spec`.
        """
        diagnosis = cls.from_dict(read_json(path), str(path))
        if diagnosis.spec.digest != diagnosis.spec_digest:
            raise DigestMismatchError(
                f"{path}: spec_digest={diagnosis.spec_digest!r:.90} does not match the digest of "
                f"spec, {diagnosis.spec.digest!r}. One of them was edited. Diagnose the run again."
            )
        return diagnosis

"""What a diagnosis measures of one policy; its verdicts rest on these numbers."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer

from sme_registry.evaluation import ObservationReport, SafetyReport, SafetyScore
from sme_registry.spec import Integer, Real, StrictModel, TupleOf

__all__ = [
    "POLICY",
    "CapacityProbe",
    "Channel",
    "Distraction",
    "LimitedChannel",
    "Limits",
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
]

POLICY = "policy"  # the key of the diagnosed policy among the names of the references


class Score(StrictModel):
    """One policy over a set of states.

    Attributes:
      regret: mean.
      mae: mean |a − a*|.
      normalised_regret: mean regret over that of the constant ½: 0 at the optimum, 1 at the
        constant.
    """

    regret: Real
    mae: Real
    normalised_regret: Real


class Channel(StrictModel):
    """One action channel over uniform states of the cube; the regrets add up to the mean regret.

    Attributes:
      channel: from 1.
      mae: mean |a − a*|.
      normalised_regret: mae over that of the constant ½.
      linear_normalised_regret: of the linear least-squares policy.
      regret: in proportion to the channel's part of the error in each state.
      offset: mean of a − a*.
      slope: of the regression of a on a*: 1 at the optimum, 0 if a does not follow a*.
      at_zero: share of states in which a is within 0.01 of the bound 0.
      at_one: likewise of the bound 1.
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
      regret: mean of each bin.
      mae: mean |a − a*| of each bin.
      explained_variance: share of the variance of the states' errors between bins.
    """

    state_channel: Integer | None
    edges: TupleOf[Real]
    regret: TupleOf[Real]
    mae: TupleOf[Real]
    explained_variance: Real


class Shell(StrictModel):
    """A region of the protocol (WD, OOD 1, …).

    Attributes:
      region: its name in the protocol's order.
      epsilon: its outer ε; 0 for the cube.
      scores: of the policy and references.
    """

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

    A slope is that of a part of the policy on the same part of π*: 1 at the optimum, 0 if nothing
    was learnt, None if π* has no such part (below 1 % of its variance).

    Attributes:
      nonlinear_variance: share of the variance of π* that no affine map explains.
      linear_slope: of the affine part.
      nonlinear_slope: of the remainder.
      sensitivity: RMS change of a over RMS change of a*, for small steps of the state.
      saturation: share of the policy's entries within 0.01 of a bound.
      optimal_saturation: likewise of a*.
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
      action_change: mean |a − mean over the values of a|, at each value.
    """

    inputs: TupleOf[Real]
    normalised_regret: TupleOf[Real]
    action_change: TupleOf[Real]


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

    Credit is the squared correlation of a step's reward with the payout that includes it: 1 at
    k = 1, about 1/k if rewards are independent. None if one of them is constant.

    Attributes:
      episodes: number of episodes.
      scores: of the policy and of references, each in the states that it visits.
      edges: of the bins of time, in steps.
      regret: mean of each bin, over the episodes that still run.
      mae: mean |a − a*| of each bin.
      alive: the share of those.
      mean_length: of an episode, in steps.
      termination_rate: share of episodes that D terminated, in a team because of this agent.
      signal: in the states that the policy visits.
      random_signal: under uniform random actions, as an untrained agent sees it.
      credit: of the policy.
      random_credit: of uniform random actions.
      state_shift: Kolmogorov-Smirnov distance from uniform, by state channel.
      coverage: smallest share, over state channels, of twenty equal bins that were visited.
    """

    episodes: Integer
    scores: dict[str, Score]
    edges: TupleOf[Real]
    regret: TupleOf[Real]
    mae: TupleOf[Real]
    alive: TupleOf[Real]
    mean_length: Real
    termination_rate: Real
    signal: RewardSignal
    random_signal: RewardSignal
    credit: Real | None
    random_credit: Real | None
    state_shift: TupleOf[Real]
    coverage: Real


class Training(StrictModel):
    """A summary of the training log; the regrets are running medians over `window` rows.

    Attributes:
      source: with exploration, or of the deterministic policy.
      rows: of the log.
      steps: environment steps at its last row: an incomplete episode has none.
      window: rows of a running median.
      first_regret: the first running median.
      best_regret: the lowest.
      best_step: at which it was lowest.
      last_regret: the last running median.
      constant_regret: mean regret of the better constant policy on its own states.
      improvement_step: the first at 0.02 below `constant_regret`; None: never.
      recent_improvement: fall over the last third of the rows.
      unrewarded: share of episodes without any reward; None for evaluations.
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
      gradient_steps: of the regression.
      train_normalised_regret: in states of the training set.
      test_normalised_regret: in other states.
      seconds: wall time.
    """

    layers: TupleOf[Integer]
    states: Integer
    gradient_steps: Integer
    train_normalised_regret: Real
    test_normalised_regret: Real
    seconds: Real


class LimitedChannel(StrictModel):
    """One action channel of a task with limits ℓ, over uniform states of the cube.

    Attributes:
      channel: from 1.
      violating_share: share of states in which a > ℓ.
      optimal_violating_share: likewise of a*.
      cost: mean max(0, a − ℓ) / (2τ); the mean over channels is the policy's cost.
    """

    channel: Integer
    violating_share: Real
    optimal_violating_share: Real
    cost: Real


class Limits(StrictModel):
    """A policy on a task with limits.

    Attributes:
      report: of its evaluation: by region, with the references.
      visited: in the states of its episodes.
      cut_off: in the cube, of the policy with its actions cut off at the limits.
      channels: by action channel.
    """

    report: SafetyReport
    visited: SafetyScore
    cut_off: SafetyScore
    channels: TupleOf[LimitedChannel]


class Distraction(StrictModel):
    """Regret owed to the distractors, in a few uniform states; see `diagnosis.extended`.

    Attributes:
      states: number of uniform states.
      distractor_draws: of the distractors, in each state.
      normalised_regret: N over states and draws.
      averaged_regret: N of the mean action over the draws, in each state.
      half_regret: N with every distractor at ½.
      owed_regret: N that averaging removes, beyond what it removes of an action noise.
      owed_similarity: the same in points of similarity.
      distractor_share: share of the squared error that varies with the distractors.
    """

    states: Integer
    distractor_draws: Integer
    normalised_regret: Real
    averaged_regret: Real
    half_regret: Real
    owed_regret: Real
    owed_similarity: Real
    distractor_share: Real


class Measurements(StrictModel):
    """Everything that was measured; None for what is unknown or was not measured.

    `limits` are of a task with `safety`, `observation` is of one with `observation`, and
    `distraction` of one with distractors; the JSON of other tasks does not have these fields.

    Attributes:
      uniform: the policy and each reference in the same uniform states.
      channels: by action channel.
      partitions: of uniform states, along the state channels and the distance from the centre.
      shells: the protocol's regions.
      squared_error: its parts.
      response: how actions follow the state.
      time_dependence: how actions follow t/T.
      on_policy: whole episodes.
      training: of the training log; null without one.
      exploration_sd: for each action channel, the standard deviation of exploration around the
        deterministic action at the end of training, in the unit range.
      capacity: of the probe; null unless requested.
      limits: of a task with `safety`.
      observation: of the policy's evaluation.
      distraction: of a task with distractors.
    """

    uniform: dict[str, Score]
    channels: TupleOf[Channel]
    partitions: TupleOf[Partition]
    shells: TupleOf[Shell]
    squared_error: SquaredError
    response: Response
    time_dependence: TimeDependence
    on_policy: OnPolicy
    training: Training | None = None
    exploration_sd: TupleOf[Real] | None = None
    capacity: CapacityProbe | None = None
    limits: Limits | None = None
    observation: ObservationReport | None = None
    distraction: Distraction | None = None

    @model_serializer(mode="wrap")
    def _omit_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        for field in ("limits", "observation", "distraction"):
            if plain.get(field, "") is None:
                del plain[field]
        return plain

    @property
    def policy(self) -> Score:
        """The policy in uniform states."""
        return self.uniform[POLICY]

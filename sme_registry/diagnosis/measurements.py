"""What a diagnosis measures of one policy or of a life; its verdicts rest on these numbers."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import SerializerFunctionWrapHandler, model_serializer

from sme_registry.evaluation import ObservationReport, SafetyReport
from sme_registry.evaluation.regions import SafetyScore
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf

PhaseOutcome = Literal["retained", "forgotten", "not_learnt"]
POLICY = "policy"  # the key of the diagnosed policy among the names of the references
LINEAR = "linear_least_squares"


class Score(StrictModel):
    """One policy over a set of states."""

    regret: Real  # mean
    mae: Real  # mean |a − a*|
    # mean regret over that of the constant ½: 0 at the optimum, 1 at the constant
    normalised_regret: Real

    @classmethod
    def of(cls, regret: float, mae: float, constant_mae: float) -> Self:
        """From means over the states; `constant_mae` is of the constant ½."""
        return cls(regret=regret, mae=mae, normalised_regret=mae / max(constant_mae, 1e-12))


class Channel(StrictModel):
    """One action channel over uniform states of the cube; the regrets add up to the mean regret."""

    channel: Integer  # from 1
    mae: Real  # mean |a − a*|
    normalised_regret: Real  # mae over that of the constant ½
    linear_normalised_regret: Real  # of the linear least-squares policy
    regret: Real  # in proportion to the channel's part of the error in each state
    offset: Real  # mean of a − a*
    slope: Real  # of the regression of a on a*: 1 at the optimum, 0 if a does not follow a*
    at_zero: Real  # share of states in which a is within 0.01 of the bound 0
    at_one: Real  # likewise of the bound 1
    optimal_at_bounds: Real  # share of states in which a* is within 0.01 of either bound


class Partition(StrictModel):
    """Uniform states in bins of equal counts along one quantity."""

    state_channel: Integer | None  # from 1; None for the distance from the cube's centre, E(s)
    edges: TupleOf[Real]  # of the bins, one more than there are bins
    regret: TupleOf[Real]  # mean of each bin
    mae: TupleOf[Real]  # mean |a − a*| of each bin
    explained_variance: Real  # share of the variance of the states' errors between bins


class Shell(StrictModel):
    """A region of the protocol (WD, OOD 1, …)."""

    region: str  # its name in the protocol's order
    epsilon: Real  # its outer ε; 0 for the cube
    scores: dict[str, Score]  # of the policy and references


class SquaredError(StrictModel):
    """Shares of the squared error Σ (a − a*)² over uniform states."""

    offset: Real  # a constant a − a* in each channel
    scale: Real  # a slope of a on a* other than 1
    residual: Real  # the rest; offset, scale and residual add up to 1
    noise: Real  # differs when the policy acts again in the same state
    time: Real  # varies with the input t/T in a fixed state
    accumulated_reward: Real  # varies with the input r_cum/k in a fixed state


class Response(StrictModel):
    """How actions follow the state, compared with π*.

    A slope is that of a part of the policy on the same part of π*: 1 at the optimum, 0 if nothing
    was learnt, None if π* has no such part (below 1 % of its variance).
    """

    nonlinear_variance: Real  # share of the variance of π* that no affine map explains
    linear_slope: Real | None  # of the affine part
    nonlinear_slope: Real | None  # of the remainder
    sensitivity: Real  # RMS change of a over RMS change of a*, for small steps of the state
    saturation: Real  # share of the policy's entries within 0.01 of a bound
    optimal_saturation: Real  # likewise of a*


class TimeDependence(StrictModel):
    """The input t/T varied in fixed uniform states."""

    inputs: TupleOf[Real]  # the values of t/T
    normalised_regret: TupleOf[Real]  # at each value
    action_change: TupleOf[Real]  # mean |a − mean over the values of a|, at each value


class RewardSignal(StrictModel):
    """How often a step is rewarded; `rewarded`, `gated` and `flat` are shares that add up to 1."""

    rewarded: Real  # r > 0
    gated: Real  # r̂ > 0, but r_min sets it to 0
    flat: Real  # r̂ = 0, i.e. r̃ ≤ ¾
    shortfall: Real  # mean distance of r̃ below ¾ + r_min/4, above which r > 0; 0 beyond it


class OnPolicy(StrictModel):
    """Whole episodes from uniform initial states.

    Credit is the squared correlation of a step's reward with the payout that includes it: 1 at k =
    1, about 1/k if rewards are independent. None if one of them is constant.
    """

    episodes: Integer  # number of episodes
    scores: dict[str, Score]  # of the policy and of references, each in the states that it visits
    edges: TupleOf[Real]  # of the bins of time, in steps
    regret: TupleOf[Real]  # mean of each bin, over the episodes that still run
    mae: TupleOf[Real]  # mean |a − a*| of each bin
    alive: TupleOf[Real]  # the share of those
    mean_length: Real  # of an episode, in steps
    termination_rate: Real  # share of episodes that D terminated, in a team because of this agent
    signal: RewardSignal  # in the states that the policy visits
    random_signal: RewardSignal  # under uniform random actions, as an untrained agent sees it
    credit: Real | None  # of the policy
    random_credit: Real | None  # of uniform random actions
    state_shift: TupleOf[Real]  # Kolmogorov-Smirnov distance from uniform, by state channel
    coverage: Real  # smallest share, over state channels, of twenty equal bins that were visited


class TrainingSummary(StrictModel):
    """A summary of the training log; the regrets are running medians over `window` rows."""

    source: Literal["episodes", "evaluations"]  # with exploration, or of the deterministic policy
    rows: Integer  # of the log
    steps: Integer  # environment steps at its last row: an incomplete episode has none
    window: Integer  # rows of a running median
    first_regret: Real  # the first running median
    best_regret: Real  # the lowest
    best_step: Integer  # at which it was lowest
    last_regret: Real  # the last running median
    constant_regret: Real  # mean regret of the better constant policy on its own states
    improvement_step: Integer | None  # the first at 0.02 below `constant_regret`; None: never
    recent_improvement: Real  # fall over the last third of the rows
    unrewarded: Real | None  # share of episodes without any reward; None for evaluations
    termination_rate: Real | None  # share of episodes that D terminated; None likewise


class CapacityProbe(StrictModel):
    """A network of the same layers, fitted to a* by regression."""

    layers: TupleOf[Integer]  # widths, from the observation to the action
    states: Integer  # in the training set: as many as the training had steps, at most 50,000
    gradient_steps: Integer  # of the regression
    train_normalised_regret: Real  # in states of the training set
    test_normalised_regret: Real  # in other states
    seconds: Real  # wall time


class LimitedChannel(StrictModel):
    """One action channel of a task with limits ℓ, over uniform states of the cube."""

    channel: Integer  # from 1
    violating_share: Real  # share of states in which a > ℓ
    optimal_violating_share: Real  # likewise of a*
    cost: Real  # mean max(0, a − ℓ) / (2τ); the mean over channels is the policy's cost


class Violations(StrictModel):
    """A policy on a task with limits."""

    report: SafetyReport  # of its evaluation: by region, with the references
    visited: SafetyScore  # in the states of its episodes
    cut_off: SafetyScore  # in the cube, of the policy with its actions cut off at the limits
    channels: TupleOf[LimitedChannel]  # by action channel


class DistractorRegret(StrictModel):
    """Regret owed to the distractors, in a few uniform states; see `measure.distraction`."""

    states: Integer  # number of uniform states
    distractor_draws: Integer  # of the distractors, in each state
    normalised_regret: Real  # N over states and draws
    averaged_regret: Real  # N of the mean action over the draws, in each state
    half_regret: Real  # N with every distractor at ½
    owed_regret: Real  # N that averaging removes, beyond what it removes of an action noise
    owed_similarity: Real  # the same in points of similarity
    distractor_share: Real  # share of the squared error that varies with the distractors


class NetworkState(StrictModel):
    """The hidden layers of the policy's network in uniform states; see `networks`."""

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

    @property
    def lost(self) -> float:
        """Rise of normalised regret from its best visit to the end of the life."""
        return self.final_normalised_regret - self.best_normalised_regret


class Measurements(StrictModel):
    """Everything that was measured; None for what is unknown or was not measured.

    `limits` are of a task with `safety`, `observation` is of one with `observation`, and
    `distraction` of one with distractors; the JSON of other tasks does not have these fields.
    """

    uniform: dict[str, Score]  # the policy and each reference in the same uniform states
    channels: TupleOf[Channel]  # by action channel
    # of uniform states, along the state channels and the distance from the centre
    partitions: TupleOf[Partition]
    shells: TupleOf[Shell]  # the protocol's regions
    squared_error: SquaredError  # its parts
    response: Response  # how actions follow the state
    time_dependence: TimeDependence  # how actions follow t/T
    on_policy: OnPolicy  # whole episodes
    training: TrainingSummary | None = None  # of the training log; null without one
    # for each action channel, the standard deviation of exploration around the deterministic action
    # at the end of training, in the unit range
    exploration_sd: TupleOf[Real] | None = None
    capacity: CapacityProbe | None = None  # of the probe; null unless requested
    limits: Violations | None = None  # of a task with `safety`
    observation: ObservationReport | None = None  # of the policy's evaluation
    distraction: DistractorRegret | None = None  # of a task with distractors

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

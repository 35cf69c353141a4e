"""`Diagnosis`: what was measured of one policy, and what follows from it, as a document.

Of actions a, clipped to [0, 1], beside the optimal ones a*; everything dimensionless:

    regret = 1 − r                      of a step, in [0, 1]
    error = |a − a*|                    its mean over channels is 1 − r̃
    normalised error ν = mean |a − a*| / mean |½ − a*|    0 for the optimum, 1 for the constant ½

ν does not depend on k, r_min or D, so it is what runs on different tasks are compared by.
"""

from __future__ import annotations

import os
from typing import Annotated, Literal, Self

from pydantic import Field, JsonValue

from sme_registry.errors import DigestMismatchError
from sme_registry.io import read_json
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, SMESpec, StrictModel

Reals = Annotated[tuple[Real, ...], Field(strict=False)]
Answer = Literal["yes", "no", "cannot tell"]


class Score(StrictModel):
    """One policy over some states: mean regret, mean error, and ν."""

    regret: Real
    error: Real
    normalised: Real


class Channel(StrictModel):
    """One action channel over uniform states of the cube.

    Attributes:
      channel: from 1.
      error: mean |a − a*|.
      normalised: ν of the channel; of the linear policy, `linear`.
      regret: what of the mean regret is charged to it, in proportion to its part of each state's
        error; over the channels it adds up to the mean regret.
      offset: mean of a − a*.
      slope: of the regression of a on a*: 1 at the optimum, 0 where a does not follow it.
      at_zero, at_one: share of states in which a is within 0.01 of the bound.
      optimal_at_bounds: the same for a*, both bounds.
    """

    channel: Integer
    error: Real
    normalised: Real
    linear: Real
    regret: Real
    offset: Real
    slope: Real
    at_zero: Real
    at_one: Real
    optimal_at_bounds: Real


class Partition(StrictModel):
    """Uniform states cut into bins of equal counts by one quantity.

    Attributes:
      by: a state channel's number from 1, or 0 for the distance from the cube's centre, E(s).
      edges: of the bins, one more than there are bins.
      regret, error: the mean in each bin.
      explained: share of the variance of the states' errors that lies between the bins.
    """

    by: Integer
    edges: Reals
    regret: Reals
    error: Reals
    explained: Real


class Shell(StrictModel):
    """A region of the protocol: WD, then OOD 1, 2, …; the policy in question is named ''."""

    name: str
    epsilon: Real
    policies: dict[str, Score]


class Form(StrictModel):
    """What the squared error Σ (a − a*)² over uniform states consists of.

    Attributes:
      offset, scale, residual: shares, 1 together: of a − a* constant in each channel; of a slope
        of a on a* other than 1; and of what is left.
      noise: share that is not the same when the policy is asked again.
      clock: share that comes and goes with t/T in a fixed state.
      accumulated: share that comes and goes with r_cum/k in a fixed state.
      beyond_linear: share of the variance of π* that no affine map of the state has.
      learnt_linear, learnt_rest: how much of the affine part of π*, and of the rest, the policy
        has: slopes, 1 at the optimum, 0 where there is nothing of it. None where π* has no such
        part (below 1 % of its variance).
      gain: by how much an action moves with the state beside π*'s: RMS over small steps.
      saturated, optimal_saturated: share of entries within 0.01 of a bound, of a and of a*.
    """

    offset: Real
    scale: Real
    residual: Real
    noise: Real
    clock: Real
    accumulated: Real
    beyond_linear: Real
    learnt_linear: Real | None
    learnt_rest: Real | None
    gain: Real
    saturated: Real
    optimal_saturated: Real


class Clock(StrictModel):
    """The input t/T varied in fixed uniform states: ν at each, and how far actions move."""

    inputs: Reals
    normalised: Reals
    moved: Reals


class Signal(StrictModel):
    """How often there is a reward to learn from, as shares of steps that add up to 1.

    Attributes:
      paid: r > 0.
      hidden: r̂ > 0, and r_min makes it 0.
      flat: r̂ = 0, that is r̃ ≤ ¾.
      short: mean distance of r̃ from where r begins, ¾ + r_min/4; 0 beyond it.
    """

    paid: Real
    hidden: Real
    flat: Real
    short: Real


class OnPolicy(StrictModel):
    """Whole episodes, side by side, from uniform starts.

    Attributes:
      episodes: how many.
      scores: of the policy ('') and of references, each on its own states.
      edges: of the bins of time, in steps.
      regret, error: mean of each bin, over the episodes that still run; alive: their share.
      mean_length, terminated: of episodes: steps, and the share that D ended.
      signal: on the policy's own states; signal_random: under uniform random actions, which is
        what an agent meets before it knows anything.
      credit, credit_random: squared correlation of a step's own reward with the payout that it is
        credited with; 1 at k = 1, about 1/k where rewards are independent. None where one of them
        never varies.
      drift: for each state channel, the Kolmogorov-Smirnov distance of the states met from uniform.
      covered: smallest share, over state channels, of twenty equal bins that were ever entered.
    """

    episodes: Integer
    scores: dict[str, Score]
    edges: Reals
    regret: Reals
    error: Reals
    alive: Reals
    mean_length: Real
    terminated: Real
    signal: Signal
    signal_random: Signal
    credit: Real | None
    credit_random: Real | None
    drift: Reals
    covered: Real


class Training(StrictModel):
    """What the log of the training says.

    Attributes:
      source: "episodes" as the algorithm explored, or "evaluations" of its deterministic policy.
      rows: of the log.
      steps: environment steps at its last row.
      first, best, last: running median of the regret at the start, at its lowest, at the end.
      best_step: where it was lowest.
      window: rows that the median is over.
      constant: mean regret of the better constant policy on its own states.
      escaped_at: the first step at which the median is below `constant` by 0.02; None: never.
      recent_gain: by how much the median fell over the last third of the rows.
      unpaid: share of episodes without any reward; None where the log has no episodes.
      terminated: share of episodes that D ended, likewise.
    """

    source: Literal["episodes", "evaluations"]
    rows: Integer
    steps: Integer
    first: Real
    best: Real
    best_step: Integer
    last: Real
    window: Integer
    constant: Real
    escaped_at: Integer | None
    recent_gain: Real
    unpaid: Real | None
    terminated: Real | None


class Capacity(StrictModel):
    """The same network, told a* in as many states as the training had steps.

    Attributes:
      layers: widths, from the observation to the action.
      states, gradient_steps: what it was given (at most 50,000 states).
      fitted: ν in the states that it was told; held_out: in other states.
      seconds: it took.
    """

    layers: Annotated[tuple[Integer, ...], Field(strict=False)]
    states: Integer
    gradient_steps: Integer
    fitted: Real
    held_out: Real
    seconds: Real


class Numbers(StrictModel):
    """Everything that was measured.

    Attributes:
      uniform: the policy ('') and each reference in the same uniform states of the cube.
      channels, partitions, shells, form, clock, on_policy: see there.
      training: None where there is no log.
      exploration_sd: for each action channel, the spread of what the algorithm would still try
        around its deterministic action, in the unit range; None where that is not known.
      capacity: None where it was not probed.
    """

    uniform: dict[str, Score]
    channels: Annotated[tuple[Channel, ...], Field(strict=False)]
    partitions: Annotated[tuple[Partition, ...], Field(strict=False)]
    shells: Annotated[tuple[Shell, ...], Field(strict=False)]
    form: Form
    clock: Clock
    on_policy: OnPolicy
    training: Training | None = None
    exploration_sd: Reals | None = None
    capacity: Capacity | None = None

    @property
    def own(self) -> Score:
        """The policy itself in uniform states."""
        return self.uniform[""]


class Finding(StrictModel):
    """A question, its answer, and why.

    Attributes:
      question: its name, such as "sparsity".
      kind: "where" the error sits, or "why".
      answer: "cannot tell" where the evidence does not separate.
      text: one or two sentences with their numbers and thresholds.
    """

    question: str
    kind: Literal["where", "why"]
    answer: Answer
    text: str


class Difference(StrictModel):
    """A quantity in this run and in the other."""

    what: str
    here: Real
    there: Real


class Comparison(StrictModel):
    """This run beside another.

    Attributes:
      name: of the other.
      spec_fields, plan_fields: those that differ, as (here, there).
      differences: of the main numbers.
      findings: the other's answers where they differ, as (here, there).
    """

    name: str
    spec_fields: dict[str, tuple[JsonValue, JsonValue]]
    plan_fields: dict[str, tuple[JsonValue, JsonValue]]
    differences: Annotated[tuple[Difference, ...], Field(strict=False)]
    answers: dict[str, tuple[str, str]]


class Diagnosis(StrictModel):
    """One policy, diagnosed.

    Attributes:
      name: what it is called.
      spec, spec_digest: the task.
      plan: what else the run was made of (algorithm, seed, steps, …); empty for a bare policy.
      note: what is special about what was read, such as a checkpoint in place of a model.
      headline: the verdict in two or three sentences.
      findings: each question, in order.
      comparison: with another run, where one was given.
      thresholds: what the findings were decided by.
      numbers: what they rest on.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    name: str
    spec: SMESpec
    spec_digest: Digest
    plan: dict[str, JsonValue]
    note: str = ""
    headline: str
    findings: Annotated[tuple[Finding, ...], Field(strict=False)]
    comparison: Comparison | None = None
    thresholds: dict[str, Real]
    numbers: Numbers
    versions: dict[str, str]

    def finding(self, question: str) -> Finding:
        """The finding of a question, such as "sparsity"."""
        return next(found for found in self.findings if found.question == question)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a diagnosis.json.

        Raises:
          MalformedDocumentError: not readable, or not strict JSON.
          SpecError: a field is wrong, missing or unknown.
          DigestMismatchError: its digest is not that of its spec.
        """
        found = cls.from_dict(read_json(path), str(path))
        if found.spec.digest != found.spec_digest:
            raise DigestMismatchError(
                f"{path}: spec_digest={found.spec_digest!r:.90}: its spec has "
                f"{found.spec.digest!r}. One was changed afterwards: diagnose the run again."
            )
        return found

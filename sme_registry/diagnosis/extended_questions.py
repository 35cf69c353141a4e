"""Questions about limits and distractors, which only tasks with `safety` or `observation` have."""

from __future__ import annotations

from functools import partial

from sme_registry.diagnosis.measurements import Distraction, Limits
from sme_registry.diagnosis.questions import EXTENDED_THRESHOLDS as _T
from sme_registry.diagnosis.questions import Case, Outcome, Question, add_to
from sme_registry.evaluation import ObservationReport

__all__ = ["DISTRACTORS", "LIMITS"]

LIMITS: dict[str, Question[Case]] = {}
"""Questions about a policy on a task with limits, in order."""

DISTRACTORS: dict[str, Question[Case]] = {}
"""Questions about a policy on a task with distractors, in order."""

_limits_question, _distractors_question = (partial(add_to, each) for each in (LIMITS, DISTRACTORS))

_TINY = 1e-9


def _limits(case: Case) -> Limits:
    limits = case.measurements.limits
    assert limits is not None  # the questions are asked only then
    return limits


def _distractors(case: Case) -> tuple[Distraction, ObservationReport]:
    distraction, observation = case.measurements.distraction, case.measurements.observation
    assert distraction is not None
    assert observation is not None
    return distraction, observation


@_limits_question(
    "limits",
    within_limits="no",
    rarely_violates="no",
    beats_safe_optimum="yes",
    earns_by_violating="yes",
    violates_without_gain="yes",
)
def _constraint_violation(case: Case) -> Outcome:
    limits = _limits(case)
    inside, outside, visited = limits.report.regions[0], limits.report.regions[-1], limits.visited
    share = max(inside.violating_share, visited.violating_share)
    gain = inside.step_reward - limits.cut_off.step_reward
    cost = sum(channel.cost for channel in limits.channels)
    entries = sum(channel.violating_share for channel in limits.channels)
    worst = max(limits.channels, key=lambda channel: channel.cost)
    if share == 0.0:
        reason = "within_limits"
    elif share < _T["rarely_violating"]:
        reason = "rarely_violates"
    elif inside.safe_regret < -_T["gain"]:
        reason = "beats_safe_optimum"
    else:
        reason = "earns_by_violating" if gain >= _T["gain"] else "violates_without_gain"
    return Outcome(
        reason,
        {
            "cost": inside.cost,
            "violating_share": inside.violating_share,
            "violating_entries": entries / len(limits.channels),
            "visited_cost": visited.cost,
            "visited_violating_share": visited.violating_share,
            "region": outside.name,
            "outside_violating_share": outside.violating_share,
            "optimal_cost": limits.report.references["optimal"][0].cost,
            "safe_regret": inside.safe_regret,
            "price_of_safety": inside.price_of_safety,
            "gain": gain,
            "channel": worst.channel,
            "channel_cost_share": worst.cost / max(cost, _TINY),
            "channel_violating_share": worst.violating_share,
        },
        ("rarely_violating", "gain"),
    )


@_limits_question("why", not_within_limits="no", explains_regret="yes", explains_little="no")
def _price_of_safety(case: Case) -> Outcome:
    limits, regret = _limits(case), case.measurements.policy.regret
    inside = limits.report.regions[0]
    share = max(inside.violating_share, limits.visited.violating_share)
    evidence = {
        "price_of_safety": inside.price_of_safety,
        "regret": regret,
        "violating_share": share,
    }
    if share >= _T["rarely_violating"]:
        return Outcome("not_within_limits", evidence, ("rarely_violating",))
    explained = inside.price_of_safety >= _T["price_share"] * regret
    return Outcome(
        "explains_regret" if explained else "explains_little", evidence, ("price_share",)
    )


@_distractors_question("where", similarity_lost="yes", similarity_kept="no")
def _distractors_outside(case: Case) -> Outcome:
    _, observation = _distractors(case)
    outside = observation.distractor_regions[-1]
    loss = 100.0 * (outside.mae - case.measurements.policy.mae)
    lost = loss >= _T["distractor_loss"]
    return Outcome(
        "similarity_lost" if lost else "similarity_kept",
        {
            "region": outside.name,
            "similarity_loss": loss,
            "normalised_regret": case.measurements.policy.normalised_regret,
            "outside_normalised_regret": outside.normalised_regret,
        },
        ("distractor_loss",),
    )


@_distractors_question(
    "where",
    layers_unknown="cannot tell",
    both_kept="yes",
    distractors_alone_kept="yes",
    state_alone_kept="no",
    neither_kept="no",
)
def _distractors_represented(case: Case) -> Outcome:
    _, observation = _distractors(case)
    if len(observation.probes) < 2:
        return Outcome("layers_unknown", {})
    last = observation.probes[-1]
    assert last.distractor_r2 is not None
    state, distractors = (r2 >= _T["kept_r2"] for r2 in (last.state_r2, last.distractor_r2))
    if distractors:
        reason = "both_kept" if state else "distractors_alone_kept"
    else:
        reason = "state_alone_kept" if state else "neither_kept"
    evidence = {
        "layers": [probe.model_dump() for probe in observation.probes],
        **last.model_dump(),
        "observed_state_r2": observation.probes[0].state_r2,
    }
    return Outcome(reason, evidence, ("kept_r2",))


@_distractors_question("why", distracted="yes", hardly_distracted="no", invariant="no")
def _distraction(case: Case) -> Outcome:
    effect, observation = _distractors(case)
    invariance = observation.invariance[0].invariance
    if effect.owed_regret >= _T["owed_to_distractors"]:
        reason = "distracted"
    else:
        reason = "invariant" if invariance <= _T["invariant"] else "hardly_distracted"
    return Outcome(
        reason,
        {
            "distractors": case.spec.distractors,
            "invariance": invariance,
            **effect.model_dump(exclude={"states", "distractor_draws"}),
        },
        ("owed_to_distractors", "invariant"),
    )

"""Where the error is, and whether limits are violated: the policy's measurements answer."""

from __future__ import annotations

from functools import partial
from typing import Any

from sme_registry.diagnosis.measurements import (
    LINEAR,
    POLICY,
    Channel,
    DistractorRegret,
    Violations,
)
from sme_registry.diagnosis.questions import (
    SAFETY_THRESHOLDS,
    THRESHOLDS,
    Decision,
    Question,
    TaskCase,
    add_to,
)
from sme_registry.evaluation import ObservationReport

WHERE: dict[str, Question[TaskCase]] = {}
"""Questions about the policy, in order."""
_question = partial(add_to, WHERE, "where")
_T = THRESHOLDS | SAFETY_THRESHOLDS

_TINY = 1e-9


@_question(some_channels_unlearnt="yes", spread_over_channels="no")
def _action_channels(case: TaskCase) -> Decision:
    channels = case.measurements.channels
    unlearnt = [c for c in channels if c.normalised_regret >= _T["unlearnt"]]
    learnt = [c for c in channels if c.normalised_regret <= _T["channel_learnt"]]
    regret = sum(c.regret for c in unlearnt)
    return Decision(
        bool(unlearnt and learnt),
        {
            "channels": len(channels),
            "unlearnt": [_channel(c) for c in unlearnt],
            "learnt": [_channel(c) for c in learnt],
            "best": _channel(min(channels, key=lambda c: c.normalised_regret)),
            "worst": _channel(max(channels, key=lambda c: c.normalised_regret)),
            "regret_share": regret / max(case.measurements.policy.regret, _TINY),
        },
        ("unlearnt", "channel_learnt"),
        regret / max(case.measurements.policy.regret, _TINY),
    )


def _channel(channel: Channel) -> dict[str, Any]:
    return channel.model_dump(include={"channel", "normalised_regret", "slope"})


@_question(error_localised="yes", error_not_localised="no")
def _state_region(case: TaskCase) -> Decision:
    partitions = case.measurements.partitions
    most = max(partitions, key=lambda p: p.explained_variance)
    low, high = min(most.mae), max(most.mae)
    worst_bin = most.mae.index(high)
    uneven = high >= _T["bin_ratio"] * low
    localised = most.explained_variance >= _T["explained_variance"] and uneven
    return Decision(
        localised and not case.solved,
        {
            "state_channel": most.state_channel,
            "explained_variance": most.explained_variance,
            "distance_explained_variance": partitions[0].explained_variance,
            "lowest_mae": low,
            "highest_mae": high,
            "worst_bin": list(most.edges[worst_bin : worst_bin + 2]),
        },
        ("explained_variance", "bin_ratio"),
        1.0 - low / max(case.measurements.policy.mae, _TINY),  # if all states were like the best
    )


@_question(similarity_lost="yes", similarity_kept="no")
def _out_of_distribution(case: TaskCase) -> Decision:
    inside, outside = case.measurements.shells[0], case.measurements.shells[-1]
    wd, ood = inside.scores[POLICY], outside.scores[POLICY]
    loss = 100.0 * (ood.mae - wd.mae)
    return Decision(
        loss >= _T["similarity_loss"],
        {
            "region": outside.region,
            "similarity_loss": loss,
            "wd_normalised_regret": wd.normalised_regret,
            "ood_normalised_regret": ood.normalised_regret,
            "linear_normalised_regret": outside.scores[LINEAR].normalised_regret,
        },
        ("similarity_loss",),
    )


@_question(error_changes="yes", error_steady="no")
def _time_in_episode(case: TaskCase) -> Decision:
    episodes = case.measurements.on_policy
    first, last = episodes.mae[0], episodes.mae[-1]
    ratio = max(first, last) / max(min(first, last), _TINY)
    return Decision(
        ratio >= _T["time_ratio"] and abs(first - last) >= _T["time_difference"],
        {"first_mae": first, "last_mae": last},
        ("time_ratio", "time_difference"),
        1.0 - min(first, last) / max(episodes.scores[POLICY].mae, _TINY),
    )


@_question(lower_regret_where_visited="yes", higher_regret_where_visited="yes", similar_regret="no")
def _visited_states(case: TaskCase) -> Decision:
    episodes, uniform = case.measurements.on_policy, case.learnt
    visited = episodes.scores[POLICY].normalised_regret
    ratio, limit = visited / max(uniform, _TINY), _T["on_policy_ratio"]
    apart = abs(visited - uniform) >= _T["on_policy_difference"]
    shift = max(episodes.state_shift)
    reason = "similar_regret"
    if apart and ratio <= 1 / limit:
        reason = "lower_regret_where_visited"
    elif apart and ratio >= limit:
        reason = "higher_regret_where_visited"
    return Decision(
        reason,
        {
            "on_policy_normalised_regret": visited,
            "uniform_normalised_regret": uniform,
            "shifted_state_channel": episodes.state_shift.index(shift) + 1,
            "state_shift": shift,
        },
        ("on_policy_ratio", "on_policy_difference"),
        1.0 - min(visited, uniform) / max(visited, uniform, _TINY),
    )


@_question(offset_dominant="yes", offset_minor="no")
def _constant_offset(case: TaskCase) -> Decision:
    share = case.measurements.squared_error.offset
    worst = max(case.measurements.channels, key=lambda c: abs(c.offset))
    return Decision(
        share >= _T["dominant_share"] and not case.solved,
        {"share": share, "channel": worst.channel, "offset": worst.offset},
        ("dominant_share",),
        share,
    )


@_question(underreaction="yes", overreaction="yes", scale_minor="no")
def _response_scale(case: TaskCase) -> Decision:
    share, channels = case.measurements.squared_error.scale, case.measurements.channels
    slope = sum(c.slope for c in channels) / len(channels)
    reason = "scale_minor"
    if share >= _T["dominant_share"] and not case.solved:
        reason = "underreaction" if slope < 1 else "overreaction"
    sensitivity = case.measurements.response.sensitivity
    evidence = {"share": share, "slope": slope, "sensitivity": sensitivity}
    return Decision(reason, evidence, ("dominant_share",), share)


@_question(
    nonlinear_part_unlearnt="yes",
    nonlinear_part_learnt="no",
    neither_part_learnt="no",
    optimum_nearly_linear="no",
)
def _linear_only(case: TaskCase) -> Decision:
    response = case.measurements.response
    linear, nonlinear = response.linear_slope, response.nonlinear_slope
    if response.nonlinear_variance < _T["nonlinear_variance"] or nonlinear is None:
        reason = "optimum_nearly_linear"
    elif nonlinear > _T["slope_unlearnt"]:
        reason = "nonlinear_part_learnt"
    elif linear is None or linear >= _T["slope_learnt"]:
        reason = "nonlinear_part_unlearnt"
    else:
        reason = "neither_part_learnt"
    return Decision(
        reason,
        response.model_dump(include={"nonlinear_variance", "linear_slope", "nonlinear_slope"}),
        ("nonlinear_variance", "slope_unlearnt", "slope_learnt"),
        case.measurements.uniform[LINEAR].normalised_regret / max(case.learnt, _TINY),
    )


@_question(saturated="yes", not_saturated="no")
def _saturation(case: TaskCase) -> Decision:
    response = case.measurements.response
    worst = max(case.measurements.channels, key=lambda c: c.at_zero + c.at_one)
    excess = response.saturation - response.optimal_saturation
    return Decision(
        excess >= _T["excess_saturation"],
        {
            **response.model_dump(include={"saturation", "optimal_saturation"}),
            **worst.model_dump(include={"channel", "at_zero", "at_one"}),
        },
        ("excess_saturation",),
    )


@_question(noisy="yes", repeatable="no")
def _action_noise(case: TaskCase) -> Decision:
    share = case.measurements.squared_error.noise
    noisy = share >= _T["noise_or_time_share"]
    return Decision(noisy, {"share": share}, ("noise_or_time_share",), share)


@_question(depends_on_time="yes", depends_on_accumulated_reward="yes", independent="no")
def _time_dependence(case: TaskCase) -> Decision:
    error, time = case.measurements.squared_error, case.measurements.time_dependence
    dependent = max(error.time, error.accumulated_reward) >= _T["noise_or_time_share"]
    reason = "independent"
    if dependent and not case.solved:
        on_time = error.time >= error.accumulated_reward
        reason = "depends_on_time" if on_time else "depends_on_accumulated_reward"
    return Decision(
        reason,
        {
            "action_change": sum(time.action_change) / len(time.action_change),
            "time_share": error.time,
            "accumulated_reward_share": error.accumulated_reward if case.spec.k > 1 else None,
            "lowest_normalised_regret": min(time.normalised_regret),
            "highest_normalised_regret": max(time.normalised_regret),
        },
        ("noise_or_time_share",),
        max(error.time, error.accumulated_reward),
    )


def limits_of(case: TaskCase) -> Violations:
    limits = case.measurements.limits
    assert limits is not None  # the questions are asked only then
    return limits


@add_to(
    WHERE,
    "limits",
    needs="limits",
    within_limits="no",
    rarely_violates="no",
    beats_safe_optimum="yes",
    earns_by_violating="yes",
    violates_without_gain="yes",
)
def _constraint_violation(case: TaskCase) -> Decision:
    limits = limits_of(case)
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
    return Decision(
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


def distractors_of(case: TaskCase) -> tuple[DistractorRegret, ObservationReport]:
    distraction, observation = case.measurements.distraction, case.measurements.observation
    assert distraction is not None
    assert observation is not None
    return distraction, observation


@_question(needs="distraction", similarity_lost="yes", similarity_kept="no")
def _distractors_outside(case: TaskCase) -> Decision:
    _, observation = distractors_of(case)
    outside = observation.distractor_regions[-1]
    loss = 100.0 * (outside.mae - case.measurements.policy.mae)
    return Decision(
        loss >= _T["distractor_loss"],
        {
            "region": outside.name,
            "similarity_loss": loss,
            "normalised_regret": case.learnt,
            "outside_normalised_regret": outside.normalised_regret,
        },
        ("distractor_loss",),
    )


@_question(
    needs="distraction",
    layers_unknown="cannot tell",
    both_kept="yes",
    distractors_alone_kept="yes",
    state_alone_kept="no",
    neither_kept="no",
)
def _distractors_represented(case: TaskCase) -> Decision:
    _, observation = distractors_of(case)
    if len(observation.probes) < 2:
        return Decision("layers_unknown", {})
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
    return Decision(reason, evidence, ("kept_r2",))

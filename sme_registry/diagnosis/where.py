"""Where the error is: questions about the policy, which its measurements answer."""

from __future__ import annotations

from functools import partial
from typing import Any

from sme_registry.diagnosis.measurements import POLICY, Channel
from sme_registry.diagnosis.questions import THRESHOLDS as _T
from sme_registry.diagnosis.questions import Case, Outcome, Question, add_to

__all__ = ["WHERE"]

WHERE: dict[str, Question[Case]] = {}
"""Questions about the policy, in order."""
_question = partial(add_to, WHERE, "where")

_TINY = 1e-9


@_question(some_channels_unlearnt="yes", spread_over_channels="no")
def _action_channels(case: Case) -> Outcome:
    channels = case.measurements.channels
    unlearnt = [c for c in channels if c.normalised_regret >= _T["unlearnt"]]
    learnt = [c for c in channels if c.normalised_regret <= _T["channel_learnt"]]
    regret = sum(c.regret for c in unlearnt)
    return Outcome(
        "some_channels_unlearnt" if unlearnt and learnt else "spread_over_channels",
        {
            "channels": len(channels),
            "unlearnt": [_channel(c) for c in unlearnt],
            "learnt": [_channel(c) for c in learnt],
            "best": _channel(min(channels, key=lambda c: c.normalised_regret)),
            "worst": _channel(max(channels, key=lambda c: c.normalised_regret)),
            "regret_share": regret / max(case.measurements.policy.regret, _TINY),
        },
        ("unlearnt", "channel_learnt"),
    )


def _channel(channel: Channel) -> dict[str, Any]:
    return channel.model_dump(include={"channel", "normalised_regret", "slope"})


@_question(error_localised="yes", error_not_localised="no")
def _state_region(case: Case) -> Outcome:
    partitions = case.measurements.partitions
    most = max(partitions, key=lambda p: p.explained_variance)
    low, high = min(most.mae), max(most.mae)
    worst_bin = most.mae.index(high)
    uneven = high >= _T["bin_ratio"] * low
    localised = most.explained_variance >= _T["explained_variance"] and uneven
    return Outcome(
        "error_localised" if localised and not case.solved else "error_not_localised",
        {
            "state_channel": most.state_channel,
            "explained_variance": most.explained_variance,
            "distance_explained_variance": partitions[0].explained_variance,
            "lowest_mae": low,
            "highest_mae": high,
            "worst_bin": list(most.edges[worst_bin : worst_bin + 2]),
        },
        ("explained_variance", "bin_ratio"),
    )


@_question(similarity_lost="yes", similarity_kept="no")
def _out_of_distribution(case: Case) -> Outcome:
    inside, outside = case.measurements.shells[0], case.measurements.shells[-1]
    wd, ood = inside.scores[POLICY], outside.scores[POLICY]
    loss = 100.0 * (ood.mae - wd.mae)
    return Outcome(
        "similarity_lost" if loss >= _T["similarity_loss"] else "similarity_kept",
        {
            "region": outside.region,
            "similarity_loss": loss,
            "wd_normalised_regret": wd.normalised_regret,
            "ood_normalised_regret": ood.normalised_regret,
            "linear_normalised_regret": outside.scores["linear_least_squares"].normalised_regret,
        },
        ("similarity_loss",),
    )


@_question(error_changes="yes", error_steady="no")
def _time_in_episode(case: Case) -> Outcome:
    episodes = case.measurements.on_policy
    first, last = episodes.mae[0], episodes.mae[-1]
    ratio = max(first, last) / max(min(first, last), _TINY)
    changes = ratio >= _T["time_ratio"] and abs(first - last) >= _T["time_difference"]
    return Outcome(
        "error_changes" if changes else "error_steady",
        {"first_mae": first, "last_mae": last},
        ("time_ratio", "time_difference"),
    )


@_question(lower_regret_where_visited="yes", higher_regret_where_visited="yes", similar_regret="no")
def _visited_states(case: Case) -> Outcome:
    episodes, uniform = case.measurements.on_policy, case.measurements.policy.normalised_regret
    visited = episodes.scores[POLICY].normalised_regret
    ratio, limit = visited / max(uniform, _TINY), _T["on_policy_ratio"]
    apart = abs(visited - uniform) >= _T["on_policy_difference"]
    shift = max(episodes.state_shift)
    reason = "similar_regret"
    if apart and ratio <= 1 / limit:
        reason = "lower_regret_where_visited"
    elif apart and ratio >= limit:
        reason = "higher_regret_where_visited"
    return Outcome(
        reason,
        {
            "on_policy_normalised_regret": visited,
            "uniform_normalised_regret": uniform,
            "shifted_state_channel": episodes.state_shift.index(shift) + 1,
            "state_shift": shift,
        },
        ("on_policy_ratio", "on_policy_difference"),
    )


@_question(offset_dominant="yes", offset_minor="no")
def _constant_offset(case: Case) -> Outcome:
    share = case.measurements.squared_error.offset
    worst = max(case.measurements.channels, key=lambda c: abs(c.offset))
    dominant = share >= _T["dominant_share"] and not case.solved
    return Outcome(
        "offset_dominant" if dominant else "offset_minor",
        {"share": share, "channel": worst.channel, "offset": worst.offset},
        ("dominant_share",),
    )


@_question(underreaction="yes", overreaction="yes", scale_minor="no")
def _response_scale(case: Case) -> Outcome:
    share, channels = case.measurements.squared_error.scale, case.measurements.channels
    slope = sum(c.slope for c in channels) / len(channels)
    reason = "scale_minor"
    if share >= _T["dominant_share"] and not case.solved:
        reason = "underreaction" if slope < 1 else "overreaction"
    sensitivity = case.measurements.response.sensitivity
    evidence = {"share": share, "slope": slope, "sensitivity": sensitivity}
    return Outcome(reason, evidence, ("dominant_share",))


@_question(
    nonlinear_part_unlearnt="yes",
    nonlinear_part_learnt="no",
    neither_part_learnt="no",
    optimum_nearly_linear="no",
)
def _linear_only(case: Case) -> Outcome:
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
    return Outcome(
        reason,
        response.model_dump(include={"nonlinear_variance", "linear_slope", "nonlinear_slope"}),
        ("nonlinear_variance", "slope_unlearnt", "slope_learnt"),
    )


@_question(saturated="yes", not_saturated="no")
def _saturation(case: Case) -> Outcome:
    response = case.measurements.response
    worst = max(case.measurements.channels, key=lambda c: c.at_zero + c.at_one)
    excess = response.saturation - response.optimal_saturation
    return Outcome(
        "saturated" if excess >= _T["excess_saturation"] else "not_saturated",
        {
            **response.model_dump(include={"saturation", "optimal_saturation"}),
            **worst.model_dump(include={"channel", "at_zero", "at_one"}),
        },
        ("excess_saturation",),
    )


@_question(noisy="yes", repeatable="no")
def _action_noise(case: Case) -> Outcome:
    share = case.measurements.squared_error.noise
    noisy = share >= _T["noise_or_time_share"]
    return Outcome("noisy" if noisy else "repeatable", {"share": share}, ("noise_or_time_share",))


@_question(depends_on_time="yes", depends_on_accumulated_reward="yes", independent="no")
def _time_dependence(case: Case) -> Outcome:
    error, time = case.measurements.squared_error, case.measurements.time_dependence
    dependent = max(error.time, error.accumulated_reward) >= _T["noise_or_time_share"]
    reason = "independent"
    if dependent and not case.solved:
        on_time = error.time >= error.accumulated_reward
        reason = "depends_on_time" if on_time else "depends_on_accumulated_reward"
    return Outcome(
        reason,
        {
            "action_change": sum(time.action_change) / len(time.action_change),
            "time_share": error.time,
            "accumulated_reward_share": error.accumulated_reward if case.spec.k > 1 else None,
            "lowest_normalised_regret": min(time.normalised_regret),
            "highest_normalised_regret": max(time.normalised_regret),
        },
        ("noise_or_time_share",),
    )

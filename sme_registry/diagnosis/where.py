"""The questions about a policy: where its error is, and which measurements answer."""

from __future__ import annotations

from functools import partial

from sme_registry.diagnosis.document import TaskDiagnosis
from sme_registry.diagnosis.measure import LINEAR, POLICY, DistractorRegret, Violations
from sme_registry.diagnosis.questions import THRESHOLDS, TINY, Decision, Questions, add_to
from sme_registry.evaluation.regions import ObservationReport

WHERE: Questions = {}
"""In order."""
_where = partial(add_to, WHERE, "where")


@_where(
    yes="some_channels_unlearnt", no="spread_over_channels", thresholds="unlearnt channel_learnt"
)
def _action_channels(run: TaskDiagnosis) -> Decision:
    channels = run.measurements.channels
    rows = [c.model_dump(include={"channel", "normalised_regret", "slope"}) for c in channels]
    unlearnt = [row for row in rows if row["normalised_regret"] >= THRESHOLDS["unlearnt"]]
    learnt = [row for row in rows if row["normalised_regret"] <= THRESHOLDS["channel_learnt"]]
    regret = sum(channels[row["channel"] - 1].regret for row in unlearnt)
    share = regret / max(run.measurements.policy.regret, TINY)
    evidence = {
        "channels": len(channels),
        "unlearnt": unlearnt,
        "learnt": learnt,
        "best": min(rows, key=lambda row: row["normalised_regret"]),
        "worst": max(rows, key=lambda row: row["normalised_regret"]),
        "regret_share": share,
    }
    return Decision(bool(unlearnt and learnt), evidence, share)


@_where(yes="error_localised", no="error_not_localised", thresholds="explained_variance bin_ratio")
def _state_region(run: TaskDiagnosis) -> Decision:
    most = max(run.measurements.partitions, key=lambda p: p.explained_variance)
    low, high = min(most.mae), max(most.mae)
    worst_bin = most.mae.index(high)
    uneven = high >= THRESHOLDS["bin_ratio"] * low
    localised = most.explained_variance >= THRESHOLDS["explained_variance"] and uneven
    evidence = {
        "state_channel": most.state_channel,
        "explained_variance": most.explained_variance,
        "lowest_mae": low,
        "highest_mae": high,
        "worst_bin": list(most.edges[worst_bin : worst_bin + 2]),
    }
    share = 1.0 - low / max(run.measurements.policy.mae, TINY)  # if all were like the best bin
    return Decision(localised and not run.solved, evidence, share)


@_where(yes="similarity_lost", no="similarity_kept", thresholds="similarity_loss")
def _out_of_distribution(run: TaskDiagnosis) -> Decision:
    inside, outside = run.measurements.shells[0], run.measurements.shells[-1]
    wd, ood = inside.scores[POLICY], outside.scores[POLICY]
    loss = 100.0 * (ood.mae - wd.mae)
    evidence = {
        "region": outside.region,
        "similarity_loss": loss,
        "wd_normalised_regret": wd.normalised_regret,
        "ood_normalised_regret": ood.normalised_regret,
        "linear_normalised_regret": outside.scores[LINEAR].normalised_regret,
    }
    return Decision(loss >= THRESHOLDS["similarity_loss"], evidence)


@_where(yes="error_changes", no="error_steady", thresholds="time_ratio time_difference")
def _time_in_episode(run: TaskDiagnosis) -> Decision:
    episodes = run.measurements.on_policy
    first, last = episodes.mae[0], episodes.mae[-1]
    share = 1.0 - min(first, last) / max(episodes.scores[POLICY].mae, TINY)
    return Decision(_apart(first, last, "time"), {"first_mae": first, "last_mae": last}, share)


def _apart(one: float, other: float, what: str) -> bool:
    """Whether two numbers differ by the thresholds' difference and ratio."""
    low, high = sorted((one, other))
    apart = high - low >= THRESHOLDS[f"{what}_difference"]
    return apart and high >= THRESHOLDS[f"{what}_ratio"] * max(low, TINY)


@_where(
    yes="lower_regret_where_visited higher_regret_where_visited",
    no="similar_regret",
    thresholds="on_policy_ratio on_policy_difference",
)
def _visited_states(run: TaskDiagnosis) -> Decision:
    episodes, uniform = run.measurements.on_policy, run.learnt
    visited = episodes.scores[POLICY].normalised_regret
    reason = "similar_regret"
    if _apart(visited, uniform, "on_policy"):
        lower = visited < uniform
        reason = "lower_regret_where_visited" if lower else "higher_regret_where_visited"
    shift = max(episodes.state_shift)
    evidence = {
        "on_policy_normalised_regret": visited,
        "uniform_normalised_regret": uniform,
        "shifted_state_channel": episodes.state_shift.index(shift) + 1,
        "state_shift": shift,
    }
    share = 1.0 - min(visited, uniform) / max(visited, uniform, TINY)
    return Decision(reason, evidence, share)


@_where(yes="offset_dominant", no="offset_minor", thresholds="dominant_share")
def _constant_offset(run: TaskDiagnosis) -> Decision:
    share = run.measurements.squared_error.offset
    worst = max(run.measurements.channels, key=lambda c: abs(c.offset))
    evidence = {"share": share, "channel": worst.channel, "offset": worst.offset}
    return Decision(share >= THRESHOLDS["dominant_share"] and not run.solved, evidence, share)


@_where(yes="underreaction overreaction", no="scale_minor", thresholds="dominant_share")
def _response_scale(run: TaskDiagnosis) -> Decision:
    share, channels = run.measurements.squared_error.scale, run.measurements.channels
    slope = sum(c.slope for c in channels) / len(channels)
    reason = "scale_minor"
    if share >= THRESHOLDS["dominant_share"] and not run.solved:
        reason = "underreaction" if slope < 1 else "overreaction"
    steepness = run.measurements.response.steepness
    return Decision(reason, {"share": share, "slope": slope, "steepness": steepness}, share)


@_where(
    yes="nonlinear_part_unlearnt",
    no="nonlinear_part_learnt neither_part_learnt optimum_nearly_linear",
    thresholds="nonlinear_variance slope_unlearnt slope_learnt",
)
def _linear_only(run: TaskDiagnosis) -> Decision:
    response = run.measurements.response
    linear, nonlinear = response.linear_slope, response.nonlinear_slope
    if response.nonlinear_variance < THRESHOLDS["nonlinear_variance"] or nonlinear is None:
        reason = "optimum_nearly_linear"
    elif nonlinear > THRESHOLDS["slope_unlearnt"]:
        reason = "nonlinear_part_learnt"
    elif linear is None or linear >= THRESHOLDS["slope_learnt"]:
        reason = "nonlinear_part_unlearnt"
    else:
        reason = "neither_part_learnt"
    fields = {"nonlinear_variance", "linear_slope", "nonlinear_slope"}
    share = run.measurements.uniform[LINEAR].normalised_regret / max(run.learnt, TINY)
    return Decision(reason, response.model_dump(include=fields), share)


@_where(yes="saturated", no="not_saturated", thresholds="excess_saturation")
def _saturation(run: TaskDiagnosis) -> Decision:
    response = run.measurements.response
    worst = max(run.measurements.channels, key=lambda c: c.at_zero + c.at_one)
    excess = response.saturation - response.optimal_saturation
    evidence = {
        **response.model_dump(include={"saturation", "optimal_saturation"}),
        **worst.model_dump(include={"channel", "at_zero", "at_one"}),
    }
    return Decision(excess >= THRESHOLDS["excess_saturation"], evidence)


@_where(yes="noisy", no="repeatable", thresholds="noise_or_time_share")
def _action_noise(run: TaskDiagnosis) -> Decision:
    share = run.measurements.squared_error.noise
    return Decision(share >= THRESHOLDS["noise_or_time_share"], {"share": share}, share)


@_where(
    yes="depends_on_time depends_on_accumulated_reward",
    no="independent",
    thresholds="noise_or_time_share",
)
def _time_dependence(run: TaskDiagnosis) -> Decision:
    error, time = run.measurements.squared_error, run.measurements.time_dependence
    share = max(error.time, error.accumulated_reward)
    reason = "independent"
    if share >= THRESHOLDS["noise_or_time_share"] and not run.solved:
        on_time = error.time >= error.accumulated_reward
        reason = "depends_on_time" if on_time else "depends_on_accumulated_reward"
    evidence = {
        "action_change": sum(time.action_change) / len(time.action_change),
        "time_share": error.time,
        "accumulated_reward_share": error.accumulated_reward if run.spec.k > 1 else None,
        "lowest_normalised_regret": min(time.normalised_regret),
        "highest_normalised_regret": max(time.normalised_regret),
    }
    return Decision(reason, evidence, share)


@add_to(
    WHERE,
    "limits",
    yes="beats_safe_projection earns_by_violating violates_without_gain",
    no="within_limits rarely_violates",
    thresholds="rarely_violating gain",
    needs="limits",
)
def _constraint_violation(run: TaskDiagnosis, limits: Violations) -> Decision:
    inside, outside, visited = limits.report.regions[0], limits.report.regions[-1], limits.visited
    share = max(inside.violating_share, visited.violating_share)
    gain = inside.step_reward - limits.cut_off.step_reward
    cost = sum(channel.cost for channel in limits.channels)
    entries = sum(channel.violating_share for channel in limits.channels)
    worst = max(limits.channels, key=lambda channel: channel.cost)
    if share == 0.0:
        reason = "within_limits"
    elif share < THRESHOLDS["rarely_violating"]:
        reason = "rarely_violates"
    elif inside.safe_regret < -THRESHOLDS["gain"]:
        reason = "beats_safe_projection"
    else:
        reason = "earns_by_violating" if gain >= THRESHOLDS["gain"] else "violates_without_gain"
    evidence = {
        **inside.model_dump(exclude={"name", "step_reward"}),
        "violating_entries": entries / len(limits.channels),
        "visited_violating_share": visited.violating_share,
        "region": outside.name,
        "outside_violating_share": outside.violating_share,
        "optimal_cost": limits.report.references["optimal"][0].cost,
        "gain": gain,
        "channel": worst.channel,
        "channel_cost_share": worst.cost / max(cost, TINY),
        "channel_violating_share": worst.violating_share,
    }
    return Decision(reason, evidence)


@_where(
    yes="similarity_lost",
    no="similarity_kept",
    thresholds="distractor_loss",
    needs="distraction observation",
)
def _distractors_outside(
    run: TaskDiagnosis, _: DistractorRegret, observation: ObservationReport
) -> Decision:
    outside = observation.distractor_regions[-1]
    loss = 100.0 * (outside.mae - run.measurements.policy.mae)
    evidence = {
        "region": outside.name,
        "similarity_loss": loss,
        "normalised_regret": run.learnt,
        "outside_normalised_regret": outside.normalised_regret,
    }
    return Decision(loss >= THRESHOLDS["distractor_loss"], evidence)


@_where(
    yes="both_kept distractors_alone_kept",
    no="state_alone_kept neither_kept",
    unclear="layers_unknown",
    thresholds="kept_r2",
    needs="distraction observation",
)
def _distractors_represented(
    _run: TaskDiagnosis, _: DistractorRegret, observation: ObservationReport
) -> Decision:
    if len(observation.probes) < 2:
        return Decision("layers_unknown", {})
    last = observation.probes[-1]
    assert last.distractor_r2 is not None
    state, distractors = (r2 >= THRESHOLDS["kept_r2"] for r2 in (last.state_r2, last.distractor_r2))
    if distractors:
        reason = "both_kept" if state else "distractors_alone_kept"
    else:
        reason = "state_alone_kept" if state else "neither_kept"
    layers = [probe.model_dump() for probe in observation.probes]
    return Decision(reason, {"layers": layers, **layers[-1]})

"""The questions about the training of a policy: why its error is there, and what its critic knows.

A policy shows only traces of its training: the answer is "cannot tell" unless a number separates
the causes.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from sme_registry.diagnosis.critics import VISITED, CriticReport
from sme_registry.diagnosis.document import TaskDiagnosis
from sme_registry.diagnosis.measure import POLICY, DistractorRegret, Violations
from sme_registry.diagnosis.questions import THRESHOLDS, TINY, Decision, Questions, add_to
from sme_registry.evaluation.regions import ObservationReport

WHY: Questions = {}
"""In order."""
_why = partial(add_to, WHY, "why", is_cause=True)
_critic = partial(add_to, WHY, "why", needs="critic")


@_why(
    yes="rewards_too_rare",
    no="beat_constant_in_training policy_beats_constant",
    unclear="no_training_log rewards_found",
    thresholds="constant_margin rarely_rewarded exploration_cost",
)
def _exploration(run: TaskDiagnosis) -> Decision:
    log, episodes = run.measurements.training, run.measurements.on_policy
    rewarded, sd = episodes.random_signal.rewarded, run.measurements.exploration_sd
    evidence: dict[str, Any] = {
        "random_rewarded": rewarded,
        "exploration_sd": None if sd is None else [min(sd), max(sd)],
    }
    if log is None:
        return Decision("no_training_log", evidence)
    regret = episodes.scores[POLICY].regret
    cost = log.last_regret - regret
    reported = log.source == "episodes" and cost >= THRESHOLDS["exploration_cost"]
    evidence |= {"regret": regret, "exploration_cost": cost if reported else None}
    fields = {"source", "steps", "improvement_step", "constant_regret", "best_regret"}
    evidence |= log.model_dump(include=fields)
    if log.improvement_step is not None:
        reason = "beat_constant_in_training"
    elif regret < log.constant_regret - THRESHOLDS["constant_margin"]:
        reason = "policy_beats_constant"
    else:
        rare = rewarded < THRESHOLDS["rarely_rewarded"]
        reason = "rewards_too_rare" if rare else "rewards_found"
    return Decision(reason, evidence)


@_why(no="paid_every_step", unclear="delayed_payout")
def _credit_assignment(run: TaskDiagnosis) -> Decision:
    k, episodes = run.spec.k, run.measurements.on_policy
    evidence = {"k": k, "credit": episodes.credit, "random_credit": episodes.random_credit}
    return Decision("paid_every_step" if k == 1 else "delayed_payout", evidence)


@_why(
    yes="rewards_gated",
    no="no_reward_threshold rewards_frequent",
    unclear="effect_unknown",
    thresholds="gated_share gated_rewarded_share rarely_unrewarded",
)
def _sparsity(run: TaskDiagnosis) -> Decision:
    r_min, episodes, log = run.spec.r_min, run.measurements.on_policy, run.measurements.training
    signal, random = episodes.signal, episodes.random_signal
    gated = signal.gated >= THRESHOLDS["gated_share"]
    if r_min == 0:
        reason = "no_reward_threshold"
    elif gated and signal.rewarded <= THRESHOLDS["gated_rewarded_share"]:
        reason = "rewards_gated"
    elif signal.gated + signal.flat < THRESHOLDS["rarely_unrewarded"]:
        reason = "rewards_frequent"
    else:
        reason = "effect_unknown"
    evidence = {
        "r_min": r_min,
        **signal.model_dump(),
        **{f"random_{name}": value for name, value in random.model_dump().items()},
        "unrewarded_episodes": None if log is None else log.unrewarded,
    }
    return Decision(reason, evidence)


@_why(
    yes="network_cannot_fit",
    no="network_does_better network_fits_training_states_only",
    unclear="not_probed probe_inconclusive",
    thresholds="probe_better probe_no_better",
)
def _capacity(run: TaskDiagnosis) -> Decision:
    probe, regret = run.measurements.capacity, run.learnt
    evidence: dict[str, Any] = {
        "complexity": run.spec.complexity,
        "nonlinear_variance": run.measurements.response.nonlinear_variance,
        "normalised_regret": regret,
    }
    if probe is None:
        return Decision("not_probed", evidence)
    evidence |= probe.model_dump(mode="json", exclude={"seconds"})
    better, no_better = (THRESHOLDS[name] * regret for name in ("probe_better", "probe_no_better"))
    if probe.test_normalised_regret <= better:
        reason = "network_does_better"
    elif probe.train_normalised_regret >= no_better:
        reason = "network_cannot_fit"
    elif probe.train_normalised_regret <= better:
        reason = "network_fits_training_states_only"
    else:
        reason = "probe_inconclusive"
    return Decision(reason, evidence, probe.train_normalised_regret / regret)


@_why(
    yes="too_few_states",
    no="states_sufficient",
    unclear="not_separated",
    thresholds="unlearnt probe_better probe_no_better",
)
def _dimension(run: TaskDiagnosis) -> Decision:
    probe, regret = run.measurements.capacity, run.learnt
    channels = run.measurements.channels
    evidence: dict[str, Any] = {
        "state_dim": run.spec.state_dim,
        "action_dim": run.spec.action_dim,
        "normalised_regret": regret,
        "unlearnt_channels": sum(c.normalised_regret >= THRESHOLDS["unlearnt"] for c in channels),
        "random_rewarded": run.measurements.on_policy.random_signal.rewarded,
    }
    better, no_better = (THRESHOLDS[name] * regret for name in ("probe_better", "probe_no_better"))
    if probe is None or probe.train_normalised_regret > better:
        return Decision("not_separated", evidence)
    evidence |= probe.model_dump(include={"states", "test_normalised_regret"})
    if probe.test_normalised_regret >= no_better:
        return Decision("too_few_states", evidence, probe.test_normalised_regret / regret)
    sufficient = probe.test_normalised_regret <= better
    return Decision("states_sufficient" if sufficient else "not_separated", evidence)


@_why(
    yes="episodes_cut_short",
    no="episodes_long_enough no_survival_threshold",
    thresholds="termination_rate short_episode",
)
def _survival(run: TaskDiagnosis) -> Decision:
    spec, episodes = run.spec, run.measurements.on_policy
    often = episodes.termination_rate >= THRESHOLDS["termination_rate"]
    early = episodes.mean_length <= THRESHOLDS["short_episode"] * spec.horizon
    evidence = {
        "D": spec.D,
        "effective_D": max(spec.D, spec.r_min),
        "horizon": spec.horizon,
        **episodes.model_dump(include={"termination_rate", "mean_length", "coverage"}),
    }
    return Decision("no_survival_threshold" if spec.D == 0 else often and early, evidence)


@_why(
    yes="still_improving",
    no="regressed plateaued",
    unclear="no_training_log log_too_short never_improved",
    thresholds="log_rows regressed still_improving",
)
def _budget(run: TaskDiagnosis) -> Decision:
    log = run.measurements.training
    if log is None:
        return Decision("no_training_log", {})
    if log.rows < THRESHOLDS["log_rows"]:
        reason = "log_too_short"
    elif log.last_regret - log.best_regret >= THRESHOLDS["regressed"]:
        reason = "regressed"
    elif log.recent_improvement >= THRESHOLDS["still_improving"]:
        reason = "still_improving"
    else:
        reason = "never_improved" if log.improvement_step is None else "plateaued"
    fields = {"source", "rows", "steps", "best_regret", "best_step", "last_regret"}
    return Decision(reason, log.model_dump(include=fields | {"recent_improvement"}))


@_why(
    yes="explains_regret",
    no="explains_little not_within_limits",
    thresholds="rarely_violating price_share",
    needs="limits",
)
def _price_of_safety(run: TaskDiagnosis, limits: Violations) -> Decision:
    regret = run.measurements.policy.regret
    price = limits.report.regions[0].price_of_safety
    violating = max(limits.report.regions[0].violating_share, limits.visited.violating_share)
    evidence = {"price_of_safety": price, "regret": regret, "violating_share": violating}
    if violating >= THRESHOLDS["rarely_violating"]:
        return Decision("not_within_limits", evidence)
    explains = price >= THRESHOLDS["price_share"] * regret
    return Decision(explains, evidence, price / max(regret, TINY))


@_why(
    yes="distracted",
    no="hardly_distracted invariant",
    thresholds="owed_to_distractors invariant",
    needs="distraction observation",
)
def _distraction(
    run: TaskDiagnosis, effect: DistractorRegret, observation: ObservationReport
) -> Decision:
    sensitivity = observation.sensitivity[0].sensitivity
    reason = "invariant" if sensitivity <= THRESHOLDS["invariant"] else "hardly_distracted"
    if effect.owed_regret >= THRESHOLDS["owed_to_distractors"]:
        reason = "distracted"
    evidence = {
        "distractors": run.spec.distractors,
        "sensitivity": sensitivity,
        **effect.model_dump(exclude={"states", "distractor_draws"}),
    }
    return Decision(reason, evidence, effect.owed_regret / max(run.learnt, TINY))


def _without_ranking(report: CriticReport) -> Decision:
    return Decision("critic_of_states" if report.kind == "V" else "rewards_alike", {})


@_critic(
    yes="critic_ahead_of_actor",
    no="actor_follows critic_ranks_badly critic_between",
    unclear="critic_of_states rewards_alike",
    thresholds="ranks_well ranks_badly actor_lags",
)
def _critic_ranking(run: TaskDiagnosis, report: CriticReport) -> Decision:
    ranking = report.region(VISITED).ranking
    if ranking is None:
        return _without_ranking(report)
    evidence = {"ranking": ranking, "normalised_regret": run.learnt}
    if _badly(ranking):
        return Decision("critic_ranks_badly", evidence)
    if run.learnt < THRESHOLDS["actor_lags"]:
        return Decision("actor_follows", evidence)
    ahead = "critic_ahead_of_actor" if _well(ranking) else "critic_between"
    return Decision(ahead, evidence)


@_critic(
    yes="ranks_inside_only",
    no="ranks_alike",
    unclear="critic_of_states rewards_alike",
    thresholds="ranks_well ranks_badly",
)
def _critic_outside(_run: TaskDiagnosis, report: CriticReport) -> Decision:
    inside, outside = report.region("WD"), report.regions[-1]
    if inside.ranking is None or outside.ranking is None:
        return _without_ranking(report)
    evidence = {"wd": inside.ranking, "outside": outside.ranking, "region": outside.region}
    return Decision(_well(inside.ranking) and _badly(outside.ranking), evidence)


@_critic(
    yes="misled_by_discount",
    no="not_misled nothing_misleads",
    unclear="neither_learnt critic_of_states rewards_alike",
    thresholds="ranks_well ranks_badly",
)
def _discount(run: TaskDiagnosis, report: CriticReport) -> Decision:
    cube = report.region("WD")
    if cube.misled_ranking is None or cube.ranking is None:
        unshaped = run.spec.shaping is None
        return Decision("nothing_misleads", {}) if unshaped else _without_ranking(report)
    evidence = {**cube.model_dump(include={"ranking", "misled_ranking"}), "gamma": report.gamma}
    if _badly(cube.ranking) and not _well(cube.misled_ranking):
        return Decision("neither_learnt", evidence)
    return Decision(_badly(cube.ranking), evidence)


def _well(ranking: float) -> bool:
    return ranking >= THRESHOLDS["ranks_well"]


def _badly(ranking: float) -> bool:
    return ranking < THRESHOLDS["ranks_badly"]


@_critic(
    yes="level_immature",
    no="level_right",
    unclear="level_biased level_of_data",
    thresholds="level_bias maturity",
)
def _critic_level(_run: TaskDiagnosis, report: CriticReport) -> Decision:
    cube = report.region("WD")
    if cube.bias_share is None:
        return Decision("level_of_data", {})
    evidence = {
        **cube.model_dump(include={"claim", "finite", "continuing", "bias_share"}),
        "sweeps": report.sweeps,
        "gamma": report.gamma,
    }
    if abs(cube.bias_share) < THRESHOLDS["level_bias"]:
        return Decision("level_right", evidence)
    # A critic that starts at 0 has covered about 1 − exp(−(1 − γ) sweeps) of the way to its level.
    sweeps = float("inf") if report.sweeps is None else report.sweeps
    immature = (1 - report.gamma) * sweeps < THRESHOLDS["maturity"]
    return Decision("level_immature" if immature else "level_biased", evidence)

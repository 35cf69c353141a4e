"""Why the error is there: questions about training, of which a policy shows only traces.

The answer is "cannot tell" unless a number separates the causes.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.questions import (
    SAFETY_THRESHOLDS,
    THRESHOLDS,
    Decision,
    Question,
    TaskCase,
    add_to,
)
from sme_registry.diagnosis.where import distractors_of, limits_of

WHY: dict[str, Question[TaskCase]] = {}
"""Questions about training, in order."""
_question = partial(add_to, WHY, "why", is_cause=True)
_T = THRESHOLDS | SAFETY_THRESHOLDS

_DETERMINISTIC_SD = 1e-6


@_question(
    no_training_log="cannot tell",
    beat_constant_in_training="no",
    policy_beats_constant="no",
    rewards_too_rare="yes",
    rewards_found="cannot tell",
)
def _exploration(case: TaskCase) -> Decision:
    log, episodes = case.measurements.training, case.measurements.on_policy
    rewarded = episodes.random_signal.rewarded
    regret = episodes.scores[POLICY].regret
    evidence: dict[str, Any] = {"random_rewarded": rewarded, **_exploration_sd(case)}
    if log is None:
        return Decision("no_training_log", evidence)
    cost = log.last_regret - regret
    reported = log.source == "episodes" and cost >= _T["exploration_cost"]
    evidence |= {
        "regret": regret,
        "exploration_cost": cost if reported else None,
        **log.model_dump(
            include={"source", "steps", "improvement_step", "constant_regret", "best_regret"}
        ),
    }
    if log.improvement_step is not None:
        return Decision("beat_constant_in_training", evidence)
    if regret < log.constant_regret - _T["constant_margin"]:
        return Decision("policy_beats_constant", evidence, ("constant_margin",))
    rare = rewarded < _T["rarely_rewarded"]
    return Decision("rewards_too_rare" if rare else "rewards_found", evidence, ("rarely_rewarded",))


def _exploration_sd(case: TaskCase) -> dict[str, Any]:
    sd = case.measurements.exploration_sd
    if sd is None:
        return {"exploration_sd": None}
    return {"exploration_sd": [min(sd), max(sd)], "explores": max(sd) >= _DETERMINISTIC_SD}


@_question(paid_every_step="no", delayed_payout="cannot tell")
def _credit_assignment(case: TaskCase) -> Decision:
    k, episodes = case.spec.k, case.measurements.on_policy
    if k == 1:
        return Decision("paid_every_step", {"k": k})
    evidence = {"k": k, "credit": episodes.credit, "random_credit": episodes.random_credit}
    return Decision("delayed_payout", evidence)


@_question(
    no_reward_threshold="no",
    rewards_gated="yes",
    rewards_frequent="no",
    effect_unknown="cannot tell",
)
def _sparsity(case: TaskCase) -> Decision:
    r_min, episodes, log = case.spec.r_min, case.measurements.on_policy, case.measurements.training
    signal, random = episodes.signal, episodes.random_signal
    evidence = {
        "r_min": r_min,
        **signal.model_dump(),
        **{f"random_{name}": value for name, value in random.model_dump().items()},
        "unrewarded_episodes": None if log is None else log.unrewarded,
    }
    if r_min == 0:
        return Decision("no_reward_threshold", evidence)
    gated = signal.gated >= _T["gated_share"]
    if gated and signal.rewarded <= _T["gated_rewarded_share"]:
        return Decision("rewards_gated", evidence, ("gated_share", "gated_rewarded_share"))
    if signal.gated + signal.flat < _T["rarely_unrewarded"]:
        return Decision("rewards_frequent", evidence, ("rarely_unrewarded",))
    return Decision("effect_unknown", evidence, ("gated_share", "gated_rewarded_share"))


@_question(
    not_probed="cannot tell",
    network_does_better="no",
    network_cannot_fit="yes",
    network_fits_training_states_only="no",
    probe_inconclusive="cannot tell",
)
def _capacity(case: TaskCase) -> Decision:
    probe, regret = case.measurements.capacity, case.learnt
    evidence: dict[str, Any] = {
        "complexity": case.spec.complexity,
        "nonlinear_variance": case.measurements.response.nonlinear_variance,
        "normalised_regret": regret,
    }
    if probe is None:
        return Decision("not_probed", evidence)
    evidence |= probe.model_dump(mode="json", exclude={"seconds"})
    better, no_better = _T["probe_better"] * regret, _T["probe_no_better"] * regret
    if probe.test_normalised_regret <= better:
        reason = "network_does_better"
    elif probe.train_normalised_regret >= no_better:
        reason = "network_cannot_fit"
    elif probe.train_normalised_regret <= better:
        reason = "network_fits_training_states_only"
    else:
        reason = "probe_inconclusive"
    share = probe.train_normalised_regret / regret
    return Decision(reason, evidence, ("probe_better", "probe_no_better"), share)


@_question(too_few_states="yes", states_sufficient="no", not_separated="cannot tell")
def _dimension(case: TaskCase) -> Decision:
    probe, regret = case.measurements.capacity, case.learnt
    channels = case.measurements.channels
    evidence: dict[str, Any] = {
        "state_dim": case.spec.state_dim,
        "action_dim": case.spec.action_dim,
        "normalised_regret": regret,
        "unlearnt_channels": sum(c.normalised_regret >= _T["unlearnt"] for c in channels),
        "random_rewarded": case.measurements.on_policy.random_signal.rewarded,
    }
    better, no_better = _T["probe_better"] * regret, _T["probe_no_better"] * regret
    if probe is not None and probe.train_normalised_regret <= better:
        evidence |= probe.model_dump(include={"states", "test_normalised_regret"})
        if probe.test_normalised_regret >= no_better:
            share = probe.test_normalised_regret / regret
            return Decision("too_few_states", evidence, ("probe_better", "probe_no_better"), share)
        if probe.test_normalised_regret <= better:
            return Decision("states_sufficient", evidence, ("probe_better",))
    return Decision("not_separated", evidence, ("unlearnt",))


@_question(episodes_cut_short="yes", episodes_long_enough="no", no_survival_threshold="no")
def _survival(case: TaskCase) -> Decision:
    spec, episodes, log = case.spec, case.measurements.on_policy, case.measurements.training
    if spec.D == 0:
        return Decision("no_survival_threshold", {"D": spec.D})
    rate, length = episodes.termination_rate, episodes.mean_length
    return Decision(
        rate >= _T["termination_rate"] and length <= _T["short_episode"] * spec.horizon,
        {
            "D": spec.D,
            "effective_D": max(spec.D, spec.r_min),
            "horizon": spec.horizon,
            "termination_rate": rate,
            "mean_length": length,
            "coverage": episodes.coverage,
            "training_termination_rate": None if log is None else log.termination_rate,
        },
        ("termination_rate", "short_episode"),
    )


@_question(
    no_training_log="cannot tell",
    log_too_short="cannot tell",
    regressed="no",
    still_improving="yes",
    never_improved="cannot tell",
    plateaued="no",
)
def _budget(case: TaskCase) -> Decision:
    log = case.measurements.training
    if log is None:
        return Decision("no_training_log", {})
    evidence = log.model_dump(
        include={
            "source",
            "rows",
            "steps",
            "best_regret",
            "best_step",
            "last_regret",
            "recent_improvement",
        }
    )
    if log.rows < _T["log_rows"]:
        return Decision("log_too_short", evidence, ("log_rows",))
    if log.last_regret - log.best_regret >= _T["regressed"]:
        return Decision("regressed", evidence, ("regressed",))
    if log.recent_improvement >= _T["still_improving"]:
        reason = "still_improving"
    else:
        reason = "never_improved" if log.improvement_step is None else "plateaued"
    return Decision(reason, evidence, ("still_improving",))


@_question(needs="limits", explains_regret="yes", explains_little="no", not_within_limits="no")
def _price_of_safety(case: TaskCase) -> Decision:
    limits, regret = limits_of(case), case.measurements.policy.regret
    inside = limits.report.regions[0]
    share = max(inside.violating_share, limits.visited.violating_share)
    evidence = {
        "price_of_safety": inside.price_of_safety,
        "regret": regret,
        "violating_share": share,
    }
    if share >= _T["rarely_violating"]:
        return Decision("not_within_limits", evidence, ("rarely_violating",))
    explained = inside.price_of_safety >= _T["price_share"] * regret
    share = inside.price_of_safety / max(regret, 1e-9)
    return Decision(explained, evidence, ("price_share",), share)


@_question(needs="distraction", distracted="yes", hardly_distracted="no", invariant="no")
def _distraction(case: TaskCase) -> Decision:
    effect, observation = distractors_of(case)
    invariance = observation.invariance[0].invariance
    if effect.owed_regret >= _T["owed_to_distractors"]:
        reason = "distracted"
    else:
        reason = "invariant" if invariance <= _T["invariant"] else "hardly_distracted"
    return Decision(
        reason,
        {
            "distractors": case.spec.distractors,
            "invariance": invariance,
            **effect.model_dump(exclude={"states", "distractor_draws"}),
        },
        ("owed_to_distractors", "invariant"),
        effect.owed_regret / max(case.learnt, 1e-9),
    )

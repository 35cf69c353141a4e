"""The questions about a critic: does the actor follow it, where does it rank, is its level due?"""

from __future__ import annotations

from functools import partial

from sme_registry.diagnosis.critics import VISITED, CriticReport
from sme_registry.diagnosis.document import TaskDiagnosis
from sme_registry.diagnosis.questions import THRESHOLDS, Decision, Questions, add_to

CRITIC: Questions = {}
"""Asked where the policy's model has a critic that can be read."""
_about = partial(add_to, CRITIC, "why", needs="critic")


def _without_ranking(report: CriticReport) -> Decision:
    return Decision("critic_of_states" if report.kind == "V" else "rewards_alike", {})


@_about(
    yes="critic_ahead_of_actor",
    no="actor_follows critic_ranks_badly critic_between critic_of_states",
    unclear="rewards_alike",
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


@_about(
    yes="ranks_inside_only",
    no="ranks_alike critic_of_states",
    unclear="rewards_alike",
    thresholds="ranks_well ranks_badly",
)
def _critic_outside(_run: TaskDiagnosis, report: CriticReport) -> Decision:
    inside, outside = report.region("WD"), report.regions[-1]
    if inside.ranking is None or outside.ranking is None:
        return _without_ranking(report)
    evidence = {"wd": inside.ranking, "outside": outside.ranking, "region": outside.region}
    return Decision(_well(inside.ranking) and _badly(outside.ranking), evidence)


@_about(
    yes="misled_by_discount",
    no="not_misled nothing_misleads",
    unclear="neither_learnt",
    thresholds="ranks_well ranks_badly",
)
def _discount(_run: TaskDiagnosis, report: CriticReport) -> Decision:
    cube = report.region("WD")
    if cube.misled_ranking is None or cube.ranking is None:
        return Decision("nothing_misleads", {})
    evidence = {**cube.model_dump(include={"ranking", "misled_ranking"}), "gamma": report.gamma}
    if _badly(cube.ranking) and not _well(cube.misled_ranking):
        return Decision("neither_learnt", evidence)
    return Decision(_badly(cube.ranking), evidence)


def _well(ranking: float) -> bool:
    return ranking >= THRESHOLDS["ranks_well"]


def _badly(ranking: float) -> bool:
    return ranking < THRESHOLDS["ranks_badly"]


@_about(
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

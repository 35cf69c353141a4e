"""Questions about a life in a stream: which phases were costly, and what became of the network.

Against fresh agents of the phases, where these are known; else against the other visits. A single
life has one seed: another one could differ as much, and a study gives intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sme_registry.diagnosis.questions import THRESHOLDS, Outcome, Question, add_to
from sme_registry.diagnosis.stream_document import (
    NetworkState,
    PhaseDiagnosis,
    PhaseOutcome,
    VisitDiagnosis,
)
from sme_registry.spec import StreamSpec

__all__ = ["STREAM_QUESTIONS", "STREAM_THRESHOLDS", "StreamCase", "outcome_of"]

STREAM_THRESHOLDS = {
    **{name: THRESHOLDS[name] for name in ("unlearnt", "difference")},
    "fresh_excess": 0.05,  # of a visit's online regret beyond a fresh agent's
    "visit_excess": 0.1,  # of it beyond the mean of the other visits
    "visits_for_trend": 4.0,  # at least, without fresh agents
    "inactive_rise": 0.1,  # of the share of inactive units
    "inactive_share": 0.5,  # of the units, from the start
    "rank_ratio": 0.5,  # of the effective rank to what it is compared with, at most
    "weight_ratio": 2.0,  # of the weight norm to what it is compared with, at least
}
_T = STREAM_THRESHOLDS


class StreamCase(NamedTuple):
    """What the rules read."""

    stream: StreamSpec
    visits: Sequence[VisitDiagnosis]
    phases: Sequence[PhaseDiagnosis]
    forgetting: float | None


STREAM_QUESTIONS: dict[str, Question[StreamCase]] = {}
"""Questions about a life, in order."""
_where = partial(add_to, STREAM_QUESTIONS, "where")
_why = partial(add_to, STREAM_QUESTIONS, "why")


def outcome_of(best: float, final: float) -> PhaseOutcome:
    """What became of a phase."""
    if best >= _T["unlearnt"]:
        return "not_learnt"
    return "forgotten" if final - best >= _T["difference"] else "retained"


@_where(
    no_training_log="cannot tell",
    one_visit="cannot tell",
    costlier_than_fresh="yes",
    no_costlier_than_fresh="no",
    some_visits_stand_out="yes",
    visits_alike="no",
)
def _costly_visits(case: StreamCase) -> Outcome:
    """Whether regret during some visits was higher than elsewhere."""
    known = [visit for visit in case.visits if visit.online_regret is not None]
    if not known:
        return Outcome("no_training_log", {})
    fresh = [phase.fresh_online_regret for phase in case.phases]
    against_fresh = None not in fresh
    if not against_fresh and len(known) == 1:
        return Outcome("one_visit", {})
    total = max(sum(visit.dynamic_regret or 0.0 for visit in known), 1e-12)
    rows: list[dict[str, Any]] = [
        {
            "visit": visit.visit,
            "phase": visit.phase,
            "online_regret": visit.online_regret,
            "other": fresh[visit.phase] if against_fresh else _mean_of_others(visit, known),
            "share": (visit.dynamic_regret or 0.0) / total,
        }
        for visit in known
    ]
    threshold = "fresh_excess" if against_fresh else "visit_excess"
    rows.sort(key=lambda row: row["other"] - row["online_regret"])
    costly = [row for row in rows if row["online_regret"] - row["other"] >= _T[threshold]]
    if against_fresh:
        reason = "costlier_than_fresh" if costly else "no_costlier_than_fresh"
    else:
        reason = "some_visits_stand_out" if costly else "visits_alike"
    return Outcome(reason, {"visits": costly, "highest": rows[0]}, (threshold,))


def _mean_of_others(visit: VisitDiagnosis, visits: Sequence[VisitDiagnosis]) -> float:
    """Mean online regret over the steps of the other visits."""
    others = [each for each in visits if each is not visit]
    regrets = [each.online_regret or 0.0 for each in others]
    return float(np.average(regrets, weights=[each.steps for each in others]))


@_where(
    failed_as_fresh_agents="yes",
    failed_unlike_fresh_agents="yes",
    some_failed_unlike_fresh_agents="yes",
    visits_failed="yes",
    every_visit_learnt="no",
)
def _failure_to_learn(case: StreamCase) -> Outcome:
    """Whether some visits ended without having learnt their own phase."""
    failed: list[dict[str, Any]] = [
        {
            "visit": visit.visit,
            "phase": visit.phase,
            "normalised_regret": visit.normalised_regret,
            "fresh": case.phases[visit.phase].fresh_normalised_regret,
        }
        for visit in case.visits
        if visit.normalised_regret >= _T["unlearnt"]
    ]
    highest = max(visit.normalised_regret for visit in case.visits)
    evidence = {"failed": failed, "visits": len(case.visits), "highest": highest}
    if not failed:
        return Outcome("every_visit_learnt", evidence, ("unlearnt",))
    if None in [row["fresh"] for row in failed]:
        return Outcome("visits_failed", evidence, ("unlearnt",))
    unlike = [row["visit"] for row in failed if _is_unlike_fresh(row)]
    if not unlike:
        reason = "failed_as_fresh_agents"
    elif len(unlike) == len(failed):
        reason = "failed_unlike_fresh_agents"
    else:
        reason = "some_failed_unlike_fresh_agents"
    return Outcome(reason, {**evidence, "unlike_fresh": unlike}, ("unlearnt", "difference"))


def _is_unlike_fresh(failed: dict[str, Any]) -> bool:
    """Whether a visit failed because of the life before it, of which visit 0 has none."""
    gap = failed["normalised_regret"] - failed["fresh"]
    learns = failed["fresh"] < _T["unlearnt"] and gap >= _T["difference"]
    return failed["visit"] > 0 and bool(learns)


@_where(
    one_visit="cannot tell",
    nothing_to_forget="cannot tell",
    phases_forgotten="yes",
    phases_retained="no",
)
def _forgetting(case: StreamCase) -> Outcome:
    """Whether phases that were learnt are worse at the end of the life."""
    if len(case.visits) == 1:
        return Outcome("one_visit", {})
    recent = case.visits[-1].phase  # retained if only because it was just visited
    learnt = [
        phase
        for phase in case.phases
        if phase.outcome == "forgotten" or (phase.outcome == "retained" and phase.phase != recent)
    ]
    if not learnt:
        return Outcome("nothing_to_forget", {}, ("unlearnt",))
    learnt.sort(key=lambda phase: phase.best_normalised_regret - phase.final_normalised_regret)
    fields = {"phase", "best_normalised_regret", "final_normalised_regret"}
    rows = [(phase.model_dump(include=fields), phase.outcome) for phase in learnt]
    forgotten = [row for row, outcome in rows if outcome == "forgotten"]
    return Outcome(
        "phases_forgotten" if forgotten else "phases_retained",
        {"phases": forgotten, "most": rows[0][0], "forgetting": case.forgetting},
        ("difference",),
    )


@_why(
    one_visit="cannot tell",
    below_fresh_agents="yes",
    as_fresh_agents="no",
    fresh_agents_learnt_little="cannot tell",
    phases_differ="cannot tell",
    too_few_visits="cannot tell",
    nothing_learnt="cannot tell",
    later_visits_worse="yes",
    later_visits_as_good="no",
)
def _loss_of_plasticity(case: StreamCase) -> Outcome:
    """Whether later visits learn less than fresh agents, or than earlier visits."""
    visits = case.visits
    if len(visits) == 1:
        return Outcome("one_visit", {})
    learnt = [visit.normalised_regret for visit in visits]
    fresh = [phase.fresh_normalised_regret for phase in case.phases]
    alone = [each for each in fresh if each is not None]
    if len(alone) == len(fresh):
        return _against_fresh(visits, alone)
    if not _equally_hard(case.stream):
        return Outcome("phases_differ", {})
    if len(visits) < _T["visits_for_trend"]:
        return Outcome("too_few_visits", {"visits": len(visits)}, ("visits_for_trend",))
    half = len(visits) // 2
    early, late = float(np.mean(learnt[:half])), float(np.mean(learnt[-half:]))
    evidence = {"early": early, "late": late, "visits": half}
    if min(early, late) >= _T["unlearnt"]:
        return Outcome("nothing_learnt", evidence, ("unlearnt",))
    worse = late - early >= _T["difference"]
    reason = "later_visits_worse" if worse else "later_visits_as_good"
    return Outcome(reason, evidence, ("difference",))


def _against_fresh(visits: Sequence[VisitDiagnosis], fresh: Sequence[float]) -> Outcome:
    """The first visit is left out: its agent is itself a fresh one."""
    later = [(visit.normalised_regret, fresh[visit.phase]) for visit in visits[1:]]
    own, alone = (float(np.mean(each)) for each in zip(*later, strict=True))
    evidence = {
        "normalised_regret": own,
        "fresh_normalised_regret": alone,
        "plasticity_difference": own - alone,
        "visits": len(later),
    }
    if alone >= _T["unlearnt"]:
        return Outcome("fresh_agents_learnt_little", evidence, ("unlearnt",))
    below = own - alone >= _T["difference"]
    return Outcome("below_fresh_agents" if below else "as_fresh_agents", evidence, ("difference",))


def _equally_hard(stream: StreamSpec) -> bool:
    """Whether all phases have as many steps, and specs that differ in their draw or rotation."""
    return len(stream.kinds) == 1 and len({phase.steps for phase in stream.phases}) == 1


class _Change(NamedTuple):
    """A quantity of the network at the end of the life, and what it is compared with."""

    last: float
    other: float
    evidence: dict[str, Any]


def _change(case: StreamCase, quantity: Callable[[NetworkState], float]) -> _Change | Outcome:
    """The change against fresh agents' networks, else the first visit's; or why none is known."""
    first, last = case.visits[0].network, case.visits[-1].network
    fresh = [phase.fresh_network for phase in case.phases]
    alone = [each for each in fresh if each is not None]
    if first is None or last is None:
        return Outcome("network_unknown", {})
    against_fresh = len(alone) == len(fresh)
    if not against_fresh and len(case.visits) == 1:
        return Outcome("one_visit", {})
    other = float(np.mean([quantity(each) for each in alone] if against_fresh else quantity(first)))
    evidence = {
        "first": quantity(first),
        "last": quantity(last),
        "other": other,
        "against": "fresh_agents" if against_fresh else "first_visit",
    }
    return _Change(quantity(last), other, evidence)


@_why(
    network_unknown="cannot tell",
    one_visit="cannot tell",
    units_became_inactive="yes",
    inactive_from_the_start="yes",
    units_active="no",
)
def _dormant_units(case: StreamCase) -> Outcome:
    """Whether hidden units stopped responding to the state."""
    change = _change(case, lambda network: network.inactive_units)
    if isinstance(change, Outcome):
        return change
    network = case.visits[-1].network
    assert network is not None  # there is a change
    evidence = {
        **change.evidence,
        **network.model_dump(include={"dormant_units", "saturated_units"}),
    }
    if change.last - change.other >= _T["inactive_rise"]:
        return Outcome("units_became_inactive", evidence, ("inactive_rise",))
    many = min(change.last, change.other) >= _T["inactive_share"]
    reason = "inactive_from_the_start" if many else "units_active"
    return Outcome(reason, evidence, ("inactive_rise", "inactive_share"))


@_why(
    network_unknown="cannot tell",
    one_visit="cannot tell",
    rank_collapsed="yes",
    rank_kept="no",
)
def _rank_collapse(case: StreamCase) -> Outcome:
    """Whether the last hidden layer represents fewer directions."""
    change = _change(case, lambda network: network.effective_rank)
    if isinstance(change, Outcome):
        return change
    network = case.visits[-1].network
    assert network is not None
    collapsed = change.last <= _T["rank_ratio"] * change.other
    evidence = {**change.evidence, "units": network.hidden[-1]}
    return Outcome("rank_collapsed" if collapsed else "rank_kept", evidence, ("rank_ratio",))


@_why(
    network_unknown="cannot tell",
    one_visit="cannot tell",
    weights_grew="yes",
    weights_steady="no",
)
def _weight_growth(case: StreamCase) -> Outcome:
    """Whether weights became so large that steps of the optimiser change little."""
    change = _change(case, lambda network: network.weight_norm)
    if isinstance(change, Outcome):
        return change
    grew = change.last >= _T["weight_ratio"] * change.other
    reason = "weights_grew" if grew else "weights_steady"
    return Outcome(reason, change.evidence, ("weight_ratio",))

"""A life in a stream: which phases were costly, forgotten or never learnt, and what the network's
state says about a loss of plasticity.

Normalised regret is of the policy at the end of a visit, in the cube, on the task of a phase;
online regret is the mean of 1 − r over the steps of a visit. Both are compared with those of fresh
agents of the phases, where these are known; else with the other visits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from sme_registry.diagnosis import measure
from sme_registry.diagnosis.behaviour import NetworkState, network_state
from sme_registry.diagnosis.critics import ranking_in_cube
from sme_registry.diagnosis.document import Diagnosis, Part, cells, table
from sme_registry.diagnosis.questions import THRESHOLDS, TINY, Decision, Questions, add_to
from sme_registry.diagnosis.subject import StreamSubject
from sme_registry.evaluation import regions
from sme_registry.evaluation.models import load_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.spec import StreamSpec
from sme_registry.spec.document import Digest, Integer, Real, StrictModel, TupleOf
from sme_registry.task.loading import load_task
from sme_registry.task.task import Observation

_T = TypeVar("_T")
PhaseOutcome = Literal["retained", "forgotten", "not_learnt"]


class VisitDiagnosis(StrictModel):
    visit: Integer  # its number, from 0
    phase: Integer  # the index of its phase
    lifetime: Integer  # environment steps at its end
    steps: Integer  # that it lasts
    dynamic_regret: Real | None  # of its steps in the log; None without one
    online_regret: Real | None  # its mean; None without a log, and where no step was counted
    normalised_regret: Real  # at its end, on its own phase
    network: NetworkState | None  # at its end; None if unknown
    # share of pairs of actions that the critic at its end orders as the phase rewards them
    critic_ranking: Real | None = None


class PhaseDiagnosis(StrictModel):
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


class StreamDiagnosis(Diagnosis):
    """The diagnosis of a life in a stream, by visit and by phase."""

    documents = ("stream",)
    stream: StreamSpec
    stream_digest: Digest
    average_performance: Real  # at the end of the life
    # fall of performance below its best, at the end of the life; null where it is not defined
    forgetting: Real | None
    dynamic_regret: Real | None  # sum over the steps of the log; null without one
    visits: TupleOf[VisitDiagnosis]
    phases: TupleOf[PhaseDiagnosis]
    initial_network: NetworkState | None  # before training; null if unknown

    @property
    def learnt(self) -> float:
        """The lowest normalised regret of a visit on its own phase."""
        return min(visit.normalised_regret for visit in self.visits)

    @property
    def solved(self) -> bool:
        """Never: a life whose best visit was perfect can have lost that."""
        return False

    def fresh(self, quantity: str) -> list[Any]:
        """A quantity of each phase's fresh agent; empty unless all of them are known."""
        values = [getattr(phase, f"fresh_{quantity}") for phase in self.phases]
        return [] if None in values else values

    def tables(self) -> Iterator[Part]:
        """What a visit cost, what was known and the network at its end; what became of phases."""
        fields = "phase online_regret normalised_regret"
        visits = [
            (
                str(visit.visit),
                *cells(visit, fields),
                *cells(visit.network, _NETWORK),
                *cells(visit, "critic_ranking"),
            )
            for visit in self.visits
        ]
        if self.initial_network is not None:
            visits.insert(0, ("initial", "", "", "", *cells(self.initial_network, _NETWORK), ""))
        columns = ("visit", "phase", "online regret", "N", "inactive", "rank", "weights", "critic")
        yield Part("Visits", columns, visits)
        rows = {str(phase.phase): phase for phase in self.phases}
        fields = (
            "outcome best_normalised_regret final_normalised_regret fresh_normalised_regret "
            "fresh_online_regret"
        )
        yield table("Phases", "phase", rows, fields, *_LEGEND)


_NETWORK = "inactive_units effective_rank weight_norm"
_LEGEND = (
    "N: normalised regret at the end of the visit on its own phase, or of the life on each phase · "
    "online regret: mean of 1 − r over the visit · inactive: hidden units that are dormant or "
    "saturated · rank: effective rank of the last hidden layer · critic: share of pairs of actions "
    "that it orders as the phase rewards them, ½ is chance",
    "Dormant units, effective rank and weights go together with lost plasticity in the literature; "
    "none of them proves it. A study gives intervals over seeds.",
)

STREAM_QUESTIONS: Questions = {}
"""Questions about a life, in order."""
_where = partial(add_to, STREAM_QUESTIONS, "where")
_why = partial(add_to, STREAM_QUESTIONS, "why", is_cause=True)


def outcome_of(best: float, final: float) -> PhaseOutcome:
    if best >= THRESHOLDS["unlearnt"]:
        return "not_learnt"
    return "forgotten" if final - best >= THRESHOLDS["difference"] else "retained"


@_where(
    yes="costlier_than_fresh some_visits_stand_out",
    no="no_costlier_than_fresh visits_alike",
    unclear="no_training_log one_visit",
    thresholds="fresh_excess visit_excess",
)
def _costly_visits(life: StreamDiagnosis) -> Decision:
    """Whether regret during some visits was higher than elsewhere."""
    known = [visit for visit in life.visits if visit.online_regret is not None]
    if not known:
        return Decision("no_training_log", {})
    fresh = life.fresh("online_regret")
    if not fresh and len(known) == 1:
        return Decision("one_visit", {})
    total = max(sum(visit.dynamic_regret or 0.0 for visit in known), TINY)
    rows: list[dict[str, Any]] = [
        {
            **visit.model_dump(include={"visit", "phase", "online_regret"}),
            "other": fresh[visit.phase] if fresh else _mean_of_others(visit, known),
            "share": (visit.dynamic_regret or 0.0) / total,
        }
        for visit in known
    ]
    rows.sort(key=lambda row: row["other"] - row["online_regret"])
    excess = THRESHOLDS["fresh_excess" if fresh else "visit_excess"]
    costly = [row for row in rows if row["online_regret"] - row["other"] >= excess]
    if fresh:
        reason = "costlier_than_fresh" if costly else "no_costlier_than_fresh"
    else:
        reason = "some_visits_stand_out" if costly else "visits_alike"
    evidence = {"visits": costly, "highest": rows[0]}
    return Decision(reason, evidence, sum(row["share"] for row in costly))


def _mean_of_others(visit: VisitDiagnosis, visits: Sequence[VisitDiagnosis]) -> float:
    """Mean online regret over the steps of the other visits."""
    others = [other for other in visits if other is not visit]
    regrets = [other.online_regret or 0.0 for other in others]
    return float(np.average(regrets, weights=[other.steps for other in others]))


@_where(
    yes="failed_as_fresh_agents failed_unlike_fresh_agents some_failed_unlike_fresh_agents "
    "visits_failed",
    no="every_visit_learnt",
    thresholds="unlearnt difference",
)
def _failure_to_learn(life: StreamDiagnosis) -> Decision:
    """Whether some visits ended without having learnt their own phase."""
    failed: list[dict[str, Any]] = [
        {
            **visit.model_dump(include={"visit", "phase", "normalised_regret"}),
            "fresh": life.phases[visit.phase].fresh_normalised_regret,
        }
        for visit in life.visits
        if visit.normalised_regret >= THRESHOLDS["unlearnt"]
    ]
    highest = max(visit.normalised_regret for visit in life.visits)
    evidence = {"failed": failed, "visits": len(life.visits), "highest": highest}
    if not failed:
        return Decision("every_visit_learnt", evidence)
    if None in [row["fresh"] for row in failed]:
        return Decision("visits_failed", evidence)
    unlike = [row["visit"] for row in failed if _is_unlike_fresh(row)]
    if not unlike:
        reason = "failed_as_fresh_agents"
    elif len(unlike) == len(failed):
        reason = "failed_unlike_fresh_agents"
    else:
        reason = "some_failed_unlike_fresh_agents"
    return Decision(reason, {**evidence, "unlike_fresh": unlike})


def _is_unlike_fresh(failed: dict[str, Any]) -> bool:
    """Whether a visit failed because of the life before it, of which visit 0 has none."""
    gap = failed["normalised_regret"] - failed["fresh"]
    learns = failed["fresh"] < THRESHOLDS["unlearnt"] and gap >= THRESHOLDS["difference"]
    return failed["visit"] > 0 and bool(learns)


@_where(
    yes="phases_forgotten",
    no="phases_retained",
    unclear="one_visit nothing_to_forget",
    thresholds="unlearnt difference",
)
def _forgetting(life: StreamDiagnosis) -> Decision:
    """Whether phases that were learnt are worse at the end of the life."""
    if len(life.visits) == 1:
        return Decision("one_visit", {})
    recent = life.visits[-1].phase  # retained if only because it was just visited
    forgotten = [phase for phase in life.phases if phase.outcome == "forgotten"]
    retained = [p for p in life.phases if p.outcome == "retained" and p.phase != recent]
    if not forgotten and not retained:
        return Decision("nothing_to_forget", {})
    fields = {"phase", "best_normalised_regret", "final_normalised_regret"}
    forgotten.sort(key=lambda phase: phase.lost, reverse=True)
    most = max([*forgotten, *retained], key=lambda phase: phase.lost)
    evidence = {
        "phases": [phase.model_dump(include=fields) for phase in forgotten],
        "most": most.model_dump(include=fields),
        "forgetting": life.forgetting,
    }
    # The part of the error at the end of the life that was not there after each best visit.
    final = sum(phase.final_normalised_regret for phase in life.phases)
    lost = sum(phase.lost for phase in forgotten)
    return Decision(bool(forgotten), evidence, lost / max(final, TINY))


@_why(
    yes="below_fresh_agents later_visits_worse",
    no="as_fresh_agents later_visits_as_good",
    unclear="one_visit below_one_fresh_agent fresh_agents_learnt_little "
    "phases_differ too_few_visits nothing_learnt",
    thresholds="unlearnt difference visits_for_trend",
)
def _loss_of_plasticity(life: StreamDiagnosis) -> Decision:
    """Whether later visits learn less than fresh agents, or than earlier visits."""
    visits = life.visits
    if len(visits) == 1:
        return Decision("one_visit", {})
    learnt = [visit.normalised_regret for visit in visits]
    if fresh := life.fresh("normalised_regret"):
        return _against_fresh(visits, fresh)
    # Phases are equally hard if their specs differ in the draw or rotation, and not in the steps.
    if len(life.stream.kinds) > 1 or len({phase.steps for phase in life.stream.phases}) > 1:
        return Decision("phases_differ", {})
    if len(visits) < THRESHOLDS["visits_for_trend"]:
        return Decision("too_few_visits", {"visits": len(visits)})
    half = len(visits) // 2
    early, late = float(np.mean(learnt[:half])), float(np.mean(learnt[-half:]))
    evidence = {"early": early, "late": late, "visits": half}
    if min(early, late) >= THRESHOLDS["unlearnt"]:
        return Decision("nothing_learnt", evidence)
    worse = late - early >= THRESHOLDS["difference"]
    reason = "later_visits_worse" if worse else "later_visits_as_good"
    return Decision(reason, evidence, 1.0 - early / max(late, TINY))


def _against_fresh(visits: Sequence[VisitDiagnosis], fresh: Sequence[float]) -> Decision:
    """The first visit is left out: its agent is itself a fresh one."""
    later = [(visit.normalised_regret, fresh[visit.phase]) for visit in visits[1:]]
    life, alone = (float(np.mean(regrets)) for regrets in zip(*later, strict=True))
    evidence = {
        "normalised_regret": life,
        "fresh_normalised_regret": alone,
        "plasticity_difference": life - alone,
        "visits": len(later),
    }
    if alone >= THRESHOLDS["unlearnt"]:
        return Decision("fresh_agents_learnt_little", evidence)
    reason = "as_fresh_agents"
    if life - alone >= THRESHOLDS["difference"]:
        agents = len({visit.phase for visit in visits[1:]})
        reason = "below_fresh_agents" if agents > 1 else "below_one_fresh_agent"
    return Decision(reason, evidence, 1.0 - alone / max(life, TINY))


_network = partial(_why, unclear="network_unknown one_visit")


def _compared(
    life: StreamDiagnosis, quantity: str, reason_of: Callable[[float, float], str | bool]
) -> Decision:
    """The last network's quantity, compared with fresh agents' or with the first visit's."""
    first, last = life.visits[0].network, life.visits[-1].network
    if first is None or last is None:
        return Decision("network_unknown", {})
    alone = life.fresh("network")
    if not alone and len(life.visits) == 1:
        return Decision("one_visit", {})
    value = getattr(last, quantity)
    other = float(np.mean([getattr(network, quantity) for network in alone or [first]]))
    evidence = {
        "first": getattr(first, quantity),
        "last": value,
        "other": other,
        "against": "fresh_agents" if alone else "first_visit",
        "units": last.hidden[-1],
        **last.model_dump(include={"dormant_units", "saturated_units"}),
    }
    return Decision(reason_of(value, other), evidence)


@_network(
    yes="units_became_inactive inactive_from_the_start",
    no="units_active",
    thresholds="inactive_rise inactive_share",
)
def _dormant_units(life: StreamDiagnosis) -> Decision:
    """Whether hidden units stopped responding to the state."""

    def reason_of(value: float, other: float) -> str:
        if value - other >= THRESHOLDS["inactive_rise"]:
            return "units_became_inactive"
        many = min(value, other) >= THRESHOLDS["inactive_share"]
        return "inactive_from_the_start" if many else "units_active"

    return _compared(life, "inactive_units", reason_of)


@_network(yes="rank_collapsed", no="rank_kept", thresholds="rank_ratio")
def _rank_collapse(life: StreamDiagnosis) -> Decision:
    """Whether the last hidden layer represents fewer directions."""
    most = THRESHOLDS["rank_ratio"]
    return _compared(life, "effective_rank", lambda value, other: value <= most * other)


@_network(yes="weights_grew", no="weights_steady", thresholds="weight_ratio")
def _weight_growth(life: StreamDiagnosis) -> Decision:
    """Whether weights became so large that steps of the optimiser change little."""
    least = THRESHOLDS["weight_ratio"]
    return _compared(life, "weight_norm", lambda value, other: value >= least * other)


_MOST_STATES = 2048  # in which networks are measured; more would not change the numbers
_RANKED_STATES = 500  # in which a critic's actions are ranked


def diagnose_stream(
    subject: StreamSubject, states: int, seed: int, report: Callable[[str], None]
) -> StreamDiagnosis:
    """The arguments and errors are those of `diagnose`."""
    life = subject.report
    agent, regret = life.region("WD").agent, life.dynamic_regret
    report(f"{subject.name}: networks and critics")
    spec = life.stream.phases[0].spec
    drawn = measure.states_of(spec, min(states, _MOST_STATES, regions.batch_rows(spec)), seed)
    observation = drawn.observation(drawn.s, spec.horizon)
    diagnosis = StreamDiagnosis.about(
        subject,
        average_performance=agent.average_performance[-1],
        forgetting=agent.forgetting[-1],
        dynamic_regret=None if regret is None else regret.dynamic_regret,
        visits=tuple(_visits(subject, observation, min(states, _RANKED_STATES), seed)),
        phases=tuple(_phases(subject, observation)),
        initial_network=_state(subject.initial_network, observation, life.stream, 0),
    )
    return diagnosis.judged(STREAM_QUESTIONS)


def _state(
    network: Perceptron | None, observation: Observation, stream: StreamSpec, phase: int
) -> NetworkState | None:
    """The state of a network in a phase, where the agent observes that; None of an unknown one."""
    if network is None:
        return None
    if stream.observes_phase:
        one_hot = np.zeros((len(observation), stream.observed_phases), np.float32)
        one_hot[:, phase] = 1.0
        observation = np.concatenate([observation, one_hot], axis=1)
    return network_state(network, observation)


def _ranking(
    model: Path | None, stream: StreamSpec, phase: int, states: int, seed: int
) -> float | None:
    """Of the critic of a model that was kept, on the task of a phase."""
    if model is None or not model.exists():
        return None
    task = load_task(stream.phases[phase].spec)
    return ranking_in_cube(load_sb3(model), task, states, seed)


def _at(values: Sequence[_T] | None, index: int) -> _T | None:
    """One of the values; None where they are not known."""
    return values[index] if values else None


def _visits(
    subject: StreamSubject, observation: Observation, ranked: int, seed: int
) -> Iterator[VisitDiagnosis]:
    life, regret = subject.report, subject.report.dynamic_regret
    regret_on = life.region("WD").agent.normalised_regret
    logged = {} if regret is None else {visit.visit: visit for visit in regret.visits}
    for v, visit in enumerate(life.visits):
        log, network = logged.get(v), _at(subject.networks, v)
        yield VisitDiagnosis(
            visit=v,
            phase=visit.phase,
            lifetime=visit.lifetime,
            steps=life.stream.phases[visit.phase].steps,
            dynamic_regret=None if log is None else log.dynamic_regret,
            online_regret=None if log is None else log.online_regret,
            normalised_regret=regret_on[v][visit.phase],
            network=_state(network, observation, life.stream, visit.phase),
            critic_ranking=_ranking(_at(subject.models, v), life.stream, visit.phase, ranked, seed),
        )


def _phases(subject: StreamSubject, observation: Observation) -> Iterator[PhaseDiagnosis]:
    life = subject.report
    agent, regret = life.region("WD").agent, life.dynamic_regret
    M, P = np.array(agent.normalised_regret), len(life.stream.phases)
    online = None if regret is None else regret.fresh_online_regret
    for phase in range(P):
        best, final = float(M[phase::P, phase].min()), float(M[-1, phase])
        network = _at(subject.fresh_networks, phase)
        yield PhaseDiagnosis(
            phase=phase,
            outcome=outcome_of(best, final),
            best_normalised_regret=best,
            final_normalised_regret=final,
            initial_normalised_regret=_at(agent.initial_normalised_regret, phase),
            fresh_normalised_regret=_at(agent.fresh_normalised_regret, phase),
            fresh_online_regret=_at(online, phase),
            fresh_network=None if network is None else network_state(network, observation),
        )

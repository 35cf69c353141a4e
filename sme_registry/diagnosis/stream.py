"""`diagnose_stream`: a life in a stream to a `StreamDiagnosis`.

The life's report says what the agent retained and what each visit cost; here the networks are
measured, and the questions answered. All states are uniform in the cube.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from sme_registry.diagnosis.hidden_layers import network_state
from sme_registry.diagnosis.questions import answer_all
from sme_registry.diagnosis.stream_document import (
    NetworkState,
    PhaseDiagnosis,
    StreamDiagnosis,
    VisitDiagnosis,
)
from sme_registry.diagnosis.stream_questions import (
    STREAM_QUESTIONS,
    STREAM_THRESHOLDS,
    StreamCase,
    outcome_of,
)
from sme_registry.diagnosis.stream_subject import StreamSubject
from sme_registry.evaluation import regions
from sme_registry.evaluation.networks import Perceptron
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol, StreamSpec

__all__ = ["diagnose_stream"]

_MOST_STATES = 2048  # in which networks are measured; more would not change the numbers


def diagnose_stream(
    subject: StreamSubject, states: int, seed: int, report: Callable[[str], None]
) -> StreamDiagnosis:
    """Measure the networks of a life, and answer every question about it.

    The arguments and errors are those of `diagnose`.
    """
    life = subject.report
    stream, agent = life.stream, life.region("WD").agent
    report(f"{subject.name}: networks")
    measured_in = _States(stream, states, seed)
    visits = tuple(_visits(subject, measured_in))
    phases = tuple(_phases(subject, measured_in))
    case = StreamCase(stream, visits, phases, agent.forgetting[-1])
    regret = life.dynamic_regret
    return StreamDiagnosis(
        name=subject.name,
        stream=stream,
        stream_digest=life.stream_digest,
        task=life.name,
        plan=subject.plan,
        average_performance=agent.average_performance[-1],
        forgetting=agent.forgetting[-1],
        dynamic_regret=None if regret is None else regret.dynamic_regret,
        verdicts=answer_all(STREAM_QUESTIONS, case, STREAM_THRESHOLDS),
        visits=visits,
        phases=phases,
        initial_network=measured_in.of(subject.initial_network, 0),
        thresholds=STREAM_THRESHOLDS,
        versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
    )


class _States:
    """The states in which networks are measured, the same for all of them."""

    def __init__(self, stream: StreamSpec, states: int, seed: int) -> None:
        self._stream = stream
        spec = stream.phases[0].spec
        count = min(states, _MOST_STATES, regions.batch_rows(spec))
        protocol = EvaluationProtocol(states_per_region=count, seed=seed)
        (drawn,) = regions.states(protocol, 0, spec, rows=count)
        self._observation = drawn.observation(drawn.s, spec.horizon)

    def of(self, network: Perceptron | None, phase: int | None) -> NetworkState | None:
        """The state of a network; None of an unknown one."""
        if network is None:
            return None
        if phase is None or not self._stream.observes_phase:
            return network_state(network, self._observation)
        shown = np.zeros((len(self._observation), self._stream.observed_phases), np.float32)
        shown[:, phase] = 1.0
        return network_state(network, np.concatenate([self._observation, shown], axis=1))


def _visits(subject: StreamSubject, states: _States) -> Iterator[VisitDiagnosis]:
    life = subject.report
    regret_on = life.region("WD").agent.normalised_regret
    regret = life.dynamic_regret
    logged = {} if regret is None else {each.visit: each for each in regret.visits}
    begin = 0
    for visit in life.visits:
        log = logged.get(visit.visit)
        network = None if subject.networks is None else subject.networks[visit.visit]
        yield VisitDiagnosis(
            visit=visit.visit,
            phase=visit.phase,
            lifetime=visit.lifetime,
            steps=visit.lifetime - begin,
            dynamic_regret=None if log is None else log.dynamic_regret,
            online_regret=None if log is None else log.online_regret,
            normalised_regret=regret_on[visit.visit][visit.phase],
            network=states.of(network, visit.phase),
        )
        begin = visit.lifetime


def _phases(subject: StreamSubject, states: _States) -> Iterator[PhaseDiagnosis]:
    life = subject.report
    agent, regret = life.region("WD").agent, life.dynamic_regret
    M = np.array(agent.normalised_regret)
    fresh_regret = None if regret is None else regret.fresh_online_regret
    initial, fresh = agent.initial_normalised_regret, agent.fresh_normalised_regret
    P = len(life.stream.phases)
    for phase in range(P):
        best, final = float(M[phase::P, phase].min()), float(M[-1, phase])
        network = None if subject.fresh_networks is None else subject.fresh_networks[phase]
        yield PhaseDiagnosis(
            phase=phase,
            outcome=outcome_of(best, final),
            best_normalised_regret=best,
            final_normalised_regret=final,
            initial_normalised_regret=None if initial is None else initial[phase],
            fresh_normalised_regret=None if fresh is None else fresh[phase],
            fresh_online_regret=None if fresh_regret is None else fresh_regret[phase],
            fresh_network=states.of(network, None),
        )

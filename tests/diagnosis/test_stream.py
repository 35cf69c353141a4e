"""Diagnoses of lives in streams: known faults are found, in runs, in cells and by the command."""

import functools
import json
import random
import shutil

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec
from sme_registry.diagnosis import (
    Diagnosis,
    critic,
    diagnose,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.behaviour import NetworkState, network_state
from sme_registry.diagnosis.questions import DOUBTS
from sme_registry.diagnosis.stream import (
    STREAM_QUESTIONS,
    PhaseDiagnosis,
    StreamDiagnosis,
    VisitDiagnosis,
    outcome_of,
)
from sme_registry.errors import OptionError
from sme_registry.evaluation.networks import Perceptron
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies import run_study
from sme_registry.studies.subject import find_result, load_cell
from sme_registry.training import train
from tests.commands import good, refused
from tests.diagnosis.lives import (
    PROTOCOL,
    SPEC,
    STEPS,
    diagnosis_of,
    network,
    optima,
    report_of,
    stream_of,
    write_run,
)
from tests.diagnosis.policies import printed
from tests.geometry import assert_readable

SETTINGS = {"n_steps": 50, "batch_size": 50, "policy_kwargs": {"net_arch": [12, 8]}}
UNIFORM = np.random.default_rng(0).random((500, 5)).astype(np.float32)
TWO, THREE, CYCLES = stream_of(2), stream_of(3), stream_of(2, cycles=2)
FIRST, SECOND = optima(TWO)  # of phases 0 and 1 of each of them
HALF = "constant"


def phases_of(*specs, cycles=1, **fields):
    phases = [{"spec": spec, "steps": STEPS} for spec in specs]
    return StreamSpec(phases=phases, cycles=cycles, **fields)


def answer(diagnosis, question):
    verdict = diagnosis.verdict(question)
    return verdict.answer, verdict.reason


def answer_to(question, policies, stream, *regrets, **options):
    """The answer about a life with these policies at the ends of its visits."""
    return answer(diagnosis_of(report_of(policies, stream, *regrets, **options)), question)


# --- the network --------------------------------------------------------------------------------


def test_dead_and_stuck_units_are_counted():
    state = network_state(network(dead=5, stuck=3), UNIFORM)
    assert state.hidden == (20, 20)
    assert state.dormant_units == pytest.approx(5 / 40)
    assert state.saturated_units == pytest.approx(3 / 40)
    assert state.inactive_units == pytest.approx(8 / 40)
    b = np.full(4, -1e3)
    dead = Perceptron([(np.ones((5, 4)), b, "relu"), (np.ones((4, 2)), np.zeros(2), "identity")])
    state = network_state(dead, UNIFORM)
    assert (state.dormant_units, state.effective_rank) == (1.0, 0)
    linear = Perceptron([(np.ones((5, 2)), np.zeros(2), "identity")])
    assert network_state(linear, UNIFORM) is None  # it has no hidden layer


def test_the_effective_rank_counts_directions_and_the_norm_all_weights():
    full, same = (network_state(network(same=each), UNIFORM) for each in (False, True))
    assert same.effective_rank == 1
    assert 3 <= full.effective_rank <= 20
    weights = [W for W, _, _ in network().layers]
    assert full.weight_norm == pytest.approx(np.sqrt(sum((W**2).sum() for W in weights)))
    # The rank of Kumar et al., of a layer of identity, whose singular values are known.
    σ = np.array([8.0, 1.0, 1e-3, 1e-3])
    left = np.linalg.qr(np.random.default_rng(0).normal(size=(50, 4)))[0] * σ
    identity = Perceptron(
        [(np.eye(4), np.zeros(4), "identity"), (np.ones((4, 2)), np.zeros(2), "identity")]
    )
    state = network_state(identity, left.astype(np.float32))
    assert state.effective_rank == 2  # 8 / 9.002 < 0.99 ≤ 9 / 9.002


# --- verdicts on known lives --------------------------------------------------------------------


def test_a_policy_that_is_overwritten_is_forgetting():
    found = diagnosis_of(report_of(optima(THREE), THREE, [0.3, 0.3, 0.3]))
    verdict = found.verdict("forgetting")
    assert (verdict.answer, verdict.reason) == ("yes", "phases_forgotten")
    assert [row["phase"] for row in verdict.evidence["phases"]] == [0, 1]
    assert [phase.outcome for phase in found.phases] == ["forgotten", "forgotten", "retained"]
    assert answer(found, "failure to learn") == ("no", "every_visit_learnt")
    assert found.forgetting == verdict.evidence["forgetting"]
    assert "Learnt and forgotten: 2 of 3 phases (0 and 1)." in found.headline()
    assert "learnt or not" not in found.headline()


def test_a_phase_that_was_never_learnt_is_a_failure_and_not_forgetting():
    stream = phases_of(SPEC, SPEC.derive(seed=2))
    found = diagnosis_of(report_of([FIRST, FIRST], stream))
    assert [phase.outcome for phase in found.phases] == ["retained", "not_learnt"]
    assert answer(found, "failure to learn") == ("yes", "visits_failed")
    assert answer(found, "forgetting") == ("no", "phases_retained")
    for life in ([HALF, HALF], [HALF, optima(stream)[1]]):
        expected = ("cannot tell", "nothing_to_forget")
        assert answer_to("forgetting", life, stream) == expected
    # A phase counts as learnt only after a visit of its own.
    found = diagnosis_of(report_of([HALF, FIRST, HALF, HALF], CYCLES))
    assert found.phases[0].outcome == "not_learnt"


@pytest.mark.parametrize(
    ("stream", "policies", "fresh", "reason"),
    [
        (TWO, [FIRST, HALF], [FIRST, SECOND], "failed_unlike_fresh_agents"),
        (TWO, [FIRST, HALF], [HALF, HALF], "failed_as_fresh_agents"),
        # Phase 0 is learnt by no agent, phase 1 by the fresh one alone.
        (CYCLES, [HALF] * 4, [HALF, SECOND], "some_failed_unlike_fresh_agents"),
        (CYCLES, [HALF, SECOND] * 2, [HALF, SECOND], "failed_as_fresh_agents"),
        (CYCLES, [FIRST, HALF] * 2, [HALF, SECOND], "failed_unlike_fresh_agents"),
        # Before the first visit there is no life, so that what it lacks is no fault of the life.
        (CYCLES, [HALF, SECOND, FIRST, SECOND], [FIRST, SECOND], "failed_as_fresh_agents"),
    ],
)
def test_fresh_agents_say_whether_the_life_or_the_task_is_the_cause_of_a_failure(
    stream, policies, fresh, reason
):
    found = diagnosis_of(report_of(policies, stream, fresh=fresh))
    verdict = found.verdict("failure to learn")
    assert verdict.reason == reason
    assert verdict.sentence()
    if fresh == [HALF, HALF]:
        assert found.verdict("loss of plasticity").reason == "fresh_agents_learnt_little"


def visit_of(visit, phase, regret, dynamic=None, online=None, network=None):
    return VisitDiagnosis(
        visit=visit, phase=phase, lifetime=(visit + 1) * STEPS, steps=STEPS, dynamic_regret=dynamic,
        online_regret=online, normalised_regret=regret, network=network,
    )  # fmt: skip


def phase_of(phase, best, final, fresh=None, online=None, network=None):
    return PhaseDiagnosis(
        phase=phase, outcome=outcome_of(best, final), best_normalised_regret=best,
        final_normalised_regret=final, initial_normalised_regret=None,
        fresh_normalised_regret=fresh, fresh_online_regret=online, fresh_network=network,
    )  # fmt: skip


@functools.cache
def plain_life():
    return diagnosis_of(report_of([HALF], stream_of(1)))


def life_of(stream, visits, phases, forgetting, updates=None):
    """The diagnosis of a life with these numbers."""
    fields = {
        "stream": stream, "visits": visits, "phases": phases, "forgetting": forgetting,
        "updates": updates,
    }  # fmt: skip
    return plain_life().model_copy(update=fields).judged(STREAM_QUESTIONS)


def test_a_failure_that_is_hardly_worse_than_a_fresh_agent_s_is_not_blamed_on_the_life():
    visits = [visit_of(v, v, regret) for v, regret in enumerate((0.5, 0.93))]
    phases = [phase_of(j, 0.5, 0.5, fresh) for j, fresh in enumerate((0.5, 0.89))]
    found = life_of(TWO, visits, phases, None)
    assert found.verdict("failure_to_learn").reason == "failed_as_fresh_agents"


def test_the_visit_whose_regret_stands_out_is_named():
    life, fresh = [FIRST, SECOND] * 2, [FIRST, SECOND]

    def verdict(*regrets, **options):
        report = report_of(life, CYCLES, *regrets, **options)
        return diagnosis_of(report).verdict("costly visits")

    one = verdict([0.3, 0.3, 0.3, 0.6])
    assert (one.answer, one.reason) == ("yes", "some_visits_stand_out")
    assert [row["visit"] for row in one.evidence["visits"]] == [3]
    assert one.evidence["highest"]["other"] == pytest.approx(0.3)
    assert one.evidence["highest"]["share"] == pytest.approx(0.4)
    alike = verdict([0.3, 0.32, 0.34, 0.36])
    assert (alike.answer, alike.reason) == ("no", "visits_alike")
    compared = verdict([0.3, 0.32, 0.34, 0.36], [0.29, 0.36], fresh=fresh)
    assert compared.reason == "costlier_than_fresh"
    assert [row["visit"] for row in compared.evidence["visits"]] == [2]
    assert verdict().answer == "cannot tell"


RELATED = phases_of(SPEC, SPEC.derive(rotation=0.5), cycles=2)
HARDER = phases_of(SPEC, SPEC.derive(complexity=3), cycles=2)


@pytest.mark.parametrize(
    ("stream", "policies", "fresh", "expected"),
    [
        (CYCLES, [FIRST, SECOND, HALF, HALF], None, ("yes", "later_visits_worse")),
        (CYCLES, [FIRST, SECOND] * 2, None, ("no", "later_visits_as_good")),
        (CYCLES, [FIRST, HALF] * 2, [FIRST, SECOND], ("yes", "below_fresh_agents")),
        (CYCLES, [HALF, SECOND, FIRST, SECOND], [FIRST, SECOND], ("no", "as_fresh_agents")),
        (TWO, [FIRST, HALF], [FIRST, SECOND], ("cannot tell", "below_one_fresh_agent")),
        # Without fresh agents a trend needs phases of equal difficulty.
        (HARDER, [HALF] * 4, None, ("cannot tell", "phases_differ")),
        (TWO, [HALF] * 2, None, ("cannot tell", "too_few_visits")),
        (RELATED, [HALF] * 4, None, ("cannot tell", "nothing_learnt")),
    ],
    ids=lambda value: value[1] if isinstance(value, tuple) else "",
)
def test_plasticity_is_lost_where_later_visits_learn_less(stream, policies, fresh, expected):
    options = {} if fresh is None else {"fresh": fresh}
    assert answer_to("loss of plasticity", policies, stream, **options) == expected


def test_a_network_that_decays_is_found_against_the_first_visit_and_fresh_agents():
    report = report_of(optima(TWO), TWO)
    decayed = (network(), network(dead=10, same=True, scale=2.5))
    found = diagnosis_of(report, decayed, initial_network=network())
    assert answer(found, "dormant units") == ("yes", "units_became_inactive")
    assert answer(found, "rank collapse") == ("yes", "rank_collapsed")
    assert answer(found, "weight growth") == ("yes", "weights_grew")
    assert found.initial_network == found.visits[0].network
    hasty = diagnosis_of(report, decayed, updates=19)
    assert answer(hasty, "dormant units") == ("cannot tell", "few_updates")
    against = diagnosis_of(report, decayed, fresh_networks=(decayed[1],) * 2)
    for question in ("dormant units", "rank collapse", "weight growth"):
        assert against.verdict(question).answer == "no"
        assert against.verdict(question).evidence["against"] == "fresh_agents"
    broken = diagnosis_of(report, (network(dead=20, stuck=10),) * 2)
    assert answer(broken, "dormant units") == ("yes", "inactive_from_the_start")


def test_a_life_of_one_visit_or_of_unknown_networks_cannot_be_compared():
    one = diagnosis_of(report_of([HALF], stream_of(1), [0.5]), (network(),))
    assert {v.reason for v in one.verdicts if v.answer == "cannot tell"} == {"one_visit"}
    unknown = diagnosis_of(report_of([HALF] * 2, TWO), (None, None))
    assert answer(unknown, "dormant units") == ("cannot tell", "network_unknown")


# --- words --------------------------------------------------------------------------------------


def random_life(generator):
    """A life of random numbers, with and without fresh agents, a log and networks."""
    P = generator.choice((1, 1, 2, 3))
    cycles = generator.choice((1, 2, 3))
    stream = stream_of(P, cycles)
    if P > 1 and generator.random() < 0.2:
        stream = StreamSpec(phases=[{"spec": SPEC, "steps": 10 * (i + 1)} for i in range(P)])
    V = stream.cycles * P
    log, fresh, networks = (generator.random() < 0.6 for _ in range(3))
    low, high = generator.choice(((0.2, 0.4), (0.0, 1.3), (0.9, 1.2)))

    def number(known=True):
        return generator.uniform(low, high) if known else None

    def state(known=True):
        if not (networks and known):
            return None
        dormant = generator.choice((0.05, 0.3, 0.6))
        return NetworkState(
            hidden=(8, 8), dormant_units=dormant, saturated_units=0.0,
            effective_rank=generator.choice((2, 7)), weight_norm=generator.choice((1.0, 9.0)),
        )  # fmt: skip

    visits, phases = [], []
    for v in range(V):
        online = generator.uniform(0.3, generator.choice((0.34, 0.9))) if log else None
        visits.append(visit_of(v, v % P, number(), 40.0 if log else None, online, state()))
    for j in range(P):
        online = generator.uniform(0.3, 0.7) if fresh and log else None
        phases.append(phase_of(j, number(), number(), number(fresh), online, state(fresh)))
    return life_of(stream, visits, phases, number(V > 1), generator.choice((None, 5, 30)))


def test_every_reason_is_reached_and_has_a_sentence():
    generator, reached = random.Random(0), set()
    for _ in range(300):
        for verdict in random_life(generator).verdicts:
            reason = verdict.evidence.get("own_reason", verdict.reason)
            reached.add((verdict.question, reason))
            assert (reason != verdict.reason) == (verdict.reason in DOUBTS)
            text = verdict.sentence()
            assert text.endswith("."), text
            assert not any(bad in text for bad in ("None", " ,", " .", " ;", "( ", "..")), text
    declared = {(name, each) for name, rule in STREAM_QUESTIONS.items() for each in rule.reasons}
    assert reached == declared


def test_long_lists_are_cut_in_sentences_and_whole_in_data():
    verdict = diagnosis_of(report_of([HALF] * 10, stream_of(2, 5))).verdict("failure to learn")
    assert len(verdict.evidence["failed"]) == 10
    assert "; and 6 more." in verdict.sentence()


def test_the_page_and_the_terminal_show_a_life_of_which_a_network_is_unknown():
    report = report_of(optima(THREE), THREE, [0.3, 0.4, 0.5], fresh=optima(THREE))
    found = diagnosis_of(report, (network(), network(), None))
    assert found.headline() in " ".join(" ".join(printed(found, 60, details=True)).split())
    page = found.markdown(details=True)
    assert all(verdict.sentence() in page for verdict in found.verdicts)


# --- runs, cells and the command ----------------------------------------------------------------

FIRST_LAYER = {
    "jax:PPO": "mlp_extractor.policy_net",
    "jax:TD3": "actor.mu",
    "jax:SAC": "actor.latent_pi",
}


@pytest.mark.parametrize("uses", FIRST_LAYER)
def test_the_networks_of_a_run_are_those_of_its_snapshots(tmp_path, uses):
    models = write_run(tmp_path, stream_of(2, observes_phase=uses == "jax:TD3"), uses)
    life = load_run(tmp_path)
    for own, model in zip((*life.networks, life.initial_network), models, strict=True):
        weights = dict(model.policy.named_parameters())[f"{FIRST_LAYER[uses]}.0.weight"]
        np.testing.assert_array_equal(own.layers[0][0], weights.detach().numpy().T)
    found = diagnose(life, states=64)
    assert [visit.network.hidden for visit in found.visits] == [(12, 8)] * 2
    rankings = [visit.critic_ranking for visit in found.visits]
    if uses == "jax:SAC":  # the critics of TD3 see the phase here, and PPO's are of states
        alone = critic(models[1], found.stream.phases[1].spec, states=64)
        assert rankings[1] == alone.region("WD").ranking
        assert all(0 < ranking < 1 for ranking in rankings)
    else:
        assert rankings == [None, None]
    assert found.plan["algorithm"] == uses.removeprefix("jax:")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short life of PPO, as `sme train` leaves it."""
    folder = tmp_path_factory.mktemp("runs") / "life"
    train(
        THREE, algorithm="PPO", hyperparameters=SETTINGS, folder=folder, protocol=PROTOCOL,
        progress=False,
    )  # fmt: skip
    return folder


def test_the_command_writes_a_page_its_data_and_its_figures(run, tmp_path, figures):
    pytest.importorskip("matplotlib")
    result = good("diagnose", run, "--states", "64", "--out", tmp_path / "d")
    assert "Phases" in result.stdout
    page = (tmp_path / "d" / "diagnosis.md").read_text()
    assert [path.stem for path in (tmp_path / "d").glob("*.png")] == ["network_by_visit"]
    assert "](network_by_visit.png)" in page
    for figure in set(figures):
        assert_readable(figure)
    read = Diagnosis.read(tmp_path / "d" / "diagnosis.json")
    assert isinstance(read, StreamDiagnosis)
    assert read.stream_digest == THREE.digest
    assert all(visit.online_regret is not None for visit in read.visits)
    assert read.visits[2].network != read.visits[0].network != read.initial_network
    shown = good("diagnose", run, "--states", "64", "--json")
    assert json.loads(shown.stdout) == read.to_dict()


def test_comparisons_and_probes_are_refused_for_lives(run):
    assert "on one task only" in refused("diagnose", run, "--probe-capacity")
    assert "on one task only" in refused("diagnose", run, "--against", run)
    with pytest.raises(OptionError, match="one task only"):
        diagnose(load_policy("constant", SMESpec()), against=load_run(run))


def test_a_life_that_has_not_ended_is_refused_and_one_without_its_networks_is_not(run, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(run, folder)
    (folder / "snapshots" / "visit-02.zip").unlink()
    found = json.loads(good("diagnose", folder, "--states", "64", "--json").stdout)
    assert [visit["network"] is None for visit in found["visits"]] == [False, False, True]
    (folder / "stream.json").unlink()
    assert "when it has ended" in refused("diagnose", folder)


def test_lives_of_a_study_are_diagnosed_with_their_fresh_agents(tmp_path):
    drifting = {"spec": SPEC, "steps": STEPS, "drift": {"rotation": 1.0, "increments": 2}}
    phases = [drifting, {"spec": SPEC, "steps": STEPS}]
    streams = StreamSpec(phases=phases, observes_phase=True), StreamSpec(phases=[drifting])
    plan = StudyPlan.from_dict(
        {
            "streams": [{"name": f"s{i}", "stream": s.to_dict()} for i, s in enumerate(streams)],
            "algorithms": [{"name": "PPO", "uses": "PPO", "hyperparameters": SETTINGS}],
            "seeds": 1,
            "evaluations": 0,
            "protocol": PROTOCOL,
        }
    )
    file = StudyFile(name="tiny", digest=plan.digest, plan=plan)
    run_study(file, tmp_path, executor="in-process", keep_models=True)
    two, one = (next(p.cell for p in plan.cells if p.cell.stream == s) for s in streams)
    result = good("diagnose", tmp_path, "--cell", two.digest, "--states", "64", "--json")
    found = StreamDiagnosis.from_dict(json.loads(result.stdout))
    assert all(visit.network is not None for visit in found.visits)
    assert all(phase.fresh_network is not None for phase in found.phases)
    alone = [find_result(tmp_path, agent.digest) for agent in two.fresh]
    assert [p.fresh_online_regret for p in found.phases] == [agent.online_regret for agent in alone]
    assert found.phases[1].fresh_normalised_regret == alone[1].report.wd_regret
    assert found.verdict("costly visits").reason.endswith("_than_fresh")
    # A life of one phase is a fresh agent itself, which is not compared with itself.
    (phase,) = diagnose(load_cell(tmp_path, one.digest), states=64).phases
    assert (phase.fresh_online_regret, phase.fresh_normalised_regret) == (None, None)
    assert phase.fresh_network is None

    shutil.rmtree(tmp_path / "models")
    agent = two.fresh[1].digest.removeprefix("sha256:")
    (tmp_path / "cells" / f"{agent}.json").write_text("{}")  # as if it had not finished
    life = load_cell(tmp_path, two.digest.removeprefix("sha256:")[:12])
    assert (life.networks, life.fresh_networks) == ((None, None), (None, None))
    assert life.report.region().agent.fresh_normalised_regret is None
    assert diagnose(life, states=64).verdict("dormant units").reason == "network_unknown"

"""Diagnoses of lives in streams: known faults are found, in runs, in cells and by the command."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec
from sme_registry.diagnosis import (
    StreamDiagnosis,
    StreamSubject,
    diagnose,
    load_cell,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.hidden_layers import network_state
from sme_registry.diagnosis.questions import answer_all
from sme_registry.diagnosis.stream_document import NetworkState, PhaseDiagnosis, VisitDiagnosis
from sme_registry.diagnosis.stream_questions import (
    STREAM_QUESTIONS,
    STREAM_THRESHOLDS,
    StreamCase,
    outcome_of,
)
from sme_registry.diagnosis.stream_render import headline, markdown, stream_sentence, terminal
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation import StreamReport, evaluate, fresh_per_phase
from sme_registry.evaluation.policies import Perceptron, saved_sb3
from sme_registry.spec import EvaluationProtocol, StudyFile, StudyPlan
from sme_registry.spec.study import Cell
from sme_registry.studies import run_study
from sme_registry.studies.engine.result import CellResult, LearningCurve, Timing
from sme_registry.training import train
from sme_registry.training.snapshots import Snapshots
from tests.commands import refused, sme
from tests.diagnosis.lives import (
    PROTOCOL,
    SPEC,
    STEPS,
    diagnosis_of,
    model_of,
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


def answer(diagnosis: StreamDiagnosis, question: str) -> tuple[str, str]:
    verdict = diagnosis.verdict(question)
    return verdict.answer, verdict.reason


# --- the network --------------------------------------------------------------------------------


def test_dead_and_stuck_units_are_counted() -> None:
    state = network_state(network(dead=5, stuck=3), UNIFORM)
    assert state is not None
    assert state.hidden == (20, 20)
    assert state.dormant_units == pytest.approx(5 / 40)
    assert state.saturated_units == pytest.approx(3 / 40)
    assert state.inactive_units == pytest.approx(8 / 40)


def test_a_layer_whose_outputs_are_all_0_is_dormant_and_has_rank_0() -> None:
    b = np.full(4, -1e3)
    dead = Perceptron([(np.ones((5, 4)), b, "relu"), (np.ones((4, 2)), np.zeros(2), "identity")])
    state = network_state(dead, UNIFORM)
    assert state is not None
    assert (state.dormant_units, state.effective_rank) == (1.0, 0)


def test_the_effective_rank_counts_directions_and_the_norm_all_weights() -> None:
    full, same = (network_state(network(same=each), UNIFORM) for each in (False, True))
    assert full is not None
    assert same is not None
    assert same.effective_rank == 1
    assert 3 <= full.effective_rank <= 20
    weights = [W for W, _, _ in network().layers]
    assert full.weight_norm == pytest.approx(np.sqrt(sum((W**2).sum() for W in weights)))


def test_the_effective_rank_is_that_of_kumar() -> None:
    """Of a layer of identity, whose singular values are known: 8, 1, 1e-3, 1e-3."""
    σ = np.array([8.0, 1.0, 1e-3, 1e-3])
    left = np.linalg.qr(np.random.default_rng(0).normal(size=(50, 4)))[0] * σ
    identity = Perceptron(
        [(np.eye(4), np.zeros(4), "identity"), (np.ones((4, 2)), np.zeros(2), "identity")]
    )
    state = network_state(identity, left.astype(np.float32))
    assert state is not None
    assert state.effective_rank == 2  # 8 / 9.002 < 0.99 ≤ 9 / 9.002


def test_a_linear_policy_has_no_hidden_layer() -> None:
    linear = Perceptron([(np.ones((5, 2)), np.zeros(2), "identity")])
    assert network_state(linear, UNIFORM) is None


# --- verdicts on known lives --------------------------------------------------------------------


def test_a_policy_that_is_overwritten_is_forgetting() -> None:
    stream = stream_of(3)
    found = diagnosis_of(report_of(optima(stream), stream, [0.3, 0.3, 0.3]))
    assert answer(found, "forgetting") == ("yes", "phases_forgotten")
    assert [row["phase"] for row in found.verdict("forgetting").evidence["phases"]] != [2]  # type: ignore[index, union-attr, call-overload]
    assert [phase.outcome for phase in found.phases] == ["forgotten", "forgotten", "retained"]
    assert answer(found, "failure to learn") == ("no", "every_visit_learnt")
    assert found.forgetting == found.verdict("forgetting").evidence["forgetting"]
    assert "Learnt and forgotten: 2 of 3 phases (0 and 1)." in headline(found)


def test_a_phase_that_was_never_learnt_is_a_failure_and_not_forgetting() -> None:
    specs = [SPEC, SPEC.derive(seed=2)]
    stream = StreamSpec(phases=[{"spec": spec, "steps": STEPS} for spec in specs])
    first = optima(stream)[0]
    found = diagnosis_of(report_of([first, first], stream))
    assert [phase.outcome for phase in found.phases] == ["retained", "not_learnt"]
    assert answer(found, "failure to learn") == ("yes", "visits_failed")
    assert answer(found, "forgetting") == ("no", "phases_retained")
    nothing = diagnosis_of(report_of(["constant"] * 2, stream))
    assert answer(nothing, "forgetting") == ("cannot tell", "nothing_to_forget")
    last = diagnosis_of(report_of(["constant", optima(stream)[1]], stream))
    assert answer(last, "forgetting") == ("cannot tell", "nothing_to_forget")


def test_a_phase_counts_as_learnt_only_after_a_visit_of_its_own() -> None:
    stream = stream_of(2, cycles=2)
    first = optima(stream)[0]
    found = diagnosis_of(report_of(["constant", first, "constant", "constant"], stream))
    assert found.phases[0].outcome == "not_learnt"


def test_fresh_agents_say_whether_the_life_or_the_task_is_the_cause_of_a_failure() -> None:
    stream = stream_of(2)
    policies = [optima(stream)[0], "constant"]
    unlike = report_of(policies, stream, fresh=optima(stream))
    alike = report_of(policies, stream, fresh=["constant", "constant"])
    question = "failure to learn"
    assert diagnosis_of(unlike).verdict(question).reason == "failed_unlike_fresh_agents"
    assert diagnosis_of(alike).verdict(question).reason == "failed_as_fresh_agents"
    assert answer(diagnosis_of(alike), "loss of plasticity")[1] == "fresh_agents_learnt_little"


def test_each_failed_visit_is_compared_with_the_fresh_agent_of_its_own_phase() -> None:
    stream = stream_of(2, cycles=2)
    first, second = optima(stream)
    question = "failure to learn"

    def reason(policies: list[Any], fresh: list[Any]) -> str:
        verdict = diagnosis_of(report_of(policies, stream, fresh=fresh)).verdict(question)
        assert stream_sentence(verdict)
        return verdict.reason

    # Phase 0 is learnt by no agent, phase 1 by the fresh one alone.
    assert reason(["constant"] * 4, ["constant", second]) == "some_failed_unlike_fresh_agents"
    assert reason(["constant", second] * 2, ["constant", second]) == "failed_as_fresh_agents"
    assert reason([first, "constant"] * 2, ["constant", second]) == "failed_unlike_fresh_agents"
    # Before the first visit there is no life, so that what it lacks is no fault of the life.
    assert reason(["constant", second, first, second], [first, second]) == "failed_as_fresh_agents"


def test_a_failure_that_is_hardly_worse_than_a_fresh_agent_s_is_not_blamed_on_the_life() -> None:
    case = StreamCase(
        stream_of(2),
        [
            VisitDiagnosis(
                visit=v, phase=v, lifetime=(v + 1) * STEPS, steps=STEPS, dynamic_regret=None,
                online_regret=None, normalised_regret=regret, network=None,
            )
            for v, regret in enumerate((0.5, 0.93))
        ],
        [
            PhaseDiagnosis(
                phase=j, outcome="retained", best_normalised_regret=0.5,
                final_normalised_regret=0.5, initial_normalised_regret=None,
                fresh_normalised_regret=fresh, fresh_online_regret=None, fresh_network=None,
            )
            for j, fresh in enumerate((0.5, 0.89))
        ],
        None,
    )  # fmt: skip
    (verdict,) = (
        each
        for each in answer_all(STREAM_QUESTIONS, case, STREAM_THRESHOLDS)
        if each.question == "failure_to_learn"
    )
    assert verdict.reason == "failed_as_fresh_agents"


def test_forgetting_of_a_phase_that_was_never_learnt_is_said_to_be_that() -> None:
    stream = stream_of(3)
    first, second, _ = optima(stream)

    def away(observations: Any) -> Any:  # good in phase 1, and worse in phase 0 than before
        best = second(observations)
        return np.clip(best + 0.15 * (best - first(observations)), 0.0, 1.0)

    found = diagnosis_of(report_of(["constant", second, away], stream))
    assert [phase.outcome for phase in found.phases] == ["not_learnt", "retained", "not_learnt"]
    assert found.forgetting is not None
    assert found.forgetting > 0.0
    assert answer(found, "forgetting") == ("no", "phases_retained")
    assert "(mean over earlier phases, learnt or not)" in headline(found)
    assert "earlier phases, learnt or not" in stream_sentence(found.verdict("forgetting"))
    learnt = diagnosis_of(report_of(optima(stream), stream))
    assert "learnt or not" not in headline(learnt)


def test_the_visit_whose_regret_stands_out_is_named() -> None:
    stream = stream_of(2, cycles=2)
    life = fresh_per_phase(stream, optima(stream))
    found = diagnosis_of(report_of(life, stream, [0.3, 0.3, 0.3, 0.6]))
    verdict = found.verdict("costly visits")
    assert (verdict.answer, verdict.reason) == ("yes", "some_visits_stand_out")
    assert [row["visit"] for row in verdict.evidence["visits"]] == [3]  # type: ignore[index, union-attr, call-overload]
    assert verdict.evidence["highest"]["other"] == pytest.approx(0.3)  # type: ignore[index, call-overload]
    assert verdict.evidence["highest"]["share"] == pytest.approx(0.4)  # type: ignore[index, call-overload]
    alike = diagnosis_of(report_of(life, stream, [0.3, 0.32, 0.34, 0.36]))
    assert answer(alike, "costly visits") == ("no", "visits_alike")
    fresh = optima(stream)
    paired = report_of(life, stream, [0.3, 0.32, 0.34, 0.36], [0.29, 0.36], fresh=fresh)
    compared = diagnosis_of(paired).verdict("costly visits")
    assert compared.reason == "costlier_than_fresh"
    assert [row["visit"] for row in compared.evidence["visits"]] == [2]  # type: ignore[index, union-attr, call-overload]
    assert diagnosis_of(report_of(life, stream)).verdict("costly visits").answer == "cannot tell"


def test_plasticity_is_lost_where_later_visits_learn_less() -> None:
    stream = stream_of(2, cycles=2)
    first, second = optima(stream)
    fading = report_of([first, second, "constant", "constant"], stream)
    assert answer(diagnosis_of(fading), "loss of plasticity") == ("yes", "later_visits_worse")
    steady = report_of([first, second] * 2, stream)
    assert answer(diagnosis_of(steady), "loss of plasticity") == ("no", "later_visits_as_good")
    fresh = {"fresh": [first, second]}
    below = report_of([first, "constant", first, "constant"], stream, **fresh)  # type: ignore[arg-type]
    assert answer(diagnosis_of(below), "loss of plasticity") == ("yes", "below_fresh_agents")
    as_good = report_of(["constant", second, first, second], stream, **fresh)  # type: ignore[arg-type]
    assert answer(diagnosis_of(as_good), "loss of plasticity") == ("no", "as_fresh_agents")


def test_without_fresh_agents_a_trend_needs_phases_of_equal_difficulty() -> None:
    specs = [SPEC, SPEC.derive(complexity=3)]
    harder = StreamSpec(phases=[{"spec": spec, "steps": STEPS} for spec in specs], cycles=2)
    found = diagnosis_of(report_of(["constant"] * 4, harder))
    assert answer(found, "loss of plasticity") == ("cannot tell", "phases_differ")
    few = diagnosis_of(report_of(["constant"] * 2, stream_of(2)))
    assert answer(few, "loss of plasticity") == ("cannot tell", "too_few_visits")
    rotated = [SPEC, SPEC.derive(rotation=0.5)]
    related = StreamSpec(phases=[{"spec": spec, "steps": STEPS} for spec in rotated], cycles=2)
    nothing = diagnosis_of(report_of(["constant"] * 4, related))
    assert answer(nothing, "loss of plasticity") == ("cannot tell", "nothing_learnt")


def test_a_network_that_decays_is_found_against_the_first_visit_and_fresh_agents() -> None:
    stream = stream_of(2)
    report = report_of(["constant"] * 2, stream)
    decayed = (network(), network(dead=10, same=True, scale=2.5))
    found = diagnosis_of(report, decayed, initial_network=network())
    assert answer(found, "dormant units") == ("yes", "units_became_inactive")
    assert answer(found, "rank collapse") == ("yes", "rank_collapsed")
    assert answer(found, "weight growth") == ("yes", "weights_grew")
    assert found.initial_network == found.visits[0].network
    against = diagnosis_of(report, decayed, fresh_networks=(decayed[1],) * 2)
    for question in ("dormant units", "rank collapse", "weight growth"):
        assert against.verdict(question).answer == "no"
        assert against.verdict(question).evidence["against"] == "fresh_agents"
    broken = diagnosis_of(report, (network(dead=20, stuck=10),) * 2)
    assert answer(broken, "dormant units") == ("yes", "inactive_from_the_start")


def test_a_life_of_one_visit_or_of_unknown_networks_cannot_be_compared() -> None:
    one = diagnosis_of(report_of(["constant"], stream_of(1), [0.5]), (network(),))
    assert {v.reason for v in one.verdicts if v.answer == "cannot tell"} == {"one_visit"}
    unknown = diagnosis_of(report_of(["constant"] * 2, stream_of(2)), (None, None))
    assert answer(unknown, "dormant units") == ("cannot tell", "network_unknown")
    with pytest.raises(UnknownNameError, match="Did you mean 'forgetting'"):
        unknown.verdict("forgeting")


# --- words --------------------------------------------------------------------------------------

DECLARED = {(name, each) for name, rule in STREAM_QUESTIONS.items() for each in rule.reasons}


def random_case(generator: random.Random) -> StreamCase:
    """A life of random numbers, with and without fresh agents, a log and networks."""
    P = generator.choice((1, 1, 2, 3))
    cycles = generator.choice((1, 2, 3))
    stream = stream_of(P, cycles)
    if P > 1 and generator.random() < 0.2:
        stream = StreamSpec(phases=[{"spec": SPEC, "steps": 10 * (i + 1)} for i in range(P)])
    V = stream.cycles * P
    log, fresh, networks = (generator.random() < 0.6 for _ in range(3))
    low, high = generator.choice(((0.2, 0.4), (0.0, 1.3), (0.9, 1.2)))

    def number(known: bool = True) -> Any:
        return generator.uniform(low, high) if known else None

    def state() -> NetworkState | None:
        if not networks:
            return None
        dormant = generator.choice((0.05, 0.3, 0.6))
        return NetworkState(
            hidden=(8, 8), dormant_units=dormant, saturated_units=0.0,
            effective_rank=generator.choice((2, 7)), weight_norm=generator.choice((1.0, 9.0)),
        )  # fmt: skip

    visits = [
        VisitDiagnosis(
            visit=v, phase=v % P, lifetime=(v + 1) * STEPS, steps=STEPS,
            dynamic_regret=40.0 if log else None,
            online_regret=generator.uniform(0.3, generator.choice((0.34, 0.9))) if log else None,
            normalised_regret=number(), network=state(),
        )
        for v in range(V)
    ]  # fmt: skip
    phases = []
    for j in range(P):
        best, final = number(), number()
        phases.append(
            PhaseDiagnosis(
                phase=j, outcome=outcome_of(best, final), best_normalised_regret=best,
                final_normalised_regret=final, initial_normalised_regret=None,
                fresh_normalised_regret=number(fresh),
                fresh_online_regret=generator.uniform(0.3, 0.7) if fresh and log else None,
                fresh_network=state() if fresh else None,
            )
        )  # fmt: skip
    return StreamCase(stream, visits, phases, number(V > 1))


def test_every_reason_is_reached_and_has_a_sentence() -> None:
    generator, reached = random.Random(0), set()
    for _ in range(300):
        for verdict in answer_all(STREAM_QUESTIONS, random_case(generator), STREAM_THRESHOLDS):
            reached.add((verdict.question, verdict.reason))
            text = stream_sentence(verdict)
            assert text.endswith("."), text
            assert not any(bad in text for bad in ("None", " ,", " .", " ;", "( ", "..")), text
    assert reached == DECLARED


def test_long_lists_are_cut_in_sentences_and_whole_in_data() -> None:
    stream = stream_of(2, cycles=5)
    found = diagnosis_of(report_of(["constant"] * 10, stream))
    verdict = found.verdict("failure to learn")
    assert len(verdict.evidence["failed"]) == 10  # type: ignore[arg-type]
    assert "; and 6 more." in stream_sentence(verdict)


@pytest.mark.parametrize("width", [60, 120, None])
def test_a_life_is_readable_at_every_width_and_in_a_pipe(width: int | None) -> None:
    stream = stream_of(3)
    report = report_of(optima(stream), stream, [0.3, 0.4, 0.5], fresh=optima(stream))
    found = diagnosis_of(report, (network(), network(), None))
    lines = printed(terminal(found), width)
    assert width is None or max(map(len, lines)) <= width
    shown = " ".join(" ".join(lines).split())
    assert headline(found) in shown
    page = markdown(found, ["which_phases.png"])
    assert all(stream_sentence(verdict) in page for verdict in found.verdicts)
    assert "![which phases](which_phases.png)" in page
    assert found._repr_markdown_().startswith("# life on SME/")
    named = found.model_copy(update={"name": "<script>"})
    assert named._repr_markdown_().startswith("# &lt;script> on SME/")


# --- runs, cells and the command ----------------------------------------------------------------


def same_network(own: Perceptron | None, model: Any, hidden: str) -> bool:
    """Whether a network has the first weights of a model's policy."""
    assert own is not None
    weights = dict(model.policy.named_parameters())[f"{hidden}.0.weight"].detach().numpy()
    return np.array_equal(own.layers[0][0], weights.T)


FIRST = {
    "jax:PPO": "mlp_extractor.policy_net",
    "jax:TD3": "actor.mu",
    "jax:SAC": "actor.latent_pi",
}


@pytest.mark.parametrize("uses", FIRST)
def test_the_networks_of_a_run_are_those_of_its_snapshots(tmp_path: Path, uses: str) -> None:
    stream = stream_of(2, observes_phase=uses == "jax:TD3")
    models = write_run(tmp_path, stream, uses)
    life = load_run(tmp_path)
    assert isinstance(life, StreamSubject)
    assert life.networks is not None
    for own, model in zip((*life.networks, life.initial_network), models, strict=True):
        assert same_network(own, model, FIRST[uses])
    found = diagnose(life, states=64)
    assert [visit.network.hidden for visit in found.visits if visit.network] == [(12, 8)] * 2
    assert found.plan["algorithm"] == uses.removeprefix("jax:")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short life of PPO, as `sme train` leaves it."""
    folder = tmp_path_factory.mktemp("runs") / "life"
    train(
        stream_of(3), algorithm="PPO", hyperparameters=SETTINGS, folder=folder, protocol=PROTOCOL,
        progress=False,
    )  # fmt: skip
    return folder


def test_the_command_writes_a_page_its_data_and_its_figures(
    run: Path, tmp_path: Path, figures: list[Any]
) -> None:
    pytest.importorskip("matplotlib")
    result = sme("diagnose", run, "--states", "64", "--out", tmp_path / "d")
    assert result.exit_code == 0, result.output
    assert "Plasticity and the network" in result.stdout
    page = (tmp_path / "d" / "diagnosis.md").read_text()
    names = sorted(path.stem for path in (tmp_path / "d").glob("*.png"))
    assert names == ["network_by_visit", "what_is_retained", "which_phases"]
    assert all(f"]({name}.png)" in page for name in names)
    for figure in figures:
        assert_readable(figure)
    read = StreamDiagnosis.from_dict(json.loads((tmp_path / "d" / "diagnosis.json").read_text()))
    assert read.stream_digest == stream_of(3).digest
    assert all(visit.online_regret is not None for visit in read.visits)
    assert read.visits[2].network != read.visits[0].network != read.initial_network
    shown = sme("diagnose", run, "--states", "64", "--json")
    assert json.loads(shown.stdout) == read.to_dict()


def test_comparisons_and_probes_are_refused_for_lives(run: Path) -> None:
    assert "on one task only" in refused("diagnose", run, "--probe-capacity")
    assert "on one task only" in refused("diagnose", run, "--against", run)
    with pytest.raises(OptionError, match="one task only"):
        diagnose(load_policy("constant", SMESpec()), against=load_run(run))


def test_a_life_that_has_not_ended_or_lacks_files_is_refused(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run, folder)
    (folder / "snapshots" / "visit-01.zip").unlink()
    assert "lacks visit-01.zip" in refused("diagnose", folder)
    report = StreamReport.read(folder / "stream.json")
    other = report_of(["constant"] * 2, stream_of(2))
    other.write(folder / "stream.json")
    shutil.copytree(run / "snapshots", folder / "snapshots", dirs_exist_ok=True)
    assert "is about the stream" in refused("diagnose", folder)
    (folder / "stream.json").unlink()
    assert "when it has ended" in refused("diagnose", folder)
    report.write(folder / "stream.json")
    assert sme("diagnose", folder, "--states", "64", "--json").exit_code == 0


def cell_of(stream: StreamSpec) -> Cell:
    return Cell(
        spec=stream.phases[0].spec, stream=stream, uses="jax:PPO", hyperparameters={},
        action_range="symmetric", seed=0, steps=stream.steps, evaluations=4,
        evaluation_episodes=1, protocol=EvaluationProtocol.from_dict(PROTOCOL),
    )  # fmt: skip


def write_cell(study: Path, cell: Cell, report: Any, online_regret: float | None) -> str:
    stem = cell.digest.removeprefix("sha256:")
    field = "report" if cell.stream is None else "stream_report"
    timing = Timing(total=1, training=1, environment=0, evaluation=0, steps_per_second=1)
    result = CellResult(
        key=cell.digest, cell=cell, curve=LearningCurve(), timing=timing, versions={},
        online_regret=online_regret, **{field: report},
    )  # fmt: skip
    (study / "cells").mkdir(parents=True, exist_ok=True)
    (study / "cells" / f"{stem}.json").write_text(json.dumps(result.to_dict()))
    return stem


def test_a_cell_is_diagnosed_with_its_fresh_agents(tmp_path: Path) -> None:
    stream = stream_of(2)
    cell = cell_of(stream)
    key = write_cell(tmp_path, cell, report_of(["constant"] * 2, stream, [0.5, 0.6]), 0.55)
    alone = load_cell(tmp_path, key[:12])
    assert isinstance(alone, StreamSubject)
    assert alone.networks is None
    assert diagnose(alone).verdict("dormant units").reason == "network_unknown"
    assert [each.document for each in cell.fresh] == [phase.spec for phase in stream.phases]
    for each, policy, regret in zip(cell.fresh, optima(stream), (0.5, 0.3), strict=True):
        stem = write_cell(tmp_path, each, evaluate(policy, each.spec, PROTOCOL), regret)
        (tmp_path / "models").mkdir(exist_ok=True)
        (tmp_path / "models" / f"{stem}.zip").write_bytes(saved_sb3(model_of("jax:PPO", each.spec)))
    kept = Snapshots(tmp_path / "models" / key, stream)
    kept.write_initial(model_of("jax:PPO", stream, 9))
    for visit in range(2):
        kept.write(visit, model_of("jax:PPO", stream, visit))
    result = sme("diagnose", tmp_path, "--cell", key[:12], "--states", "64", "--json")
    assert result.exit_code == 0, result.output
    found = StreamDiagnosis.from_dict(json.loads(result.stdout))
    assert [phase.fresh_online_regret for phase in found.phases] == [0.5, 0.3]
    assert [phase.fresh_normalised_regret for phase in found.phases] == [0.0, 0.0]
    assert answer(found, "costly visits") == ("yes", "costlier_than_fresh")
    assert answer(found, "loss of plasticity") == ("yes", "below_fresh_agents")
    assert found.verdict("weight growth").evidence["against"] == "fresh_agents"


def test_a_life_of_a_study_that_kept_its_models_is_diagnosed(tmp_path: Path) -> None:
    algorithm = {"name": "PPO", "uses": "PPO", "hyperparameters": SETTINGS}
    fields = {
        "streams": [{"name": "two", "stream": stream_of(2).to_dict()}],
        "algorithms": [algorithm],
        "seeds": 1,
        "evaluations": 0,
        "protocol": PROTOCOL,
    }
    plan = StudyPlan.from_dict(fields)
    file = StudyFile(name="tiny", digest=plan.digest, plan=plan)
    run_study(file, tmp_path, executor="in-process", keep_models=True)
    life = load_cell(tmp_path, plan.cells[0].cell.digest)
    assert isinstance(life, StreamSubject)
    found = diagnose(life, states=64)
    assert all(visit.network is not None for visit in found.visits)
    assert all(phase.fresh_network is not None for phase in found.phases)
    assert None not in [phase.fresh_online_regret for phase in found.phases]
    assert found.verdict("costly visits").reason.endswith("_than_fresh")


def test_a_life_that_is_a_fresh_agent_itself_is_not_compared_with_itself(tmp_path: Path) -> None:
    drift = {"rotation": 1.0, "increments": 2}
    stream = StreamSpec(phases=[{"spec": SPEC, "steps": STEPS, "drift": drift}])
    key = write_cell(tmp_path, cell_of(stream), report_of(["constant"], stream, [0.5]), 0.5)
    Snapshots(tmp_path / "models" / key, stream).write(0, model_of("jax:PPO", stream))
    (tmp_path / "models" / f"{key}.zip").write_bytes(saved_sb3(model_of("jax:PPO", stream)))
    found = diagnose(load_cell(tmp_path, key), states=64)
    (phase,) = found.phases
    assert (phase.fresh_online_regret, phase.fresh_normalised_regret) == (None, None)
    assert phase.fresh_network is None


def test_a_cell_whose_phase_observes_and_drifts_has_fresh_agents_of_that_phase(
    tmp_path: Path,
) -> None:
    drift = {"rotation": 1.0, "increments": 2}
    phases = [{"spec": SPEC, "steps": STEPS, "drift": drift}, {"spec": SPEC, "steps": STEPS}]
    stream = StreamSpec(phases=phases, observes_phase=True)
    cell = cell_of(stream)
    key = write_cell(tmp_path, cell, report_of(["constant"] * 2, stream), None)
    drifting, plain = cell.fresh
    alone = report_of(["constant"], drifting.stream)  # type: ignore[arg-type]
    for each, report in ((drifting, alone), (plain, evaluate("constant", SPEC, PROTOCOL))):
        stem = write_cell(tmp_path, each, report, 0.5)
        (tmp_path / "models").mkdir(exist_ok=True)
        model = model_of("jax:PPO", each.document)
        (tmp_path / "models" / f"{stem}.zip").write_bytes(saved_sb3(model))
    life = load_cell(tmp_path, key)
    assert isinstance(life, StreamSubject)
    found = diagnose(life, states=64)
    assert all(phase.fresh_network is not None for phase in found.phases)
    assert [phase.fresh_normalised_regret for phase in found.phases] == [1.0, 1.0]
    (tmp_path / "cells" / f"{plain.digest.removeprefix('sha256:')}.json").write_text("{}")
    with pytest.raises(OptionError, match="not the result of a cell"):
        load_cell(tmp_path, key)

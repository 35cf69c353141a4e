"""Cells that are lives in streams: the policies of their visits, their regret, their files."""

import json

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec, materialize
from sme_registry.errors import PolicyError, SMEError, SpecError
from sme_registry.evaluation import evaluate_stream, expected_regret
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger, label, study_status
from sme_registry.studies.result import CellResult
from sme_registry.training.algorithms import find
from sme_registry.training.record import Snapshots
from tests.studies.cells import cell_of, file_of, numbers, quick

pytest.importorskip("stable_baselines3")

TASK = SMESpec(state_dim=2, action_dim=2, horizon=8)
OTHER = TASK.derive(seed=1)
SMALL = {"n_steps": 16, "batch_size": 16, "n_epochs": 2, "policy_kwargs": {"net_arch": [4]}}
PROTOCOL = {"states_per_region": 50, "epsilons": [1.0]}


def stream_of(*specs, steps=32, **fields):
    return StreamSpec(phases=[{"spec": spec, "steps": steps} for spec in specs], **fields)


TWICE = stream_of(TASK, OTHER, cycles=2)


def life(stream=TWICE, uses="PPO", **changes):
    fields = {
        "spec": stream.phases[0].spec, "stream": stream, "steps": stream.steps, "uses": uses,
        "hyperparameters": SMALL if "PPO" in uses else {}, "evaluations": 8,
    }  # fmt: skip
    return cell_of(**fields | changes)


def plan_file(uses="PPO", **fields):
    """Two streams that share phase 0, two runs each."""
    second = {"switch": OTHER, "related": TASK.derive(rotation=1.0)}
    fields = {
        "streams": [
            {"name": name, "stream": stream_of(TASK, spec).to_dict(), "draws": [0, 1]}
            for name, spec in second.items()
        ],
        "algorithms": [{"name": "agent", "uses": uses, "hyperparameters": SMALL}],
        "seeds": 2,
        "evaluations": 4,
        "evaluation_episodes": 2,
        "protocol": PROTOCOL,
    } | fields
    return file_of("lives", **fields)


def matrix(report, region="WD"):
    return np.array(report.region(region).agent.normalised_regret)


class Knowing:
    """A learner that acts optimally in one phase, or in the one that it observes."""

    def __init__(self, env, copies):
        self._env, self._tasks = env, [materialize(phase.spec) for phase in env.document.phases]
        self._lock = None if copies else (each for each in ())

    def learn(self, total_timesteps):
        observation = self._env.reset()
        for _ in range(total_timesteps):
            action, _ = self.predict(observation, deterministic=True)
            observation = self._env.step(action.astype(np.float32))[0]

    def predict(self, observation, *, deterministic):
        s, shown = observation[:, :2].astype(np.float64), observation[:, 4:]
        phase = int(shown[0].argmax()) if shown.size else 0
        return 2.0 * self._tasks[phase].optimal_action(s) - 1.0, None


def knowing(env, *, seed, copies=True):
    return Knowing(env, copies)


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """The result of a life, and where its models are."""
    model = tmp_path_factory.mktemp("life") / "model.zip"
    return run_cell(life(), model_path=model), model


@pytest.fixture(scope="module")
def report(lived):
    """The life's."""
    report = lived[0].stream_report
    assert report.dynamic_regret is not None
    return report


def test_a_life_has_the_policies_that_ppo_has_at_the_end_of_each_visit(lived, report):
    from stable_baselines3 import PPO

    from sme_registry.sb3 import SMEVecEnv

    settings = SMALL | {"policy_kwargs": dict(SMALL["policy_kwargs"])}  # type: ignore[call-overload]
    env = SMEVecEnv(TWICE, 1, action_range="symmetric")
    model = PPO("MlpPolicy", env, seed=3, device="cpu", **settings)
    rows = []
    for _ in range(4):
        model.learn(32, reset_num_timesteps=not rows)
        rows.append(matrix(evaluate_stream([model] * 4, TWICE, PROTOCOL))[0])
    assert lived[0].report is None
    assert report.policy == "PPO"
    np.testing.assert_allclose(matrix(report), rows, atol=1e-6)
    assert len({*matrix(report)[:, 0]}) == 4


def test_a_life_has_the_agent_that_stopped_learning_after_its_first_visit(lived, report):
    frozen, own = report.reference_regret["frozen_agent"], report.dynamic_regret
    assert frozen.visits[0].online_regret == pytest.approx(own.visits[0].online_regret)
    kept = Snapshots(lived[1].with_suffix(""), TWICE).visits[0]
    expected = expected_regret([0.0, kept, kept, kept], TWICE, action_range="symmetric")
    for visit in (1, 2, 3):
        found, wanted = frozen.visits[visit].online_regret, expected.visits[visit].online_regret
        assert found == pytest.approx(wanted, abs=1e-6)


def test_a_life_s_document_is_read_again_and_holds_one_report(lived):
    result, _ = lived
    document = json.loads(json.dumps(result.to_dict()))
    assert "report" not in document
    assert CellResult.from_dict(document) == result
    single = run_cell(life().fresh[0])
    assert "stream_report" not in single.to_dict()
    for wrong in (
        document | {"report": single.to_dict()["report"]},
        {name: value for name, value in document.items() if name != "stream_report"},
        single.to_dict() | {"report": None},
    ):
        with pytest.raises(SpecError, match="report: must be the only report"):
            CellResult.from_dict(wrong)


def test_the_dynamic_regret_of_a_life_is_that_of_its_training(lived, report):
    result, regret = lived[0], report.dynamic_regret
    assert [visit.steps for visit in regret.visits] == [32] * 4
    assert regret.online_regret == pytest.approx(result.online_regret)
    assert regret.lifetime == tuple(range(1, 129))
    fresh = [run_cell(cell) for cell in result.cell.fresh]
    beside = report.with_fresh(
        [each.any_report for each in fresh], [each.online_regret or 0.0 for each in fresh]
    )
    assert None not in beside.region().agent.plasticity_ratio
    assert beside.dynamic_regret.learning_transfer is not None
    assert beside.dynamic_regret.visits[0].learning_transfer == pytest.approx(0.0)  # the same agent


def test_the_models_of_a_life_are_kept_before_training_and_after_each_visit(lived, report):
    model = lived[1]
    names = ["initial.zip", "visit-00.zip", "visit-01.zip", "visit-02.zip", "visit-03.zip"]
    files = sorted(model.with_suffix("").iterdir())
    assert [path.name for path in files] == names
    initial, *visits = map(str, files)
    again = evaluate_stream(visits, TWICE, PROTOCOL, initial=initial)
    np.testing.assert_allclose(matrix(again), matrix(report), atol=1e-6)
    last = evaluate_stream([str(model)] * 4, TWICE, PROTOCOL)
    np.testing.assert_array_equal(matrix(last)[3], matrix(again)[3])
    agent, own = again.region().agent, report.region().agent
    assert agent.forward_transfer == pytest.approx(own.forward_transfer, abs=1e-6)


def test_evaluations_during_a_life_are_on_the_task_in_force():
    name = f"{__name__}:knowing"
    regret = np.array(run_cell(life(uses=name)).curve.regret).reshape(4, 2)
    assert (regret[[0, 2]] < 1e-5).all()
    assert (regret[[1, 3]] > 0.1).all()


def test_a_learner_that_observes_the_phase_is_shown_the_one_in_force():
    stream = stream_of(TASK, OTHER, cycles=2, observes_phase=True)
    result = run_cell(life(stream, f"{__name__}:knowing"))
    assert max(result.curve.regret) < 1e-5
    assert np.abs(matrix(result.stream_report)).max() < 1e-6


def test_a_life_of_a_learner_that_cannot_be_copied_is_refused_before_it_begins():
    with pytest.raises(PolicyError, match=r"cannot be copied at the end of a visit: TypeError"):
        run_cell(life(uses=f"{__name__}:knowing", hyperparameters={"copies": False}))


def test_a_phase_that_goes_on_to_the_end_of_an_episode_gets_its_regret():
    stream = stream_of(TASK, OTHER, steps=30, cycles=2)  # 30 is no multiple of the horizon
    result = run_cell(life(stream, f"{__name__}:knowing"))
    regret = result.stream_report.dynamic_regret
    assert [visit.steps for visit in regret.visits] == [32, 32, 32, 24]
    first, second, *_ = (visit.dynamic_regret for visit in regret.visits)
    assert first < 1e-4 < second


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A study of lives that has been run, with its models."""
    study = tmp_path_factory.mktemp("study")
    quick(plan_file(), study, keep_models=True)
    return study


def test_fresh_agents_that_two_streams_share_run_once_and_count_once(studied):
    file = plan_file()
    status = study_status(studied)
    places = file.plan.cells
    assert len(places) == 12
    assert len(status.cells) == status.count("done") == len(Ledger(studied).results()) == 10
    assert {name: sum(of.values()) for (name, _), of in status.counts.items()} == {
        "switch": 6,
        "related": 6,
    }
    assert status.other_results == 0
    names = [label(place) for place in places if place.run == 1]
    assert names[:2] == ["agent on switch, run 1", "agent on phase 0 of switch alone, run 1"]


def test_a_study_keeps_the_models_of_its_lives(studied):
    ledger = Ledger(studied)
    for place in plan_file().plan.cells:
        key = place.cell.digest
        names = [] if place.phase is not None else ["initial.zip", "visit-00.zip", "visit-01.zip"]
        assert sorted(path.name for path in ledger.snapshots_path(key).glob("*")) == names
        assert ledger.model_path(key).exists()


@pytest.mark.parametrize(
    ("stream", "message"),
    [
        (stream_of(TASK, OTHER.derive(D=0.5)), "phases.1.spec: D=0.5: must be 0"),
        (stream_of(TASK, OTHER, steps=30), "phases.1: begins or ends a task at step 30"),
    ],
)
def test_a_stream_that_agents_in_jax_cannot_live_in_is_refused_before_anything_runs(
    stream, message, tmp_path
):
    pytest.importorskip("jax")
    with pytest.raises(SMEError, match=message):
        find("jax:PPO").check_task(stream)
    find("PPO").check_task(stream)
    file = plan_file("jax:PPO", streams=[{"name": "one", "stream": stream.to_dict()}])
    with pytest.raises(SMEError, match=message):
        quick(file, tmp_path / "study", device="cpu")
    assert not (tmp_path / "study").exists()


def test_lives_that_switch_at_the_same_steps_are_runs_of_one_program():
    pytest.importorskip("jax")
    from sme_registry.studies.programs import Programs

    deep = TASK.derive(complexity=3, hidden_width=8)
    base = life(stream_of(TASK, OTHER), "jax:PPO")
    same = [
        life(stream_of(OTHER, TASK.derive(rotation=1.0)), "jax:PPO"),
        life(base.stream or TWICE, "jax:PPO", seed=4),
    ]
    others = [
        life(stream_of(TASK, OTHER, steps=16, cycles=2), "jax:PPO"),
        life(stream_of(TASK, OTHER, switch="step"), "jax:PPO"),
        life(stream_of(TASK, OTHER, observes_phase=True), "jax:PPO"),
        life(stream_of(TASK, deep), "jax:PPO"),
        life(stream_of(deep, TASK), "jax:PPO"),
        life(stream_of(TASK, OTHER.derive(k=2)), "jax:PPO"),
        life(stream_of(TASK, steps=64), "jax:PPO"),
        life(stream_of(TASK, steps=64), "jax:PPO").fresh[0],
    ]
    programs = Programs([base, *same, *others], "cpu")
    group = programs.group(base)
    assert [programs.group(cell) == group for cell in same] == [True] * 2
    assert len({programs.group(cell) for cell in (base, *others)}) == 1 + len(others)
    assert programs.runs(base) == 3
    assert programs.program(others[3]).build_key["shape"] == [2, 2, 3, 8]


def jax_file():
    """Two lives, on two draws of a stream."""
    stream = {"name": "switch", "stream": stream_of(TASK, OTHER).to_dict(), "draws": [0, 1]}
    return plan_file("jax:PPO", streams=[stream])


@pytest.fixture
def visits(monkeypatch):
    """The visits that lives in JAX ended; and what to raise at the end of visit 1, once."""
    ended = []
    raised = []
    pytest.importorskip("jax")
    from sme_registry.studies import programs

    original = programs._ProgramRun._on_visit

    def on_visit(run, visit):
        ended.append(visit)
        original(run, visit)
        if visit == 1 and raised:
            raise raised.pop()

    monkeypatch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)
    monkeypatch.setattr(programs._ProgramRun, "_on_visit", on_visit)
    return ended, raised


@pytest.mark.usefixtures("quickly_compiled")
def test_interrupted_lives_in_jax_go_on_with_the_weights_of_their_visits(tmp_path, visits):
    whole, interrupted = tmp_path / "whole", tmp_path / "interrupted"
    quick(jax_file(), whole, device="cpu", keep_models=True)
    ended, raised = visits
    raised.append(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        quick(jax_file(), interrupted, device="cpu")
    assert not Ledger(interrupted).results()
    assert list((interrupted / "states").glob("*.npz"))
    ended.clear()
    assert quick(jax_file(), interrupted, device="cpu")[0].count("done") == 6
    assert ended == [1]  # visit 0 had been saved
    assert numbers(interrupted) == numbers(whole)
    lives = [result for result in Ledger(whole).results().values() if result.cell.stream]
    assert [len({*matrix(result.stream_report)[:, 0]}) for result in lives] == [2, 2]
    for result in lives:
        initial, *files = map(str, sorted(Ledger(whole).snapshots_path(result.key).iterdir()))
        again = evaluate_stream(files, result.cell.document, PROTOCOL, initial=initial)
        np.testing.assert_allclose(matrix(again), matrix(result.stream_report), atol=1e-6)
        regret = result.stream_report and result.stream_report.dynamic_regret
        assert [visit.steps for visit in regret.visits] == [32, 32]
        assert regret.online_regret == pytest.approx(result.online_regret)
        assert result.curve.steps == (16, 32, 48, 64)


@pytest.mark.usefixtures("quickly_compiled")
def test_models_that_are_asked_for_after_an_interruption_make_lives_in_jax_start_again(
    tmp_path, visits
):
    ended, raised = visits
    raised.append(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        quick(jax_file(), tmp_path, device="cpu")
    ended.clear()
    assert quick(jax_file(), tmp_path, device="cpu", keep_models=True)[0].count("done") == 6
    assert ended == [0, 1]  # a model needs more than was saved
    folders = [Ledger(tmp_path).snapshots_path(key) for key in Ledger(tmp_path).results()]
    assert sorted(len(list(folder.glob("*"))) for folder in folders) == [0] * 4 + [3] * 2

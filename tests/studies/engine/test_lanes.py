"""Cells that use JAX: as in `run_cell`, in one program, resumed with the same bits."""

import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sme_registry.evaluation import evaluate
from sme_registry.studies.cell import run_cell
from sme_registry.studies.executors import InProcess
from sme_registry.studies.ledger import Ledger, read_header, read_state, write_state
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.tables import analyse
from sme_registry.studies.report.texts import implementation_caveats
from sme_registry.studies.report.write import page
from sme_registry.studies.result import CellResult
from tests.studies.cells import ROOT, file_of, numbers, python, quick

pytest.importorskip("jax")
pytest.importorskip("stable_baselines3")

from sme_registry.studies import programs

pytestmark = pytest.mark.usefixtures("quickly_compiled")

STEPS = 96

# Kills itself after the first of three rollouts, when its state has been written.
KILLED = """
import os, signal, sys
from tests.studies.engine import test_lanes
from sme_registry.studies import programs

programs.SECONDS_BETWEEN_STATES = 0.0
test_lanes.ran(sys.argv[1], on_steps=lambda done: os.kill(os.getpid(), signal.SIGKILL))
"""


def plan_file(**fields):
    """Two seeds on two classes of one group, and a reference."""
    small = {"state_dim": 2, "action_dim": 2, "horizon": 20}
    settings = {"n_steps": 32, "batch_size": 16, "n_epochs": 2}
    settings["policy_kwargs"] = {"net_arch": [8, 8]}
    fields = {
        "classes": [
            {"name": "small", "setting": small, "seeds": [1, 2]},
            {"name": "gated", "setting": small | {"r_min": 0.5}, "seeds": [1, 2]},
        ],
        "algorithms": [
            {"name": "agent", "uses": "jax:PPO", "hyperparameters": settings},
            {"name": "linear", "uses": "reference:linear", "steps": 0},
        ],
        "seeds": 2,
        "steps": STEPS,
        "evaluations": 4,
        "evaluation_episodes": 2,
        "protocol": {"states_per_region": 20, "epsilons": [1.0]},
    } | fields
    return file_of("lanes", **fields)


class Watched(InProcess):
    """Says how far a program is."""

    def __init__(self, keep_models, on_steps):
        super().__init__(keep_models=keep_models)
        self.on_steps = on_steps

    def map(self, jobs, progress):
        def report(job, done, total):
            progress(job, done, total)
            if job.program is not None:
                self.on_steps(done)

        return super().map(jobs, report)


def ran(study, *, on_steps=lambda done: None, keep_models=False, **options):
    """The status of a run in this process, of agents alone."""
    executor = Watched(keep_models=keep_models, on_steps=on_steps)
    options = {"executor": executor, "only": ["algorithm=agent"], "device": "cpu"} | options
    return quick(plan_file(), study, **options)[0]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study that was never interrupted, with its models."""
    study = tmp_path_factory.mktemp("whole")
    status = ran(study, keep_models=True, only=())
    assert status.count("done") == 8, status.failed
    return study


def agents(study):
    results = Ledger(study).results()
    cells = (planned.cell.digest for planned in plan_file().plan.cells)
    return [results[key] for key in cells if results[key].program is not None]


def test_a_result_says_in_what_program_it_was_made_and_a_reference_s_does_not(whole):
    results = Ledger(whole).results().values()
    for result in results:
        document = result.to_dict()
        if result.cell.uses == "jax:PPO":
            assert document["program"] == {"device": "cpu", "lanes": 4, "shape": [2, 2, 1, 0]}
            assert {"jax", "jaxlib"} <= result.versions.keys()
        else:
            assert "program" not in document
        assert CellResult.from_dict(document) == result
    assert len(agents(whole)) == 4
    assert not list((whole / "states").glob("*"))


def test_curve_and_regret_mean_what_they_mean_in_any_cell(whole):
    results = agents(whole)
    for result in results:
        curve = result.curve
        assert curve.steps == (24, 48, 72, 96)
        assert curve.length == (20.0,) * 4
        np.testing.assert_allclose(curve.episode_return, 20 * (1 - np.array(curve.regret)))
        assert all(0.5 < similarity < 1.0 for similarity in curve.similarity)
        assert 0.5 < result.online_regret < 1.0
        assert result.timing.total > 0
    assert len({result.curve.episode_return for result in results}) == 4
    assert len({result.online_regret for result in results}) == 4


def test_a_report_says_which_algorithms_run_in_jax(whole):
    assert implementation_caveats(plan_file().plan, ["agent"]) == []
    analysis = analyse(plan_file(), Ledger(whole).results())
    assert "4 runs in JAX" in page(analysis)
    beside = replace(analysis, learners=("agent", "linear"))
    (sentence,) = implementation_caveats(analysis.plan, beside.learners)
    assert sentence.startswith("agent runs in JAX, the other algorithms do not")
    assert sentence in set(findings(beside).sentence) - set(findings(analysis).sentence)


def test_a_kept_model_is_one_of_stable_baselines3_and_scores_the_same(whole):
    result = agents(whole)[1]
    model = Ledger(whole).model_path(result.key)
    report = evaluate(str(model), result.cell.spec, result.cell.protocol)
    for ours, theirs in zip(result.report.regions, report.regions, strict=True):
        assert ours.similarity == pytest.approx(theirs.similarity, abs=1e-6)


def test_after_kill_9_a_program_goes_on_from_its_state_with_the_same_bits(whole, tmp_path):
    process = python(KILLED, tmp_path)
    assert process.returncode == -signal.SIGKILL, process.stderr
    ledger = Ledger(tmp_path)
    (state,) = (tmp_path / "states").glob("*.npz")
    assert not ledger.results()
    steps = []
    status = ran(tmp_path, on_steps=steps.append)
    assert status.count("done") == 4
    assert steps[0] == 64  # after the next rollout; from the beginning, it would be 32
    assert not state.exists()
    assert numbers(tmp_path).items() <= numbers(whole).items()


def change_state(path, change, **header):
    """Write a state again, with changed arrays and fields of its header; returns the header."""
    before, arrays = read_header(path), read_state(path)
    assert arrays
    change(arrays)
    write_state(path, before | header, arrays)
    return before


def interrupt(done):
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A study that was interrupted after its first rollout, and left a state."""
    study = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)
        with pytest.raises(KeyboardInterrupt, match="Run the same command to continue"):
            ran(study, on_steps=interrupt)
    return study


@pytest.fixture
def study(interrupted, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(interrupted, tmp_path / "study"))


@pytest.fixture
def state(study):
    """Its state."""
    (state,) = (study / "states").glob("*.npz")
    return state


def test_a_lane_whose_weights_are_not_finite_fails_and_the_others_go_on(whole, study, state):
    def break_a_lane(arrays):
        for name in arrays:
            if "action_net.bias" in name and "weights" in name:
                arrays[name][1] = np.nan

    header = change_state(state, break_a_lane)
    status = ran(study)
    assert (status.count("done"), status.count("failed")) == (3, 1)
    (failure,) = Ledger(study).failures().values()
    assert failure.key == header["cells"][1]
    assert failure.error.startswith("PolicyError: its weights were not finite after step 64.")
    assert numbers(study).items() <= numbers(whole).items()


def test_weights_that_break_in_the_very_last_update_are_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)

    def interrupt_at_the_end(done):
        if done == STEPS:  # before the update that follows the last step
            raise KeyboardInterrupt

    def break_a_moment(arrays):
        for name in arrays:
            if "action_net.bias" in name and "optimiser" in name:
                arrays[name][1] = np.nan

    with pytest.raises(KeyboardInterrupt):
        ran(tmp_path, on_steps=interrupt_at_the_end)
    (state,) = (tmp_path / "states").glob("*.npz")
    change_state(state, break_a_moment)
    assert ran(tmp_path).count("failed") == 1
    (failure,) = Ledger(tmp_path).failures().values()
    assert "its weights were not finite after step 96." in failure.error


def test_a_retry_goes_on_from_the_state_if_an_evaluation_at_the_end_failed(
    whole, study, state, monkeypatch
):
    monkeypatch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)

    def evaluate_nothing(policies, protocol):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(programs, "evaluate_many", evaluate_nothing)
        status = ran(study)
    assert (status.count("done"), status.count("failed")) == (0, 4)
    steps = []
    assert ran(study, retry_failed=True, on_steps=steps.append).count("done") == 4
    assert steps == []  # its training was complete
    assert not state.exists()
    assert numbers(study).items() <= numbers(whole).items()


def test_lanes_of_cells_that_are_left_out_keep_their_tasks(whole, study, state, monkeypatch):
    monkeypatch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)
    assert ran(study, only=["algorithm=agent", "class=small"]).count("done") == 2
    assert state.exists()  # with two lanes at the end of their training
    assert ran(study).count("done") == 4
    assert not state.exists()
    assert numbers(study).items() <= numbers(whole).items()


def test_a_program_with_other_lanes_leaves_a_state_whole(whole, study, state, monkeypatch):
    before = state.read_bytes()
    monkeypatch.setattr(programs, "SECONDS_BETWEEN_STATES", 0.0)
    with pytest.raises(KeyboardInterrupt):
        ran(study, lanes=2, on_steps=interrupt)
    assert state.read_bytes() == before
    assert len(list((study / "states").glob("*.npz"))) == 2
    assert ran(study).count("done") == 4
    assert numbers(study).items() <= numbers(whole).items()
    assert not list((study / "states").glob("*.npz"))


@pytest.mark.parametrize("other", ["versions", "program/.key"])
def test_a_state_of_other_versions_or_with_other_arrays_counts_as_none(other, whole, study, state):
    def change(arrays):
        arrays["records/regret"] += 1000.0  # would show in the results
        if other != "versions":
            arrays[other] = np.zeros(3)

    change_state(state, change, **({"versions": {"jax": "0"}} if other == "versions" else {}))
    steps = list[int]()
    status = ran(study, on_steps=steps.append)
    assert status.count("done") == 4
    assert steps[0] == 32
    assert numbers(study).items() <= numbers(whole).items()


def test_a_cell_by_itself_is_a_program_of_one_lane(tmp_path):
    cell = plan_file(steps=0, evaluations=0).plan.cells[0].cell
    result = run_cell(cell, model_path=tmp_path / "model.zip")
    assert result.program.lanes == 1
    assert (result.online_regret, result.online_cost, result.curve.steps) == (None, None, ())
    report = evaluate(str(tmp_path / "model.zip"), cell.spec, cell.protocol)
    assert report.wd_regret == pytest.approx(result.report.wd_regret, abs=1e-6)


def test_a_cell_with_limits_and_distractors_has_their_costs_and_reports():
    setting = {
        "state_dim": 2,
        "action_dim": 2,
        "horizon": 20,
        "safety": {"tightness": 0.3},
        "observation": {"distractors": 3, "dynamics": "driven", "mixing": "nonlinear"},
    }
    classes = [{"name": "mixed", "setting": setting, "seeds": [1]}]
    file = plan_file(classes=classes, seeds=1, steps=32, evaluations=0)
    result = run_cell(file.plan.cells[0].cell)
    assert 0.0 < result.online_cost < 1.0
    assert result.report.safety is not None
    assert [region.name for region in result.report.observation.sensitivity] == ["WD", "OOD 1"]
    assert [probe.units for probe in result.report.observation.probes] == [5, 8, 8]


def test_processes_give_the_same_bits(whole, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    status = ran(tmp_path, executor="processes", jobs=1)
    assert status.count("done") == 4
    assert numbers(tmp_path).items() <= numbers(whole).items()

"""Runs of agents in JAX: the same folder, exact resumption, and models of Stable-Baselines3."""

import io
import shutil
import signal
import sys

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("stable_baselines3")
pytest.importorskip("jax")

from sme_registry import SMESpec, StreamSpec, evaluate
from sme_registry.diagnosis.subject import load_run
from sme_registry.errors import (
    MissingDependencyError,
    OptionError,
    PolicyError,
    SMEError,
)
from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.models import load_sb3, saved_sb3
from sme_registry.export import export_onnx
from sme_registry.io import read_arrays, write_arrays
from sme_registry.jax.run import new_program
from sme_registry.training import jax_agents, train
from sme_registry.training.models import new_sb3_model, set_weights
from sme_registry.training.record import CHECKPOINT, RunRecord, read_episodes
from tests.training.runs import NARROW, PROTOCOL, TINY

pytestmark = pytest.mark.usefixtures("quickly_compiled")

PPO = {"n_steps": 32, "batch_size": 32, "n_epochs": 2, **NARROW}


def jax_run(folder, document=TINY, **changes):
    settings = {
        "algorithm": "PPO",
        "agents": "jax",
        "steps": 120,
        "hyperparameters": PPO,
        "protocol": PROTOCOL,
        "checkpoint_every": 50,
        "progress": False,
    }
    return train(document, folder=folder, **{**settings, **changes})


@pytest.fixture(scope="module")
def shown():
    """What `run` printed."""
    return io.StringIO()


@pytest.fixture(scope="module")
def run(tmp_path_factory, shown):
    console = Console(file=shown, width=100)
    return jax_run(tmp_path_factory.mktemp("jax"), progress=True, console=console)


def test_a_run_writes_the_same_files(run, shown):
    assert "\ntraining PPO: compiling …\n" in shown.getvalue()
    assert "\ntraining PPO: 128 of 128 steps" in shown.getvalue()
    names = {path.name for path in run.folder.iterdir()}
    assert names >= {"run.json", "episodes.csv", "checkpoint.zip", "model.zip", "evaluation.json"}
    assert {path.name for path in run.figures} <= names
    record = RunRecord.read(run.folder)
    assert record == run.record
    assert (record.algorithm, record.device, record.status) == ("jax:PPO", "cpu", "finished")
    assert (record.steps, record.steps_done, record.episodes) == (120, 128, 6)
    assert record.hyperparameters == PPO
    assert {"jax", "jaxlib", "torch", "stable_baselines3"} <= record.versions.keys()
    assert run.report.policy == "PPO"
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(run.folder / "tensorboard")).Reload()
    (first, *_) = events.Scalars("rollout/regret")
    finished = [episode.regret for episode in run.episodes[:3]]  # in the first piece, 64 steps
    assert first.value == pytest.approx(np.mean(finished), abs=1e-6)
    assert [episode.step for episode in run.episodes] == [20, 40, 60, 80, 100, 120]
    for episode in read_episodes(run.folder / "episodes.csv"):
        # With k = 1 and r_min = 0 the return is the horizon less the sum of regrets.
        assert episode.episode_return == pytest.approx(20 * (1 - episode.regret), abs=1e-6)
        assert (episode.length, episode.terminated) == (20, 0)
        assert 0 < episode.similarity < 1


def test_the_model_is_one_of_stable_baselines3(run, tmp_path):
    model = load_sb3(run.model_path)
    assert (type(model).__name__, model.num_timesteps, model.n_steps) == ("PPO", 128, 32)
    assert evaluate(run.model_path, TINY, PROTOCOL, name="PPO").regions == run.report.regions
    # The last checkpoint precedes the last update.
    program = new_program("jax:PPO", [TINY], [0], hyperparameters=PPO, steps=120)
    arrays = read_arrays(run.folder / CHECKPOINT)
    program.restore({name: array for name, array in arrays.items() if name != "episode"})
    program.finish()
    for name, weight in model.policy.state_dict().items():
        assert np.array_equal(weight.numpy(), program.weights(0)[name])
    pytest.importorskip("onnxruntime")
    exported = export_onnx(run.model_path, TINY, tmp_path / "policy.onnx")
    of_onnx = evaluate(exported, TINY, PROTOCOL).regions[0].similarity
    assert of_onnx == pytest.approx(run.report.regions[0].similarity, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "action_range"), [("PPO", "symmetric"), ("TD3", "unit"), ("SAC", "symmetric")]
)
def test_the_model_predicts_the_same_actions(name, action_range, tmp_path):
    # A buffer that fits in no memory: neither here nor where the model is loaded it is allocated.
    settings = NARROW if name == "PPO" else {**NARROW, "buffer_size": 10**15}
    run = {"hyperparameters": settings, "action_range": action_range, "steps": 64}
    program = new_program(f"jax:{name}", [TINY], [3], **run)
    model = new_sb3_model(f"jax:{name}", TINY, seed=3, **run)
    set_weights(model, program.weights(0), 64)
    (tmp_path / "model.zip").write_bytes(saved_sb3(model))
    observations = np.random.default_rng(0).random((50, 4), np.float32)
    weights = {name: weight[0] for name, weight in program.state.weights.items()}
    acted = program.act(program.settings, weights, observations, action_range == "symmetric")
    low = -1.0 if action_range == "symmetric" else 0.0
    expected = np.clip(np.asarray(acted), low, 1.0)
    for loaded in (model, load_sb3(tmp_path / "model.zip")):
        predicted, _ = loaded.predict(observations, deterministic=True)
        np.testing.assert_allclose(predicted, expected, rtol=0, atol=1e-6)
    own = model.policy.state_dict()
    assert all(np.array_equal(own[name].numpy(), w) for name, w in weights.items() if name in own)


def test_the_model_of_a_stream_has_the_inputs_of_its_phases():
    phases = [{"spec": TINY, "steps": 20}, {"spec": TINY.derive(seed=1), "steps": 20}]
    stream = StreamSpec(phases=phases, observes_phase=True)
    run = {"hyperparameters": NARROW, "steps": 40}
    program = new_program("jax:SAC", [stream], [0], **run)
    model = new_sb3_model("jax:SAC", stream, seed=0, action_range="symmetric", **run)
    set_weights(model, program.weights(0), 0)
    assert model.observation_space.shape == (4 + 2,)


def interrupted(folder, monkeypatch, **changes):
    """A run that Ctrl-C ends while it writes its first checkpoint."""
    with monkeypatch.context() as patch:
        save = jax_agents.write_arrays

        def save_and_interrupt(*arguments):
            save(*arguments)
            signal.raise_signal(signal.SIGINT)  # delivered when the record is written, too

        patch.setattr(jax_agents, "write_arrays", save_and_interrupt)
        with pytest.raises(KeyboardInterrupt):
            jax_run(folder, **changes)


def without_times(result):
    rows = read_episodes(result.folder / "episodes.csv")
    return [episode._replace(wall_seconds=0.0) for episode in rows]


def same_bits(one, other):
    assert without_times(one) == without_times(other)
    assert one.report.regions == other.report.regions
    with np.load(one.folder / CHECKPOINT) as a, np.load(other.folder / CHECKPOINT) as b:
        assert a.files == b.files
        assert all(np.array_equal(a[name], b[name]) for name in a.files)
    weights, others = (load_sb3(each.model_path).policy.state_dict() for each in (one, other))
    assert all((weights[name] == others[name]).all() for name in weights)


def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(run, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    interrupted(folder, monkeypatch)
    assert not (folder / "model.zip").exists()
    with pytest.raises(OptionError, match="Use --resume"):
        jax_run(folder)
    with pytest.raises(
        OptionError, match=r"has neither model.zip nor a checkpoint.zip that can be diagnosed"
    ):
        load_run(folder)
    shutil.copytree(folder, tmp_path / "longer")

    resumed = jax_run(folder, resume=True, hyperparameters={})
    assert resumed.record.sessions == 2
    # The checkpoint came after 64 steps, in the middle of the fourth episode.
    assert resumed.episodes[3].step == 80
    same_bits(resumed, run)
    assert jax_run(tmp_path / "longer", resume=True, steps=150).record.steps_done == 160


def test_a_damaged_checkpoint_is_refused_and_one_with_weights_that_are_not_finite_is_kept(
    tmp_path, monkeypatch
):
    folder = tmp_path / "run"
    interrupted(folder, monkeypatch)
    path = folder / CHECKPOINT
    whole = read_arrays(path)

    def refused():
        with pytest.raises(PolicyError, match=r"cannot be loaded: .*--force"):
            jax_run(folder, resume=True)

    path.write_bytes(b"PK")
    refused()
    for name in ("episode", "steps"):
        write_arrays(path, {each: array for each, array in whole.items() if each != name})
        refused()

    broken = {
        name: np.full_like(array, np.nan) if "action_net.bias" in name else array
        for name, array in whole.items()
    }
    write_arrays(path, broken)
    with pytest.raises(PolicyError, match=r"not finite any longer at step 128.*last checkpoint"):
        jax_run(folder, resume=True)
    record = RunRecord.read(folder)
    assert record is not None
    assert (record.status, record.steps_done) == ("failed", 64)
    assert record.failure == "the weights are not finite any longer at step 128"
    assert not (folder / "model.zip").exists()
    with pytest.raises(OptionError, match=r"failed run of jax:PPO \(the weights are not finite"):
        jax_run(folder, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algorithm": "A2C"}, "algorithm='jax:A2C': must be one of jax:PPO, jax:TD3, jax:SAC"),
        ({"hyperparameters": {"use_sde": True}}, "use_sde: jax:PPO has no such.*batch_size"),
    ],
)
def test_invalid_arguments_raise_typed_errors_and_create_no_folder(change, message, tmp_path):
    settings = {"hyperparameters": {}, **change}
    with pytest.raises(SMEError, match=message):
        jax_run(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_a_team_is_refused_by_name(tmp_path):
    team = SMESpec(action_dim=2, team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    for algorithm in (None, "jax:PPO"):
        with pytest.raises(SMEError, match=r"jax:PPO.*and this is the task of a team"):
            train(team, agents="jax", algorithm=algorithm, folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_without_jax_it_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("sme_registry.jax")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingDependencyError, match=r"JAX is not installed.*\[jax\]"):
        jax_run(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_life_has_the_snapshots_of_sb3_and_its_resumption_the_same_bits(tmp_path, monkeypatch):
    phases = [{"spec": TINY, "steps": 40}, {"spec": TINY.derive(seed=6), "steps": 40}]
    stream = StreamSpec(phases=phases)
    whole = jax_run(tmp_path / "whole", stream, steps=None)
    assert isinstance(whole.report, StreamReport)
    assert (whole.record.steps_done, whole.record.stream) == (96, stream)
    assert [e.step for e in whole.episodes] == [20, 40, 60, 80]
    files = ["initial.zip", "visit-00.zip", "visit-01.zip"]
    models = [load_sb3(tmp_path / "whole" / "snapshots" / name) for name in files]
    assert [model.num_timesteps for model in models] == [0, 64, 96]
    last = load_sb3(whole.model_path).policy.state_dict()
    assert all((last[k] == w).all() for k, w in models[-1].policy.state_dict().items())

    # Ended after 64 steps, in phase 1, before the update that follows the second rollout.
    interrupted(tmp_path / "cut", monkeypatch, document=stream, steps=None)
    resumed = jax_run(tmp_path / "cut", stream, steps=None, resume=True)
    same_bits(resumed, whole)
    assert resumed.report.to_dict() == whole.report.to_dict()
    # The policy of visit 0 has learned from the first rollout alone.
    program = new_program("jax:PPO", [stream], [0], hyperparameters=PPO, steps=80)
    program.advance(32)
    program.finish()
    for name, weight in models[1].policy.state_dict().items():
        assert np.array_equal(weight.numpy(), program.weights(0)[name])


MIXED = TINY.derive(
    safety={"tightness": 0.3},
    observation={"distractors": 3, "dynamics": "autonomous", "mixing": "nonlinear"},
)


@pytest.fixture(scope="module")
def mixed_run(tmp_path_factory):
    return jax_run(tmp_path_factory.mktemp("mixed"), MIXED)


def test_a_run_on_a_task_with_limits_and_distractors_has_its_costs_and_resumes_bit_for_bit(
    mixed_run, tmp_path, monkeypatch
):
    run = mixed_run
    assert "cost_curve.png" in {path.name for path in run.figures}
    assert run.report.safety is not None
    assert run.report.observation is not None
    assert len(run.report.observation.probes) == 2  # of the observation and the hidden layer
    assert load_sb3(run.model_path).observation_space.shape == (2 + 3 + 2,)
    rows = read_episodes(run.folder / "episodes.csv")
    program = new_program("jax:PPO", [MIXED], [0], hyperparameters=PPO, steps=120)
    log = program.advance(120)
    assert log.cost is not None
    costs = log.cost[:120, 0].reshape(6, 20)
    for row, cost in zip(rows, costs, strict=True):
        assert row.safety is not None
        assert row.safety.cost == pytest.approx(cost.mean(), abs=1e-8)
        assert row.safety.violating_share == np.mean(cost > 1e-6)
        assert -1.0 <= row.safety.safe_regret <= 1.0
    interrupted(tmp_path / "again", monkeypatch, document=MIXED)
    same_bits(jax_run(tmp_path / "again", MIXED, resume=True, hyperparameters={}), run)

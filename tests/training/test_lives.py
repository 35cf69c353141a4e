"""Runs on streams: snapshots, what is reported, resuming in mid-life, and what is refused."""

import json
import signal

import numpy as np
import pytest

from sme_registry import SMESpec, StreamSpec
from sme_registry.errors import OptionError, SMEError
from sme_registry.evaluation import StreamReport, evaluate_stream
from sme_registry.evaluation.models import load_sb3
from sme_registry.training import train
from sme_registry.training.record import RunRecord, VisitEnds, read_episodes
from tests.training.runs import PROTOCOL, TINY

pytest.importorskip("stable_baselines3")

from sme_registry.training.models import SB3Learner

# Nobody is rewarded in phase 1, so that every regret says in which phase it was.
BARREN = TINY.derive(seed=6, r_min=0.999)
STREAM = StreamSpec(phases=[{"spec": TINY, "steps": 60}, {"spec": BARREN, "steps": 40}], cycles=2)
PPO = {"n_steps": 32, "batch_size": 32, "n_epochs": 2, "policy_kwargs": {"net_arch": [8]}}


def life(folder, stream=STREAM, **changes):
    settings = {
        "algorithm": "PPO",
        "hyperparameters": PPO,
        "protocol": PROTOCOL,
        "checkpoint_every": 32,
        "progress": False,
    }
    return train(stream, folder=folder, **{**settings, **changes})


def weights(path):
    return {k: v.numpy() for k, v in load_sb3(path).policy.state_dict().items()}


def same_weights(one, other):
    a, b = weights(one), weights(other)
    return all(np.array_equal(a[name], b[name]) for name in a)


def visit_files(folder):
    return [folder / "snapshots" / f"visit-0{visit}.zip" for visit in range(4)]


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    return life(tmp_path_factory.mktemp("life") / "run")


def test_a_life_writes_its_report_and_a_model_for_each_visit(lived):
    names = {path.name for path in lived.folder.iterdir()}
    assert names >= {"run.json", "episodes.csv", "model.zip", "stream.json", "snapshots"}
    assert "evaluation.json" not in names
    assert {path.name for path in lived.figures if path.suffix == ".png"} == {
        "training_curve.png", "retention_map.png", "performance_curve.png",
        "dynamic_regret_curve.png",
    }  # fmt: skip
    snapshots = {path.name for path in (lived.folder / "snapshots").iterdir()}
    assert snapshots == {"initial.zip", *(path.name for path in visit_files(lived.folder))}
    record = RunRecord.read(lived.folder)
    assert record == lived.record
    assert (record.stream, record.stream_digest) == (STREAM, STREAM.digest)
    assert (record.spec, record.steps, record.steps_done) == (TINY, STREAM.steps, 224)
    assert json.loads((lived.folder / "run.json").read_text())["stream"] == STREAM.to_dict()


def test_a_snapshot_has_learned_from_the_rollouts_that_were_over(lived):
    # Rollouts of 32 steps, two epochs each: one is over at 60, three at 100, five at 160. The last
    # visit ends with the training, which finishes its last rollout.
    updates = [load_sb3(path)._n_updates for path in visit_files(lived.folder)]
    assert updates == [2, 6, 10, 14]
    assert same_weights(visit_files(lived.folder)[-1], lived.model_path)
    initial = lived.folder / "snapshots" / "initial.zip"
    assert (load_sb3(initial)._n_updates, load_sb3(initial).num_timesteps) == (0, 0)


def test_a_snapshot_of_td3_has_learned_from_every_step_of_the_visit(tmp_path):
    settings = {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    td3 = life(tmp_path / "run", algorithm="TD3", hyperparameters=settings)
    updates = [load_sb3(path)._n_updates for path in visit_files(td3.folder)]
    assert updates == [50, 90, 150, 190]
    assert same_weights(visit_files(td3.folder)[-1], td3.model_path)


def test_the_report_of_a_life_is_about_its_snapshots_and_its_episodes(lived):
    report = StreamReport.read(lived.folder / "stream.json")
    assert report == lived.report
    snapshots = lived.folder / "snapshots"
    again = evaluate_stream(
        visit_files(lived.folder), STREAM, PROTOCOL, initial=snapshots / "initial.zip", name="PPO"
    )
    assert report.regions == again.regions
    assert report.dynamic_regret is not None
    total = sum(episode.regret * episode.length for episode in lived.episodes)
    assert report.dynamic_regret.dynamic_regret == pytest.approx(total)
    by_visit = [visit.online_regret for visit in report.dynamic_regret.visits]
    assert by_visit[1] == by_visit[3] == 1.0
    assert max(filter(None, by_visit[::2])) < 1.0
    assert report.reference_regret.keys() >= {"frozen_optimum", "frozen_agent", "constant"}


def killed(folder, monkeypatch, at_step, stream=STREAM):
    """A life that ends right after the checkpoint of a step."""
    save = SB3Learner.save_checkpoint

    def save_and_end(learner, *arguments):
        save(learner, *arguments)
        if learner.steps >= at_step:
            signal.raise_signal(signal.SIGINT)  # delivered when the record is written, too

    with monkeypatch.context() as patch:
        patch.setattr(SB3Learner, "save_checkpoint", save_and_end)
        with pytest.raises(KeyboardInterrupt):
            life(folder, stream)


def test_a_resumed_life_goes_on_at_the_step_of_its_checkpoint(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    killed(folder, monkeypatch, at_step=96)
    first, second, *_ = visit_files(folder)
    assert [path.exists() for path in visit_files(folder)] == [True, False, False, False]
    before = first.read_bytes()
    second.write_bytes(b"of a visit that ended after the checkpoint")

    resumed = life(folder, resume=True)
    assert (resumed.record.sessions, resumed.record.steps_done) == (2, 224)
    assert first.read_bytes() == before
    assert [load_sb3(path)._n_updates for path in visit_files(folder)] == [2, 6, 10, 14]
    # The episode that was cut at step 96 began again there, in phase 1, and those after it in the
    # phases of their steps.
    episodes = read_episodes(folder / "episodes.csv")
    assert [e.step for e in episodes] == [20, 40, 60, 80, 116, 136, 156, 176, 196, 216]
    barren = [e.step for e in episodes if e.regret == 1.0]
    assert barren == [80, 116, 196, 216]


def test_a_life_that_was_killed_after_its_last_step_ends_its_last_visit(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    killed(folder, monkeypatch, at_step=224)
    assert not visit_files(folder)[-1].exists()
    resumed = life(folder, resume=True)
    assert same_weights(visit_files(folder)[-1], resumed.model_path)


def test_a_life_whose_first_visit_is_in_no_finished_episode_is_reported(tmp_path, monkeypatch):
    task = TINY.derive(horizon=50)
    phases = [{"spec": task, "steps": 10}, {"spec": task.derive(seed=6), "steps": 90}]
    stream = StreamSpec(phases=phases, switch="step")
    killed(tmp_path / "run", monkeypatch, at_step=32, stream=stream)
    resumed = life(tmp_path / "run", stream, resume=True)
    assert [(e.step, e.length) for e in resumed.episodes] == [(82, 50)]
    assert isinstance(resumed.report, StreamReport)
    assert resumed.report.dynamic_regret is not None
    assert resumed.report.dynamic_regret.visits[0].online_regret is None
    assert "frozen_agent" not in resumed.report.reference_regret


def test_force_removes_the_snapshots_of_the_run_before(lived, tmp_path):
    folder = tmp_path / "run"
    (folder / "snapshots").mkdir(parents=True)
    (folder / "snapshots" / "visit-09.zip").write_bytes(b"of another stream")
    (folder / "run.json").write_bytes((lived.folder / "run.json").read_bytes())
    with pytest.raises(OptionError, match="contains a finished run"):
        life(folder)
    replaced = life(folder, force=True)
    assert not (replaced.folder / "snapshots" / "visit-09.zip").exists()


@pytest.mark.parametrize("other", [STREAM.draw(1), StreamSpec(phases=STREAM.phases), TINY])
def test_a_life_is_not_resumed_on_another_stream(other, lived, tmp_path):
    lived.record.updated(status="running").write(tmp_path)
    with pytest.raises(OptionError, match=r"^stream_digest='.*': the run in .* has 'sha256:"):
        life(tmp_path, other, resume=True, steps=None if other is not TINY else 300)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envs": 2}, "num_envs=2: must be 1 on a stream, since each environment would live"),
        ({"num_envs": 2, "agents": "jax"}, "num_envs=2: must be 1"),
        ({"steps": 100}, "steps=100: must be 200, since .* or make another stream"),
        ({"independent": True}, "learns the task of a team, and this is a stream"),
        ({"stream": "Switch6"}, "'Switch6'.*Did you mean 'Switch5-v1'"),
        ({"stream": {"phases": []}}, "phases"),
        (
            {"stream": {"phases": STREAM.phases, "cycles": 501}},
            r"cycles × phases=1,002: must be at most 1,000, .* fewer cycles",
        ),
        (
            {"stream": {"phases": [{"spec": TINY, "steps": 50}, {"spec": TINY, "steps": 50}]},
             "agents": "jax"},
            r"phases\.1: begins .* step 50 of the cycle: must be a multiple of horizon=20",
        ),
        (
            {"stream": {"phases": [{"spec": TINY, "steps": 60},
                                   {"spec": TINY.derive(D=0.5), "steps": 60}]}, "agents": "jax"},
            r"phases\.1\.spec: D=0\.5: must be 0, since agents in JAX",
        ),
    ],
)  # fmt: skip
def test_what_a_life_cannot_have_is_refused_and_creates_no_folder(change, message, tmp_path):
    if "agents" in change:
        pytest.importorskip("jax")
    with pytest.raises(SMEError, match=message):
        life(tmp_path / "run", **change)
    assert not (tmp_path / "run").exists()


SHORT = SMESpec(state_dim=1, action_dim=1, horizon=5)
VISITS = StreamSpec(
    phases=[{"spec": SHORT, "steps": 5}, {"spec": SHORT.derive(seed=1), "steps": 5}], cycles=2
)


@pytest.mark.parametrize(
    ("first", "steps", "called"),
    [
        (0, 20, [(0, 6), (1, 11), (2, 16), (3, "end")]),
        (0, 24, [(0, 6), (1, 11), (2, 16), (3, "end")]),  # the last phase goes on
        (10, 20, [(1, 11), (2, 16), (3, "end")]),  # resumed before the policy of visit 1 was called
        (24, 24, [(3, "end")]),  # after the last step
        (0, 15, [(0, 6), (1, 11), (2, "end")]),  # cut where a visit ends
        (0, 14, [(0, 6), (1, 11)]),
    ],
)
def test_visits_end_at_the_next_step_and_the_last_one_with_the_training(first, steps, called):
    ended = []
    now = first
    visits = VisitEnds(VISITS, lambda visit: ended.append((visit, now)), first)
    for now in range(first + 1, steps + 1):
        visits.after_step(int(now))
    now = "end"
    visits.finish(steps)
    assert ended == called

"""Resuming a killed run from its checkpoint."""

import io
import subprocess
import sys
import time
import zipfile

import numpy as np
import pytest

from sme_registry.errors import (
    OptionError,
    PolicyError,
)
from sme_registry.training.record import RunRecord, read_episodes
from tests.training.runs import TINY, copy_files, short, without_figures

pytest.importorskip("stable_baselines3")

from sme_registry.training.models import random_seed

_SCRIPT = """
import sys
from sme_registry import SMESpec
from sme_registry.training import train
spec = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)
train(spec, steps=100_000, seed=3, folder=sys.argv[1], checkpoint_every=50,
      hyperparameters={"gamma": 0.9}, protocol={"states_per_region": 50}, progress=False)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """The folder of a run whose process was killed some way beyond its third checkpoint."""
    folder = tmp_path_factory.mktemp("killed") / "run"
    process = subprocess.Popen([sys.executable, "-c", _SCRIPT, str(folder)])
    try:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and process.poll() is None:
            record = RunRecord.read(folder) if (folder / "run.json").exists() else None
            if record is not None and record.steps_done >= 150:
                break
            time.sleep(0.05)
    finally:
        running = process.poll() is None
        process.kill()
        process.wait()
    assert running
    return folder


@pytest.fixture(scope="module")
def resumed(killed, tmp_path_factory):
    """The killed run, 60 steps on."""
    folder = tmp_path_factory.mktemp("resumed") / "run"
    copy_files(killed, folder)
    with without_figures():
        return short(folder, seed=3, steps=steps_of(killed) + 60, resume=True)


def steps_of(folder):
    record = RunRecord.read(folder)
    assert record is not None
    assert record.status == "running"
    return record.steps_done


def test_a_killed_run_resumes_from_its_checkpoint(killed, resumed):
    with pytest.raises(OptionError, match="--resume"):
        short(killed, seed=3, steps=1000)
    before = steps_of(killed)
    logged = read_episodes(killed / "episodes.csv")
    assert resumed.record.sessions == 2
    assert resumed.record.steps_done == before + 60
    kept = [episode for episode in logged if episode.step <= before]
    assert kept
    assert list(resumed.episodes[: len(kept)]) == kept
    numbers = [episode.episode for episode in resumed.episodes]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > len(kept)
    assert resumed.episodes[-1].step > before
    assert resumed.episodes[-1].wall_seconds > kept[-1].wall_seconds
    # Its starts are drawn from another stream than those of the first session.
    with zipfile.ZipFile(resumed.folder / "checkpoint.zip") as archive:
        replay = np.load(io.BytesIO(archive.read("sme_replay_buffer.npz")))
    starts = replay["observations"][[0, before], 0, :2]
    assert not np.array_equal(starts[0], starts[1])


def test_resuming_keeps_the_hyperparameters_and_repeats_to_the_bit(killed, resumed, tmp_path):
    from stable_baselines3 import TD3

    assert resumed.record.hyperparameters == {"gamma": 0.9}
    assert TD3.load(resumed.model_path, device="cpu").gamma == 0.9
    copy_files(killed, tmp_path / "again")
    again = short(tmp_path / "again", seed=3, steps=resumed.record.steps, resume=True)
    assert again.report.regions == resumed.report.regions
    assert [e.regret for e in again.episodes] == [e.regret for e in resumed.episodes]


def test_the_checkpoint_holds_the_model_its_optimisers_and_its_replay_buffer(killed):
    from stable_baselines3 import TD3

    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training.models import load_checkpoint

    path = killed / "checkpoint.zip"
    model = load_checkpoint(TD3, path, SMEVecEnv(TINY, 1), buffer_size=5_000)
    steps = model.num_timesteps
    assert steps % 50 == 0
    assert steps >= 150
    assert model.replay_buffer.size() == steps
    assert not model.replay_buffer.full
    replayed = model.replay_buffer
    # Observations' time input shows that the buffer holds the run's own steps, in order.
    time_input = replayed.observations[:steps, 0, 2] * 20
    assert time_input == pytest.approx(np.arange(steps) % 20, abs=1e-4)
    assert model.critic.optimizer.state_dict()["state"]
    assert TD3.load(path, device="cpu").num_timesteps == steps


def test_a_run_that_was_killed_after_its_last_step_is_only_evaluated(killed, tmp_path):
    copy_files(killed, tmp_path / "run")
    before = RunRecord.read(killed)
    assert before is not None
    result = short(tmp_path / "run", seed=3, steps=before.steps_done, resume=True)
    assert result.record.steps_done == before.steps_done
    assert result.model_path.exists()
    # On-policy algorithms finish their rollout: more steps are done than were asked for.
    before.updated(steps=20).continuing(before.updated(steps=20), tmp_path)


def test_the_seeds_of_a_resumed_session_are_those_of_every_version():
    assert [random_seed(3, 200), random_seed(0, 1)] == [319665505, 1982462498]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"seed": 4}, "seed"),
        ({"steps": 20}, "steps"),
        ({"algorithm": "SAC"}, "algorithm"),
        ({"action_range": "unit"}, "action_range"),
        ({"num_envs": 2}, "num_envs"),
        ({"hyperparameters": {"gamma": 0.5}}, r"hyperparameters\.gamma"),
        ({"hyperparameters": {"tau": 0.5}}, r"hyperparameters\.tau"),
    ],
)
def test_another_plan_cannot_be_resumed(killed, change, field):
    before = (killed / "run.json").read_bytes()
    with pytest.raises(OptionError, match=f"^{field}="):
        short(killed, **{"seed": 3, "steps": 100_000, "resume": True, **change})
    assert (killed / "run.json").read_bytes() == before


def test_a_broken_checkpoint_is_refused_with_a_remedy(killed, tmp_path):
    folder = tmp_path / "run"
    copy_files(killed, folder)
    (folder / "checkpoint.zip").write_bytes(b"PK\x03\x04 no checkpoint")
    with pytest.raises(PolicyError, match="--force"):
        short(folder, seed=3, resume=True)


def test_a_run_killed_before_its_first_checkpoint_starts_again(tmp_path):
    folder = tmp_path / "run"
    finished = short(folder, steps=40)
    finished.record.updated(status="running", steps_done=0).write(folder)
    (folder / "checkpoint.zip").unlink()
    again = short(folder, steps=40, resume=True)
    assert [e.regret for e in again.episodes] == [e.regret for e in finished.episodes]

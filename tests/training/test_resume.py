"""Resuming a killed run from its checkpoint."""

from __future__ import annotations

import io
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sme_registry.errors import (
    OptionError,
    PolicyError,
)
from sme_registry.training import RunRecord
from sme_registry.training.episodes import read_episodes
from tests.training.runs import TINY, copy_files, short

pytest.importorskip("stable_baselines3")

_SCRIPT = """
import sys
from sme_registry import SMESpec
from sme_registry.training import train
spec = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)
train(spec, steps=100_000, seed=3, folder=sys.argv[1], checkpoint_every=50,
      hyperparameters={"gamma": 0.9}, protocol={"states_per_region": 50}, progress=False)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_a_killed_run_resumes_from_its_checkpoint(killed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    copy_files(killed, folder)
    before = RunRecord.read(folder)
    assert before is not None
    assert before.status == "running"
    logged = read_episodes(folder / "episodes.csv")
    steps = before.steps_done + 60

    with pytest.raises(OptionError, match="--resume"):
        short(folder, seed=3, steps=steps)
    result = short(folder, seed=3, steps=steps, resume=True)

    assert result.record.sessions == 2
    assert result.record.steps_done == steps
    kept = [episode for episode in logged if episode.step <= before.steps_done]
    assert kept
    assert list(result.episodes[: len(kept)]) == kept
    assert len(result.episodes) > len(kept)
    numbers = [episode.episode for episode in result.episodes]
    assert numbers == list(range(1, len(numbers) + 1))
    assert result.episodes[-1].step > before.steps_done
    assert result.episodes[-1].wall_seconds > kept[-1].wall_seconds
    # Its starts are drawn from another stream than those of the first session.
    with zipfile.ZipFile(folder / "checkpoint.zip") as archive:
        replay = np.load(io.BytesIO(archive.read("sme_replay_buffer.npz")))
    starts = replay["observations"][[0, before.steps_done], 0, :2]
    assert not np.array_equal(starts[0], starts[1])


def test_the_checkpoint_holds_the_model_its_optimisers_and_its_replay_buffer(
    killed: Path,
) -> None:
    from stable_baselines3 import TD3

    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training import checkpoint

    path = killed / "checkpoint.zip"
    model = checkpoint.load(TD3, path, SMEVecEnv(TINY, 1), buffer_size=5_000)
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


def test_a_run_that_was_killed_after_its_last_step_is_only_evaluated(
    killed: Path, tmp_path: Path
) -> None:
    copy_files(killed, tmp_path / "run")
    before = RunRecord.read(killed)
    assert before is not None
    result = short(tmp_path / "run", seed=3, steps=before.steps_done, resume=True)
    assert result.record.steps_done == before.steps_done
    assert result.model_path.exists()
    # On-policy algorithms finish their rollout: more steps are done than were asked for.
    before.updated(steps=20).continuing(before.updated(steps=20), tmp_path)


def test_resuming_twice_from_one_checkpoint_gives_the_same_run(
    killed: Path, tmp_path: Path
) -> None:
    reports = []
    for name in ("one", "two"):
        copy_files(killed, tmp_path / name)
        record = RunRecord.read(killed)
        assert record is not None
        result = short(tmp_path / name, seed=3, steps=record.steps_done + 40, resume=True)
        reports.append(result.report.regions)
    assert reports[0] == reports[1]


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
def test_another_plan_cannot_be_resumed(killed: Path, change: dict[str, Any], field: str) -> None:
    before = (killed / "run.json").read_bytes()
    with pytest.raises(OptionError, match=f"^{field}="):
        short(killed, **{"seed": 3, "steps": 100_000, "resume": True, **change})
    assert (killed / "run.json").read_bytes() == before


def test_hyperparameters_are_kept_and_may_be_left_out(killed: Path, tmp_path: Path) -> None:
    from stable_baselines3 import TD3

    copy_files(killed, tmp_path / "run")
    record = RunRecord.read(killed)
    assert record is not None
    assert record.hyperparameters == {"gamma": 0.9}
    steps = record.steps_done + 20
    result = short(tmp_path / "run", seed=3, steps=steps, resume=True)
    assert result.record.hyperparameters == {"gamma": 0.9}
    assert TD3.load(result.model_path, device="cpu").gamma == 0.9


def test_a_broken_checkpoint_is_refused_with_a_remedy(killed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    copy_files(killed, folder)
    (folder / "checkpoint.zip").write_bytes(b"PK\x03\x04 no checkpoint")
    with pytest.raises(PolicyError, match="--force"):
        short(folder, seed=3, resume=True)


def test_a_run_killed_before_its_first_checkpoint_starts_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    finished = short(folder, steps=40)
    finished.record.updated(status="running", steps_done=0).write(folder)
    (folder / "checkpoint.zip").unlink()
    again = short(folder, steps=40, resume=True)
    assert [e.regret for e in again.episodes] == [e.regret for e in finished.episodes]

"""`train`: one algorithm on one task, its exact regret logged, evaluated at the end.

The agents of a team share one policy, which is told whom it acts for (`envs.shared`).

The folder of a run:
    run.json          what was run, and how far it got
    episodes.csv      one row for each finished episode
    checkpoint.zip    model and replay buffer, to resume from
    model.zip         the trained model
    evaluation.json   its evaluation; training_curve.png, decay_curve.png where matplotlib is
    tensorboard/      where TensorBoard is installed
"""

from __future__ import annotations

import importlib.util
import io
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, evaluate, resolve_protocol
from sme_registry.io import write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec, catalogue
from sme_registry.task import load_spec, materialize
from sme_registry.terminal.interrupts import defer_interrupts
from sme_registry.terminal.progress import Progress
from sme_registry.training import checkpoint
from sme_registry.training import episodes as episode_files
from sme_registry.training.algorithms import (
    default_algorithm,
    default_num_envs,
    known_algorithm,
    load_algorithm,
    one_thread,
    quiet,
    refuse_without_dependencies,
    replay_settings,
    rollout_steps,
)
from sme_registry.training.episodes import Episode, EpisodeLog
from sme_registry.training.record import DEFAULTS, RunRecord, installed_versions
from sme_registry.training.record import FILE as RECORD

if TYPE_CHECKING:
    from sme_registry.training.callback import RunCallback

MODEL = "model.zip"
EVALUATION = "evaluation.json"
TRAINING_CURVE = "training_curve.png"
DECAY_CURVE = "decay_curve.png"
SIMILARITY_MAP = "similarity_map.png"
REPORT = "report.md"  # which `sme demo` adds
TENSORBOARD = "tensorboard"
_OWN_FILES = (
    RECORD, episode_files.FILE, checkpoint.FILE, MODEL, EVALUATION,
    TRAINING_CURVE, DECAY_CURVE, SIMILARITY_MAP, REPORT,
)  # fmt: skip

MAX_STEPS = 10**10
_CHECKPOINTS = 20
_FEWEST_STEPS_BETWEEN_CHECKPOINTS = 1_000


@dataclass(frozen=True)
class TrainingResult:
    """A finished run.

    Attributes:
      folder: where everything is.
      record: what `run.json` holds.
      episodes: what `episodes.csv` holds.
      report: the evaluation of the final model.
      figures: the figures written; none where matplotlib is not installed.
    """

    folder: Path
    record: RunRecord
    episodes: tuple[Episode, ...]
    report: EvaluationReport
    figures: tuple[Path, ...]

    @property
    def model_path(self) -> Path:
        """The trained model, for SB3's `load`."""
        return self.folder / MODEL


def train(
    spec: SMESpec | dict[str, Any] | str | os.PathLike[str],
    *,
    algorithm: str | None = None,
    steps: int = 20_000,
    seed: int = 0,
    folder: str | os.PathLike[str],
    action_range: Literal["unit", "symmetric"] = "symmetric",
    num_envs: int | None = None,
    checkpoint_every: int | None = None,
    protocol: EvaluationProtocol | dict[str, Any] | str | os.PathLike[str] = "paper-v1",
    progress: bool = True,
    console: Console | None = None,
    resume: bool = False,
    force: bool = False,
) -> TrainingResult:
    """Train one SB3 algorithm, with SB3's default hyperparameters, on the CPU.

    One exception: on a team PPO's rollout of 2,048 transitions is shared out over the agents of
    all teams, at least 16 steps each, instead of 2,048 for each of them.

    A resumed run goes on from its last checkpoint: the same networks, optimisers, replay buffer
    and step count. It is not the run that would have been without the kill, to the bit: random
    streams are seeded anew, and the episodes under way (and for PPO and A2C the rollout) begin
    again. What was logged after the checkpoint is dropped and lived through again.

    Args:
      spec: the task: a spec, its fields, an id, a digest or a path.
      algorithm: "TD3", "SAC", "DDPG", "PPO" or "A2C", in any case; None takes TD3, and for a team
        PPO.
      steps: environment steps over all environments, at least 1. A step of a team is one step of
        all its n agents, n transitions to learn from. PPO and A2C finish their last rollout.
      seed: of the algorithm and of the environment's starts, in [0, 2**32 - num_envs].
      folder: where to write; made if missing.
      action_range: of the policy's actions, "symmetric" [−1, 1] or "unit" [0, 1].
      num_envs: environments (of a team: teams) stepped at once, in [1, 4096]; None takes 1, and
        for a team with PPO or A2C 8. Off-policy algorithms still learn once for each step of all
        of them, so more mean fewer updates.
      checkpoint_every: steps between checkpoints; None takes a twentieth of `steps`, at least
        1,000.
      protocol: of the evaluation at the end.
      progress: whether to show a bar (lines every few seconds where there is no terminal).
      console: where to show it; None for standard error.
      resume: go on with the run in the folder, if there is one; `steps` may have grown.
      force: remove the run in the folder and begin anew.

    Returns:
      The finished run.

    Raises:
      UnknownNameError, SpecError: no such task, algorithm or protocol, or a field out of range.
      OptionError: another argument is outside its range, the folder holds another run, a finished
        one, or files that are none of a run, or it cannot be written to.
      PolicyError: the checkpoint cannot be resumed from.
      ResourceLimitError: the task would not fit in memory.
      MissingDependencyError: Stable-Baselines3 or PyTorch is not installed.
    """
    resolved = load_spec(spec)
    algorithm = known_algorithm(default_algorithm(resolved) if algorithm is None else algorithm)
    if num_envs is None:
        num_envs = default_num_envs(resolved, algorithm)
    _in_range("steps", steps, 1, MAX_STEPS)
    _in_range("num_envs", num_envs, 1, 4096)
    _in_range("seed", seed, 0, 2**32 - num_envs)
    if checkpoint_every is None:
        checkpoint_every = max(_FEWEST_STEPS_BETWEEN_CHECKPOINTS, steps // _CHECKPOINTS)
    _in_range("checkpoint_every", checkpoint_every, 1, MAX_STEPS)
    if action_range not in ("unit", "symmetric"):
        raise OptionError(f"action_range={action_range!r}: must be 'unit' or 'symmetric'.")
    judged_by = resolve_protocol(protocol)
    n_steps = rollout_steps(resolved, algorithm, num_envs)
    asked = RunRecord(
        status="running",
        hyperparameters=DEFAULTS if n_steps is None else f"{DEFAULTS}, but n_steps={n_steps}",
        spec=resolved,
        spec_digest=resolved.digest,
        algorithm=algorithm,
        seed=seed,
        action_range=action_range,
        num_envs=num_envs,
        agents=1 if resolved.team is None else len(resolved.team.agents),
        steps=steps,
        checkpoint_every=checkpoint_every,
        protocol=judged_by,
        protocol_digest=judged_by.digest,
        versions=installed_versions(),
    )
    refuse_without_dependencies()
    materialize(resolved)  # what cannot be drawn is refused before a folder is made
    folder = Path(folder)
    before = _claim(folder, asked, resume=resume, force=force)
    asked.updated(**before).write(folder)
    with quiet(), one_thread():
        record, episodes, model = _learn(asked.updated(**before), folder, progress, console)
        report = _evaluate(model, record, folder, progress, console)
        figures = _draw(report, folder, model)
    record = record.updated(status="finished")
    record.write(folder)
    return TrainingResult(folder, record, tuple(episodes), report, figures)


def _in_range(name: str, value: Any, low: int, high: int) -> None:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise OptionError(f"{name}={value!r}: must be an integer in [{low}, {high}].")


def _claim(folder: Path, asked: RunRecord, *, resume: bool, force: bool) -> dict[str, Any]:
    """Make the folder ready; the fields of an earlier session that a resumed run takes over.

    Raises:
      OptionError: the folder holds what must not be touched.
    """
    if folder.exists() and not folder.is_dir():
        raise OptionError(f"folder={str(folder)!r}: is a file. Give a folder, or a new name.")
    found = RunRecord.read(folder) if not force else None
    if found is None:
        strangers = [path.name for path in folder.glob("*") if path.name not in _removable(force)]
        if strangers:
            raise OptionError(
                f"folder={str(folder)!r}: holds files that are no run's, such as "
                f"{sorted(strangers)[0]!r}. Give an empty or a new folder."
            )
        for name in _OWN_FILES:
            (folder / name).unlink(missing_ok=True)
        shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)
        return {}
    if found.status == "finished":
        raise OptionError(
            f"folder={str(folder)!r}: holds a finished run of {found.algorithm}. Give another "
            "folder, or --force (in Python force=True) to replace it."
        )
    if not resume:
        raise OptionError(
            f"folder={str(folder)!r}: holds a run of {found.algorithm} that stopped. Give --resume "
            "to go on with it from its last checkpoint, or --force to replace it "
            "(in Python resume=True, force=True)."
        )
    found.refuse_other_plan(asked, folder)
    return {"sessions": found.sessions + 1, "steps_done": found.steps_done}


def _removable(force: bool) -> tuple[str, ...]:
    """What may lie in a folder without being a stranger: with `force`, all that a run writes."""
    return (*_OWN_FILES, TENSORBOARD) if force else ()


def _learn(
    record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode], Any]:
    """Train, from the start or the checkpoint; write the model, and the record of it."""
    from stable_baselines3.common.vec_env import VecMonitor

    from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
    from sme_registry.training.callback import RunCallback

    algorithm = load_algorithm(record.algorithm)
    team = record.spec.team
    names = () if team is None else tuple(agent.name for agent in team.agents)
    kind = SMEVecEnv if team is None else SMETeamVecEnv
    env = VecMonitor(kind(record.spec, record.num_envs, action_range=record.action_range))  # type: ignore[arg-type, unused-ignore]
    has_tensorboard = importlib.util.find_spec("tensorboard") is not None
    settings: dict[str, Any] = {
        "tensorboard_log": str(folder / TENSORBOARD) if has_tensorboard else None
    }
    transitions = (record.steps + record.num_envs) * record.agents
    settings |= replay_settings(algorithm, transitions)
    n_steps = rollout_steps(record.spec, record.algorithm, record.num_envs)
    if n_steps is not None:
        settings["n_steps"] = n_steps

    path = folder / checkpoint.FILE
    if record.sessions > 1 and path.exists():
        model = checkpoint.load(algorithm, path, env, **settings)
        # Another stream than the first session's, and the same one whenever this is repeated.
        sequence = np.random.SeedSequence([record.seed, model.num_timesteps])
        model.set_random_seed(int(sequence.generate_state(1)[0] >> 1))
    else:
        model = algorithm("MlpPolicy", env, seed=record.seed, device="cpu", **settings)
    begun_at = int(model.num_timesteps) // record.agents  # SB3 counts each agent's steps

    log = EpisodeLog(folder / episode_files.FILE, begun_at, names)
    wall_before = log.episodes[-1].wall_seconds if log.episodes else 0.0

    def save_checkpoint(steps_done: int) -> None:
        with defer_interrupts():
            checkpoint.save(model, path)
            record.updated(**_so_far(steps_done, log, callback)).write(folder)

    # What will be done: on-policy algorithms collect whole rollouts.
    rollout = 1 if "buffer_size" in settings else model.n_steps
    chunk = rollout * record.num_envs
    total = begun_at + -(-max(0, record.steps - begun_at) // chunk) * chunk
    with Progress(
        f"training {record.algorithm}", total, done=begun_at, console=console, shown=progress
    ) as bar:
        callback = RunCallback(
            log, bar, save_checkpoint, record.checkpoint_every, wall_before, names
        )
        try:
            if begun_at < record.steps:
                model.learn(
                    (record.steps - begun_at) * record.agents,
                    callback=callback,
                    reset_num_timesteps=begun_at == 0,
                    tb_log_name="run",
                )
                save_checkpoint(callback.steps_done)
        finally:
            log.close()
            env.close()
    steps_done = int(model.num_timesteps) // record.agents
    record = record.updated(**_so_far(steps_done, log, callback))
    saved = io.BytesIO()
    with defer_interrupts():
        model.save(saved)
        write_atomically(folder / MODEL, saved.getvalue())
        record.write(folder)
    return record, log.episodes, model


def _so_far(steps_done: int, log: EpisodeLog, callback: RunCallback) -> dict[str, Any]:
    seconds = callback.wall_seconds
    return {
        "steps_done": steps_done,
        "episodes": len(log.episodes),
        "wall_seconds": round(seconds, 3),
        "steps_per_second": round(steps_done / max(seconds, 1e-9), 3),
    }


def _evaluate(
    model: Any, record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> EvaluationReport:
    states = record.protocol.states_per_region * len(record.protocol.edges)
    with Progress("evaluating", states, console=console, unit="states", shown=progress) as bar:
        report = evaluate(
            model,
            record.spec,
            record.protocol,
            action_range=record.action_range,
            name=record.algorithm,
            progress=lambda done, total: bar.update(done),
        )
    report.write(folder / EVALUATION)
    return report


def _draw(report: EvaluationReport, folder: Path, model: Any) -> tuple[Path, ...]:
    """The figures of a run, in its folder; none where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        return ()
    from sme_registry import plots

    figures = []
    log = folder / episode_files.FILE
    if episode_files.read_episodes(log):
        title = f"{report.policy} on {catalogue.title(report.spec)}"
        figures.append(plots.training_curve(log, folder / TRAINING_CURVE, title=title))
    figures.append(plots.decay_curve(report, folder / DECAY_CURVE))
    if report.spec.state_dim == 2 and report.spec.team is None:
        path = folder / SIMILARITY_MAP
        figures.append(plots.similarity_map(model, report.spec, path, name=report.policy))
    return tuple(figures)

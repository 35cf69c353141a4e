"""`train`: train one algorithm on one task or stream, with exact regret of every episode.

The folder of a run, which `resume` continues after an interruption, and of which one process at a
time writes the files:
    run.json          the run and its progress
    episodes.csv      one row for each finished episode
    checkpoint.zip    model and replay buffer, for resuming
    model.zip         the trained model, of Stable-Baselines3, also where it was trained in JAX
    model/            instead: one model for each agent of a team, `<agent>.zip`
    evaluation.json   its evaluation
    stream.json       instead, of a life in a stream: what it retained and what it cost
    snapshots/        and its models at the end of each visit (`record`)
    *.png, *.pdf      figures, if matplotlib is installed
    tensorboard/      if TensorBoard is installed
"""

from __future__ import annotations

import contextlib
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from sme_registry.envs.episodes import Episode
from sme_registry.errors import OptionError
from sme_registry.evaluation import (
    EvaluationReport,
    StreamReport,
    dynamic_regret,
    evaluate,
    evaluate_stream,
    reference_regret,
)
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io import (
    Lock,
    choice,
    claim_folder,
    file_lock,
    integer_in,
    is_installed,
    is_locked,
)
from sme_registry.io.terminal import Progress, err
from sme_registry.plots import reports as plot_files
from sme_registry.plots.maps import STREAM
from sme_registry.spec import SMESpec, StreamSpec, catalogue
from sme_registry.spec.sme_spec import ACTION_RANGES, ActionRange, SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.spec.suite import ProtocolLike
from sme_registry.task import load
from sme_registry.task.loading import materialize_segments
from sme_registry.training.algorithms import (
    Entry,
    check_hyperparameters,
    default_algorithm,
    default_num_envs,
    find,
    full_name,
    imported,
    load_algorithm,
    needs_device,
    nested_hyperparameters,
    quiet,
    short_name,
)
from sme_registry.training.functions import source_of
from sme_registry.training.learn import Run, learn
from sme_registry.training.record import (
    CHECKPOINT,
    EPISODES,
    MODEL,
    MODELS,
    RECORD,
    SNAPSHOTS,
    TENSORBOARD,
    RunRecord,
    Snapshots,
    read_episodes,
    versions_for,
)

EVALUATION = "evaluation.json"
REPORT = "report.md"  # written by `sme demo`
EXPLORER = "explorer.html"  # written by `sme train` and `sme diagnose --explore`
_FILES = (
    RECORD, EPISODES, CHECKPOINT, MODEL, MODELS, SNAPSHOTS, EVALUATION, STREAM, *plot_files.FILES,
    REPORT, EXPLORER, TENSORBOARD,
)  # fmt: skip
_BOARD = "leaderboard"  # the folder of `sme-leaderboard demo`, which replaces it itself

_LOCK = ".lock"  # held by the process that trains; the file stays
MAX_STEPS = 10**10
DEFAULT_STEPS = 20_000
_CHECKPOINTS = 20
_MIN_STEPS_BETWEEN_CHECKPOINTS = 1_000


@dataclass(frozen=True)
class TrainingResult:
    """A finished run."""

    folder: Path
    record: RunRecord  # the content of `run.json`
    episodes: tuple[Episode, ...] = field(repr=False)  # the content of `episodes.csv`
    report: EvaluationReport | StreamReport  # of the final model, or of the life in a stream
    figures: tuple[Path, ...]  # empty if matplotlib is not installed

    @property
    def model_path(self) -> Path:
        """Path of the trained model, for SB3's `load`; of independent agents, of their folder."""
        return self.folder / self.record.model_name

    def _repr_html_(self) -> str:
        return self.report._repr_html_()


def train(
    spec: SpecLike | StreamLike,
    *,
    algorithm: str | None = None,
    steps: int | None = None,
    seed: int = 0,
    folder: str | os.PathLike[str],
    hyperparameters: Mapping[str, Any] | None = None,
    independent: bool = False,
    action_range: ActionRange = "symmetric",
    num_envs: int | None = None,
    checkpoint_every: int | None = None,
    protocol: ProtocolLike | None = None,
    progress: bool = True,
    console: Console | None = None,
    resume: bool = False,
    force: bool = False,
    agents: str | None = None,
    device: str | None = None,
) -> TrainingResult:
    """Train one algorithm on one task or stream: with Stable-Baselines3 on the CPU, or in JAX.

    Hyperparameters that are not given have the algorithm's defaults, except in several environments
    or for a team, where `n_steps` or `gradient_steps` keep the algorithm what it is in one.
    `run.json` records all that differ from the defaults.

    A resumed run continues from its last checkpoint, with the same networks, optimisers, replay
    buffer and step count, but not bit for bit: random streams are seeded again, and the current
    episodes (for PPO and A2C the current rollout) restart. In JAX it is the uninterrupted run, bit
    for bit on the same device and versions.

    On a stream the agent lives through all phases, and `folder/snapshots` keeps its model at the
    end of each visit. A resumed life goes on at the step of its checkpoint.

    Args:
      algorithm: a name (see `algorithms`) in any case, an entry point, "module:Class", or
        "train:module:function"; None takes TD3, and PPO for a team.
      steps: environment steps over all environments; None takes 20,000, and those of a stream. One
        step of a team is a step of all its agents. PPO and A2C finish their last rollout.
      hyperparameters: as JSON values, such as
        {"learning_rate": 1e-4, "policy_kwargs": {"net_arch": [64, 64]}}. Dotted names are nested.
        Of "train:module:function", keyword arguments.
      independent: whether each agent of a team has a model of its own, which learns from its
        observations and rewards; otherwise they share one. For on-policy algorithms.
      action_range: of the policy's actions, "symmetric" [−1, 1] or "unit" [0, 1].
      num_envs: environments (or teams) stepped in parallel, in [1, 4096]; None takes 1, and 8 for a
        team and an on-policy algorithm. 1 on a stream and in JAX.
      checkpoint_every: steps between checkpoints; None takes a twentieth of `steps`, at least
        1,000.
      protocol: of the final evaluation; None takes "paper-v1", and "quick-v1" below 20,000 steps,
        after which it would take longer than the training.
      resume: continue the unfinished run in the folder; `steps` may be larger than before.
      force: remove the run in the folder and start again.
      agents: "jax" or "sb3", whose implementation is trained; None for the one that `algorithm`
        names.
      device: of agents in JAX, "cpu", "gpu" or "tpu"; None for JAX's default.

    Examples:
      >>> from sme_registry.training import train
      >>> result = train(
      ...     "Default",
      ...     algorithm="PPO",
      ...     steps=128,
      ...     folder="runs/mine",
      ...     hyperparameters={"n_steps": 128, "batch_size": 64},
      ...     protocol="quick-v1",
      ...     progress=False,
      ... )
      >>> result.record.steps_done
      128
    """
    document = load(spec)
    stream = document if isinstance(document, StreamSpec) else None
    task = document.specs[0]
    steps = _steps(document, steps)
    if checkpoint_every is None:
        checkpoint_every = max(_MIN_STEPS_BETWEEN_CHECKPOINTS, steps // _CHECKPOINTS)
    choice("action_range", action_range, ACTION_RANGES)
    protocol = resolve_protocol(protocol or default_protocol(steps))
    uses = full_name(default_algorithm(document) if algorithm is None else algorithm, agents)
    entry = find(f"independent:{uses}" if independent else uses)
    entry.check_learns()
    independent = entry.kind == "independent"
    hyperparameters = nested_hyperparameters(hyperparameters or {})
    with quiet():
        entry.check_task(document)
        check_hyperparameters(entry.uses, hyperparameters)
        num_envs = _num_envs(document, entry, num_envs)
        plan = RunRecord(
            status="running",
            spec=task,
            spec_digest=task.digest,
            stream=stream,
            stream_digest="" if stream is None else stream.digest,
            task=document.name,
            algorithm=entry.name if independent else entry.uses,
            hyperparameters=hyperparameters,
            device=_device(entry, device),
            source=source_of(entry.uses) or "",
            seed=integer_in("seed", seed, 0, 2**32 - num_envs),
            action_range=action_range,
            num_envs=num_envs,
            agents=len(task.agents),
            independent=independent,
            steps=steps,
            checkpoint_every=integer_in("checkpoint_every", checkpoint_every, 1, MAX_STEPS),
            protocol=protocol,
            protocol_digest=protocol.digest,
            versions=versions_for(entry.uses),
        )
    materialize_segments(document)  # fails before the folder is created
    folder = Path(folder)
    record = _new_or_continued(folder, plan, resume=resume, force=force)
    with entry.surroundings():
        run = Run(
            document=document,
            seed=record.seed,
            steps=record.steps,
            hyperparameters=record.hyperparameters,
            action_range=record.action_range,
            num_envs=record.num_envs,
            device=record.device,
            piece=min(100, record.checkpoint_every),
        )
        with _show_advice(console or err()):
            learner = entry.learner(run)  # rejects hyperparameters before the folder is created
        record = record.updated(hyperparameters=learner.hyperparameters)
        if record.sessions == 1:
            claim_folder(folder, (*_FILES, _BOARD) if force else (), force=force)
        with _lock(folder):
            if record.sessions == 1:
                _remove_run(folder)
            record.write(folder)
            record, episodes = learn(learner, record, folder, progress, console)
            report, figures = _report(learner.model, record, episodes, folder, progress, console)
            record = record.updated(status="finished")
            record.write(folder)
    return TrainingResult(folder, record, tuple(episodes), report, figures)


def default_protocol(steps: int) -> str:
    """Of the final evaluation, which should not take longer than the training."""
    return "paper-v1" if steps >= DEFAULT_STEPS else "quick-v1"


@contextlib.contextmanager
def _show_advice(console: Console) -> Iterator[None]:
    """Print once what Stable-Baselines3 warns of hyperparameters, such as a truncated minibatch."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        yield
    advice = [each for each in caught if "stable_baselines3" in each.filename]
    for text in dict.fromkeys(str(each.message) for each in advice if each.category is UserWarning):
        message = " ".join(text.split())
        console.print(f"[yellow]note:[/] {escape(message)}", soft_wrap=True)


def _steps(document: SMESpec | StreamSpec, steps: int | None) -> int:
    if isinstance(document, SMESpec):
        return integer_in("steps", DEFAULT_STEPS if steps is None else steps, 1, MAX_STEPS)
    if steps not in (None, document.steps):
        raise OptionError(
            f"steps={steps!r}: must be {document.steps:,}, since an agent lives through the whole "
            f"stream {catalogue.title(document)}. Leave it out, or make another stream, whose "
            "phases have other steps."
        )
    document.check_visits()
    advice = "Make a stream with fewer cycles or phases, or with shorter ones."
    return integer_in("steps", document.steps, 1, MAX_STEPS, advice=advice)


def _num_envs(document: SMESpec | StreamSpec, entry: Entry, num_envs: int | None) -> int:
    if entry.backend.several and isinstance(document, SMESpec):
        default = default_num_envs(document, load_algorithm(entry.name))
        return integer_in("num_envs", default if num_envs is None else num_envs, 1, 4096)
    if num_envs not in (None, 1):
        raise OptionError(
            f"num_envs={num_envs!r}: must be 1 on a stream, since each environment would live a "
            "life of its own, and for an algorithm outside Stable-Baselines3. Leave it out."
        )
    return 1


def _device(entry: Entry, device: str | None) -> str:
    if entry.backend.device:
        return str(imported(entry.backend.device)(device).platform)
    if device is not None:
        raise needs_device("device", device, "; all others train on the CPU")
    return ""


def _new_or_continued(folder: Path, plan: RunRecord, *, resume: bool, force: bool) -> RunRecord:
    if is_locked(folder / _LOCK):
        raise _in_use(folder)
    previous = None if force else RunRecord.read(folder)
    if previous is None:
        if resume and not force:
            raise OptionError(
                f"{folder}: contains no run to resume. Leave out --resume to start one (in Python, "
                "resume=True), or give the folder of the run."
            )
        return plan
    if previous.status != "running":
        reason = f" ({previous.failure})" if previous.failure else ""
        raise OptionError(
            f"{folder}: contains a {previous.status} run of {previous.algorithm}{reason}. Only "
            "interrupted runs can be resumed, also with more steps. Give another folder, or use "
            "--force to replace it (in Python, force=True)."
        )
    if not resume:
        raise OptionError(
            f"{folder}: contains an unfinished run of {previous.algorithm}. Use --resume to "
            "continue it from its last checkpoint, or --force to replace it (in Python, "
            "resume=True or force=True)."
        )
    return plan.continuing(previous, folder)


def _lock(folder: Path) -> Lock:
    """The lock of a run's folder, which the system releases also when the process is killed."""
    lock = file_lock(folder / _LOCK)
    if lock is None:
        raise _in_use(folder)
    return lock


def _in_use(folder: Path) -> OptionError:
    return OptionError(
        f"{folder}: another process is training in this folder. Wait for it or stop it, or give "
        "another folder."
    )


def _remove_run(folder: Path) -> None:
    for name in _FILES:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name, ignore_errors=True)
        else:
            (folder / name).unlink(missing_ok=True)


def _report(
    model: Any,
    record: RunRecord,
    episodes: Sequence[Episode],
    folder: Path,
    progress: bool,
    console: Console | None,
) -> tuple[EvaluationReport | StreamReport, tuple[Path, ...]]:
    states = record.protocol.states_per_region * len(record.protocol.edges)
    options: dict[str, Any] = {
        "action_range": record.action_range,
        "name": f"{'independent ' * record.independent}{short_name(record.algorithm)}",
    }
    report: EvaluationReport | StreamReport
    with Progress("evaluating", states, console=console, unit="states", enabled=progress) as bar:
        options["progress"] = bar.update
        if record.stream is None:
            report = evaluate(model, record.spec, record.protocol, **options)
        else:
            report = _report_of_life(record, record.stream, folder, options)
    report.write(folder / (EVALUATION if record.stream is None else STREAM))
    return report, _draw(report, episodes, folder, model)


def _report_of_life(
    record: RunRecord, stream: StreamSpec, folder: Path, options: dict[str, Any]
) -> StreamReport:
    files = Snapshots(folder / SNAPSHOTS, stream)
    report = evaluate_stream(
        files.visits, stream, record.protocol, initial=files.initial, **options
    )
    episodes = read_episodes(folder / EPISODES)  # rounded alike in every session
    if not episodes:
        return report
    step, regret, length = zip(*((e.step, e.regret, e.length) for e in episodes), strict=True)
    log = dynamic_regret(stream, step, regret, length)
    frozen: dict[str, Any] = {"frozen": files.visits[0], "training": log}
    if log.visits[0].online_regret is None:  # where no episode of the first visit is in the log
        frozen = {}
    references = reference_regret(stream, **frozen)
    return report.with_dynamic_regret(log).with_reference_regret(references)


def _draw(
    report: EvaluationReport | StreamReport, episodes: Sequence[Episode], folder: Path, model: Any
) -> tuple[Path, ...]:
    if not is_installed("matplotlib"):
        return ()
    figures: list[Path] = []
    if episodes:
        title = f"{report.policy} on {report.title}"
        visits = report.visits if isinstance(report, StreamReport) else ()
        costs = episodes[0].safety is not None
        figures += plot_files.write_training(folder / EPISODES, folder, title, visits, costs)
    if isinstance(report, StreamReport):
        return (*figures, *plot_files.write_stream(report, folder))
    return (*figures, *plot_files.write_evaluation(report, folder, model))

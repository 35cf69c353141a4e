"""`sme train`: an algorithm on a task, a stream or a suite; `sme demo`: all of it on one task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from sme_registry import explorer, training
from sme_registry.cli.arguments import (
    Force,
    Json,
    Out,
    Protocol,
    changed,
    changes,
    find_file,
    only_with,
    print_training,
    print_written,
    with_options,
)
from sme_registry.cli.plan import Jobs, warn_of_uneven_rollouts
from sme_registry.cli.study import check_complete, print_status
from sme_registry.diagnosis import load_run
from sme_registry.errors import OptionError, SMEError
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io.markup import Table
from sme_registry.io.terminal import err, print_note
from sme_registry.spec import (
    EnvFile,
    SMESpec,
    StreamFile,
    StreamSpec,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteFile,
    catalogue,
)
from sme_registry.studies.runner import run_study
from sme_registry.task import load
from sme_registry.training import algorithms
from sme_registry.training.record import CHECKPOINT
from sme_registry.training.run import DEFAULT_STEPS

RUNS = 10
"""Runs on each class by default: those that a leaderboard requires for a rank."""

app = typer.Typer()

_EVALUATIONS = 10  # of a run, for the learning curves of `sme study report`
_OF_A_TASK = ("task", "seed", "num_envs", "checkpoint_every", "resume", "force")
_OF_A_SUITE = ("seeds", "jobs")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of a training on a task, a stream or each instance of a suite."""

    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            "-a",
            help="TD3, SAC, DDPG, PPO, A2C, module:Class, such as sb3_contrib:TQC, or "
            "train:module:function for a function of yours; for tasks with safety also "
            "PPOLagrangian, PPOProjection. Default TD3, for teams PPO.",
        ),
    ] = None
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="sb3|jax",
            help="Implementation of PPO, TD3 and SAC: of Stable-Baselines3 (default), or in JAX, "
            "with the environment in one program.",
        ),
    ] = None
    device: Annotated[
        str | None, typer.Option(help="Of agents in JAX: cpu, gpu or tpu. Default JAX's.")
    ] = None
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            "-n",
            help="Environment steps; for a team, of the team. Default 20,000, and those of a "
            "stream.",
        ),
    ] = None
    out_folder: Out = None
    action_range: Annotated[
        str, typer.Option(help="Action space: symmetric, [-1, 1], or unit, [0, 1].")
    ] = "symmetric"
    independent: Annotated[
        bool, typer.Option("--independent", help="One model for each agent of a team.")
    ] = False
    protocol: Protocol = "paper-v1"
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change a field of the task or a hyperparameter of the algorithm. Repeatable.",
        ),
    ] = None
    hyperparameters: Annotated[
        Path | None,
        typer.Option(metavar="CHECKPOINT", help="Hyperparameters in a JSON file.", dir_okay=False),
    ] = None

    def changes(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The changes of the task, and the hyperparameters from a file and from --set."""
        values = changes(self.set_)
        fields = {name: value for name, value in values.items() if name in SMESpec.model_fields}
        flat = {name: value for name, value in values.items() if name not in fields}
        settings = algorithms.nested_hyperparameters(flat)
        path = self.hyperparameters
        from_file = {} if path is None else algorithms.read_hyperparameters(path)
        for name in settings.keys() & from_file.keys():
            raise OptionError(f"--set {name}: {path} sets it, too. Remove one.")
        return fields, {**from_file, **settings}

    def uses(self, document: SMESpec | StreamSpec) -> str:
        algorithm = self.algorithm or algorithms.default_algorithm(document)
        return algorithms.full_name(algorithm, self.agents)

    def folder(self, label: str, uses: str, suffix: str = "") -> Path:
        name = f"{'independent-' * self.independent}{algorithms.folder_name(uses)}"
        return self.out_folder or Path("runs") / f"{label}-{name}{suffix}"


@app.command()
@with_options(Settings)
def train(
    context: typer.Context,
    options: Settings,
    task: Annotated[
        str | None,
        typer.Argument(
            metavar="TASK",
            help="The task or stream: a name, a path or a digest.",
            autocompletion=catalogue.completion(EnvFile, StreamFile),
        ),
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(
            help="Instead of a TASK: train on every instance of a suite, by its name or path.",
            autocompletion=catalogue.completion(SuiteFile),
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the algorithm and of the start states.")] = 0,
    seeds: Annotated[
        int | None,
        typer.Option(
            help="With --suite: runs on each class, in turn on its instances. Default 10, or more "
            "for equally many on each instance.",
        ),
    ] = None,
    jobs: Jobs = None,
    num_envs: Annotated[
        int | None,
        typer.Option(
            help="Environments (teams) at once; the algorithm stays the same. Default 1; on-policy "
            "for a team 8."
        ),
    ] = None,
    checkpoint_every: Annotated[
        int | None,
        typer.Option(help="Steps between checkpoints; default a twentieth of all, at least 1,000."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Train an algorithm, log the exact regret of each episode, and evaluate the trained policy.

    The output folder, by default runs/TASK-ALGORITHM-seedN, contains episodes.csv, checkpoint.zip,
    model.zip, run.json, evaluation.json, figures, explorer.html (`sme explore`), and logs that
    `tensorboard --logdir runs` shows; of a stream, stream.json and a model for each visit.

    --set changes a field of the task (`sme show TASK`) or a hyperparameter, whose names and
    defaults are those of the algorithm's class in Stable-Baselines3. Values are JSON or text; dots
    lead into a block, as in policy_kwargs.net_arch=[64,64].

    The agents of a team share one policy (for its observation see `sme evaluate --help`). With
    --independent, each agent has a model of its own, which learns from its own rewards.

    --suite trains on all instances of a suite at once, as `sme study run --keep-models` would, into
    runs/SUITE-ALGORITHM, a study's folder: the same command continues it, `sme study status` and
    `report` read it, and `sme-leaderboard submit` submits it.

    --resume continues an interrupted run from its last checkpoint; --steps may be larger.

    Examples:

      sme train Default --steps 20000 --seed 1
      sme train Default -a PPO -n 100000 --agents jax
      sme train Default -a PPO -n 100000 --num-envs 8 --set complexity=10 --set learning_rate=1e-4
      sme train Default -a sb3_contrib:TQC --set top_quantiles_to_drop_per_net=5
      sme train mine.json --out runs/mine --resume
      sme train Team4 --steps 40000
      sme train Team4 --independent --steps 40000
      sme train Switch5 -a PPO --agents jax
      sme train Safety20 -a PPOLagrangian -n 100000 --set cost_limit=0.02
      sme train --suite mine.json -a PPO --out runs/mine
    """
    if suite is not None:
        only_with(context, _OF_A_TASK, "is for a single task. Leave it out, or --suite")
        _train_suite(context, suite, options, seeds, jobs, json=json)
        return
    only_with(context, _OF_A_SUITE, "is for --suite. Add --suite, or leave it out")
    if task is None:
        raise OptionError("Give a TASK or --suite, such as Default. See `sme train --help`.")
    overrides, settings = options.changes()
    document = load(task)
    if isinstance(document, StreamSpec):
        overrides |= {name: settings[name] for name in settings if name in StreamSpec.model_fields}
    document = changed(document, task, overrides)
    uses = options.uses(document)
    algorithms.check_hyperparameters(uses, settings, others=SMESpec.model_fields)
    folder = options.folder(_label(task, document, changed=bool(overrides)), uses, f"-seed{seed}")
    result = _train(
        document,
        folder,
        "the same command with --resume",
        algorithm=uses,
        steps=options.steps,
        seed=seed,
        hyperparameters=settings,
        independent=options.independent,
        action_range=options.action_range,
        num_envs=num_envs,
        checkpoint_every=checkpoint_every,
        protocol=options.protocol,
        resume=resume,
        force=force,
        agents=options.agents,
        device=options.device,
    )
    if result.record.stream is None:
        _write_explorer(folder)
    print_training(result, folder, json=json)


def _train(
    document: SMESpec | StreamSpec, folder: Path, continued_by: str, **settings: Any
) -> training.TrainingResult:
    """Train; an interrupt says that `continued_by` continues the run, if anything was written."""
    try:
        return training.train(document, folder=folder, console=err(), **settings)
    except KeyboardInterrupt:
        if training.RunRecord.read(folder) is None:
            message = "interrupted before the training began: nothing was written."
        else:
            has_checkpoint = (folder / CHECKPOINT).exists()
            saved = "up to its last checkpoint" if has_checkpoint else "without a checkpoint"
            message = (
                f"interrupted: the run is in {folder}, {saved}. Run {continued_by} to continue, or "
                "with --force to start again."
            )
        raise KeyboardInterrupt(message) from None


def _write_explorer(folder: Path) -> list[Path]:
    """Write the explorer of a run; where that cannot be, say so: the run is complete without."""
    try:
        path, report = folder / explorer.FILE, explorer.run_report(folder)
        return [explorer.write_explorer(path, load_run(folder), report=report)]
    except SMEError as error:
        print_note(f"no explorer: {escape(str(error))}")
        return []


def _label(task: str, document: SMESpec | StreamSpec, *, changed: bool) -> str:
    """A task's name in a folder's name; a changed or unnamed task is named by content."""
    if changed or task.startswith("sha256"):
        return document.content_name
    return Path(task).name.removesuffix(".json").removesuffix("-v1")


def _train_suite(
    context: typer.Context,
    name: str,
    options: Settings,
    seeds: int | None,
    jobs: int | None,
    *,
    json: bool,
) -> None:
    """Train on every instance of a suite and keep the models; the same call continues."""
    fields, settings = options.changes()
    for field in fields:
        raise OptionError(
            f"--set {field}: is a field of the task, and the suite sets it. Write another suite "
            f"with `sme suite new`, for example from `sme new task.json --set {field}=…`."
        )
    file = find_file(SuiteFile, name)
    suite = file.suite
    if not suite.classes:
        only_with(context, ("steps",), "is that of each stream here. Leave it out")
    first = suite.classes[0].instances[0] if suite.classes else suite.streams[0].stream
    uses = options.uses(first)
    folder = options.folder(file.name, uses)
    algorithm = {
        "name": algorithms.short_name(uses),
        "uses": f"independent:{uses}" if options.independent else uses,
        "hyperparameters": settings,
        "action_range": options.action_range,
    }
    members = {name: some for name, some in suite.to_dict().items() if some}
    fields = {name: members[name] for name in ("classes", "streams") if name in members}
    fields |= {
        "algorithms": [algorithm],
        "seeds": equal_runs(suite) if seeds is None else seeds,
        "steps": DEFAULT_STEPS if options.steps is None else options.steps,
        "evaluations": _EVALUATIONS,
        "protocol": resolve_protocol(options.protocol).to_dict(),
    }
    plan = StudyPlan.from_dict(fields, "options")
    warn_of_uneven_rollouts(plan)
    study = StudyFile(name=file.name, digest=plan.digest, plan=plan)
    status = run_study(
        study, folder, jobs=jobs, keep_models=True, device=options.device, console=err()
    )
    print_status(status, json)
    check_complete(status)
    if not json:
        print_note(f"[dim]{escape(_next_step(suite, plan, folder))}[/]")


def _next_step(suite: Suite, plan: StudyPlan, folder: Path) -> str:
    if suite.streams:
        return f"To see what the agents retain: sme study report {folder}"
    instances = max(suite.runs.values())
    if plan.seeds < instances:
        return f"A leaderboard needs a run on every instance: use --seeds {instances} or more."
    return f"To submit them: sme-leaderboard submit {folder} BOARD --method NAME --submitter NAME"


def equal_runs(suite: Suite) -> int:
    """At least `RUNS` on each class, and equally many on each instance of the largest class."""
    return max(-(-RUNS // instances) * instances for instances in suite.runs.values())


DEMO_FOLDER = Path("runs/demo")
# Networks of 64² units and batches of 128 learn this task in a third of the time of TD3's defaults.
_STEPS, _SETTINGS = 6_000, {"batch_size": 128, "policy_kwargs": {"net_arch": [64, 64]}}
_FULL_STEPS = 15_000


@app.command()
def demo(
    out_folder: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")] = DEMO_FOLDER,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            "-n",
            help=f"Training steps; default {_STEPS:,}, with --full {_FULL_STEPS:,}.",
        ),
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="TD3's default hyperparameters and a longer training.")
    ] = False,
    force: Force = False,
) -> None:
    """Train TD3 on SME/Default-v1, show its regret falling, evaluate it in and out of distribution.

    Takes less than a minute on one core, with networks of two layers of 64 units. --full takes a
    few minutes. Writes figures and explorer.html, and lists them.

    Examples:

      sme demo
      sme demo --full --out runs/full
    """
    if steps is None:
        steps = _FULL_STEPS if full else _STEPS
    print_note(
        f"Training TD3 on SME/Default-v1 for {steps:,} steps. The optimal action of every state "
        "is known, so the regret below is exact."
    )
    result = _train(
        load("Default-v1"),
        out_folder,
        f"`sme train Default-v1 --steps {steps} --out {out_folder} --resume`",
        steps=steps,
        hyperparameters={} if full else _SETTINGS,
        force=force or out_folder == DEMO_FOLDER,
    )
    files = [*result.figures, *_write_explorer(out_folder)]
    print_training(result, out_folder, [_regret_of_tenths(result)])
    print_written(files)


def _regret_of_tenths(result: training.TrainingResult) -> Table:
    """The mean regret of each tenth of the episodes."""
    episodes = np.array([(episode.step, episode.regret) for episode in result.episodes])
    rows = [
        {"up to step": int(steps[-1]), "regret": f"{regrets.mean():.3f}"}
        | {"": "█" * round(30 * regrets.mean())}
        for steps, regrets in (tenth.T for tenth in np.array_split(episodes, 10) if len(tenth))
    ]
    return Table.of("Mean regret during training (0 is optimal)", rows)

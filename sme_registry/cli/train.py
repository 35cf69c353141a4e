"""`sme train`: an algorithm on tasks or on a data set; `sme demo`: all of it on one task."""

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
    changes,
    load_changed,
    only_with,
    print_training,
    print_written,
    with_options,
)
from sme_registry.cli.plan import Agents, Jobs, warn_of_uneven_rollouts
from sme_registry.cli.study import check_complete, print_status
from sme_registry.datasets import open_dataset, train_offline
from sme_registry.datasets.documents import check_algorithm
from sme_registry.datasets.offline import train_sealed
from sme_registry.datasets.storage import is_sealed
from sme_registry.diagnosis import load_run
from sme_registry.errors import OptionError, SMEError
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io import check_new, read_json
from sme_registry.io.markup import Table
from sme_registry.io.terminal import Progress, count, err, print_json, print_line, print_note
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
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
from sme_registry.training.run import DEFAULT_STEPS, default_protocol

RUNS = 10
"""Runs on each class by default: those that a leaderboard requires for a rank."""

app = typer.Typer()

_EVALUATIONS = 10  # of a run, for the learning curves of `sme study report`
_OF_A_TASK = ("task", "num_envs", "checkpoint_every", "resume")
_OF_A_SUITE = ("seeds", "jobs")
_PASSED_ON = (  # to `training.train`
    *("steps", "seed", "independent", "action_range", "num_envs", "checkpoint_every"),
    *("resume", "force", "agents", "device"),
)
_OF_AN_ENVIRONMENT = ("agents", "device", "action_range", "independent", "hyperparameters")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of a training on a task, a stream, each instance of a suite, or a data set."""

    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            "-a",
            help="TD3, SAC, DDPG, PPO, A2C, module:Class, such as sb3_contrib:TQC, or "
            "train:module:function; for tasks with safety also PPOLagrangian, PPOProjection. "
            "Default TD3, for teams PPO; of --data bc or iql, the default.",
        ),
    ] = None
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            "-n",
            parser=count,
            metavar="INTEGER",
            help="Environment steps, for a team of the team; of --data gradient steps. Default "
            "20,000, and those of a stream.",
        ),
    ] = None
    seed: Annotated[int, typer.Option(help="Seed of the algorithm and of the start states.")] = 0
    out_folder: Out = None
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change a field of the task or a hyperparameter of the algorithm. Repeatable.",
        ),
    ] = None
    agents: Agents = None
    suite: Annotated[
        str | None,
        typer.Option(
            help="Instead of a TASK: train on every instance of a suite, by its name or path.",
            autocompletion=catalogue.completion(SuiteFile),
        ),
    ] = None
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATASET",
            help="Instead of a TASK: train on a data set, by its id from `sme data list` or its "
            "folder, never in the environment.",
        ),
    ] = None
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False
    force: Force = False
    json: Json = False
    protocol: Annotated[
        str | None,
        typer.Option(
            help="Evaluation protocol; default paper-v1, below 20,000 steps quick-v1, of --data "
            "the data set's.",
            autocompletion=catalogue.completion(ProtocolFile),
        ),
    ] = None
    hyperparameters: Annotated[
        Path | None, typer.Option(help="Hyperparameters in a JSON file.", dir_okay=False)
    ] = None
    num_envs: Annotated[
        int | None,
        typer.Option(
            help="Environments (teams) at once; the algorithm stays the same. Default 1; on-policy "
            "for a team 8."
        ),
    ] = None
    action_range: Annotated[
        str, typer.Option(help="Action space: symmetric, [-1, 1], or unit, [0, 1].")
    ] = "symmetric"
    independent: Annotated[
        bool, typer.Option("--independent", help="One model for each agent of a team.")
    ] = False
    checkpoint_every: Annotated[
        int | None,
        typer.Option(help="Steps between checkpoints; default a twentieth of all, at least 1,000."),
    ] = None
    device: Annotated[
        str | None, typer.Option(help="Of agents in JAX: cpu, gpu or tpu. Default JAX's.")
    ] = None
    seeds: Annotated[
        int | None,
        typer.Option(
            help="With --suite: runs on each class, in turn on its instances. Default 10, or more "
            "for equally many on each instance.",
        ),
    ] = None
    jobs: Jobs = None

    def changes(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The changes of the task, and the hyperparameters from a file and from --set."""
        values = changes(self.set_)
        fields = {name: value for name, value in values.items() if name in SMESpec.model_fields}
        flat = {name: value for name, value in values.items() if name not in fields}
        settings = algorithms.nested_hyperparameters(flat)
        path = self.hyperparameters
        from_file = {} if path is None else _read_hyperparameters(path)
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
@with_options
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
) -> None:
    """Train an algorithm, log the exact regret of each episode, and evaluate the trained policy.

    Writes the record, the model, figures and an explorer to runs/TASK-ALGORITHM-seedN. --set takes
    fields of the task (`sme show TASK`) and hyperparameters by their names in Stable-Baselines3.
    --suite writes a study's folder, which the same command continues and `sme study` reads. --data
    trains bc or iql on a data set, of a sealed one without an evaluation.

    Examples:

      sme train Default --steps 20000 --seed 1
      sme train Default -a PPO -n 1e5 --agents jax --set complexity=10 --set learning_rate=1e-4
      sme train mine.json --out runs/mine --resume
      sme train Team4 --independent --steps 40000
      sme train --suite mine.json -a PPO --out runs/mine
      sme train --data sme/Default-v1-nu50-seed7-v0 -a iql
    """
    if options.data is not None:
        foreign = (*_OF_A_TASK, "suite", *_OF_A_SUITE, *_OF_AN_ENVIRONMENT)
        only_with(context, foreign, "is not for --data. Leave one of them out")
        _train_on_data(context, options, options.data)
    elif options.suite is not None:
        others = (*_OF_A_TASK, "seed", "force")
        only_with(context, others, "is for a single task. Leave it out, or --suite")
        _train_suite(context, options, options.suite)
    else:
        only_with(context, _OF_A_SUITE, "is for --suite. Add --suite, or leave it out")
        if task is None:
            raise OptionError("Give a TASK, --suite or --data. See `sme train --help`.")
        _train_task(options, task)


def _train_task(options: Settings, task: str) -> None:
    overrides, settings = options.changes()
    document = load(task)
    if isinstance(document, StreamSpec):
        overrides |= {name: settings[name] for name in settings if name in StreamSpec.model_fields}
    document = load_changed(task, overrides)
    uses = options.uses(document)
    algorithms.find(uses).check_learns()
    algorithms.check_hyperparameters(uses, settings, others=SMESpec.model_fields)
    folder = options.folder(
        _label(task, document, changed=bool(overrides)), uses, f"-seed{options.seed}"
    )
    result = _train(
        document,
        folder,
        "the same command with --resume",
        algorithm=uses,
        hyperparameters=settings,
        protocol=options.protocol,
        **{name: getattr(options, name) for name in _PASSED_ON},
    )
    if result.record.stream is None:
        _write_explorer(folder)
    chosen = default_protocol(result.record.steps)
    if options.protocol is None and chosen != "paper-v1":
        print_note(
            f"Evaluated with {chosen}, since the training has fewer than {DEFAULT_STEPS:,} steps. "
            "Use --protocol paper-v1 for the full evaluation."
        )
    print_training(result, folder, json=options.json)


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


def _train_on_data(context: typer.Context, options: Settings, data: str) -> None:
    settings = changes(options.set_)
    algorithm, _ = check_algorithm(options.algorithm or "iql")
    steps = DEFAULT_STEPS if options.steps is None else options.steps
    arguments: dict[str, Any] = {"algorithm": algorithm, "steps": steps, "seed": options.seed}
    if "batch_size" in settings:
        arguments["batch_size"] = settings.pop("batch_size")
    arguments["hyperparameters"] = settings
    title = f"training {algorithm.upper()}"
    with Progress(title, max(1, steps), console=err()) as progress:
        if is_sealed(data):
            only_with(context, ("protocol",), "is of an evaluation, and sealed data have none")
            if options.out_folder is None:
                raise OptionError("--out: is required with a sealed data set: the policy's .npz.")
            if options.out_folder.suffix != ".npz":
                raise OptionError(f"--out {options.out_folder}: must end in .npz, as a policy.")
            check_new(options.out_folder, force=options.force)
            policy = train_sealed(data, **arguments, progress=progress.update)
            policy.save(options.out_folder)
            if options.json:
                print_json({"policy": str(options.out_folder)})
            else:
                print_line(escape(str(options.out_folder)))
            return
        dataset = open_dataset(data)
        name = f"{dataset.id.rsplit('/', 1)[-1]}-{algorithm}-seed{options.seed}"
        folder = options.out_folder or Path("runs") / name
        result = train_offline(
            dataset,
            **arguments,
            evaluations=min(20, max(1, steps)),
            protocol=options.protocol,
            folder=folder,
            force=options.force,
            progress=progress.update,
        )
    print_training(result, folder, [_improvement(result.record)], json=options.json)


def _improvement(record: Any) -> Table:
    algorithm = record.algorithm.upper()
    rows = [
        {"": f"behaviour, {record.transitions:,} transitions", "r̃": record.behaviour.similarity},
        {"": f"{algorithm}, {record.episodes} episodes", "r̃": record.evaluations[-1].similarity},
        {"": "improvement", "r̃": record.improvement},
    ]
    rows = [row | {"r̃": f"{row['r̃']:.3f}"} for row in rows]
    return Table.of(f"{algorithm} on {escape(record.dataset)}", rows)


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


def _train_suite(context: typer.Context, options: Settings, name: str) -> None:
    """Train on every instance of a suite and keep the models; the same call continues."""
    fields, settings = options.changes()
    for field in fields:
        raise OptionError(
            f"--set {field}: is a field of the task, and the suite sets it. Write another suite "
            "with `sme new`, such as sme new suite.json -t task.json."
        )
    file = catalogue.find(SuiteFile, name)
    suite = file.suite
    if not suite.classes:
        only_with(context, ("steps",), "is that of each stream here. Leave it out")
    uses = options.uses(suite.members[0].instances[0])
    folder = options.folder(file.name, uses)
    algorithm = {
        "name": algorithms.short_name(uses),
        "uses": f"independent:{uses}" if options.independent else uses,
        "hyperparameters": settings,
        "action_range": options.action_range,
    }
    fields = {
        "classes": suite.classes,
        "streams": suite.streams,
        "algorithms": [algorithm],
        "seeds": equal_runs(suite) if options.seeds is None else options.seeds,
        "steps": DEFAULT_STEPS if options.steps is None else options.steps,
        "evaluations": _EVALUATIONS,
        "protocol": resolve_protocol(options.protocol or "paper-v1").to_dict(),
    }
    plan = StudyPlan.from_dict(fields, "options")
    warn_of_uneven_rollouts(plan)
    study = StudyFile(name=file.name, digest=plan.digest, plan=plan)
    status = run_study(
        study, folder, jobs=options.jobs, keep_models=True, device=options.device, console=err()
    )
    print_status(status, options.json)
    check_complete(status)
    if not options.json:
        print_note(f"[dim]{escape(_next_step(suite, plan, folder))}[/]")


def _next_step(suite: Suite, plan: StudyPlan, folder: Path) -> str:
    if suite.streams:
        return f"To see what the agents retain: sme study report {folder}"
    instances = max(suite.runs.values())
    if plan.seeds < instances:
        return f"A leaderboard needs a run on every instance: use --seeds {instances} or more."
    return f"To submit them: sme-leaderboard submit {folder} BOARD --method NAME --submitter NAME"


def _read_hyperparameters(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict):
        raise OptionError(
            f"{path}: must be an object of hyperparameters, such as "
            '{"learning_rate": 0.0001, "policy_kwargs": {"net_arch": [64, 64]}}.'
        )
    return algorithms.nested_hyperparameters(values)


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
        protocol="paper-v1",
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

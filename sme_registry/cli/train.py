"""`sme train`: an algorithm on a task, a stream or a suite."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer
from rich.markup import escape

from sme_registry.cli.arguments import (
    Force,
    Json,
    Out,
    Protocol,
    changed,
    changes,
    find_file,
    print_training,
    write_run_explorer,
)
from sme_registry.cli.plan import Jobs
from sme_registry.errors import OptionError
from sme_registry.io import integer_in
from sme_registry.io.terminal import err
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
from sme_registry.task import load


def train(
    context: typer.Context,
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
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            "-a",
            help="TD3, SAC, DDPG, PPO, A2C, module:Class, such as sb3_contrib:TQC, or "
            "train:module:function for a function of yours; for tasks with safety also "
            "PPOLagrangian, PPOProjection. Default TD3, for teams PPO.",
        ),
    ] = None,
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="sb3|jax",
            help="Implementation of PPO, TD3 and SAC: of Stable-Baselines3 (default), or in JAX, "
            "with the environment in one program.",
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="Of agents in JAX: cpu, gpu or tpu. Default JAX's.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            "-n",
            help="Environment steps; for a team, of the team. Default 20,000, and those of a "
            "stream.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the algorithm and of the start states.")] = 0,
    seeds: Annotated[
        int | None,
        typer.Option(
            help="With --suite: runs on each class, in turn on its instances. Default 10, or more "
            "for equally many on each instance."
        ),
    ] = None,
    jobs: Jobs = None,
    out_folder: Out = None,
    action_range: Annotated[
        str, typer.Option(help="Action space: symmetric, [-1, 1], or unit, [0, 1].")
    ] = "symmetric",
    num_envs: Annotated[
        int | None,
        typer.Option(
            help="Environments (teams) at once; the algorithm stays the same. Default 1; on-policy "
            "for a team 8."
        ),
    ] = None,
    independent: Annotated[
        bool, typer.Option("--independent", help="One model for each agent of a team.")
    ] = False,
    protocol: Protocol = "paper-v1",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change a field of the task or a hyperparameter of the algorithm. Repeatable.",
        ),
    ] = None,
    hyperparameters: Annotated[
        Path | None,
        typer.Option(metavar="CHECKPOINT", help="Hyperparameters in a JSON file.", dir_okay=False),
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

    The algorithm is one of Stable-Baselines3, or with --agents jax the same in JAX. The former runs
    on one CPU thread, which is fastest for networks of this size. On-policy algorithms finish their
    last rollout. The output folder, by default runs/TASK-ALGORITHM-seedN, contains episodes.csv,
    checkpoint.zip, model.zip, run.json, evaluation.json, figures, explorer.html (`sme explore`),
    and logs that `tensorboard --logdir runs` shows.

    --set changes a field of the task (`sme show TASK`) or a hyperparameter, whose names and
    defaults are those of the algorithm's class in Stable-Baselines3. Values are JSON or text; dots
    lead into a block, as in policy_kwargs.net_arch=[64,64]. Unknown names are rejected before
    training starts. run.json records all hyperparameters that differ from the defaults.

    With several environments an algorithm stays the same: PPO still collects 2,048 steps for an
    update, over all environments (n_steps of each is smaller), and off-policy algorithms still
    update once for each step (gradient_steps=-1). Setting these yourself overrides this.

    The agents of a team share one policy (for its observation see `sme evaluate --help`). With
    --independent, each agent has a model of its own, from its observations to its actions, which
    learns from its own rewards; the output folder then contains model/AGENT.zip instead of
    model.zip. In both cases episodes.csv has the team's mean regret, and one column per agent, such
    as regret/agent_0. A step is one step of the whole team, so a shared policy sees as many
    transitions per step as there are agents, and TensorBoard's axis counts those transitions.

    --agents jax trains the same algorithms in JAX, in one environment without a team: PPO in a
    twentieth of the time on a CPU, TD3 in two fifths, SAC in a third. The folder, by default
    runs/TASK-jax-ALGORITHM-seedN, contains the same files; model.zip is a model of
    Stable-Baselines3 with the trained weights. Tasks of a new shape, or other hyperparameters, are
    compiled first, which takes some seconds.

    PPOLagrangian and PPOProjection are for tasks with safety. PPOLagrangian is PPO that keeps the
    mean cost of a step, exploration included, near cost_limit (0.01): a multiplier weighs costs
    against rewards, and rises while the cost is above the limit, by multiplier_learning_rate times
    the difference. PPOProjection is PPO whose actions are cut at the limits: it is given the task's
    own limits, which no other agent knows, so it costs nothing. On such tasks, episodes.csv also
    has the cost of each episode.

    On a stream, such as Switch5, the agent lives through all phases, in one environment and for as
    many steps as the stream has. The folder contains stream.json instead of evaluation.json (what
    the agent retains of each phase, and its dynamic regret beside that of reference agents), and in
    snapshots the model before training and at the end of each visit of a phase.

    --suite trains on all instances of a suite at once, as `sme study run --keep-models` would, into
    runs/SUITE-ALGORITHM, a study's folder: the same command continues it, `sme study status` and
    `report` read it, and `sme-leaderboard new --runs` makes a submission of it.

    --resume continues an interrupted run from its last checkpoint with the same networks,
    optimisers, replay buffer, hyperparameters and step count; --steps may be larger. A finished run
    cannot be continued. The result differs from an uninterrupted run: random streams get new seeds,
    and unfinished episodes start again, on a stream at the same step of its life. With --agents jax
    no bit differs.

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
    from sme_registry import training

    overrides, settings = _split(changes(set_), hyperparameters)
    if suite is not None:
        refuse_fields(overrides)
        train_suite(
            context,
            suite,
            algorithm=algorithm,
            agents=agents,
            device=device,
            steps=training.DEFAULT_STEPS if steps is None else steps,
            seeds=seeds,
            folder=out_folder,
            action_range=action_range,
            independent=independent,
            protocol=protocol,
            hyperparameters=settings,
            jobs=jobs,
            json=json,
        )
        return
    refuse_without_suite(context)
    if task is None:
        raise OptionError("Give a TASK or --suite, such as Default. See `sme train --help`.")
    document = load(task)
    if isinstance(document, StreamSpec):
        overrides |= {name: settings[name] for name in settings if name in StreamSpec.model_fields}
    document = changed(document, task, overrides)
    algorithm = training.full_name(algorithm or training.default_algorithm(document), agents)
    training.check_hyperparameters(algorithm, settings, others=SMESpec.model_fields)
    if out_folder is None:
        label = _label(task, document, changed=bool(overrides))
        name = training.folder_name(algorithm)
        out_folder = Path("runs") / f"{label}-{'independent-' * independent}{name}-seed{seed}"
    try:
        result = training.train(
            document,
            algorithm=algorithm,
            steps=steps,
            seed=seed,
            folder=out_folder,
            hyperparameters=settings,
            independent=independent,
            action_range=cast(Any, action_range),
            num_envs=num_envs,
            checkpoint_every=checkpoint_every,
            protocol=protocol,
            console=err(),
            resume=resume,
            force=force,
            agents=cast(Any, agents),
            device=device,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(how_to_continue(out_folder)) from None
    if result.record.stream is None:
        write_run_explorer(out_folder)
    print_training(result, out_folder, json=json)


def _split(values: dict[str, Any], path: Path | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """The changes of the task, and the hyperparameters from a file and from --set."""
    from sme_registry.training import nested_hyperparameters, read_hyperparameters

    fields = {name: value for name, value in values.items() if name in SMESpec.model_fields}
    flat = {name: value for name, value in values.items() if name not in fields}
    settings = nested_hyperparameters(flat)
    from_file = {} if path is None else read_hyperparameters(path)
    for name in settings.keys() & from_file.keys():
        raise OptionError(f"--set {name}: {path} sets it, too. Remove one.")
    return fields, {**from_file, **settings}


def _label(task: str, document: SMESpec | StreamSpec, *, changed: bool) -> str:
    """A task's name in a folder's name; a changed or unnamed task is named by content."""
    if changed or task.startswith("sha256"):
        return document.content_name
    return Path(task).name.removesuffix(".json").removesuffix("-v1")


def how_to_continue(folder: Path, command: str = "the same command with --resume") -> str:
    """The message after an interrupted training in a folder, which `command` continues."""
    from sme_registry.training import RunRecord

    if RunRecord.read(folder) is None:
        return "interrupted before the training began: nothing was written."
    from sme_registry.training.record import CHECKPOINT

    saved = (
        "up to its last checkpoint" if (folder / CHECKPOINT).exists() else "without a checkpoint"
    )
    return (
        f"interrupted: the run is in {folder}, {saved}. Run {command} to continue, or with --force "
        "to start again."
    )


RUNS = 10
"""Runs on each class by default: those that a leaderboard requires for a rank."""

_EVALUATIONS = 10  # of a run, for the learning curves of `sme study report`
_NOT_WITH_SUITE = ("task", "seed", "num_envs", "checkpoint_every", "resume", "force")


def train_suite(
    context: typer.Context,
    suite: str,
    *,
    algorithm: str | None,
    agents: str | None,
    device: str | None,
    steps: int,
    seeds: int | None,
    folder: Path | None,
    action_range: str,
    independent: bool,
    protocol: str,
    hyperparameters: dict[str, Any],
    jobs: int | None,
    json: bool,
) -> None:
    """Train on every instance of a suite and keep the models; the same call continues."""
    from sme_registry import training
    from sme_registry.cli.plan import warn_of_uneven_rollouts
    from sme_registry.cli.study import print_status
    from sme_registry.evaluation import resolve_protocol
    from sme_registry.spec.study import INDEPENDENT
    from sme_registry.studies.engine.runner import run_study

    _refuse_options(context, _NOT_WITH_SUITE, "is for a single task. Leave it out, or --suite")
    file = find_file(SuiteFile, suite)
    members = file.suite
    if not members.classes:
        _refuse_options(context, ("steps",), "is that of each stream here. Leave it out")
    first = members.classes[0].instances[0] if members.classes else members.streams[0].stream
    algorithm = algorithm or training.default_algorithm(first)
    uses = training.full_name(algorithm, agents)
    name = training.short_name(uses)
    if folder is None:
        label = training.folder_name(uses)
        folder = Path("runs") / f"{file.name}-{'independent-' * independent}{label}"
    plan = StudyPlan.from_dict(
        {
            **{
                name: [member.to_dict() for member in kind]
                for name, kind in (("classes", members.classes), ("streams", members.streams))
                if kind
            },
            "algorithms": [
                {
                    "name": name,
                    "uses": f"{INDEPENDENT}{uses}" if independent else uses,
                    "hyperparameters": hyperparameters,
                    "action_range": action_range,
                }
            ],
            "seeds": equal_runs(members) if seeds is None else integer_in("seeds", seeds, 1),
            "steps": steps,
            "evaluations": _EVALUATIONS,
            "protocol": resolve_protocol(protocol).to_dict(),
        },
        "options",
    )
    warn_of_uneven_rollouts(plan)
    study = StudyFile(name=file.name, digest=plan.digest, plan=plan)
    status = run_study(study, folder, jobs=jobs, keep_models=True, device=device, console=err())
    print_status(status, json)
    if status.failed:
        raise typer.Exit(1)
    if not json:
        err().print(f"[dim]{escape(_next_step(suite, members, plan, folder))}[/]", soft_wrap=True)


def _next_step(name: str, suite: Suite, plan: StudyPlan, folder: Path) -> str:
    """What to do with the models of a suite."""
    if suite.streams:
        return f"To see what the agents retain: sme study report {folder}"
    instances = max(suite.runs.values())
    if plan.seeds < instances:
        return f"A leaderboard needs a run on every instance: use --seeds {instances} or more."
    return f"To submit them: sme-leaderboard new BUNDLE --suite {name} --runs {folder}"


def equal_runs(suite: Suite) -> int:
    """At least `RUNS` on each class, and equally many on each instance of the largest class."""
    return max(-(-RUNS // instances) * instances for instances in suite.runs.values())


def refuse_without_suite(context: typer.Context) -> None:
    """Check that no option is given that only --suite has."""
    _refuse_options(context, ("seeds", "jobs"), "is for --suite. Add --suite, or leave it out")


def refuse_fields(fields: dict[str, Any]) -> None:
    """Check that no option changes a field of the suite's tasks."""
    for name in fields:
        raise OptionError(
            f"--set {name}: is a field of the task, and the suite sets it. Write another suite "
            f"with `sme suite new`, for example from `sme new task.json --set {name}=…`."
        )


def _refuse_options(context: typer.Context, names: tuple[str, ...], problem: str) -> None:
    for name in names:
        origin = context.get_parameter_source(name)
        # By name: newer versions of Typer include their own Click.
        if origin is not None and origin.name == "COMMANDLINE":
            option = "TASK" if name == "task" else f"--{name.replace('_', '-')}"
            raise OptionError(f"{option}: {problem}.")

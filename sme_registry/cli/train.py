"""`sme train`: train an algorithm of Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from sme_registry import load
from sme_registry.cli.arguments import (
    Force,
    Json,
    Out,
    Protocol,
    SpecChanges,
    TaskName,
    changes,
)
from sme_registry.cli.files import print_training
from sme_registry.spec import SMESpec
from sme_registry.terminal import err


def train(
    task: TaskName,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm", "-a", help="TD3, SAC, DDPG, PPO or A2C; default TD3, for teams PPO."
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option("--steps", "-n", help="Environment steps; for a team, of the team.")
    ] = 20_000,
    seed: Annotated[int, typer.Option(help="Seed of the algorithm and of the start states.")] = 0,
    out_folder: Out = None,
    action_range: Annotated[
        str, typer.Option(help="Action space: symmetric, [-1, 1], or unit, [0, 1].")
    ] = "symmetric",
    num_envs: Annotated[
        int | None,
        typer.Option(
            help="Environments (teams) at once. More mean fewer updates for off-policy algorithms. "
            "Default 1; on-policy for a team 8."
        ),
    ] = None,
    protocol: Protocol = "paper-v1",
    set_: SpecChanges = None,
    checkpoint_every: Annotated[
        int | None,
        typer.Option(help="Steps between checkpoints; default a twentieth of all, at least 1,000."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Train an algorithm of Stable-Baselines3, log the exact regret of each episode, evaluate it.

    It uses SB3's default hyperparameters on one CPU thread, which is fastest for networks of this
    size. PPO and A2C finish their last rollout. The output folder, by default
    runs/TASK-ALGORITHM-seedN, contains episodes.csv, checkpoint.zip, model.zip, run.json,
    evaluation.json, figures, and TensorBoard's logs.

    The agents of a team share one policy (for its observation see `sme evaluate --help`).
    episodes.csv then has the team's mean regret, and one column per agent, such as regret/agent_0.
    A step is one step of the whole team, so the algorithm sees as many transitions per step as
    there are agents. TensorBoard's axis counts those transitions. PPO collects its 2,048
    transitions over all agents of all teams together; run.json records n_steps.

    --resume continues from the last checkpoint with the same networks, optimisers, replay buffer
    and step count. The result differs from an uninterrupted run: random streams get new seeds, and
    unfinished episodes start again.

    Examples:

      sme train Default --steps 20000 --seed 1

      sme train Default -a PPO -n 100000 --num-envs 8 --set complexity=10

      sme train mine.json --out runs/mine --resume

      sme train Team4 --steps 40000
    """
    from sme_registry import training

    overrides = changes(set_)
    spec = load(task).derive(**overrides)
    algorithm = training.known_algorithm(algorithm or training.default_algorithm(spec))
    if out_folder is None:
        label = _label(task, spec, changed=bool(overrides))
        out_folder = Path("runs") / f"{label}-{algorithm}-seed{seed}"
    try:
        result = training.train(
            spec,
            algorithm=algorithm,
            steps=steps,
            seed=seed,
            folder=out_folder,
            action_range=cast(Any, action_range),
            num_envs=num_envs,
            checkpoint_every=checkpoint_every,
            protocol=protocol,
            console=err(),
            resume=resume,
            force=force,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(how_to_continue(out_folder)) from None
    print_training(result, out_folder, json=json)


def _label(task: str, spec: SMESpec, *, changed: bool) -> str:
    """A task's name in a folder's name; a changed or unnamed task is named by content."""
    if changed or task.startswith("sha256"):
        return spec.content_name
    return Path(task).name.removesuffix(".json").removesuffix("-v1")


def how_to_continue(folder: Path, command: str = "the same command with --resume") -> str:
    """The message after an interrupted training in a folder, which `command` continues."""
    from sme_registry.training import RunRecord

    if RunRecord.read(folder) is None:
        return "interrupted before the training began: nothing was written."
    from sme_registry.training.checkpoint import FILE

    saved = "up to its last checkpoint" if (folder / FILE).exists() else "without a checkpoint"
    return (
        f"interrupted: the run is in {folder}, {saved}. Run {command} to continue, or with --force "
        "to start again."
    )

"""`sme offline`: train on a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import DatasetsFolder, Force, Json, Out, changes
from sme_registry.cli.files import print_training
from sme_registry.io.tables import Table
from sme_registry.io.terminal import Progress, err, out

app = typer.Typer(no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Offline reinforcement learning: train on a data set, never in the environment."""


@app.command()
def train(
    dataset: Annotated[
        str, typer.Argument(metavar="DATASET", help="An id from `sme dataset list`, or a path.")
    ],
    algorithm: Annotated[str, typer.Option("--algorithm", "-a", help="bc or iql.")] = "iql",
    steps: Annotated[int, typer.Option("--steps", "-n", help="Gradient steps.")] = 20_000,
    batch_size: Annotated[int, typer.Option(help="Transitions in each gradient step.")] = 256,
    seed: Annotated[int, typer.Option(help="Seed of weights, shuffling and episodes.")] = 0,
    evaluations: Annotated[int, typer.Option(help="Evaluations during training.")] = 20,
    protocol: Annotated[
        str | None, typer.Option(help="Protocol of the last evaluation; default the data set's.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a hyperparameter. Repeatable."),
    ] = None,
    folder: DatasetsFolder = None,
    out_folder: Out = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Train behaviour cloning (bc) or implicit Q-learning (iql) on a data set, and evaluate it.

    The policy learns from the data alone. Every evaluation runs 10 episodes in the task and
    compares their mean similarity r̃ with the data set's. 20,000 steps take a few minutes on one
    core. The output folder, by default runs/DATASET-ALGORITHM-seedN, contains policy.npz,
    offline.json, evaluation.json and a figure.

    Hyperparameters: hidden, learning_rate; for iql also discount, expectile, inverse_temperature,
    max_weight, target_rate.

    Examples:

      sme dataset make Default --nu 0.5 --seed 7

      sme offline train sme/Default-v1-nu50-seed7-v0 --algorithm bc --seed 1

      sme offline train sme/Default-v1-nu50-seed7-v0 -a iql --set expectile=0.9

      sme evaluate runs/Default-v1-nu50-seed7-v0-iql-seed0/policy.npz Default
    """
    from sme_registry import offline
    from sme_registry.datasets import open_dataset
    from sme_registry.training import known_algorithm

    algorithm = known_algorithm(algorithm, offline.ALGORITHMS)
    opened = open_dataset(dataset, folder)
    if out_folder is None:
        out_folder = Path("runs") / f"{opened.id.rsplit('/', 1)[-1]}-{algorithm}-seed{seed}"
    with Progress(f"training {algorithm.upper()}", max(1, steps), console=err()) as progress:
        result = offline.train_offline(
            opened,
            algorithm=algorithm,
            steps=steps,
            batch_size=batch_size,
            seed=seed,
            evaluations=min(evaluations, max(1, steps)),
            hyperparameters=changes(set_),
            protocol=protocol,
            folder=out_folder,
            force=force,
            progress=lambda done, total, note: progress.update(done, note),
        )
    print_training(result, out_folder, [_scores(result.record)], json=json)


@app.command()
def sealed(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder of a sealed data set.")
    ],
    out_file: Annotated[Path, typer.Option("--out", "-o", help="The policy's .npz file.")],
    algorithm: Annotated[str, typer.Option("--algorithm", "-a", help="bc or iql.")] = "iql",
    steps: Annotated[int, typer.Option("--steps", "-n", help="Gradient steps.")] = 20_000,
    batch_size: Annotated[int, typer.Option(help="Transitions in each gradient step.")] = 256,
    seed: Annotated[int, typer.Option(help="Seed of weights and shuffling.")] = 0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a hyperparameter. Repeatable."),
    ] = None,
    force: Force = False,
) -> None:
    """Train bc or iql on a sealed data set, whose task is hidden. Nothing is evaluated here.

    `sme-leaderboard enter` sends the policy's answers to the season's board.

    Examples:

      sme offline sealed autumn/datasets/sealed/autumn/deep-0-v0 -o deep-0.npz
    """
    from sme_registry.io import refuse_existing
    from sme_registry.offline import train_sealed

    refuse_existing(out_file, force=force)
    title = f"training {algorithm.upper()}"
    with Progress(title, max(1, steps), console=err()) as progress:
        policy = train_sealed(
            dataset,
            algorithm=algorithm,
            steps=steps,
            batch_size=batch_size,
            seed=seed,
            hyperparameters=changes(set_),
            progress=lambda done, _: progress.update(done),
        )
    policy.save(out_file)
    out().print(escape(str(out_file)), soft_wrap=True)


def _scores(record: Any) -> Table:
    behaviour, last = record.behaviour, record.evaluations[-1]
    algorithm = record.algorithm.upper()
    rows = [
        (name, f"{each.similarity:.3f}", f"{each.similarity_sd:.3f}")
        for name, each in (
            (f"behaviour, {record.transitions:,} transitions", behaviour),
            (f"{algorithm}, {record.episodes} episodes", last),
        )
    ]
    return Table(
        f"{algorithm} on {escape(record.dataset)}",
        {"": "text", "r̃": "number", "SD over steps": "number"},
        [*rows, ("improvement", f"{record.improvement:+.3f}", "")],
    )

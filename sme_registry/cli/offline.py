"""`sme offline train`: BC or IQL on a data set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sme_registry.cli import names
from sme_registry.terminal.output import err, out, print_json

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Learners that see a data set and never the environment.",
)


@app.callback()
def _group() -> None:
    """Learners that see a data set and never the environment."""


@app.command()
def train(
    dataset: Annotated[
        str, typer.Argument(metavar="DATASET", help="An id of `sme dataset list`, or a path.")
    ],
    algorithm: Annotated[str, typer.Option("--algorithm", "-a", help="bc or iql.")] = "iql",
    steps: Annotated[int, typer.Option("--steps", "-n", help="Gradient steps.")] = 20_000,
    batch_size: Annotated[int, typer.Option(help="Transitions in each step.")] = 256,
    seed: Annotated[int, typer.Option(help="Of weights, shuffles and live episodes.")] = 0,
    evaluations: Annotated[
        int, typer.Option(help="Live evaluations on the way, of 10 episodes each.")
    ] = 20,
    protocol: Annotated[
        str | None,
        typer.Option(help="Where it is judged at the end; by default the data set's own."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a hyperparameter; repeatable."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--datasets", help="Where data sets lie; by default Minari's folder."),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="By default `runs/<dataset>-<algorithm>-seed<seed>`."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the training in the folder.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Record and report as JSON.")] = False,
) -> None:
    """Train behaviour cloning (bc) or implicit Q-learning (iql) on a data set, and judge it.

    The policy never acts while it learns. At intervals 10 episodes are played in the task: the
    score is mean r̃, beside that of the data set itself. Some minutes for 20,000 steps on one core.
    The folder holds policy.npz, offline.json, evaluation.json and a figure.

    Hyperparameters: hidden, learning_rate; of iql also discount, expectile, inverse_temperature,
    max_weight, target_rate.

    Examples:

      sme dataset make Default --nu 0.5 --seed 7

      sme offline train sme/Default-v1-nu50-seed7-v0 --algorithm bc --seed 1

      sme offline train sme/Default-v1-nu50-seed7-v0 -a iql --set expectile=0.9

      sme evaluate runs/Default-v1-nu50-seed7-v0-iql-seed0/policy.npz Default
    """
    from sme_registry import offline
    from sme_registry.datasets import open_dataset
    from sme_registry.offline.hyperparameters import known_algorithm
    from sme_registry.terminal.progress import Progress

    algorithm = known_algorithm(algorithm)
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
            hyperparameters=names.overrides(set_ or []),
            protocol=protocol,
            folder=out_folder,
            force=force,
            progress=lambda done, total, note: progress.update(done, note),
        )
    if json:
        report = result.report.to_dict()
        print_json(
            {"folder": str(out_folder), "training": result.record.to_dict(), "evaluation": report}
        )
        return
    out().print(_scores(result.record))
    out().print(result.report.table())
    out().print(f"everything is in {escape(str(out_folder))}{os.sep}", soft_wrap=True)


def _scores(record: Any) -> Table:
    behaviour, last = record.behaviour, record.evaluations[-1]
    table = Table(
        title=f"{record.algorithm.upper()} on {escape(record.dataset)}", title_justify="left"
    )
    for heading in ("", "r̃", "SD over steps"):
        table.add_column(heading, justify="right" if heading else "left")
    table.add_row(
        f"behaviour, {record.transitions:,} transitions",
        f"{behaviour.similarity:.3f}",
        f"{behaviour.similarity_sd:.3f}",
    )
    table.add_row(
        f"{record.algorithm.upper()}, {record.episodes} live episodes",
        f"{last.similarity:.3f}",
        f"{last.similarity_sd:.3f}",
    )
    table.add_row("improvement", f"{record.improvement:+.3f}", "")
    return table

"""`sme dataset make · list · show · validate`: data sets for offline RL."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sme_registry import load
from sme_registry.cli import names
from sme_registry.errors import OptionError, SMEError
from sme_registry.spec import catalogue
from sme_registry.terminal.output import err, failure, out, print_json, print_pairs

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Data sets for offline RL, of a chosen quality, with the exact regret of every step.",
)

Folder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder of data sets; by default Minari's: MINARI_DATASETS_PATH, or "
        "~/.minari/datasets.",
    ),
]
Name = Annotated[str, typer.Argument(metavar="ID|PATH", help="A set's id, or its folder.")]
Json = Annotated[bool, typer.Option("--json", help="Plain JSON on standard output.")]


@app.command("make")
def make(
    task: Annotated[str, typer.Argument(metavar="TASK", help="A name, a path, or a digest.")],
    nu: Annotated[
        float | None,
        typer.Option(help="ν of the mixture that acts, in [0, 1]: 0 optimal, 1 worst; 0.5."),
    ] = None,
    mix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WHO:WEIGHT",
            help="In place of --nu, repeatable: nu=0.5:0.7, random:0.1, policy=model.zip:0.2 "
            "(or an .onnx). The weights add up to 1.",
        ),
    ] = None,
    transitions: Annotated[
        int, typer.Option("--transitions", "-n", help="Exactly so many.")
    ] = 50_000,
    seed: Annotated[int, typer.Option(help="Of the data, not of the task.")] = 0,
    coverage: Annotated[
        float | None,
        typer.Option(help="ε in (-1, 0]: only states of the sub-cube of half side (1 + ε)/2."),
    ] = None,
    protocol: Annotated[
        str, typer.Option(help="Where policies that learn from it are to be judged.")
    ] = "paper-v1",
    action_range: Annotated[
        str | None, typer.Option(help="unit or symmetric, of a policy's actions; its own.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Minari's id, such as sme/mine-v0; by default descriptive.")
    ] = None,
    out_folder: Folder = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Change a spec field; repeatable."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a set that is there.")] = False,
    json: Json = False,
) -> None:
    """Make a data set of a chosen quality, as Minari's HDF5; the same command, the same bits.

    The behaviour policy is a = (1 − α) a* + α ã, α ~ U(0, ν) at each step, ã another network of the
    shape of the optimal policy. Every transition has its optimal action, similarity and regret;
    the metadata have the exact scores of the constant action, the behaviour and the optimum.

    Examples:

      sme dataset make Default --nu 0.5 --transitions 50000 --seed 7

      sme dataset make Complexity10 --mix nu=0.5:0.7 --mix random:0.1 --mix policy=model.zip:0.2

      sme dataset make Plane1 --nu 0.25 --coverage -0.2 --name sme/inner-v0 --out data
    """
    from sme_registry.datasets import make_dataset
    from sme_registry.terminal.progress import Progress

    spec = load(task).derive(**names.overrides(set_ or []))
    with Progress("collecting", transitions, unit="transitions", console=err()) as progress:
        made = make_dataset(
            spec,
            nu,
            mix=None if not mix else [_weighted(text) for text in mix],
            transitions=transitions,
            seed=seed,
            coverage=coverage,
            protocol=protocol,
            action_range=action_range,
            name=name,
            folder=out_folder,
            force=force,
            progress=lambda done, total: progress.update(done),
        )
    if json:
        print_json(_summary(made))
    else:
        _print(made)
    err().print(f"wrote {escape(str(made.path))}{os.sep}", soft_wrap=True)


def _weighted(text: str) -> tuple[Any, float]:
    """`nu=0.5:0.7`, `random:0.1` or `policy=model.zip:0.2` as who acts and its weight.

    Raises:
      OptionError: it is none of these.
    """
    who, _, weight = text.rpartition(":")
    kind, _, value = who.partition("=")
    try:
        if kind == "nu":
            return float(value), float(weight)
        if kind == "policy" and value:
            return Path(value), float(weight)
        if who == "random":
            return who, float(weight)
    except ValueError:
        pass
    raise OptionError(
        f"--mix {text!r}: must be nu=NU:WEIGHT, random:WEIGHT or policy=FILE:WEIGHT, as in "
        "--mix nu=0.5:0.7."
    )


@app.command("list")
def list_(out_folder: Folder = None, json: Json = False) -> None:
    """The data sets in a folder.

    Examples:

      sme dataset list

      sme dataset list --out data --json
    """
    from sme_registry.datasets import datasets_folder, list_datasets

    found, broken = list_datasets(out_folder)
    if json:
        print_json([_summary(dataset) for dataset in found])
    elif found:
        table = Table(
            title="Data sets",
            title_justify="left",
            caption="r̃ similarity of the behaviour, and of the constant action ½, on the set's "
            "own states",
            caption_justify="left",
        )
        table.add_column("id", overflow="fold")
        for column in ("transitions", "trajectories", "r̃", "r̃ of ½", "MB"):
            table.add_column(column, justify="right")
        for dataset in found:
            record = dataset.record
            table.add_row(
                dataset.id,
                f"{record.recipe.transitions:,}",
                f"{record.trajectories:,}",
                f"{record.scores.behaviour.similarity:.3f}",
                f"{record.scores.constant.similarity:.3f}",
                f"{dataset.size_bytes / 1e6:.1f}",
            )
        out().print(table)
    else:
        err().print(
            f"no data sets in {escape(str(datasets_folder(out_folder)))}. "
            "`sme dataset make --help` shows how to make one.",
            soft_wrap=True,
        )
    for reason in broken.values():
        err().print(f"[yellow]not listed:[/] {escape(reason)}", soft_wrap=True)


@app.command("show")
def show(name: Name, out_folder: Folder = None, json: Json = False) -> None:
    """One data set: its recipe, its scores, its digests.

    Examples:

      sme dataset show sme/Default-v1-nu50-seed7-v0

      sme dataset show data/sme/inner-v0 --json
    """
    from sme_registry.datasets import open_dataset

    dataset = open_dataset(name, out_folder)
    if json:
        print_json(_summary(dataset))
    else:
        _print(dataset)


@app.command("validate")
def validate(
    sets: Annotated[list[str], typer.Argument(metavar="ID|PATH…", help="Sets to check.")],
    out_folder: Folder = None,
    json: Json = False,
) -> None:
    """Check sets to the last bit: place, digests, and every transition again through the task.

    Examples:

      sme dataset validate sme/Default-v1-nu50-seed7-v0

      sme dataset validate data/sme/*
    """
    from sme_registry.datasets import check_location, open_dataset, replay
    from sme_registry.task import materialize

    results: list[dict[str, Any]] = []
    for name in sets:
        result: dict[str, Any] = {"set": name, "valid": True, "error": None}
        try:
            dataset = open_dataset(name, out_folder)
            check_location(dataset, out_folder)
            replay(dataset.transitions(), dataset.recipe, materialize(dataset.recipe.spec))
            result["arrays_digest"] = dataset.record.arrays_digest
        except SMEError as error:
            result |= {"valid": False, "error": str(error)}
            failure(str(error))
        else:
            if not json:
                out().print(f"[green]valid[/] {escape(name)}", soft_wrap=True)
        results.append(result)
    if json:
        print_json(results)
    if not all(result["valid"] for result in results):
        raise typer.Exit(2)


def _summary(dataset: Any) -> dict[str, Any]:
    return {
        "id": dataset.id,
        "path": str(dataset.path),
        "bytes": dataset.size_bytes,
        **dataset.record.to_dict(),
    }


def _print(dataset: Any) -> None:
    """A set's facts, then its scores as a table."""
    record = dataset.record
    recipe = record.recipe
    kept = "all" if recipe.coverage is None else f"E(s) ≤ {recipe.coverage:g}"
    pairs: dict[str, object] = {
        "task": f"{catalogue.title(recipe.spec)}  {record.spec_digest}",
        "transitions": f"{recipe.transitions:,} in {record.trajectories:,} trajectories",
        "states": kept,
        "seeds": f"task {record.seeds.task}, data {record.seeds.data}",
        "protocol": record.protocol_digest,
        "recipe": record.recipe_digest,
        "arrays": record.arrays_digest,
    }
    if recipe.expected_similarity is not None:
        pairs["r̃ if ã and a* were uniform"] = f"{recipe.expected_similarity:.4f}"
    print_pairs(f"[bold]{escape(dataset.id)}[/]", pairs)
    table = Table(
        title="Scores",
        title_justify="left",
        caption="r̃, r on the set's own states · return over whole episodes, ± standard error",
        caption_justify="left",
    )
    for column in ("who", "weight", "r̃", "r", "return"):
        table.add_column(column, justify="left" if column == "who" else "right")
    scores = record.scores
    rows = [("constant ½", "", scores.constant), ("behaviour", "", scores.behaviour)]
    if len(recipe.behaviours) > 1:
        rows += [
            (f"  {behaviour.label}", f"{behaviour.weight:g}", score)
            for behaviour, score in zip(recipe.behaviours, scores.behaviours, strict=True)
        ]
    for who, weight, score in [*rows, ("optimum", "", scores.optimum)]:
        rollouts = score.rollouts
        played = "" if rollouts is None else f"{rollouts.mean_return:.2f}"
        if rollouts is not None and rollouts.episodes:
            played += f" ± {rollouts.standard_error:.2f}"
        numbers = f"{score.similarity:.4f}", f"{score.step_reward:.4f}"
        table.add_row(escape(who), weight, *numbers, played)
    out().print(table)

"""`sme data`: data sets for offline RL; `sme train --data` learns from them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry import SMESpec, load
from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Protocol,
    SpecChanges,
    TaskName,
    changes,
    print_checks,
)
from sme_registry.datasets import Dataset, make_dataset, open_dataset, replay
from sme_registry.datasets.collect import check_scores
from sme_registry.datasets.documents import PolicyScore
from sme_registry.datasets.storage import check_location, datasets_folder, list_datasets
from sme_registry.errors import OptionError, SMEError
from sme_registry.io.markup import Table
from sme_registry.io.terminal import Progress, count, err, out, print_json, print_note, print_pairs
from sme_registry.spec import catalogue
from sme_registry.task import materialize

app = typer.Typer()
data = typer.Typer(
    no_args_is_help=True,
    help="""Data sets for offline RL, of a chosen quality, with the exact regret of every step.

    Examples:

      sme data make Default --nu 0.5
      sme data list
      sme train --data sme/Default-v1-nu50-seed0-v0 -a iql
    """,
)
app.add_typer(data, name="data")

Name = Annotated[
    str, typer.Argument(metavar="DATASET", help="The id of a data set, or its folder.")
]
_FOLDER = "Folder of data sets; default MINARI_DATASETS_PATH, or ~/.minari/datasets."
Folder = Annotated[Path | None, typer.Option("--datasets", help=_FOLDER)]


@data.command("make")
def make(
    task: TaskName,
    nu: Annotated[
        float | None,
        typer.Option(help="Quality ν of the behaviour, from 0, optimal, to 1, worst; default 0.5."),
    ] = None,
    mix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="POLICY:WEIGHT",
            help="Instead of --nu, a mixture: nu=0.5:0.7, random:0.1, policy=model.zip:0.2 (or "
            ".onnx). Repeatable; the weights must add up to 1.",
        ),
    ] = None,
    transitions: Annotated[
        int,
        typer.Option(
            "--transitions",
            "-n",
            parser=count,
            metavar="INTEGER",
            help="Number of transitions.",
        ),
    ] = 50_000,
    seed: Annotated[int, typer.Option(help="Seed of the data, not of the task.")] = 0,
    coverage: Annotated[
        float | None,
        typer.Option(help="ε in (-1, 0]: keep only states in the central cube of side 1 + ε."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Minari id, such as sme/mine-v0; default from the settings.")
    ] = None,
    out_folder: Annotated[Path | None, typer.Option("--out", "-o", help=_FOLDER)] = None,
    set_: SpecChanges = None,
    force: Force = False,
    json: Json = False,
    protocol: Protocol = "paper-v1",
    action_range: ActionRange = None,
) -> None:
    """Make a data set of a chosen quality in Minari's HDF5 format.

    The behaviour is `a = (1 − α) a* + α ã`, where α is uniform in (0, ν) at each step and ã comes
    from another network of the same shape as the optimal policy. Every transition records its
    optimal action, similarity and exact regret. The same command makes the same bits.

    Examples:

      sme data make Default --nu 0.5 --transitions 50000 --seed 7
      sme data make Complexity10 --mix nu=0.5:0.7 --mix random:0.1 --mix policy=model.zip:0.2
      sme data make Plane1 --nu 0.25 --coverage -0.2 --name sme/inner-v0 --out data
    """
    spec = load(task, SMESpec).derive(**changes(set_))
    with Progress("collecting", transitions, unit="transitions", console=err()) as progress:
        dataset = make_dataset(
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
            progress=progress.update,
        )
    _print(dataset, json)
    print_note(f"wrote {escape(str(dataset.path))}{os.sep}")


def _weighted(text: str) -> tuple[Any, float]:
    """Read `nu=0.5:0.7`, `random:0.1` or `policy=model.zip:0.2` as a policy and its weight."""
    policy, _, weight = text.rpartition(":")
    kind, _, value = policy.partition("=")
    try:
        if kind == "nu":
            return float(value), float(weight)
        if kind == "policy" and value:
            return Path(value), float(weight)
        if policy == "random":
            return policy, float(weight)
    except ValueError:
        pass
    raise OptionError(
        f"--mix {text!r}: must be nu=NU:WEIGHT, random:WEIGHT or policy=FILE:WEIGHT, such as "
        "--mix nu=0.5:0.7."
    )


@data.command("list")
def list_(folder: Folder = None, json: Json = False) -> None:
    """List the data sets in a folder.

    Examples:

      sme data list
      sme data list --datasets data --json
    """
    datasets, broken = list_datasets(folder)
    if json:
        print_json([_summary(dataset) for dataset in datasets])
    elif datasets:
        rows = [
            {
                "id": dataset.id,
                "transitions": dataset.recipe.transitions,
                "trajectories": dataset.record.trajectories,
                "r̃": f"{dataset.record.scores.behaviour.similarity:.3f}",
                "r̃ of ½": f"{dataset.record.scores.constant.similarity:.3f}",
                "MB": f"{dataset.size_bytes / 1e6:.1f}",
            }
            for dataset in datasets
        ]
        caption = (
            "r̃: similarity of the behaviour, and of the constant action ½, in the states of the "
            "data set"
        )
        out().print(Table.of("Data sets", rows, caption=caption))
    else:
        print_note(
            f"There are no data sets in {escape(str(datasets_folder(folder)))}. "
            "To make one, see `sme data make --help`."
        )
    for reason in broken.values():
        print_note(f"[yellow]invalid:[/] {escape(reason)}")


@data.command("show")
def show(name: Name, folder: Folder = None, json: Json = False) -> None:
    """Show a data set: its recipe, scores and digests.

    Examples:

      sme data show sme/Default-v1-nu50-seed7-v0
      sme data show data/sme/inner-v0 --json
    """
    _print(open_dataset(name, folder), json)


@data.command("check")
def check(
    sets: Annotated[list[str], typer.Argument(metavar="DATASET…", help="Data sets to check.")],
    folder: Folder = None,
    json: Json = False,
) -> None:
    """Check data sets bit for bit: location, digests, every transition and its scores.

    Examples:

      sme data check sme/Default-v1-nu50-seed7-v0
      sme data check data/sme/inner-v0
    """
    print_checks((_check(name, folder) for name in sets), "data sets", json=json)


def _check(name: str, folder: Path | None) -> dict[str, Any]:
    result: dict[str, Any] = {"name": name, "valid": False, "error": None}
    try:
        dataset = open_dataset(name, folder)
        check_location(dataset, folder)
        transitions, task = dataset.transitions(), materialize(dataset.recipe.spec)
        replay(transitions, dataset.recipe, task)
        check_scores(dataset.record.scores, task, transitions)
    except SMEError as error:
        return result | {"error": str(error)}
    return result | {"valid": True, "digest": dataset.record.arrays_digest}


def _summary(dataset: Dataset) -> dict[str, Any]:
    return {
        "id": dataset.id,
        "path": str(dataset.path),
        "bytes": dataset.size_bytes,
        **dataset.record.to_dict(),
    }


def _print(dataset: Dataset, json: bool) -> None:
    if json:
        print_json(_summary(dataset))
        return
    record, recipe = dataset.record, dataset.recipe
    pairs: dict[str, object] = {
        "task": f"{catalogue.title(recipe.spec.named(record.task))}  {record.spec_digest}",
        "transitions": f"{recipe.transitions:,} in {record.trajectories:,} trajectories",
        "states": "all" if recipe.coverage is None else f"E(s) ≤ {recipe.coverage:g}",
        "seeds": f"task {record.seeds.task}, data {record.seeds.data}",
        "protocol": record.protocol_digest,
        "recipe": record.recipe_digest,
        "arrays": record.arrays_digest,
    }
    print_pairs(f"[bold]{escape(dataset.id)}[/]", pairs)
    scores = record.scores
    rows = [_score_row("constant ½", scores.constant), _score_row("behaviour", scores.behaviour)]
    if len(recipe.behaviours) > 1:
        rows += [
            _score_row(f"  {behaviour.label}", score, f"{behaviour.weight:g}")
            for behaviour, score in zip(recipe.behaviours, scores.behaviours, strict=True)
        ]
    rows.append(_score_row("optimum", scores.optimum))
    caption = (
        "similarity r̃ and step reward r in the states of the data set · return of whole episodes, "
        "± standard error"
    )
    out().print(Table.of("Scores", rows, caption=caption))


def _score_row(policy: str, score: PolicyScore, weight: str = "") -> dict[str, object]:
    rollouts = score.rollouts
    returns = "" if rollouts is None else f"{rollouts.mean_return:.2f}"
    if rollouts is not None and rollouts.episodes:
        returns += f" ± {rollouts.standard_error:.2f}"
    similarity, reward = f"{score.similarity:.4f}", f"{score.step_reward:.4f}"
    return {"policy": policy, "weight": weight, "r̃": similarity, "r": reward, "return": returns}

"""`sme dataset` and `sme offline`: data sets for offline RL, and learning from them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry import SMESpec, load
from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Out,
    Protocol,
    SpecChanges,
    TaskName,
    changes,
    print_checks,
    print_training,
    with_options,
)
from sme_registry.datasets import Dataset, make_dataset, open_dataset, replay, train_offline
from sme_registry.datasets.documents import PolicyScore, check_algorithm
from sme_registry.datasets.offline import train_sealed
from sme_registry.datasets.storage import check_location, datasets_folder, list_datasets
from sme_registry.errors import OptionError, SMEError
from sme_registry.io import check_new
from sme_registry.io.markup import Table
from sme_registry.io.terminal import (
    Progress,
    err,
    out,
    print_json,
    print_line,
    print_note,
    print_pairs,
)
from sme_registry.spec import catalogue
from sme_registry.task import materialize

app = typer.Typer()
dataset = typer.Typer(
    no_args_is_help=True,
    help="""Data sets for offline RL, of a chosen quality, with the exact regret of every step.

    Examples:

      sme dataset make Default --nu 0.5
      sme dataset list
    """,
)
app.add_typer(dataset, name="dataset")

Name = Annotated[
    str, typer.Argument(metavar="DATASET", help="The id of a data set, or its folder.")
]
_FOLDER = "Folder of data sets; default MINARI_DATASETS_PATH, or ~/.minari/datasets."
Folder = Annotated[Path | None, typer.Option("--datasets", help=_FOLDER)]


@dataset.command("make")
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
        int, typer.Option("--transitions", "-n", help="Number of transitions.")
    ] = 50_000,
    seed: Annotated[int, typer.Option(help="Seed of the data, not of the task.")] = 0,
    coverage: Annotated[
        float | None,
        typer.Option(help="ε in (-1, 0]: keep only states in the central cube of side 1 + ε."),
    ] = None,
    protocol: Protocol = "paper-v1",
    action_range: ActionRange = None,
    name: Annotated[
        str | None, typer.Option(help="Minari id, such as sme/mine-v0; default from the settings.")
    ] = None,
    out_folder: Annotated[Path | None, typer.Option("--out", "-o", help=_FOLDER)] = None,
    set_: SpecChanges = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Make a data set of a chosen quality in Minari's HDF5 format.

    The behaviour policy is `a = (1 − α) a* + α ã`, where α is uniform in (0, ν) at each step and ã
    comes from another network of the same shape as the optimal policy. Every transition records its
    optimal action, similarity and exact regret. The metadata contain the exact scores of the
    constant action, the behaviour and the optimum. The same command makes the same bits.

    Examples:

      sme dataset make Default --nu 0.5 --transitions 50000 --seed 7
      sme dataset make Complexity10 --mix nu=0.5:0.7 --mix random:0.1 --mix policy=model.zip:0.2
      sme dataset make Plane1 --nu 0.25 --coverage -0.2 --name sme/inner-v0 --out data
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
            progress=progress.update_of,
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


@dataset.command("list")
def list_(folder: Folder = None, json: Json = False) -> None:
    """List the data sets in a folder.

    Examples:

      sme dataset list
      sme dataset list --datasets data --json
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
            "To make one, see `sme dataset make --help`."
        )
    for reason in broken.values():
        print_note(f"[yellow]invalid:[/] {escape(reason)}")


@dataset.command("show")
def show(name: Name, folder: Folder = None, json: Json = False) -> None:
    """Show a data set: its recipe, scores and digests.

    Examples:

      sme dataset show sme/Default-v1-nu50-seed7-v0
      sme dataset show data/sme/inner-v0 --json
    """
    _print(open_dataset(name, folder), json)


@dataset.command("validate")
def validate(
    sets: Annotated[list[str], typer.Argument(metavar="DATASET…", help="Data sets to check.")],
    folder: Folder = None,
    json: Json = False,
) -> None:
    """Check data sets bit for bit: location, digests, and every transition recomputed by the task.

    Examples:

      sme dataset validate sme/Default-v1-nu50-seed7-v0
      sme dataset validate data/sme/inner-v0
    """
    print_checks([_check(name, folder) for name in sets], "data sets", json=json)


def _check(name: str, folder: Path | None) -> dict[str, Any]:
    result: dict[str, Any] = {"set": name, "valid": False, "error": None}
    try:
        dataset = open_dataset(name, folder)
        check_location(dataset, folder)
        replay(dataset.transitions(), dataset.recipe, materialize(dataset.recipe.spec))
    except SMEError as error:
        return result | {"error": str(error)}
    return result | {"valid": True, "arrays_digest": dataset.record.arrays_digest}


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


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of a training on a data set."""

    algorithm: Annotated[str, typer.Option("--algorithm", "-a", help="bc or iql.")] = "iql"
    steps: Annotated[int, typer.Option("--steps", "-n", help="Gradient steps.")] = 20_000
    batch_size: Annotated[int, typer.Option(help="Transitions in each gradient step.")] = 256
    seed: Annotated[int, typer.Option(help="Seed of weights, shuffling and episodes.")] = 0
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a hyperparameter. Repeatable."),
    ] = None

    def arguments(self) -> dict[str, Any]:
        named = {name: getattr(self, name) for name in ("algorithm", "steps", "batch_size", "seed")}
        return {**named, "hyperparameters": changes(self.set_)}

    def progress(self) -> Progress:
        title = f"training {self.algorithm.upper()}"
        return Progress(title, max(1, self.steps), console=err())


offline = typer.Typer(no_args_is_help=True)
app.add_typer(offline, name="offline")


@offline.callback()
def _group() -> None:
    """Offline reinforcement learning: train on a data set, never in the environment."""


@offline.command()
@with_options(TrainingOptions)
def train(
    dataset: Annotated[
        str, typer.Argument(metavar="DATASET", help="An id from `sme dataset list`, or a path.")
    ],
    options: TrainingOptions,
    evaluations: Annotated[int, typer.Option(help="Evaluations during training.")] = 20,
    protocol: Annotated[
        str | None, typer.Option(help="Protocol of the last evaluation; default the data set's.")
    ] = None,
    folder: Folder = None,
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
    algorithm, _ = check_algorithm(options.algorithm)
    opened = open_dataset(dataset, folder)
    if out_folder is None:
        name = opened.id.rsplit("/", 1)[-1]
        out_folder = Path("runs") / f"{name}-{algorithm}-seed{options.seed}"
    with options.progress() as progress:
        result = train_offline(
            opened,
            **options.arguments(),
            evaluations=min(evaluations, max(1, options.steps)),
            protocol=protocol,
            folder=out_folder,
            force=force,
            progress=lambda done, total, note: progress.update(done, note),
        )
    print_training(result, out_folder, [_scores(result.record)], json=json)


@offline.command()
@with_options(TrainingOptions)
def sealed(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder of a sealed data set.")
    ],
    out_file: Annotated[Path, typer.Option("--out", "-o", help="The policy's .npz file.")],
    options: TrainingOptions,
    force: Force = False,
) -> None:
    """Train bc or iql on a sealed data set, whose task is hidden. Nothing is evaluated here.

    `sme-leaderboard enter` sends the policy's answers to the season's board.

    Examples:

      sme offline sealed autumn/datasets/sealed/autumn/deep-0-v0 -o deep-0.npz
    """
    check_new(out_file, force=force)
    with options.progress() as progress:
        policy = train_sealed(
            dataset, **options.arguments(), progress=lambda done, _: progress.update(done)
        )
    policy.save(out_file)
    print_line(escape(str(out_file)))


def _scores(record: Any) -> Table:
    algorithm = record.algorithm.upper()
    means = {
        f"behaviour, {record.transitions:,} transitions": record.behaviour,
        f"{algorithm}, {record.episodes} episodes": record.evaluations[-1],
    }
    rows = [
        {"": name, "r̃": f"{mean.similarity:.3f}", "SD over steps": f"{mean.similarity_sd:.3f}"}
        for name, mean in means.items()
    ]
    rows.append({"": "improvement", "r̃": f"{record.improvement:+.3f}", "SD over steps": ""})
    return Table.of(f"{algorithm} on {escape(record.dataset)}", rows)

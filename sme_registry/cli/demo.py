"""`sme demo`: the whole way once, from a task to a trained agent whose regret is known exactly."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from sme_registry.io import write_atomically
from sme_registry.terminal.output import err, out

if TYPE_CHECKING:
    from sme_registry.training import TrainingResult

TASK = "Default-v1"
FOLDER = Path("runs/demo")
_STEPS, _QUICK_STEPS = 15_000, 2_000
_STAGES = 10


def demo(
    out_folder: Annotated[
        Path, typer.Option("--out", "-o", help="Another folder must be new, or take --force.")
    ] = FOLDER,
    steps: Annotated[
        int | None, typer.Option("--steps", "-n", help=f"By default {_STEPS:,}.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help=f"A minute: {_QUICK_STEPS:,} steps, few states.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the run in --out.")] = False,
) -> None:
    """Train TD3 on SME/Default-v1, watch its regret fall, judge it in and out of distribution.

    A few minutes on two cores. Writes figures and report.md, and says where.

    Examples:

      sme demo

      sme demo --quick --out demo
    """
    from sme_registry import training
    from sme_registry.cli.runs import how_to_go_on
    from sme_registry.training.run import REPORT

    if steps is None:
        steps = _QUICK_STEPS if quick else _STEPS
    err().print(
        f"Training TD3 on SME/{TASK} for {steps:,} steps. The optimal action is known in every "
        "state, so the regret below is exact."
    )
    try:
        result = training.train(
            TASK,
            steps=steps,
            folder=out_folder,
            protocol="quick-v1" if quick else "paper-v1",
            console=err(),
            force=force or out_folder == FOLDER,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            how_to_go_on(out_folder).replace(
                "the same command with --resume",
                f"sme train {TASK} --steps {steps} --out {out_folder} --resume",
            )
        ) from None
    stages = regret_by_stage(result)
    out().print(_stages_table(stages))
    out().print(result.report.table())
    report = write_atomically(out_folder / REPORT, _report(result, stages))
    within = result.report.regions[0]
    out().print(
        f"\nWithin distribution: r̃ = {within.similarity:.3f}, normalised regret "
        f"{within.normalised_regret:.3f} (0 is optimal, 1 the constant policy)."
    )
    for path in (report, *result.figures, result.model_path, out_folder / "episodes.csv"):
        out().print(f"  {escape(str(path))}", soft_wrap=True)


def regret_by_stage(result: TrainingResult) -> list[tuple[int, int, float]]:
    """`(first step, last step, mean regret)` of each tenth of the training that ended episodes."""
    edges = np.linspace(0, result.record.steps_done, _STAGES + 1).astype(int)
    stages = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        regrets = [e.regret for e in result.episodes if first < e.step <= last]
        if regrets:
            stages.append((first, last, float(np.mean(regrets))))
    return stages


def _stages_table(stages: list[tuple[int, int, float]]) -> Table:
    table = Table(title="Mean regret while training (0 is optimal)", title_justify="left")
    table.add_column("steps", justify="right")
    table.add_column("mean regret", justify="right")
    table.add_column("", no_wrap=True)
    for first, last, regret in stages:
        table.add_row(f"{first:,}–{last:,}", f"{regret:.3f}", "█" * round(30 * regret))
    return table


def _report(result: TrainingResult, stages: list[tuple[int, int, float]]) -> str:
    record, report = result.record, result.report
    lines = [
        f"# {record.algorithm} on SME/{TASK}",
        "",
        f"{record.steps_done:,} steps in {record.wall_seconds / 60:.1f} minutes "
        f"({record.steps_per_second:.0f} a second), seed {record.seed}, Stable-Baselines3's "
        f"default hyperparameters. Task `{report.spec_digest}`, protocol "
        f"`{report.protocol_digest}`.",
        "",
        "## Regret while training",
        "",
        "Regret is 1 − step reward: what the optimal action would have earned beyond the one "
        "taken. It is exact, in every step.",
        "",
        "| steps | mean regret |",
        "|---|---:|",
        *(f"| {first:,}–{last:,} | {regret:.3f} |" for first, last, regret in stages),
        "",
        "## Within and out of distribution",
        "",
        f"{report.regions[0].states:,} states a region. r̃ is the similarity to the optimal "
        "action (1 is optimal); normalised regret is 0 for the optimum and 1 for the constant "
        "action ½; similarity decay is the share of r̃ lost since WD.",
        "",
        "| region | ε | r̃ | normalised regret | similarity decay | linear policy's r̃ |",
        "|---|---|---:|---:|---:|---:|",
    ]
    linear = report.references["linear_least_squares"]
    for region, reference in zip(report.regions, linear, strict=True):
        lines.append(
            f"| {region.name} | {region.epsilon_low:g}–{region.epsilon_high:g} "
            f"| {region.similarity:.3f} | {region.normalised_regret:.3f} "
            f"| {region.similarity_decay:.1%} | {reference.similarity:.3f} |"
        )
    for figure in result.figures:
        lines += ["", f"![{figure.stem.replace('_', ' ')}]({figure.name})"]
    files = ["model.zip", "episodes.csv", "evaluation.json", "run.json"]
    lines += ["", "## Files", "", *(f"- [{name}]({name})" for name in files)]
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    lines += ["", f"Versions: {versions}.", ""]
    return "\n".join(lines).replace(os.sep, "/")

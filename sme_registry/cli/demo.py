"""`sme demo`: train an agent on one task, with its exact regret, and evaluate it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.markup import escape

from sme_registry.cli.arguments import Force, write_run_explorer
from sme_registry.evaluation import EvaluationReport
from sme_registry.io import write_atomically
from sme_registry.io.markup import environment
from sme_registry.io.tables import Table
from sme_registry.io.terminal import err, out

if TYPE_CHECKING:
    from sme_registry.training import TrainingResult

TASK = "Default-v1"
FOLDER = Path("runs/demo")
_STAGES = 10
# Networks of 64² units and batches of 128 learn this task in a third of the time of TD3's defaults.
_STEPS, _SETTINGS = 6_000, {"batch_size": 128, "policy_kwargs": {"net_arch": [64, 64]}}
_FULL_STEPS = 15_000


def demo(
    out_folder: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")] = FOLDER,
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
    few minutes. Writes figures, report.md and explorer.html, and lists them.

    Examples:

      sme demo

      sme demo --full --out runs/full
    """
    from sme_registry import training
    from sme_registry.cli.train import how_to_continue
    from sme_registry.training.run import REPORT

    if steps is None:
        steps = _FULL_STEPS if full else _STEPS
    settings = {} if full else _SETTINGS
    err().print(
        f"Training TD3 on SME/{TASK} for {steps:,} steps. The optimal action of every state is "
        "known, so the regret below is exact."
    )
    try:
        result = training.train(
            TASK,
            steps=steps,
            folder=out_folder,
            hyperparameters=settings,
            console=err(),
            force=force or out_folder == FOLDER,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            how_to_continue(
                out_folder, f"`sme train {TASK} --steps {steps} --out {out_folder} --resume`"
            )
        ) from None
    stages = regret_by_stage(result)
    out().print(_stages_table(stages))
    out().print(result.report.table())
    explorer = write_run_explorer(out_folder)
    report = write_atomically(out_folder / REPORT, _report(result, stages, explorer))
    assert isinstance(result.report, EvaluationReport)  # of a task, not of a stream
    within = result.report.regions[0]
    out().print(
        f"\nWithin distribution: r̃ = {within.similarity:.3f}, normalised regret "
        f"{within.normalised_regret:.3f} (0 is optimal, 1 the constant policy)."
    )
    for path in (
        report,
        *explorer,
        *result.figures,
        result.model_path,
        out_folder / "episodes.csv",
    ):
        out().print(f"  {escape(str(path))}", soft_wrap=True)


def regret_by_stage(result: TrainingResult) -> list[tuple[int, int, float]]:
    """`(first step, last step, mean regret)` of each tenth of training in which episodes ended."""
    edges = np.linspace(0, result.record.steps_done, _STAGES + 1).astype(int)
    stages = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        regrets = [e.regret for e in result.episodes if first < e.step <= last]
        if regrets:
            stages.append((first, last, float(np.mean(regrets))))
    return stages


def _stages_table(stages: list[tuple[int, int, float]]) -> Table:
    columns = {"steps": "number", "regret": "number", "": "name"}
    rows = [
        (f"{first:,}–{last:,}", f"{regret:.3f}", "█" * round(30 * regret))
        for first, last, regret in stages
    ]
    return Table("Mean regret during training (0 is optimal)", columns, rows)


def _report(
    result: TrainingResult, stages: list[tuple[int, int, float]], explorer: list[Path]
) -> str:
    templates = environment(Path(__file__).parent / "templates", autoescape=False)
    text = templates.get_template("demo.md.jinja").render(
        task=TASK, result=result, stages=stages, explorer=[path.name for path in explorer]
    )
    return f"{text}\n"

"""`sme study plan`: list plans, and estimate how long one takes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Json, find_file
from sme_registry.cli.list import number_of_cells, study_table, summary
from sme_registry.errors import OptionError, SMEError
from sme_registry.io.tables import Table
from sme_registry.io.terminal import duration_range, err, out, print_json
from sme_registry.spec import PlannedCell, StudyAlgorithm, StudyFile, StudyPlan, catalogue

Steps = Annotated[
    list[str] | None,
    typer.Option(
        "--steps",
        "-n",
        metavar="N|ALGORITHM=N",
        help="Steps of each training, or of one algorithm's. Repeatable.",
    ),
]
Seeds = Annotated[int | None, typer.Option(help="Runs of each algorithm on each class.")]
Evaluations = Annotated[int | None, typer.Option(help="Evaluations during each training.")]
Agents = Annotated[
    str | None,
    typer.Option(
        metavar="sb3|jax",
        help="Implementation of PPO, TD3 and SAC: of Stable-Baselines3, or in JAX, with the "
        "environment in one program. Default as in the plan.",
    ),
]
Only = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND=GLOB",
        help="Only cells that match class=GLOB or algorithm=GLOB. Repeatable: a cell must "
        "match one pattern of each kind given.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, help="Cells at once; default one per core.")
]


def plan(
    plan: Annotated[
        str | None,
        typer.Argument(
            metavar="PLAN",
            help="A name or a path; without it, list the catalogue.",
            autocompletion=catalogue.completion(StudyFile),
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", "-f", help="Use and count the results in this study's folder."),
    ] = None,
    cores: Annotated[
        int | None, typer.Option(min=1, help="Also estimate for a cluster with this many cores.")
    ] = None,
    jobs: Jobs = None,
    steps: Steps = None,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    agents: Agents = None,
    only: Only = None,
    json: Json = False,
) -> None:
    """Show what a study runs and how long it takes, before anything runs.

    Times come from finished cells of the same algorithm in --folder. Without any, they are a range
    from a fast core to a slow one.

    Examples:

      sme study plan

      sme study plan paper-ablations --cores 64

      sme study plan paper-ablations --steps 20000 --seeds 3 --only algorithm=PPO --only "class=k-*"

      sme study plan smoke --folder runs/smoke --json
    """
    from sme_registry.studies.engine.estimate import Estimator, Span, makespan
    from sme_registry.studies.engine.jobs import available_cores
    from sme_registry.studies.engine.ledger import Ledger
    from sme_registry.studies.engine.scaling import selected

    if plan is None:
        _list_plans(json)
        return
    file = scaled_plan(find_file(StudyFile, plan), steps, seeds, evaluations, agents)
    planned = selected(file.plan.cells, only or ())
    cells = {cell.cell.digest: cell.cell for cell in planned}
    results = {} if folder is None else Ledger(folder).results()
    names = {cell.algorithm for cell in planned}
    check_algorithms((a for a in file.plan.algorithms if a.name in names), SMEError)
    warn_of_uneven_rollouts(file.plan)
    estimator = Estimator(results.values())
    waiting = [cell for key, cell in cells.items() if key not in results]
    spans = [estimator.seconds(cell) for cell in waiting]

    def seconds(workers: int) -> Span:
        return Span(*(makespan([span[i] for span in spans], workers) for i in (0, 1)))

    here = jobs or available_cores()
    workers = {"one core": 1, f"this machine, {here} at once": here}
    if cores is not None:
        workers[f"a cluster, {cores} cores"] = cores
    done = len(cells) - len(waiting)
    measured = {cell.uses for cell in waiting if estimator.knows(cell)}
    if json:
        print_json(
            {
                "study": file.versioned_name,
                "digest": file.digest,
                "cells": len(cells),
                "done": done,
                "classes": unique(cell.class_name for cell in planned),
                "algorithms": unique(cell.algorithm for cell in planned),
                "seeds": file.plan.seeds,
                "estimated_from_results": sorted(measured),
                "seconds": [
                    {"cores": n, **seconds(n)._asdict()} for n in dict.fromkeys(workers.values())
                ],
            }
        )
        return
    out().print(_plan_table(file, planned, estimator.seconds))
    finished = f", {done:,} of them finished" if results else ""
    out().print(f"{len(cells):,} cells{finished}. Estimated time:")
    for place, n in workers.items():
        out().print(f"  {place + ':':32}{duration_range(*seconds(n))}")
    unmeasured = sorted({cell.uses for cell in waiting} - measured)
    if unmeasured:
        out().print(
            f"[dim]From a table of costs, not from results: {escape(', '.join(unmeasured))}.[/]",
            soft_wrap=True,
        )


def _list_plans(json: bool) -> None:
    files = catalogue.entries(StudyFile)
    if json:
        print_json([{**summary(file), "cells": number_of_cells(file.plan)} for file in files])
    else:
        out().print(study_table(files))


def _plan_table(file: StudyFile, planned: Sequence[PlannedCell], seconds: Any) -> Table:
    classes = unique(cell.class_name for cell in planned)
    numbers = ("classes", "runs each", "steps", "evaluations", "cells", "time per run")
    rows = []
    for name in unique(cell.algorithm for cell in planned):
        places = [place for place in planned if place.algorithm == name]
        cells = {place.cell.digest: place for place in places}.values()
        first = places[0].cell
        steps = [each.cell.steps for each in cells]
        spans = [seconds(each.cell) for each in cells]
        rows.append(
            (
                escape(name),
                str(len({each.class_name for each in places})),
                str(len({each.run for each in places})),
                " to ".join(f"{bound:,}" for bound in sorted({min(steps), max(steps)})),
                f"{first.evaluations:,} × {first.evaluation_episodes}",
                f"{len(cells):,}",
                duration_range(min(span.low for span in spans), max(span.high for span in spans)),
            )
        )
    return Table(
        f"[bold]{file.versioned_name}[/]  {escape(file.description)}",
        {"algorithm": "name", **dict.fromkeys(numbers, "number")},
        rows,
        caption=f"{file.digest}\n{len(classes)} classes: {escape(', '.join(classes))}",
    )


def scaled_plan(
    file: StudyFile,
    steps: list[str] | None,
    seeds: int | None,
    evaluations: int | None,
    agents: str | None = None,
) -> StudyFile:
    """A plan with the budgets of `--steps`, `--seeds` and `--evaluations`, and `--agents`.

    Raises:
      OptionError: `--steps` is not a number, or is given twice for an algorithm.
      UnknownNameError, SpecError: see `scaling.scaled`.
      SMEError: see `scaling.with_agents`.
    """
    from sme_registry.studies.engine.scaling import scaled, with_agents

    budgets: dict[str, int] = {}
    for text in steps or ():
        name, _, number = text.rpartition("=")
        if not number.replace("_", "").isdigit():
            raise OptionError(
                f"--steps {text!r}: must be N or ALGORITHM=N, such as --steps PPO=100000."
            )
        if name in budgets:
            raise OptionError(f"--steps {text!r}: {name or 'N'} is given twice. Remove one.")
        budgets[name] = int(number)
    every = budgets.pop("", None)
    file = scaled(file, steps=every, steps_of=budgets, seeds=seeds, evaluations=evaluations)
    return file if agents is None else with_agents(file, agents)


def check_algorithms(algorithms: Iterable[StudyAlgorithm], errors: type[SMEError]) -> None:
    """Check a plan's algorithms; warn about those that cannot be found here by such an error.

    Raises:
      OptionError, SpecError: an algorithm has no hyperparameter of a name.
      SMEError: it cannot be found, by an error of another type.
    """
    from sme_registry.studies.engine import checks

    messages = []
    for algorithm in algorithms:
        try:
            checks.find(algorithm.uses)
        except errors as error:
            unchecked = " Its hyperparameters are not checked." if algorithm.hyperparameters else ""
            messages.append(f"{error}{unchecked}")
        else:
            checks.check_hyperparameters(algorithm)
    for message in unique(messages):  # several algorithms may lack the same package
        err().print(f"[yellow]cannot run here:[/] {escape(message)}", soft_wrap=True)


def warn_of_uneven_rollouts(plan: StudyPlan) -> None:
    """Print which rollouts do not end where the phases of streams do."""
    from sme_registry.studies.engine import checks

    for uneven in checks.uneven_rollouts(plan):
        err().print(
            f"[yellow]uneven rollouts:[/] {escape(uneven.algorithm)} on "
            f"{escape(', '.join(uneven.streams))}: its rollouts of {uneven.n_steps:,} steps do not "
            "end where phases do. At the end of a visit it has learned from fewer steps than a "
            "fresh agent, which counts as lost plasticity. Use "
            f"--set {escape(uneven.algorithm)}.n_steps={uneven.better}, and a batch_size that "
            "divides it.",
            soft_wrap=True,
        )


def unique(values: Iterable[str]) -> list[str]:
    """The different values, in order of appearance."""
    return list(dict.fromkeys(values))

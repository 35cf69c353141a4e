"""`sme study`: plans of runs, what they will take, running them, and where they stand."""

from __future__ import annotations

import enum
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sme_registry import load
from sme_registry.cli import study_report
from sme_registry.errors import MissingDependencyError, OptionError, SMEError
from sme_registry.io import read_json
from sme_registry.spec import (
    PlannedCell,
    StudyFile,
    StudyPlan,
    SuiteClass,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.resolve import is_path
from sme_registry.terminal import duration_range, err, out, print_json

if TYPE_CHECKING:
    from sme_registry.studies.engine.estimate import Span
    from sme_registry.studies.engine.status import StudyStatus

_LINES_OF_FAILURES = 20
_BESIDE_FROM = ("path", "name", "description", "source", "force")

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="""Studies: algorithms × kinds of tasks × seeds, resumable, on a laptop or a cluster.

    Examples:

      sme study run smoke --folder runs/smoke

      sme study plan paper-ablations --cores 64

      sme study status runs/smoke

      sme study report runs/smoke
    """,
)

PlanName = Annotated[
    str, typer.Argument(metavar="PLAN", help="A name of `sme study plan`, or a plan's path.")
]
Steps = Annotated[
    list[str] | None,
    typer.Option(
        "--steps",
        "-n",
        metavar="N|ALGORITHM=N",
        help="Steps of each run that trains, or of one algorithm's; repeatable.",
    ),
]
Seeds = Annotated[int | None, typer.Option(help="Runs of each algorithm on each class.")]
Evaluations = Annotated[int | None, typer.Option(help="Evaluations during each training.")]
Only = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND=GLOB",
        help="class=GLOB or algorithm=GLOB; repeatable: any of a kind, and both kinds.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", "-j", min=1, help="Cells at once; by default one a core."),
]
Json = Annotated[bool, typer.Option("--json", help="Plain JSON on standard output.")]


class ExecutorName(enum.StrEnum):
    """Where cells run."""

    processes = "processes"
    in_process = "in-process"
    ray = "ray"


@app.command("new")
def new(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)],
    suite: Annotated[
        str | None, typer.Option(help="Its classes: a suite's name, or its path.")
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option("--task", "-t", help="A class of this one task: name or path; repeatable."),
    ] = None,
    algorithm: Annotated[
        list[str] | None,
        typer.Option(
            "--algorithm",
            "-a",
            metavar="[NAME=]USES",
            help="PPO, TD3, SAC, … of Stable-Baselines3, module:function, reference:linear, "
            "reference:constant, …; repeatable.",
        ),
    ] = None,
    steps: Annotated[
        list[str] | None,
        typer.Option("--steps", "-n", metavar="N|ALGORITHM=N", help="Of each run; repeatable."),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Runs of each algorithm on each class.")] = 10,
    evaluations: Annotated[int, typer.Option(help="During each training.")] = 100,
    evaluation_episodes: Annotated[int, typer.Option(help="In each evaluation.")] = 5,
    action_range: Annotated[
        list[str] | None,
        typer.Option(help="symmetric, unit, or both of them in turn; repeatable."),
    ] = None,
    protocol: Annotated[
        str, typer.Option(help="Of the evaluation within and out of distribution at the end.")
    ] = "paper-v1",
    name: Annotated[str | None, typer.Option(help="By default --from's, or the file's.")] = None,
    description: Annotated[str | None, typer.Option(help="One or two sentences.")] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="PLAN",
            help="In place of the options above: the plan of a file that was edited, whatever its "
            "digest; of a file that is a plan alone; or of the catalogue, to edit it.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write a plan: which algorithms on which tasks, how often, and how long.

    A plan is a file that a colleague can run. References learn nothing and take no steps. What has
    no option, such as hyperparameters, is edited in the file, which --from then makes a plan again.

    Examples:

      sme study new mine.json --suite smoke -a PPO -a TD3 -a reference:linear --seeds 5 -n 20000

      sme study new deep.json -t Default -t Complexity10 -a TQC=sb3_contrib:TQC -n 10000

      sme study new ranges.json -t Default -a PPO --action-range symmetric --action-range unit

      sme study new wider.json --from edited.json
    """
    from sme_registry.evaluation import resolve_protocol

    if path.suffix != ".json":
        raise OptionError(f"{path}: must end in .json, by which every command knows a path.")
    if path.exists() and not force:
        raise OptionError(f"{path}: is there already. Give another path, or --force to replace it.")
    own = {"name": name, "description": description}
    own = {field: text for field, text in own.items() if text is not None}
    if source is None:
        plan = _made(
            str(path),
            [*(_suite_classes(suite) if suite is not None else ()), *map(_class, task or ())],
            algorithm or (),
            action_range or ["symmetric"],
            steps,
            seeds=seeds,
            evaluations=evaluations,
            evaluation_episodes=evaluation_episodes,
            protocol=resolve_protocol(protocol).to_dict(),
        )
        file = StudyFile.sealed(plan.to_dict(), str(path), **{"name": path.stem, **own})
    else:
        _refuse_beside_from(context)
        data = read_json(source) if is_path(source) else _find(source).to_dict()
        named = isinstance(data, dict) and "name" in data
        file = StudyFile.sealed(data, source, **{**({} if named else {"name": path.stem}), **own})
    # What is only not installed here may be where the plan is run.
    _tell_of_algorithms(
        (algorithm.uses for algorithm in file.plan.algorithms), MissingDependencyError
    )
    file.write(path)
    out().print(f"{escape(str(path))}  {file.digest}", soft_wrap=True)
    err().print(f"[dim]sme study plan {escape(str(path))}  says what it takes[/]", soft_wrap=True)


def _tell_of_algorithms(uses: Iterable[str], told: type[SMEError]) -> None:
    """Say which algorithms could not be run here.

    Args:
      uses: of a plan's algorithms.
      told: the kind of error that is a line on standard error; others are raised.
    """
    from sme_registry.studies.engine.cell import refuse_unknown_algorithm

    lines: dict[str, None] = {}
    for one in dict.fromkeys(uses):
        try:
            refuse_unknown_algorithm(one)
        except told as error:
            lines[str(error)] = None  # one that several have is said once
    for line in lines:
        err().print(f"[yellow]could not be run here:[/] {escape(line)}", soft_wrap=True)


def _refuse_beside_from(context: typer.Context) -> None:
    """Raise where what --from brings is also given as an option.

    Raises:
      OptionError: names the option.
    """
    for option in context.params:
        given = context.get_parameter_source(option)
        # By name: newer versions of Typer bring their own Click.
        if option not in _BESIDE_FROM and given is not None and given.name == "COMMANDLINE":
            raise OptionError(
                f"--{option.replace('_', '-')}: the plan of --from has its own. Change it in that "
                "file, or leave out --from."
            )


def _made(
    path: str,
    classes: Sequence[SuiteClass],
    algorithms: Sequence[str],
    ranges: Sequence[str],
    steps: list[str] | None,
    **fields: Any,
) -> StudyPlan:
    """The plan that the options of `sme study new` describe.

    Raises:
      OptionError, SpecError, UnknownNameError: an option is missing or wrong.
    """
    from sme_registry.studies.engine.scaling import scaled

    if not classes:
        raise OptionError(
            "--suite: missing: on which tasks? Give --suite smoke, or --task Default."
        )
    if not algorithms:
        raise OptionError("--algorithm: missing: what is run? Give for example --algorithm PPO.")
    plan = StudyPlan.from_dict(
        {
            "classes": [member.to_dict() for member in classes],
            "algorithms": [
                _algorithm(text, each, len(ranges) > 1) for text in algorithms for each in ranges
            ],
            **fields,
        },
        path,
    )
    every, single = _budgets(steps)
    # Scaled as a plan of the catalogue would be, so that the options mean the same.
    draft = StudyFile(name="draft", digest=plan.digest, plan=plan)
    return scaled(draft, steps=every, steps_of=single).plan


def _suite_classes(name: str) -> Sequence[SuiteClass]:
    file = SuiteFile.read(name) if is_path(name) else catalogue.find(SuiteFile, name)
    return file.suite.classes


def _class(task: str) -> SuiteClass:
    spec = load(task)
    fields = spec.to_dict()
    seed = fields.pop("seed")
    title = catalogue.title(spec).rsplit("/", 1)[-1].removesuffix("-v1")
    return SuiteClass.from_dict({"name": title, "setting": fields, "seeds": [seed]})


def _algorithm(text: str, action_range: str, several_ranges: bool) -> dict[str, Any]:
    name, equals, uses = text.partition("=")
    if not equals:
        uses = text
        name = text.rsplit(":", 1)[-1]
    if several_ranges:
        name = f"{name} ({action_range})"
    trains = not uses.startswith("reference:")
    fields = {"name": name, "uses": uses, "action_range": action_range}
    return fields if trains else {**fields, "steps": 0}


@app.command("plan")
def plan(
    plan: Annotated[
        str | None,
        typer.Argument(metavar="PLAN", help="A name or a path; none lists those of the catalogue."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", "-f", help="Learn from what has finished there, and count it."),
    ] = None,
    cores: Annotated[
        int | None, typer.Option(min=1, help="Also estimate for a cluster of so many cores.")
    ] = None,
    jobs: Jobs = None,
    steps: Steps = None,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    only: Only = None,
    json: Json = False,
) -> None:
    """What a study would run, and how long it would take, before anything runs.

    Times are from what has finished in --folder, where there is something of the algorithm; else
    between a quick core's and a slow one's.

    Examples:

      sme study plan

      sme study plan paper-ablations --cores 64

      sme study plan paper-ablations --steps 20000 --seeds 3 --only algorithm=PPO --only "class=k-*"

      sme study plan smoke --folder runs/smoke --json
    """
    from sme_registry.studies.engine.estimate import Estimator, Span, makespan
    from sme_registry.studies.engine.executors import available_cores
    from sme_registry.studies.engine.ledger import Ledger
    from sme_registry.studies.engine.scaling import selected

    if plan is None:
        _list_plans(json)
        return
    file = _scaled(_find(plan), steps, seeds, evaluations)
    planned = selected(file.plan.cells, only or ())
    cells = {cell.cell.digest: cell.cell for cell in planned}
    results = {} if folder is None else Ledger(folder).results()
    _tell_of_algorithms((cell.cell.uses for cell in planned), SMEError)
    estimator = Estimator(results.values())
    waiting = [cell for key, cell in cells.items() if key not in results]
    spans = [estimator.seconds(cell) for cell in waiting]

    def takes(workers: int) -> Span:
        return Span(*(makespan([span[i] for span in spans], workers) for i in (0, 1)))

    here = available_cores() if jobs is None else jobs
    times = {"one core": takes(1), f"this machine, {here} at once": takes(here)}
    if cores is not None:
        times[f"a cluster, {cores} cores"] = takes(cores)
    if json:
        print_json(
            {
                "study": file.versioned_name,
                "digest": file.digest,
                "cells": len(cells),
                "done": len(cells) - len(waiting),
                "classes": _unique(cell.class_name for cell in planned),
                "algorithms": _unique(cell.algorithm for cell in planned),
                "seeds": file.plan.seeds,
                "estimated_from_results": sorted(
                    {cell.uses for cell in waiting if estimator.knows(cell)}
                ),
                "seconds": [
                    {"cores": n, **takes(n)._asdict()}
                    for n in dict.fromkeys([1, here, *([] if cores is None else [cores])])
                ],
            }
        )
        return
    out().print(_plan_table(file, planned, estimator.seconds))
    done = f", of which {len(cells) - len(waiting):,} have finished" if results else ""
    out().print(f"{len(cells):,} cells{done}. To run them takes about")
    for where, span in times.items():
        out().print(f"  {where + ':':32}{duration_range(*span)}")
    guessed = sorted({cell.uses for cell in waiting if not estimator.knows(cell)})
    if guessed:
        out().print(
            f"[dim]From a table of costs, not from results: {escape(', '.join(guessed))}.[/]",
            soft_wrap=True,
        )


def _list_plans(json: bool) -> None:
    files = catalogue.entries(StudyFile)
    if json:
        print_json(
            [
                {
                    "name": file.versioned_name,
                    "digest": file.digest,
                    "cells": len(file.plan.cells),
                    "description": file.description,
                }
                for file in files
            ]
        )
        return
    table = Table(title="Studies", title_justify="left")
    for column in ("name", "classes × algorithms × seeds", "description"):
        table.add_column(column, no_wrap=column == "name")
    for file in files:
        plan = file.plan
        size = f"{len(plan.classes)} × {len(plan.algorithms)} × {plan.seeds}"
        table.add_row(file.versioned_name, size, escape(file.description))
    out().print(table)


def _plan_table(file: StudyFile, planned: Sequence[PlannedCell], seconds: Any) -> Table:
    table = Table(
        title=f"[bold]{file.versioned_name}[/]  {escape(file.description)}",
        caption=f"{file.digest}\n{len(_unique(cell.class_name for cell in planned))} classes: "
        f"{escape(', '.join(_unique(cell.class_name for cell in planned)))}",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("algorithm", no_wrap=True)
    for column in ("classes", "runs each", "steps", "evaluations", "cells", "a run"):
        table.add_column(column, justify="right")
    for name in _unique(cell.algorithm for cell in planned):
        cells = [cell for cell in planned if cell.algorithm == name]
        cell = cells[0].cell
        spans = [seconds(each.cell) for each in cells]
        low, high = min(span.low for span in spans), max(span.high for span in spans)
        table.add_row(
            escape(name),
            str(len({each.class_name for each in cells})),
            str(len({each.run for each in cells})),
            f"{cell.steps:,}",
            f"{cell.evaluations:,} × {cell.evaluation_episodes}",
            f"{len(cells):,}",
            duration_range(low, high),
        )
    return table


@app.command("run")
def run(
    plan: PlanName,
    folder: Annotated[Path, typer.Option("--folder", "-f", help="Of the study; made if missing.")],
    executor: Annotated[
        ExecutorName | None,
        typer.Option(help="By default processes; with --ray, ray."),
    ] = None,
    jobs: Jobs = None,
    ray: Annotated[
        str | None,
        typer.Option(metavar="local|ADDRESS", help="Run on Ray, started here or at host:port."),
    ] = None,
    retry: Annotated[
        bool, typer.Option("--retry", help="Also run the cells that failed before.")
    ] = False,
    keep_models: Annotated[
        bool,
        typer.Option(
            "--keep-models", help="Keep the models that are trained now, in FOLDER/models."
        ),
    ] = False,
    steps: Steps = None,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    only: Only = None,
    json: Annotated[bool, typer.Option("--json", help="Where it stands at the end, as JSON.")] = (
        False
    ),
) -> None:
    """Run the cells of a plan that the folder has no result of.

    Stop it as you like, also with kill -9: the same command goes on, and only the cells that were
    running begin again. Run it twice on one folder, also from two machines that share it, and they
    share the cells. With other --steps, --seeds, --evaluations or another plan, what is the same is
    reused. A cell that fails is listed, and run again with --retry.

    On a cluster, this package and Ray in the same versions on every node are all that is needed:
    results come back here.

    Examples:

      sme study run smoke --folder runs/smoke

      sme study run paper-ablations -f runs/k --only "class=k-*" --only class=default --seeds 3

      sme study run paper-ablations -f runs/short --steps 20000 --steps PPO=100000 --jobs 8

      sme study run paper-ablations -f runs/all --ray 10.0.0.1:6379
    """
    from sme_registry.studies.engine.runner import run_study

    if ray is not None and executor not in (None, ExecutorName.ray):
        raise OptionError(f"--ray {ray}: --executor {executor} is another. Leave out one of them.")
    chosen = executor or (ExecutorName.processes if ray is None else ExecutorName.ray)
    file = _scaled(_find(plan), steps, seeds, evaluations)
    status = run_study(
        file,
        folder,
        executor=chosen.value,
        jobs=jobs,
        ray=ray or "local",
        retry_failed=retry,
        keep_models=keep_models,
        only=only or (),
        console=err(),
    )
    if json:
        print_json(status.to_dict())
    else:
        _print_status(status)
    if status.failed:
        err().print(
            f"[bold red]{len(status.failed)} of {len(status.cells)} cells failed.[/] The same "
            "command with --retry runs them again.",
            soft_wrap=True,
        )
        raise typer.Exit(1)


@app.command("status")
def status(
    folder: Annotated[Path, typer.Argument(help="Of the study.")],
    only: Only = None,
    steps: Steps = None,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    json: Json = False,
) -> None:
    """Where a study stands: cells done, running, failed and waiting, and the time left.

    Changes nothing, also while it runs. With --steps, --seeds or --evaluations: where the plan so
    scaled would stand.

    Examples:

      sme study status runs/smoke

      sme study status runs/all --only "class=k-*" --json
    """
    from sme_registry.studies.engine.status import study_status

    found = study_status(folder, only or (), lambda file: _scaled(file, steps, seeds, evaluations))
    if json:
        print_json(found.to_dict())
    else:
        _print_status(found)


app.command("report")(study_report.report)


def _print_status(status: StudyStatus) -> None:
    from sme_registry.studies.engine.executors import available_cores
    from sme_registry.studies.engine.status import STATES

    file = status.file
    table = Table(
        title=f"[bold]{file.versioned_name}[/] in {escape(str(status.folder))}",
        title_justify="left",
    )
    algorithms = _unique(cell.planned.algorithm for cell in status.cells)
    table.add_column("class", no_wrap=True)
    for name in algorithms:
        table.add_column(escape(name), justify="right", no_wrap=True)
    counts = status.counts
    for class_name in _unique(cell.planned.class_name for cell in status.cells):
        row = [counts.get((class_name, name)) for name in algorithms]
        table.add_row(class_name, *("" if one is None else _counted(one) for one in row))
    out().print(table)
    out().print("done · [cyan]+ running[/] · [red]! failed[/] · [dim]/ of all[/]")
    parts = [f"{status.count(state):,} {state}" for state in STATES if status.count(state)]
    out().print(f"{len(status.cells):,} cells: {', '.join(parts)}")
    if status.seconds_left.high > 0:
        here = available_cores()
        one = duration_range(*status.seconds_left)
        all_here = duration_range(*(bound / here for bound in status.seconds_left))
        out().print(f"Time left: {one} on one core, {all_here} on the {here} cores here")
    if status.other_results:
        out().print(
            f"[dim]{status.other_results:,} results in the folder are of no cell of this plan[/]"
        )
    for cell in status.failed[:_LINES_OF_FAILURES]:
        failure, planned = cell.failure, cell.planned
        if failure is None:
            continue
        times = f" ({failure.attempts} times)" if failure.attempts > 1 else ""
        out().print(
            f"[red]failed{times}[/] {escape(planned.algorithm)} on {planned.class_name}, run "
            f"{planned.run}: {escape(failure.error)}\n  "
            f"[dim]{_failure_path(status, failure.key)}[/]",
            soft_wrap=True,
        )
    if len(status.failed) > _LINES_OF_FAILURES:
        out().print(f"… and {len(status.failed) - _LINES_OF_FAILURES} more: --json lists them all")


def _failure_path(status: StudyStatus, key: str) -> str:
    path = status.folder / "failed" / f"{key.removeprefix('sha256:')}.json"
    return escape(str(path).replace(os.sep, "/"))


def _counted(counts: Any) -> str:
    """`7 +2 !1 / 10`: done, running, failed, of all."""
    text = f"{counts['done']}"
    if counts["running"]:
        text += f" [cyan]+{counts['running']}[/]"
    if counts["failed"]:
        text += f" [red]!{counts['failed']}[/]"
    return f"{text} [dim]/ {counts.total()}[/]"


def _find(name: str) -> StudyFile:
    """A plan by its name or path.

    Raises:
      UnknownNameError, SpecError: there is none, or it is no plan.
    """
    return StudyFile.read(name) if is_path(name) else catalogue.find(StudyFile, name)


def _scaled(
    file: StudyFile, steps: list[str] | None, seeds: int | None, evaluations: int | None
) -> StudyFile:
    from sme_registry.studies.engine.scaling import scaled

    every, single = _budgets(steps)
    return scaled(file, steps=every, steps_of=single, seeds=seeds, evaluations=evaluations)


def _budgets(texts: list[str] | None) -> tuple[int | None, dict[str, int]]:
    """`--steps 20000 --steps PPO=100000` as the budget of all, and those of single algorithms.

    Raises:
      OptionError: not a number, or given twice.
    """
    found: dict[str, int] = {}
    for text in texts or ():
        name, _, number = text.rpartition("=")
        if not number.replace("_", "").isdigit():
            raise OptionError(
                f"--steps {text!r}: must be a number or ALGORITHM=number, as in --steps PPO=100000."
            )
        if name in found:
            raise OptionError(f"--steps {text!r}: {name or 'all'} is given twice. Remove one.")
        found[name] = int(number)
    return found.pop("", None), found


def _unique(values: Any) -> list[str]:
    return list(dict.fromkeys(values))

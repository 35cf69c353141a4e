"""`sme study`: run, inspect, report and compare studies."""

from __future__ import annotations

import enum
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from sme_registry import studies
from sme_registry.cli.arguments import Json, Out, unique, with_options
from sme_registry.cli.plan import Budgets, Jobs, Only, PlanName, PlanOptions, new, plan
from sme_registry.errors import OptionError
from sme_registry.io.markup import Table, plural
from sme_registry.io.system import available_cores
from sme_registry.io.terminal import duration, out, print_json, print_line, print_note
from sme_registry.spec import StudyFile, catalogue
from sme_registry.studies.executors import EXECUTORS
from sme_registry.studies.ledger import (
    PLAN,
    STATES,
    CellStatus,
    Ledger,
    State,
    StudyStatus,
    label,
    plan_status,
)
from sme_registry.studies.runner import run_study

_FAILURES_SHOWN = 20
ExecutorName = enum.StrEnum("ExecutorName", list(EXECUTORS))  # type: ignore[misc]

StudyFolder = Annotated[Path, typer.Argument(help="The study's folder.")]
NewFolder = Annotated[
    Path, typer.Option("--folder", "-f", help="The study's folder; created if necessary.")
]

study = typer.Typer(
    no_args_is_help=True,
    help="""Studies: algorithms × classes of tasks × seeds, resumable, on a laptop or a cluster.

    Examples:

      sme study run smoke --folder runs/smoke
      sme study sweep -t Default --sweep k=1,2,5,10 -a PPO -n 20000 -f runs/k
      sme study plan paper-ablations --cores 64
      sme study status runs/smoke
      sme study report runs/smoke
      sme study compare runs/smoke PPO TD3
    """,
)


@with_options
def run(
    plan: PlanName,
    folder: NewFolder,
    options: Budgets,
    executor: Annotated[
        ExecutorName | None, typer.Option(help="Default processes; with --ray, ray.")
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
        bool, typer.Option("--keep-models", help="Keep the models trained now, in FOLDER/models.")
    ] = False,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="cpu|gpu|tpu", help="Of agents in JAX. Default a GPU if there is one."
        ),
    ] = None,
    lanes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Most cells in one program of JAX. Default 10 on a CPU, 256 elsewhere."
        ),
    ] = None,
    only: Only = None,
    json: Json = False,
) -> None:
    """Run the cells of a plan that have no result in the folder.

    A cell is one run: an algorithm, a class and a seed. Stop the study at any time, even with
    kill -9, and run the same command to continue. Several commands may share a folder, also from
    several machines. With another plan or other budgets, cells with the same content are reused.
    Agents in JAX are other algorithms: no result of theirs counts for Stable-Baselines3's. A
    cluster needs this package and Ray in the same versions on every node.

    Examples:

      sme study run smoke --folder runs/smoke
      sme study run paper-ablations -f runs/k --only "class=k-*" --only class=default --seeds 3
      sme study run paper-ablations -f runs/jax --agents jax --only algorithm=PPO
      sme study run paper-ablations -f runs/all --ray 10.0.0.1:6379
    """
    status = run_study(
        options.scaled(catalogue.find(StudyFile, plan)),
        folder,
        executor=executor,
        jobs=jobs,
        ray=ray,
        retry_failed=retry,
        keep_models=keep_models,
        only=only or (),
        device=device,
        lanes=lanes,
    )
    print_status(status, json)
    check_complete(status, only or ())


def check_complete(status: StudyStatus, only: Sequence[str] = ()) -> None:
    """End with exit code 1 if cells failed."""
    if status.failed:
        again = ["sme", "study", "run", f"{status.folder / PLAN}", "--folder", f"{status.folder}"]
        again += ["--retry", *(word for glob in only for word in ("--only", glob))]
        print_note(
            f"[bold red]{len(status.failed)} of {len(status.cells)} cells failed.[/] "
            f"To run them again: {escape(shlex.join(again))}"
        )
        raise typer.Exit(1)


@with_options
def status(folder: StudyFolder, options: Budgets, only: Only = None, json: Json = False) -> None:
    """Show how many cells are done, running, failed and waiting, and the time left.

    It changes nothing and may be used while the study runs. --steps, --seeds and --evaluations
    show the status of the plan with these budgets.

    Examples:

      sme study status runs/smoke
      sme study status runs/all --only "class=k-*" --json
    """
    ledger = Ledger(folder)
    print_status(plan_status(ledger, options.scaled(ledger.study_file()), only or ()), json)


def report(
    folder: StudyFolder,
    out_folder: Out = None,
    formats: Annotated[
        str, typer.Option("--format", metavar="FORMATS", help="Any of these, separated by commas.")
    ] = "html,png,pdf,csv,latex",
    explorers: Annotated[
        bool,
        typer.Option(
            "--explorers", help="Also an explorer (`sme diagnose --explore`) of each kept model."
        ),
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="Also all figures and tables as files.")
    ] = False,
) -> None:
    """Report which property of the task breaks an algorithm, and how certain that is.

    Of streams it reports what is forgotten, how visits end beside fresh agents, and what
    relatedness does.

    It writes a self-contained page index.html, its first figure, and a table as CSV and LaTeX; with
    --full every figure and number; by default to FOLDER/report. It uses the cells finished so far,
    so it may be run during the study.

    Maps of tasks with two state channels, and --explorers, need the models kept by `sme study run
    --keep-models`. Loading a model can run code: use only models whose author you trust.

    Examples:

      sme study report runs/smoke
      sme study report runs/all --full --out paper/study --format pdf,latex
      sme study report runs/smoke --explorers
    """
    chosen = [name.strip() for name in formats.split(",")]
    _print_report(studies.write_report(folder, out_folder, chosen, explorers=explorers, full=full))


def _print_report(files: Sequence[Path]) -> None:
    """The page, and how many files are in each folder beside it."""
    for path in files:
        if path.parent == files[0].parent:
            print_line(escape(str(path)))
    counts = Counter(path.parent for path in files if path.parent != files[0].parent)
    for parent, count in counts.items():
        print_line(f"{escape(str(parent))}  {count} files")


def print_status(status: StudyStatus, json: bool) -> None:
    if json:
        print_json(status.to_dict())
        return
    counts = status.counts
    algorithms = unique(algorithm for _, algorithm in counts)
    rows = [
        {"class": name, **{each: _counts(counts[name, each]) for each in algorithms}}
        for name in unique(class_name for class_name, _ in counts)
    ]
    title = f"[bold]{status.file.versioned_name}[/] in {escape(str(status.folder))}"
    out().print(Table.of(title, rows, caption="done · + running · ! failed · / all"))
    parts = [f"{status.count(state):,} {state}" for state in STATES if status.count(state)]
    out().print(f"{plural(len(status.cells), 'cell')}: {', '.join(parts)}")
    if status.seconds_left > 0:
        here = available_cores()
        one, all_here = (duration(status.seconds_left / cores) for cores in (1, here))
        out().print(f"Time left: about {one} on one core, {all_here} on the {here} cores here")
    if status.other_results:
        out().print(f"[dim]{status.other_results:,} results in the folder belong to other plans[/]")
    for cell in status.failed[:_FAILURES_SHOWN]:
        _print_failure(status, cell)
    if len(status.failed) > _FAILURES_SHOWN:
        out().print(f"… and {len(status.failed) - _FAILURES_SHOWN} more; --json lists them all")


def _print_failure(status: StudyStatus, cell: CellStatus) -> None:
    failure = cell.failure
    assert failure is not None
    times = f" ({failure.attempts} times)" if failure.attempts > 1 else ""
    path = Ledger(status.folder).failure_path(failure.key).as_posix()
    print_line(
        f"[red]failed{times}[/] {escape(label(cell.planned))}: {escape(failure.error)}\n"
        f"  [dim]{escape(path)}[/]"
    )


def _counts(counts: Counter[State]) -> str:
    """`7 +2 !1 / 10`: done, running, failed, all."""
    others = {"+": counts["running"], "!": counts["failed"], "/ ": counts.total()}
    return " ".join([str(counts["done"]), *(f"{sign}{n}" for sign, n in others.items() if n)])


def compare(
    folder: StudyFolder,
    first: Annotated[str, typer.Argument(metavar="A", help="An algorithm of the plan, by name.")],
    second: Annotated[str, typer.Argument(metavar="B", help="The one it is compared with.")],
    metric: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            "-m",
            help="A metric of the report's levels, such as final_return. Repeatable; default "
            "wd_regret and ood_regret.",
        ),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Also write CSV, JSON, LaTeX, and figures as PNG and PDF."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Compare two algorithms of a study: the difference A − B on each class, with its interval.

    Runs are compared in pairs: those on the same instance with the same seed. A is better or worse
    (†) where the interval excludes 0 with at least 5 pairs per class; with fewer it is an
    indication, otherwise open.

    Each .tex file is a complete table with its own caption and label: \\input it outside of any
    table environment.

    Examples:

      sme study compare runs/smoke PPO TD3
      sme study compare runs/mine slow fast --metric wd_regret --out paper/slow-fast
      sme study compare runs/smoke PPO TD3 --json
    """
    from sme_registry.studies.report import write
    from sme_registry.studies.report.frames import records
    from sme_registry.studies.report.texts import comparison_caveats, comparison_tables

    differences = write.compare(folder, first, second, metric or write.DEFAULT_METRICS)
    files = [] if out_folder is None else write.write_comparison(folder, out_folder, differences)
    if json:
        print_json(records(differences))
        return
    for each in comparison_tables(differences, verdicts=True):
        out().print(Table.of(f"[bold]{escape(each.title)}[/]", each.frame.to_dict("records")))
    for sentence in comparison_caveats(Ledger(folder).study_file().plan, differences):
        print_line(escape(sentence))
    if files:
        print_line(f"{escape(str(out_folder))}  {len(files)} files")


@with_options
def sweep(folder: NewFolder, options: PlanOptions, jobs: Jobs = None) -> None:
    """Vary a field of a task, run an algorithm on each value, and draw regret against the value.

    One command for `study new --sweep`, `study run` and `study report`. Interrupt it at any time
    and run it again to continue; add values or seeds, and only the new cells run. The report is in
    FOLDER/report.

    Examples:

      sme study sweep -t Default --sweep k=1,2,5,10 -a PPO -n 20000 --seeds 5 -f runs/k
      sme study sweep -t Team4 --sweep team.reward=individual,team -a PPO --seeds 3 -f runs/reward
      sme study sweep -t Default --sweep k=1,5 --sweep D=0,0.25 -a PPO -a reference:linear -f runs/2
    """
    if not options.sweep:
        raise OptionError("--sweep: is required, such as --sweep k=1,2,5,10.")
    plan = options.plan("the options")
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name)[:64] or "sweep"
    file = StudyFile(name=name, digest=plan.digest, plan=plan)
    status = run_study(file, folder, jobs=jobs)
    _print_report(studies.write_report(folder))
    check_complete(status)


app = typer.Typer()
app.add_typer(study, name="study")
for _command in (new, plan, sweep, compare, run, status, report):
    study.command()(_command)

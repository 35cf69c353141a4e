"""`sme study sweep`: plan, run and report a sweep in one command."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from sme_registry.cli.plan_options import PlanOptions, with_options
from sme_registry.cli.study_plan import Jobs
from sme_registry.errors import OptionError
from sme_registry.io.terminal import err, out
from sme_registry.spec import StudyFile


@with_options(PlanOptions)
def sweep(
    folder: Annotated[
        Path, typer.Option("--folder", "-f", help="The study's folder; created if necessary.")
    ],
    options: PlanOptions,
    jobs: Jobs = None,
) -> None:
    """Vary a field of a task, run an algorithm on each value, and draw regret against the value.

    One command for `study new --sweep`, `study run` and `study report`. Interrupt it at any time
    and run it again to continue; add values or seeds, and only the new cells run. The report is in
    FOLDER/report.

    Examples:

      sme study sweep -t Default --sweep k=1,2,5,10 -a PPO -n 20000 --seeds 5 -f runs/k

      sme study sweep -t Team4 --sweep team.reward=individual,team -a PPO --seeds 3 -f runs/reward

      sme study sweep -t Default --sweep k=1,5 --sweep D=0,0.25 -a PPO -a reference:linear -f runs/2
    """
    from sme_registry.studies import run_study, write_report

    if not options.sweep:
        raise OptionError("--sweep: is required, such as --sweep k=1,2,5,10.")
    plan = options.plan("the options")
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name)[:64] or "sweep"
    file = StudyFile(name=name, digest=plan.digest, plan=plan)
    status = run_study(file, folder, jobs=jobs, console=err())
    for path in write_report(folder):
        if path.name == "index.html" or path.stem.startswith(
            ("regret-", "wd-regret", "ood-regret")
        ):
            out().print(escape(str(path)), soft_wrap=True)
    if status.failed:
        failed = f"{len(status.failed)} of {len(status.cells)} cells failed"
        err().print(f"[bold red]{failed}.[/] See `sme study status {escape(str(folder))}`.")
        raise typer.Exit(1)

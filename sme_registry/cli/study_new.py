"""`sme study new`: write a plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Force, find_file
from sme_registry.cli.files import check_document_path
from sme_registry.cli.plan_options import PlanOptions, with_options
from sme_registry.cli.study_plan import check_algorithms, warn_of_uneven_rollouts
from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.io import read_json
from sme_registry.io.terminal import err, out
from sme_registry.spec import StudyFile
from sme_registry.spec.resolve import is_path

_ALLOWED_WITH_FROM = ("path", "name", "description", "source", "force")


@with_options(PlanOptions)
def new(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)],
    options: PlanOptions,
    name: Annotated[str | None, typer.Option(help="Default --from's, or the file's.")] = None,
    description: Annotated[str | None, typer.Option(help="One or two sentences.")] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="PLAN",
            help="Instead of these options: an edited plan file, whose digest may be outdated or "
            "missing, or the name of a plan to copy.",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a plan: which algorithms run on which tasks, how often, and for how long.

    A plan is a file that a colleague can run. Reference policies learn nothing and take no steps.
    In a stream an algorithm lives once, for the steps of the stream, and a fresh agent trains on
    each phase alone.
    Settings without an option are edited in the file. Editing changes the digest, so the file is
    rejected until --from rewrites it.

    Examples:

      sme study new mine.json --suite smoke -a PPO -a TD3 -a reference:linear --seeds 5 -n 20000

      sme study new deep.json -t Default -t Complexity10 -a TQC=sb3_contrib:TQC -n 10000

      sme study new ranges.json -t Default -a PPO --action-range symmetric --action-range unit

      sme study new intervals.json -t Default --sweep k=1,2,5,10 -a PPO --seeds 5 -n 20000

      sme study new two.json --suite smoke -a PPO -a slow=PPO --set slow.learning_rate=0.0001

      sme study new teams.json --suite teams -a PPO -a independent:PPO --seeds 3 -n 20000

      sme study new lives.json -t Switch5 -t Related5 -a PPO --seeds 3 --instances 3

      sme study new wider.json --from edited.json
    """
    check_document_path(path, force=force)
    about = {"name": name, "description": description}
    about = {field: text for field, text in about.items() if text is not None}
    default_name = {"name": path.stem}
    if source is None:
        data = {"plan": options.plan(str(path)).to_dict()}
        file = StudyFile.with_digest(data, str(path), **default_name | about)
    else:
        _refuse_other_options(context)
        data = read_json(source) if is_path(source) else find_file(StudyFile, source).to_dict()
        named = isinstance(data, dict) and "name" in data
        file = StudyFile.with_digest(data, source, **({} if named else default_name) | about)
    # A package that is not installed here may be installed where the plan runs.
    check_algorithms(file.plan.algorithms, MissingDependencyError)
    warn_of_uneven_rollouts(file.plan)
    file.write(path)
    out().print(f"{escape(str(path))}  {file.digest}", soft_wrap=True)
    err().print(f"[dim]To see its runs and times: sme study plan {escape(str(path))}[/]")


def _refuse_other_options(context: typer.Context) -> None:
    """Check that no option is given that the plan of --from already sets."""
    for option in context.params:
        origin = context.get_parameter_source(option)
        # By name: newer versions of Typer include their own Click.
        if option not in _ALLOWED_WITH_FROM and origin is not None and origin.name == "COMMANDLINE":
            raise OptionError(
                f"--{option.replace('_', '-')}: the plan of --from already sets it. Change it in "
                "that file, or leave out --from."
            )

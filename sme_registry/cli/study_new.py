"""`sme study new`: write a plan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry import load
from sme_registry.cli.arguments import Force, Protocol, find_file
from sme_registry.cli.files import check_document_path
from sme_registry.cli.study_plan import scaled_plan, warn_of_unavailable
from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.io import read_json
from sme_registry.spec import StudyFile, StudyPlan, SuiteFile, catalogue
from sme_registry.spec.resolve import is_path
from sme_registry.terminal import err, out

_ALLOWED_WITH_FROM = ("path", "name", "description", "source", "force")


def new(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)],
    suite: Annotated[str | None, typer.Option(help="A suite of classes: name or path.")] = None,
    task: Annotated[
        list[str] | None,
        typer.Option("--task", "-t", help="A task as a class of its own. Repeatable."),
    ] = None,
    algorithm: Annotated[
        list[str] | None,
        typer.Option(
            "--algorithm",
            "-a",
            metavar="[NAME=]USES",
            help="PPO, TD3, SAC, … of Stable-Baselines3, module:function, reference:linear, "
            "reference:constant, offline:bc, … Repeatable.",
        ),
    ] = None,
    steps: Annotated[
        list[str] | None,
        typer.Option("--steps", "-n", metavar="N|ALGORITHM=N", help="Of each run. Repeatable."),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Runs of each algorithm on each class.")] = 10,
    evaluations: Annotated[int, typer.Option(help="Evaluations during each training.")] = 100,
    evaluation_episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.")] = 5,
    action_range: Annotated[
        list[str] | None,
        typer.Option(help="symmetric or unit. Repeatable: each algorithm with each range."),
    ] = None,
    protocol: Protocol = "paper-v1",
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
    Settings without an option, such as hyperparameters, are edited in the file. Editing changes the
    digest, so the file is rejected until --from rewrites it.

    Examples:

      sme study new mine.json --suite smoke -a PPO -a TD3 -a reference:linear --seeds 5 -n 20000

      sme study new deep.json -t Default -t Complexity10 -a TQC=sb3_contrib:TQC -n 10000

      sme study new ranges.json -t Default -a PPO --action-range symmetric --action-range unit

      sme study new wider.json --from edited.json
    """
    from sme_registry.evaluation import resolve_protocol

    check_document_path(path, force=force)
    about = {"name": name, "description": description}
    about = {field: text for field, text in about.items() if text is not None}
    default_name = {"name": path.stem}
    if source is None:
        fields = {
            "classes": _classes(suite, task or ()),
            "algorithms": _algorithms(algorithm or (), action_range or ["symmetric"]),
            "seeds": seeds,
            "evaluations": evaluations,
            "evaluation_episodes": evaluation_episodes,
            "protocol": resolve_protocol(protocol).to_dict(),
        }
        plan = StudyPlan.from_dict(fields, str(path))
        draft = StudyFile(name="draft", digest=plan.digest, plan=plan)
        data = scaled_plan(draft, steps, None, None).plan.to_dict()
        file = StudyFile.with_digest(data, str(path), **default_name | about)
    else:
        _refuse_other_options(context)
        data = read_json(source) if is_path(source) else find_file(StudyFile, source).to_dict()
        named = isinstance(data, dict) and "name" in data
        file = StudyFile.with_digest(data, source, **({} if named else default_name) | about)
    # A package that is not installed here may be installed where the plan runs.
    uses = (algorithm.uses for algorithm in file.plan.algorithms)
    warn_of_unavailable(uses, MissingDependencyError)
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


def _classes(suite: str | None, tasks: Sequence[str]) -> list[dict[str, Any]]:
    """The classes of a suite, and one for each task."""
    classes = []
    if suite is not None:
        members = find_file(SuiteFile, suite).suite.classes
        classes += [member.to_dict() for member in members]
    for task in tasks:
        spec = load(task)
        setting = spec.to_dict()
        seed = setting.pop("seed")
        title = catalogue.title(spec).rsplit("/", 1)[-1].removesuffix("-v1")
        name = title.replace(" (", "-").removesuffix(")")  # as a document's name
        classes.append({"name": name, "setting": setting, "seeds": [seed]})
    if not classes:
        raise OptionError("Give --suite or --task, such as --suite smoke or --task Default.")
    return classes


def _algorithms(texts: Sequence[str], ranges: Sequence[str]) -> list[dict[str, Any]]:
    """Each `[NAME=]USES` with each action range."""
    if not texts:
        raise OptionError("--algorithm: is required, such as --algorithm PPO.")
    algorithms = []
    for text in texts:
        name, equals, uses = text.partition("=")
        if not equals:
            name, uses = text.rsplit(":", 1)[-1], text
        for action_range in ranges:
            fields: dict[str, Any] = {
                "name": f"{name} ({action_range})" if len(ranges) > 1 else name,
                "uses": uses,
                "action_range": action_range,
            }
            if uses.startswith("reference:"):
                fields["steps"] = 0
            algorithms.append(fields)
    return algorithms

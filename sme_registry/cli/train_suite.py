"""`sme train --suite`: train one algorithm on every instance of a suite, as a study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import find_file
from sme_registry.errors import OptionError
from sme_registry.io import integer_in
from sme_registry.io.terminal import err
from sme_registry.spec import StudyFile, StudyPlan, Suite, SuiteFile

RUNS = 10
"""Runs on each class by default: those that a leaderboard requires for a rank."""

_EVALUATIONS = 10  # of a run, for the learning curves of `sme study report`
_NOT_WITH_SUITE = ("task", "seed", "num_envs", "checkpoint_every", "resume", "force")


def train_suite(
    context: typer.Context,
    suite: str,
    *,
    algorithm: str | None,
    agents: str | None,
    device: str | None,
    steps: int,
    seeds: int | None,
    folder: Path | None,
    action_range: str,
    independent: bool,
    protocol: str,
    hyperparameters: dict[str, Any],
    jobs: int | None,
    json: bool,
) -> None:
    """Train on every instance of a suite and keep the models; the same call continues.

    Args:
      context: of the command, to refuse its options for a single task.
      suite: name or path of the suite.
      algorithm: as in `sme train`; None for the default of the suite's first task.
      agents: as in `sme train`.
      device: of agents in JAX.
      steps: of each run.
      seeds: runs on each class; None for `RUNS`, rounded up so that all instances of a class have
        equally many.
      folder: of the study; None for runs/SUITE-ALGORITHM.
      action_range: "symmetric" or "unit".
      independent: one model for each agent of a team.
      protocol: name or path of the protocol of the evaluation after each run.
      hyperparameters: where they differ from the algorithm's defaults.
      jobs: runs at once; None for one per core.
      json: print JSON.

    Raises:
      OptionError: an option is for a single task, or invalid.
      Exit: a run failed; the exit code is 1.
    """
    from sme_registry import training
    from sme_registry.cli.study import print_status
    from sme_registry.cli.study_plan import warn_of_uneven_rollouts
    from sme_registry.evaluation import resolve_protocol
    from sme_registry.spec.study import INDEPENDENT
    from sme_registry.studies.engine.runner import run_study

    _refuse_options(context, _NOT_WITH_SUITE, "is for a single task. Leave it out, or --suite")
    file = find_file(SuiteFile, suite)
    members = file.suite
    if not members.classes:
        _refuse_options(context, ("steps",), "is that of each stream here. Leave it out")
    first = members.classes[0].instances[0] if members.classes else members.streams[0].stream
    algorithm = algorithm or training.default_algorithm(first)
    uses = training.full_name(algorithm, agents)
    name = training.short_name(uses)
    if folder is None:
        label = training.folder_name(uses)
        folder = Path("runs") / f"{file.name}-{'independent-' * independent}{label}"
    plan = StudyPlan.from_dict(
        {
            **{
                name: [member.to_dict() for member in kind]
                for name, kind in (("classes", members.classes), ("streams", members.streams))
                if kind
            },
            "algorithms": [
                {
                    "name": name,
                    "uses": f"{INDEPENDENT}{uses}" if independent else uses,
                    "hyperparameters": hyperparameters,
                    "action_range": action_range,
                }
            ],
            "seeds": equal_runs(members) if seeds is None else integer_in("seeds", seeds, 1),
            "steps": steps,
            "evaluations": _EVALUATIONS,
            "protocol": resolve_protocol(protocol).to_dict(),
        },
        "options",
    )
    warn_of_uneven_rollouts(plan)
    study = StudyFile(name=file.name, digest=plan.digest, plan=plan)
    status = run_study(study, folder, jobs=jobs, keep_models=True, device=device, console=err())
    print_status(status, json)
    if status.failed:
        raise typer.Exit(1)
    if not json:
        err().print(f"[dim]{escape(_next_step(suite, members, plan, folder))}[/]", soft_wrap=True)


def _next_step(name: str, suite: Suite, plan: StudyPlan, folder: Path) -> str:
    """What to do with the models of a suite."""
    if suite.streams:
        return f"To see what the agents retain: sme study report {folder}"
    instances = max(suite.runs.values())
    if plan.seeds < instances:
        return f"A leaderboard needs a run on every instance: use --seeds {instances} or more."
    return f"To submit them: sme-leaderboard new BUNDLE --suite {name} --runs {folder}"


def equal_runs(suite: Suite) -> int:
    """At least `RUNS` on each class, and equally many on each instance of the largest class."""
    return max(-(-RUNS // instances) * instances for instances in suite.runs.values())


def refuse_without_suite(context: typer.Context) -> None:
    """Check that no option is given that only --suite has.

    Raises:
      OptionError: there is one.
    """
    _refuse_options(context, ("seeds", "jobs"), "is for --suite. Add --suite, or leave it out")


def refuse_fields(fields: dict[str, Any]) -> None:
    """Check that no option changes a field of the suite's tasks.

    Raises:
      OptionError: one does.
    """
    for name in fields:
        raise OptionError(
            f"--set {name}: is a field of the task, and the suite sets it. Write another suite "
            f"with `sme suite new`, for example from `sme new task.json --set {name}=…`."
        )


def _refuse_options(context: typer.Context, names: tuple[str, ...], problem: str) -> None:
    for name in names:
        origin = context.get_parameter_source(name)
        # By name: newer versions of Typer include their own Click.
        if origin is not None and origin.name == "COMMANDLINE":
            option = "TASK" if name == "task" else f"--{name.replace('_', '-')}"
            raise OptionError(f"{option}: {problem}.")

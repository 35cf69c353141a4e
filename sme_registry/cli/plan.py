"""The plan of a study: its options, its table, and `sme study plan` and `new`."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import (
    Force,
    Json,
    NewFile,
    Protocol,
    assignments,
    changes,
    check_document_path,
    only_with,
    unique,
    with_options,
)
from sme_registry.cli.task import ClassOptions
from sme_registry.errors import MissingDependencyError, OptionError, SMEError
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io import read_json
from sme_registry.io.markup import Table, plural
from sme_registry.io.system import available_cores
from sme_registry.io.terminal import (
    count,
    duration,
    duration_range,
    err,
    out,
    print_json,
    print_line,
    print_note,
)
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan, catalogue
from sme_registry.spec.catalogue import is_path
from sme_registry.spec.study import PlannedCell
from sme_registry.studies.budget import (
    Estimator,
    in_implementation,
    scaled,
    selected,
    uneven_rollouts,
    with_sources,
)
from sme_registry.studies.ledger import Ledger
from sme_registry.training.algorithms import (
    AGENTS,
    BACKENDS,
    check_algorithms,
    folder_name,
    nested_hyperparameters,
    parse_uses,
)

_EVERY = "*"  # algorithm
Agents = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(AGENTS),
        help="The implementation that is trained: "
        f"{', or '.join(f'{kind}, of {BACKENDS[kind].title}' for kind in AGENTS)}. Default the one "
        "that the algorithm names.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Budgets:
    """Options that make another plan of a plan: other budgets, other implementations."""

    steps: Annotated[
        list[str] | None,
        typer.Option(
            "--steps",
            "-n",
            metavar="N|ALGORITHM=N",
            help="Steps of each training, or of one algorithm's. Repeatable.",
        ),
    ] = None
    seeds: Annotated[
        int | None,
        typer.Option(
            help="Runs of each algorithm on each class. Default the plan's, of a new plan 10."
        ),
    ] = None
    evaluations: Annotated[
        int | None,
        typer.Option(
            help="Evaluations during each training. Default the plan's, of a new plan 100."
        ),
    ] = None
    agents: Agents = None

    def scaled(self, file: StudyFile) -> StudyFile:
        texts = [text if "=" in text else f"{_EVERY}={text}" for text in self.steps or ()]
        steps: dict[str, int] = {}
        for name, number in assignments("--steps", texts, "PPO=100000").items():
            try:
                steps[name] = count(number)
            except typer.BadParameter:
                raise OptionError(
                    f"--steps {number!r}: must be N or ALGORITHM=N, such as --steps PPO=1e5."
                ) from None
        every = steps.pop(_EVERY, None)
        counts = {"seeds": self.seeds, "evaluations": self.evaluations}
        file = scaled(file, steps=every, steps_of=steps, **counts)
        return file if self.agents is None else in_implementation(file, self.agents)


@dataclass(frozen=True, kw_only=True)
class PlanOptions(Budgets, ClassOptions):
    algorithm: Annotated[
        list[str] | None,
        typer.Option(
            "--algorithm",
            "-a",
            metavar="[NAME=]USES",
            help="PPO, TD3, SAC, … of Stable-Baselines3, jax:PPO, module:function, "
            "train:mine:train, reference:linear, offline:bc, … Repeatable.",
        ),
    ] = None
    evaluation_episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.")] = 5
    action_range: Annotated[
        list[str] | None,
        typer.Option(help="symmetric or unit. Repeatable: each algorithm with each range."),
    ] = None
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="ALGORITHM.NAME=VALUE",
            help="A hyperparameter of an algorithm, such as slow.n_steps=64. Repeatable.",
        ),
    ] = None
    protocol: Protocol = "paper-v1"

    def plan(self, source: str) -> StudyPlan:
        """The plan that the options describe; errors name `source`."""
        members = self.members()
        fields = {
            **members,
            "algorithms": self._algorithms(on_tasks=bool(members["classes"])),
            "evaluations": 100,
            "evaluation_episodes": self.evaluation_episodes,
            "protocol": resolve_protocol(self.protocol).to_dict(),
        }
        plan = StudyPlan.from_dict(fields, source)
        plan = self.scaled(StudyFile(name="draft", digest=plan.digest, plan=plan)).plan
        _check_different(plan.algorithms)
        return plan

    def _algorithms(self, *, on_tasks: bool) -> list[dict[str, Any]]:
        """Each `[NAME=]USES` with each action range."""
        if not self.algorithm:
            raise OptionError("--algorithm: is required, such as --algorithm PPO.")
        ranges = self.action_range or ["symmetric"]
        uses_of: list[tuple[str, str]] = []
        for text in self.algorithm:
            name, equals, uses = text.partition("=")
            uses_of.append((name, uses) if equals else (_short_name(text), text))
        settings = _hyperparameters(self.set_, [name for name, _ in uses_of])
        return [
            {
                "name": f"{name} ({action_range})" if len(ranges) > 1 else name,
                "uses": uses,
                "hyperparameters": nested_hyperparameters(settings.get(name, {})),
                "action_range": action_range,
                **({"steps": 0} if on_tasks and parse_uses(uses)[0] == "reference" else {}),
            }
            for name, uses in uses_of
            for action_range in ranges
        ]


def _check_different(algorithms: Iterable[StudyAlgorithm]) -> None:
    for first, second in itertools.combinations(algorithms, 2):
        if first.model_copy(update={"name": second.name}) == second:
            raise OptionError(
                f"--algorithm {second.name}: is {first.name} under another name: all differences "
                f"would be 0. Change a hyperparameter, such as --set "
                f"{second.name}.learning_rate=0.001, or leave one of the two out."
            )


def _short_name(uses: str) -> str:
    """The name of an algorithm in a plan: `TQC`, `linear`, `jax-PPO`, `independent PPO`."""
    kind, name = parse_uses(uses)
    if kind == "independent":
        return f"independent {_short_name(name)}"
    return folder_name(uses)


def _hyperparameters(
    texts: list[str] | None, algorithms: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """The hyperparameters of each algorithm, from `ALGORITHM.NAME=VALUE`; flat, by dotted names."""
    values: dict[str, dict[str, Any]] = {}
    for path, value in changes(texts).items():
        owners = [name for name in algorithms if path.startswith(f"{name}.")]
        if not owners:
            raise OptionError(
                f"--set {path!r}: must be ALGORITHM.NAME=VALUE with an algorithm of the plan "
                f"({', '.join(algorithms)}), such as {algorithms[0]}.learning_rate=0.001."
            )
        owner = max(owners, key=len)
        values.setdefault(owner, {})[path.removeprefix(f"{owner}.")] = value
    return values


PlanName = Annotated[
    str,
    typer.Argument(
        metavar="PLAN",
        help="A name from `sme list --kind study`, or a path.",
        autocompletion=catalogue.completion(StudyFile),
    ),
]
Only = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND=GLOB",
        help="Only cells that match class=GLOB, algorithm=GLOB or run=GLOB (from 0). Repeatable: "
        "a cell must match one pattern of each kind given.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, help="Cells at once; default one per core.")
]


@with_options
def plan(
    options: Budgets,
    plan: PlanName,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", "-f", help="Use and count the results in this study's folder."),
    ] = None,
    cores: Annotated[
        int | None, typer.Option(min=1, help="Also estimate for a cluster with this many cores.")
    ] = None,
    jobs: Jobs = None,
    only: Only = None,
    json: Json = False,
) -> None:
    """Show what a study runs and how long it takes, before anything runs.

    Times come from finished cells of the same algorithm in --folder. Without any, they are those
    of a fast core.

    Examples:

      sme study plan paper-ablations --cores 64
      sme study plan paper-ablations --steps 20000 --seeds 3 --only algorithm=PPO --only "class=k-*"
      sme study plan smoke --folder runs/smoke --json
    """
    file = with_sources(options.scaled(catalogue.find(StudyFile, plan)))
    planned = selected(file.plan.cells, only or ())
    cells = {cell.cell.digest: cell.cell for cell in planned}
    if folder is not None:
        Ledger(folder).study_file()  # or there is no study
    results = {} if folder is None else Ledger(folder).results()
    _warn(file.plan, planned, SMEError)
    estimator = Estimator(results.values())
    waiting = [cell for key, cell in cells.items() if key not in results]
    of_cells = [estimator.seconds(cell) for cell in waiting]

    def seconds(workers: int) -> float:
        return max([sum(of_cells) / workers, *of_cells])

    here = jobs or available_cores()
    workers = {"one core": 1, f"this machine, {here} at once": here}
    if cores is not None:
        workers[f"a cluster, {cores} cores"] = cores
    done = len(cells) - len(waiting)
    measured = {cell.uses for cell in waiting} & {r.cell.uses for r in results.values()}
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
                    {"cores": n, "seconds": seconds(n)} for n in dict.fromkeys(workers.values())
                ],
            }
        )
        return
    out().print(_plan_table(file, planned, estimator.seconds))
    finished = f", {done:,} of them finished" if results else ""
    out().print(f"{plural(len(cells), 'cell')}{finished}. Estimated time:")
    for place, n in workers.items():
        out().print(f"  {place + ':':32}about {duration(seconds(n))}")
    unmeasured = sorted({cell.uses for cell in waiting} - measured)
    if unmeasured:
        listed = escape(", ".join(unmeasured))
        print_line(
            f"[dim]From a table of costs, not from results: {listed}. A slow core takes twice as "
            "long.[/]"
        )


def _plan_table(file: StudyFile, planned: Sequence[PlannedCell], seconds: Any) -> Table:
    rows = []
    for name in unique(cell.algorithm for cell in planned):
        places = [place for place in planned if place.algorithm == name]
        cells = [*{place.cell.digest: place.cell for place in places}.values()]
        steps = sorted({cell.steps for cell in cells})
        times = [seconds(cell) for cell in cells]
        row = {
            "algorithm": name,
            "classes": len({place.class_name for place in places}),
            "runs each": len({place.run for place in places}),
            "steps": " to ".join(f"{bound:,}" for bound in unique([steps[0], steps[-1]])),
            "evaluations": f"{cells[0].evaluations:,} × {cells[0].evaluation_episodes}",
            "cells": len(cells),
            "time per run": duration_range(min(times), max(times)),
        }
        rows.append(row)
    classes = unique(cell.class_name for cell in planned)
    listed = f"{plural(len(classes), 'class', 'classes')}: {', '.join(classes)}"
    caption = f"{file.digest}\n{escape(listed)}"
    title = f"[bold]{file.versioned_name}[/]  {escape(file.description)}"
    return Table.of(title, rows, caption=caption)


def _warn(plan: StudyPlan, planned: Sequence[PlannedCell], errors: type[SMEError]) -> None:
    """Warn of algorithms that raise such an error here, and of uneven rollouts."""
    messages = check_algorithms(plan, planned, lambda text: print_note(escape(text)), errors)
    for message in unique(messages):  # several algorithms may lack the same package
        print_note(f"[yellow]cannot run here:[/] {escape(message)}")
    warn_of_uneven_rollouts(plan)


def warn_of_uneven_rollouts(plan: StudyPlan) -> None:
    for warning in uneven_rollouts(plan):
        print_note(f"[yellow]uneven rollouts:[/] {escape(warning)}")


_ALLOWED_WITH_FROM = ("path", "name", "description", "source", "force")


@with_options
def new(
    context: typer.Context,
    path: NewFile,
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

    A plan is a file that a colleague can run. Settings without an option are edited in the file.
    Editing changes the digest, so the file is rejected until --from rewrites it. In a stream an
    algorithm lives once, and a fresh agent trains on each phase alone.

    Examples:

      sme study new mine.json --suite smoke -a PPO -a TD3 -a reference:linear
      sme study new deep.json -t Default -t Complexity10 -a TQC=sb3_contrib:TQC
      sme study new intervals.json -t Default --sweep k=1,2,5,10 -a PPO --seeds 5
      sme study new two.json --suite smoke -a slow=PPO --set slow.n_steps=64
      sme study new lives.json -t Switch5 -t Related5 -a PPO --instances 3
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
        others = [option for option in context.params if option not in _ALLOWED_WITH_FROM]
        reason = "the plan of --from already sets it. Change it in that file, or leave out --from"
        only_with(context, others, reason)
        data = read_json(source) if is_path(source) else catalogue.find(StudyFile, source).to_dict()
        named = isinstance(data, dict) and "name" in data
        file = StudyFile.with_digest(data, source, **({} if named else default_name) | about)
    # A package that is not installed here may be installed where the plan runs.
    _warn(file.plan, file.plan.cells, MissingDependencyError)
    file.write(path)
    print_line(f"{escape(str(path))}  {file.digest}")
    err().print(f"[dim]To see its runs and times: sme study plan {escape(str(path))}[/]")

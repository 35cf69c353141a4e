"""The options that describe classes of tasks and plans, shared by the commands that make them."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from sme_registry.cli.arguments import Protocol, find_file, json_or_text
from sme_registry.cli.study_plan import Agents, scaled_plan
from sme_registry.errors import OptionError, SMEError
from sme_registry.io import integer_in, parse_json
from sme_registry.spec import (
    Document,
    EnvFile,
    SMESpec,
    StreamClass,
    StreamFile,
    StreamSpec,
    StudyFile,
    StudyPlan,
    SuiteClass,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.study import INDEPENDENT
from sme_registry.spec.sweep import sweep
from sme_registry.task import load_document


@dataclass(frozen=True, kw_only=True)
class ClassOptions:
    """Options of a command that describe classes of tasks and streams, each with its help."""

    suite: Annotated[
        str | None,
        typer.Option(
            help="A suite of classes: name or path.", autocompletion=catalogue.completion(SuiteFile)
        ),
    ] = None
    task: Annotated[
        list[str] | None,
        typer.Option(
            "--task",
            "-t",
            help="A task, or a stream, as a class of its own. Repeatable.",
            autocompletion=catalogue.completion(EnvFile, StreamFile),
        ),
    ] = None
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=VALUE,…",
            help="Vary a field of the --task, such as k=1,2,5 or D=0,0.25: a "
            "class for each value. Repeatable: each sweep is an axis of its own around the task, "
            "not a cross product.",
        ),
    ] = None
    instances: Annotated[
        int,
        typer.Option(
            help="Draws of each --task: its seed and those that follow; of a stream, other tasks "
            "for all of its phases."
        ),
    ] = 1

    def members(self) -> dict[str, list[dict[str, Any]]]:
        """The classes of a suite, one for each task or stream, or those of the sweeps.

        Returns:
          The fields `classes` and `streams` of a suite or a plan; no field that is empty.
        """
        tasks = self.task or ()
        if self.sweep and (self.suite is not None or len(tasks) != 1):
            raise OptionError("--sweep: needs exactly one --task, and no --suite.")
        if self.suite is None and not tasks:
            raise OptionError("Give --suite or --task, such as --suite smoke or --task Default.")
        instances = integer_in("instances", self.instances, 1, 10_000)
        axes = sweep_axes(self.sweep or ())
        classes: list[SuiteClass] = []
        streams: list[StreamClass] = []
        if self.suite is not None:
            suite = find_file(SuiteFile, self.suite).suite
            classes, streams = [*suite.classes], [*suite.streams]
        for task in tasks:
            document = load_document(task)
            if isinstance(document, SMESpec):
                classes += sweep(document, axes, name=_title(document), instances=instances)
                continue
            if axes:
                raise OptionError(
                    f"--sweep: varies a field of a task, and {task!r} is a stream. Make a stream "
                    "for each value."
                )
            draws = tuple(range(instances))
            streams.append(StreamClass(name=_title(document), stream=document, draws=draws))
        kinds: dict[str, Sequence[Document]] = {"classes": classes, "streams": streams}
        return {name: [each.to_dict() for each in some] for name, some in kinds.items() if some}


@dataclass(frozen=True, kw_only=True)
class PlanOptions(ClassOptions):
    """Options of a command that describe a plan, each with its help."""

    algorithm: Annotated[
        list[str] | None,
        typer.Option(
            "--algorithm",
            "-a",
            metavar="[NAME=]USES",
            help="PPO, TD3, SAC, … of Stable-Baselines3, jax:PPO, module:function, "
            "reference:linear, reference:constant, offline:bc, … Repeatable.",
        ),
    ] = None
    steps: Annotated[
        list[str] | None,
        typer.Option("--steps", "-n", metavar="N|ALGORITHM=N", help="Of each run. Repeatable."),
    ] = None
    seeds: Annotated[int, typer.Option(help="Runs of each algorithm on each class.")] = 10
    evaluations: Annotated[int, typer.Option(help="Evaluations during each training.")] = 100
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
    agents: Agents = None
    protocol: Protocol = "paper-v1"

    def plan(self, source: str) -> StudyPlan:
        """The plan that the options describe; errors name `source`."""
        from sme_registry.evaluation import resolve_protocol

        fields = {
            **self.members(),
            "algorithms": self._algorithms(),
            "seeds": self.seeds,
            "evaluations": self.evaluations,
            "evaluation_episodes": self.evaluation_episodes,
            "protocol": resolve_protocol(self.protocol).to_dict(),
        }
        plan = StudyPlan.from_dict(fields, source)
        draft = StudyFile(name="draft", digest=plan.digest, plan=plan)
        return scaled_plan(draft, self.steps, None, None, self.agents).plan

    def _algorithms(self) -> list[dict[str, Any]]:
        """Each `[NAME=]USES` with each action range."""
        if not self.algorithm:
            raise OptionError("--algorithm: is required, such as --algorithm PPO.")
        from sme_registry.training.hyperparameters import nested_hyperparameters

        ranges = self.action_range or ["symmetric"]
        uses_of: list[tuple[str, str]] = []
        for text in self.algorithm:
            name, equals, uses = text.partition("=")
            uses_of.append((name, uses) if equals else (_short_name(text), text))
        settings = _hyperparameters(self.set_ or (), [name for name, _ in uses_of])
        return [
            {
                "name": f"{name} ({action_range})" if len(ranges) > 1 else name,
                "uses": uses,
                "hyperparameters": nested_hyperparameters(settings.get(name, {})),
                "action_range": action_range,
                **({"steps": 0} if uses.startswith("reference:") else {}),
            }
            for name, uses in uses_of
            for action_range in ranges
        ]


def sweep_axes(texts: typing.Iterable[str]) -> dict[str, list[Any]]:
    """The axes of `FIELD=VALUE,…`: values are JSON, or else text, separated by commas."""
    axes: dict[str, list[Any]] = {}
    for text in texts:
        field, equals, values = text.partition("=")
        field = field.strip()
        if not equals or not field or not values.strip():
            raise OptionError(f"--sweep {text!r}: must be FIELD=VALUE,…, such as k=1,2,5,10.")
        if field in axes:
            raise OptionError(f"--sweep {text!r}: {field} is swept twice. Join their values.")
        try:
            axes[field] = parse_json(f"[{values}]")
        except SMEError:
            axes[field] = [json_or_text(value.strip()) for value in values.split(",")]
    return axes


def with_options(options: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the fields of a dataclass as options; it receives them as `options`."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = typing.get_type_hints(command, include_extras=True)
        types = typing.get_type_hints(options, include_extras=True)
        fields = [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=types[field.name],
            )
            for field in dataclasses.fields(options)
        ]
        parameters: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command).parameters.items():
            if name == "options":
                parameters += fields
            else:
                kind = inspect.Parameter.KEYWORD_ONLY
                parameters.append(parameter.replace(annotation=hints[name], kind=kind))

        @functools.wraps(command)
        def with_fields(**values: Any) -> None:
            chosen = {field.name: values.pop(field.name) for field in fields}
            command(options=options(**chosen), **values)

        with_fields.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_fields.__annotations__ = {each.name: each.annotation for each in parameters}
        return with_fields

    return decorate


def _short_name(uses: str) -> str:
    """The name of an algorithm in a plan: `TQC`, `linear`, `jax-PPO`, `independent PPO`."""
    from sme_registry.training.algorithms import folder_name

    if uses.startswith(INDEPENDENT):
        return f"independent {_short_name(uses.removeprefix(INDEPENDENT))}"
    return folder_name(uses)


def _hyperparameters(
    pairs: typing.Iterable[str], algorithms: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """The hyperparameters of each algorithm, from `ALGORITHM.NAME=VALUE`; flat, by dotted names."""
    values: dict[str, dict[str, Any]] = {}
    for pair in pairs:
        path, equals, text = pair.partition("=")
        owners = [name for name in algorithms if path.startswith(f"{name}.")]
        if not equals or not owners:
            raise OptionError(
                f"--set {pair!r}: must be ALGORITHM.NAME=VALUE with an algorithm of the plan "
                f"({', '.join(algorithms)}), such as {algorithms[0]}.learning_rate=0.001."
            )
        owner = max(owners, key=len)
        name = path.removeprefix(f"{owner}.").strip()
        if name in values.setdefault(owner, {}):
            raise OptionError(f"--set {pair!r}: {path} is set twice. Remove one.")
        values[owner][name] = json_or_text(text.strip())
    return values


def _title(document: SMESpec | StreamSpec) -> str:
    """The name of a task's or a stream's class: its title, as a document's name."""
    title = catalogue.title(document).rsplit("/", 1)[-1].removesuffix("-v1")
    return title.replace(" (", "-").removesuffix(")")

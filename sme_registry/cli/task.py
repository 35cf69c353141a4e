"""`sme new` and `check`: files of tasks and suites, and what they draw."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from rich.markup import escape

from sme_registry import save
from sme_registry.cli.arguments import (
    KINDS,
    Force,
    Json,
    NewFile,
    assignments,
    check_document_path,
    find_any,
    json_or_text,
    kind_of,
    only_with,
    print_checks,
    with_options,
)
from sme_registry.errors import OptionError, SMEError
from sme_registry.io import integer_in, parse_json
from sme_registry.io.markup import plural
from sme_registry.io.terminal import out, print_line, print_note
from sme_registry.spec import (
    EnvFile,
    SMESpec,
    StreamClass,
    StreamFile,
    StreamSpec,
    StudyFile,
    Suite,
    SuiteClass,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.catalogue import is_path
from sme_registry.spec.files import Envelope
from sme_registry.spec.study import sweep
from sme_registry.task import load
from sme_registry.task.certificate import MARKS, Certificate, certify, short
from sme_registry.task.loading import materialize_segments

app = typer.Typer()

_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", type(None): "JSON"}
_FORMS = {  # what a value looks like, where the field's description does not say it
    "policy_init": "'semi_orthogonal' or 'unit_variance'; ",
    "safety": "'{\"tightness\": 0.2}'; ",
    "observation": '\'{"distractors": 32, "dynamics": "driven", "mixing": "nonlinear", '
    '"mixing_depth": 1}\', where dynamics is noise, autonomous or driven, and mixing none, '
    "orthogonal or nonlinear; ",
    "team": '\'{"agents": [{"action_dim": 2, "observes": [0, 1]}, {"action_dim": 2}], "reward": '
    '"team"}\', where reward is individual or team; ',
    "seed": "an integer, or hexadecimal 0x… for a sealed task; ",
}


def _field_option(name: str, field: FieldInfo) -> tuple[str, Any, Any]:
    """The option of a field, whose text `json_or_text` reads and the spec itself checks."""
    default = "none" if field.default is None else field.default
    meaning = (field.description or "").rstrip(".")
    option = typer.Option(
        f"--{name.replace('_', '-')}",
        metavar=_METAVARS[type(field.default)],
        help=f"{meaning[0].upper()}{meaning[1:]}; {_FORMS.get(name, '')}default {default}.",
    )
    return name, Annotated[str | None, option], dataclasses.field(default=None)


_FIRST = ("complexity", "k", "r_min", "D", "state_dim", "action_dim", "seed")  # in the help
FieldOptions = dataclasses.make_dataclass(
    "FieldOptions",
    [
        _field_option(name, SMESpec.model_fields[name])
        for name in dict.fromkeys([*_FIRST, *SMESpec.model_fields])
        if name != "schema_version"
    ],
    frozen=True,
    kw_only=True,
)
"""An option for each field of a spec."""


@dataclass(frozen=True, kw_only=True)
class ClassOptions:
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
            help="Vary a field of the --task, such as k=1,2,5: a class for each value. Repeatable: "
            "each is an axis of its own, not a cross product.",
        ),
    ] = None
    instances: Annotated[
        int,
        typer.Option(
            help="Draws of each --task: its seed and those that follow; of a stream, other tasks "
            "for all of its phases.",
        ),
    ] = 1

    def members(self) -> dict[str, Any]:
        """The classes of a suite, one for each task or stream, or those of the sweeps."""
        instances = integer_in("instances", self.instances, 1, 10_000)
        documents = [load(task) for task in self.task or ()]
        axes = sweep_axes(self.sweep)
        if axes and (self.suite is not None or len(documents) != 1):
            raise OptionError("--sweep: needs exactly one --task, and no --suite.")
        if self.suite is None and not documents:
            raise OptionError("Give --suite or --task, such as --suite smoke or --task Default.")
        if instances > 1 and not documents:
            raise OptionError(f"instances={instances}: is for --task. Leave it out with --suite.")
        classes: list[SuiteClass] = []
        streams: list[StreamClass] = []
        if self.suite is not None:
            suite = catalogue.find(SuiteFile, self.suite).suite
            classes, streams = [*suite.classes], [*suite.streams]
        for document in documents:
            name = _class_name(document)
            if isinstance(document, SMESpec):
                classes += sweep(document, axes, name=name, instances=instances)
            elif axes:
                raise OptionError(
                    f"--sweep: varies a field of a task, and {name!r} is a stream. Make a stream "
                    "for each value."
                )
            else:
                draws = tuple(range(instances))
                streams.append(StreamClass(name=name, stream=document, draws=draws))
        return {"classes": classes, "streams": streams}


def sweep_axes(texts: Iterable[str] | None) -> dict[str, list[Any]]:
    """The axes of `FIELD=VALUE,…`: values are JSON, or else text, separated by commas."""
    axes: dict[str, list[Any]] = {}
    for field, values in assignments("--sweep", texts, "k=1,2,5,10").items():
        try:
            axes[field] = parse_json(f"[{values}]")
        except SMEError:
            axes[field] = [json_or_text(value.strip()) for value in values.split(",")]
            if re.fullmatch(r"[\d.]+:[\d.]+(:[\d.]+)?", values):
                raise OptionError(
                    f"--sweep {field}={values}: a range is not expanded. List the values, such as "
                    f"{field}=1,2,5,10."
                ) from None
    return axes


def _class_name(document: SMESpec | StreamSpec) -> str:
    """The title of a task or a stream as a document's name."""
    title = catalogue.title(document).rsplit("/", 1)[-1].removesuffix("-v1")
    return title.replace(" (", "-").removesuffix(")")


@app.command()
@with_options
def new(
    context: typer.Context,
    path: NewFile,
    base: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="NAME|PATH",
            help="The task to start from.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ] = None,
    force: Force = False,
    *,
    fields: FieldOptions,  # type: ignore[valid-type]
    classes: ClassOptions,
    agents: Annotated[
        int | None, typer.Option(help="A team of this many equal agents, which observe all.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="By default the file's name.")] = None,
    description: Annotated[str, typer.Option(help="One or two sentences.")] = "",
    tag: Annotated[list[str] | None, typer.Option(help="A keyword. Repeatable.")] = None,
) -> None:
    """Write a task's file: its spec, its digest, and a fingerprint of the numbers drawn from it.

    Fields left out have their default, or the value of the --from task. --task or --suite write a
    suite instead: classes of tasks or streams, each with several instances, so that a method is
    judged on a kind of task and not on one draw.

    Examples:

      sme new deep.json --complexity 20 --policy-init unit_variance --seed 7
      sme new delayed.json --from HardDeep --k 25 --description "Paid every 25 steps."
      sme new safe.json --safety '{"tightness": 0.2}' --policy-init unit_variance
      sme new team.json --agents 4 --action-dim 8
      sme new mine.json -t Default -t HardSparse -t k2.json --instances 5
      sme new intervals.json -t Default --sweep k=1,5,25 --instances 3
    """
    check_document_path(path, force=force)
    about: dict[str, Any] = {"description": description, "tags": tuple(tag or ())}
    texts = dataclasses.asdict(fields)
    if classes.task or classes.suite or classes.sweep:
        foreign = ("base", "agents", *texts)
        only_with(context, foreign, "is for a task. Leave out --task, --suite and --sweep")
        suite = Suite.from_dict(classes.members())
        file = SuiteFile(name=name or path.stem, digest=suite.digest, suite=suite, **about)
        file.write(path)
        counts = plural(len(suite.runs), "class", "classes"), sum(suite.runs.values())
        digest, hint = file.digest, f"{counts[0]}, {plural(counts[1], 'instance')}. To train: "
        hint += f"sme train --suite {path} -a PPO"
    else:
        only_with(context, ("instances",), "is for a suite. Add --task")
        values = {key: json_or_text(text) for key, text in texts.items() if text is not None}
        spec = _new_spec(values, base, agents)
        save(spec, path, name, force=True, **about)
        digest, hint = spec.digest, f"To check the draw: sme check {path}"
    print_line(f"{escape(str(path))}  {digest}")
    print_note(f"[dim]{escape(hint)}[/]")


def _new_spec(fields: dict[str, Any], base: str | None, agents: int | None) -> SMESpec:
    start = SMESpec() if base is None else load(base, SMESpec)
    if agents is not None:
        if "team" in fields:
            raise OptionError("--agents: --team already lists the agents. Give one or the other.")
        alone = start.derive(**{**fields, "team": None})
        fields["team"] = _equal_team(alone.action_dim, agents)
    return start.derive(**fields)


def _equal_team(action_dim: int, agents: int) -> dict[str, Any]:
    integer_in("--agents", agents, 1, 1024)
    channels, remainder = divmod(action_dim, agents)
    if remainder or not channels:
        raise OptionError(
            f"--agents {agents}: action_dim={action_dim} cannot be shared equally. Change "
            "--action-dim, or use --team for unequal agents."
        )
    return {"agents": [{"action_dim": channels}] * agents}


@app.command()
def check(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME|PATH...",
            help="Tasks, streams, suites, protocols or studies; or folders of their files.",
            autocompletion=catalogue.completion(*KINDS.values()),
        ),
    ],
    files_only: Annotated[
        bool, typer.Option("--files-only", help="Check the files, but not what they draw.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the states and actions used.")] = 0,
    json: Json = False,
) -> None:
    """Check files, and that the tasks they draw are sound, before you train on them.

    Of a file: its JSON, its fields, its digest, and the fingerprint of the drawn numbers. Every
    file is checked, even after an invalid one; exit code 2 if any is invalid.

    Of a task: a broken or trivial one is refused, with exit code 1. A warning marks a valid but
    easy one, such as a semi_orthogonal policy of 2 to 5 layers, whose target stays near the middle.

    Examples:

      sme check mine.json
      sme check core smoke
      sme check specs/envs specs/suites --files-only
    """
    passed: list[bool] = []

    def checked() -> Iterator[dict[str, Any]]:
        whats = [name for each in names for name in _files(each)]
        for name in whats:
            result, tasks = _check(name)
            yield result
            result["certificates"] = []
            for label, spec in () if files_only else tasks:
                try:
                    certificate = certify(spec, seed=seed)
                except SMEError as error:  # such as too large a task; the next files are checked
                    passed.append(False)
                    result |= {"valid": False, "error": f"{label}: {error}"}
                    print_note(f"[red]not certified[/] {escape(result['error'])}")
                    continue
                passed.append(certificate.passed)
                result["certificates"].append({"task": label, **certificate.to_dict()})
                if not json:
                    _print_certificate(label, certificate, table=len(whats) == len(tasks) == 1)

    print_checks(checked(), "files", json=json)
    if not all(passed):
        print_note("Of a refused task, use another seed, or change a field.")
        raise typer.Exit(1)


def _files(name: str) -> list[str]:
    """The files of a folder; any other name alone."""
    if not Path(name).is_dir():
        return [name]
    files = sorted(map(str, Path(name).rglob("*.json")))
    if not files:
        raise OptionError(f"{name}: contains no .json file. Give files, or a folder of them.")
    return files


def _check(name: str) -> tuple[dict[str, Any], list[tuple[str, SMESpec]]]:
    """Whether a document is valid, and the tasks in it. An unknown name is an error at once."""
    result: dict[str, Any] = {"name": name, "valid": False, "kind": None, "error": None}
    try:
        document, file = find_any(name)
        tasks = _tasks(name, document, file)
    except SMEError as error:
        if not is_path(name):
            raise
        text = str(error)
        return result | {"error": text if name in text else f"{name}: {text}"}, []
    if file is not None:
        result["kind"] = kind_of(file)
    return result | {"valid": True, "digest": document.digest}, tasks


def _tasks(name: str, document: Any, file: Envelope | None) -> list[tuple[str, SMESpec]]:
    """The tasks of a document; those of a file are drawn, and have its fingerprints."""
    if isinstance(file, EnvFile | StreamFile):
        materialize_segments(*file.published)
    if isinstance(document, SMESpec | StreamSpec):
        return _phases(name, document)
    if isinstance(file, StudyFile):
        _ = file.plan.cells
    if not isinstance(file, SuiteFile):
        return []
    return [
        task
        for (member, kind, number), instance in file.suite.documents.items()
        for task in _phases(f"{file.name}/{member} {kind} {number}", instance)
    ]


def _phases(label: str, document: SMESpec | StreamSpec) -> list[tuple[str, SMESpec]]:
    """A task, or that of each phase of a stream."""
    if isinstance(document, SMESpec):
        return [(label, document)]
    return [(f"{label} phase {index}", spec) for index, spec in enumerate(document.specs)]


def _print_certificate(label: str, certificate: Certificate, *, table: bool) -> None:
    if table:
        out().print(certificate.table(f"Certificate of {escape(label)}"))
    notable = [*certificate.of("refused"), *certificate.of("warning")]
    reasons = ", ".join(f"{each.name} {short(each.value)}".rstrip() for each in notable)
    print_line(f"{MARKS[certificate.outcome]}  {escape(label)}  [dim]{reasons}[/]")

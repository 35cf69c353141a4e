"""`sme new`, `suite`, `validate` and `certify`: files of tasks and suites, and what they draw."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from rich.markup import escape

from sme_registry import save
from sme_registry.cli.arguments import (
    Force,
    Json,
    NewFile,
    assignments,
    check_document_path,
    find_any,
    find_file,
    json_or_text,
    kind_of,
    print_checks,
    read_any,
    with_options,
)
from sme_registry.errors import OptionError, SMEError, UnknownNameError
from sme_registry.io import integer_in, parse_json
from sme_registry.io.markup import plural
from sme_registry.io.terminal import out, print_json, print_line, print_note
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamClass,
    StreamFile,
    StreamSpec,
    StudyFile,
    Suite,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.document import Document
from sme_registry.spec.study import sweep
from sme_registry.task import load
from sme_registry.task.certificate import MARKS, Certificate, short
from sme_registry.task.certificate import certify as certify_task
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


FieldOptions = dataclasses.make_dataclass(
    "FieldOptions",
    [
        _field_option(name, field)
        for name, field in SMESpec.model_fields.items()
        if name != "schema_version"
    ],
    frozen=True,
    kw_only=True,
)
"""An option for each field of a spec."""


@app.command()
@with_options(FieldOptions)
def new(
    path: NewFile,
    options: Any,
    agents: Annotated[
        int | None, typer.Option(help="A team of this many equal agents, which observe all.")
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="NAME|PATH",
            help="The task to start from.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="By default the file's name.")] = None,
    description: Annotated[str, typer.Option(help="One or two sentences.")] = "",
    tag: Annotated[list[str] | None, typer.Option(help="A keyword. Repeatable.")] = None,
    force: Force = False,
) -> None:
    """Write a task's file: its spec, its digest, and a fingerprint of the numbers drawn from it.

    Fields left out have their default, or the value of the --from task. Everyone who has the file
    has the same task.

    Examples:

      sme new deep.json --complexity 20 --policy-init unit_variance --seed 7
      sme new delayed.json --from HardDeep --k 25 --description "Paid every 25 steps."
      sme new safe.json --safety '{"tightness": 0.2}' --policy-init unit_variance
      sme new sealed.json --seed 0x9f86d081884c7d659a2feaa0c55ad015
      sme new team.json --agents 4 --action-dim 8
    """
    check_document_path(path, force=force)
    texts = dataclasses.asdict(options)
    fields = {name: json_or_text(text) for name, text in texts.items() if text is not None}
    start = SMESpec() if base is None else load(base, SMESpec)
    if agents is not None:
        if "team" in fields:
            raise OptionError("--agents: --team already lists the agents. Give one or the other.")
        alone = start.derive(**{**fields, "team": None})
        fields["team"] = _equal_team(alone.action_dim, agents)
    spec = start.derive(**fields)
    save(spec, path, name, description=description, tags=tuple(tag or ()))
    print_line(f"{escape(str(path))}  {spec.digest}")
    print_note(f"[dim]To check the draw: sme certify {escape(str(path))}[/]")


def _equal_team(action_dim: int, agents: int) -> dict[str, Any]:
    integer_in("--agents", agents, 1, 1024)
    channels, remainder = divmod(action_dim, agents)
    if remainder or not channels:
        raise OptionError(
            f"--agents {agents}: action_dim={action_dim} cannot be shared equally. Change "
            "--action-dim, or use --team for unequal agents."
        )
    return {"agents": [{"action_dim": channels}] * agents}


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
            help="Vary a field of the --task, such as k=1,2,5 or D=0,0.25: a "
            "class for each value. Repeatable: each sweep is an axis of its own around the task, "
            "not a cross product.",
        ),
    ] = None
    instances: Annotated[
        int,
        typer.Option(
            help="Draws of each --task: its seed and those that follow; of a stream, other tasks "
            "for all of its phases.",
        ),
    ] = 1

    def members(self) -> dict[str, list[dict[str, Any]]]:
        """The classes of a suite, one for each task or stream, or those of the sweeps."""
        instances = integer_in("instances", self.instances, 1, 10_000)
        documents = [load(task) for task in self.task or ()]
        axes = sweep_axes(self.sweep)
        if axes and (self.suite is not None or len(documents) != 1):
            raise OptionError("--sweep: needs exactly one --task, and no --suite.")
        if self.suite is None and not documents:
            raise OptionError("Give --suite or --task, such as --suite smoke or --task Default.")
        classes: list[Document] = []
        streams: list[Document] = []
        if self.suite is not None:
            suite = find_file(SuiteFile, self.suite).suite
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
        kinds = {"classes": classes, "streams": streams}
        return {name: [each.to_dict() for each in some] for name, some in kinds.items() if some}


def sweep_axes(texts: Iterable[str] | None) -> dict[str, list[Any]]:
    """The axes of `FIELD=VALUE,…`: values are JSON, or else text, separated by commas."""
    axes: dict[str, list[Any]] = {}
    for field, values in assignments("--sweep", texts, "k=1,2,5,10").items():
        try:
            axes[field] = parse_json(f"[{values}]")
        except SMEError:
            axes[field] = [json_or_text(value.strip()) for value in values.split(",")]
    return axes


def _class_name(document: SMESpec | StreamSpec) -> str:
    """The title of a task or a stream as a document's name."""
    title = catalogue.title(document).rsplit("/", 1)[-1].removesuffix("-v1")
    return title.replace(" (", "-").removesuffix(")")


suite = typer.Typer(
    no_args_is_help=True,
    help="""Suites of your own: classes of tasks, each with several instances.

    Examples:

      sme suite new mine.json -t Default -t HardSparse --instances 5
      sme suite new more.json --suite smoke -t Complexity50
    """,
)
app.add_typer(suite, name="suite")


@suite.command("new")
@with_options(ClassOptions)
def new_suite(
    path: NewFile,
    options: ClassOptions,
    name: Annotated[str | None, typer.Option(help="By default the file's name.")] = None,
    description: Annotated[str, typer.Option(help="One or two sentences.")] = "",
    force: Force = False,
) -> None:
    """Write a suite's file: classes of tasks or streams, each with several instances.

    A class is one setting under several seeds, so that a method is judged on a kind of task and not
    on one draw. Studies, leaderboards and --suite accept the file like the name of a suite;
    leaderboards only if it has no streams.

    Examples:

      sme suite new mine.json -t Default -t HardSparse -t k2.json --instances 5
      sme suite new intervals.json -t Default --sweep k=1,5,25 --instances 3
      sme suite new more.json --suite smoke -t Complexity50
      sme suite new lives.json -t Switch5 -t Related5 --instances 5
    """
    check_document_path(path, force=force)
    members = Suite.from_dict(options.members())
    file = SuiteFile(
        name=name or path.stem, description=description, digest=members.digest, suite=members
    )
    file.write(path)
    classes = plural(len(members.runs), "class", "classes")
    tasks = f"{classes}, {plural(sum(members.runs.values()), 'instance')}"
    print_line(f"{escape(str(path))}  {file.digest}")
    hint = f"{tasks}. To train an algorithm on them: sme train --suite {path} -a PPO"
    print_note(f"[dim]{escape(hint)}[/]")


@app.command()
def validate(
    paths: Annotated[list[Path], typer.Argument(help="Files, or folders of .json files.")],
    json: Json = False,
) -> None:
    """Check files of tasks, suites, protocols and studies.

    It checks the JSON, the fields, the digest, and the fingerprint of the drawn numbers. Every
    file is checked, even after an invalid one. Exit code 2 if any file is invalid.

    Examples:

      sme validate mine.json
      sme validate specs/envs specs/suites
    """
    results = [_check(file) for path in paths for file in _files(path)]
    print_checks(results, "files", json=json)


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.rglob("*.json"))
    if not files:
        raise OptionError(f"{path}: contains no .json file. Give files, or a folder of them.")
    return files


def _check(path: Path) -> dict[str, Any]:
    result: dict[str, Any] = {"path": str(path), "valid": False, "kind": None, "error": None}
    try:
        file = read_any(path)
        result |= {"kind": kind_of(file), "name": file.versioned_name, "digest": file.digest}
        if isinstance(file, EnvFile | StreamFile):
            materialize_segments(*file.published)
        elif isinstance(file, SuiteFile):
            _ = file.suite.documents
        elif isinstance(file, StudyFile):
            _ = file.plan.cells
    except SMEError as error:
        text = str(error)
        return result | {"error": text if str(path) in text else f"{path}: {text}"}
    return result | {"valid": True}


@app.command()
def certify(
    tasks: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME|PATH...",
            help="Tasks or suites to check.",
            autocompletion=catalogue.completion(EnvFile, SuiteFile),
        ),
    ],
    seed: Annotated[int, typer.Option(help="Seed of the states and actions used.")] = 0,
    json: Json = False,
) -> None:
    """Draw a task and check that it is sound, before training on it.

    A broken or trivial task is refused. A warning marks a valid but easy one, such as a
    semi_orthogonal policy of 2 to 5 layers, whose target stays near the middle, or one whose limits
    bind more or less often than its tightness says. Exit code 1 if any task is refused.

    Examples:

      sme certify mine.json
      sme certify core smoke
    """
    specs = [entry for name in tasks for entry in _tasks(name)]
    certificates: list[tuple[str, Certificate]] = []
    for label, spec in specs:
        certificate = certify_task(spec, seed=seed)
        certificates.append((label, certificate))
        if json:
            continue
        if len(specs) == 1:
            out().print(certificate.table(f"Certificate of {escape(label)}"))
        notable = [*certificate.of("refused"), *certificate.of("warning")]
        reasons = ", ".join(f"{check.name} {short(check.value)}".rstrip() for check in notable)
        print_line(f"{MARKS[certificate.outcome]}  {escape(label)}  [dim]{reasons}[/]")
    if json:
        print_json([{"task": label, **each.to_dict()} for label, each in certificates])
    if not all(certificate.passed for _, certificate in certificates):
        print_note("Of a refused task, use another seed, or change a field.")
        raise typer.Exit(1)


def _tasks(name: str) -> list[tuple[str, SMESpec]]:
    document = find_any(name)
    if isinstance(document, ProtocolFile | StudyFile):
        raise UnknownNameError(
            f"{name!r}: is a {kind_of(document)}. Give a task, a stream or a suite."
        )
    if isinstance(document, SuiteFile):
        suite = document.suite
        labels = [f"{document.name}/{member} {kind} {n}" for member, kind, n in suite.places]
        instances = zip(labels, suite.documents, strict=True)
        return [task for label, instance in instances for task in _phases(label, instance)]
    if isinstance(document, EnvFile | StreamFile):
        materialize_segments(*document.published)
        return _phases(name, document.published.document)
    assert isinstance(document, SMESpec | StreamSpec)
    return _phases(name, document)


def _phases(label: str, document: SMESpec | StreamSpec) -> list[tuple[str, SMESpec]]:
    """A task, or that of each phase of a stream."""
    if isinstance(document, SMESpec):
        return [(label, document)]
    return [(f"{label} phase {index}", spec) for index, spec in enumerate(document.specs)]

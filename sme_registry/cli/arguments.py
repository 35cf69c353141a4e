"""Options and output that several commands share."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
import typing
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import typer
from rich.markup import escape

import sme_registry
from sme_registry.errors import (
    MalformedDocumentError,
    OptionError,
    SMEError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import check_new, install_command, is_installed, parse_json, read_json
from sme_registry.io.markup import Table
from sme_registry.io.terminal import out, print_json, print_line, print_note
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamFile,
    StreamSpec,
    StudyFile,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.catalogue import is_path, resolve
from sme_registry.spec.files import Envelope

TaskName = Annotated[
    str,
    typer.Argument(
        metavar="TASK",
        help="The task: a name, a path or a digest.",
        autocompletion=catalogue.completion(EnvFile, StreamFile),
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print plain JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
SpecChanges = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Change a field of the task. Repeatable."),
]
Protocol = Annotated[
    str,
    typer.Option(
        help="Evaluation protocol: a name from `sme list`, or a path.",
        autocompletion=catalogue.completion(ProtocolFile),
    ),
]
NewFile = Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)]
Out = Annotated[Path | None, typer.Option("--out", "-o", help="Output folder.")]
ActionRange = Annotated[
    str | None,
    typer.Option(
        help="Range of the policy's actions: unit or symmetric. Default: as saved, else unit."
    ),
]

# A name stands for the first kind that has it: `smoke` is a suite here, and a study in `sme study`.
KINDS: dict[str, type[Envelope]] = {
    "env": EnvFile,
    "stream": StreamFile,
    "suite": SuiteFile,
    "protocol": ProtocolFile,
    "study": StudyFile,
}

_Value = TypeVar("_Value")


def kind_of(file: Envelope) -> str:
    return next(kind for kind, model in KINDS.items() if isinstance(file, model))


def read_any(path: str | os.PathLike[str]) -> Envelope:
    """Read a file of any kind, which follows from the document in it."""
    data = read_json(path)
    for kind in KINDS.values():
        if isinstance(data, dict) and kind.content in data:
            return kind.from_dict(data, os.fspath(path))
    if isinstance(data, dict) and data.keys() <= SMESpec.model_fields.keys():
        return EnvFile.from_dict(data, os.fspath(path))  # says that it is a bare spec
    contents = ", ".join(repr(kind.content) for kind in KINDS.values())
    raise MalformedDocumentError(f"{os.fspath(path)}: must be an object with one of {contents}.")


class Found(NamedTuple):
    """A document, and its file; a spec or a stream may have none of its own."""

    document: Any
    file: Envelope | None


def find_any(name: str) -> Found:
    """The document of a name, path or digest."""
    if is_path(name):
        file = read_any(name)
        return Found(file.document, file)
    files = [file for kind in KINDS.values() for file in catalogue.entries(kind)]
    for file in files:
        if name in (file.name, file.versioned_name, file.digest):
            return Found(file.document, file)
    try:
        document = resolve(name).document
    except UnknownNameError as error:
        hint = did_you_mean(name.rsplit("/", 1)[-1], [file.name for file in files])
        if hint and "Did you mean" not in str(error):
            raise UnknownNameError(
                f"{name!r}: nothing in the catalogue has this name.{hint}"
            ) from None
        raise
    same = [file for file in files if file.digest == document.digest]
    return Found(document, same[0] if len(same) == 1 else None)


def assignments(option: str, texts: Iterable[str] | None, example: str) -> dict[str, str]:
    """What a repeatable option `NAME=VALUE` gives each name."""
    values: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise OptionError(f"{option} {text!r}: must be NAME=VALUE, such as {example}.")
        if name in values:
            raise OptionError(f"{option} {text!r}: {name} is given twice. Remove one.")
        values[name] = value
    return values


def changes(texts: list[str] | None) -> dict[str, Any]:
    """The fields or hyperparameters of `--set`."""
    values = assignments("--set", texts, "complexity=10")
    return {name: json_or_text(value) for name, value in values.items()}


def load_changed(name: str, fields: dict[str, Any]) -> SMESpec | StreamSpec:
    """The task of a name with other values of these fields; or the stream, which takes none."""
    document = sme_registry.load(name)
    if isinstance(document, SMESpec):
        return document.derive(**fields)
    for field in fields:
        advice = sme_registry.envs.arguments.another_stream(field.partition(".")[0])
        raise OptionError(f"--set {field}: {name} is a stream. {advice}")
    return document


def json_or_text(text: str) -> Any:
    """A value as JSON (`10`, `0.5`, `{"agents": …}`), or as the text itself (`0x1f`)."""
    try:
        return parse_json(text)
    except SMEError:
        return text


def check_document_path(path: Path, *, force: bool) -> None:
    if path.suffix != ".json":
        raise OptionError(f"{path}: must end in .json, so that commands recognise it as a path.")
    check_new(path, force=force)


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the fields of its parameters that are dataclasses as options."""
    hints = typing.get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {
        name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        kind = inspect.Parameter.KEYWORD_ONLY
        if name not in groups:
            parameters.append(parameter.replace(annotation=hints[name], kind=kind))
            continue
        types = typing.get_type_hints(groups[name], include_extras=True)
        parameters += [
            inspect.Parameter(field.name, kind, default=field.default, annotation=types[field.name])
            for field in dataclasses.fields(groups[name])
        ]

    @functools.wraps(command)
    def with_fields(**values: Any) -> None:
        for name, group in groups.items():
            chosen = {field.name: values.pop(field.name) for field in dataclasses.fields(group)}
            values[name] = group(**chosen)
        command(**values)

    with_fields.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_fields.__annotations__ = {p.name: p.annotation for p in parameters}
    return with_fields


def only_with(context: typer.Context, names: Iterable[str], reason: str) -> None:
    """Check that none of these parameters is given, since they belong to something else."""
    parameters = {parameter.name: parameter for parameter in context.command.params}
    for name in names:
        origin = context.get_parameter_source(name)
        # By name: newer versions of Typer include their own Click.
        if origin is not None and origin.name == "COMMANDLINE":
            shown = parameters[name].metavar or name.upper()
            options = [text for text in parameters[name].opts if text.startswith("--")]
            raise OptionError(f"{options[0] if options else shown}: {reason}.")


def can_draw() -> bool:
    if is_installed("matplotlib"):
        return True
    print_note(f"no figures: Matplotlib is not installed ({escape(install_command('plot'))})")
    return False


def print_training(
    result: Any, folder: Path, tables: Iterable[Table] = (), *, json: bool = False
) -> None:
    """Print the record and report of a training in a folder as JSON, or its tables."""
    if json:
        record, report = result.record.to_dict(), result.report.to_dict()
        print_json({"folder": str(folder), "run": record, "evaluation": report})
        return
    print_tables([*tables, *result.report.tables()])
    print_line(f"All files are in {escape(str(folder))}{os.sep}")


def print_checks(results: Iterable[dict[str, Any]], what: str, *, json: bool) -> None:
    """Print which of several things are valid as they come, and why others are not: exit code 2."""
    checked = []
    for result in results:
        checked.append(result)
        if json:
            continue
        shown = (result.get(key) for key in ("name", "kind", "digest"))
        about = " ".join(str(value) for value in shown if value is not None)
        verdict = "[green]valid[/]  " if result["valid"] else "[red]invalid[/]"
        print_line(f"{verdict}  {escape(about if result['valid'] else result['error'])}")
    if json:
        print_json(checked)
    invalid = sum(not result["valid"] for result in checked)
    if invalid:
        raise OptionError(
            f"{invalid} of {len(checked)} {what} {'is' if invalid == 1 else 'are'} invalid."
        )


def print_tables(tables: Iterable[Table]) -> None:
    for index, table in enumerate(tables):
        if index:
            out().print()
        out().print(table)


def print_written(paths: Iterable[Path]) -> None:
    for path in paths:
        print_note(f"wrote {escape(str(path))}")


def unique(values: Iterable[_Value]) -> list[_Value]:
    return list(dict.fromkeys(values))

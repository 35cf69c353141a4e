"""`sme validate` and `sme certify`: check files, and the tasks drawn from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Json, find_any, kind_of, read_any
from sme_registry.errors import OptionError, SMEError, UnknownNameError
from sme_registry.io.terminal import err, out, print_json
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

if TYPE_CHECKING:
    from sme_registry.task.certificate import Certificate


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
    if json:
        print_json(results)
    else:
        for result in results:
            if result["valid"]:
                name = f"{result['kind']:8}  {escape(result['path'])}"
                line = f"[green]valid[/]    {name}  {result['digest']}"
            else:
                line = f"[red]invalid[/]  {escape(result['error'])}"
            out().print(line, soft_wrap=True)
    invalid = sum(not result["valid"] for result in results)
    if invalid:
        raise OptionError(
            f"{invalid} of {len(results)} files {'is' if invalid == 1 else 'are'} invalid."
        )


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.rglob("*.json"))
    if not files:
        raise OptionError(f"{path}: contains no .json file. Give files, or a folder of them.")
    return files


def _check(path: Path) -> dict[str, Any]:
    from sme_registry.task import materialize_segments

    result: dict[str, Any] = {"path": str(path), "valid": False, "kind": None, "error": None}
    try:
        file = read_any(path)
        result |= {"kind": kind_of(file), "name": file.versioned_name, "digest": file.digest}
        if isinstance(file, EnvFile | StreamFile):
            materialize_segments(*file.published)
        elif isinstance(file, SuiteFile):
            _ = file.suite.instances, file.suite.stream_instances
        elif isinstance(file, StudyFile):
            _ = file.plan.cells
        result["valid"] = True
    except SMEError as error:
        text = str(error)
        result["error"] = text if str(path) in text else f"{path}: {text}"
    return result


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
    from sme_registry.task.certificate import certify as certify_task

    specs = [entry for name in tasks for entry in _tasks(name)]
    certificates: list[tuple[str, Certificate]] = []
    for label, spec in specs:
        certificates.append((label, certify_task(spec, seed=seed)))
        if not json and len(specs) > 1:
            _print_line(*certificates[-1])
    if json:
        print_json([{"task": label, **each.to_dict()} for label, each in certificates])
    elif len(specs) == 1:
        _print_certificate(*certificates[0])
    if not all(each.passed for _, each in certificates):
        raise typer.Exit(1)


def _tasks(name: str) -> list[tuple[str, SMESpec]]:
    """The label and spec of each task that a name stands for."""
    from sme_registry.task import materialize_segments

    document = find_any(name)
    if isinstance(document, SMESpec):
        return [(name, document)]
    if isinstance(document, EnvFile):
        materialize_segments(*document.published)
        return [(name, document.spec)]
    if isinstance(document, SuiteFile):
        tasks = [
            (f"{document.name}/{member.name} seed {spec.seed}", spec)
            for member in document.suite.classes
            for spec in member.instances
        ]
        draws = [
            (f"{document.name}/{member.name} draw {number}", stream)
            for member in document.suite.streams
            for number, stream in zip(member.draws, member.instances, strict=True)
        ]
        return tasks + [phase for label, stream in draws for phase in _phases(label, stream)]
    if isinstance(document, StreamSpec):
        return _phases(name, document)
    if isinstance(document, StreamFile):
        materialize_segments(*document.published)
        return _phases(document.name, document.stream)
    assert isinstance(document, ProtocolFile | StudyFile)
    kind = "protocol" if isinstance(document, ProtocolFile) else "study"
    raise UnknownNameError(f"{name!r}: is a {kind}. Give a task, a stream or a suite.")


def _phases(label: str, stream: StreamSpec) -> list[tuple[str, SMESpec]]:
    return [(f"{label} phase {index}", phase.spec) for index, phase in enumerate(stream.phases)]


def _print_line(label: str, certificate: Certificate) -> None:
    from sme_registry.task.certificate import MARKS, short

    notable = [*certificate.of("refused"), *certificate.of("warning")]
    reasons = ", ".join(f"{check.name} {short(check.value)}".rstrip() for check in notable)
    out().print(f"{MARKS[certificate.outcome]}  {escape(label)}  [dim]{reasons}[/]", soft_wrap=True)


def _print_certificate(label: str, certificate: Certificate) -> None:
    out().print(certificate.table(f"Certificate of {escape(label)}"))
    out().print()
    for check in certificate.checks:
        out().print(f"[bold]{check.name}[/]: {escape(check.meaning)}")
    out().print()
    refused = certificate.of("refused")
    if refused:
        reasons = ", ".join(check.name for check in refused)
        err().print(f"[red]refused[/] for {reasons}. Use another seed, or change a field.")
    elif certificate.outcome == "warning":
        err().print("[yellow]valid, with warnings[/]: see above.")
    else:
        err().print("[green]passed[/]")

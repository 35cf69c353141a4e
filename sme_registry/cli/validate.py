"""`sme validate`: check the files of tasks, suites, protocols and studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Json, kind_of, read_any
from sme_registry.errors import OptionError, SMEError
from sme_registry.io.terminal import out, print_json
from sme_registry.spec import EnvFile, StreamFile, StudyFile, SuiteFile


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
    from sme_registry.task import materialize, materialize_stream

    result: dict[str, Any] = {"path": str(path), "valid": False, "kind": None, "error": None}
    try:
        file = read_any(path)
        result |= {"kind": kind_of(file), "name": file.versioned_name, "digest": file.digest}
        if isinstance(file, EnvFile):
            materialize(file.spec, file.fingerprint)
        elif isinstance(file, StreamFile):
            materialize_stream(file.stream, file.fingerprints)
        elif isinstance(file, SuiteFile):
            _ = file.suite.instances, file.suite.stream_instances
        elif isinstance(file, StudyFile):
            _ = file.plan.cells
        result["valid"] = True
    except SMEError as error:
        text = str(error)
        result["error"] = text if str(path) in text else f"{path}: {text}"
    return result

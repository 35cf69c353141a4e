"""The catalogue: the files under `specs/`, by name.

The folders are the only list: a file in them is in the catalogue.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.io import read_json
from sme_registry.spec.envelope import (
    Envelope,
    EnvFile,
    ProtocolFile,
    StreamFile,
    StudyFile,
    SuiteFile,
)
from sme_registry.spec.sme_spec import SMESpec
from sme_registry.spec.stream import StreamSpec

NAMESPACE = "SME"
SYMMETRIC = "Symmetric"
"""Ends the name in an id of the same task with actions in [−1, 1]: `SME/DefaultSymmetric-v1`."""

STREAM = "Stream"
"""May begin the name of a stream in an id: `SME/StreamSwitch5-v1` is `SME/Switch5-v1`."""

_E = TypeVar("_E", bound=Envelope)
_FOLDERS: dict[type[Envelope], str] = {
    EnvFile: "envs",
    StreamFile: "streams",
    SuiteFile: "suites",
    ProtocolFile: "protocols",
    StudyFile: "studies",
}
_VERSION = re.compile(r"-v(\d+)$")


def spec_folder() -> Path:
    """The folder of the catalogue: inside the installed package, or next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "specs"
    return installed if installed.is_dir() else package.parent / "specs"


def paths(kind: type[Envelope]) -> list[Path]:
    """The catalogue's files of one kind, in natural order (`StateDim4` before `StateDim16`)."""

    def natural(path: Path) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.stem)]

    return sorted((spec_folder() / _FOLDERS[kind]).glob("*.json"), key=natural)


def names(kind: type[Envelope]) -> list[str]:
    """The versioned names of one kind: `Default-v1`, …"""
    return [path.stem for path in paths(kind)]


@functools.cache
def _read(kind: type[_E], path: Path) -> _E:
    return kind.read(path)


def completion(*kinds: type[Envelope]) -> Callable[[str], list[str]]:
    """What completes a name of these kinds in a shell: ids after `SME/`, else short names."""

    def complete(incomplete: str) -> list[str]:
        known = [_VERSION.sub("", name) for kind in kinds for name in names(kind)]
        if incomplete.startswith(f"{NAMESPACE}/") and EnvFile in kinds:
            known = [f"{NAMESPACE}/{name}" for name in names(EnvFile)]
        return [name for name in dict.fromkeys(known) if name.startswith(incomplete)]

    return complete


def entries(kind: type[_E]) -> list[_E]:
    """Every file of one kind, read and checked."""
    return [_read(kind, path) for path in paths(kind)]


def find(kind: type[_E], name: str, others: Iterable[str] = ()) -> _E:
    """The file of a name, with or without its version (then the newest)."""
    known = names(kind)
    if name in known:
        return cast(_E, _read(kind, spec_folder() / _FOLDERS[kind] / f"{name}.json"))
    versions = [
        (int(match[1]), full)
        for full in known
        if (match := _VERSION.search(full)) and full[: match.start()] == name
    ]
    if versions:
        return find(kind, max(versions)[1])
    known += others
    short = [_VERSION.sub("", full) for full in known]
    raise UnknownNameError(
        f"{name!r}: no {kind.content} has this name."
        + (did_you_mean(name, known) or did_you_mean(name, short))
        + " `sme list` shows the names."
    )


def unique_name(document: SMESpec | StreamSpec) -> str:
    """The name of a task or a stream in the catalogue (`Default-v1`), else its name by content."""
    kind = StreamFile if isinstance(document, StreamSpec) else EnvFile
    released = {file.digest: file.versioned_name for file in entries(kind)}
    return released.get(document.digest, document.content_name)


def title(document: SMESpec | StreamSpec) -> str:
    """What tables and figures call a task or a stream.

    `SME/Default-v1` in the catalogue; else the name of its file or registration; else `SME/` and
    its name by content. Another task's file with a catalogue name: `Default (sha256-…)`.
    """
    unique = unique_name(document)
    if unique != document.content_name or not document.name:
        return f"{NAMESPACE}/{unique}"
    known = [*names(EnvFile), *names(StreamFile)]
    released = {short for name in known for short in (name, _VERSION.sub("", name))}
    return f"{document.name} ({unique})" if document.name in released else document.name


def titles(specs: Iterable[SMESpec]) -> dict[str, str]:
    """Digest → title; different tasks of one name are told apart by their names by content."""
    tasks = {spec.digest: spec for spec in specs}
    plain = {digest: title(spec) for digest, spec in tasks.items()}
    shared = [*plain.values()]
    return {
        digest: text if shared.count(text) == 1 else f"{text} ({tasks[digest].content_name})"
        for digest, text in plain.items()
    }


def symmetric_name(versioned_name: str) -> str:
    """`Default-v1` → `DefaultSymmetric-v1`."""
    return _VERSION.sub(lambda version: SYMMETRIC + version[0], versioned_name)


def released() -> Iterator[tuple[str, str, str]]:
    """`(kind, versioned name, name by content)` of every environment, not validated."""
    for path in [*paths(EnvFile), *paths(StreamFile)]:
        file = read_json(path)
        content_name = file["digest"].replace(":", "-")[: len("sha256-") + 12]
        kind = "stream" if "stream" in file else "team" if file["spec"]["team"] else "spec"
        yield kind, path.stem, content_name

"""`sme list`: the catalogue."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import KINDS, Json, kind_of
from sme_registry.errors import UnknownNameError
from sme_registry.io.tables import Table
from sme_registry.io.terminal import out, print_json
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    StreamFile,
    StudyFile,
    StudyPlan,
    SuiteFile,
    catalogue,
)
from sme_registry.spec.envelope import Envelope

Kind = enum.StrEnum("Kind", ["env", "stream", "suite", "protocol", "study"])


def list_(
    kind: Annotated[Kind | None, typer.Option("--kind", "-k", help="Only this kind.")] = None,
    tag: Annotated[
        list[str] | None,
        typer.Option("--tag", "-t", help="Only entries with this tag. Repeatable: with all tags."),
    ] = None,
    json: Json = False,
) -> None:
    """List the catalogue: environments, streams, suites, protocols and studies.

    Examples:

      sme list

      sme list --kind env --tag paper

      sme list --json | jq '.[].id'
    """
    tags = set(tag or ())
    files = {
        name: [file for file in catalogue.entries(model) if tags <= set(file.tags)]
        for name, model in KINDS.items()
        if kind in (None, name)
    }
    if json:
        print_json([summary(file) for group in files.values() for file in group])
        return
    if not any(files.values()):
        known = sorted(
            {tag for model in KINDS.values() for f in catalogue.entries(model) for tag in f.tags}
        )
        raise UnknownNameError(
            f"--tag {' --tag '.join(sorted(tags))}: nothing in the catalogue has "
            f"{'this tag' if len(tags) == 1 else 'all of these tags'}. Tags: {', '.join(known)}."
        )
    for name, group in files.items():
        if group:
            out().print(_TABLES[name](group))


def summary(file: Envelope) -> dict[str, Any]:
    """A file's entry in the JSON output."""
    entry: dict[str, Any] = {
        "kind": kind_of(file),
        "name": file.versioned_name,
        "digest": file.digest,
        "tags": list(file.tags),
        "description": file.description,
    }
    if isinstance(file, EnvFile | StreamFile):
        entry["id"] = f"{catalogue.NAMESPACE}/{file.versioned_name}"
    if isinstance(file, EnvFile):
        entry["spec"] = file.spec.to_dict()
    return entry


def _env_table(files: list[EnvFile]) -> Table:
    numbers = ("n", "S", "A", "L", "k", "r_min", "D", "T")
    rows = []
    for file in files:
        spec = file.spec
        values = (
            1 if spec.team is None else len(spec.team.agents), spec.state_dim, spec.action_dim,
            spec.complexity, spec.k, spec.r_min, spec.D, spec.horizon,
        )  # fmt: skip
        name = f"{catalogue.NAMESPACE}/{file.versioned_name}"
        rows.append((name, *(f"{value:g}" for value in values), " ".join(file.tags)))
    return Table(
        "Environments",
        {"id": "name", **dict.fromkeys(numbers, "number"), "tags": "text"},
        rows,
        caption="n agents · S state channels, A action channels · L layers of π* · k reward "
        "interval · T horizon · actions are in [0, 1]; in [−1, 1] by SME/DefaultSymmetric-v1, …",
    )


def _stream_table(files: list[StreamFile]) -> Table:
    columns = {"name": "name", "phases": "number", "cycles": "number", "steps": "number"}
    columns |= {"description": "text"}
    streams = [file.stream for file in files]
    counts = ((len(stream.phases), stream.cycles, stream.steps) for stream in streams)
    return Table("Streams", columns, _rows(files, counts))


def _suite_table(files: list[SuiteFile]) -> Table:
    columns = {"name": "name", "classes": "number", "tasks": "number", "streams": "number"}
    columns |= {"description": "text"}
    suites = [file.suite for file in files]
    counts = ((len(each.runs), len(each.instances), len(each.stream_instances)) for each in suites)
    return Table("Suites", columns, _rows(files, counts))


def _protocol_table(files: list[ProtocolFile]) -> Table:
    columns = {"name": "name", "regions": "number", "states each": "number", "description": "text"}
    counts = ((len(file.protocol.edges), file.protocol.states_per_region) for file in files)
    return Table("Protocols", columns, _rows(files, counts))


def study_table(files: list[StudyFile]) -> Table:
    """The plans of studies: how many classes, algorithms, seeds and cells."""
    columns = {"name": "name", "classes": "number", "algorithms": "text"}
    columns |= {"seeds": "number", "cells": "number", "description": "text"}
    counts = (
        (
            len(file.plan.classes) + len(file.plan.streams),
            escape(", ".join(algorithm.name for algorithm in file.plan.algorithms)),
            file.plan.seeds,
            number_of_cells(file.plan),
        )
        for file in files
    )
    return Table("Studies", columns, _rows(files, counts))


def number_of_cells(plan: StudyPlan) -> int:
    """How many cells run; streams may share fresh agents."""
    if plan.streams:
        return len({planned.cell.digest for planned in plan.cells})
    return len(plan.classes) * len(plan.algorithms) * plan.seeds


def _rows(
    files: Sequence[Envelope], values: Iterable[tuple[int | str, ...]]
) -> Iterator[tuple[str, ...]]:
    """Each file's name, values and description."""
    for file, row in zip(files, values, strict=True):
        texts = (f"{value:,}" if isinstance(value, int) else value for value in row)
        yield file.versioned_name, *texts, escape(file.description)


_TABLES: dict[str, Any] = {
    "env": _env_table,
    "stream": _stream_table,
    "suite": _suite_table,
    "protocol": _protocol_table,
    "study": study_table,
}

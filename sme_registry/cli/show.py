"""`sme list` and `sme show`: the catalogue, and one entry of it."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.markup import escape

from sme_registry.cli.arguments import KINDS, Json, find_any, kind_of, print_tables
from sme_registry.envs.schedule import content_id
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io.markup import Table
from sme_registry.io.terminal import out, print_json, print_line, print_pairs
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamFile,
    StreamSpec,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteFile,
    cards,
    catalogue,
)
from sme_registry.spec.catalogue import Envelope, known
from sme_registry.spec.suite import EvaluationProtocol
from sme_registry.task.loading import parameter_bytes

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
            len(spec.agents), spec.state_dim, spec.action_dim,
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


Schema = enum.StrEnum(
    "Schema",
    "spec env-file stream stream-file suite suite-file protocol protocol-file study study-file",
)
_SCHEMAS: dict[str, type[BaseModel]] = {
    "spec": SMESpec,
    "env-file": EnvFile,
    "stream": StreamSpec,
    "stream-file": StreamFile,
    "suite": Suite,
    "suite-file": SuiteFile,
    "protocol": EvaluationProtocol,
    "protocol-file": ProtocolFile,
    "study": StudyPlan,
    "study-file": StudyFile,
}


def show(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME|PATH|DIGEST",
            help="What to show.",
            autocompletion=catalogue.completion(*KINDS.values()),
        ),
    ] = None,
    json: Json = False,
    json_schema: Annotated[
        Schema | None,
        typer.Option("--json-schema", help="Print the JSON Schema of a kind of document instead."),
    ] = None,
    digests: Annotated[
        bool,
        typer.Option("--digests", help="Print only the digests of a suite's tasks, one per line."),
    ] = False,
) -> None:
    """Show a task, stream, suite, protocol or study plan: fields, digest and derived facts.

    For a suite, it lists the task of each class and seed; `sme train` takes their digests.

    Examples:

      sme show Default
      sme show mine.json --json
      sme show sha256:66e9b7a9a266
      for task in $(sme show smoke --digests); do sme train $task; done
      sme show --json-schema env-file > env-file.schema.json
    """
    if json_schema is not None:
        if name is not None:
            raise OptionError(f"{name!r}: --json-schema takes no name. Give one or the other.")
        schema = _SCHEMAS[json_schema].model_json_schema()
        print_json({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema})
        return
    if name is None:
        raise OptionError("Give a name, a path or a digest, as in `sme show Default`.")
    document = find_any(name)
    if digests:
        if json or not isinstance(document, SuiteFile):
            raise OptionError("--digests: applies to suites, and not with --json. Leave one out.")
        tasks = document.suite.documents
        print_line("\n".join(each.digest for each in tasks))
    else:
        _show_document(name, document, json)


def _show_document(name: str, document: Envelope | SMESpec | StreamSpec, json: bool) -> None:
    if isinstance(document, SMESpec | EnvFile):
        _show_task(document, json)
    elif isinstance(document, SuiteFile):
        _show_suite(document, json)
    elif isinstance(document, StreamSpec) and json:
        print_json({"stream": document.to_dict(), "digest": document.digest})
    elif json:
        print_json(document.to_dict())
    elif isinstance(document, StudyFile):
        out().print(study_table([document]))
        out().print(f"{document.digest}\nTo see its runs and times: sme study plan {escape(name)}")
    elif isinstance(document, StreamSpec | StreamFile):
        _show_stream(document)
    elif isinstance(document, ProtocolFile):
        fields = {**document.protocol.to_dict(), "digest": document.digest}
        print_pairs(_title(document), fields)


def _show_task(document: SMESpec | EnvFile, json: bool) -> None:
    spec = document if isinstance(document, SMESpec) else document.spec
    facts = _facts(spec)
    agents = cards.agents(spec)
    if json:
        head = {} if isinstance(document, SMESpec) else summary(document)
        derived = facts | ({"agents": agents} if agents else {})
        print_json({**head, "spec": spec.to_dict(), "digest": spec.digest, "derived": derived})
        return
    title = spec.content_name if isinstance(document, SMESpec) else _title(document)
    print_pairs(title, cards.field_values(spec))
    if agents:
        out().print()
        out().print(cards.agents_table(agents))
    out().print()
    print_pairs("Derived", {"digest": spec.digest, **facts})


def _facts(spec: SMESpec) -> dict[str, Any]:
    """What follows from a spec without drawing its task."""
    env_id = _env_id(spec)
    symmetric = spec.team is None and "/sha256-" not in env_id
    facts: dict[str, Any] = {
        "id": env_id,
        **({"symmetric_id": catalogue.symmetric_name(env_id)} if symmetric else {}),
        **_spaces(spec),
        "parameters": parameter_bytes(spec) // 8,
        "parameter_memory_bytes": parameter_bytes(spec),
        "largest_return": spec.horizon,  # of each agent in a team
        "payouts_in_a_full_episode": math.ceil(spec.horizon / spec.k),
        "largest_payout": min(spec.k, spec.horizon),
    }
    if spec.D > 0:
        facts["episode_ends_below_step_reward"] = max(spec.D, spec.r_min)
    if spec.safety is not None:
        facts["limits"] = f"in [{1 - 2 * spec.safety.tightness:g}, 1], one for each action channel"
    return facts


def _env_id(spec: SMESpec) -> str:
    name = catalogue.unique_name(spec)
    return content_id(spec) if name == spec.content_name else f"{catalogue.NAMESPACE}/{name}"


def _spaces(spec: SMESpec) -> dict[str, str]:
    if spec.team is None:
        size = f"[{spec.observation_dim}] float32 in [0, 1]"
        return {
            "observation": f"{size}: {cards.observation_text(spec)}",
            "action": f"[{spec.action_dim}] float32 in [0, 1]",
        }
    n, widest = len(spec.team.agents), max(agent.action_dim for agent in spec.team.agents)
    return {
        "observation": "per agent, float32 in [0, 1]: its state channels, t/T, its r_cum/k",
        "action": "per agent, float32 in [0, 1]: its action channels",
        "shared_observation": f"[{spec.state_dim + 2 + n}] for one policy shared by all agents: "
        "state with unobserved channels set to 0, t/T, the agent's r_cum/k, its one-hot index",
        "shared_action": f"[{widest}]; an agent uses as many channels as it owns",
    }


def _show_stream(document: StreamSpec | StreamFile) -> None:
    stream = document if isinstance(document, StreamSpec) else document.stream
    title = stream.content_name if isinstance(document, StreamSpec) else _title(document)
    out().print(cards.stream_table(stream, title))
    out().print()
    print_pairs("Stream", cards.stream_facts(stream))


def _show_suite(file: SuiteFile, json: bool) -> None:
    if json:
        places = zip(file.suite.places, file.suite.documents, strict=True)
        instances = [
            {"class": name, kind: number, "digest": document.digest}
            for (name, kind, number), document in places
        ]
        print_json({**file.to_dict(), "derived": {"instances": instances}})
        return
    suite = file.suite
    tables = [make(suite) for make in (_tasks_table, _streams_table)]
    shown = [table for table in tables if table.rows]
    shown[0].title, shown[-1].caption = _title(file), file.digest
    print_tables(shown)
    digests = [each.digest for each in suite.documents]
    kind = "task" if suite.classes else "stream"
    if known(SMESpec).keys() | known(StreamSpec).keys() >= set(digests):
        print_line(f"To train on a {kind}: sme train {digests[0][: cards.SHORT]}")
    else:  # one outside the catalogue cannot be found by its digest
        out().print(f"To train on these {kind}s: sme study new plan.json -a PPO --suite FILE")


def _tasks_table(suite: Suite) -> Table:
    columns = {"class": "name", "differs from the default in": "text", "seed": "number"}
    rows = [
        (
            member.name,
            escape(cards.in_words(cards.changed_fields(member.setting))),
            "\n".join(str(seed) for seed in member.seeds),
            "\n".join(spec.digest[: cards.SHORT] for spec in member.instances),
        )
        for member in suite.classes
    ]
    return Table("", {**columns, "task": "name"}, rows)


def _streams_table(suite: Suite) -> Table:
    numbers = dict.fromkeys(("phases", "cycles", "steps", "draw"), "number")
    rows = [
        (
            member.name,
            str(len(member.stream.phases)),
            str(member.stream.cycles),
            f"{member.stream.steps:,}",
            "\n".join(str(number) for number in member.draws),
            "\n".join(stream.digest[: cards.SHORT] for stream in member.instances),
        )
        for member in suite.streams
    ]
    return Table("", {"class": "name", **numbers, "stream": "name"}, rows)


def _title(file: Envelope) -> str:
    name = file.versioned_name
    if isinstance(file, EnvFile) and name in catalogue.names(EnvFile):
        name = catalogue.unique_name(file.spec)  # a file of the user may use the same name
    return f"[bold]{name}[/]  {escape(file.description)}"

"""`sme list` and `sme show`: the catalogue, and one entry of it."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.markup import escape

import sme_registry
from sme_registry.cli.arguments import KINDS, Found, Json, find_any, kind_of, print_tables
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io.markup import Table
from sme_registry.io.terminal import out, print_json, print_line, print_pairs
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamClass,
    StreamFile,
    StreamSpec,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteClass,
    SuiteFile,
    cards,
    catalogue,
)
from sme_registry.spec.catalogue import known
from sme_registry.spec.files import Envelope
from sme_registry.spec.suite import EvaluationProtocol

app = typer.Typer()
Kind = enum.StrEnum("Kind", ["env", "stream", "suite", "protocol", "study"])


@app.command("list")
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
    catalogued = {
        name: catalogue.entries(model) for name, model in KINDS.items() if kind in (None, name)
    }
    groups = [[file for file in files if tags <= set(file.tags)] for files in catalogued.values()]
    if json:
        print_json([summary(file) for group in groups for file in group])
    elif any(groups):
        print_tables(catalogue_table(group) for group in groups if group)
    else:
        used = sorted({tag for files in catalogued.values() for file in files for tag in file.tags})
        raise UnknownNameError(
            f"--tag {' --tag '.join(sorted(tags))}: nothing in the catalogue has "
            f"{'this tag' if len(tags) == 1 else 'all of these tags'}. Tags: {', '.join(used)}."
        )


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


_TITLES: dict[type[Envelope], tuple[str, str]] = {
    EnvFile: (
        "Environments",
        "n agents · S state channels, A action channels · L layers of π* · k reward interval · "
        "T horizon · actions are in [0, 1]; in [−1, 1] by SME/DefaultSymmetric-v1, …",
    ),
    StreamFile: ("Streams", ""),
    SuiteFile: ("Suites", ""),
    ProtocolFile: ("Protocols", ""),
    StudyFile: ("Studies", ""),
}


def catalogue_table(files: Sequence[Envelope]) -> Table:
    """Files of one kind."""
    title, caption = _TITLES[type(files[0])]
    return Table.of(title, [_row(file) for file in files], caption=caption)


def _row(file: Envelope) -> dict[str, object]:
    if isinstance(file, EnvFile):
        spec = file.spec
        sizes = {"n": len(spec.agents), "S": spec.state_dim, "A": spec.action_dim}
        fields = {"L": spec.complexity, "k": spec.k, "r_min": spec.r_min, "D": spec.D}
        about = {"T": spec.horizon, "tags": " ".join(file.tags)}
        return {"id": f"{catalogue.NAMESPACE}/{file.versioned_name}", **sizes, **fields, **about}
    counts: dict[str, object] = {}
    if isinstance(file, StreamFile):
        stream = file.stream
        counts = {"phases": len(stream.phases), "cycles": stream.cycles, "steps": stream.steps}
    elif isinstance(file, SuiteFile):
        tasks, every = len(file.suite.instances), sum(file.suite.runs.values())
        counts = {"classes": len(file.suite.members), "tasks": tasks, "streams": every - tasks}
    elif isinstance(file, ProtocolFile):
        protocol = file.protocol
        counts = {"regions": len(protocol.edges), "states each": protocol.states_per_region}
    elif isinstance(file, StudyFile):
        plan = file.plan
        counts = {
            "classes": len(plan.members),
            "algorithms": ", ".join(algorithm.name for algorithm in plan.algorithms),
            "seeds": plan.seeds,
            "cells": number_of_cells(plan),
        }
    return {"name": file.versioned_name, **counts, "description": file.description}


def number_of_cells(plan: StudyPlan) -> int:
    """How many cells run; streams may share fresh agents."""
    if plan.streams:
        return len({planned.cell.digest for planned in plan.cells})
    return len(plan.classes) * len(plan.algorithms) * plan.seeds


Schema = enum.StrEnum(
    "Schema",
    "spec env-file stream stream-file suite suite-file protocol protocol-file study study-file",
)
_SCHEMAS: dict[str, type[BaseModel]] = {
    "spec": SMESpec,
    "stream": StreamSpec,
    "suite": Suite,
    "protocol": EvaluationProtocol,
    "study": StudyPlan,
    **{f"{kind}-file": model for kind, model in KINDS.items()},
}


@app.command()
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
        if name is not None or digests:
            given = "--digests" if name is None else repr(name)
            raise OptionError(f"{given}: is not for --json-schema. Give one or the other.")
        schema = _SCHEMAS[json_schema].model_json_schema()
        print_json({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema})
        return
    if name is None:
        raise OptionError("Give a name, a path or a digest, as in `sme show Default`.")
    found = find_any(name)
    if digests:
        if json or not isinstance(found.file, SuiteFile):
            raise OptionError("--digests: applies to suites, and not with --json. Leave one out.")
        print_line("\n".join(each.digest for each in found.document.documents.values()))
    elif json:
        print_json(_data(found))
    else:
        _show_document(name, found)


def _show_document(name: str, found: Found) -> None:
    document, file = found
    title = document.content_name if file is None else _title(file)
    if isinstance(document, SMESpec):
        _show_task(document, title)
    elif isinstance(document, StreamSpec):
        out().print(cards.stream_table(document, title))
        out().print()
        print_pairs("Stream", cards.stream_facts(document))
    elif isinstance(file, SuiteFile):
        _show_suite(file.suite, title)
    elif isinstance(file, StudyFile):
        out().print(catalogue_table([file]))
        out().print(f"{file.digest}\nTo see its runs and times: sme study plan {escape(name)}")
    else:
        print_pairs(title, {**document.to_dict(), "digest": document.digest})


def _data(found: Found) -> dict[str, Any]:
    """A document as JSON, with what follows from it."""
    document, file = found
    if isinstance(document, SMESpec):
        head = {} if file is None else summary(file)
        agents = cards.agents(document)
        derived = _facts(document) | ({"agents": agents} if agents else {})
        head |= {"spec": document.to_dict(), "digest": document.digest, "derived": derived}
        return head
    if file is None:
        return {"stream": document.to_dict(), "digest": document.digest}
    if not isinstance(file, SuiteFile):
        return file.to_dict()
    instances = [
        {"class": name, kind: number, "digest": instance.digest}
        for (name, kind, number), instance in file.suite.documents.items()
    ]
    return {**file.to_dict(), "derived": {"instances": instances}}


def _show_task(spec: SMESpec, title: str) -> None:
    print_pairs(title, cards.field_values(spec))
    if agents := cards.agents(spec):
        out().print()
        out().print(cards.agents_table(agents))
    out().print()
    print_pairs("Derived", {"digest": spec.digest, **_facts(spec)})


def _facts(spec: SMESpec) -> dict[str, Any]:
    """What follows from a spec without drawing its task."""
    env_id, size = _env_id(spec), sme_registry.task.loading.parameter_bytes(spec)
    symmetric = spec.team is None and "/sha256-" not in env_id
    facts: dict[str, Any] = {
        "id": env_id,
        **({"symmetric_id": catalogue.symmetric_name(env_id)} if symmetric else {}),
        **_spaces(spec),
        "parameters": size // 8,
        "parameter_memory_bytes": size,
        **_largest_return(spec),
        "payouts_in_a_full_episode": math.ceil(spec.horizon / spec.k),
        "largest_payout": min(spec.k, spec.horizon),
    }
    if spec.D > 0:
        facts["episode_ends_below_step_reward"] = max(spec.D, spec.r_min)
    if spec.safety is not None:
        facts["limits"] = f"in [{1 - 2 * spec.safety.tightness:g}, 1], one for each action channel"
    return facts


def _largest_return(spec: SMESpec) -> dict[str, Any]:
    """What the optimal policy is paid in an episode, without a discount; of each agent in a team.

    What is paid on top for safety makes other policies earn more than it, but for a cost.
    """
    name = "largest_return_without_cost" if spec.compensated else "largest_return"
    noisy = " on average" if spec.reward_noise else ""
    if spec.shaping is None:
        return {name: f"{spec.horizon}{noisy}" if noisy else spec.horizon}
    if spec.shaping.discount == 1:
        c = f"{spec.shaping.scale:g}"
        return {name: f"{spec.horizon} − P₀(s₀){noisy}, with the potential P₀ in [0, {c}]"}
    # Σ F then depends on the states between: π* is optimal only for a learner of this discount.
    return {name: f"not that of π*, which is optimal at γ = {spec.shaping.discount:g}"}


def _env_id(spec: SMESpec) -> str:
    name = catalogue.unique_name(spec)
    return (
        catalogue.content_id(spec) if name == spec.content_name else f"{catalogue.NAMESPACE}/{name}"
    )


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


def _show_suite(suite: Suite, title: str) -> None:
    tables = [
        Table.of("", [_class_row(member) for member in members])
        for members in (suite.classes, suite.streams)
        if members
    ]
    tables[0].title, tables[-1].caption = title, suite.digest
    print_tables(tables)
    digests = [each.digest for each in suite.documents.values()]
    kind = "task" if suite.classes else "stream"
    if known(SMESpec).keys() | known(StreamSpec).keys() >= set(digests):
        print_line(f"To train on a {kind}: sme train {digests[0][: cards.SHORT]}")
    else:  # one outside the catalogue cannot be found by its digest
        out().print(f"To train on these {kind}s: sme study new plan.json -a PPO --suite FILE")


def _class_row(member: SuiteClass | StreamClass) -> dict[str, object]:
    if isinstance(member, SuiteClass):
        changed = cards.in_words(cards.changed_fields(member.setting))
        about: dict[str, object] = {"differs from the default in": changed}
        what = "task"
    else:
        stream = member.stream
        about = {"phases": len(stream.phases), "cycles": stream.cycles, "steps": stream.steps}
        what = "stream"
    numbers = "\n".join(map(str, member.numbers))
    digests = "\n".join(instance.digest[: cards.SHORT] for instance in member.instances)
    return {"class": member.name, **about, member.kind: numbers, what: digests}


def _title(file: Envelope) -> str:
    name = file.versioned_name
    if isinstance(file, EnvFile) and name in catalogue.names(EnvFile):
        name = catalogue.unique_name(file.spec)  # a file of the user may use the same name
    return f"[bold]{name}[/]  {escape(file.description)}"

"""`sme list`, `show`, `new`, `validate`, `certify`: tasks, suites and protocols as documents."""

from __future__ import annotations

import enum
import math
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from pydantic import BaseModel
from rich.markup import escape
from rich.table import Table

from sme_registry import load
from sme_registry.cli import names
from sme_registry.errors import OptionError, SMEError, UnknownNameError
from sme_registry.io import read_json
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StudyFile,
    StudyPlan,
    Suite,
    SuiteFile,
    TeamSpec,
    catalogue,
)
from sme_registry.spec.envelope import Envelope
from sme_registry.spec.protocol import EvaluationProtocol
from sme_registry.spec.resolve import known_specs
from sme_registry.terminal.output import err, mark, out, print_json, print_pairs

Json = Annotated[bool, typer.Option("--json", help="Plain JSON on standard output.")]


class Kind(enum.StrEnum):
    """What `sme list` shows."""

    env = "env"
    suite = "suite"
    protocol = "protocol"
    study = "study"


class Schema(enum.StrEnum):
    """Whose JSON Schema `sme show --json-schema` prints."""

    spec = "spec"
    env_file = "env-file"
    suite = "suite"
    suite_file = "suite-file"
    protocol = "protocol"
    protocol_file = "protocol-file"
    study = "study"
    study_file = "study-file"


_SCHEMAS: dict[Schema, type[BaseModel]] = {
    Schema.spec: SMESpec,
    Schema.env_file: EnvFile,
    Schema.suite: Suite,
    Schema.suite_file: SuiteFile,
    Schema.protocol: EvaluationProtocol,
    Schema.protocol_file: ProtocolFile,
    Schema.study: StudyPlan,
    Schema.study_file: StudyFile,
}


_SHORT = len("sha256:") + 12  # of a digest, enough to name a task by


def list_(
    kind: Annotated[Kind | None, typer.Option("--kind", "-k", help="Only one kind.")] = None,
    tag: Annotated[
        list[str] | None, typer.Option("--tag", "-t", help="Only what has this tag; repeatable.")
    ] = None,
    json: Json = False,
) -> None:
    """The catalogue: environments, suites, protocols and studies.

    Examples:

      sme list

      sme list --kind env --tag paper

      sme list --json | jq '.[].id'
    """
    wanted = set(tag or ())
    found = {
        name: [file for file in catalogue.entries(kind_of) if wanted <= set(file.tags)]
        for name, kind_of in names.KINDS.items()
        if kind in (None, name)
    }
    if json:
        print_json([_summary(name, file) for name, files in found.items() for file in files])
        return
    if not any(found.values()):
        known = sorted(
            {tag for k in names.KINDS.values() for f in catalogue.entries(k) for tag in f.tags}
        )
        raise UnknownNameError(
            f"--tag {' --tag '.join(sorted(wanted))}: nothing in the catalogue has "
            f"{'it' if len(wanted) == 1 else 'them all'}. Tags: {', '.join(known)}."
        )
    for name, files in found.items():
        if files:
            out().print(_TABLES[name](files))


def _summary(kind: str, file: Envelope) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "kind": kind,
        "name": file.versioned_name,
        "digest": file.digest,
        "tags": list(file.tags),
        "description": file.description,
    }
    if isinstance(file, EnvFile):
        summary["id"] = f"{catalogue.NAMESPACE}/{file.versioned_name}"
        summary["spec"] = file.spec.to_dict()
    return summary


def _env_table(files: list[EnvFile]) -> Table:
    table = Table(
        title="Environments",
        caption="n agents · S state, A action channels · L layers of π* · k reward interval · "
        "T horizon",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("id", no_wrap=True)
    for column in ("n", "S", "A", "L", "k", "r_min", "D", "T"):
        table.add_column(column, justify="right")
    table.add_column("tags", overflow="fold")
    for file in files:
        spec = file.spec
        agents = 1 if spec.team is None else len(spec.team.agents)
        numbers = (
            agents, spec.state_dim, spec.action_dim, spec.complexity, spec.k, spec.r_min, spec.D,
            spec.horizon,
        )  # fmt: skip
        table.add_row(
            f"{catalogue.NAMESPACE}/{file.versioned_name}",
            *(f"{number:g}" for number in numbers),
            " ".join(file.tags),
        )
    return table


def _suite_table(files: list[SuiteFile]) -> Table:
    table = Table(title="Suites", title_justify="left")
    for column in ("name", "classes", "tasks", "description"):
        table.add_column(column, no_wrap=column == "name")
    for file in files:
        counts = len(file.suite.classes), len(file.suite.instances)
        table.add_row(file.versioned_name, *map(str, counts), escape(file.description))
    return table


def _protocol_table(files: list[ProtocolFile]) -> Table:
    table = Table(title="Protocols", title_justify="left")
    for column in ("name", "regions", "states each", "description"):
        table.add_column(column, no_wrap=column == "name")
    for file in files:
        protocol = file.protocol
        counts = str(len(protocol.edges)), f"{protocol.states_per_region:,}"
        table.add_row(file.versioned_name, *counts, escape(file.description))
    return table


def _study_table(files: list[StudyFile]) -> Table:
    table = Table(title="Studies", title_justify="left")
    for column in ("name", "classes", "algorithms", "runs", "description"):
        table.add_column(column, no_wrap=column == "name")
    for file in files:
        plan = file.plan
        algorithms = ", ".join(algorithm.name for algorithm in plan.algorithms)
        runs = len(plan.classes) * len(plan.algorithms) * plan.seeds
        table.add_row(
            file.versioned_name,
            str(len(plan.classes)),
            escape(algorithms),
            f"{runs:,}",
            escape(file.description),
        )
    return table


_TABLES: dict[str, Any] = {
    "env": _env_table,
    "suite": _suite_table,
    "protocol": _protocol_table,
    "study": _study_table,
}


def show(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|PATH|DIGEST", help="What to show.")
    ] = None,
    json: Json = False,
    json_schema: Annotated[
        Schema | None,
        typer.Option("--json-schema", help="Print the JSON Schema of a kind of document instead."),
    ] = None,
    digests: Annotated[
        bool,
        typer.Option("--digests", help="Of a suite, only its instances' digests, a line each."),
    ] = False,
) -> None:
    """One task, suite or protocol: its fields, its digest, and what follows from them.

    Of a suite, the instances of each class: `sme train` takes their digests.

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
        raise OptionError(
            "NAME: missing: must be a name, a path or a digest, as in `sme show Default`."
        )
    found = names.find_any(name)
    if digests and (json or not isinstance(found, SuiteFile)):
        raise OptionError("--digests: is for a suite, and without --json. Leave one of them out.")
    if isinstance(found, SMESpec | EnvFile):
        _show_task(found, json)
        return
    document = getattr(found, found.content)
    if isinstance(found, SuiteFile):
        if digests:
            out().print("\n".join(spec.digest for spec in found.suite.instances), soft_wrap=True)
        else:
            _show_suite(found, json)
    elif json:
        print_json(found.to_dict())
    elif isinstance(found, StudyFile):
        out().print(_study_table([found]))
        out().print(f"{found.digest}\nIts runs and what they take: sme study plan {escape(name)}")
    else:
        print_pairs(_title(found), {**document.to_dict(), "digest": found.digest})


def _show_task(found: SMESpec | EnvFile, json: bool) -> None:
    spec = found if isinstance(found, SMESpec) else found.spec
    facts = _facts(spec)
    agents = _agents(spec)
    if json:
        if agents:
            facts["agents"] = agents
        head = {} if isinstance(found, SMESpec) else _summary("env", found)
        print_json({**head, "spec": spec.to_dict(), "digest": spec.digest, "derived": facts})
        return
    fields = spec.to_dict()
    if spec.team is not None:
        fields["team"] = _team_in_words(spec.team)
    print_pairs(spec.content_name if isinstance(found, SMESpec) else _title(found), fields)
    if agents:
        out().print()
        out().print(_agents_table(agents))
    out().print()
    print_pairs("Derived", {"digest": spec.digest, **facts})


def _env_id(spec: SMESpec) -> str:
    """The id to make it by: its released name, or its name by content."""
    from sme_registry.envs.naming import content_id

    title = catalogue.title(spec)
    return content_id(spec) if title.endswith(spec.content_name) else title


def _facts(spec: SMESpec) -> dict[str, Any]:
    """What follows from a spec, without drawing it."""
    from sme_registry.task.memory import parameter_bytes

    payouts = math.ceil(spec.horizon / spec.k)
    facts: dict[str, Any] = {
        "id": _env_id(spec),
        **_spaces(spec),
        "parameters": parameter_bytes(spec) // 8,
        "parameter_memory_bytes": parameter_bytes(spec),
        "largest_return": spec.horizon,  # of a team, each agent's
        "payouts_in_a_full_episode": payouts,
        "largest_payout": min(spec.k, spec.horizon),
    }
    if spec.D > 0:
        facts["episode_ends_below_step_reward"] = max(spec.D, spec.r_min)
    return facts


def _spaces(spec: SMESpec) -> dict[str, str]:
    """What is observed and what is done, in words."""
    if spec.team is None:
        return {
            "observation": f"[{spec.state_dim + 2}] float32 in [0, 1]: state, t/T, r_cum/k",
            "action": f"[{spec.action_dim}] float32 in [0, 1]",
        }
    n, widest = len(spec.team.agents), max(agent.action_dim for agent in spec.team.agents)
    return {
        "observation": "of each agent, float32 in [0, 1]: what it observes, t/T, its own r_cum/k",
        "action": "of each agent, float32 in [0, 1]: the channels that it owns",
        "shared_observation": f"[{spec.state_dim + 2 + n}] of one policy for all agents: state "
        "with unobserved channels 0, t/T, its own r_cum/k, one-hot of the agent",
        "shared_action": f"[{widest}], of which the agent's first count",
    }


def _team_in_words(team: TeamSpec) -> str:
    n = len(team.agents)
    return f"{n} agent{'s' * (n > 1)}, {team.reward} reward"


def _agents(spec: SMESpec) -> list[dict[str, Any]]:
    """Who owns, sees and is paid for what; nothing where there is no team."""
    if spec.team is None:
        return []
    agents, first = [], 0
    for agent in spec.team.agents:
        seen = range(spec.state_dim) if agent.observes == "all" else agent.observes
        agents.append(
            {
                "name": agent.name,
                "action_channels": list(range(first, first + agent.action_dim)),
                "observed_channels": list(seen),
                "observation_dim": len(seen) + 2,
                "paid_for": "all channels" if spec.team.reward == "team" else "own channels",
            }
        )
        first += agent.action_dim
    return agents


def _agents_table(agents: list[dict[str, Any]]) -> Table:
    table = Table(title="Agents", title_justify="left")
    table.add_column("agent", no_wrap=True)
    for column in ("action channels", "observed state channels", "observation", "paid for"):
        table.add_column(column, overflow="fold")
    for agent in agents:
        table.add_row(
            escape(agent["name"]),
            _ranges(agent["action_channels"]),
            _ranges(agent["observed_channels"]),
            escape(f"[{agent['observation_dim']}]"),
            agent["paid_for"],
        )
    return table


def _ranges(channels: list[int]) -> str:
    """Increasing channels in short: `0–3, 6`."""
    runs: list[list[int]] = []
    for channel in channels:
        if runs and channel == runs[-1][-1] + 1:
            runs[-1].append(channel)
        else:
            runs.append([channel])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)


def _show_suite(file: SuiteFile, json: bool) -> None:
    if json:
        instances = [
            {"class": member.name, "seed": spec.to_dict()["seed"], "digest": spec.digest}
            for member in file.suite.classes
            for spec in member.instances
        ]
        print_json({**file.to_dict(), "derived": {"instances": instances}})
        return
    default = SMESpec().to_dict()
    table = Table(
        title=_title(file), caption=file.digest, title_justify="left", caption_justify="left"
    )
    table.add_column("class", no_wrap=True)
    table.add_column("differs from the default in", overflow="fold")
    table.add_column("seed", justify="right", no_wrap=True)
    table.add_column("instance", no_wrap=True)
    for member in file.suite.classes:
        changed = {k: v for k, v in member.setting.to_dict().items() if v != default[k]}
        if member.setting.team is not None:
            changed["team"] = _team_in_words(member.setting.team)
        table.add_row(
            member.name,
            escape(", ".join(f"{k}={v}" for k, v in changed.items())),
            "\n".join(str(seed) for seed in member.seeds),
            "\n".join(spec.digest[:_SHORT] for spec in member.instances),
        )
    out().print(table)
    first = file.suite.instances[0].digest
    if first in known_specs():  # those of a file outside the catalogue have no name to train by
        out().print(f"To train on an instance: sme train {first[:_SHORT]}", soft_wrap=True)


def _title(file: Envelope) -> str:
    return f"[bold]{file.versioned_name}[/]  {escape(file.description)}"


def new(
    path: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)],
    state_dim: Annotated[int | None, typer.Option(help="S, state channels.")] = None,
    action_dim: Annotated[int | None, typer.Option(help="A, action channels.")] = None,
    k: Annotated[int | None, typer.Option("--k", help="Steps between payouts.")] = None,
    r_min: Annotated[float | None, typer.Option(help="Step rewards up to it are 0.")] = None,
    D: Annotated[
        float | None, typer.Option("--D", help="An episode ends below this step reward.")
    ] = None,
    complexity: Annotated[int | None, typer.Option(help="L, layers of the optimal policy.")] = None,
    horizon: Annotated[int | None, typer.Option(help="T, steps of an episode.")] = None,
    hidden_width: Annotated[int | None, typer.Option(help="H, width of the inner layers.")] = None,
    policy_init: Annotated[
        str | None, typer.Option(help="semi_orthogonal, or unit_variance: also where layers widen.")
    ] = None,
    seed: Annotated[
        str | None, typer.Option(help="Of the draw: an integer, or 0x… sealed.")
    ] = None,
    team: Annotated[
        str | None,
        typer.Option(
            metavar="JSON|FILE",
            help='\'{"agents": [{"action_dim": 2, "observes": \\[0, 1]}, {"action_dim": 2}]}\', '
            "or a file of it.",
        ),
    ] = None,
    agents: Annotated[
        int | None, typer.Option(help="A team of so many alike, who observe the whole state.")
    ] = None,
    channels_each: Annotated[
        int | None,
        typer.Option(help="Action channels of each of --agents; by default A shared out."),
    ] = None,
    team_reward: Annotated[
        str | None, typer.Option(help="individual, or team: all paid for all channels.")
    ] = None,
    base: Annotated[
        str | None, typer.Option("--from", metavar="NAME|PATH", help="The task to derive from.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="By default the file's name.")] = None,
    description: Annotated[str, typer.Option(help="One or two sentences.")] = "",
    tag: Annotated[list[str] | None, typer.Option(help="A word to find it by; repeatable.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write a task's file: spec, digest, and a fingerprint of the numbers drawn.

    What is left out has the default, or the value of --from. Whoever holds the file holds the
    same task.

    Examples:

      sme new deep.json --complexity 20 --policy-init unit_variance --seed 7

      sme new sparse.json --from HardDeep --k 25 --description "Paid every 25 steps."

      sme new sealed.json --seed 0x9f86d081884c7d659a2feaa0c55ad015

      sme new team.json --agents 4 --channels-each 2 --team-reward team
    """
    given = {
        "state_dim": state_dim,
        "action_dim": action_dim,
        "k": k,
        "r_min": r_min,
        "D": D,
        "complexity": complexity,
        "horizon": horizon,
        "hidden_width": hidden_width,
        "policy_init": policy_init,
        "seed": None if seed is None else names.json_or_text(seed),
    }
    fields = {field: value for field, value in given.items() if value is not None}
    if path.suffix != ".json":
        raise OptionError(f"{path}: must end in .json, by which every command knows a path.")
    if path.exists() and not force:
        raise OptionError(f"{path}: is there already. Give another path, or --force to replace it.")
    origin = load(base) if base is not None else SMESpec()
    fields |= _team_fields(origin, fields, team, agents, channels_each, team_reward)
    spec = origin.derive(**fields)

    import sme_registry

    sme_registry.save(spec, path, name, description=description, tags=tuple(tag or ()))
    out().print(f"{escape(str(path))}  {spec.digest}", soft_wrap=True)
    err().print(f"[dim]sme certify {escape(str(path))}  checks the draw[/]", soft_wrap=True)


def _team_fields(
    origin: SMESpec,
    fields: dict[str, Any],
    team: str | None,
    agents: int | None,
    channels_each: int | None,
    reward: str | None,
) -> dict[str, Any]:
    """The spec fields that the options of a team amount to.

    Raises:
      OptionError: two options contradict each other, or channels cannot be shared out.
      MalformedDocumentError: the team's file cannot be read.
    """
    if team is not None and agents is not None:
        raise OptionError("--agents: --team says who the agents are. Give one or the other.")
    if channels_each is not None and agents is None:
        raise OptionError(f"--channels-each {channels_each}: of how many? Give --agents, too.")
    made: dict[str, Any] = {}
    if team is not None:
        made["team"] = read_json(team) if team.endswith(".json") else names.json_or_text(team)
    elif agents is not None:
        if agents < 1:
            raise OptionError(f"--agents {agents}: must be at least 1.")
        if channels_each is None:
            A = fields.get("action_dim", origin.action_dim)
            channels_each, left_over = divmod(A, agents)
            if left_over or not channels_each:
                raise OptionError(
                    f"--agents {agents}: action_dim={A} cannot be shared out evenly. Give "
                    "--channels-each, or --team for unequal agents."
                )
        else:
            fields.setdefault("action_dim", agents * channels_each)
        if fields.get("action_dim", origin.action_dim) != agents * channels_each:
            raise OptionError(
                f"--agents {agents} --channels-each {channels_each}: make {agents * channels_each} "
                f"action channels and --action-dim says {fields['action_dim']}. Leave it out."
            )
        # The spec refuses far fewer than these; billions would first fill the memory.
        made["team"] = {"agents": [{"action_dim": channels_each}] * min(agents, 2**12)}
    elif reward is not None and origin.team is not None:
        made["team"] = origin.team.to_dict()
    if reward is not None:
        if not isinstance(made.get("team"), dict):
            raise OptionError(f"--team-reward {reward}: of which team? Give --agents or --team.")
        made["team"] = {**made["team"], "reward": reward}
    return made


def validate(
    paths: Annotated[list[Path], typer.Argument(help="Files, or folders of *.json.")],
    json: Json = False,
) -> None:
    """Check files of tasks, suites and protocols: strict JSON, fields, digest, fingerprint.

    Every file is checked, also after a bad one. Exit code 2 if any is bad.

    Examples:

      sme validate mine.json

      sme validate specs/envs specs/suites
    """
    results = [_validated(path) for given in paths for path in _files_in(given)]
    if json:
        print_json(results)
    else:
        for result in results:
            if result["valid"]:
                line = f"[green]valid[/]   {result['kind']:8}  {escape(result['path'])}"
                out().print(line, soft_wrap=True)
            else:
                out().print(f"[red]bad[/]     {escape(result['error'])}", soft_wrap=True)
    bad = sum(not result["valid"] for result in results)
    if bad:
        raise OptionError(f"{bad} of {len(results)} files {'is' if bad == 1 else 'are'} bad.")


def _files_in(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted(path.rglob("*.json"))
    if not found:
        raise OptionError(f"{path}: holds no .json file. Give files, or a folder of them.")
    return found


def _validated(path: Path) -> dict[str, Any]:
    from sme_registry.task import materialize

    result: dict[str, Any] = {"path": str(path), "valid": False, "kind": None, "error": None}
    try:
        file = names.read_any(path)
        result["kind"] = next(kind for kind, of in names.KINDS.items() if isinstance(file, of))
        result |= {"name": file.versioned_name, "digest": file.digest}
        if isinstance(file, EnvFile):
            materialize(file.spec, file.fingerprint)
        elif isinstance(file, SuiteFile):
            _ = file.suite.instances
        elif isinstance(file, StudyFile):
            _ = file.plan.cells
        result["valid"] = True
    except SMEError as error:
        text = str(error)
        result["error"] = text if str(path) in text else f"{path}: {text}"
    return result


def certify(
    tasks: Annotated[list[str], typer.Argument(metavar="NAME|PATH...", help="Tasks, or suites.")],
    seed: Annotated[int, typer.Option(help="Of the states and actions it is measured with.")] = 0,
    json: Json = False,
) -> None:
    """Draw a task and measure whether it is sane: before training on it, not after.

    Refused is what is broken or trivial. A warning is for what is right and easy, such as
    semi_orthogonal policies of 2 to 5 layers, whose target bunches around the middle. Exit code 1
    if any is refused.

    Examples:

      sme certify mine.json

      sme certify core smoke
    """
    from sme_registry.task.certify import Certificate
    from sme_registry.task.certify import certify as measure

    found = [task for name in tasks for task in _tasks_of(name)]
    certificates: list[tuple[str, Certificate]] = []
    for label, spec in found:
        certificates.append((label, measure(spec, seed=seed)))
        if not json and len(found) > 1:
            _print_line(*certificates[-1])
    if json:
        print_json([{"task": label, **made.to_dict()} for label, made in certificates])
    elif len(found) == 1:
        _print_certificate(*certificates[0])
    if not all(made.passed for _, made in certificates):
        raise typer.Exit(1)


def _tasks_of(name: str) -> list[tuple[str, SMESpec]]:
    from sme_registry.task import materialize

    found = names.find_any(name)
    if isinstance(found, SuiteFile):
        return [
            (f"{found.name}/{member.name} seed {spec.seed}", spec)
            for member in found.suite.classes
            for spec in member.instances
        ]
    if isinstance(found, ProtocolFile | StudyFile):
        kind = "protocol" if isinstance(found, ProtocolFile) else "study"
        raise UnknownNameError(f"{name!r}: is a {kind}. Give a task or a suite.")
    if isinstance(found, EnvFile):
        materialize(found.spec, found.fingerprint)
    return [(name, found if isinstance(found, SMESpec) else cast(EnvFile, found).spec)]


def _print_line(label: str, made: Any) -> None:
    notable = [*made.of("refused"), *made.of("warning")]
    why = ", ".join(f"{check.name} {check.value:.3g}" for check in notable)
    out().print(f"{mark(made.outcome)}  {escape(label)}  [dim]{why}[/]", soft_wrap=True)


def _print_certificate(label: str, made: Any) -> None:
    table = Table(title=f"Certificate of {escape(label)}", title_justify="left", box=None)
    for column in ("", "check"):
        table.add_column(column, no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("passes in", no_wrap=True)
    for check in made.checks:
        low = "" if check.low is None else f"≥ {check.low:.3g}"
        high = "" if check.high is None else f"≤ {check.high:.3g}"
        value = "" if check.value is None else f"{check.value:.3g}"
        bounds = ", ".join(filter(None, (low, high)))
        table.add_row(mark(check.outcome), f"[bold]{check.name}[/]", value, bounds)
    out().print(table)
    out().print()
    for check in made.checks:
        out().print(f"[bold]{check.name}[/]: {escape(check.meaning)}")
    out().print()
    refused = made.of("refused")
    if refused:
        reason = ", ".join(check.name for check in refused)
        err().print(f"[red]refused[/] for {reason}. Draw it with another seed, or change an axis.")
    elif made.outcome == "warning":
        err().print("[yellow]usable, but easy[/]: see the warnings above.")
    else:
        err().print("[green]passed[/]")

"""`sme new`, `suite`, `validate` and `certify`: files of tasks and suites, and what they draw."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from rich.markup import escape

from sme_registry import save
from sme_registry.cli.arguments import (
    ClassOptions,
    Force,
    Json,
    NewFile,
    check_document_path,
    find_any,
    json_or_text,
    kind_of,
    read_any,
    with_options,
)
from sme_registry.errors import OptionError, SMEError, UnknownNameError
from sme_registry.io import integer_in, read_json
from sme_registry.io.markup import plural
from sme_registry.io.terminal import CommandGroup, err, out, print_json, print_line, print_note
from sme_registry.spec import (
    EnvFile,
    ProtocolFile,
    SMESpec,
    StreamFile,
    StreamSpec,
    StudyFile,
    Suite,
    SuiteFile,
    catalogue,
)
from sme_registry.task import load
from sme_registry.task.certificate import MARKS, Certificate, short
from sme_registry.task.certificate import certify as certify_task
from sme_registry.task.loading import materialize_segments

_MOST_AGENTS = 2**12  # the spec allows far fewer; a list of billions would fill the memory
_NO_OPTION = ("schema_version", "team")
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", type(None): "JSON"}
_FORMS = {  # what a value looks like, where the field's description does not say it
    "policy_init": "'semi_orthogonal' or 'unit_variance'; ",
    "safety": "'{\"tightness\": 0.2}'; ",
    "observation": '\'{"distractors": 32, "dynamics": "driven", "mixing": "nonlinear", '
    '"mixing_depth": 1}\', where dynamics is noise, autonomous or driven, and mixing none, '
    "orthogonal or nonlinear; ",
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
        if name not in _NO_OPTION
    ],
    frozen=True,
    kw_only=True,
)
"""An option for each field of a spec that has a single value."""


@with_options(FieldOptions)
def new(
    path: NewFile,
    options: Any,
    team: Annotated[
        str | None,
        typer.Option(
            metavar="JSON|FILE",
            help='Agents of a team, as a .json file or as JSON: \'{"agents": [{"action_dim": 2, '
            '"observes": [0, 1]}, {"action_dim": 2}]}\'.',
        ),
    ] = None,
    agents: Annotated[
        int | None, typer.Option(help="A team of this many equal agents that observe all.")
    ] = None,
    channels_each: Annotated[
        int | None,
        typer.Option(help="Action channels of each of --agents; by default an equal share."),
    ] = None,
    team_reward: Annotated[
        str | None,
        typer.Option(
            help="individual, or team: each agent is rewarded for its own or for all channels."
        ),
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
      sme new sparse.json --from HardDeep --k 25 --description "Paid every 25 steps."
      sme new safe.json --safety '{"tightness": 0.2}' --policy-init unit_variance
      sme new sealed.json --seed 0x9f86d081884c7d659a2feaa0c55ad015
      sme new team.json --agents 4 --channels-each 2 --team-reward team
    """
    check_document_path(path, force=force)
    texts = dataclasses.asdict(options)
    fields = {name: json_or_text(text) for name, text in texts.items() if text is not None}
    start = SMESpec() if base is None else load(base, SMESpec)
    if team is not None and agents is not None:
        raise OptionError("--agents: --team already lists the agents. Give one or the other.")
    if channels_each is not None and agents is None:
        raise OptionError(f"--channels-each {channels_each}: needs --agents. Add it.")
    if team is not None:
        fields["team"] = read_json(team) if team.endswith(".json") else json_or_text(team)
    elif agents is not None:
        fields |= _equal_team(start, fields.get("action_dim"), agents, channels_each)
    if team_reward is not None:
        fields["team"] = _with_reward(start, fields.get("team"), team_reward)
    spec = start.derive(**fields)
    save(spec, path, name, description=description, tags=tuple(tag or ()))
    print_line(f"{escape(str(path))}  {spec.digest}")
    print_note(f"[dim]To check the draw: sme certify {escape(str(path))}[/]")


def _equal_team(
    start: SMESpec, action_dim: Any, agents: int, channels_each: int | None
) -> dict[str, Any]:
    integer_in("--agents", agents, 1)
    if channels_each is None:
        A = start.action_dim if action_dim is None else action_dim
        channels_each, remainder = divmod(A, agents) if isinstance(A, int) else (0, 0)
        if remainder or not channels_each:
            raise OptionError(
                f"--agents {agents}: action_dim={A} cannot be shared equally. Give "
                "--channels-each, or --team for unequal agents."
            )
    total = agents * channels_each
    if action_dim not in (None, total):
        raise OptionError(
            f"--agents {agents} --channels-each {channels_each}: give {total} action channels, "
            f"but --action-dim is {action_dim}. Leave it out."
        )
    members = [{"action_dim": channels_each}] * min(agents, _MOST_AGENTS)
    return {"team": {"agents": members}, "action_dim": total}


def _with_reward(start: SMESpec, team: Any, reward: str) -> dict[str, Any]:
    """The team, by default of the task to start from, with another reward."""
    if team is None and start.team is not None:
        team = start.team.to_dict()
    if not isinstance(team, dict):
        raise OptionError(f"--team-reward {reward}: needs a team. Add --agents or --team.")
    return {**team, "reward": reward}


class _NewByDefault(CommandGroup):
    """A group whose command `new` may be left out."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = args and args[0] in (*self.commands, *self.get_help_option_names(ctx))
        parsed: list[str] = super().parse_args(ctx, args if named or not args else ["new", *args])
        return parsed


suite = typer.Typer(
    cls=_NewByDefault,
    no_args_is_help=True,
    help="""Suites of your own: classes of tasks, each with several instances.

    Examples:

      sme suite new mine.json -t Default -t HardSparse --instances 5
      sme suite new more.json --suite smoke -t Complexity50
    """,
)


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
    leaderboards only if it has no streams. `sme suite FILE` is short for `sme suite new FILE`.

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
            print_line(line)
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
    specs = [entry for name in tasks for entry in _tasks(name)]
    certificates: list[tuple[str, Certificate]] = []
    for label, spec in specs:
        certificates.append((label, certify_task(spec, seed=seed)))
        if not json and len(specs) > 1:
            _print_outcome(*certificates[-1])
    if json:
        print_json(
            [{"task": label, **certificate.to_dict()} for label, certificate in certificates]
        )
    elif len(specs) == 1:
        _print_certificate(*certificates[0])
    if not all(certificate.passed for _, certificate in certificates):
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


def _print_outcome(label: str, certificate: Certificate) -> None:
    notable = [*certificate.of("refused"), *certificate.of("warning")]
    reasons = ", ".join(f"{check.name} {short(check.value)}".rstrip() for check in notable)
    print_line(f"{MARKS[certificate.outcome]}  {escape(label)}  [dim]{reasons}[/]")


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

"""`sme evaluate` and `diagnose`: how good a policy is, where its regret is, and why."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry import diagnosis, evaluation, explorer
from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Out,
    Protocol,
    SpecChanges,
    TaskName,
    can_draw,
    changes,
    load_changed,
    only_with,
    print_tables,
    print_written,
    with_options,
)
from sme_registry.diagnosis.figures import draw
from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, Policy, StreamReport
from sme_registry.evaluation.evaluate import acts_below_range
from sme_registry.evaluation.policies import TeamPolicy
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import check_new, integer_in, write_atomically
from sme_registry.io.terminal import Progress, err, print_json, print_note
from sme_registry.io.terminal import out as stdout
from sme_registry.plots.maps import STREAM
from sme_registry.plots.reports import write_evaluation, write_stream
from sme_registry.spec import (
    EnvFile,
    EvaluationProtocol,
    SMESpec,
    StreamSpec,
    catalogue,
)
from sme_registry.studies.subject import find_result, load_cell
from sme_registry.task import load

_EVALUATION = "evaluation.json"
_JSON, _PAGE = "diagnosis.json", "diagnosis.md"
_FORCE = "replaces what --out writes. Add --out, or leave it out"

app = typer.Typer()


def _complete_policy(incomplete: str) -> list[str]:
    return [name for name in POLICIES if name.startswith(incomplete)]


@app.command()
def evaluate(
    context: typer.Context,
    policies: Annotated[
        list[str],
        typer.Argument(
            metavar="POLICY",
            autocompletion=_complete_policy,
            help=f"A .zip, .onnx or .npz file, module:function, or {', '.join(POLICIES)}. "
            "On a stream: one, or one for each visit.",
        ),
    ],
    task: TaskName,
    protocol: Protocol = "paper-v1",
    out_folder: Out = None,
    action_range: ActionRange = None,
    set_: SpecChanges = None,
    all_: Annotated[
        bool, typer.Option("--all", help="All numbers, of all reference policies.")
    ] = False,
    force: Force = False,
    json: Json = False,
    algorithm: Annotated[
        str | None,
        typer.Option(
            metavar="CLASS",
            help="Class of a model's .zip that does not tell it: PPO, or sb3_contrib:TQC.",
        ),
    ] = None,
    initial: Annotated[
        str | None,
        typer.Option(metavar="POLICY", help="Of a stream: the policy before training."),
    ] = None,
    fresh: Annotated[
        list[str] | None,
        typer.Option(
            metavar="POLICY",
            help="Of a stream: an agent trained on one phase alone. Repeat it for each phase.",
        ),
    ] = None,
) -> None:
    """Evaluate a policy in and out of distribution, compared with reference policies.

    A function takes observations `[B, S + 2]` and returns actions `[B, A]`, in [0, 1] unless
    --action-range is symmetric; so does an .onnx network. A .zip can run code when it is loaded:
    use only files whose author you trust. For a team, give the one policy that all agents share, or
    a folder with one for each, such as agent_0.zip; on a stream, one for the end of each visit.

    Examples:

      sme evaluate linear Complexity10
      sme evaluate runs/demo/model.zip Default --out runs/demo-again
      sme evaluate actor.onnx Default --action-range symmetric
      sme evaluate mypolicy:act Default --protocol quick-v1 --json
      sme evaluate runs/Team4-independent-PPO-seed0/model Team4
      sme evaluate runs/life/snapshots/visit-*.zip Switch5
    """
    document = load_changed(task, changes(set_))
    resolved = evaluation.resolve_protocol(protocol)
    is_stream = isinstance(document, StreamSpec)
    target = None if out_folder is None else out_folder / (STREAM if is_stream else _EVALUATION)
    if target is not None:
        check_new(target, force=force)
    only_with(context, ("force",) if target is None else (), _FORCE)
    options: dict[str, Any] = {"action_range": action_range, "algorithm": algorithm}
    report: EvaluationReport | StreamReport
    policy: Policy | TeamPolicy | None = None
    if isinstance(document, StreamSpec):
        report = _on_stream(policies, document, resolved, options, initial, fresh)
    else:
        only_with(context, ("initial", "fresh"), f"is for streams, and {task!r} is a task")
        if len(policies) > 1:
            raise OptionError(
                f"{' '.join(policies):.80}: are {len(policies)} policies: must be one for the task "
                f"{task!r}. Only a stream needs one for each visit."
            )
        policy = evaluation.as_policy(policies[0], document, **options)
        with _progress(resolved) as progress:
            report = evaluation.evaluate(policy, document, resolved, progress=progress.update)
        if action_range is None and acts_below_range(policy, report):
            clipped = report.regions[0].clipped_share
            print_note(
                f"{clipped:.0%} of the actions in WD are outside [0, 1] and were clipped. If the "
                "policy's actions are in [−1, 1], add --action-range symmetric."
            )
    files = []
    if target is not None:
        files.append(report.write(target))
        if isinstance(report, StreamReport) and can_draw():
            files += write_stream(report, target.parent)
        elif isinstance(report, EvaluationReport) and can_draw():
            files += write_evaluation(report, target.parent, policy)
    if json:
        print_json(report.to_dict())
    else:
        print_tables(report.tables(details=all_))
    print_written(files)


def _progress(protocol: EvaluationProtocol) -> Progress:
    states = protocol.states_per_region * len(protocol.edges)
    return Progress("evaluating", states, unit="states", console=err())


def _on_stream(
    files: list[str],
    stream: StreamSpec,
    protocol: EvaluationProtocol,
    options: dict[str, Any],
    initial: str | None,
    fresh: list[str] | None,
) -> StreamReport:
    """The report of the policies at the ends of visits, or of one for the whole life."""
    stream.check_visits()
    if len(files) not in (1, stream.visits):
        raise OptionError(
            f"{len(files)} policies: must be one for the whole life, or {stream.visits}, one at "
            "the end of each visit."
        )
    policies: list[Any] = [*files]
    learns = len(policies) > 1
    if not learns:
        task, phases = stream.phases[0].spec, stream.observed_phases
        policy = evaluation.as_policy(files[0], task, observed_phases=phases, **options)
        policies = [policy] * stream.visits
    with _progress(protocol) as progress:
        report = evaluation.evaluate_stream(
            policies,
            stream,
            protocol,
            initial=initial,
            fresh=fresh,
            progress=progress.update,
            **options,
        )
    report = report.with_reference_regret(evaluation.reference_regret(stream))
    if not learns:
        report = report.with_dynamic_regret(evaluation.expected_regret(policies, stream))
    return report


@dataclass(frozen=True, kw_only=True)
class SubjectOptions:
    """Options that say what the argument of a command is: a run, a cell, a policy or a task."""

    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            "-t",
            help="The argument is a policy, for this task.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ] = None
    cell: Annotated[
        str | None,
        typer.Option(help="The argument is a study's folder; the start of a cell's key."),
    ] = None
    log: Annotated[
        Path | None,
        typer.Option(help="With --task, the episodes.csv of the policy's training."),
    ] = None
    action_range: ActionRange = None
    set_: SpecChanges = None

    def subject(self, what: str, *, or_task: bool = False) -> Any:
        """The policy on a task, the cell of a study, the run; or the spec of a task."""
        fields = changes(self.set_)
        if self.task is not None:
            if self.cell is not None:
                raise OptionError("--cell: names a cell of a study, --task a policy's task.")
            spec = load(self.task, SMESpec).derive(**fields)
            return diagnosis.load_policy(what, spec, action_range=self.action_range, log=self.log)
        if self.action_range is not None or self.log is not None:
            option = "--log" if self.action_range is None else "--action-range"
            raise OptionError(f"{option}: is of a policy with --task; a run has its own.")
        if self.cell is not None or Path(what).is_dir():
            if fields:
                raise OptionError("--set: changes the task of a policy. Add --task, or remove it.")
            if self.cell is not None:
                return load_cell(what, self.cell)
            return diagnosis.load_run(what)
        is_digest = what.startswith("sha256:")
        is_policy = what.endswith(catalogue.POLICY_SUFFIXES) or (":" in what and not is_digest)
        if is_policy or not or_task:
            raise OptionError(
                f"{what!r}: is not a folder. Give a folder of `sme train`; for a policy, add the "
                "task that it is for, such as --task Default."
            )
        return load(what, SMESpec).derive(**fields)

    def other(self, what: str, against: str) -> Any:
        """What --against names: like the argument, or a cell as STUDY:KEY or by its key."""
        if self.task is None and not Path(against).exists():
            study, colon, key = against.rpartition(":")
            if colon:
                return load_cell(study, key)
            if self.cell is not None:
                return load_cell(what, against)
        return replace(self, cell=None, log=None).subject(against)


_NOT_OF_EXPLORE = ("against", "probe_capacity", "states", "all_", "json")
_OF_EXPLORE = ("channels", "open_")


@app.command()
@with_options
def diagnose(
    context: typer.Context,
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN",
            help="A folder of `sme train`; with --cell, of a study; with --task, any policy; with "
            "--explore also a task.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ],
    explore: Annotated[
        bool,
        typer.Option("--explore", help="Instead write a page that shows the regret in any state."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output folder; with --explore, the .html file."),
    ] = None,
    all_: Annotated[
        bool,
        typer.Option("--all", help="Also what was ruled out, with its evidence, and all numbers."),
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="RUN2",
            help="Another run to compare with, such as one with another field: like RUN, or "
            "STUDY:KEY, a study's cell.",
        ),
    ] = None,
    probe_capacity: Annotated[
        bool,
        typer.Option(
            "--probe-capacity",
            help="Fit a network of the same layers to the optimal actions; takes under a minute.",
        ),
    ] = False,
    *,
    subject: SubjectOptions,
    force: Force = False,
    json: Json = False,
    states: Annotated[int, typer.Option(help="Uniform states to evaluate in.")] = 8192,
    episodes: Annotated[int, typer.Option(help="Episodes to evaluate.")] = 64,
    seed: Annotated[int, typer.Option(help="Seed of these states and start states.")] = 0,
    channels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="I,J",
            help="With --explore: two channels over which to sample a policy whose network is "
            "unknown; default 1,2. Repeatable.",
        ),
    ] = None,
    open_: Annotated[
        bool, typer.Option("--open", help="With --explore: open the page in a browser.")
    ] = False,
) -> None:
    """Show where a policy's regret occurs and what most likely causes it.

    What was found comes first, the largest share of the error at the top; --all shows the rest.
    Where the evidence does not separate causes, --against or --probe-capacity often help. With
    --out, it also writes diagnosis.json, diagnosis.md and figures.

    --explore writes one HTML file, which carries the networks and needs no connection. Loading a
    model's .zip can run code: use only files whose author you trust.

    Examples:

      sme diagnose runs/Default-TD3-seed0 --out runs/Default-TD3-seed0/diagnosis
      sme diagnose runs/k10 --against runs/k1 --probe-capacity
      sme diagnose actor.onnx --task Default --log runs/mine/episodes.csv
      sme diagnose runs/smoke --cell 3f2a91c4
      sme diagnose runs/demo --explore --open
      sme diagnose Complexity10 --explore
    """
    if explore:
        only_with(context, _NOT_OF_EXPLORE, "is not for --explore. Leave one of them out")
        page = _write_page(run, subject, out, channels, episodes, seed, force=force)
        if open_:
            typer.launch(page.absolute().as_uri())
        return
    only_with(context, _OF_EXPLORE, "is for --explore. Add --explore, or leave it out")
    if out is not None:
        check_new(out / _JSON, force=force)
    only_with(context, ("force",) if out is None else (), _FORCE)
    result = diagnosis.diagnose(
        subject.subject(run),
        against=None if against is None else subject.other(run, against),
        probe_capacity=probe_capacity,
        states=states,
        episodes=episodes,
        seed=seed,
        progress=lambda what: err().print(escape(what), style="dim", soft_wrap=True),
    )
    if json:
        print_json(result.to_dict())
    else:
        for part in result.terminal(details=all_):
            stdout().print(part)
    if out is None:
        return
    figures = draw(result, out) if can_draw() else ()
    names = [path.name for path in figures if path.suffix == ".png"]
    text = result.markdown(names, details=all_)
    # The data last, so that the other files exist once it does.
    written = write_atomically(out / _PAGE, text)
    data = result.write(out / _JSON)
    print_written([*figures, written, data])


def _write_page(
    what: str,
    options: SubjectOptions,
    out: Path | None,
    channels: list[str] | None,
    episodes: int,
    seed: int,
    *,
    force: bool,
) -> Path:
    integer_in("--episodes", episodes, 1, 10_000)
    pairs = [_channels(text) for text in channels or ()]
    target = _target(what, options, out, force=force)
    subject = options.subject(what, or_task=True)
    report = None
    if options.cell is not None:
        report = find_result(what, options.cell).report
    elif options.task is None and not isinstance(subject, SMESpec):
        report = explorer.run_report(what)
    written = explorer.write_explorer(
        target, subject, report=report, channels=pairs, episodes=episodes, seed=seed
    )
    print_written([written])
    return written


def _target(what: str, options: SubjectOptions, out: Path | None, *, force: bool) -> Path:
    """The file to write; that in a run's folder follows from the run and may be replaced."""
    task, cell = options.task, options.cell
    if out is not None:
        if out.suffix != ".html":
            raise OptionError(f"--out {out}: must end in .html.")
        return check_new(out, force=force)
    if task is None and cell is None and Path(what).is_dir():
        return Path(what) / explorer.FILE
    is_file = os.sep in what or what.endswith(catalogue.POLICY_SUFFIXES)
    name = Path(what).name if is_file else what
    label = "".join(c if c.isalnum() or c in "-_" else "-" for c in name.removesuffix(".json"))
    if cell is not None:
        label += f"-{cell[:12]}"
    return check_new(Path(f"{label}-explorer.html"), force=force)


def _channels(text: str) -> tuple[int, int]:
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise OptionError(f"--channels {text}: must be two channels, such as --channels 1,2.")
    return int(parts[0]), int(parts[1])

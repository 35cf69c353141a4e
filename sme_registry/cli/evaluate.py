"""`sme evaluate`: a policy on a task, or the policies of a life on a stream."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from sme_registry import evaluation
from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Out,
    Protocol,
    SpecChanges,
    can_draw,
    changed,
    changes,
    only_with,
    print_tables,
    print_written,
)
from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, Policy, StreamReport, TeamPolicy
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import check_new
from sme_registry.io.terminal import Progress, err, print_json
from sme_registry.plots.maps import STREAM
from sme_registry.plots.reports import write_evaluation, write_stream
from sme_registry.spec import (
    EnvFile,
    EvaluationProtocol,
    StreamFile,
    StreamSpec,
    catalogue,
)
from sme_registry.task import load

_EVALUATION = "evaluation.json"


def _complete_policy(incomplete: str) -> list[str]:
    return [name for name in POLICIES if name.startswith(incomplete)]


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
    task: Annotated[
        str,
        typer.Argument(
            metavar="TASK",
            help="The task or stream: a name, a path or a digest.",
            autocompletion=catalogue.completion(EnvFile, StreamFile),
        ),
    ],
    protocol: Protocol = "paper-v1",
    out_folder: Out = None,
    action_range: ActionRange = None,
    set_: SpecChanges = None,
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
    force: Force = False,
    json: Json = False,
) -> None:
    """Evaluate a policy in and out of distribution, compared with reference policies.

    A function takes observations `[B, S + 2]`, with m distractors `[B, S + m + 2]`, and returns
    actions `[B, A]`, in [0, 1] unless --action-range is symmetric; so does an .onnx network. A .zip
    of Stable-Baselines3 can run code when it is loaded: use only files whose author you trust.

    For a team, give a folder with the policy of each agent, such as agent_0.zip, or the one policy
    that all agents share. That one is called for each agent with `[B, S + 2 + n]`: the state with
    unobserved channels set to 0, t/T, the agent's r_cum/k, and its one-hot index.

    On a stream, give the policy at the end of each visit, or one policy for the whole life, which
    learns nothing: its expected dynamic regret is reported as well.

    Examples:

      sme evaluate linear Complexity10
      sme evaluate runs/demo/model.zip Default --out runs/demo-again
      sme evaluate actor.onnx Default --action-range symmetric
      sme evaluate mypolicy:act Default --protocol quick-v1 --json
      sme evaluate runs/Team4-PPO-seed0/model.zip Team4
      sme evaluate runs/Team4-independent-PPO-seed0/model Team4
      sme evaluate runs/life/snapshots/visit-*.zip Switch5 --initial runs/life/snapshots/initial.zip
    """
    document = changed(load(task), task, changes(set_))
    resolved = evaluation.resolve_protocol(protocol)
    is_stream = isinstance(document, StreamSpec)
    target = None if out_folder is None else out_folder / (STREAM if is_stream else _EVALUATION)
    if target is not None:
        check_new(target, force=force)
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
            report = evaluation.evaluate(policy, document, resolved, progress=progress.update_of)
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
        print_tables(report.tables())
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
            progress=progress.update_of,
            **options,
        )
    report = report.with_reference_regret(evaluation.reference_regret(stream))
    if not learns:
        report = report.with_dynamic_regret(evaluation.expected_regret(policies, stream))
    return report

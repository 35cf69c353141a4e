"""`sme evaluate`: a policy on a task, or the policies of a life on a stream."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

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
    print_tables,
    print_written,
)
from sme_registry.errors import OptionError
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import check_new
from sme_registry.io.terminal import Progress, err, print_json
from sme_registry.spec import (
    EnvFile,
    EvaluationProtocol,
    SMESpec,
    StreamFile,
    StreamSpec,
    catalogue,
)
from sme_registry.task import load


def _complete_policy(incomplete: str) -> list[str]:
    return [name for name in POLICIES if name.startswith(incomplete)]


def evaluate(
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

    With --out, it also writes evaluation.json (of a stream stream.json) and figures.

    A function takes observations `[B, S + 2]`, with m distractors `[B, S + m + 2]`, and returns
    actions `[B, A]`, in [0, 1] unless --action-range is symmetric; so does an .onnx network. A .zip
    of Stable-Baselines3 can run code when it is loaded: use only files whose author you trust.

    For a team, give a folder with the policy of each agent, such as agent_0.zip, from the agent's
    own observations; or the one policy that all agents share. That one is called for each agent
    with the shared observation `[B, S + 2 + n]`: the state with unobserved channels set to 0, t/T,
    the agent's r_cum/k, and its one-hot index. It returns `[B, C]`, C being the most channels that
    an agent owns. The report then includes each agent.

    On a stream, give the policy at the end of each visit, or one policy for the whole life. That
    one learns nothing, and its expected dynamic regret is reported as well. On a stream with a
    single visit, a policy is taken for one that learns nothing: what its training cost is in the
    stream.json of sme train. A reference policy, such as linear, is that of phase 0.

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
    given = _Policies(policies, initial, fresh, action_range, algorithm)
    _check_number(given, task, document)
    from sme_registry import evaluation
    from sme_registry.plots.streams import FILE

    resolved = evaluation.resolve_protocol(protocol)
    name = FILE if isinstance(document, StreamSpec) else "evaluation.json"
    target = None if out_folder is None else out_folder / name
    if target is not None:
        check_new(target, force=force)
    if isinstance(document, StreamSpec):
        report, draw = _on_stream(given, document, resolved)
    else:
        report, draw = _on_task(given, document, resolved)
    files = []
    if target is not None:
        files = [report.write(target), *(draw(target.parent) if can_draw() else ())]
    if json:
        print_json(report.to_dict())
    else:
        print_tables(report.tables())
    print_written(files)


# A report, and what draws its figures into a folder.
_Evaluated = tuple[Any, Callable[[Path], list[Path]]]


class _Policies(NamedTuple):
    """The policies, as the command line has them; `initial` and `fresh` only of a stream."""

    policies: list[str]
    initial: str | None
    fresh: list[str] | None
    action_range: str | None
    algorithm: str | None

    def options(self) -> dict[str, Any]:
        """How their files are read."""
        return {"action_range": self.action_range, "algorithm": self.algorithm}


def _check_number(given: _Policies, task: str, document: SMESpec | StreamSpec) -> None:
    number = len(given.policies)
    if isinstance(document, StreamSpec):
        document.check_visits()
        if number not in (1, document.visits):
            raise OptionError(
                f"{number} policies: must be one for the whole life, or {document.visits}, one at "
                "the end of each visit."
            )
        return
    if number > 1:
        raise OptionError(
            f"{' '.join(given.policies):.80}: are {number} policies: must be one for the task "
            f"{task!r}. Only a stream needs one for each visit."
        )
    for option, value in (("--initial", given.initial), ("--fresh", given.fresh)):
        if value:
            raise OptionError(f"{option}: is for streams, and {task!r} is a task. Leave it out.")


def _progress(protocol: EvaluationProtocol) -> Progress:
    states = protocol.states_per_region * len(protocol.edges)
    return Progress("evaluating", states, unit="states", console=err())


def _on_task(given: _Policies, spec: SMESpec, protocol: EvaluationProtocol) -> _Evaluated:
    from sme_registry import evaluation

    policy = evaluation.as_policy(given.policies[0], spec, **given.options())
    with _progress(protocol) as progress:
        report = evaluation.evaluate(policy, spec, protocol, progress=progress.update_of)

    def draw(folder: Path) -> list[Path]:
        from sme_registry.plots.files import write_evaluation

        return write_evaluation(report, folder, policy)

    return report, draw


def _on_stream(given: _Policies, stream: StreamSpec, protocol: EvaluationProtocol) -> _Evaluated:
    from sme_registry import evaluation

    policies: list[Any] = [*given.policies]
    learns = len(policies) > 1
    if not learns:
        task, phases = stream.phases[0].spec, stream.observed_phases
        policy = evaluation.as_policy(policies[0], task, observed_phases=phases, **given.options())
        policies = [policy] * stream.visits
    with _progress(protocol) as progress:
        report = evaluation.evaluate_stream(
            policies,
            stream,
            protocol,
            initial=given.initial,
            fresh=given.fresh,
            progress=progress.update_of,
            **given.options(),
        )
    report = report.with_reference_regret(evaluation.reference_regret(stream))
    if not learns:
        report = report.with_dynamic_regret(evaluation.expected_regret(policies, stream))

    def draw(folder: Path) -> list[Path]:
        from sme_registry.plots.files import write_stream

        return write_stream(report, folder)

    return report, draw

"""`sme evaluate`: evaluate a policy in and out of distribution."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Out,
    Protocol,
    SpecChanges,
    changed,
    changes,
)
from sme_registry.cli.evaluate_stream import Life, evaluate_life
from sme_registry.cli.files import can_draw, print_tables, print_written
from sme_registry.errors import OptionError
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import refuse_existing
from sme_registry.io.terminal import Progress, err, print_json
from sme_registry.spec import EnvFile, StreamFile, StreamSpec, catalogue
from sme_registry.task import load_document


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
    document = changed(load_document(task), task, changes(set_))
    if isinstance(document, StreamSpec):
        life = Life(policies, initial, fresh, action_range, algorithm)
        evaluate_life(life, document, protocol, out_folder, force=force, json=json)
        return
    policy = _alone(policies, initial, fresh, task)
    from sme_registry import evaluation

    resolved = evaluation.resolve_protocol(protocol)
    target = None if out_folder is None else out_folder / "evaluation.json"
    if target is not None:
        refuse_existing(target, force=force)
    prepared = evaluation.as_policy(
        policy, document, action_range=action_range, algorithm=algorithm
    )
    states = resolved.states_per_region * len(resolved.edges)
    with Progress("evaluating", states, unit="states", console=err()) as progress:
        report = evaluation.evaluate(prepared, document, resolved, progress=progress.update_of)
    files = [] if target is None else [report.write(target), *_figures(report, prepared, target)]
    if json:
        print_json(report.to_dict())
    else:
        print_tables(report.tables())
    print_written(files)


def _alone(policies: list[str], initial: str | None, fresh: list[str] | None, task: str) -> str:
    """The one policy for a single task.

    Raises:
      OptionError: several, or one that only a stream needs.
    """
    if len(policies) > 1:
        raise OptionError(
            f"{' '.join(policies):.80}: are {len(policies)} policies: must be one for the task "
            f"{task!r}. Only a stream needs one for each visit."
        )
    for option, value in (("--initial", initial), ("--fresh", fresh)):
        if value:
            raise OptionError(f"{option}: is for streams, and {task!r} is a task. Leave it out.")
    return policies[0]


def _figures(report: Any, policy: Any, target: Path) -> list[Path]:
    if not can_draw():
        return []
    from sme_registry.plots.files import write_evaluation

    return write_evaluation(report, target.parent, policy)

"""`sme evaluate` and `sme train`."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from rich.markup import escape

from sme_registry import load
from sme_registry.cli import names
from sme_registry.errors import OptionError
from sme_registry.evaluation.references import POLICIES
from sme_registry.spec import SMESpec
from sme_registry.terminal.output import err, out, print_json

TaskName = Annotated[str, typer.Argument(metavar="TASK", help="A name, a path, or a digest.")]
Protocol = Annotated[
    str, typer.Option(help="Where it is evaluated: a name of `sme list`, or a path.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Change a spec field; repeatable."),
]


def evaluate(
    policy: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help=f"A .zip, .onnx or .npz, module:function, or {', '.join(POLICIES)}.",
        ),
    ],
    task: TaskName,
    protocol: Protocol = "paper-v1",
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for evaluation.json and the figures.")
    ] = None,
    action_range: Annotated[
        str | None, typer.Option(help="unit or symmetric; by default a model's own, else unit.")
    ] = None,
    set_: Overrides = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an evaluation that is there.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="The report as JSON.")] = False,
) -> None:
    """Judge a policy within and out of distribution, beside policies that know nothing or all.

    A function takes observations `[B, S + 2]` and returns actions `[B, A]`. A .zip of
    Stable-Baselines3 is code: open only those whose author you trust. An .onnx file's network is
    as a function: in the unit range, unless --action-range says otherwise.

    A team's function or file is the policy that all agents share: it is asked for each agent in
    turn, with its shared observation `[B, S + 2 + n]` (the state with what the agent does not
    observe set to 0, t/T, its r_cum/k, the one-hot of the agent), and returns `[B, max a_i]`.
    The report has each agent, too.

    Examples:

      sme evaluate linear Complexity10

      sme evaluate runs/demo/model.zip Default --out runs/demo-again

      sme evaluate actor.onnx Default --action-range symmetric

      sme evaluate mypolicy:act Default --protocol quick-v1 --json

      sme evaluate runs/Team4-PPO-seed0/model.zip Team4
    """
    from sme_registry import evaluation
    from sme_registry.terminal.progress import Progress

    spec = load(task).derive(**names.overrides(set_ or []))
    judged_by = evaluation.resolve_protocol(protocol)
    target = None if out_folder is None else out_folder / "evaluation.json"
    if target is not None and target.exists() and not force:
        raise OptionError(f"{target}: is there already. Give another --out, or --force.")
    prepared = evaluation.as_policy(policy, spec, action_range=action_range)
    states = judged_by.states_per_region * len(judged_by.edges)
    with Progress("evaluating", states, unit="states", console=err()) as progress:
        report = evaluation.evaluate(
            prepared,
            spec,
            judged_by,
            progress=lambda done, total: progress.update(done),
        )
    written = [] if target is None else [report.write(target), *_figures(report, prepared, target)]
    if json:
        print_json(report.to_dict())
    else:
        out().print(report.table())
    _say_where(written)


def _figures(report: Any, policy: Any, target: Path) -> list[Path]:
    if importlib.util.find_spec("matplotlib") is None:
        err().print("no figures: matplotlib is not installed (pip install 'sme-registry\\[plot]')")
        return []
    from sme_registry import plots

    figures = [plots.decay_curve(report, target.with_name("decay_curve.png"))]
    if report.spec.state_dim == 2 and report.spec.team is None:
        path = target.with_name("similarity_map.png")
        figures.append(
            plots.similarity_map(
                policy,
                report.spec,
                path,
                action_range=report.action_range,
                name=report.policy,
            )
        )
    return figures


def _say_where(written: list[Path]) -> None:
    for path in written:
        err().print(f"wrote {escape(str(path))}", soft_wrap=True)


def train(
    task: TaskName,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm", "-a", help="TD3, SAC, DDPG, PPO or A2C; by default TD3, of a team PPO."
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option("--steps", "-n", help="Steps of the environment; of a team, the team's.")
    ] = 20_000,
    seed: Annotated[int, typer.Option(help="Of the algorithm and of the starts.")] = 0,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="By default `runs/<task>-<algorithm>-seed<seed>`."),
    ] = None,
    action_range: Annotated[
        str, typer.Option(help="symmetric, [-1, 1], or unit, [0, 1].")
    ] = "symmetric",
    num_envs: Annotated[
        int | None,
        typer.Option(
            help="Environments (teams) at once; off-policy, more mean fewer updates. By default 1, "
            "of a team on-policy 8."
        ),
    ] = None,
    protocol: Protocol = "paper-v1",
    set_: Overrides = None,
    checkpoint_every: Annotated[
        int | None, typer.Option(help="Steps; by default a twentieth of all, at least 1,000.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a run that was stopped or killed.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the run in the folder.")] = False,
    json: Annotated[bool, typer.Option("--json", help="The run and its report as JSON.")] = False,
) -> None:
    """Train an algorithm of Stable-Baselines3, log the exact regret of each episode, evaluate it.

    SB3's default hyperparameters, on the CPU, one thread (these networks are too small to share).
    PPO and A2C finish their last rollout. The folder holds episodes.csv, checkpoint.zip,
    model.zip, run.json, evaluation.json, figures, and what TensorBoard reads.

    The agents of a team share one policy (its shared observation: `sme evaluate --help`).
    episodes.csv then has the team's mean and a column regret/<agent> for each. A step is one
    of the whole team, so the algorithm sees as many transitions as there are agents; SB3's own
    count, on TensorBoard's axis, is of those. PPO collects its 2,048 transitions over all agents
    of all teams together, not 2,048 from each: run.json says n_steps.

    --resume goes on from the last checkpoint, with the same networks, optimisers, replay buffer
    and step count. It is not the uninterrupted run to the bit: random streams are seeded anew, and
    episodes that were under way begin again.

    Examples:

      sme train Default --steps 20000 --seed 1

      sme train Default -a PPO -n 100000 --num-envs 8 --set complexity=10

      sme train mine.json --out runs/mine --resume

      sme train Team4 --steps 40000
    """
    from sme_registry import training

    changed = names.overrides(set_ or [])
    spec = load(task).derive(**changed)
    algorithm = training.known_algorithm(algorithm or training.default_algorithm(spec))
    if out_folder is None:
        out_folder = Path("runs") / f"{_label(task, spec, bool(changed))}-{algorithm}-seed{seed}"
    try:
        result = training.train(
            spec,
            algorithm=algorithm,
            steps=steps,
            seed=seed,
            folder=out_folder,
            action_range=cast(Any, action_range),
            num_envs=num_envs,
            checkpoint_every=checkpoint_every,
            protocol=protocol,
            console=err(),
            resume=resume,
            force=force,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(how_to_go_on(out_folder)) from None
    if json:
        report = result.report.to_dict()
        print_json(
            {"folder": str(out_folder), "run": result.record.to_dict(), "evaluation": report}
        )
        return
    out().print(result.report.table())
    out().print(f"everything is in {escape(str(out_folder))}{os.sep}", soft_wrap=True)


def _label(task: str, spec: SMESpec, changed: bool) -> str:
    """A folder's name for a task: its own name where it has one, else its content's."""
    if changed or task.startswith("sha256"):
        return spec.content_name
    return Path(task).name.removesuffix(".json").removesuffix("-v1")


def how_to_go_on(folder: Path) -> str:
    """What to do after an interrupted training."""
    from sme_registry.training import RunRecord

    record = RunRecord.read(folder)
    if record is None:
        return "interrupted before the training began: nothing was written."
    from sme_registry.training.checkpoint import FILE

    kept = "up to its last checkpoint" if (folder / FILE).exists() else "and holds no checkpoint"
    return (
        f"interrupted: the run is in {folder}, {kept}. Run the same command with --resume "
        "to go on, or with --force to begin anew."
    )

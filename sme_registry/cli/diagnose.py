"""`sme diagnose`: locate a policy's regret, and find likely causes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from sme_registry import SMESpec, load
from sme_registry.cli.arguments import (
    ActionRange,
    Force,
    Json,
    Out,
    SpecChanges,
    can_draw,
    changes,
    print_written,
)
from sme_registry.errors import OptionError
from sme_registry.io import check_new, to_json, write_atomically
from sme_registry.io.terminal import err, out, print_json
from sme_registry.spec import EnvFile, catalogue

if TYPE_CHECKING:
    from sme_registry.diagnosis import AnySubject

_JSON, _PAGE = "diagnosis.json", "diagnosis.md"


def diagnose(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN",
            help="A folder of `sme train`; with --cell, of a study; with --task, any policy.",
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            "-t",
            help="RUN is a policy, for this task.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="RUN is a study's folder; the start of a cell's key.")
    ] = None,
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
    log: Annotated[
        Path | None,
        typer.Option(help="With --task, the episodes.csv of the policy's training."),
    ] = None,
    out_folder: Out = None,
    action_range: ActionRange = None,
    set_: SpecChanges = None,
    states: Annotated[int, typer.Option(help="Uniform states to evaluate in.")] = 8192,
    episodes: Annotated[int, typer.Option(help="Episodes to evaluate.")] = 64,
    seed: Annotated[int, typer.Option(help="Seed of these states and start states.")] = 0,
    all_: Annotated[
        bool,
        typer.Option("--all", help="Also what was ruled out, with its evidence, and all numbers."),
    ] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Show where a policy's regret occurs and what most likely causes it. Takes seconds.

    Where: by action channel, state region, distance out of distribution, and time in the episode.
    Likely causes: exploration, credit assignment (k), sparse reward (r_min), capacity (L),
    dimension, survival (D), and budget. The answer is "cannot tell" if the evidence does not
    separate causes; --against or --probe-capacity then often help. What was found comes first, the
    largest share of the error at the top; --all shows the rest. With --out, it also writes
    diagnosis.json, diagnosis.md and figures.

    On a task with limits or distractors, it also shows whether the policy violates the limits and
    earns by it, and how much of its regret is owed to the distractors.

    Of a team, it shows who is to blame for the team's regret, and where each agent's own error is.
    Of a life in a stream, it shows which phases were costly, forgotten or never learnt, whether
    plasticity was lost, and the state of the network after each visit.

    Loading a model's .zip can run code: use only files whose author you trust.

    Examples:

      sme diagnose runs/Default-TD3-seed0 --out runs/Default-TD3-seed0/diagnosis

      sme diagnose runs/k10 --against runs/k1 --probe-capacity

      sme diagnose mypolicy:act --task Complexity10

      sme diagnose actor.onnx --task Default --log runs/mine/episodes.csv

      sme diagnose runs/smoke --cell 3f2a91c4

      sme diagnose runs/Team4-PPO-seed0 --out runs/Team4-PPO-seed0/diagnosis

      sme diagnose runs/Switch5-PPO-seed0 --out runs/Switch5-PPO-seed0/diagnosis
    """
    from sme_registry import diagnosis

    if out_folder is not None:
        check_new(out_folder / _JSON, force=force)
    if set_ and task is None:
        raise OptionError("--set: changes the task of a policy. Add --task.")
    check_policy_options(task, action_range, log)
    subject = _subject(run, task, cell, set_, action_range, log)
    other = None
    if against is not None:
        other = _other_cell(run, task, cell, against) or _subject(
            against, task, None, set_, action_range
        )
    result = diagnosis.diagnose(
        subject,
        against=other,
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
            out().print(part)
    if out_folder is None:
        return
    figures: tuple[Path, ...] = ()
    if can_draw():
        from sme_registry.diagnosis.figures import draw

        figures = draw(result, out_folder, subject)
    names = [path.name for path in figures if path.suffix == ".png"]
    text = result.markdown(names, details=all_)
    # The data last, so that the other files exist once it does.
    written = write_atomically(out_folder / _PAGE, text)
    data = write_atomically(out_folder / _JSON, to_json(result.to_dict()))
    print_written([*figures, written, data])


def _subject(
    run: str,
    task: str | None,
    cell: str | None,
    set_: list[str] | None,
    action_range: str | None,
    log: Path | None = None,
) -> AnySubject:
    """The run, cell or policy that the arguments name."""
    is_policy = Path(run).is_file() or ":" in run or os.sep not in run
    if task is None and cell is None and is_policy and not Path(run).is_dir():
        raise OptionError(
            f"run={run!r}: is not a folder. Give a folder of `sme train`; for a policy, add the "
            "task it is for, such as --task Default."
        )
    name = run if os.sep not in run else None
    return load_subject(run, task, cell, set_, action_range, log, name)


def check_policy_options(task: str | None, action_range: str | None, log: Path | None) -> None:
    """Refuse options of a policy where there is none."""
    if task is None and action_range is not None:
        raise OptionError("--action-range: applies to a policy with --task; a run records its own.")
    if task is None and log is not None:
        raise OptionError("--log: is the log of a policy with --task; a run has its own.")


def load_subject(
    what: str,
    task: str | None,
    cell: str | None,
    set_: list[str] | None,
    action_range: str | None,
    log: Path | None,
    name: str | None = None,
) -> AnySubject:
    """A policy on a task, a cell of a study or a run; `name` is of the policy."""
    from sme_registry import diagnosis

    if cell is not None and task is not None:
        raise OptionError("--cell: names a cell of a study, --task a policy's task. Give one.")
    if task is not None:
        spec = load(task, SMESpec).derive(**changes(set_))
        return diagnosis.load_policy(what, spec, action_range=action_range, name=name, log=log)
    if cell is not None:
        return diagnosis.load_cell(what, cell)
    return diagnosis.load_run(what)


def _other_cell(run: str, task: str | None, cell: str | None, against: str) -> AnySubject | None:
    """The cell that --against names, as STUDY:KEY or as a key of the same study; else None."""
    from sme_registry import diagnosis

    if task is not None or Path(against).exists():
        return None
    study, colon, key = against.rpartition(":")
    if colon:
        return diagnosis.load_cell(study, key)
    return None if cell is None else diagnosis.load_cell(run, against)

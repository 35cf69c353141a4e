"""`sme diagnose`: where the regret of a run sits, and what the evidence says about why."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from sme_registry import load
from sme_registry.cli import names
from sme_registry.errors import OptionError
from sme_registry.io import to_json, write_atomically
from sme_registry.terminal.output import err, out, print_json

if TYPE_CHECKING:
    from sme_registry.diagnosis import Diagnosis, Subject

_JSON, _PAGE = "diagnosis.json", "diagnosis.md"


def diagnose(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN",
            help="A folder of `sme train`; a study's with --cell; or any policy with --task.",
        ),
    ],
    task: Annotated[
        str | None, typer.Option("--task", "-t", help="RUN is a policy, for this task.")
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="RUN is a study's folder; the first digits of a cell's key.")
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="RUN2",
            help="Another run, such as one with a single axis changed. Of the same form as RUN; "
            "STUDY:KEY names a study's cell.",
        ),
    ] = None,
    probe_capacity: Annotated[
        bool,
        typer.Option(
            "--probe-capacity",
            help="Fit a network of the same layers to the optimal actions; tens of seconds.",
        ),
    ] = False,
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help=f"Folder for {_JSON}, {_PAGE} and figures.")
    ] = None,
    action_range: Annotated[
        str | None, typer.Option(help="Of a policy: unit or symmetric; by default a model's own.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Change a field of --task; repeatable."),
    ] = None,
    states: Annotated[int, typer.Option(help="Uniform states to ask it in.")] = 8192,
    episodes: Annotated[int, typer.Option(help="Episodes to follow it through.")] = 64,
    seed: Annotated[int, typer.Option(help="Of these states and starts.")] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a diagnosis that is in --out.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="The diagnosis as JSON.")] = False,
) -> None:
    """Say where a run's regret sits, and what the evidence says about why. Seconds.

    Where: by action channel, state region, shell, time in the episode, and what the error is made
    of. Why: exploration, credit assignment (k), sparsity (r_min), capacity (L), dimension, survival
    (D), budget. "cannot tell" where the evidence does not separate causes; --against and
    --probe-capacity are what most often would. A model's .zip is code: open only those whose author
    you trust.

    Examples:

      sme diagnose runs/Default-TD3-seed0 --out runs/Default-TD3-seed0/diagnosis

      sme diagnose runs/k10 --against runs/k1 --probe-capacity

      sme diagnose mypolicy:act --task Complexity10

      sme diagnose runs/smoke --cell 3f2a91c4
    """
    from sme_registry import diagnosis

    if out_folder is not None and (out_folder / _JSON).exists() and not force:
        raise OptionError(
            f"{out_folder / _JSON}: is there already. Give another --out, or --force."
        )
    if set_ and task is None:
        raise OptionError("--set: changes the task of a policy, so it needs --task. Add it.")
    if action_range and task is None:
        raise OptionError("--action-range: is of a policy with --task; a run's is in its record.")
    subject = _subject(run, task, cell, set_, action_range)
    other = None
    if against is not None:
        study, colon, key = against.rpartition(":")
        if task is None and colon and not Path(against).exists():
            other = diagnosis.load_cell(study, key)
        elif task is None and cell is not None and not Path(against).exists():
            other = diagnosis.load_cell(run, against)
        else:
            other = _subject(against, task, None, set_, action_range)
    found = diagnosis.diagnose(
        subject,
        against=other,
        probe_capacity=probe_capacity,
        states=states,
        episodes=episodes,
        seed=seed,
        progress=lambda what: err().print(escape(what), style="dim", soft_wrap=True),
    )
    if json:
        print_json(found.to_dict())
    else:
        from sme_registry.diagnosis.render import terminal

        for part in terminal(found):
            out().print(part)
    if out_folder is not None:
        for path in _write(found, subject, out_folder):
            err().print(f"wrote {escape(str(path))}", soft_wrap=True)


def _subject(
    run: str, task: str | None, cell: str | None, set_: list[str] | None, action_range: str | None
) -> Subject:
    from sme_registry import diagnosis

    if cell is not None and task is not None:
        raise OptionError("--cell: is of a study, and --task of a policy. Give one of them.")
    if task is not None:
        spec = load(task).derive(**names.overrides(set_ or []))
        shown = run if os.sep not in run else None
        return diagnosis.load_policy(run, spec, action_range=action_range, name=shown)
    if cell is not None:
        return diagnosis.load_cell(run, cell)
    if not Path(run).is_dir() and (Path(run).is_file() or ":" in run or os.sep not in run):
        raise OptionError(
            f"run={run!r}: is no folder. Give one that `sme train` wrote, or with a policy the "
            "task that it is for, as in --task Default."
        )
    return diagnosis.load_run(run)


def _write(found: Diagnosis, subject: Subject, folder: Path) -> list[Path]:
    from sme_registry.diagnosis.render import markdown

    figures: tuple[Path, ...] = ()
    if importlib.util.find_spec("matplotlib") is None:
        err().print("no figures: matplotlib is not installed (pip install 'sme-registry\\[plot]')")
    else:
        from sme_registry.diagnosis.figures import draw

        figures = draw(found, folder, subject.log)
    page = write_atomically(folder / _PAGE, markdown(found, [path.name for path in figures]))
    # Last: whoever finds it finds all the others, too.
    data = write_atomically(folder / _JSON, to_json(found.to_dict()))
    return [*figures, page, data]

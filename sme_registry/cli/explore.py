"""`sme explore`: one HTML file in which a reader explores a task, or a policy on it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sme_registry.cli.arguments import ActionRange, Force, SpecChanges, changes, print_written
from sme_registry.cli.diagnose import check_policy_options, load_subject
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io import check_new, integer_in
from sme_registry.spec import EnvFile, SMESpec, catalogue
from sme_registry.task import load

if TYPE_CHECKING:
    from sme_registry.diagnosis import AnySubject

_POLICY_FILES = (".zip", ".onnx", ".npz")


def explore(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="A folder of `sme train`; a task, by name, path or digest; with --task, any "
            "policy; with --cell, a study.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            "-t",
            help="WHAT is a policy, for this task.",
            autocompletion=catalogue.completion(EnvFile),
        ),
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="WHAT is a study's folder; the start of a cell's key.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="The .html file. Default explorer.html in a run's folder, else "
            "NAME-explorer.html here.",
        ),
    ] = None,
    channels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="I,J",
            help="Two channels over which to sample a policy whose network is unknown; default "
            "1,2. Repeatable.",
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="With --task, the episodes.csv of the policy's training."),
    ] = None,
    action_range: ActionRange = None,
    set_: SpecChanges = None,
    episodes: Annotated[int, typer.Option(help="Episodes for the regret over time.")] = 64,
    seed: Annotated[int, typer.Option(help="Seed of their start states.")] = 0,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    force: Force = False,
) -> None:
    """Write one HTML file that shows regret in any state, in and beyond the training cube.

    A map shows the regret over any two channels, with a slider for each of the others; beside it
    the optimal and the chosen action, the regret over an episode and, of a run, its learning curve,
    its evaluation and what its layers keep. The file carries the networks and computes them in the
    browser: it needs no network connection and no installation.

    Networks are known of Stable-Baselines3's models with MlpPolicy, of our agents in JAX, of
    offline policies (.npz), and of PyTorch modules and ONNX files of feed-forward layers. Any other
    policy is sampled over the channels of --channels, and the other sliders are off.

    Of a task alone, the page shows the optimal policy, and the regret of a linear and of a constant
    policy. Loading a model's .zip can run code: use only files whose author you trust.

    Examples:

      sme explore runs/demo --open

      sme explore Complexity10

      sme explore actor.onnx --task Default

      sme explore mypolicy:act --task Complexity10 --channels 1,2 --channels 3,7

      sme explore runs/smoke --cell 3f2a91c4 --out cell.html
    """
    integer_in("--episodes", episodes, 1, 10_000)
    pairs = [_channels(text) for text in channels or ()]
    target = _target(what, task, cell, out, force=force)
    check_policy_options(task, action_range, log)
    _check_kind(task, set_, what)
    from sme_registry import explorer

    shown = _shown(what, task, cell, set_, action_range, log)
    is_run = not isinstance(shown, SMESpec) and task is None
    written = explorer.write_explorer(
        target,
        shown,
        report=explorer.run_report(what, cell) if is_run else None,
        channels=pairs,
        episodes=episodes,
        seed=seed,
    )
    print_written([written])
    if open_:
        typer.launch(written.absolute().as_uri())


def _target(
    what: str, task: str | None, cell: str | None, out: Path | None, *, force: bool
) -> Path:
    """The file to write; that in a run's folder follows from the run and may be replaced."""
    if out is not None:
        if out.suffix != ".html":
            raise OptionError(f"--out {out}: must end in .html.")
        return check_new(out, force=force)
    if task is None and cell is None and Path(what).is_dir():
        from sme_registry.training import EXPLORER

        return Path(what) / EXPLORER
    name = Path(what).name if os.sep in what or what.endswith(_POLICY_FILES) else what
    label = "".join(c if c.isalnum() or c in "-_" else "-" for c in name.removesuffix(".json"))
    if cell is not None:
        label += f"-{cell[:12]}"
    return check_new(Path(f"{label}-explorer.html"), force=force)


def _check_kind(task: str | None, set_: list[str] | None, what: str) -> None:
    if task is None and set_ and Path(what).is_dir():
        raise OptionError("--set: changes a task; a run has its own. Leave it out.")
    if task is None and (what.endswith(_POLICY_FILES)):
        raise OptionError(
            f"{what!r}: is a policy. Add the task that it is for, such as --task Default."
        )


def _shown(
    what: str,
    task: str | None,
    cell: str | None,
    set_: list[str] | None,
    action_range: str | None,
    log: Path | None,
) -> SMESpec | AnySubject:
    """The task, run, cell or policy that the arguments name."""
    if task is None and cell is None and not Path(what).is_dir():
        try:
            return load(what, SMESpec).derive(**changes(set_))
        except UnknownNameError as error:
            if ":" not in what or what.startswith("sha256:"):
                raise
            raise OptionError(f"{error} For a policy, add its task: --task Default.") from None
    return load_subject(what, task, cell, set_, action_range, log)


def _channels(text: str) -> tuple[int, int]:
    """Two channels, as text `I,J`."""
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise OptionError(f"--channels {text}: must be two channels, such as --channels 1,2.")
    return int(parts[0]), int(parts[1])

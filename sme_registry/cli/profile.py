"""`sme profile`: where an algorithm breaks, beside the reference algorithms."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Json, changes, only_with
from sme_registry.cli.plan import Agents, Jobs
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.io import choice
from sme_registry.io.system import module_file
from sme_registry.io.terminal import count, out, print_json, print_line, print_note
from sme_registry.training.algorithms import nested_hyperparameters

app = typer.Typer()

_SHOW = "show"
_WITH_SHOW = "subject", "name", "json"
_WITH_RUNS = "runs", "algorithm", "folder", "quick", "json"


@app.command()
def profile(
    context: typer.Context,
    subject: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE[:FUNCTION]",
            help="The file of your function, train by default; or `show`, and the name of a "
            "reference.",
        ),
    ] = None,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", hidden=True)] = None,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            "-a",
            help="Instead of a FILE: PPO, TD3, SAC, module:Class, train:module:function, … With "
            "--runs one of the study.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A first look: the hardest levels alone, two draws of each."),
    ] = False,
    agents: Agents = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A hyperparameter. Repeatable."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", "-f", help="Default runs/profile-NAME. Continued if it exists."),
    ] = None,
    runs: Annotated[
        Path | None,
        typer.Option(
            help="Train nothing: the profile of a study's runs, in this folder. With --quick of "
            "these levels alone."
        ),
    ] = None,
    jobs: Jobs = None,
    json: Json = False,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            "-n",
            parser=count,
            metavar="INTEGER",
            help="Of each training. Default 20,000, those of the references: with others, there "
            "are none beside it.",
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Draws of each level. Default 5.")
    ] = None,
    title: Annotated[
        str | None, typer.Option("--name", help="Of the profile. Default the algorithm's.")
    ] = None,
    retry: Annotated[
        bool, typer.Option("--retry", help="Also run the cells that failed before.")
    ] = False,
) -> None:
    """Show where an algorithm breaks: along which axis, how far, and beside PPO, TD3 and SAC.

    It trains on the default and on two harder levels of each of nine axes, five draws of each, and
    writes one page, profile.html. Your own algorithm is a function in a file:

      def train(env, steps, seed):  # at most so many steps
          return policy             # from observations [B, O] to actions [B, A]

    With `yield policy` it is evaluated during training, too. Stop at any time, and run the same
    command to continue.

    Examples:

      sme profile mine.py --quick
      sme profile mine.py:other --set learning_rate=0.001
      sme profile -a PPO --agents jax
      sme profile --runs runs/mine
      sme profile show PPO
    """
    if subject == _SHOW:
        others = [option for option in context.params if option not in _WITH_SHOW]
        only_with(context, others, "is not for show. Leave it out")
        _show(name, json)
        return
    _check_subject(subject, name, algorithm, runs)
    from sme_registry.profiles import page, run  # not to show: that takes no pages and no training

    if runs is not None:
        others = [option for option in context.params if option not in _WITH_RUNS]
        only_with(context, others, "is for a training, and --runs trains nothing. Leave one out")
        made = run.profile_of(runs, algorithm, classes=run.quick_classes() if quick else None)
        files = folder or runs
        page.write_page(made, files)
    else:
        made = run.profile(
            algorithm or uses_of(subject or ""), folder=folder,
            agents=agents, hyperparameters=nested_hyperparameters(changes(set_)), name=title,
            steps=steps, seeds=seeds, quick=quick, jobs=jobs, retry_failed=retry,
        )  # fmt: skip
        files = folder or run.default_folder(made.name)
    _print(made, json)
    if not json:
        print_line(escape(str(files / "profile.html")))
    for failure in made.failures[:3]:
        print_note(
            f"[red]failed[/] {escape(failure.class_name)}, run {failure.run}: "
            f"{escape(failure.error)}"
        )
    if len(made.failures) > 3:
        print_note(f"{len(made.failures) - 3} more failed runs are in the page.")
    if made.failures:
        raise typer.Exit(1)


def _check_subject(
    subject: str | None, name: str | None, algorithm: str | None, runs: Path | None
) -> None:
    if name is not None:
        raise OptionError(f"{name!r}: is one argument too many. Give one FILE, or show NAME.")
    if subject is not None and (algorithm or runs):
        raise OptionError(f"{subject!r}: is given beside --algorithm or --runs. Leave one out.")
    if subject is None and not (algorithm or runs):
        raise OptionError("Give a FILE, --algorithm or --runs. See `sme profile --help`.")


def uses_of(subject: str) -> str:
    """`train:module:function` of a file in the working directory."""
    file, _, function = subject.partition(":")
    path = Path(file)
    if path.suffix != ".py" or not path.is_file():
        raise OptionError(
            f"{subject!r}: must be a Python file with a function train(env, steps, seed), such as "
            "mine.py, or mine.py:other. For an algorithm by its name: sme profile -a PPO."
        )
    here = Path.cwd().resolve()
    if not path.resolve().is_relative_to(here):
        raise OptionError(f"{subject!r}: must be in the working directory or below. Go there.")
    parts = path.resolve().relative_to(here).with_suffix("").parts
    module = ".".join(parts)
    if not all(map(str.isidentifier, parts)) or module_file(module) != str(path.resolve()):
        raise OptionError(
            f"{subject!r}: cannot be imported as the module {module!r}. Give the file and its "
            "folders names of letters, digits and underscores that no other module has."
        )
    return f"train:{module}:{function or 'train'}"


def _show(name: str | None, json: bool) -> None:
    from sme_registry.profiles.document import Profile

    known = Profile.references()
    exact = {key.casefold(): key for key in known}.get((name or "").casefold(), name)
    _print(known[choice("show", exact, known, error=UnknownNameError)], json)


def _print(made: Any, json: bool) -> None:
    if json:
        print_json(made.to_dict())
        return
    out().print(made.table())
    for sentence in made.sentences():
        print_line(escape(sentence))

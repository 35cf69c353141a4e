"""`sme suite new`: write a suite's file. `sme suite FILE` is short for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Force
from sme_registry.cli.files import check_document_path
from sme_registry.cli.plan_options import ClassOptions, with_options
from sme_registry.io.markup import plural
from sme_registry.io.terminal import CommandGroup, err, out
from sme_registry.spec import Suite, SuiteFile


class _NewByDefault(CommandGroup):
    """A group whose command `new` may be left out."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = args and args[0] in (*self.commands, *self.get_help_option_names(ctx))
        parsed: list[str] = super().parse_args(ctx, args if named or not args else ["new", *args])
        return parsed


app = typer.Typer(
    cls=_NewByDefault,
    no_args_is_help=True,
    help="""Suites of your own: classes of tasks, each with several instances.

    Examples:

      sme suite new mine.json -t Default -t HardSparse --instances 5

      sme suite new more.json --suite smoke -t Complexity50
    """,
)


@app.command("new")
@with_options(ClassOptions)
def new(
    path: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)],
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
    out().print(f"{escape(str(path))}  {file.digest}", soft_wrap=True)
    hint = f"{tasks}. To train an algorithm on them: sme train --suite {path} -a PPO"
    err().print(f"[dim]{escape(hint)}[/]", soft_wrap=True)

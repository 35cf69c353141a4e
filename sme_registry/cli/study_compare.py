"""`sme study compare`: two algorithms, or two settings of one, by their paired differences."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from sme_registry.cli.arguments import Json
from sme_registry.io.tables import Table
from sme_registry.io.terminal import out, print_json


def compare(
    folder: Annotated[Path, typer.Argument(help="The study's folder.")],
    first: Annotated[str, typer.Argument(metavar="A", help="An algorithm of the plan, by name.")],
    second: Annotated[str, typer.Argument(metavar="B", help="The one it is compared with.")],
    metric: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            "-m",
            help="wd_regret, ood_regret, ood_decay, final_return or online_regret. Repeatable; "
            "default wd_regret and ood_regret.",
        ),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Also write CSV, JSON, LaTeX, and figures as PNG and PDF."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Compare two algorithms of a study: the difference A − B on each class, with its interval.

    Runs are compared in pairs: those on the same instance with the same seed. An interval that
    excludes 0 and rests on at least 5 pairs is marked: * if A is worse, † if A is better.

    Each .tex file is a complete table with its own caption and label: \\input it outside of any
    table environment.

    Examples:

      sme study compare runs/smoke PPO TD3

      sme study compare runs/mine slow fast --metric wd_regret --out paper/slow-fast

      sme study compare runs/smoke PPO TD3 --json
    """
    from sme_registry.studies.report import compare as comparison
    from sme_registry.studies.report.exports import difference_caveats

    metrics = tuple(metric or comparison.DEFAULT_METRICS)
    differences = comparison.compare(folder, first, second, metrics)
    files = []
    if out_folder is not None:
        files = comparison.write_comparison(folder, out_folder, first, second, metrics)
    if json:
        print_json(comparison.records(differences))
        return
    for each in comparison.comparison_tables(differences):
        columns = {escape(name): "number" for name in each.frame.columns} | {"class": "name"}
        rows = (tuple(map(escape, row)) for row in each.frame.itertuples(index=False))
        out().print(Table(f"[bold]{escape(each.title)}[/]", columns, rows))
    caveats = comparison.implementation_caveats(folder, first, second)
    for sentence in (*difference_caveats(differences), *caveats):
        out().print(escape(sentence), soft_wrap=True)
    if files:
        out().print(f"{escape(str(out_folder))}  {len(files)} files", soft_wrap=True)

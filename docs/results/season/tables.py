"""The tables and the figure of a board with revealed seasons.

python docs/results/season/tables.py docs/results/season/board
python docs/results/season/tables.py docs/results/season/board --figure curves.png
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from leaderboard.seasons.cli import MOST_ROWS, table_regret
from leaderboard.seasons.scoring import counting
from leaderboard.seasons.season import SealedResult
from leaderboard.seasons.store import SeasonStore

PARTS = 25  # of a curve in the figure, of the 100 in a result


class Played(NamedTuple):
    """What a method got in one class: a row for each of its runs.

    Attributes:
      regrets: `[n, 6]` normalised regret N_m by region.
      online: `[n]` normalised online regret; empty offline.
      curves: `[n, 100]` the same in each hundredth of the budget; empty offline.
    """

    regrets: np.ndarray
    online: np.ndarray
    curves: np.ndarray


def played(result: SealedResult, name: str) -> Played:
    """A result's runs of one class."""
    own = [number for number, run in enumerate(result.runs) if run.class_name == name]
    stepping = [result.stepping[number] for number in own] if result.stepping else []
    return Played(
        np.array([result.runs[number].normalised_regret for number in own]),
        np.array([each.normalised_online_regret for each in stepping]),
        np.array([each.learning_curve for each in stepping]),
    )


def results(store: SeasonStore, season: str) -> Iterator[tuple[str, SealedResult]]:
    """The counting results of a season, the best first."""
    found = []
    for row in counting(store, store.season(season)):
        result = store.sealed_result(row)
        if result is not None:
            star = "*" if row.knowledge == "family" else ""
            found.append((row.method + star, result))
    return iter(sorted(found, key=lambda each: each[1].scores.wd_regret.value))


def spread(values: np.ndarray) -> str:
    """The mean of some runs, and each of them."""
    return f"{values.mean():.2f} ({', '.join(f'{each:.2f}' for each in sorted(values))})"


def print_tables(store: SeasonStore, season: str) -> None:
    """Print a season's tables in Markdown; a star marks knowledge of the family."""
    document = store.season(season)
    print(f"\n{document.title}, {document.track}, {document.digest}\n")
    print("| method | N₀ | 95 % | N̄ | N̄ − N₀ | 95 % |\n|---|---|---|---|---|---|")
    for method, result in results(store, season):
        inside, outside, decay = (
            getattr(result.scores, name) for name in ("wd_regret", "ood_regret", "ood_decay")
        )
        print(
            f"| {method} | {inside.value:.3f} | {inside.low:.2f} to {inside.high:.2f} | "
            f"{outside.value:.3f} | {decay.value:.3f} | {decay.low:.2f} to {decay.high:.2f} |"
        )
    for member in document.classes:
        table = table_regret(member.setting, MOST_ROWS)
        print(
            f"\n{member.name}: a table of {MOST_ROWS:,} states with their optima has {table:.2f}\n"
        )
        print("| method | N₀ (runs) | N₁ | N₂ | N₃ | N₄ | N₅ | online regret (runs) |")
        print("|---" * 8 + "|")
        for method, result in results(store, season):
            own = played(result, member.name)
            shells = " | ".join(f"{each:.2f}" for each in own.regrets.mean(axis=0)[1:])
            online = spread(own.online) if own.online.size else ""
            print(f"| {method} | {spread(own.regrets[:, 0])} | {shells} | {online} |")


def draw(store: SeasonStore, season: str, path: Path) -> None:
    """Draw the learning curves of an online season, a panel for each class."""
    import matplotlib.pyplot as plt

    document = store.season(season)
    figure, panels = plt.subplots(
        1, len(document.classes), figsize=(8, 3.3), sharey=True, layout="constrained"
    )
    for axes, member in zip(panels, document.classes, strict=True):
        steps = (np.arange(PARTS) + 0.5) / PARTS * (member.budget or 0)
        for method, result in results(store, season):
            curves = played(result, member.name).curves
            curves = curves.reshape(len(curves), PARTS, -1).mean(axis=2)
            [line] = axes.plot(steps, curves.mean(axis=0), label=method)
            axes.fill_between(
                steps, curves.min(axis=0), curves.max(axis=0), alpha=0.2, color=line.get_color()
            )
        axes.set_title(f"{member.name}: L = {member.setting.complexity}")
        axes.set_xlabel("steps")
        axes.set_ylim(0, None)
    panels[0].set_ylabel("normalised online regret")
    lines, names = panels[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False)
    figure.savefig(path, dpi=75)


def main() -> None:
    """Print the tables of all seasons of a board, and draw the curves of the online one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("board", type=Path)
    parser.add_argument("--figure", type=Path, help="a PNG file to write")
    arguments = parser.parse_args()
    with SeasonStore.open(arguments.board, read_only=True) as store:
        for row in store.seasons():
            print_tables(store, row.id)
            if row.kind == "sealed-online" and arguments.figure:
                draw(store, row.id, arguments.figure)


if __name__ == "__main__":
    main()

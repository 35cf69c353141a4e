"""Tables and figures of docs/results/limits_and_distractors.md, from the compact results beside it.

    python docs/results/limits_and_distractors.py
    python docs/results/limits_and_distractors.py --from REPRESENTATION-REPORT SAFETY-REPORT

The second form first writes the compact results, from two folders of `sme study report`.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from scipy import stats

from sme_registry import evaluate, load
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    MARKERS,
    figure_of,
    legend_below,
    new_figure,
    save_figure,
    styled,
)

FOLDER = Path(__file__).parent / "limits-and-distractors"
RUN = ["class_name", "algorithm", "run", "steps", "spec_digest", "seed", "uses"]
VALUES = ["wd_regret", "ood_regret", "online_regret"]
GROWTH = "N̄ − N"  # of normalised regret, relative to ½ in the same states: not the paper's decay
OBSERVATION = ["distractor_regret", "wd_sensitivity"]
SAFETY = ["wd_cost", "violating_share", "wd_safe_regret", "price_of_safety", "online_cost"]


def compact(report: Path, more: list[str]) -> pd.DataFrame:
    """One row a run: values in the cube, means over the shells and over training."""
    results = pd.read_csv(report / "tables" / "results.csv")
    return results[results["region"] == "WD"][[*RUN, *VALUES, *more]].round(6)


def means(runs: pd.DataFrame, value: str) -> pd.DataFrame:
    """Mean over runs by class and algorithm, in the plan's order."""
    table = runs.pivot_table(index="class_name", columns="algorithm", values=value)
    return table.loc[list(dict.fromkeys(runs["class_name"]))].round(3)


def changes(runs: pd.DataFrame, value: str) -> pd.DataFrame:
    """Mean, least and greatest change from `plain` over pairs of runs with the same seed."""
    wide = runs.pivot(index=["algorithm", "run"], columns="class_name", values=value)
    change = wide[list(dict.fromkeys(runs["class_name"]))].sub(wide["plain"], axis=0)
    change = change.drop(columns="plain").groupby("algorithm")
    return change.agg(["mean", "min", "max"]).round(3).T.unstack()


def association(runs: pd.DataFrame, value: str) -> pd.DataFrame:
    """Spearman's ρ of sensitivity and a value, over runs and within classes (centred by class).

    Runs that are worse than the constant ½ are left out: their actions hardly depend on anything.
    """
    seen = runs[runs["wd_regret"] < 1].dropna(subset=["wd_sensitivity"])
    rows = {}
    for name, group in seen.groupby("algorithm"):
        pair = group[["wd_sensitivity", value]]
        within = pair - pair.groupby(group["class_name"]).transform("mean")
        rows[name] = {
            "runs": len(pair),
            "over all": stats.spearmanr(*pair.to_numpy().T).statistic,
            "within classes": stats.spearmanr(*within.to_numpy().T).statistic,
        }
    return pd.DataFrame(rows).T.round(2)


def draw_sensitivity(axes: Axes, runs: pd.DataFrame) -> None:
    """One point a run: what distractors do to the actions, and what is lost outside the cube."""
    for index, (name, group) in enumerate(runs.groupby("algorithm", sort=False)):
        x, y = group["wd_sensitivity"], group[GROWTH]
        axes.scatter(x, y, s=18, color=COLOURS[index], marker=MARKERS[index], label=name)
    axes.set(xlabel="sensitivity in the cube (0: distractors change nothing)", ylabel=GROWTH)
    legend_below(figure_of(axes), axes.get_legend_handles_labels()[0], most_across=3)


def references(seeds: Iterable[int]) -> pd.DataFrame:
    """Step reward and cost of the reference policies in the cube, means over instances."""
    rows = [
        {"policy": name, "step_reward": regions[0].step_reward, "wd_cost": regions[0].cost}
        for seed in seeds
        for name, regions in evaluate(
            "constant", load("Safety20").derive(seed=seed), "paper-v1"
        ).safety.references.items()
    ]
    return pd.DataFrame(rows).groupby("policy").mean().round(3)


def draw_limits(axes: Axes, runs: pd.DataFrame, known: pd.DataFrame) -> None:
    """One point a run, and the reference policies: step reward against cost, both in the cube."""
    for name, point in known.loc[["optimal", "safe_projection", "shrunk_optimal"]].iterrows():
        at = (point["wd_cost"], point["step_reward"])
        axes.plot(*at, "x", color=GREY)
        axes.annotate(name.replace("_", " "), at, (4, 4), textcoords="offset points", color=GREY)
    for index, (name, group) in enumerate(runs.groupby("algorithm", sort=False)):
        x, y = group["wd_cost"], group["step_reward"]
        axes.scatter(x, y, s=22, color=COLOURS[index], marker=MARKERS[index], label=name)
    axes.set(xlabel="cost (0: no limit is violated)", ylabel="step reward")
    legend_below(figure_of(axes), axes.get_legend_handles_labels()[0], most_across=3)


def main() -> None:
    """Print the tables and draw the figures, after compacting two reports if they are given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="reports", type=Path, nargs=2)
    if reports := parser.parse_args().reports:
        compact(reports[0], OBSERVATION).to_csv(FOLDER / "representation.csv", index=False)
        compact(reports[1], SAFETY).to_csv(FOLDER / "safety.csv", index=False)
        shutil.copy(reports[0] / "tables" / "layers.csv", FOLDER / "layers.csv")
    runs, limits, layers = (
        pd.read_csv(FOLDER / f"{name}.csv") for name in ("representation", "safety", "layers")
    )
    limits["step_reward"] = 1 - limits["price_of_safety"] - limits["wd_safe_regret"]
    for rows in (runs, limits):
        rows[GROWTH] = rows["ood_regret"] - rows["wd_regret"]
    known = references(limits["run"].unique())
    for value in ("wd_regret", "ood_regret", GROWTH):
        print(f"\n{value}\n{means(runs, value)}\nchange\n{changes(runs, value).to_string()}")
    for value in OBSERVATION:
        print(f"\n{value}\n{means(runs.dropna(subset=[value]), value)}")
    for value in (GROWTH, "ood_regret", "wd_regret"):
        print(f"\nsensitivity and {value}\n{association(runs, value)}")
    wide = layers.pivot(index=["class_name", "algorithm"], columns="layer")
    print("\nR² by layer\n", wide[["state_r2", "distractor_r2"]].round(3).to_string())
    earned = limits.groupby("algorithm", sort=False)[["step_reward", *VALUES, GROWTH, *SAFETY]]
    print("\nlimits\n", earned.agg(["mean", "min", "max"]).round(3).T.to_string(), "\n", known)
    with styled():
        seen, safe = new_figure((4.6, 3.2)), new_figure((4.6, 3.2))
        draw_sensitivity(seen.subplots(), runs.dropna(subset=["wd_sensitivity"]))
        draw_limits(safe.subplots(), limits, known)
        save_figure(seen, FOLDER / "sensitivity.png")
        save_figure(safe, FOLDER / "reward-against-cost.png")


if __name__ == "__main__":
    main()

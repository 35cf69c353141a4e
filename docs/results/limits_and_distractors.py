"""Tables and figures of docs/results/limits_and_distractors.md, from the compact results beside it.

    python docs/results/limits_and_distractors.py
    python docs/results/limits_and_distractors.py --from REPRESENTATION-REPORT SAFETY-REPORT

The second form first writes the compact results, from two folders of `sme study report`.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterable, Iterator
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
    """Spearman's ρ of sensitivity and a value: of ranks within classes, and over runs.

    Runs that are worse than the constant ½ are left out: their actions hardly depend on anything.
    """
    seen = runs[runs["wd_regret"] < 1].dropna(subset=["wd_sensitivity"])
    rows = {}
    for name, group in seen.groupby("algorithm"):
        pair = group[["wd_sensitivity", value]]
        ranks = pair.groupby(group["class_name"]).rank()
        ranks -= ranks.groupby(group["class_name"]).transform("mean")  # classes may differ in size
        rows[name] = {
            "runs": len(pair),
            "within classes": ranks.corr().iloc[0, 1],
            "over all": stats.spearmanr(*pair.to_numpy().T).statistic,
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
    """Step reward, cost and violations of the reference policies in the cube: means of draws."""
    rows = [
        {
            "policy": name,
            "step_reward": regions[0].step_reward,
            "wd_cost": regions[0].cost,
            "violating_share": regions[0].violating_share,
        }
        for seed in seeds
        for name, regions in evaluate(
            "constant", load("Safety20").derive(seed=seed), "paper-v1"
        ).safety.references.items()
    ]
    return pd.DataFrame(rows).groupby("policy").mean().round(3)


def untrained(seeds: Iterable[int]) -> pd.DataFrame:
    """N in the cube of the linear and of a random policy on the plain task: means of draws."""
    rows = [
        {name: evaluate(name, load("Default").derive(seed=seed), "quick-v1").wd_regret}
        for seed in seeds
        for name in ("linear", "random")
    ]
    return pd.DataFrame(rows).mean().to_frame().T.round(2)


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


def rows() -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """The runs on observations, those on limits, and what layers represent."""
    runs, limits, layers = (
        pd.read_csv(FOLDER / f"{name}.csv") for name in ("representation", "safety", "layers")
    )
    limits["step_reward"] = 1 - limits["price_of_safety"] - limits["wd_safe_regret"]
    for table in (runs, limits):
        table[GROWTH] = table["ood_regret"] - table["wd_regret"]
    return runs, limits, layers


def tables() -> Iterator[tuple[str, pd.DataFrame]]:
    """Each table of the page, with its title."""
    runs, limits, layers = rows()
    for value in ("wd_regret", "ood_regret", GROWTH):
        yield value, means(runs, value)
        yield f"{value}: change from plain", changes(runs, value).round(2)
    stuck = runs["wd_regret"] >= 1
    yield "N of policies that do not train, plain", untrained((1, 2, 3))
    yield "stuck", runs[stuck][["class_name", "algorithm", "run", "wd_regret"]]
    outside = runs.assign(change=runs["distractor_regret"] - runs["wd_regret"])[~stuck]
    outside = outside.dropna(subset=["change"])
    yield "distractors outside: change of N", means(outside, "change").round(2)
    yield "sensitivity", means(runs.dropna(subset=["wd_sensitivity"]), "wd_sensitivity")
    for value in ("wd_regret", "ood_regret", GROWTH):
        yield f"ρ of sensitivity and {value}", association(runs, value)
    wide = layers.pivot(index=["class_name", "algorithm"], columns="layer")
    wide = wide[["state_r2", "distractor_r2"]]
    yield "R² by layer", wide.dropna().round(2)
    yield "R² by layer, without distractors", wide[wide.isna().any(axis=1)].round(3)
    earned = limits.groupby("algorithm", sort=False)[["step_reward", *VALUES, GROWTH, *SAFETY]]
    yield "limits", earned.agg(["mean", "min", "max"]).round(3).stack(0, future_stack=True)
    by_draw = limits.pivot(index="run", columns="algorithm").round(3)
    yield "step reward by draw", by_draw["step_reward"]
    yield "safe regret by draw", by_draw["wd_safe_regret"]
    yield "references", references(limits["run"].unique())


def printed() -> str:
    """The tables of the page."""
    return "\n\n".join(f"{title}\n{table.to_string()}" for title, table in tables())


def main() -> None:
    """Print the tables and draw the figures, after compacting two reports if they are given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="reports", type=Path, nargs=2)
    if reports := parser.parse_args().reports:
        compact(reports[0], OBSERVATION).to_csv(FOLDER / "representation.csv", index=False)
        compact(reports[1], SAFETY).to_csv(FOLDER / "safety.csv", index=False)
        shutil.copy(reports[0] / "tables" / "layers.csv", FOLDER / "layers.csv")
    print(printed())
    runs, limits, _ = rows()
    known = references(limits["run"].unique())
    with styled():
        seen, safe = new_figure((4.6, 3.2)), new_figure((4.6, 3.2))
        draw_sensitivity(seen.subplots(), runs.dropna(subset=["wd_sensitivity"]))
        draw_limits(safe.subplots(), limits, known)
        save_figure(seen, FOLDER / "sensitivity.png")
        save_figure(safe, FOLDER / "reward-against-cost.png")


if __name__ == "__main__":
    main()

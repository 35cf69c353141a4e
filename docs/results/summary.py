"""Tables of docs/results/ablations_in_jax.md, from the compact results beside it.

    python docs/results/summary.py docs/results/ablations-in-jax/runs.csv
    python docs/results/summary.py runs.csv --from report/tables/results.csv

The second form first writes `runs.csv`, one row a run, from the table that `sme study report`
writes with one row a run and region.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
from scipy import stats

RUN = ["algorithm", "class_name", "run", "steps", "complexity", "spec_digest", "seed", "uses"]
KEPT = ["online_regret", "linear_normalised_regret"]
BY_REGION = ["normalised_regret", "similarity"]


def compact(results: pd.DataFrame) -> pd.DataFrame:
    """One row a run: `similarity_0` in the cube, `similarity_1` … in the shells, and so on."""
    region = results["region"].map({"WD": 0} | {f"OOD {m}": m for m in range(1, 6)})
    wide = results.assign(m=region).pivot(index=RUN, columns="m", values=BY_REGION)
    wide.columns = [f"{name}_{m}" for name, m in wide.columns]
    kept = results[region == 0].set_index(RUN)[KEPT]  # in the report's order, the plan's
    return kept.join(wide).reset_index().round(6)


def with_losses(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs with `loss_1` and `loss_5`: (r̃_WD − r̃_m)/r̃_WD, per cent, METHOD section 3."""
    for m in (1, 5):
        lost = runs["similarity_0"] - runs[f"similarity_{m}"]
        runs[f"loss_{m}"] = 100.0 * lost / runs["similarity_0"]
    return runs


def average_loss(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean and SD of the losses over runs, by algorithm and by whether L is 1."""
    depth = runs["complexity"].map(lambda L: "L = 1" if L == 1 else "L > 1")
    parts = [runs.assign(tasks="all"), runs.assign(tasks=depth)]
    grouped = pd.concat(parts).groupby(["algorithm", "tasks"])
    table = grouped.agg(
        runs=("loss_1", "size"),
        loss_1=("loss_1", "mean"),
        sd_1=("loss_1", "std"),
        loss_5=("loss_5", "mean"),
        sd_5=("loss_5", "std"),
    )
    for name, group in grouped:
        rank = stats.spearmanr(group["similarity_0"], group["loss_5"])
        table.loc[name, "spearman"] = rank.statistic
    return table.round(2)


def classes(runs: pd.DataFrame) -> pd.DataFrame:
    """N₀, N̄ and the loss in the outermost shell of each class, means over runs."""
    shells = [f"normalised_regret_{m}" for m in range(1, 6)]
    runs = runs.assign(ood_regret=runs[shells].mean(axis=1), wd_regret=runs["normalised_regret_0"])
    values = ["wd_regret", "ood_regret", "loss_5", "online_regret"]
    order = list(dict.fromkeys(runs["class_name"]))
    table = runs.pivot_table(index="class_name", columns="algorithm", values=values, aggfunc="mean")
    return table.loc[order].round(3)


def main() -> None:
    """Print the tables, after writing the runs if a report's table is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--from", dest="results", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    if options.results:
        frames = pd.concat(pd.read_csv(path) for path in options.results)
        compact(frames).to_csv(options.runs, index=False)
    runs = with_losses(pd.read_csv(options.runs))
    print(average_loss(runs).to_string(), "\n")
    print(classes(runs).to_string())


if __name__ == "__main__":
    main()

"""Runs, rows, tables and figures of docs/results/foresight.md.

    python docs/results/foresight.py                     # tables and figures, of the rows beside it
    python docs/results/foresight.py --run PPO runs/ppo  # first the runs of an algorithm; resumable

A run trains in JAX and is measured in the cube, in the shells, and at its critic. The runs of PPO
take minutes, those of TD3 and SAC an hour or more each.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats
from summary import with_interval

from sme_registry import run_study
from sme_registry.diagnosis import critic
from sme_registry.plots.style import (
    COLOURS,
    MARKERS,
    legend_below,
    new_figure,
    save_figure,
    styled,
)
from sme_registry.spec import Setting, StudyAlgorithm, StudyFile, StudyPlan, SuiteClass
from sme_registry.studies import load

FOLDER = Path(__file__).parent / "foresight"
DEPTH, RUNS = 2, 5
# Steps, discounts and scales of the shaping; those of TD3 and SAC are cut for their time.
BUDGETS = {
    "PPO": (30_720, (0.0, 0.5, 0.9, 0.99), (1.0, 3.0, 10.0, 30.0)),
    "TD3": (6_000, (0.0, 0.9, 0.99), (3.0, 10.0)),
    "SAC": (6_000, (0.0, 0.9, 0.99), (3.0, 10.0)),
}
NOISE = {"reward": (0.1, 0.3, 1.0), "transition": (0.03, 0.3)}  # in the names of classes × 100
NOISY_GAMMA = 0.99
NOISY = "plain|reward|transition"
TITLES = "misleading", "control", "difference"


def plan(algorithm: str, gamma: float) -> StudyFile:
    """An agent of one discount on the plain task, misleading ones, their controls, and noise."""
    steps, _, scales = BUDGETS[algorithm]
    settings: dict[str, dict[str, Any]] = {"plain": {}}
    for c in scales:
        settings[f"misleading-{c:g}"] = {"shaping": {"scale": c}}
        settings[f"control-{c:g}"] = {"shaping": {"scale": c, "discount": gamma}}
    if gamma == NOISY_GAMMA:
        for kind, sigmas in NOISE.items():
            settings |= {f"{kind}-{100 * sigma:g}": {"noise": {kind: sigma}} for sigma in sigmas}
    classes = [
        SuiteClass(
            name=name,
            setting=Setting.from_dict({"complexity": DEPTH, **fields}),
            seeds=tuple(range(1, RUNS + 1)),
        )
        for name, fields in settings.items()
    ]
    agent = StudyAlgorithm(
        name=algorithm, uses=f"jax:{algorithm}", hyperparameters={"gamma": gamma}
    )
    document = StudyPlan(
        classes=classes, algorithms=(agent,), seeds=RUNS, steps=steps, evaluations=20
    )
    return StudyFile(name="foresight", digest=document.digest, plan=document)


def run(algorithm: str, folder: Path, jobs: int | None) -> None:
    """Train the runs that the folder lacks, and write their rows and those of their critics."""
    for gamma in BUDGETS[algorithm][1]:
        file, place = plan(algorithm, gamma), folder / f"gamma-{gamma:g}"
        run_study(file, place, keep_models=True, jobs=jobs, retry_failed=True)
        results, _ = load(place)
        runs = compact(results.assign(gamma=gamma))
        append(runs, FOLDER / "runs.csv", ["algorithm", "gamma"])
        models = {planned.cell.digest: planned for planned in file.plan.cells}
        append(
            critics(algorithm, gamma, place, models), FOLDER / "critics.csv", ["algorithm", "gamma"]
        )


def compact(results: pd.DataFrame) -> pd.DataFrame:
    """One row a run."""
    runs = results[results["region"] == "WD"]
    kept = ["wd_regret", "ood_regret", "ood_decay", "online_regret"]
    names = ["algorithm", "gamma", "class_name", "run", "steps", "spec_digest", "seed"]
    references = {
        "random_normalised_regret": "random",
        "linear_normalised_regret": "linear",
    }
    return runs[names + kept + list(references)].rename(columns=references).round(6)


def critics(algorithm: str, gamma: float, place: Path, cells: dict[str, Any]) -> pd.DataFrame:
    """One row a run and region, of what its critic says and of the exact values."""
    rows = []
    for key, planned in cells.items():
        model = next(place.glob(f"**/{key.removeprefix('sha256:')}*.zip"))
        report = critic(model, planned.cell.spec, states=300)
        place_in_plan = {"class_name": planned.class_name, "run": planned.run}
        rows += [
            {"algorithm": algorithm, "gamma": gamma}
            | place_in_plan
            | {"kind": report.kind, "sweeps": report.sweeps}
            | region.model_dump()
            for region in report.regions
        ]
    return pd.DataFrame(rows).round(6)


def append(rows: pd.DataFrame, path: Path, key: list[str]) -> None:
    """Write rows into a file, in place of those with the same key."""
    if path.exists():
        old = pd.read_csv(path)
        new = set(map(tuple, rows[key].to_numpy().tolist()))
        kept = [tuple(each) not in new for each in old[key].to_numpy().tolist()]
        rows = pd.concat([old[kept], rows])
    rows.to_csv(path, index=False)


def grid(runs: pd.DataFrame, kind: str, value: str = "wd_regret") -> pd.DataFrame:
    """Means over runs, a row for each scale of the shaping and a column for each discount."""
    rows = runs[runs["class_name"].str.match(rf"plain|{kind}-")]
    scale = rows["class_name"].str.extract(r"-(\d+)")[0].astype(float).fillna(0)
    table = rows.assign(c=scale).pivot_table(index="c", columns="gamma", values=value)
    return table.sort_index()


def foresight(runs: pd.DataFrame) -> pd.DataFrame:
    """How much more what misleads costs than what is only as loud, over pairs of runs."""
    kind = runs["class_name"].str.extract(r"(misleading|control)-(\d+)")
    wide = runs.assign(kind=kind[0], c=kind[1].astype(float)).dropna(subset=["kind"])
    wide = wide.pivot(index=["algorithm", "gamma", "c", "run"], columns="kind", values="wd_regret")
    change = wide["misleading"] - wide["control"]
    return spread(change.groupby(["algorithm", "c", "gamma"], sort=False))


def noise(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """N₀ under noise, at one discount, and what the noise costs over pairs of runs."""
    rows = runs[(runs["gamma"] == NOISY_GAMMA) & runs["class_name"].str.match(NOISY)]
    rows = rows.set_index(["algorithm", "class_name", "run"])["wd_regret"]
    change = rows - rows.xs("plain", level="class_name").reindex(rows.index.droplevel(1)).to_numpy()
    at = ["algorithm", "class_name"]
    return spread(rows.groupby(at, sort=False)), spread(change.groupby(at, sort=False))


def spread(groups: Any) -> pd.DataFrame:
    """Mean and range of each group, and the 95 % interval of Student's t."""
    return groups.agg(["mean", "min", "max"]).join(with_interval(groups)[["low", "high"]])


def ranked(runs: pd.DataFrame, criticisms: pd.DataFrame, regions: Iterable[str]) -> pd.DataFrame:
    """How the critics rank and how far their level is off, beside N₀ of the same runs."""
    key = ["algorithm", "gamma", "class_name", "run"]
    joined = criticisms[criticisms["region"].isin(regions)].merge(runs[[*key, "wd_regret"]], on=key)
    return joined.assign(error=joined["bias_share"].abs())


def associations(joined: pd.DataFrame) -> pd.DataFrame:
    """Spearman's ρ with N₀: over all runs, and of ranks within (algorithm, class and discount).

    `p` is that of the latter, by permutation of N₀ within the cells.
    """
    rows = {}
    for value in ("ranking", "bias_share", "bias"):
        for algorithm, group in joined.dropna(subset=[value]).groupby("algorithm", sort=False):
            cells = group.groupby(["class_name", "gamma"])
            within = cells[[value, "wd_regret"]].rank()
            rows[value, algorithm] = {
                "runs": len(group),
                "over all": stats.spearmanr(group[value], group["wd_regret"]).statistic,
                "within classes": within.corr().iloc[0, 1],
                "p": chance(*within.to_numpy().T, cells.ngroup().to_numpy()),
            }
    return pd.DataFrame(rows).T.round(2)


def chance(x: np.ndarray, y: np.ndarray, cells: np.ndarray, draws: int = 2_000) -> float:
    """How often y, permuted within cells, correlates with x as much as it does."""
    rng = np.random.default_rng(0)
    order, correlation = np.argsort(cells, kind="stable"), abs(np.corrcoef(x, y)[0, 1])
    x, y, cells = x[order], y[order], cells[order]
    permuted = [y[np.lexsort((rng.random(len(y)), cells))] for _ in range(draws)]
    return float(np.mean([abs(np.corrcoef(x, z)[0, 1]) >= correlation - 1e-9 for z in permuted]))


def draw_grids(figure: Figure, runs: pd.DataFrame) -> None:
    """A row for each algorithm: N₀ with what misleads, with its control, and their difference."""
    algorithms = [name for name in BUDGETS if name in set(runs["algorithm"])]
    panels = figure.subplots(len(algorithms), 3, squeeze=False)
    for row, algorithm in zip(panels, algorithms, strict=True):
        own = runs[runs["algorithm"] == algorithm]
        misleading, control = grid(own, "misleading"), grid(own, "control")
        tables = (misleading, control, misleading - control)
        for axes, table, title in zip(row, tables, TITLES, strict=True):
            top = 1.0 if table is tables[2] else 2.0
            axes.imshow(table, cmap="Blues", vmin=0, vmax=top, aspect="auto", origin="lower")
            axes.set_xticks(range(table.shape[1]), [f"{gamma:g}" for gamma in table.columns])
            axes.set_yticks(range(table.shape[0]), [f"{c:g}" for c in table.index])
            for (i, j), value in np.ndenumerate(table.to_numpy()):
                dark = "white" if value > 0.6 * top else "black"
                shown = f"{round(value, 2) + 0.0:.2f}".replace("-", "−")
                axes.text(j, i, shown, ha="center", va="center", color=dark, size=8)
            axes.set(title=f"{algorithm}: {title}", xlabel="γ of the learner", ylabel="c")
            axes.tick_params(length=0)
            axes.grid(visible=False)


def draw_critics(figure: Figure, joined: pd.DataFrame) -> None:
    """One point a run: how its critic ranks actions, and how far off its level is, against N₀."""
    learned = joined[joined["kind"] == "Q"]
    for axes, value, label in zip(
        figure.subplots(1, 2, sharey=True),
        ("ranking", "bias_share"),
        ("ranking of actions by r (½ is chance)", "bias over the mean size of the value"),
        strict=True,
    ):
        for index, (name, group) in enumerate(learned.groupby("algorithm", sort=False)):
            axes.scatter(
                group[value].clip(-3, 3),
                group["wd_regret"],
                s=12,
                color=COLOURS[index + 1],
                marker=MARKERS[index + 1],
                label=name,
            )
        axes.set(xlabel=label)
    figure.axes[0].set(ylabel="N₀")
    legend_below(figure, figure.axes[0].get_legend_handles_labels()[0])


def rows() -> tuple[pd.DataFrame, pd.DataFrame]:
    """The runs, and what their critics say in each region."""
    return tuple(pd.read_csv(FOLDER / f"{name}.csv") for name in ("runs", "critics"))


def tables() -> Iterator[tuple[str, pd.DataFrame]]:
    """Each table of the page, with its title."""
    runs, criticisms = rows()
    cube = ranked(runs, criticisms, ["WD"])
    yield "policies that learn nothing", runs[["random", "linear"]].mean().to_frame().T
    for algorithm, own in runs.groupby("algorithm", sort=False):
        for kind in ("misleading", "control"):
            yield f"{algorithm}, {kind}: N₀", grid(own, kind)
    yield "misleading − control", foresight(runs)
    yield from zip(("noise: N₀", "noise − none"), noise(runs), strict=True)
    for algorithm, own in cube.groupby("algorithm", sort=False):
        for value in ("ranking", "misled_ranking", "bias_share"):
            if own[value].notna().any():
                for kind in ("misleading", "control"):
                    yield f"{algorithm}, {kind}: {value}", grid(own, kind, value)
    plain = criticisms[criticisms["class_name"] == "plain"]
    by_region = plain.pivot_table(
        index=["algorithm", "gamma"], columns="region", values="ranking", sort=False
    )
    yield "ranking by region, plain", by_region
    yield "Spearman's ρ with N₀", associations(cube)


def printed() -> str:
    """The tables of the page."""
    return "\n\n".join(f"{title}\n{table.round(2).to_string()}" for title, table in tables())


def main() -> None:
    """Print the tables and draw the figures, after training if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", nargs=2, metavar=("ALGORITHM", "FOLDER"))
    parser.add_argument("--jobs", type=int)
    options = parser.parse_args()
    if options.run:
        algorithm, folder = options.run
        run(algorithm, Path(folder), options.jobs)
    print(printed())
    runs, criticisms = rows()
    cube = ranked(runs, criticisms, ["WD"])
    with styled():
        grids, points = new_figure((6.4, 7.0)), new_figure((6.0, 2.8))
        draw_grids(grids, runs)
        draw_critics(points, cube)
        save_figure(grids, FOLDER / "grids.png")
        save_figure(points, FOLDER / "critics.png")


if __name__ == "__main__":
    main()

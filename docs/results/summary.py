"""The tables of pages of results, from the rows beside them.

    python docs/results/summary.py ablations
    python docs/results/summary.py ablations --rows runs.csv --from report/tables/results.csv
    python docs/results/summary.py continual --rows lives.csv --from report/tables/stream_lives.csv

The second form first writes `runs.csv`, one row a run, from the table that `sme study report
--full` writes with one row a run and region; the third the rows of lives or, from
`stream_visits.csv`, of their visits.
"""

from __future__ import annotations

import argparse
import json
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import EngFormatter
from scipy import stats

from sme_registry import Profile, evaluate, load
from sme_registry.spec import ProtocolFile, Suite, SuiteFile, catalogue
from sme_registry.statistics import aggregate, iqm, stratified_bootstrap

RESULTS = Path(__file__).parent
RUN = ["algorithm", "class_name", "run", "steps", "complexity", "spec_digest", "seed", "uses"]
KEPT = ["online_regret", "linear_normalised_regret"]
BY_REGION = ["normalised_regret", "similarity"]
OF_LIVES = (
    "visited_regret",
    "forgetting",
    "forward_transfer",
    "learning_transfer",
    "plasticity_ratio",
)
OF_TRAINING = "learning_transfer", "online_regret"
ALGORITHMS = "PPO", "TD3", "SAC"
UNTRAINED = "linear", "constant", "random"
MARGIN = 0.02  # of N₀, within which two implementations count as equal


def compact(results: pd.DataFrame) -> pd.DataFrame:
    """One row a run: `similarity_0` in the cube, `similarity_1` … in the shells, and so on."""
    region = results["region"].map({"WD": 0} | {f"OOD {m}": m for m in range(1, 6)})
    wide = results.assign(m=region).pivot(index=RUN, columns="m", values=BY_REGION)
    wide.columns = [f"{name}_{m}" for name, m in wide.columns]
    kept = results[region == 0].set_index(RUN)[KEPT]  # in the report's order, the plan's
    return kept.join(wide).reset_index().round(6)


def of_lives(lives: pd.DataFrame) -> pd.DataFrame:
    """One row a life in the cube and over the shells, or a row in the cube for each of its visits.

    With the columns of the file beside the page.
    """
    name, regions = ("lives-visits", ["WD"]) if "visit" in lives else ("lives", ["WD", "OOD"])
    columns = pd.read_csv(RESULTS / "continual" / f"{name}.csv", nrows=0).columns
    return lives.loc[lives["region"].isin(regions), columns].round(6)


def rows(*path: str) -> pd.DataFrame:
    """The rows of a page, with `lost_m`, r̃_WD − r̃_m in points, and `decay_m`, its share in %."""
    runs = pd.read_csv(RESULTS.joinpath(*path))
    for m in range(1, 6):
        runs[f"lost_{m}"] = 100.0 * (runs["similarity_0"] - runs[f"similarity_{m}"])
        runs[f"decay_{m}"] = runs[f"lost_{m}"] / runs["similarity_0"]
    return runs


def classes(runs: pd.DataFrame) -> pd.DataFrame:
    """N₀, N̄, the decay in the outermost shell and online regret of each class, means over runs."""
    shells = [f"normalised_regret_{m}" for m in range(1, 6)]
    runs = runs.assign(ood_regret=runs[shells].mean(axis=1), wd_regret=runs["normalised_regret_0"])
    values = ["wd_regret", "ood_regret", "decay_5", "online_regret", "linear_normalised_regret"]
    order = list(dict.fromkeys(runs["class_name"]))
    table = runs.pivot_table(index="class_name", columns="algorithm", values=values, aggfunc="mean")
    return table.loc[order, values].round(3)


def each_run(runs: pd.DataFrame) -> pd.DataFrame:
    """N₀ of every run of a class, in order."""
    rounded = runs.assign(n=runs["normalised_regret_0"].map("{:.2f}".format))
    return rounded.pivot_table(
        index="class_name", columns="algorithm", values="n", aggfunc=", ".join, sort=False
    )


def discounts() -> Iterator[pd.DataFrame]:
    """PPO's N₀ by γ, γ = 0 minus 0.99 over pairs by instance, and what each class costs them."""
    runs = pd.concat([rows("ablations-in-jax", f"{name}.csv") for name in ("runs", "runs-gamma")])
    yield paired(runs, "normalised_regret_0", "PPO (gamma 0)", "PPO")
    yield costs(runs[runs["algorithm"] != "PPO (gamma 0.9)"], "normalised_regret_0")


def profiles() -> Iterator[pd.DataFrame]:
    """N₀ of five runs of 20,000 steps, where each has so many, and of clones; and differences."""
    agents = [*Profile.references().values()]
    agents += [Profile.read(path) for path in RESULTS.glob("unfinished-profiles/*.json")]
    runs = [
        row.model_dump() | {"algorithm": profile.algorithm.name}
        for profile in agents
        for row in profile.rows
        if len(profile.values(row.class_name)) == profile.seeds
    ]
    clones = pd.read_csv(RESULTS / "ablations-in-jax" / "clones.csv")
    fits = by_run(clones, "wd_regret", ["algorithm", "states_of"])
    clones["algorithm"] = "clone, " + clones["algorithm"]
    early = rows("ablations-in-jax", "foresight3.csv")
    early = early.rename(columns={"normalised_regret_0": "wd_regret"})
    table = pd.concat([pd.DataFrame(runs), early, clones[clones["states_of"] == "uniform"]])
    yield paired(table, "wd_regret", "TD3", "PPO")
    of_profile = table[table["algorithm"].isin(["PPO", "PPO (gamma 0)"])]
    yield costs(of_profile[of_profile["class_name"] != "Foresight3"], "wd_regret")
    for one, other in (("SAC", "PPO"), *((f"{name} (gamma 0)", name) for name in ALGORITHMS)):
        pairs = paired(table, "wd_regret", one, other)
        yield pairs[["difference", "low", "high", "pairs", "lower"]].dropna().add_prefix(f"{one}: ")
    change = fits.xs("PPO", axis=1, level=1) - fits.xs("uniform", axis=1, level=1)
    largest = change.abs().groupby(level=0).max().dropna().round(3)
    yield largest.add_prefix("in PPO's states, clone, ")


def paired(runs: pd.DataFrame, value: str, one: str, other: str) -> pd.DataFrame:
    """Means by class and algorithm; one minus other over pairs by instance, with t's interval."""
    wide = by_run(runs, value)
    change = (wide[one] - wide[other]).groupby(level=0, sort=False)
    lower = change.apply(lambda pairs: (pairs < 0).sum())
    means = wide.groupby(level=0, sort=False).mean()
    return means.join(with_interval(change)).assign(lower=lower).round(2)


def costs(runs: pd.DataFrame, value: str) -> pd.DataFrame:
    """What each class costs an algorithm: its value minus the default's, over pairs by run."""
    wide = by_run(runs, value)
    change = wide.sub(wide.loc["default"], level="run")
    tables = {name: with_interval(change[name].groupby(level=0, sort=False)) for name in change}
    return pd.concat(tables, axis=1).round(2)


def with_bootstrap(runs: pd.DataFrame, *place: str) -> dict[str, float]:
    """The IQM of one column `[n, 1]` over runs with its interval, whose draws follow the place."""
    low, high = stratified_bootstrap({"": runs.to_numpy()}, 10_000, " ".join(place), iqm)
    return {"iqm": float(iqm(runs)[0]), "low": float(low[0]), "high": float(high[0])}


def by_run(runs: pd.DataFrame, value: str, columns: Any = "algorithm") -> pd.DataFrame:
    """A row for each run of a class, that is for each instance, and a column an algorithm."""
    place = ["class_name", "run"]
    return runs.pivot_table(index=place, columns=columns, values=value, sort=False)


def with_interval(change: Any) -> pd.DataFrame:
    """The mean of each group of differences, with t's 95 % interval."""
    n, mean = change.count(), change.mean()
    arm = stats.t.ppf(0.975, n - 1) * change.std() / np.sqrt(n)
    return pd.DataFrame({"difference": mean, "low": mean - arm, "high": mean + arm, "pairs": n})


def decays(runs: pd.DataFrame) -> pd.DataFrame:
    """What is lost outside, and how it goes with r̃_WD: ρ over runs, and over ranks in classes."""
    depths = {"all": (1, 50), "L = 1": (1, 1), "L > 1": (2, 50)}
    depths |= {"L = 2, 3": (2, 3), "L = 10, 20, 50": (10, 50)}
    shells = [f"decay_{m}" for m in range(1, 6)]
    table = {}
    for algorithm, of_algorithm in runs.groupby("algorithm", sort=False):
        for tasks, ends in depths.items():
            group = of_algorithm[of_algorithm["complexity"].between(*ends)]
            pair = group[["similarity_0", "decay_5"]]
            within = group.groupby("class_name")[[*pair, "similarity_5"]].rank().corr()
            table[algorithm, tasks] = {
                "runs": len(group),
                "decay_1": group["decay_1"].mean(),
                "sd_1": group["decay_1"].std(),
                "decay_5": group["decay_5"].mean(),
                "sd_5": group["decay_5"].std(),
                "all shells": group[shells].mean(axis=None),
                "points_5": group["lost_5"].mean(),
                "ρ within classes": within.loc["similarity_0", "decay_5"],
                "ρ pooled": stats.spearmanr(*pair.to_numpy().T).statistic,
                "ρ of r̃ outside": within.loc["similarity_0", "similarity_5"],
                **cosines(*pair.to_numpy().T),
            }
    return pd.DataFrame(table).T.round(2)


def decays_of_classes(runs: pd.DataFrame) -> pd.DataFrame:
    """Of each class the decay in the outermost shell, how many runs lose, and ρ with r̃_WD."""
    of_classes = runs.groupby("class_name", sort=False)
    return pd.DataFrame(
        {
            "decay_5": of_classes["decay_5"].mean(),
            "lose": of_classes["decay_5"].agg(lambda decay: (decay > 0).sum()),
            "ρ": of_classes[["similarity_0", "decay_5"]].apply(
                lambda runs: stats.spearmanr(*runs.to_numpy().T).statistic
            ),
        }
    ).round(2)


def cosines(x: np.ndarray, y: np.ndarray, draws: int = 2_000) -> dict[str, float]:
    """The cosine of r̃_WD and decay, and its distribution with decays permuted between runs."""
    rng = np.random.default_rng(0)

    def cosine(other: np.ndarray) -> float:
        return float(x @ other / np.sqrt((x @ x) * (other @ other)))

    permuted = [cosine(rng.permutation(y)) for _ in range(draws)]
    low, high = np.quantile(permuted, [0.025, 0.975])
    return {"cosine": cosine(y), "permuted": np.mean(permuted), "low": low, "high": high}


def references(*names: str) -> pd.DataFrame:
    """N₀, N̄ and the decay, in per cent, of the policies that learn nothing: means of five draws."""
    table: dict[Any, dict[str, float]] = {}
    for name in names:
        for policy in UNTRAINED:
            reports = [
                evaluate(policy, load(name).derive(seed=seed), "quick-v1") for seed in range(1, 6)
            ]
            similarity = np.array([[r.similarity for r in report.regions] for report in reports])
            lost = 100.0 * (1.0 - similarity[:, 1:] / similarity[:, :1])
            table[name, policy] = {
                "N0": np.mean([report.wd_regret for report in reports]),
                "mean N": np.mean([report.ood_regret for report in reports]),
                "mean decay": lost.mean(),
                "decay_5": lost[:, -1].mean(),
            }
    return pd.DataFrame(table).T.round(2)


def of_board(suite: Suite) -> pd.DataFrame:
    """θ of N₀ and N̄ of each method with its interval, by the rule of a board on this suite."""
    seed = f"{suite.digest}\n{catalogue.find(ProtocolFile, 'paper-v1').digest}"
    runs, values = pd.read_csv(RESULTS / "baselines.csv"), ["wd_regret", "ood_regret"]
    members = suite.classes
    weights = {spec.digest: 1.0 / len(of.instances) for of in members for spec in of.instances}
    table = {}
    for method, of_method in runs.groupby("method"):
        groups = dict(iter(of_method.groupby("spec_digest")[values]))
        strata = {digest: np.sort(group.to_numpy(), axis=0) for digest, group in groups.items()}
        theta = aggregate(strata, iqm, weights)
        low, high = stratified_bootstrap(strata, 10_000, seed, iqm, weights)
        ends = np.transpose([theta, low, high]).ravel()
        table[method] = dict(
            zip(["N0", "low", "high", "mean N", "low ", "high "], ends, strict=True)
        )
    return pd.DataFrame(table).T.round(3)


def of_references(suite: Suite) -> pd.DataFrame:
    """N₀ and N̄ of the policies that learn nothing: means over classes of means over draws."""
    table = {}
    for policy in UNTRAINED:
        of_classes = []
        for member in suite.classes:
            reports = [evaluate(policy, task, "quick-v1") for task in member.instances]
            of_classes.append(np.mean([[r.wd_regret, r.ood_regret] for r in reports], axis=0))
        table[policy] = dict(zip(["N0", "mean N"], np.mean(of_classes, axis=0), strict=True))
    return pd.DataFrame(table).T.round(2)


def speeds() -> Iterator[Any]:
    """Medians over rounds of `make bench`, ratios of peer to ours, and how many met a target."""
    rounds = pd.read_csv(RESULTS / "speeds.csv")
    table = rounds.groupby(["title", "unit", "peer", "target"], sort=False)[["ours_s", "peer_s"]]
    table = table.median().reset_index("target")
    ratio = table["peer_s"] / table["ours_s"]
    targets = table["target"] > 0.0
    yield pd.DataFrame(
        {
            "ours": table["ours_s"].map(duration),
            "peer ": table["peer_s"].map(duration),
            "ratio": ratio.map("{:.2f}".format),
            "target ": table["target"].map("{:.3g}".format).where(targets, ""),
        }
    )
    met = ratio[targets] >= table["target"][targets]
    yield pd.Series({"met": met.sum(), "targets": targets.sum()})


def duration(seconds: float) -> str:
    """To three digits, with its unit."""
    return EngFormatter("s")(float(f"{seconds:.3g}"))


def equality(runs: pd.DataFrame) -> pd.DataFrame:
    """JAX minus SB3 in N₀: two one-sided t-tests against a margin, over pairs by instance."""
    wide = by_run(runs, "normalised_regret_0")
    table = {}
    for algorithm in ALGORITHMS:
        for name, group in wide.groupby(level=0, sort=False):
            change = group[f"jax-{algorithm}"] - group[algorithm]
            n, mean = len(change), change.mean()
            error = change.std() / np.sqrt(n)
            arm = stats.t.ppf(0.95, n - 1) * error
            p = max(
                stats.t.sf((mean + MARGIN) / error, n - 1),
                stats.t.cdf((mean - MARGIN) / error, n - 1),
            )
            table[algorithm, name] = {
                "JAX": group[f"jax-{algorithm}"].mean(),
                "SB3": group[algorithm].mean(),
                "difference": mean,
                "low": mean - arm,
                "high": mean + arm,
                "p": p,
                "excluded above": max(abs(mean - arm), abs(mean + arm)),
            }
    return pd.DataFrame(table).T.round(3)


def ablations() -> Iterator[Any]:
    """Levels by class, and of policies that learn nothing."""
    yield classes(rows("ablations-in-jax", "runs.csv"))
    yield from discounts()
    yield from profiles()
    runs = rows("ablations-in-jax", "runs-20000.csv")
    yield each_run(runs)
    yield classes(runs)["wd_regret"]
    yield runs.groupby("algorithm")["normalised_regret_0"].agg(["mean", "std"]).round(2)
    yield references("Default", "Complexity10")


def decay() -> Iterator[Any]:
    """Decays outside the cube, and what goes with them."""
    for name in ("runs.csv", "runs-20000.csv"):
        yield decays(rows("ablations-in-jax", name))
    yield decays_of_classes(rows("ablations-in-jax", "runs.csv"))
    yield references("Default", "Complexity10")


def agents() -> Iterator[Any]:
    """Speeds, whether two implementations learn alike, and baselines by the rule of a board."""
    yield from speeds()
    yield equality(rows("equal-agents", "runs.csv"))
    yield references("Default")
    suite = catalogue.find(SuiteFile, "smoke").suite
    yield of_board(suite)
    yield of_references(suite)


def continual() -> Iterator[Any]:
    """IQMs of lives with intervals, in the cube and outside; of visits; and of fresh agents."""
    lives = pd.read_csv(RESULTS / "continual" / "lives.csv")
    place = ["region", "class_name", "algorithm"]
    yield pd.DataFrame(
        {
            (*at, metric): with_bootstrap(of_method[[metric]], metric, *at)
            for at, of_method in lives.groupby(place, sort=False)
            for metric in OF_LIVES
        }
    ).T.round(2)
    visits = pd.read_csv(RESULTS / "continual" / "lives-visits.csv")
    for metric in ("normalised_regret", "fresh_normalised_regret", *OF_TRAINING):
        of_visits = visits.groupby([*place[1:], "visit"], sort=False)[metric]
        yield of_visits.agg(lambda runs: float(iqm(runs))).unstack().round(2)
    small = pd.read_csv(RESULTS / "continual" / "buffer.csv").groupby("visit")
    yield small["normalised_regret"].agg(["mean", "min", "max"]).round(2)
    yield small["forgetting"].mean().round(2)
    tasks = [phase.spec for phase in load("Switch5").phases]
    names = "linear", "random"
    untrained = [[evaluate(name, task, "quick-v1").wd_regret for name in names] for task in tasks]
    yield pd.DataFrame(untrained, columns=names).agg(["mean"]).round(2)


def offline() -> Iterator[Any]:
    """r̃ of the data, of BC and of IQL, from the cells; and of policies that do not train."""
    learners, untrained = {}, {}
    for path in sorted((RESULTS / "offline-quality" / "cells").glob("*.json")):
        cell = json.loads(path.read_text(encoding="utf-8"))
        depth, result = cell["cell"]["spec"]["complexity"], cell["offline"]
        data = result["behaviour_similarity"]
        row = learners.setdefault((depth, result["nu"]), {"data": data})
        row["data sd"] = result["behaviour_similarity_sd"]
        name = cell["cell"]["uses"].removeprefix("offline:")
        row[name], row[f"{name} sd"] = result["similarity"], result["similarity_sd"]
        row[f"{name} - data"] = result["similarity"] - data
        known = cell["report"]["references"]
        untrained[depth] = {policy: of[0]["similarity"] for policy, of in known.items()}
    yield pd.DataFrame(learners).T.sort_index().round(3)
    yield pd.DataFrame(untrained).T.sort_index().round(3)


PAGES = {page.__name__: page for page in (ablations, decay, agents, continual, offline)}
SCRIPTS = "foresight", "limits_and_distractors"  # pages whose own scripts also make their runs


def printed(page: str) -> str:
    """The tables of a page."""
    if page in SCRIPTS:
        return str(runpy.run_path(str(RESULTS / f"{page}.py"))["printed"]())
    return "\n\n".join(table.to_string() for table in PAGES[page]())


def main() -> None:
    """Print the tables, after writing the rows if a report's table is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", choices=[*PAGES, *SCRIPTS])
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--from", dest="results", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    if options.results:
        frames = pd.concat(pd.read_csv(path) for path in options.results)
        made = of_lives(frames) if options.page == "continual" else compact(frames)
        made.to_csv(options.rows, index=False)
    print(printed(options.page))


if __name__ == "__main__":
    main()

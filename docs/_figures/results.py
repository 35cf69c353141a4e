"""Figures of committed results, and of measurements that take seconds; nothing is trained."""

from __future__ import annotations

import csv
import io
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sme_registry import statistics
from sme_registry.diagnosis import diagnose, load_policy
from sme_registry.diagnosis.figures import draw
from sme_registry.evaluation import EvaluationReport
from sme_registry.io import read_json
from sme_registry.plots import decay_curve, learning_curve
from sme_registry.plots.style import COLOURS, GREY, MARKERS, legend_below, new_figure, styled
from sme_registry.profiles.document import Profile

from .method import draw_cube, draw_optimum, plane, spec_of

RESULTS = Path(__file__).parents[1] / "results"
_STEPS = 12  # of the drawn trajectory


def profiles() -> bytes:
    """The reference profile of PPO, before the others; small, as it has many lines."""
    content = io.BytesIO()
    Profile.references()["PPO"].draw().savefig(content, format="png", dpi=110)
    return content.getvalue()


def overview() -> Figure:
    """A task with a trajectory, PPO's regret as it learns, and its similarity by region."""
    depths = {"1 layer": 1, "10 layers": 10}
    runs: dict[str, list[Any]] = {name: [] for name in depths}
    reports: dict[str, list[EvaluationReport]] = {name: [] for name in depths}
    default = spec_of("Default")
    for cell in _cells("ablations"):
        spec = cell["cell"]["spec"]
        for name, layers in depths.items():
            same = default.derive(complexity=layers, seed=spec["seed"]).to_dict()
            if cell["cell"]["uses"] == "PPO" and spec == same:
                curve = cell["curve"]
                runs[name].append({"step": curve["steps"], "regret": curve["regret"]})
                reports[name].append(EvaluationReport.from_dict(cell["report"]))
    with styled():
        figure = new_figure((9.6, 3.1))
        task, learning, decay = figure.subplots(1, 3, width_ratios=(1, 1.2, 1.2))
        _draw_trajectory(task)
        learning_curve(runs, ax=learning)
        learning.set(title="Exact regret while PPO learns", ylabel="mean regret per step")
        decay_curve(reports, measures=("similarity",), references=False, ax=[decay])
        decay.axhline(1, color=GREY, linewidth=1.2)
        decay.set(title="… and afterwards, cube and shells", ylabel="similarity to the optimum")
        decay.set(xlabel="region: the training cube, shells 1 to 5", ylim=(0.7, 1.02))
        decay.set_xticks(decay.get_xticks(), ["cube", *"12345"])
        handles = learning.get_legend_handles_labels()[0]
        handles[-1].set_label("quartiles of runs")  # one line is a median, the other an IQM
        legend_below(figure, handles)
        return figure


def _draw_trajectory(axes: Axes) -> None:
    task = plane()
    draw_optimum(axes, task)
    draw_cube(axes)
    s = np.array([[0.2, 0.7]])
    path = [s[0]]
    for _ in range(_STEPS):
        s = task.transition(s, task.policy(s))
        path.append(s[0])
    x, y = np.array(path).T
    for colour, width in (("black", 2.0), ("white", 0.9)):
        axes.plot(x, y, color=colour, linewidth=width, marker="o", markersize=2 + 1.5 * width)
    axes.set_title("Optimal policy, known everywhere")


def diagnosis() -> bytes:
    """What the error of the linear policy on Complexity10 is, as `sme diagnose` draws it."""
    result = diagnose(load_policy("linear", spec_of("Complexity10")))
    with tempfile.TemporaryDirectory() as folder:
        draw(result, Path(folder))
        return (Path(folder) / "what_the_error_is.png").read_bytes()


def quality() -> Figure:
    """BC and IQL against the data's own similarity, over ν, at three depths; one seed."""
    points: dict[tuple[int, str], dict[float, float]] = {}
    for cell in _cells("offline-quality"):
        offline, layers = cell["offline"], cell["cell"]["spec"]["complexity"]
        learner = cell["cell"]["uses"].removeprefix("offline:").upper()
        points.setdefault((layers, learner), {})[offline["nu"]] = offline["similarity"]
        data = points.setdefault((layers, "the data"), {})
        data[offline["nu"]] = offline["behaviour_similarity"]
    depths = sorted({layers for layers, _ in points})
    with styled():
        figure = new_figure((8.2, 2.7))
        panels = figure.subplots(1, len(depths), sharey=True)
        for axes, layers in zip(panels, depths, strict=True):
            for index, name in enumerate(("BC", "IQL", "the data")):
                nu, similarity = zip(*sorted(points[layers, name].items()), strict=True)
                style: Any = {"color": COLOURS[index], "marker": MARKERS[index]}
                if name == "the data":
                    style = {"color": GREY, "linestyle": (0, (5, 2))}
                axes.plot(nu, similarity, label=name, linewidth=2, markersize=5, **style)
            axes.set(title=f"L = {layers}", xlabel="ν of the data")
        panels[0].set_ylabel("similarity r̃")
        legend_below(figure, panels[0].get_legend_handles_labels()[0])
        return figure


def ranks() -> Figure:
    """θ of N₀ and N̄ with 95 % intervals, of the published baselines."""
    with styled():
        figure = new_figure((8.2, 2.1))
        panels = figure.subplots(1, 2, sharey=True)
        methods = baselines()
        for column, title in enumerate(("in the cube, N₀", "outside, N̄")):
            for row, estimates in enumerate(methods.values()):
                (value, low, high), colour = estimates[column], COLOURS[row]
                panels[column].plot([low, high], [-row, -row], color=colour, linewidth=2.5)
                panels[column].plot(value, -row, MARKERS[row], color=colour, markersize=8)
            label = "normalised regret θ  (0 = optimal)"
            panels[column].set(title=title, xlabel=label, xlim=(0, 0.65))
            panels[column].set_yticks([-row for row in range(len(methods))], list(methods))
            panels[column].margins(y=0.25)
        return figure


def baselines() -> dict[str, list[tuple[float, float, float]]]:
    """θ, low and high of N₀ and of N̄, by method, by the rule of a board."""
    with (RESULTS / "baselines.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for method in ("TD3", "PPO", "SAC"):
        # A board's score of a class is the mean over its instances, of which each has two here.
        instances: dict[str, Any] = defaultdict(list)
        for row in rows:
            if row["method"] == method:
                scores = [float(row["wd_regret"]), float(row["ood_regret"])]
                instances[f"{row['class_name']} {row['spec_digest']}"].append(scores)
        instances = {name: np.array(scores) for name, scores in instances.items()}
        low, high = statistics.stratified_bootstrap(instances, 10_000, "baselines")
        estimates = np.stack([statistics.aggregate(instances), low, high], axis=1)
        found[method] = [tuple(estimate) for estimate in estimates.round(3).tolist()]
    return found


def _cells(study: str) -> Iterator[dict[str, Any]]:
    """The finished runs of a committed study."""
    for path in sorted((RESULTS / study / "cells").glob("*.json")):
        yield read_json(path)

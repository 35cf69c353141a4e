"""What the method is: the optimal policy, the regions of an evaluation, and how a step is paid."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sme_registry.evaluation import reference_policy
from sme_registry.plots.style import COLOURS, GREY, MARKERS, new_figure, styled
from sme_registry.spec import EnvFile, SMESpec, catalogue
from sme_registry.task import Task, materialize

PLANE = "Plane10"
_SIDE = (-0.5, 1.5)
_LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_MINIMA = (0.0, 0.5)  # r_min
_INTERVAL, _STEPS = 5, 20


def spec_of(name: str) -> SMESpec:
    """A task of the catalogue."""
    return catalogue.find(EnvFile, name).spec


def plane() -> Task:
    """The task whose π* is drawn."""
    return materialize(spec_of(PLANE))


def draw_optimum(axes: Axes, task: Task, points: int = 161) -> Any:
    """Action channel 1 of π* over the plane, inside and outside the cube; returns its image."""
    side = np.linspace(*_SIDE, points)
    s = np.stack(np.meshgrid(side, side), axis=-1)
    a = np.stack([task.policy(row)[:, 0] for row in s])
    axes.grid(visible=False)
    axes.set(xlabel="state channel 1", ylabel="state channel 2", aspect="equal")
    axes.locator_params(nbins=5)
    return axes.contourf(side, side, a, levels=np.linspace(0, 1, 13), cmap="viridis")


def draw_cube(axes: Axes, epsilon: float = 0.0, width: float = 1.2) -> None:
    """The outline of X_ε, legible on dark and on light colours."""
    low, high = -epsilon / 2, 1 + epsilon / 2
    for colour, extra in (("white", 1.6), ("black", 0.0)):
        x, y = [low, high, high, low, low], [low, low, high, high, low]
        axes.plot(x, y, color=colour, linewidth=width + extra)


def regions() -> Figure:
    """The regions, the step reward, and when the agent is paid."""
    with styled():
        figure = new_figure((9.6, 3.1))
        where, reward, paid = figure.subplots(1, 3, width_ratios=(1, 1.05, 1.25))
        task = plane()
        draw_optimum(where, task)
        for m, epsilon in enumerate(_LEVELS):
            draw_cube(where, epsilon, 1.4 if m == 0 else 0.7)
            name, at = ("WD", 0.5) if m == 0 else (f"{m}", 1 + epsilon / 2 - 0.05)
            where.text(
                at, 0.5, name, ha="center", va="center", fontsize=8,
                bbox={"boxstyle": "round,pad=0.12", "color": "white"},
            )  # fmt: skip
        where.set_title("Regions of an evaluation")
        _draw_reward(reward, task.spec)
        _draw_payments(paid)
        return figure


def _draw_reward(axes: Axes, spec: SMESpec) -> None:
    similarity = np.linspace(0.5, 1, 501)
    for index, r_min in enumerate(_MINIMA):
        r = materialize(spec.derive(r_min=r_min)).reward_of(similarity)
        style: Any = {"color": COLOURS[index], "linestyle": ("-", (0, (5, 2)))[index]}
        axes.plot(similarity, r, linewidth=2, label=f"r_min = {r_min:g}", **style)
    axes.axvline(0.75, color=GREY, linewidth=1, linestyle=":")
    axes.set(xlabel="similarity r̃ of the action", ylabel="step reward r", title="Step reward")
    axes.legend(loc="upper left", fontsize=8)


def _draw_payments(axes: Axes) -> None:
    """Step rewards of the linear policy, and what the agent receives with k = 5."""
    spec = spec_of("Interval5")
    task, act = materialize(spec), reference_policy("linear", spec)
    assert not isinstance(act, dict)  # as of a team
    s = np.full((1, spec.state_dim), 0.3)
    rewards = []
    for _ in range(_STEPS):
        observation = np.concatenate([s, np.zeros((1, 2))], axis=1).astype(np.float32)
        a = np.clip(act(observation), 0.0, 1.0)
        rewards.append(float(task.reward_of(task.similarity_of(a, task.policy(s)))[0]))
        s = task.transition(s, a)
    steps = np.arange(1, _STEPS + 1)
    axes.bar(steps, rewards, color=COLOURS[5], label="step reward")
    ends = steps[_INTERVAL - 1 :: _INTERVAL]
    sums = np.add.reduceat(rewards, np.arange(0, _STEPS, _INTERVAL))
    axes.vlines(ends, 0, sums, color=COLOURS[1], linewidth=1.5)
    axes.plot(ends, sums, MARKERS[1], color=COLOURS[1], label="received, k = 5")
    axes.set(xlabel="step of the episode", ylabel="reward", title="Reward interval")
    axes.set_ylim(0, 6.4)
    axes.legend(loc="upper left", fontsize=8, ncols=2)

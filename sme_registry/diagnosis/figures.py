"""The figures of a diagnosis: by channel, state and time; of a team by agent; of a life by visit.

`sme evaluate` draws the shells, limits, distractors and layers, and what a life costs and retains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sme_registry.diagnosis.behaviour import CONSTANTS
from sme_registry.diagnosis.critics import CriticReport
from sme_registry.diagnosis.document import Diagnosis, TaskDiagnosis
from sme_registry.diagnosis.measure import LINEAR
from sme_registry.diagnosis.stream import StreamDiagnosis
from sme_registry.diagnosis.task import TeamDiagnosis
from sme_registry.evaluation.references import LABELS
from sme_registry.plots.curves import tick_visits
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    draw_reference,
    entitle,
    legend_above,
    look,
    merge_coincident,
    new_figure,
    save_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST = 32  # channels or agents in one panel
_OF_NETWORKS = {
    "inactive_units": "inactive hidden units, share",
    "effective_rank": "effective rank of the last hidden layer",
    "weight_norm": "norm of the weights",
}
_RANKING = "ranking by the critic, share"
_REGRET = "normalised regret  (0 = optimal)"


def draw(diagnosis: Diagnosis, folder: Path) -> tuple[Path, ...]:
    """Write the figures into a folder, as PNG and PDF."""
    written = []
    for name, fill in _FIGURES[type(diagnosis)].items():
        with styled():
            figure = new_figure((8.2, 4.0))
            entitle(figure, diagnosis.title)
            fill(diagnosis, figure)
        if figure.axes:
            written += save_figure(figure, folder / name, WRITTEN)
    return tuple(written)


def _lines(axes: Axes, x: Any, series: Mapping[str, Any]) -> None:
    """A line of each series, by its label, over the same x."""
    for index, (label, values) in enumerate(series.items()):
        y = np.array(values, float)  # none where a value is None
        axes.plot(x, y, **look(index), markersize=4.5, linewidth=2, label=label)


def _reference(axes: Axes, value: float, name: str) -> None:
    draw_reference(axes, name, None, value, LABELS[name])


def _bars(axes: Axes, x: Any, groups: Mapping[str, Sequence[float]], beside: str) -> None:
    """Bars of each group side by side at the places x; those of the group `beside` are hatched."""
    width = 0.8 / len(groups)
    for index, (label, values) in enumerate(groups.items()):
        style: dict[str, Any] = {"color": COLOURS[index]}
        if label == beside:
            style = {"color": "white", "hatch": "////"}
        places = np.asarray(x) + (index - (len(groups) - 1) / 2) * width
        axes.bar(places, values, width, label=label, edgecolor=GREY, **style)


def _legends(*panels: Axes) -> None:
    """A legend above each panel, after its limits."""
    for axes in panels:
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), high)
        merge_coincident([axes])
        legend_above(axes)


def _channels(diagnosis: TaskDiagnosis, figure: Figure) -> None:
    every = diagnosis.measurements.channels
    channels, cut = every[:_MOST], f" (the first {_MOST})" if len(every) > _MOST else ""
    x = [channel.channel for channel in channels]
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.set(xlabel=f"action channel{cut}", xticks=x[:: max(1, len(x) // 8)])
    regrets = {
        diagnosis.name: [c.normalised_regret for c in channels],
        LABELS[LINEAR]: [c.linear_normalised_regret for c in channels],
    }
    _bars(left, x, regrets, beside=LABELS[LINEAR])
    _reference(left, 1.0, "constant")
    left.set_ylabel(_REGRET)
    series = {
        "slope of a on a*  (1 = optimal)": [c.slope for c in channels],
        "offset, mean of a − a*  (0 = optimal)": [c.offset for c in channels],
        "share of states at 0 or 1": [c.at_zero + c.at_one for c in channels],
    }
    _lines(right, x, series)
    for value in (0.0, 1.0):
        right.axhline(value, color=GREY, linewidth=0.9)
    _legends(left, right)


def _states(diagnosis: TaskDiagnosis, figure: Figure) -> None:
    measured, threshold = diagnosis.measurements, diagnosis.thresholds["explained_variance"]
    left, right = figure.subplots(1, 2)
    centre, *channels = measured.partitions
    best = sorted(channels, key=lambda p: -p.explained_variance)[:2]
    parts = {"distance": centre, **{f"s{p.state_channel}": p for p in best}}
    left.bar(
        list(parts), [part.explained_variance for part in parts.values()], 0.6,
        color=COLOURS[: len(parts)], edgecolor="white", hatch=("", "////", "....")[: len(parts)],
    )  # fmt: skip
    left.axhline(threshold, color=GREY, linewidth=1.1, label=f"stands out above {threshold:.0%}")
    fifths = 1 + np.arange(len(centre.mae))
    names = ["distance from the centre", *(f"state channel {p.state_channel}" for p in best)]
    _lines(right, fifths, {name: p.mae for name, p in zip(names, parts.values(), strict=True)})
    left.set(
        xlabel="quantity that explains it",
        ylabel="share of the error's\nvariance explained",
        ylim=(0.0, max(0.12, left.get_ylim()[1])),
    )
    _reference(right, measured.uniform[LINEAR].mae, LINEAR)
    right.set(
        xlabel="fifth of the states, by quantity", ylabel="error, mean |a − a*|", xticks=fifths
    )
    _legends(left, right)


def _time(diagnosis: TaskDiagnosis, figure: Figure) -> None:
    measured = diagnosis.measurements
    episodes, time = measured.on_policy, measured.time_dependence
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    series = {"regret, 1 − r": episodes.regret, "error, mean |a − a*|": episodes.mae}
    if min(episodes.alive) < 1.0:
        series["share of episodes running"] = episodes.alive
    _lines(left, middles, series)
    for name in (LINEAR, *CONSTANTS):
        _reference(left, episodes.scores[name].regret, name)
    over = f"mean over {episodes.episodes} episodes\n(grey: regret of references)"
    left.set(xlabel="step of the episode", ylabel=over)
    series = {"in the same states": time.normalised_regret, "change of a": time.action_change}
    _lines(right, time.inputs, series)
    _reference(right, measured.uniform[LINEAR].normalised_regret, LINEAR)
    right.set(xlabel="input t/T, in fixed states", ylabel="normalised regret;\nmean |change of a|")
    _legends(left, right)


def _squared_error(diagnosis: TaskDiagnosis, figure: Figure) -> None:
    error, episodes = diagnosis.measurements.squared_error, diagnosis.measurements.on_policy
    left, right = figure.subplots(1, 2)
    shares = {
        "offset": error.offset,
        "scale": error.scale,
        "residual": error.residual,
        "· noise": error.noise,
        "· input t/T": error.time,
        "· input r_cum/k": error.accumulated_reward,
    }
    bars = left.barh(list(shares), list(shares.values()), 0.6, color=COLOURS[0])
    left.bar_label(bars, [f"{share:.0%}" for share in shares.values()], padding=3, fontsize=8)
    left.invert_yaxis()
    left.grid(visible=False, axis="y")
    left.set(xlabel="share of the squared error", xlim=(0.0, 1.15), xticks=np.linspace(0, 1, 6))
    looks = {"rewarded": ("r > 0", COLOURS[2], ""), "gated": ("0 by r_min", COLOURS[4], "////"),
             "flat": ("r̂ = 0", "#cccccc", "")}  # fmt: skip
    start = np.zeros(2)
    for name, (label, colour, hatch) in looks.items():
        widths = [getattr(signal, name) for signal in (episodes.signal, episodes.random_signal)]
        right.barh(
            (0, 1), widths, 0.55, left=start, color=colour, hatch=hatch, edgecolor="black",
            linewidth=0.5, label=label,
        )  # fmt: skip
        start = start + widths
    right.set_yticks((0, 1), (diagnosis.name, "random\nactions"))
    right.set(xlabel="share of steps", xlim=(0.0, 1.0), ylim=(1.6, -0.6))
    right.grid(visible=False, axis="y")
    legend_above(right, ncols=3, columnspacing=1.0, handlelength=1.4)


def _agents(diagnosis: TeamDiagnosis, figure: Figure) -> None:
    agents = diagnosis.agents[:_MOST]
    left, right = figure.subplots(1, 2)
    of_team = [diagnosis.shares(agent) for agent in agents]
    shares = {
        "share of the team's regret": [share["regret_share"] for share in of_team],
        "share of the action channels": [share["channel_share"] for share in of_team],
    }
    regrets = {
        "uniform states": [agent.uniform_regret for agent in agents],
        "its own episodes": [agent.visited_regret for agent in agents],
        "linear policy": [agent.linear_regret for agent in agents],
    }
    x = np.arange(len(agents))
    _bars(left, x, shares, beside="share of the action channels")
    _bars(right, x, regrets, beside="linear policy")
    right.axhline(1.0, color=GREY, linewidth=0.9)
    left.set_ylabel("share")
    right.set(ylabel=_REGRET, ylim=(0.0, max(1.05, right.get_ylim()[1])))  # 1 is the constant ½
    for axes in (left, right):
        axes.set_xticks(x, [agent.name for agent in agents], rotation=30, ha="right", fontsize=8)
        legend_above(axes)


def _critic(diagnosis: TaskDiagnosis, figure: Figure) -> None:
    """Nothing without a critic; only its level where it values states, and its ranking for IQL."""
    report = diagnosis.measurements.critic
    if report is None:
        return
    ranked = [region for region in report.regions if region.ranking is not None]
    draw = [_draw_ranking] * bool(ranked) + [_draw_levels] * bool(report.times)
    if not draw:
        return
    panels = figure.subplots(1, len(draw), squeeze=False)[0]
    for axes, drawn in zip(panels, draw, strict=True):
        drawn(axes, report)
    _legends(*panels)


def _draw_ranking(axes: Axes, report: CriticReport) -> None:
    ranked = [region for region in report.regions if region.ranking is not None]
    series = {"as their step rewards": [region.ranking for region in ranked]}
    if ranked[0].misled_ranking is not None:
        name = f"as paid at γ = {report.gamma:g}"
        series[name] = [region.misled_ranking for region in ranked]
    _lines(axes, range(len(ranked)), series)
    axes.axhline(0.5, color=GREY, linewidth=1.1, label="chance")
    axes.set_xticks(range(len(ranked)), [region.region for region in ranked], rotation=45)
    axes.set(ylabel="pairs of actions that the critic\norders so, share", ylim=(0.0, 1.0))


def _draw_levels(axes: Axes, report: CriticReport) -> None:
    levels = {"the critic says": "claim", "to the end of the episode": "finite"}
    if report.regions[0].continuing is not None:
        levels["if it went on"] = "continuing"
    series = {name: [getattr(part, of) for part in report.times] for name, of in levels.items()}
    _lines(axes, [part.time for part in report.times], series)
    axes.set(xlabel="t/T", ylabel="discounted value")


def _network_by_visit(diagnosis: StreamDiagnosis, figure: Figure) -> None:
    """Nothing where no network is known."""
    visits, initial = diagnosis.visits, diagnosis.initial_network is not None
    networks = [visit.network for visit in visits]
    if not any(networks):
        return
    if initial:
        networks.insert(0, diagnosis.initial_network)
    alone = [diagnosis.phases[visit.phase].fresh_network for visit in visits]
    series: dict[str, tuple[list[Any], list[Any]]] = {
        name: (
            [getattr(network, quantity, None) for network in networks],
            [getattr(network, quantity, None) for network in alone],
        )
        for quantity, name in _OF_NETWORKS.items()
    }
    rankings = [visit.critic_ranking for visit in visits]
    if any(ranking is not None for ranking in rankings):
        series[_RANKING] = [*[None] * initial, *rankings], []
    figure.set_figwidth(2.8 * len(series))
    panels = figure.subplots(1, len(series))
    for axes, (name, (life, fresh)) in zip(panels, series.items(), strict=True):
        _lines(axes, np.arange(len(life)) - initial, {"this life": life})
        if name == _RANKING:
            axes.axhline(0.5, color=GREY, linewidth=1.1)  # chance
        elif None not in fresh:  # a stroke across each visit
            x, label = np.arange(len(fresh)), "fresh agent of the phase"
            axes.hlines(fresh, x - 0.45, x + 0.45, color="black", linewidth=1.6, label=label)
        tick_visits(axes, cast(Any, visits), initial=initial)
        highest = max(number for number in (*life, *fresh) if number is not None)
        axes.set(ylabel=name, ylim=(0.0, max(0.05, 1.08 * highest)))
    legend_above(panels[0])


_FIGURES: dict[type[Diagnosis], dict[str, Callable[[Any, Figure], None]]] = {
    TaskDiagnosis: {
        "where_channels": _channels,
        "where_states": _states,
        "where_time": _time,
        "what_the_error_is": _squared_error,
        "what_the_critic_knows": _critic,
    },
    TeamDiagnosis: {"who_agents": _agents},
    StreamDiagnosis: {"network_by_visit": _network_by_visit},
}

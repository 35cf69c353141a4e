"""The figures of a diagnosis: of a task by channel, state, shell, time and training; of a team by
agent; of a life by visit and phase."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sme_registry.diagnosis.behaviour import Log, OnPolicy, TrainingSummary
from sme_registry.diagnosis.document import Diagnosis
from sme_registry.diagnosis.measure import LINEAR, POLICY, DistractorRegret, Violations
from sme_registry.diagnosis.questions import Measurements
from sme_registry.diagnosis.stream import StreamDiagnosis
from sme_registry.diagnosis.subject import AnySubject, StreamSubject, Subject
from sme_registry.diagnosis.task import TaskDiagnosis
from sme_registry.diagnosis.team import TeamDiagnosis
from sme_registry.evaluation import ObservationReport
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.regions import LayerProbe
from sme_registry.plots.curves import draw_training, tick_visits
from sme_registry.plots.maps import retention_map
from sme_registry.plots.reports import draw_cost
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    draw_reference,
    entitle,
    legend_above,
    legend_below,
    look,
    merge_coincident,
    new_figure,
    save_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REFERENCES = (LINEAR, "best_constant", "constant_half", "uniform_random")
_MOST = 32  # channels or agents in one panel
_FRESH = "fresh agent of the phase"
_REGRET = "normalised regret  (0 = optimal)"


def draw(diagnosis: Diagnosis, folder: Path, subject: AnySubject | None = None) -> tuple[Path, ...]:
    """Write the figures into a folder, as PNG and PDF.

    The training is drawn where the subject has a log, and what a life retained from its report.
    """
    written = []
    for name, fill in _fills(diagnosis, subject):
        with styled():
            figure = new_figure((8.2, 4.0))
            entitle(figure, diagnosis.title)
            fill(figure)
        written += save_figure(figure, folder / name, WRITTEN)
    if isinstance(subject, StreamSubject):
        written += save_figure(retention_map(subject.report), folder / "what_is_retained", WRITTEN)
    return tuple(written)


def _fills(
    diagnosis: Diagnosis, subject: AnySubject | None
) -> Iterator[tuple[str, Callable[[Figure], None]]]:
    """The figures by name, and what fills each of them."""
    if isinstance(diagnosis, TeamDiagnosis):
        yield "who_agents", partial(_agents, diagnosis)
    elif isinstance(diagnosis, StreamDiagnosis):
        yield "which_phases", partial(_which_phases, diagnosis)
        if any(visit.network is not None for visit in diagnosis.visits):
            yield "network_by_visit", partial(_network_by_visit, diagnosis)
    elif isinstance(diagnosis, TaskDiagnosis):
        measured, observation = diagnosis.measurements, diagnosis.measurements.observation
        yield "where_channels", partial(_channels, measured)
        yield "where_states", partial(_states, measured, diagnosis.thresholds["explained_variance"])
        yield "where_time", partial(_time, measured)
        yield "what_the_error_is", partial(_squared_error, measured)
        if isinstance(subject, Subject) and subject.log is not None and measured.training:
            yield "training", partial(_training, measured.on_policy, measured.training, subject.log)
        if measured.limits is not None:
            yield "limits", partial(_limits, measured.limits)
        if observation is not None and measured.distraction is not None:
            yield "distraction", partial(_distraction, measured.distraction, observation)
        if observation is not None and len(observation.probes) > 1:
            yield "layers", partial(_layers, observation.probes)


def _lines(axes: Axes, x: Any, series: Mapping[str, Any]) -> None:
    """A line of each series, by its label, over the same x."""
    for index, (label, values) in enumerate(series.items()):
        y = np.array(values, float)  # none where a value is None
        axes.plot(x, y, **look(index), markersize=4.5, linewidth=2, label=label)


def _reference(axes: Axes, value: float, name: str) -> None:
    draw_reference(axes, name, None, value, LABELS[name])


def _bars(
    axes: Axes, x: Any, groups: Mapping[str, Sequence[float | None]], beside: str = ""
) -> None:
    """Bars of each group side by side at the places x; those of the group `beside` are hatched."""
    width = 0.8 / len(groups)
    for index, (label, values) in enumerate(groups.items()):
        heights = np.array(values, dtype=float)  # none where a value is None
        style: dict[str, Any] = {"color": COLOURS[index]}
        if label == beside:
            style = {"color": "white", "hatch": "////"}
        axes.bar(
            np.asarray(x) + (index - (len(groups) - 1) / 2) * width, heights, width,
            label=label, edgecolor=GREY, **style,
        )  # fmt: skip


def _shares(axes: Axes, shares: Mapping[str, float], text: str, colours: Any = COLOURS[0]) -> None:
    """A bar along each line, with its value as text behind it."""
    bars = axes.barh(list(shares), list(shares.values()), 0.6, color=colours)
    axes.bar_label(bars, [text.format(share) for share in shares.values()], padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")


def _tick_channels(axes: Axes, channels: Sequence[Any]) -> list[int]:
    """Label the x axis with action channels, as many as fit; returns these."""
    numbers = [channel.channel for channel in channels[:_MOST]]
    cut = f" (the first {_MOST})" if len(channels) > _MOST else ""
    axes.set(xlabel=f"action channel{cut}", xticks=numbers[:: max(1, len(numbers) // 8)])
    return numbers


def _legends(*panels: Axes, ncols: int = 1) -> None:
    """A legend above each panel, after its limits."""
    for axes in panels:
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), high)
        merge_coincident([axes])
        legend_above(axes, ncols=ncols)


def _channels(measured: Measurements, figure: Figure) -> None:
    channels = measured.channels[:_MOST]
    left, right = figure.subplots(1, 2)
    x, _ = (_tick_channels(axes, measured.channels) for axes in (left, right))
    regrets = {
        "this policy": [c.normalised_regret for c in channels],
        LABELS[LINEAR]: [c.linear_normalised_regret for c in channels],
    }
    _bars(left, x, regrets, beside=LABELS[LINEAR])
    _reference(left, 1.0, "constant_half")
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


def _states(measured: Measurements, threshold: float, figure: Figure) -> None:
    left, middle, right = figure.subplots(1, 3)
    centre, *channels = measured.partitions
    best = sorted(channels, key=lambda p: -p.explained_variance)[:2]
    names = ["distance from the centre", *(f"state channel {p.state_channel}" for p in best)]
    for index, part in enumerate((centre, *best)):
        left.bar(
            index, part.explained_variance, 0.6, color=COLOURS[index], edgecolor="white",
            hatch=("", "////", "....")[index],
        )  # fmt: skip
    fifths = 1 + np.arange(len(centre.mae))
    _lines(middle, fifths, {name: p.mae for name, p in zip(names, (centre, *best), strict=True)})
    left.axhline(threshold, color=GREY, linewidth=1.1, label=f"stands out above {threshold:.0%}")
    left.set(
        xlabel="quantity that explains it",
        ylabel="share of the error's\nvariance explained",
        ylim=(0.0, max(0.12, left.get_ylim()[1])),
    )
    left.set_xticks(range(len(names)), ["distance", *(f"s{p.state_channel}" for p in best)])
    _reference(middle, measured.uniform[LINEAR].mae, LINEAR)
    middle.set(
        xlabel="fifth of the states, by quantity",
        ylabel="error, mean |a − a*|",
        xticks=fifths,
    )
    levels = [shell.epsilon for shell in measured.shells]
    regrets = {
        name: [shell.scores[name].normalised_regret for shell in measured.shells]
        for name in (POLICY, *_REFERENCES)
    }
    _lines(right, levels, {"this policy": regrets.pop(POLICY)})
    for name, values in regrets.items():
        draw_reference(right, name, levels, values, LABELS[name])
    right.set_xticks(levels, ["WD", *(f"{level:g}" for level in levels[1:])])
    right.set(xlabel="expansion level ε of the shell", ylabel="normalised regret")
    _legends(left, middle, right)


def _time(measured: Measurements, figure: Figure) -> None:
    episodes, time = measured.on_policy, measured.time_dependence
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    series = {"regret, 1 − r": episodes.regret, "error, mean |a − a*|": episodes.mae}
    if min(episodes.alive) < 1.0:
        series["share of episodes running"] = episodes.alive
    _lines(left, middles, series)
    for name in _REFERENCES[:3]:
        _reference(left, episodes.scores[name].regret, name)
    over = f"mean over {episodes.episodes} episodes\n(grey: regret of references)"
    left.set(xlabel="step of the episode", ylabel=over)
    series = {"in the same states": time.normalised_regret, "change of a": time.action_change}
    _lines(right, time.inputs, series)
    _reference(right, measured.uniform[LINEAR].normalised_regret, LINEAR)
    right.set(xlabel="input t/T, in fixed states", ylabel="normalised regret;\nmean |change of a|")
    _legends(left, right)


def _squared_error(measured: Measurements, figure: Figure) -> None:
    error, episodes = measured.squared_error, measured.on_policy
    left, right = figure.subplots(1, 2)
    shares = {
        "offset": error.offset,
        "scale": error.scale,
        "residual": error.residual,
        "· noise": error.noise,
        "· input t/T": error.time,
        "· input r_cum/k": error.accumulated_reward,
    }
    _shares(left, shares, "{:.0%}")
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
    right.set_yticks((0, 1), ("this policy", "random\nactions"))
    right.set(xlabel="share of steps", xlim=(0.0, 1.0), ylim=(1.6, -0.6))
    right.grid(visible=False, axis="y")
    legend_above(right, ncols=3, columnspacing=1.0, handlelength=1.4)


def _training(episodes: OnPolicy, training: TrainingSummary, log: Log, figure: Figure) -> None:
    axes = figure.add_subplot()
    draw_training(axes, log.step, log.regret, unit=log.source.removesuffix("s"))
    for name in _REFERENCES[:3]:
        _reference(axes, episodes.scores[name].regret, name)
    regret = episodes.scores[POLICY].regret
    axes.axhline(regret, color=COLOURS[1], linewidth=1.6, label="this policy")
    if training.improvement_step is not None:
        axes.axvline(training.improvement_step, color="black", linewidth=0.9, linestyle=":")
        late = training.improvement_step > training.steps / 2
        axes.annotate(
            "better than a constant", (training.improvement_step, 0.02),
            xytext=(-4 if late else 4, 0), textcoords="offset points", fontsize=8,
            ha="right" if late else "left",
        )  # fmt: skip
    merge_coincident([axes])
    legend_below(figure, axes.get_legend_handles_labels()[0])


def _limits(limits: Violations, figure: Figure) -> None:
    """Reward against cost, and which action channels violate their limits."""
    left, right = figure.subplots(1, 2)
    scores = {
        "this policy": limits.report.regions[0],
        "cut off at the limits": limits.cut_off,
        "in visited states": limits.visited,
    }
    runs = [(name, [[score]]) for name, score in scores.items()]
    draw_cost(left, runs, [limits.report], slice(1))
    x, channels = _tick_channels(right, limits.channels), limits.channels[:_MOST]
    shares = {
        "this policy": [c.violating_share for c in channels],
        LABELS["optimal"]: [c.optimal_violating_share for c in channels],
    }
    _bars(right, x, shares, beside=LABELS["optimal"])
    top = max(0.1, right.get_ylim()[1])
    right.set(ylabel="share of states above the limit", ylim=(0.0, top))
    _legends(left, right, ncols=2)


def _distraction(
    distraction: DistractorRegret, observation: ObservationReport, figure: Figure
) -> None:
    """Regret with other distractors, and how much they move the actions."""
    left, right = figure.subplots(1, 2)
    regrets = {
        "uniform": distraction.normalised_regret,
        "averaged out": distraction.averaged_regret,
        "all at ½": distraction.half_regret,
        **{region.name: region.normalised_regret for region in observation.distractor_regions},
    }
    outside = len(observation.distractor_regions)
    _shares(left, regrets, "{:.2f}", [COLOURS[0]] * 3 + [COLOURS[1]] * outside)
    left.axvline(
        1.0, color=GREY, linewidth=1.1, linestyle=(0, (4, 4)), label=LABELS["constant_half"]
    )
    most = max(regrets.values())
    left.set(xlabel=_REGRET, ylabel="distractors", xlim=(0.0, max(1.15, 1.1 * most)))
    changes = {region.name: region.invariance for region in observation.invariance}
    bars = right.bar(list(changes), list(changes.values()), 0.7, color=COLOURS[2])
    right.bar_label(bars, [f"{change:.2f}" for change in changes.values()], padding=2, fontsize=8)
    right.set(
        xlabel="region of the state",
        ylabel="change of a by other distractors\n(unit: mean |½ − a*|)",
        ylim=(0.0, max(0.1, 1.15 * max(changes.values()))),
    )
    right.grid(visible=False, axis="x")
    legend_above(left)


def _layers(probes: Sequence[LayerProbe], figure: Figure) -> None:
    """What a linear map recovers from each layer."""
    axes = figure.add_subplot()
    x, series = np.arange(len(probes)), {"of the state": [p.state_r2 for p in probes]}
    if probes[0].distractor_r2 is not None:
        series["of the distractors"] = [p.distractor_r2 or 0.0 for p in probes]
    _lines(axes, x, series)
    layers = [f"hidden {p.layer}\n({p.units} units)" for p in probes[1:]]
    axes.set_xticks(x, [f"observation\n({probes[0].units})", *layers])
    bottom = min(-0.03, axes.get_ylim()[0])
    axes.set(ylabel="held-out R²  (1 = recovered by a linear map)", ylim=(bottom, 1.03))
    legend_above(axes, ncols=2)


def _agents(diagnosis: TeamDiagnosis, figure: Figure) -> None:
    agents = diagnosis.agents[:_MOST]
    left, right = figure.subplots(1, 2)
    regret = max(diagnosis.visited.regret, 1e-12)
    shares = {
        "share of the team's regret": [agent.visited.regret_share / regret for agent in agents],
        "share of the action channels": [
            len(agent.action_channels) / diagnosis.spec.action_dim for agent in agents
        ],
    }
    regrets = {
        "uniform states": [agent.measurements.policy.normalised_regret for agent in agents],
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


def _which_phases(diagnosis: StreamDiagnosis, figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    visits, phases = diagnosis.visits, diagnosis.phases
    _bars(left, range(len(visits)), {"this life": [visit.online_regret for visit in visits]})
    _draw_fresh(left, [phases[visit.phase].fresh_online_regret for visit in visits])
    tick_visits(left, cast(Any, visits))
    left.set(xlabel="visit of phase", ylabel="online regret of the visit, mean of 1 − r")
    regrets = {
        "after its best visit": [phase.best_normalised_regret for phase in phases],
        "at the end of the life": [phase.final_normalised_regret for phase in phases],
    }
    _bars(right, range(len(phases)), regrets)
    _draw_fresh(right, [phase.fresh_normalised_regret for phase in phases])
    right.axhline(1.0, color=GREY, linewidth=0.9, linestyle=(0, (4, 4)), label="constant ½")
    every = -(-len(phases) // 15)
    right.set_xticks(range(0, len(phases), every), [str(phase.phase) for phase in phases[::every]])
    right.set(xlabel="phase", ylabel=_REGRET)
    for axes in (left, right):
        axes.set_ylim(bottom=0.0)
        legend_above(axes)


def _draw_fresh(axes: Axes, values: Sequence[float | None]) -> None:
    """A stroke across each place, of its fresh agent, where all of them are known."""
    x = np.arange(len(values))
    if None not in values:
        numbers = np.array(values, float)
        axes.hlines(numbers, x - 0.45, x + 0.45, color="black", linewidth=1.6, label=_FRESH)


def _network_by_visit(diagnosis: StreamDiagnosis, figure: Figure) -> None:
    quantities = {
        "inactive_units": "inactive hidden units, share",
        "effective_rank": "effective rank of the last hidden layer",
        "weight_norm": "norm of the weights",
    }
    networks = [visit.network for visit in diagnosis.visits]
    initial = diagnosis.initial_network is not None
    if initial:
        networks.insert(0, diagnosis.initial_network)
    alone = [diagnosis.phases[visit.phase].fresh_network for visit in diagnosis.visits]
    x = np.arange(len(networks)) - initial
    panels = figure.subplots(1, len(quantities))
    for axes, (quantity, name) in zip(panels, quantities.items(), strict=True):
        life, fresh = ([getattr(n, quantity, None) for n in group] for group in (networks, alone))
        _lines(axes, x, {"this life": life})
        _draw_fresh(axes, fresh)
        tick_visits(axes, cast(Any, diagnosis.visits), initial=initial)
        highest = max(number for number in (*life, *fresh) if number is not None)
        axes.set(ylabel=name, ylim=(0.0, max(0.05, 1.08 * highest)))
    legend_above(panels[0])

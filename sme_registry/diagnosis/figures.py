"""The figures of a diagnosis: of a task by channel, state, shell, time and training; of a team by
agent; of a life by visit and phase."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sme_registry.diagnosis.document import Diagnosis, TaskDiagnosis
from sme_registry.diagnosis.measurements import (
    LINEAR,
    POLICY,
    Distraction,
    Measurements,
    NetworkState,
    Violations,
)
from sme_registry.diagnosis.stream import StreamDiagnosis
from sme_registry.diagnosis.subject import AnySubject, Log, StreamSubject
from sme_registry.diagnosis.team import TeamDiagnosis
from sme_registry.evaluation import ObservationReport, SafetyScore
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.tables import SAFETY_REFERENCES
from sme_registry.plots.curves import draw_training
from sme_registry.plots.reports import SAFETY_MARKERS
from sme_registry.plots.streams import retention_map, tick_visits
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

__all__ = ["draw"]

_REFERENCES = (LINEAR, "best_constant", "constant_half", "uniform_random")
_MOST = 32  # channels or agents in one panel
_FRESH = "fresh agent of the phase"


def draw(diagnosis: Diagnosis, folder: Path, subject: AnySubject | None = None) -> tuple[Path, ...]:
    """Write the figures into a folder, as PNG and PDF.

    The training is drawn where the subject has a log, and what a life retained from its report.
    """
    fills: dict[str, Callable[[Figure], None]] = {}
    if isinstance(diagnosis, TaskDiagnosis):
        fills = _of_task(diagnosis, getattr(subject, "log", None))
    elif isinstance(diagnosis, TeamDiagnosis):
        fills = {"who_agents": partial(_agents, diagnosis=diagnosis)}
    elif isinstance(diagnosis, StreamDiagnosis):
        fills = {"which_phases": partial(_which_phases, diagnosis=diagnosis)}
        if any(visit.network is not None for visit in diagnosis.visits):
            fills["network_by_visit"] = partial(_network_by_visit, diagnosis=diagnosis)
    written = []
    for name, fill in fills.items():
        with styled():
            figure = new_figure((8.2, 4.0))
            entitle(figure, diagnosis.title)
            fill(figure)
        written += save_figure(figure, folder / name, WRITTEN)
    if isinstance(subject, StreamSubject):
        written += save_figure(retention_map(subject.report), folder / "what_is_retained", WRITTEN)
    return tuple(written)


def _of_task(diagnosis: TaskDiagnosis, log: Log | None) -> dict[str, Callable[[Figure], None]]:
    measured = diagnosis.measurements
    threshold = diagnosis.thresholds["explained_variance"]
    fills: dict[str, Callable[[Figure], None]] = {
        "where_channels": partial(_channels, measured=measured),
        "where_states": partial(_states, measured=measured, threshold=threshold),
        "where_time": partial(_time, measured=measured),
        "what_the_error_is": partial(_squared_error, measured=measured),
    }
    limits, distraction, observation = measured.limits, measured.distraction, measured.observation
    if log is not None:
        fills["training"] = partial(_training, measured=measured, log=log)
    if limits is not None:
        fills["limits"] = partial(_limits, limits=limits)
    if distraction is not None and observation is not None:
        fills["distraction"] = partial(
            _distraction, distraction=distraction, observation=observation
        )
    if observation is not None and len(observation.probes) > 1:
        fills["layers"] = partial(_layers, observation=observation)
    return fills


def _line(axes: Axes, x: Any, y: Any, index: int, label: str) -> None:
    axes.plot(x, y, **look(index), markersize=4.5, linewidth=2, label=label)


def _reference(axes: Axes, value: float, name: str) -> None:
    draw_reference(axes, name, None, value, LABELS[name])


def _legends(*panels: Axes, ncols: int = 1) -> None:
    """A legend above each panel, after its limits."""
    for axes in panels:
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), high)
        merge_coincident([axes])
        legend_above(axes, ncols=ncols)


def _channels(figure: Figure, measured: Measurements) -> None:
    channels = measured.channels[:_MOST]
    left, right = figure.subplots(1, 2)
    x = np.array([c.channel for c in channels])
    left.bar(
        x - 0.2, [c.normalised_regret for c in channels], 0.4, color=COLOURS[0], label="this policy"
    )
    left.bar(
        x + 0.2, [c.linear_normalised_regret for c in channels], 0.4, color="white", edgecolor=GREY,
        hatch="////", label=LABELS[LINEAR],
    )  # fmt: skip
    _reference(left, 1.0, "constant_half")
    left.set_ylabel("normalised regret  (0 = optimal)")
    slopes = [c.slope for c in channels]
    saturated = [c.at_zero + c.at_one for c in channels]
    _line(right, x, slopes, 0, "slope of a on a*  (1 = optimal)")
    _line(right, x, [c.offset for c in channels], 1, "offset, mean of a − a*  (0 = optimal)")
    _line(right, x, saturated, 2, "share of states at 0 or 1")
    for value in (0.0, 1.0):
        right.axhline(value, color=GREY, linewidth=0.9)
    cut = len(measured.channels) > _MOST
    for axes in (left, right):
        axes.set_xlabel("action channel" + (f" (the first {_MOST})" if cut else ""))
        axes.set_xticks(x[:: max(1, len(x) // 8)])
    _legends(left, right)


def _states(figure: Figure, measured: Measurements, threshold: float) -> None:
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.2))
    centre, *channels = measured.partitions
    best = sorted(channels, key=lambda p: -p.explained_variance)[:2]
    names = ["distance from the centre", *(f"state channel {p.state_channel}" for p in best)]
    short_names = ["distance", *(f"s{p.state_channel}" for p in best)]
    for index, part in enumerate((centre, *best)):
        left.bar(
            index, part.explained_variance, 0.6, color=COLOURS[index], edgecolor="white",
            hatch=("", "////", "....")[index],
        )  # fmt: skip
        _line(middle, 1 + np.arange(len(part.mae)), part.mae, index, names[index])
    left.set_xticks(range(len(names)), short_names)
    left.set_ylim(0.0, max(0.12, left.get_ylim()[1]))
    left.axhline(threshold, color=GREY, linewidth=1.1, label=f"stands out above {threshold:.0%}")
    left.set_ylabel("share of the error's\nvariance explained")
    left.set_xlabel("quantity that explains it")
    _reference(middle, measured.uniform[LINEAR].mae, LINEAR)
    middle.set_xticks(1 + np.arange(len(centre.mae)))
    middle.set_xlabel("fifth of the states, by quantity")
    middle.set_ylabel("error, mean |a − a*|")
    levels = [shell.epsilon for shell in measured.shells]
    for name in (POLICY, *_REFERENCES):
        values = [shell.scores[name].normalised_regret for shell in measured.shells]
        if name == POLICY:
            _line(right, levels, values, 0, "this policy")
        else:
            draw_reference(right, name, levels, values, LABELS[name])
    right.set_xticks(levels, ["WD", *(f"{level:g}" for level in levels[1:])])
    right.set_xlabel("expansion level ε of the shell")
    right.set_ylabel("normalised regret")
    _legends(left, middle, right)


def _time(figure: Figure, measured: Measurements) -> None:
    episodes, time = measured.on_policy, measured.time_dependence
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    _line(left, middles, episodes.regret, 0, "regret, 1 − r")
    _line(left, middles, episodes.mae, 1, "error, mean |a − a*|")
    if min(episodes.alive) < 1.0:
        _line(left, middles, episodes.alive, 2, "share of episodes running")
    for name in _REFERENCES[:3]:
        _reference(left, episodes.scores[name].regret, name)
    left.set_xlabel("step of the episode")
    left.set_ylabel(f"mean over {episodes.episodes} episodes\n(grey: regret of references)")
    _line(right, time.inputs, time.normalised_regret, 0, "in the same states")
    _line(right, time.inputs, time.action_change, 1, "change of a")
    _reference(right, measured.uniform[LINEAR].normalised_regret, LINEAR)
    right.set_xlabel("input t/T, in fixed states")
    right.set_ylabel("normalised regret;\nmean |change of a|")
    _legends(left, right)


def _squared_error(figure: Figure, measured: Measurements) -> None:
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
    bars = left.barh(list(shares), list(shares.values()), 0.6, color=COLOURS[0])
    left.bar_label(bars, [f"{share:.0%}" for share in shares.values()], padding=3, fontsize=8)
    left.invert_yaxis()
    left.set_xlim(0.0, 1.15)
    left.set_xticks(np.linspace(0, 1, 6))
    left.set_xlabel("share of the squared error")
    looks = {"rewarded": ("r > 0", COLOURS[2], ""), "gated": ("0 by r_min", COLOURS[4], "////"),
             "flat": ("r̂ = 0", "#cccccc", "")}  # fmt: skip
    for y, signal in enumerate((episodes.signal, episodes.random_signal)):
        start = 0.0
        for part, (name, colour, hatch) in looks.items():
            share = getattr(signal, part)
            right.barh(
                y, share, 0.55, left=start, color=colour, hatch=hatch, edgecolor="black",
                linewidth=0.5, label=name if y == 0 else "",
            )  # fmt: skip
            start += share
    right.set_yticks((0, 1), ("this policy", "random\nactions"))
    right.set_xlim(0.0, 1.0)
    right.set_ylim(1.6, -0.6)
    right.set_xlabel("share of steps")
    legend_above(right, ncols=3, columnspacing=1.0, handlelength=1.4)
    for axes in (left, right):
        axes.grid(visible=False, axis="y")


def _training(figure: Figure, measured: Measurements, log: Log) -> None:
    axes = figure.add_subplot()
    draw_training(axes, log.step, log.regret, each=log.source.removesuffix("s"))
    training, episodes = measured.training, measured.on_policy
    assert training is not None  # there is a log
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


def _limits(figure: Figure, limits: Violations) -> None:
    """Reward against cost, and which action channels violate their limits."""
    left, right = figure.subplots(1, 2)
    for name in SAFETY_REFERENCES:
        _point(left, limits.report.references[name][0], LABELS[name], SAFETY_MARKERS[name], GREY)
    own = {
        "this policy": limits.report.regions[0],
        "cut off at the limits": limits.cut_off,
        "in visited states": limits.visited,
    }
    for index, (label, score) in enumerate(own.items()):
        _point(left, score, label, str(look(index)["marker"]), COLOURS[index])
    left.set_xlabel("mean cost  (0 = within all limits)")
    left.set_ylabel("mean step reward  (1 = optimal)")
    left.set_xlim(-0.005, max(0.05, 1.1 * left.get_xlim()[1]))
    left.set_ylim(0.0, 1.05)
    channels = limits.channels[:_MOST]
    x = np.array([c.channel for c in channels])
    shares = [c.violating_share for c in channels], [c.optimal_violating_share for c in channels]
    right.bar(x - 0.2, shares[0], 0.4, color=COLOURS[0], label="this policy")
    right.bar(
        x + 0.2, shares[1], 0.4, color="white", edgecolor=GREY, hatch="////",
        label=LABELS["optimal"],
    )  # fmt: skip
    cut = len(limits.channels) > _MOST
    right.set_xlabel("action channel" + (f" (the first {_MOST})" if cut else ""))
    right.set_xticks(x[:: max(1, len(x) // 8)])
    right.set_ylabel("share of states above the limit")
    right.set_ylim(0.0, max(0.1, right.get_ylim()[1]))
    legend_above(left, ncols=2)
    legend_above(right, ncols=2)


def _point(axes: Axes, score: SafetyScore, label: str, marker: str, colour: str) -> None:
    axes.plot(
        score.cost, score.step_reward, marker, color=colour, markersize=8, linestyle="none",
        label=label, clip_on=False,
    )  # fmt: skip


def _distraction(figure: Figure, distraction: Distraction, observation: ObservationReport) -> None:
    """Regret with other distractors, and how much they move the actions."""
    left, right = figure.subplots(1, 2)
    bars = {
        "uniform": distraction.normalised_regret,
        "averaged out": distraction.averaged_regret,
        "all at ½": distraction.half_regret,
        **{region.name: region.normalised_regret for region in observation.distractor_regions},
    }
    colours = [COLOURS[0]] * 3 + [COLOURS[1]] * len(observation.distractor_regions)
    drawn = left.barh(list(bars), list(bars.values()), 0.7, color=colours)
    left.bar_label(drawn, [f"{value:.2f}" for value in bars.values()], padding=3, fontsize=8)
    left.invert_yaxis()
    left.axvline(
        1.0, color=GREY, linewidth=1.1, linestyle=(0, (4, 4)), label=LABELS["constant_half"]
    )
    left.set_xlim(0.0, max(1.15, 1.1 * max(bars.values())))
    left.set_xlabel("normalised regret  (0 = optimal)")
    left.set_ylabel("distractors")
    names = [sensitivity.name for sensitivity in observation.invariance]
    changes = [sensitivity.invariance for sensitivity in observation.invariance]
    drawn = right.bar(names, changes, 0.7, color=COLOURS[2])
    right.bar_label(drawn, [f"{value:.2f}" for value in changes], padding=2, fontsize=8)
    right.set_ylim(0.0, max(0.1, 1.15 * max(changes)))
    right.set_xlabel("region of the state")
    right.set_ylabel("change of a by other distractors\n(unit: mean |½ − a*|)")
    legend_above(left)
    left.grid(visible=False, axis="y")
    right.grid(visible=False, axis="x")


def _layers(figure: Figure, observation: ObservationReport) -> None:
    """What a linear map recovers from each layer."""
    axes, probes = figure.add_subplot(), observation.probes
    x = np.arange(len(probes))
    axes.plot(x, [p.state_r2 for p in probes], **look(0), linewidth=2, label="of the state")
    if probes[0].distractor_r2 is not None:
        r2 = np.array([p.distractor_r2 for p in probes], np.float64)
        axes.plot(x, r2, **look(1), linewidth=2, label="of the distractors")
    layers = [f"hidden {p.layer}\n({p.units} units)" for p in probes[1:]]
    axes.set_xticks(x, [f"observation\n({probes[0].units})", *layers])
    axes.set_ylabel("held-out R²  (1 = recovered by a linear map)")
    axes.set_ylim(min(-0.03, axes.get_ylim()[0]), 1.03)
    legend_above(axes, ncols=2)


def _agents(figure: Figure, diagnosis: TeamDiagnosis) -> None:
    agents = diagnosis.agents[:_MOST]
    left, right = figure.subplots(1, 2)
    x = np.arange(len(agents))
    regret = max(diagnosis.visited.regret, 1e-12)
    shares = [agent.visited.regret_share / regret for agent in agents]
    channels = [len(agent.action_channels) / diagnosis.spec.action_dim for agent in agents]
    _agent_bars(left, x - 0.2, shares, COLOURS[0], "share of the team's regret", 0.4)
    _agent_bars(left, x + 0.2, channels, "white", "share of the action channels", 0.4)
    left.set_ylabel("share")
    for index, (label, values) in enumerate(_agent_regrets(diagnosis).items()):
        colour = "white" if label == "linear policy" else COLOURS[index]
        _agent_bars(right, x + 0.27 * (index - 1), values[:_MOST], colour, label, 0.27)
    right.set_ylabel("normalised regret  (0 = optimal)")
    right.axhline(1.0, color=GREY, linewidth=0.9)
    for axes in (left, right):
        axes.set_xticks(x, [agent.name for agent in agents], rotation=30, ha="right", fontsize=8)
        legend_above(axes)
    right.set_ylim(0.0, max(1.05, right.get_ylim()[1]))  # 1 is the constant ½; shares fill theirs


def _agent_regrets(diagnosis: TeamDiagnosis) -> dict[str, list[float]]:
    measured = [agent.measurements for agent in diagnosis.agents]
    return {
        "uniform states": [agent.policy.normalised_regret for agent in measured],
        "its own episodes": [
            agent.on_policy.scores[POLICY].normalised_regret for agent in measured
        ],
        "linear policy": [agent.uniform[LINEAR].normalised_regret for agent in measured],
    }


def _agent_bars(
    axes: Axes, x: object, heights: list[float], colour: str, label: str, width: float
) -> None:
    hatch = "////" if colour == "white" else ""
    axes.bar(x, heights, width, color=colour, edgecolor=GREY, hatch=hatch, label=label)  # type: ignore[arg-type]


def _which_phases(figure: Figure, diagnosis: StreamDiagnosis) -> None:
    left, right = figure.subplots(1, 2)
    visits, phases = diagnosis.visits, diagnosis.phases
    _bars(left, [visit.online_regret for visit in visits], 0, 1, "this life")
    fresh = [phases[visit.phase].fresh_online_regret for visit in visits]
    if None not in fresh:
        _ticks(left, fresh)
    tick_visits(left, cast(Any, visits))
    left.set_xlabel("visit of phase")
    left.set_ylabel("online regret of the visit, mean of 1 − r")
    values = {
        "after its best visit": [phase.best_normalised_regret for phase in phases],
        "at the end of the life": [phase.final_normalised_regret for phase in phases],
    }
    for index, (name, regrets) in enumerate(values.items()):
        _bars(right, regrets, index, len(values), name)
    alone = [phase.fresh_normalised_regret for phase in phases]
    if None not in alone:
        _ticks(right, alone)
    right.axhline(1.0, color=GREY, linewidth=0.9, linestyle=(0, (4, 4)), label="constant ½")
    every = -(-len(phases) // 15)
    right.set_xticks(range(0, len(phases), every), [str(phase.phase) for phase in phases[::every]])
    right.set_xlabel("phase")
    right.set_ylabel("normalised regret  (0 = optimal)")
    for axes in (left, right):
        axes.set_ylim(bottom=0.0)
        legend_above(axes)


def _bars(axes: Axes, heights: Any, index: int, count: int, label: str) -> None:
    """A bar for each place, beside the bars of other indices; none where the height is None."""
    width = 0.8 / count
    x = np.arange(len(heights)) + (index - (count - 1) / 2) * width
    values = np.array(heights, dtype=float)
    axes.bar(x, values, width, color=COLOURS[index], label=label)


def _ticks(axes: Axes, values: Any) -> None:
    """A stroke across each place, of its fresh agent."""
    x = np.arange(len(values))
    axes.hlines(values, x - 0.45, x + 0.45, color="black", linewidth=1.6, label=_FRESH)


def _network_by_visit(figure: Figure, diagnosis: StreamDiagnosis) -> None:
    quantities: dict[str, Callable[[NetworkState], float]] = {
        "inactive hidden units, share": lambda network: network.inactive_units,
        "effective rank of the last hidden layer": lambda network: network.effective_rank,
        "norm of the weights": lambda network: network.weight_norm,
    }
    states = [visit.network for visit in diagnosis.visits]
    initial = diagnosis.initial_network is not None
    x = np.arange(len(states))
    if initial:
        states, x = [diagnosis.initial_network, *states], np.arange(-1, len(states))
    alone = [diagnosis.phases[visit.phase].fresh_network for visit in diagnosis.visits]
    panels = figure.subplots(1, len(quantities))
    for axes, (name, quantity) in zip(panels, quantities.items(), strict=True):
        drawn = _numbers(states, quantity)
        axes.plot(x, drawn, **look(0), markersize=4.5, label="this life")
        if None not in alone:
            of_fresh = _numbers(alone, quantity)
            _ticks(axes, of_fresh)
            drawn += of_fresh
        tick_visits(axes, cast(Any, diagnosis.visits), initial=initial)
        axes.set_ylabel(name)
        axes.set_ylim(0.0, max(0.05, 1.08 * np.nanmax(drawn)))
    legend_above(panels[0])


def _numbers(states: Any, quantity: Callable[[NetworkState], float]) -> list[float]:
    return [np.nan if state is None else quantity(state) for state in states]

"""The figures of a life's diagnosis: costly and lost phases, what is retained, and the network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from sme_registry.diagnosis.stream_document import NetworkState, StreamDiagnosis
from sme_registry.diagnosis.stream_render import stream_title
from sme_registry.diagnosis.stream_subject import StreamSubject
from sme_registry.plots.streams import retention_map, tick_visits
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    entitle,
    legend_above,
    look,
    new_figure,
    save_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_stream"]

_FRESH = "fresh agent of the phase"
_Fill: TypeAlias = Callable[["Figure", StreamSubject, StreamDiagnosis], None]


def draw_stream(
    diagnosis: StreamDiagnosis, folder: Path, subject: StreamSubject
) -> tuple[Path, ...]:
    """Write the figures into a folder, as PNG and PDF; the network's only where it is known."""
    figures = {
        "which_phases": _drawn(_which_phases, subject, diagnosis),
        "what_is_retained": retention_map(subject.report),
    }
    if any(visit.network is not None for visit in diagnosis.visits):
        figures["network_by_visit"] = _drawn(_network_by_visit, subject, diagnosis)
    return tuple(
        path for name, each in figures.items() for path in save_figure(each, folder / name, WRITTEN)
    )


def _drawn(fill: _Fill, subject: StreamSubject, diagnosis: StreamDiagnosis) -> Figure:
    with styled():
        figure = new_figure((8.2, 4.0))
        entitle(figure, stream_title(diagnosis))
        fill(figure, subject, diagnosis)
    return figure


def _which_phases(figure: Figure, subject: StreamSubject, diagnosis: StreamDiagnosis) -> None:
    left, right = figure.subplots(1, 2)
    visits, phases = diagnosis.visits, diagnosis.phases
    _bars(left, [visit.online_regret for visit in visits], 0, 1, "this life")
    fresh = [phases[visit.phase].fresh_online_regret for visit in visits]
    if None not in fresh:
        _ticks(left, fresh)
    tick_visits(left, subject.report.visits)
    left.set_xlabel("visit of phase")
    left.set_ylabel("online regret of the visit, mean of 1 − r")
    values = {
        "after its best visit": [phase.best_normalised_regret for phase in phases],
        "at the end of the life": [phase.final_normalised_regret for phase in phases],
    }
    for index, (name, each) in enumerate(values.items()):
        _bars(right, each, index, len(values), name)
    alone = [phase.fresh_normalised_regret for phase in phases]
    if None not in alone:
        _ticks(right, alone)
    right.axhline(1.0, color=GREY, linewidth=0.9, linestyle=(0, (4, 4)), label="constant ½")
    every = -(-len(phases) // 15)
    right.set_xticks(range(0, len(phases), every), [str(each.phase) for each in phases[::every]])
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


def _network_by_visit(figure: Figure, subject: StreamSubject, diagnosis: StreamDiagnosis) -> None:
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
        tick_visits(axes, subject.report.visits, initial=initial)
        axes.set_ylabel(name)
        axes.set_ylim(0.0, max(0.05, 1.08 * np.nanmax(drawn)))
    legend_above(panels[0])


def _numbers(states: Any, quantity: Callable[[NetworkState], float]) -> list[float]:
    return [np.nan if state is None else quantity(state) for state in states]

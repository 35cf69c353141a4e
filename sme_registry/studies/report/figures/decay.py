"""What each run loses out of distribution, against its similarity within."""

from __future__ import annotations

from collections.abc import Sequence

from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots import GREY, drawing, literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures.panels import Picture, looks
from sme_registry.studies.report.frames import RUN


def draw_decay(analysis: Analysis, formats: Sequence[str]) -> Picture | str:
    """One mark a run; a sentence where no run has finished."""
    if analysis.results.empty:
        return "No decay: no run has finished."
    inside = analysis.results.drop_duplicates(RUN, keep="first")
    outside = analysis.results.drop_duplicates(RUN, keep="last")
    loss = outside.similarity_loss.to_numpy()
    with drawing((4.8, 3.5), tuple(formats)) as (figure, files):
        axes = figure.add_subplot()
        for name, look in looks(analysis).items():
            selected = (inside.algorithm == name).to_numpy()
            edge = 0.8 if look.marker in "x+12" else 0.0
            axes.plot(
                inside.similarity[selected], loss[selected], **look.points, markersize=4,
                markeredgewidth=edge, alpha=0.55, label=literal(name),
            )  # fmt: skip
        axes.axhline(0.0, color=GREY, linewidth=1.0)
        axes.set_xlabel("similarity r̃ within distribution")
        axes.set_ylabel(f"points of r̃ lost in the shell up to ε = {outside.epsilon_high.max():g}")
        figure.legend(loc="outside right center")
    dims = sorted(set(inside.state_dim))
    caption = (
        "One mark a run: its similarity in the unit cube, and the hundredths of r̃ that it loses in "
        "the outermost shell. Below 0 a run is better outside, which an agent can be whose actions "
        "saturate before it has learnt."
    )
    if len(dims) > 1:
        caption += f" It includes runs with S = {', '.join(map(str, dims))}. {NOT_COMPARABLE}"
    return Picture("decay", "Similarity lost outside against similarity inside", caption, files)

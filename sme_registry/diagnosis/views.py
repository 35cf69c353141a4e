"""How a diagnosis is shown: `view_of` gives the functions of its kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sme_registry.diagnosis import render, stream_render, team_render
from sme_registry.diagnosis.diagnose import AnyDiagnosis
from sme_registry.diagnosis.stream_document import StreamDiagnosis
from sme_registry.diagnosis.team_document import TeamDiagnosis

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["View", "view_of"]


class View(NamedTuple):
    """The forms of one diagnosis."""

    terminal: Callable[[], Iterator[RenderableType]]  # what `sme diagnose` prints, part by part
    # the page, which shows figures of the same folder, given by their names
    markdown: Callable[[Sequence[str]], str]
    # writes the figures of the diagnosis of a subject into a folder, as PNG and PDF
    draw: Callable[[Path, Any], tuple[Path, ...]]


def view_of(diagnosis: AnyDiagnosis) -> View:
    """How to show a diagnosis."""
    if isinstance(diagnosis, TeamDiagnosis):
        from sme_registry.diagnosis.team_figures import draw_team

        return View(
            lambda: team_render.terminal(diagnosis),
            lambda figures: team_render.markdown(diagnosis, figures),
            lambda folder, subject: draw_team(diagnosis, folder),
        )
    if isinstance(diagnosis, StreamDiagnosis):
        from sme_registry.diagnosis.stream_figures import draw_stream

        return View(
            lambda: stream_render.terminal(diagnosis),
            lambda figures: stream_render.markdown(diagnosis, figures),
            lambda folder, subject: draw_stream(diagnosis, folder, subject),
        )
    from sme_registry.diagnosis.figures import draw

    return View(
        lambda: render.terminal(diagnosis),
        lambda figures: render.markdown(diagnosis, figures),
        lambda folder, subject: draw(diagnosis, folder, subject.log),
    )

"""The report as one HTML page: findings first, then figures, then tables. It loads nothing.

Every picture is embedded, and a content security policy forbids the page to load anything. Figures
are drawn on white; on a dark page their lightness is inverted and their hues are kept, except for
maps, whose lightness carries meaning.
"""

from __future__ import annotations

import base64
import itertools
import operator
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd
from markupsafe import Markup

from sme_registry.io.markup import environment, plural
from sme_registry.io.terminal import duration
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.status import run_label
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import AXES, SEVERAL
from sme_registry.studies.report.explorers import Explorer
from sme_registry.studies.report.figures import Picture
from sme_registry.studies.report.findings import Findings
from sme_registry.studies.report.text import TextTable

__all__ = ["page"]

# Headings, and the beginnings of the figures' names. A section without contents is left out.
_SECTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "offline": ("Learning from data", ("offline",)),
    "findings": ("Findings", ()),
    "breaks": ("What breaks it", ("contrasts", "regret", "wd-regret", "ood-regret")),
    "agents": ("Agents of the teams", ("agents",)),
    "regions": ("Inside and outside the training cube", ("regions", "decay", "maps")),
    "algorithms": (
        "Algorithms compared",
        ("aggregates", "profiles", "improvements", "differences"),
    ),
    "learning": ("Learning", ("learning-curves",)),
    "streams": ("Lives in streams", ("stream-",)),
    "explorers": ("Explorers", ()),
    "absent": ("Figures that could not be drawn", ()),
    "tables": ("Tables", ()),
    "origin": ("Origin of the numbers", ()),
}
_MAX_MISSING = 40  # missing runs that the page lists; the CSV lists all


def page(
    analysis: Analysis,
    findings: Findings,
    figures: Sequence[Picture],
    absent: Sequence[str],
    tables: Sequence[TextTable],
    explorers: Sequence[Explorer] = (),
) -> str:
    """The whole page; `absent` has a sentence for each figure that could not be drawn."""
    folder = Path(__file__).parent
    templates = environment(folder / "templates", autoescape=True)
    templates.filters |= {
        "base64": lambda data: base64.b64encode(data).decode("ascii"),
        "by": lambda entries, name: itertools.groupby(entries, key=operator.attrgetter(name)),
    }
    by_section = {
        key: [figure for figure in figures if figure.name.startswith(prefixes)]
        for key, (_, prefixes) in _SECTIONS.items()
    }
    required = {"tables", "origin"}
    required |= {"findings"} if analysis.classes else set()
    required |= {"offline"} if findings.offline else set()
    required |= {"streams"} if findings.streams else set()
    required |= {"absent"} if absent else set()
    required |= {"explorers"} if explorers else set()
    offline = [table for table in tables if table.name.startswith("offline")]
    return templates.get_template("page.html.jinja").render(
        file=analysis.file,
        plan=analysis.file.plan,
        kinds=_kinds(analysis),
        done=analysis.finished,
        requested=analysis.requested,
        never_requested=_planned(analysis) - analysis.requested,
        style=Markup((folder / "page.css").read_text(encoding="utf-8")),
        sections={
            key: heading
            for key, (heading, _) in _SECTIONS.items()
            if key in required or by_section[key]
        },
        findings=findings,
        in_jax=_in_jax(analysis),
        axes=AXES,
        several=SEVERAL,
        figures=by_section,
        tables={"offline": offline, "tables": [t for t in tables if t not in offline]},
        absent=absent,
        explorers=explorers,
        origin=_origin(analysis),
        missing=_missing(analysis),
        max_missing=_MAX_MISSING,
    )


def _planned(analysis: Analysis) -> int:
    """Runs of the plan: on single tasks all, in streams those that differ."""
    of_tasks = sum(not cell.in_stream for cell in analysis.file.plan.cells)
    return of_tasks + (analysis.streams.planned if analysis.streams else 0)


def _kinds(analysis: Analysis) -> list[str]:
    """`3 classes`, `2 streams`: what the plan has of each."""
    plan = analysis.file.plan
    classes = [plural(len(plan.classes), "class", "classes")] if plan.classes else []
    return [*classes, plural(len(plan.streams), "stream")] if plan.streams else classes


def _missing(analysis: Analysis) -> list[tuple[str, str]]:
    """What each missing run is, and its error."""
    streams = analysis.streams
    in_streams = () if streams is None else streams.missing.itertuples()
    return [
        *((run_label(r.class_name, r.algorithm, r.run), r.error)
          for r in analysis.missing.itertuples()),
        *((run_label(r.class_name, r.algorithm, r.run, None if pd.isna(r.phase) else r.phase),
           r.error) for r in in_streams),
    ]  # fmt: skip


def _in_jax(analysis: Analysis) -> list[str]:
    """The algorithms that run in JAX, if others beside them learn without it."""
    of_plan = {algorithm.name: algorithm.uses for algorithm in analysis.file.plan.algorithms}
    learners = {*analysis.learners, *(analysis.streams.algorithms if analysis.streams else ())}
    ours = [name for name in of_plan if name in learners and in_jax(of_plan[name])]
    return ours if len(ours) < len(learners) else []


def _origin(analysis: Analysis) -> Iterable[tuple[str, str, str]]:
    """What the numbers were made from: a name, a digest or other code, and a text."""
    file, plan = analysis.file, analysis.file.plan
    states = f"{plan.protocol.states_per_region:,} states per region"
    yield "plan", file.digest, file.versioned_name
    yield "protocol", plan.protocol.digest, states
    runs = f"{analysis.finished:,} of {plural(analysis.requested, 'run')}"
    yield "runs", "", f"{runs} finished, in {duration(analysis.seconds)} of CPU time"
    episodes = plural(plan.evaluation_episodes, "episode")
    yield "evaluations", "", f"{plan.evaluations:,} during training, {episodes} each"
    for algorithm in plan.algorithms:
        steps = plan.steps if algorithm.steps is None else algorithm.steps
        settings = ", ".join(f"{k} = {v}" for k, v in sorted(algorithm.hyperparameters.items()))
        budget = f"{steps:,} steps, " if plan.classes else ""
        text = f"{budget}{algorithm.action_range} actions"
        yield algorithm.name, algorithm.uses, f"{text}, {settings or 'default hyperparameters'}"
    programs = (result.program for result in analysis.cells.values())
    kinds = Counter((each.device, each.lanes) for each in programs if each is not None)
    for (device, lanes), count in kinds.most_common():
        text = f"on {device}, in programs of {plural(lanes, 'lane')}"
        yield f"{plural(count, 'run')} in JAX", "", text
    versions = Counter(
        ", ".join(f"{name} {version}" for name, version in sorted(result.versions.items()))
        for result in analysis.cells.values()
    )
    for text, count in versions.most_common():
        yield f"versions of {plural(count, 'run')}", "", text

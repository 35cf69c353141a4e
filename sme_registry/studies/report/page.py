"""The report as one HTML page: findings first, then figures, then tables. It loads nothing.

Every picture is embedded, and a content security policy forbids the page to load anything. Figures
are drawn on white; on a dark page their lightness is inverted and their hues are kept, except for
maps, whose lightness carries meaning.
"""

from __future__ import annotations

import base64
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from markupsafe import Markup

from sme_registry.spec.study import in_jax
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import AXES, SEVERAL
from sme_registry.studies.report.exports import TextTable
from sme_registry.studies.report.figures import Picture
from sme_registry.studies.report.findings import Findings
from sme_registry.terminal import duration
from sme_registry.terminal.templates import environment, plural

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
) -> str:
    """The whole page; `absent` has a sentence for each figure that could not be drawn."""
    folder = Path(__file__).parent
    templates = environment(folder / "templates", autoescape=True)
    templates.filters |= {
        "base64": lambda data: base64.b64encode(data).decode("ascii"),
        "by_class": lambda places: itertools.groupby(places, key=lambda place: place.class_name),
    }
    by_section = {
        key: [figure for figure in figures if figure.name.startswith(prefixes)]
        for key, (_, prefixes) in _SECTIONS.items()
    }
    required = {"findings", "tables", "origin"}
    required |= {"offline"} if findings.offline else set()
    required |= {"absent"} if absent else set()
    offline = [table for table in tables if table.name.startswith("offline")]
    return templates.get_template("page.html.jinja").render(
        file=analysis.file,
        plan=analysis.file.plan,
        done=len(analysis.runs),
        requested=_requested(analysis),
        never_requested=len(analysis.file.plan.cells) - _requested(analysis),
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
        origin=_origin(analysis),
        missing=list(analysis.missing.itertuples()),
        max_missing=_MAX_MISSING,
    )


def _requested(analysis: Analysis) -> int:
    """How many runs have finished or are missing; `--only` may have left out others."""
    return len(analysis.runs) + len(analysis.missing)


def _in_jax(analysis: Analysis) -> list[str]:
    """The algorithms that run in JAX, if others beside them learn without it."""
    of_plan = {algorithm.name: algorithm.uses for algorithm in analysis.file.plan.algorithms}
    ours = [name for name in analysis.learners if in_jax(of_plan[name])]
    return ours if len(ours) < len(analysis.learners) else []


def _origin(analysis: Analysis) -> Iterable[tuple[str, str, str]]:
    """What the numbers were made from: a name, a digest or other code, and a text."""
    file, plan = analysis.file, analysis.file.plan
    states = f"{plan.protocol.states_per_region:,} states per region"
    yield "plan", file.digest, file.versioned_name
    yield "protocol", plan.protocol.digest, states
    runs = f"{len(analysis.runs):,} of {plural(_requested(analysis), 'run')}"
    yield "runs", "", f"{runs} finished, in {duration(analysis.runs.seconds.sum())} of CPU time"
    episodes = plural(plan.evaluation_episodes, "episode")
    yield "evaluations", "", f"{plan.evaluations:,} during training, {episodes} each"
    for algorithm in plan.algorithms:
        steps = plan.steps if algorithm.steps is None else algorithm.steps
        settings = ", ".join(f"{k} = {v}" for k, v in sorted(algorithm.hyperparameters.items()))
        text = f"{steps:,} steps, {algorithm.action_range} actions"
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

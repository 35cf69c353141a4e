"""`write_report`: a study's folder to its report; `compare`: two of its algorithms.

    REPORT/index.html           the page: findings, figures and tables in one file
    REPORT/figure.png .pdf      its first figure
    REPORT/table.csv .tex       levels by class, of two algorithms with their difference

Only in a full report:

    REPORT/findings.json        the findings as data
    REPORT/figures/*.png .pdf   the figures, at the width of a printed page
    REPORT/tables/*.csv         every number
    REPORT/tables/*.tex         the tables of a paper
    REPORT/explorers/*.html     on request, a page for each model that the study kept

The same results give the same files. The page loads nothing. On a dark page the lightness of
figures is inverted, except for maps, whose lightness carries meaning.
"""

from __future__ import annotations

import base64
import contextlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from markupsafe import Markup

from sme_registry.errors import OptionError, SMEError, UnknownNameError
from sme_registry.explorer import explorer_page, facts
from sme_registry.io import check_writable, choice, to_json, write_atomically
from sme_registry.io.markup import environment, plural
from sme_registry.io.terminal import duration
from sme_registry.plots.style import WRITTEN
from sme_registry.studies.ledger import REPORT, Ledger
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.design import metrics_of
from sme_registry.studies.report.figures import draw, draw_differences, draw_figures
from sme_registry.studies.report.figures.curves import draw_class_curves
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.findings import THRESHOLDS, findings
from sme_registry.studies.report.frames import StudyFrames, frame, load, records, runs_of
from sme_registry.studies.report.tables import DIFFERENCES, analyse, differences
from sme_registry.studies.report.texts import TextTable, comparison_tables, csv_tables, text_tables
from sme_registry.studies.subject import load_cell

DEFAULT_METRICS = tuple(metric.key for metric in metrics_of("score"))  # of comparisons
FORMATS = ("html", "png", "pdf", "csv", "latex")
_FIGURE_FORMATS = {"html": "svg", "png": "png", "pdf": "pdf"}
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
    "tables": ("Tables", ()),
    "origin": ("Origin of the numbers", ()),
}
_MAX_MISSING = 40  # missing runs that the page lists; the CSV lists all
_DIGITS = 16  # of a cell's key, in the name of its explorer


class Explorer(NamedTuple):
    """A page of one run: its label, its path in the report's folder, and its HTML."""

    label: str
    path: str
    content: str


def write_report(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    formats: Sequence[str] = FORMATS,
    *,
    explorers: bool = False,
    full: bool = False,
) -> list[Path]:
    """Write the report of a study's finished runs, and return its files, the page first.

    It has a page, a figure, table.csv and table.tex; if `full` also every figure and table as a
    file of its own, and the findings as JSON.

    The maps of the plane and the explorers need the models that the study kept, and loading a model
    can run code of its author. All other files of the folder are read as data.

    `out` is FOLDER/report by default, and `formats` are of "html", "png", "pdf", "csv" and "latex".
    With `explorers` the page links to one of each kept model.

    Examples:
      >>> from sme_registry import studies
      >>> [path.name for path in studies.write_report("study", "report", formats=["csv"])]
      ['table.csv']
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise OptionError(f"format={','.join(unknown)!r}: must be of {', '.join(FORMATS)}.")
    ledger = Ledger(folder)
    file = ledger.study_file()
    keys = list(dict.fromkeys(planned.cell.digest for planned in file.plan.cells))
    results = ledger.results(keys)
    if not results:
        raise OptionError(
            f"folder={str(folder)!r}: none of its {len(keys)} runs has finished. Run them with "
            "`sme study run`, and check them with `sme study status`."
        )
    target = Path(folder) / REPORT if out is None else Path(out)
    check_writable(target / "index.html")
    failures = {key: failure.error for key, failure in ledger.failures(keys).items()}
    models = {key: path for key in results if (path := ledger.model_path(key)).exists()}
    analysis = analyse(file, results, failures, models=models)
    pages = explorers_of(ledger.folder, analysis) if explorers else []
    if explorers and not pages:
        raise OptionError(
            f"explorers: {str(folder)!r} has no model of a run on a single task that can be shown. "
            "Run the study with --keep-models, or leave it out."
        )
    contents = _contents(analysis, formats, pages, full=full)
    return [write_atomically(target / name, content) for name, content in contents.items()]


def _contents(
    analysis: Analysis, formats: Sequence[str], explorers: Sequence[Explorer], *, full: bool
) -> dict[str, str | bytes]:
    """The contents of each file, by its name in the report."""
    tables = text_tables(analysis)
    figure_formats = [_FIGURE_FORMATS[name] for name in formats if name in _FIGURE_FORMATS]
    figures = draw_figures(analysis, figure_formats) if figure_formats else []
    contents: dict[str, str | bytes] = {}
    if "html" in formats:
        contents["index.html"] = page(analysis, figures, tables, explorers)
    for ending in ("png", "pdf"):
        if ending in formats and figures:
            contents[f"figure.{ending}"] = _main_figure(analysis, figures).files[ending]
    numbers, table = _main_table(analysis, tables)
    if "csv" in formats:
        contents["table.csv"] = numbers.to_csv(index=False, lineterminator="\n")
    if "latex" in formats and table is not None:
        contents["table.tex"] = table.latex()
    if full:
        contents |= _every_file(analysis, formats, figures, tables)
    return contents | {page.path: page.content for page in explorers}


def _main_figure(analysis: Analysis, figures: Sequence[Picture]) -> Picture:
    """That of the only axis, the difference of two learners, or the first of the page."""
    preferred = [figure for figure in figures if figure.name.startswith("regret-")]
    if len(preferred) != 1:
        two = len(analysis.learners) == 2 and analysis.algorithms[:2] == analysis.learners
        preferred = [figure for figure in figures if two and figure.name == "differences"]
    return preferred[0] if preferred else figures[0]


def _main_table(
    analysis: Analysis, tables: Sequence[TextTable]
) -> tuple[pd.DataFrame, TextTable | None]:
    """The numbers of a paper's first table, and the table of the first metric, if any is known."""
    name = "levels" if analysis.algorithms else "stream_metrics"
    differences = analysis.tables["differences"]
    if len(analysis.algorithms) == 2 and not differences.empty:
        return differences, comparison_tables(differences)[0]
    first = name.replace("_", "-")
    return analysis.tables[name], next((t for t in tables if t.name.startswith(first)), None)


def _every_file(
    analysis: Analysis,
    formats: Sequence[str],
    figures: Sequence[Picture],
    tables: Sequence[TextTable],
) -> dict[str, str | bytes]:
    contents: dict[str, str | bytes] = {}
    if "html" in formats:
        contents["findings.json"] = to_json(
            {
                "schema_version": 2,  # 1 had nested documents instead of a table
                "study": analysis.file.versioned_name,
                "digest": analysis.file.digest,
                "base": analysis.base,
                "thresholds": THRESHOLDS,
                "findings": records(findings(analysis)),
            }
        )
    for ending in ("png", "pdf"):
        if ending in formats:
            contents |= {f"figures/{x.name}.{ending}": x.files[ending] for x in figures}
    if "csv" in formats:
        contents |= {f"tables/{name}.csv": text for name, text in csv_tables(analysis).items()}
    if "latex" in formats:
        contents |= {f"tables/{table.name}.tex": table.latex() for table in tables}
    return contents


def page(
    analysis: Analysis,
    figures: Sequence[Picture] = (),
    tables: Sequence[TextTable] = (),
    explorers: Sequence[Explorer] = (),
) -> str:
    rows = findings(analysis)
    by_section = {
        key: [figure for figure in figures if figure.name.startswith(prefixes)]
        for key, (_, prefixes) in _SECTIONS.items()
    }
    present = {
        "tables": True, "origin": True, "findings": analysis.classes, "streams": analysis.streams,
        "offline": "offline" in set(rows.section), "explorers": explorers,
    }  # fmt: skip
    offline = [table for table in tables if table.name.startswith("offline")]
    return rendered(
        "page.html.jinja",
        analysis=analysis,
        kinds=_kinds(analysis),
        sections={
            key: heading
            for key, (heading, _) in _SECTIONS.items()
            if present.get(key) or by_section[key]
        },
        findings=_by_subject(rows),
        figures=by_section,
        tables={"offline": offline, "tables": [t for t in tables if t not in offline]},
        explorers=explorers,
        origin=_origin(analysis),
        missing=pd.concat([analysis.missing(streams=streams) for streams in (False, True)]),
        max_missing=_MAX_MISSING,
    )


def rendered(template: str, *folders: Path, **values: Any) -> str:
    """A page in the style of reports, by a template of theirs or of other folders."""
    here = Path(__file__).parent
    templates = environment(*folders, here / "templates", autoescape=True)
    templates.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    style = Markup((here / "page.css").read_text(encoding="utf-8"))
    return templates.get_template(template).render(style=style, **values)


def _by_subject(rows: pd.DataFrame) -> dict[str, dict[str, list[str]]]:
    """The sentences of each section, by algorithm, or by class in the sections of streams."""
    sections: dict[str, dict[str, list[str]]] = {}
    for row in rows.itertuples():
        subject = row.class_name if row.section.startswith("stream") else row.algorithm
        sections.setdefault(row.section, {}).setdefault(subject, []).append(row.sentence)
    return sections


def _kinds(analysis: Analysis) -> list[str]:
    """`3 classes`, `2 streams`: what the plan has of each."""
    plan = analysis.plan
    classes = [plural(len(plan.classes), "class", "classes")] if plan.classes else []
    return [*classes, plural(len(plan.streams), "stream")] if plan.streams else classes


def _origin(analysis: Analysis) -> Iterable[tuple[str, str, str]]:
    """What the numbers were made from: a name, a digest or other code, and a text."""
    file, plan = analysis.file, analysis.plan
    states = f"{plan.protocol.states_per_region:,} states per region"
    yield "plan", file.digest, file.versioned_name
    yield "protocol", plan.protocol.digest, states
    runs = f"{analysis.finished:,} of {plural(analysis.requested, 'run')}"
    seconds = sum(result.timing.total for result in analysis.cells.values())
    yield "runs", "", f"{runs} finished, in {duration(seconds)} of CPU time"
    episodes = plural(plan.evaluation_episodes, "episode")
    yield "evaluations", "", f"{plan.evaluations:,} during training, {episodes} each"
    for algorithm in plan.algorithms:
        steps = plan.steps if algorithm.steps is None else algorithm.steps
        settings = listed(algorithm.hyperparameters, " = ") or "default hyperparameters"
        budget = f"{steps:,} steps, " if plan.classes else ""
        text = f"{budget}{algorithm.action_range} actions"
        yield algorithm.name, algorithm.uses, f"{text}, {settings}"
    programs = (result.program for result in analysis.cells.values())
    kinds = Counter((p.device, p.lanes) for p in programs if p is not None)
    for (device, lanes), count in kinds.most_common():
        text = f"on {device}, in programs of {plural(lanes, 'lane')}"
        yield f"{plural(count, 'run')} in JAX", "", text
    versions = Counter(listed(result.versions) for result in analysis.cells.values())
    for text, count in versions.most_common():
        yield f"versions of {plural(count, 'run')}", "", text


def listed(values: Mapping[str, Any], between: str = " ") -> str:
    """`numpy 2.1, torch 2.5`."""
    return ", ".join(f"{name}{between}{value}" for name, value in sorted(values.items()))


def explorers_of(folder: Path, analysis: Analysis) -> list[Explorer]:
    """A page for each run on a single task whose model was kept, in the plan's order."""
    pages = []
    for place in analysis.places[~analysis.places.streams].drop_duplicates("key").itertuples():
        if place.key in analysis.models:
            name, report = place.key.removeprefix("sha256:"), analysis.cells[place.key].report
            with contextlib.suppress(SMEError):
                content = explorer_page(facts(load_cell(folder, place.key), report=report))
                pages.append(Explorer(place.label, f"explorers/{name[:_DIGITS]}.html", content))
    return pages


def compare(
    study: StudyFrames | str | os.PathLike[str],
    first: str,
    second: str,
    metrics: Sequence[str] = DEFAULT_METRICS,
) -> pd.DataFrame:
    """The paired difference first − second on each class, and its mean over all classes.

    Args:
      study: the frames of `load`, or the study's folder.
      metrics: of the report's levels, such as "final_return", or "wd_cost" where tasks have safety.

    Returns:
      One row for each metric and class, and one for "all classes": the IQM over the paired runs of
      both, that of their differences with its 95 % bootstrap interval (NaN for a single pair), the
      number of pairs and of their instances, and the verdict on the first algorithm: better, worse,
      open, or indication: the interval excludes 0 but rests on fewer than 5 pairs.

    Examples:
      >>> from sme_registry import studies
      >>> differences = studies.compare("study", "linear", "constant", ["wd_regret"])
      >>> bool(differences["difference"].iloc[-1] < 0)
      True
    """
    names: list[str] = []
    if not isinstance(study, StudyFrames):
        plan = Ledger(study).study_file().plan
        names = [algorithm.name for algorithm in plan.algorithms]
        if not plan.classes:
            raise OptionError(
                f"folder={str(study)!r}: its plan has streams alone, and runs on single tasks are "
                "compared. `sme study report` has the differences between algorithms in streams."
            )
        study = load(study)
    finished = runs_of(study.results)
    names = names or list(dict.fromkeys(finished.algorithm))
    for name in (first, second) if names else ():
        choice("algorithm", name, names, error=UnknownNameError)
    if first == second:
        raise OptionError(f"{first!r}: is given twice. Give two different algorithms.")
    known = {metric.key: metric for metric in metrics_of("run", finished.columns)}
    chosen = {k: known[choice("metric", k, known, error=UnknownNameError)] for k in metrics}
    rows = differences(finished, [(first, second)], [*chosen.values()])
    table = frame([*rows], DIFFERENCES)
    if table.empty:
        raise OptionError(
            f"{first!r} and {second!r}: no class has a run of both on the same instance with the "
            "same seed. Run more of the study's cells."
        )
    absent = [key for key in chosen if key not in {*table.metric}]
    if absent:
        raise OptionError(f"metric={absent[0]!r}: has no value in the paired runs. Leave it out.")
    return table


def write_comparison(
    folder: str | os.PathLike[str], out: str | os.PathLike[str], table: pd.DataFrame
) -> list[Path]:
    """Write the result of `compare`: differences.csv and .json, a .tex a metric, and figures."""
    check_writable(Path(out) / "differences.csv")
    contents: dict[str, str | bytes] = {
        "differences.csv": table.to_csv(index=False, lineterminator="\n"),
        "differences.json": to_json(records(table)),
    }
    contents |= {f"{text.name}.tex": text.latex() for text in comparison_tables(table)}
    ledger = Ledger(folder)
    file = ledger.study_file()
    algorithms = {algorithm.name: algorithm for algorithm in file.plan.algorithms}
    both = tuple(algorithms[table[column].iloc[0]] for column in ("first", "second"))
    plan = file.plan.model_copy(update={"algorithms": both})
    results = ledger.results(cell.cell.digest for cell in plan.cells)
    both_alone = file.model_copy(update={"plan": plan})
    analysis = analyse(both_alone, results, coloured=file.plan.algorithms)
    for picture in draw((draw_differences, draw_class_curves), analysis, WRITTEN):
        contents |= {f"{picture.name}.{ending}": picture.files[ending] for ending in WRITTEN}
    return [write_atomically(Path(out) / name, content) for name, content in contents.items()]

"""The report as one HTML page: words first, then figures, then tables. It asks no network.

Every picture is in the page, and a policy of its own forbids it to load anything. A figure is drawn
on white; where the reader's pages are dark its lightness is turned over and its hues are kept, but
for maps, whose lightness means something.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.exports import TextTable
from sme_registry.studies.report.figures import Picture
from sme_registry.studies.report.findings import caveats, comparison, findings
from sme_registry.studies.report.offline import offline_words

_SECTIONS = {
    "breaks": ("What breaks it", ("contrasts", "wd-regret", "ood-regret")),
    "regions": ("Inside and outside of the training cube", ("regions", "decay", "maps")),
    "algorithms": ("Algorithms compared", ("aggregates", "profiles", "improvements")),
    "learning": ("Learning", ("learning-curves",)),
}
_OFFLINE = "offline"  # how the names of all that learning from data adds begin
_LISTED = 40  # missing runs that the page names; the CSV has all


def page(
    analysis: Analysis,
    figures: Sequence[Picture],
    absent: Sequence[str],
    tables: Sequence[TextTable],
) -> str:
    """The whole page.

    Args:
      analysis: the tables that words are made from.
      figures: with their SVG.
      absent: a sentence for each figure that could not be drawn.
      tables: those to show.
    """
    file = analysis.file
    title = f"Study {file.versioned_name}"
    style = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
    sections, names = [], {}
    own_tables = [table for table in tables if table.name.startswith(_OFFLINE)]
    if analysis.has_offline_runs:
        sections.append(_learnt_from_data(analysis, figures, own_tables))
        names[_OFFLINE] = "Learning from data"
    sections.append(_in_words(analysis))
    names["words"] = "In words"
    for key, (heading, kinds) in _SECTIONS.items():
        own = [figure for figure in figures if figure.name.startswith(kinds)]
        if own:
            sections.append(_section(key, heading, "".join(map(_figure, own))))
            names[key] = heading
    if absent:
        sections.append(_section("absent", "What could not be drawn", _list(absent)))
        names["absent"] = "What could not be drawn"
    others = [table for table in tables if table not in own_tables]
    sections.append(_section("tables", "Tables", "".join(map(_table, others))))
    sections.append(_section("origin", "Where this comes from", _origin(analysis)))
    names |= {"tables": "Tables", "origin": "Where this comes from"}
    links = "".join(f'<li><a href="#{key}">{escape(name)}</a></li>' for key, name in names.items())
    plan = file.plan
    done = len(analysis.runs)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<a class="skip" href="#{next(iter(names))}">Skip to the findings</a>
<header>
<p class="kind">Report of a study</p>
<h1>{escape(file.versioned_name)}</h1>
<p class="lead">{escape(file.description)}</p>
<p class="counts">{_counted(len(plan.classes), "class", "classes")} ×
{_counted(len(plan.algorithms), "algorithm")} × {_counted(plan.seeds, "seed")}:
<strong>{done:,} of {len(plan.cells):,} runs</strong> have finished.</p>
</header>
<nav aria-label="Sections"><ul>{links}</ul></nav>
<main>
{"".join(sections)}</main>
</body>
</html>
"""


def _learnt_from_data(
    analysis: Analysis, figures: Sequence[Picture], tables: Sequence[TextTable]
) -> str:
    """What cells that learn from data add, tables opened; it comes first."""
    own = [figure for figure in figures if figure.name.startswith(_OFFLINE)]
    content = (
        '<p class="question">Does a learner reach the policy that made its data, or surpass it?'
        f"</p>{_list(offline_words(analysis))}{''.join(map(_figure, own))}"
        + "".join(_table(table, opened=True) for table in tables)
    )
    return _section(_OFFLINE, "Learning from data", content)


def _in_words(analysis: Analysis) -> str:
    found = findings(analysis)
    parts = [
        '<p class="question">Which property of the task breaks the algorithm, and how sure are '
        "we?</p>"
    ]
    if not found:
        parts.append("<p>No algorithm that learns has a finished run yet.</p>")
    parts += [
        f'<article class="finding"><h3>{escape(finding.algorithm)}</h3>'
        f"<p><strong>{escape(finding.headline)}</strong></p>{_list(finding.points)}</article>"
        for finding in found
    ]
    compared = comparison(analysis)
    if compared:
        parts.append(f"<h3>Between the algorithms</h3><p>{escape(compared)}</p>")
    parts.append(
        "<h3>How to read this</h3><p>Normalised regret is the mean |a − a*| of a policy over that "
        "of the constant action ½ on the same states: 0 is the optimum, 1 is no better than the "
        "constant. The run is the unit: each is trained and judged once, and intervals are over "
        f"runs. A change is from the plan’s first class, {escape(analysis.base)}.</p>"
        f"{_list(caveats(analysis))}"
    )
    return _section("words", "In words", "".join(parts))


def _origin(analysis: Analysis) -> str:
    file, plan = analysis.file, analysis.file.plan
    results = [analysis.cells[key] for key in analysis.runs.key]
    hours = analysis.runs.seconds.sum() / 3600.0
    versions = Counter(
        ", ".join(f"{name} {version}" for name, version in sorted(result.versions.items()))
        for result in results
    )
    pairs: list[tuple[str, str]] = [
        ("plan", f"{file.versioned_name}, <code>{file.digest}</code>"),
        ("protocol", f"<code>{plan.protocol.digest}</code>"),
        (
            "runs",
            f"{len(results):,} of {len(plan.cells):,} have finished, in {hours:,.1f} hours of one "
            "core",
        ),
        (
            "evaluations",
            f"{plan.evaluations:,} while training, {plan.evaluation_episodes} episodes each; at "
            f"the end {plan.protocol.states_per_region:,} states in each region",
        ),
    ]
    for algorithm in plan.algorithms:
        steps = plan.steps if algorithm.steps is None else algorithm.steps
        settings = ", ".join(f"{k} = {v}" for k, v in sorted(algorithm.hyperparameters.items()))
        pairs.append(
            (
                escape(algorithm.name),
                f"<code>{escape(algorithm.uses)}</code>, {steps:,} steps, actions "
                f"{algorithm.action_range}, "
                + (escape(settings) if settings else "default hyperparameters"),
            )
        )
    for text, count in versions.most_common():
        pairs.append((f"versions of {_counted(count, 'run')}", escape(text)))
    rows = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in pairs)
    gaps = [
        f"{gap.algorithm} on {gap.class_name}, run {gap.run}"
        + (f": failed: {gap.error}" if gap.error else "")
        for gap in analysis.missing.itertuples()
    ]
    named = ""
    if gaps:
        rest = len(gaps) - _LISTED
        more = [f"and {rest:,} more; tables/missing.csv has all"] if rest > 0 else []
        named = (
            f"<details><summary>{_counted(len(gaps), 'run')} of the plan that "
            f"{'is' if len(gaps) == 1 else 'are'} missing</summary>"
            f"{_list([*gaps[:_LISTED], *more])}</details>"
        )
    return f"<dl>{rows}</dl>{named}"


def _figure(figure: Picture) -> str:
    source = base64.b64encode(figure.files["svg"]).decode("ascii")
    kind = ' class="map"' if figure.is_map else ""
    label = escape(figure.title, quote=True)
    return (
        f'<figure id="figure-{figure.name}"{kind}>'
        f"<h3>{escape(figure.title)}</h3>"
        f'<div class="scroll" tabindex="0" role="group" aria-label="{label}">'
        f'<img src="data:image/svg+xml;base64,{source}" alt="{label}. The numbers are in the '
        'tables below."></div>'
        f"<figcaption>{escape(figure.caption)}</figcaption></figure>\n"
    )


def _table(table: TextTable, *, opened: bool = False) -> str:
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in table.frame.columns)
    rows = "".join(
        f'<tr><th scope="row">{escape(first)}</th>'
        + "".join(f"<td>{escape(entry)}</td>" for entry in rest)
        + "</tr>"
        for first, *rest in table.frame.itertuples(index=False)
    )
    label = escape(table.title, quote=True)
    return (
        f'<details id="table-{table.name}"{" open" if opened else ""}>'
        f"<summary>{escape(table.title)}</summary>"
        f'<p class="note">{escape(table.note)}</p>'
        f'<div class="scroll" tabindex="0" role="group" aria-label="{label}"><table>'
        f'<caption class="hidden">{escape(table.title)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div></details>\n"
    )


def _section(key: str, heading: str, content: str) -> str:
    return (
        f'<section id="{key}" aria-labelledby="{key}-heading">'
        f'<h2 id="{key}-heading">{escape(heading)}</h2>\n{content}</section>\n'
    )


def _list(entries: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(entry)}</li>" for entry in entries)
    return f"<ul>{items}</ul>" if items else ""


def _counted(count: int, one: str, many: str = "") -> str:
    return f"{count:,} {one if count == 1 else many or f'{one}s'}"

"""A study's tables as files: every number as CSV, and what a paper prints as LaTeX.

A `Data` is long, a row a number or a few, for other programs; a `Printed` is what people read,
already in words, and also stands on the page.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sme_registry.studies.report.analysis import METRICS
from sme_registry.studies.report.tables import Analysis

_METRIC_LABELS = {metric.key: metric.label for metric in METRICS}


@dataclass(frozen=True)
class Data:
    """A long table of numbers; None is an empty entry."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def csv(self) -> str:
        """As CSV, floats so that they read back as they are."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue()


@dataclass(frozen=True)
class Printed:
    """A table for people; its first column names the rows."""

    name: str
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def latex(self) -> str:
        """As a `table` of LaTeX, with the rules of the package booktabs; ASCII only."""
        lines = [
            "% needs \\usepackage{booktabs}",
            "\\begin{table}",
            "  \\centering",
            f"  \\caption{{{_tex(f'{self.title}. {self.note}')}}}",
            f"  \\label{{tab:{self.name}}}",
            f"  \\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
            "    \\toprule",
            f"    {_tex_row(self.columns)}",
            "    \\midrule",
            *(f"    {_tex_row(row)}" for row in self.rows),
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
        ]
        return "\n".join(lines) + "\n"


def data(analysis: Analysis) -> list[Data]:
    """Every table of the study, whole."""
    runs = (
        (
            run.planned.class_name,
            run.planned.algorithm,
            run.planned.run,
            *(metric.of(run.result) for metric in METRICS),
            run.result.timing.total,
            run.result.timing.steps_per_second,
            run.result.key,
        )
        for run in analysis.results
    )
    curves = (
        (c.class_name, c.algorithm, c.measure, int(step), *map(float, values), c.runs)
        for c in analysis.curves
        for step, *values in zip(c.steps, c.median, c.low, c.high, strict=True)
    )
    profiles = (
        (p.group, p.algorithm, p.metric, round(float(tau), 4), *map(float, at))
        for p in analysis.profiles
        for tau, *at in zip(
            p.thresholds, p.estimate.value, p.estimate.low, p.estimate.high, strict=True
        )
    )
    return [
        table_of("runs", f"class algorithm run {' '.join(_METRIC_LABELS)} seconds "
              "steps_per_second key", runs),
        table_of("counts", "class algorithm done failed planned", analysis.counts),
        table_of("missing", "class algorithm run error", analysis.missing),
        table_of(
            "contrasts",
            "class axis algorithm metric base level change low high pairs verdict",
            (
                (r.class_name, r.axis, r.algorithm, r.metric, r.base, r.level, r.change, r.low,
                 r.high, r.pairs, r.verdict)
                for r in analysis.contrasts
            ),
        ),
        table_of(
            "levels",
            "class algorithm metric runs iqm low high linear",
            (
                (r.class_name, r.algorithm, r.metric, r.runs, r.value, r.low, r.high, r.linear)
                for r in analysis.levels
            ),
        ),
        table_of(
            "regions",
            "class algorithm region epsilon runs similarity similarity_q25 similarity_q75 "
            "normalised_regret linear",
            analysis.regions,
        ),
        table_of(
            "decay",
            "class algorithm run state_dim epsilon similarity_wd decay decay_points",
            analysis.decay,
        ),
        table_of(
            "scores",
            "group algorithm metric statistic classes runs fewest_runs value low high",
            (
                (r.group, r.algorithm, r.metric, r.statistic, r.classes, r.runs, r.fewest, r.value,
                 r.low, r.high)
                for r in analysis.aggregates
            ),
        ),
        table_of(
            "improvement",
            "group metric first second classes fewest_runs probability low high",
            (
                (r.group, r.metric, r.first, r.second, r.classes, r.fewest, r.value, r.low, r.high)
                for r in analysis.improvements
            ),
        ),
        table_of("curves", "class algorithm measure steps median q25 q75 runs", curves),
        table_of("profiles", "group algorithm metric threshold share low high", profiles),
    ]  # fmt: skip


def printed(analysis: Analysis) -> list[Printed]:
    """What people read: settings down, algorithms across."""
    found = [_contrasts(analysis, metric.key) for metric in METRICS]
    found += [_regions(analysis, name) for name in analysis.algorithms]
    found += [_scores(analysis), _improvement(analysis), _counts(analysis)]
    return [table for table in found if table.rows]


def _contrasts(analysis: Analysis, metric: str) -> Printed:
    at = {(r.class_name, r.algorithm): r for r in analysis.contrasts if r.metric == metric}
    digits = 1 if metric == "final_return" else 2

    def entry(name: str, algorithm: str) -> str:
        row = at.get((name, algorithm))
        if row is None:
            return "–"
        if row.low is None or row.high is None:
            return f"{number(row.change, digits, '+')} (1 pair)"
        ends = f"{number(row.low, digits, '+')}, {number(row.high, digits, '+')}"
        star = {"worse": " *", "better": " †", "open": ""}[row.verdict] if row.settled else ""
        few = "" if row.settled else f" (n = {row.pairs})"
        return f"{number(row.change, digits, '+')} [{ends}]{few}{star}"

    return Printed(
        f"contrasts-{metric.replace('_', '-')}",
        f"Change of {_METRIC_LABELS[metric]}, from the class {analysis.base}",
        "IQM over pairs of runs, with the 95 % bootstrap interval of the change. "
        "*: worse, †: better, by an interval that leaves out 0 and rests on enough pairs.",
        ("class", "setting", *analysis.algorithms),
        tuple(
            (
                name,
                analysis.classes[name].label,
                *(entry(name, algorithm) for algorithm in analysis.algorithms),
            )
            for name in analysis.classes
            if any(place[0] == name for place in at)
        ),
    )


def _regions(analysis: Analysis, algorithm: str) -> Printed:
    rows = [row for row in analysis.regions if row.algorithm == algorithm]
    regions = list(dict.fromkeys(row.region for row in rows))
    at = {(row.class_name, row.region): row for row in rows}
    return Printed(
        f"regions-{_slug(algorithm)}",
        f"Similarity r̃ of {algorithm} by region",
        "IQM over runs; 1 is the optimum. In brackets the normalised regret: 0 the optimum's, 1 "
        "the constant ½'s.",
        ("class", *regions),
        tuple(
            (
                name,
                *(
                    f"{at[name, region].similarity:.3f} ({at[name, region].regret:.2f})"
                    for region in regions
                ),
            )
            for name in analysis.classes
            if (name, regions[0]) in at
        ),
    )


def _scores(analysis: Analysis) -> Printed:
    at = {(r.group, r.metric, r.statistic, r.algorithm): r for r in analysis.aggregates}
    places = list(dict.fromkeys(key[:3] for key in at))
    words = {"iqm": "IQM", "median": "median", "optimality_gap": "optimality gap"}
    regions = {"wd_regret": "WD", "ood_regret": "OOD"}
    return Printed(
        "scores",
        "Scores: 1 − normalised regret",
        "Means over classes of a statistic over runs, with 95 % stratified bootstrap intervals. "
        "Of the optimality gap less is better.",
        ("classes", "region", "statistic", *analysis.algorithms),
        tuple(
            (
                group,
                regions[metric],
                words[statistic],
                *(
                    _with_interval(row.value, row.low, row.high)
                    for name in analysis.algorithms
                    for row in [at[group, metric, statistic, name]]
                ),
            )
            for group, metric, statistic in places
        ),
    )


def _improvement(analysis: Analysis) -> Printed:
    at = {(r.group, r.metric, r.first, r.second): r for r in analysis.improvements}
    rows = list(dict.fromkeys((r.group, r.first, r.second) for r in analysis.improvements))
    return Printed(
        "improvement",
        "Probability of improvement",
        "That a run of the first algorithm beats one of the second, on a class drawn at random.",
        ("classes", "comparison", "WD", "OOD"),
        tuple(
            (
                group,
                f"{first} over {second}",
                *(
                    _with_interval(row.value, row.low, row.high)
                    for metric in ("wd_regret", "ood_regret")
                    for row in [at[group, metric, first, second]]
                ),
            )
            for group, first, second in rows
        ),
    )


def _counts(analysis: Analysis) -> Printed:
    names = list(dict.fromkeys(count.algorithm for count in analysis.counts))
    at = {(count.class_name, count.algorithm): count for count in analysis.counts}

    def entry(name: str, algorithm: str) -> str:
        count = at[name, algorithm]
        failed = f", {count.failed} failed" if count.failed else ""
        return f"{count.done} of {count.planned}{failed}"

    return Printed(
        "counts",
        "Finished runs",
        "What is missing is in no number.",
        ("class", *names),
        tuple((c, *(entry(c, name) for name in names)) for c in analysis.classes),
    )


def table_of(name: str, columns: str, rows: Any) -> Data:
    """A long table; its columns in one string, between spaces."""
    return Data(name, tuple(columns.split()), tuple(map(tuple, rows)))


def _with_interval(value: float, low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return number(value)
    return f"{number(value)} [{number(low)}, {number(high)}]"


def number(value: float, digits: int = 2, sign: str = "") -> str:
    """A number with a true minus, and no sign on what rounds to 0."""
    text = f"{value:{sign}.{digits}f}"
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("+-")
    return text.replace("-", "−")


def _slug(text: str) -> str:
    """An algorithm's name as a part of a file's."""
    return "".join(c if c.isalnum() else "-" for c in text)


_TEX: dict[str, str] = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "−": "$-$", "–": "--", "½": r"$\frac12$", "ε": r"$\varepsilon$", "†": r"$^\dagger$",
    "τ": r"$\tau$", "*": "$^*$", "≥": r"$\geq$", "’": "'", "ν": r"$\nu$",
    "±": r"$\pm$",
}  # fmt: skip


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text.replace("r̃", "\0")).replace("\0", r"$\tilde r$")


def _tex_row(cells: Sequence[str]) -> str:
    return " & ".join(map(_tex, cells)) + r" \\"

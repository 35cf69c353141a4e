"""`text_tables`: the tables of a study that people read, on the report's page and as LaTeX."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from sme_registry.evaluation.retention import LABELS
from sme_registry.io.markup import escape_latex, fixed, signed
from sme_registry.studies.report.analysis import (
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    TABLES,
    Analysis,
)
from sme_registry.studies.report.design import (
    METRICS,
    OUTSIDE,
    SCHEDULE,
    WITHIN,
    Metric,
    metrics_of,
)

_ABSENT = "–"
_STATISTICS = {"iqm": "IQM", "median": "median", "optimality_gap": "optimality gap"}
_REGIONS = {"wd_regret": "WD", "ood_regret": "OOD"}
_METRICS = {metric.key: metric for metric in METRICS}
_LABELS = {key: metric.label for key, metric in _METRICS.items()}
_OF_TRAINING = [metric.key for metric in metrics_of("visit") if metric.training]
_SHOWN_BY_VISIT = ("normalised_regret", "forgetting", "plasticity_ratio", *_OF_TRAINING)
_BY_CLASS, _BY_STREAM = {"class_name": "class"}, {"class_name": "stream"}
_INTERVAL = "with its 95 % bootstrap interval"
_MARKS = "*: worse, †: better, by an interval that excludes 0 and rests on enough pairs."
_DIFFERENCE = (
    f"{_INTERVAL}. *: the first algorithm is worse, †: better, by an interval that excludes 0 and "
    f"rests on at least {ENOUGH_RUNS} pairs."
)


@dataclass(frozen=True, eq=False)
class TextTable:
    """A table for people: all columns of its frame are text; the first `names` name the rows."""

    name: str
    title: str
    note: str
    frame: pd.DataFrame
    names: int = 1
    label: str = ""  # of LaTeX; by default the name

    def latex(self) -> str:
        """As a LaTeX `table` that is scaled down to the column's width; ASCII only."""
        columns = [escape_latex(name) for name in self.frame]
        body = self.frame.map(escape_latex).set_axis(columns, axis=1).to_latex(
            index=False, column_format="l" * self.names + "r" * (len(columns) - self.names)
        )  # fmt: skip
        return (
            "% needs \\usepackage{booktabs,graphicx}\n\\begin{table}\n\\centering\\footnotesize\n"
            f"\\caption{{{escape_latex(f'{self.title}. {self.note}')}}}\n"
            f"\\label{{tab:{self.label or self.name}}}\n"
            "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
            f"{body}}}\n\\end{{table}}\n"
        )


def csv_tables(analysis: Analysis) -> dict[str, str]:
    """Every table of the study as CSV, by name; floats read back as they are."""
    kinds = {False: bool(analysis.classes), True: bool(analysis.streams)}
    return {
        name: rows.to_csv(index=False, lineterminator="\n")
        for name, rows in analysis.tables.items()
        if kinds[name.startswith("stream_")]
        and not (rows.empty and name in TABLES and TABLES[name].optional)
    }


def text_tables(analysis: Analysis) -> list[TextTable]:
    """What people read: settings down, algorithms across. Tables without rows are left out."""
    of_tasks = _task_tables(analysis) if analysis.algorithms else ()
    of_streams = _stream_tables(analysis) if analysis.streams else ()
    return [table for table in (*of_tasks, *of_streams) if not table.frame.empty]


def _task_tables(analysis: Analysis) -> Iterator[TextTable]:
    yield from offline_tables(analysis)
    yield from _metric_tables(analysis)
    yield from _overview_tables(analysis)


def _metric_tables(analysis: Analysis) -> Iterator[TextTable]:
    tables, names = analysis.tables, analysis.algorithms
    for metric, rows in _by_metric(tables["levels"]):
        yield _text(
            f"levels-{slug(metric.key)}", f"{_sentence(metric.label)} by class",
            f"IQM over runs, {_INTERVAL}.", rows, _BY_CLASS, "algorithm", _level, names,
        )  # fmt: skip
    rows = tables["layers"]
    yield _text(
        "layers", "What the layers keep",
        "Held-out R² of a linear map from a layer's outputs to the state and, after the comma, to "
        "the distractors where there are any; IQM over runs, in the training cube.",
        rows.assign(layer=rows.layer.map(str).replace("0", "observation")),
        _BY_CLASS | {"layer": "layer"}, "algorithm", _kept, names,
    )  # fmt: skip
    for metric, rows in _by_metric(tables["agents"]):
        yield _text(
            f"agents-{slug(metric.key)}", f"{_sentence(metric.label)} of each agent",
            f"IQM over runs, {_INTERVAL}, over the action channels that the agent owns.",
            rows, _BY_CLASS | {"agent": "agent"}, "algorithm", _level, names,
        )  # fmt: skip
    rows = tables["differences"]
    for metric, of_metric in _by_metric(rows[rows["first"] == names[0]]):
        yield difference_table(of_metric, metric)
    setting = {name: info.label for name, info in analysis.classes.items()}
    for metric, rows in _by_metric(tables["contrasts"]):
        yield _text(
            f"contrasts-{slug(metric.key)}",
            f"Change of {metric.label}, from the class {analysis.base}",
            f"IQM over pairs of runs, with the 95 % bootstrap interval of the change. {_MARKS}",
            rows.assign(setting=rows.class_name.map(setting)), _BY_CLASS | {"setting": "setting"},
            "algorithm", _change, names,
        )  # fmt: skip


def _overview_tables(analysis: Analysis) -> Iterator[TextTable]:
    tables = analysis.tables
    for name, rows in tables["regions"].groupby("algorithm", sort=False):
        yield _text(
            f"regions-{slug(name)}", f"Similarity r̃ of {name} by region",
            "IQM over runs; 1 is the optimum. In brackets the normalised regret: 0 for the "
            "optimum, 1 for the constant ½.",
            rows, _BY_CLASS, "region",
            lambda row, _: f"{row.similarity:.3f} ({row.normalised_regret:.2f})",
        )  # fmt: skip
    yield _text(
        "aggregates", "Aggregates of 1 − normalised regret",
        "Means over classes of a statistic over runs, with 95 % stratified bootstrap intervals. "
        "For the optimality gap less is better.",
        tables["aggregates"].replace({"metric": _REGIONS, "statistic": _STATISTICS}),
        {"group": "classes", "metric": "region", "statistic": "statistic"},
        "algorithm", lambda row, digits: _with_interval(row.value, row, digits),
    )  # fmt: skip
    rows = tables["improvements"].replace({"metric": _REGIONS})
    yield _text(
        "improvements", "Probability of improvement",
        "That a run of the first algorithm beats one of the second, on a class drawn at random.",
        rows.assign(comparison=rows["first"] + " over " + rows["second"]),
        {"group": "classes", "comparison": "comparison"},
        "metric", lambda row, digits: _with_interval(row.probability, row, digits),
    )  # fmt: skip
    yield _text(
        "counts", "Finished runs", "Missing runs are part of no other number.",
        tables["counts"], _BY_CLASS, "algorithm",
        lambda row, _: f"{row.done} of {row.planned}{_failures(row)}",
    )  # fmt: skip


def offline_tables(analysis: Analysis) -> list[TextTable]:
    rows = analysis.tables["offline"].assign(nu=lambda rows: rows.nu.map("{:g}".format))
    at = _BY_CLASS | {"nu": "ν"}
    similarity = _text(
        "offline", "Learning from data: mean similarity r̃",
        "Mean over runs ± the standard deviation over steps (its mean over runs); in brackets "
        "the number of runs, or of the behaviour policy's data sets. The constant ½ is "
        "evaluated within distribution.",
        rows, at, "learner", lambda row, _: _mean(row, "similarity", row.runs),
    )  # fmt: skip
    data = [*rows.drop_duplicates(["class_name", "nu"]).itertuples()]
    constant = [fixed(row.constant_similarity, 3) for row in data]
    behaviour = [_mean(row, "behaviour_similarity", row.data_sets) for row in data]
    similarity.frame.insert(2, "constant ½", constant)
    similarity.frame.insert(3, "behaviour policy", behaviour)
    improvement = _text(
        "offline-improvement", "Learning from data: r̃ minus the behaviour policy's",
        f"Mean over runs, with its 95 % bootstrap interval from {OFFLINE_INTERVAL} runs on. "
        "†: above its data, *: below, by an interval that excludes 0 and rests on at least "
        f"{ENOUGH_RUNS} runs.",
        rows, at, "learner", _improvement,
    )  # fmt: skip
    return [similarity, improvement]


def difference_table(rows: pd.DataFrame, metric: Metric, *, levels: bool = False) -> TextTable:
    """Paired differences of one metric: classes down, pairs of algorithms across.

    With `levels`, of a single pair, the levels of both algorithms are columns as well.
    """
    rows = rows.assign(pair=rows["first"] + " − " + rows["second"])
    pairs = list(dict.fromkeys(rows.pair))
    between = pairs[0] if len(pairs) == 1 else f"{''.join(rows['first'][:1])} minus each other"
    name = f"differences-{slug(metric.key)}"
    note = f"IQM over pairs of runs on the same instance with the same seed, {_DIFFERENCE}"
    table = _text(
        name, f"Difference of {metric.label}, {between}",
        " ".join([note, *difference_caveats(rows)]), rows, _BY_CLASS, "pair",
        lambda row, digits: _change(row, digits + 1),
        label=f"{name}-{slug(pairs[0])}" if levels else "",
    )  # fmt: skip
    for place, side in enumerate(("first", "second")) if levels else ():
        texts = [fixed(value, metric.digits + 1) for value in rows[f"{side}_level"]]
        table.frame.insert(1 + place, rows[side].iloc[0], texts)
    return table


def difference_caveats(rows: pd.DataFrame) -> list[str]:
    """A sentence for each reason why intervals of paired differences say less than 95 %."""
    caveats = []
    if not rows.enough_pairs.all():
        caveats.append(
            f"With fewer than {ENOUGH_RUNS} pairs on a class, an interval covers the true "
            "difference in far fewer than 95 % of cases: it is an indication only."
        )
    if (rows.pairs > rows.instances).any():
        caveats.append(
            "Several pairs share an instance: such runs are not independent draws of the task, so "
            "the interval is too narrow for other instances."
        )
    return caveats


def _stream_tables(analysis: Analysis) -> Iterator[TextTable]:
    tables, names = analysis.tables, analysis.stream_algorithms
    for name in analysis.streams:
        yield _life_table(analysis, name)
    for name, info in analysis.streams.items():
        yield _retention_table(tables["stream_matrices"], name, len(info.stream.phases))
    rows = tables["stream_visit_metrics"]
    at = rows.visit.astype(str) + " (phase " + rows.phase.astype(str) + ")"
    rows = rows.assign(at=at)[rows.region == WITHIN]
    for key in _SHOWN_BY_VISIT:
        end = "." if key in _OF_TRAINING else ", within distribution."
        yield _text(
            f"stream-visits-{slug(key)}", f"{_sentence(_LABELS[key])} by visit",
            f"IQM over lives, {_INTERVAL}{end}", rows[rows.metric == key],
            _BY_STREAM | {"at": "visit"}, "algorithm", _level, names,
        )  # fmt: skip
    by_metric = _BY_STREAM | {"label": "metric"}
    rows = tables["stream_differences"]
    yield _text(
        "stream-differences", "Differences between algorithms in streams",
        "IQM over pairs of lives in the same draw of the stream with the same seed, within "
        f"distribution, {_DIFFERENCE}",
        rows.assign(label=rows.metric.map(_LABELS), pair=rows["first"] + " − " + rows["second"]),
        by_metric, "pair", _change,
    )  # fmt: skip
    note = (
        "IQM over pairs of lives with the same number, within distribution, with the 95 % "
        f"bootstrap interval of the change. {_MARKS}"
    )
    others = [name for name, info in analysis.streams.items() if info.axis == SCHEDULE]
    if others:
        note += (
            f" The schedule of {', '.join(others)} differs from that of {analysis.stream_base}, so "
            "the change is not one of the tasks alone."
        )
    rows = tables["stream_contrasts"]
    yield _text(
        "stream-contrasts", f"Change from the stream {analysis.stream_base}", note,
        rows.assign(label=rows.metric.map(_LABELS)), by_metric, "algorithm", _change, names,
    )  # fmt: skip
    yield _text(
        "stream-counts", "Finished lives and fresh agents",
        "Lives, then the fresh agents with which their plasticity is compared. A life whose fresh "
        "agents are missing has no plasticity and no learning transfer, and all other numbers.",
        tables["stream_counts"], _BY_STREAM, "algorithm",
        lambda row, _: f"{row.lives} of {row.planned_lives}, "
        f"{row.fresh_agents} of {row.planned_fresh_agents}{_failures(row)}",
    )  # fmt: skip


def _life_table(analysis: Analysis, name: str) -> TextTable:
    rows = analysis.tables["stream_metrics"]
    rows = rows[(rows.class_name == name) & rows.region.isin((WITHIN, OUTSIDE))]
    everywhere = rows.metric.isin(_OF_TRAINING)
    rows = rows[~everywhere | (rows.region == WITHIN)]
    rows = rows.assign(region=rows.region.mask(everywhere, ""), label=rows.metric.map(_LABELS))
    order = list(_METRICS)
    table = _text(
        f"stream-metrics-{slug(name)}", f"Lives in {name}",
        f"IQM over lives, {_INTERVAL}, at the end of the life; the regret on "
        "the visited phase is a mean over visits, plasticity and learning transfer over those "
        "after visit 0, in which a life is a fresh agent itself. Performance is 1 − normalised "
        "regret: 1 for the optimum, 0 for the constant ½. A ratio below 1 is better than a "
        "fresh agent’s. The last columns are agents that need no training.",
        rows.sort_values("metric", kind="stable", key=lambda keys: keys.map(order.index)),
        {"label": "metric", "region": "region"}, "algorithm",
        _level, analysis.stream_algorithms,
    )  # fmt: skip
    references = analysis.tables["stream_references"]
    references = references[references.class_name == name]
    cells = {}
    for row in references.itertuples():
        region = "" if row.metric in _OF_TRAINING else row.region
        value = fixed(row.value, _METRICS[row.metric].digits)
        cells[_LABELS[row.metric], region, row.reference] = value
    places = [*zip(table.frame["metric"], table.frame["region"], strict=True)]
    for reference in dict.fromkeys(references.reference):
        table.frame[LABELS[reference]] = [cells.get((*place, reference), "") for place in places]
    return table


def _retention_table(rows: pd.DataFrame, name: str, phases: int) -> TextTable:
    rows = rows[(rows.class_name == name) & (rows.region == WITHIN)]
    after = rows.visit.map(
        lambda visit: "initial" if pd.isna(visit) else f"visit {visit} (phase {visit % phases})"
    )
    return _text(
        f"stream-retention-{slug(name)}", f"Retention in {name}",
        "Normalised regret within distribution on the task of each phase, of the policy before "
        f"training and at the end of each visit. IQM over lives, {_INTERVAL}.",
        rows.assign(after=after, column="phase " + rows.phase.astype(str)),
        {"algorithm": "algorithm", "after": "policy"}, "column", _level,
    )  # fmt: skip


def _by_metric(rows: pd.DataFrame) -> Iterator[tuple[Metric, pd.DataFrame]]:
    """Each metric of runs on single tasks, in the order of reports, and its rows."""
    for metric in metrics_of("run"):
        yield metric, rows[rows.metric == metric.key]


def _text(
    name: str,
    title: str,
    note: str,
    rows: pd.DataFrame,
    index: dict[str, str],
    across: str,
    entry: Callable[[Any, int], str],
    order: Sequence[str] = (),
    label: str = "",
) -> TextTable:
    """A long table as text: `index` names the rows, and each value of `across` is a column.

    `entry` is called with a row and the number of digits of its metric.
    """
    lines: dict[tuple[Any, ...], dict[str, str]] = {}
    for row in rows.itertuples():
        metric = _METRICS.get(getattr(row, "metric", ""))
        place = tuple(getattr(row, column) for column in index)
        digits = 2 if metric is None else metric.digits
        lines.setdefault(place, {})[getattr(row, across)] = entry(row, digits)
    present = dict.fromkeys(rows[across])
    names = [column for column in order or present if column in present]
    frame = pd.DataFrame(
        [dict(zip(index.values(), place, strict=True)) | line for place, line in lines.items()],
        columns=[*index.values(), *names],
    )
    return TextTable(name, title, note, frame.fillna(_ABSENT), len(index), label)


def slug(name: str) -> str:
    """A name with `-` for everything but letters and digits."""
    return "".join(letter if letter.isalnum() else "-" for letter in name.replace(" − ", "-"))


def _sentence(label: str) -> str:
    return label[0].upper() + label[1:]


def _level(row: Any, digits: int) -> str:
    return _with_interval(row.iqm, row, digits) + _few(row)


def _change(row: Any, digits: int) -> str:
    """A change or difference with its interval; marked if it excludes 0 by enough pairs."""
    value = row.change if hasattr(row, "change") else row.difference
    count = "" if row.enough_pairs else " (1 pair)" if row.pairs == 1 else f" (n = {row.pairs})"
    mark = {"worse": " *", "better": " †"}.get(row.verdict, "") if row.enough_pairs else ""
    return _with_interval(value, row, digits, signed) + count + mark


def _improvement(row: Any, _: int) -> str:
    mark = {"above": " †", "below": " *"}.get(row.verdict, "")
    return _with_interval(row.improvement, row, 3, signed) + _few(row) + mark


def _few(row: Any) -> str:
    return "" if row.runs >= ENOUGH_RUNS else f" (n = {row.runs})"


def _failures(row: Any) -> str:
    return f", {row.failed} failed" if row.failed else ""


def _kept(row: Any, _: int) -> str:
    kept = row.state_r2, row.distractor_r2
    return ", ".join(fixed(value) for value in kept if not math.isnan(value))


def _mean(row: Any, column: str, runs: int) -> str:
    mean, sd = getattr(row, column), getattr(row, f"{column}_sd")
    return f"{fixed(mean, 3)} ± {fixed(sd, 3)} ({runs})"


def _with_interval(
    value: float, row: Any, digits: int = 2, text: Callable[[float, int], str] = fixed
) -> str:
    """A number with the row's interval; without it where it is unknown."""
    if math.isnan(row.low):
        return text(value, digits)
    return f"{text(value, digits)} [{text(row.low, digits)}, {text(row.high, digits)}]"

"""`text_tables`: the tables of a study that people read, on the report's page and as LaTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import pandas as pd

from sme_registry.evaluation.retention import LABELS
from sme_registry.io.markup import conjunction, escape_latex, fixed, signed
from sme_registry.spec import StudyPlan
from sme_registry.studies.report.analysis import ENOUGH_RUNS, OFFLINE_INTERVAL, TABLES, Analysis
from sme_registry.studies.report.design import ALL, METRICS, OUTSIDE, WITHIN
from sme_registry.training.algorithms import AGENTS, BACKENDS, parse_uses

_LABELS = {key: metric.label for key, metric in METRICS.items()}
_OF_TRAINING = [key for key, metric in METRICS.items() if metric.training]
_ABSENT = "–"
_BY_VISIT = ["normalised_regret", "forgetting", "plasticity_ratio", *_OF_TRAINING]
_HEADINGS = {
    "class_name": "class", "nu": "ν", "group": "classes", "label": "metric"
}  # fmt: skip
_INTERVAL = "with its 95 % bootstrap interval"
_MARK = " †"
_MARKS = f"†: the interval excludes 0, with at least {ENOUGH_RUNS} pairs per class."
_OF_FEW = f"With fewer than {ENOUGH_RUNS}, a result is an indication."
_SHARED = (
    "Several pairs share an instance: such runs are not independent draws of the task, so the "
    "interval is too narrow for other instances."
)
_DIFFERENCE = f"{_INTERVAL}. {_MARKS}"


@dataclass(frozen=True, eq=False)
class TextTable:
    """A table for people: all columns of its frame are text; the first `names` name the rows."""

    name: str
    title: str
    note: str
    frame: pd.DataFrame
    names: int = 1
    caption: str = ""  # of LaTeX, after the title
    label: str = ""  # of LaTeX; by default the name

    def latex(self) -> str:
        """As a LaTeX `table` that is scaled down to the column's width; ASCII only."""
        columns = [escape_latex(name) for name in self.frame]
        caption = f"{self.title}. {self.caption}".rstrip()
        body = self.frame.map(escape_latex).set_axis(columns, axis=1).to_latex(
            index=False, column_format="l" * self.names + "r" * (len(columns) - self.names)
        )  # fmt: skip
        return (
            "% needs \\usepackage{booktabs,graphicx}\n\\begin{table}\n\\centering\\footnotesize\n"
            f"\\caption{{{escape_latex(caption)}}}\n"
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


# Entries of a table, from a row and the digits of its metric.


def _level(row: Any, digits: int) -> str:
    return _with_interval(row.iqm, row, digits) + _few(row)


def _change(row: Any, digits: int) -> str:
    """A change or difference with its interval; marked if it excludes 0 by enough pairs."""
    value = row.change if hasattr(row, "change") else row.difference
    count = "" if row.enough_pairs else " (1 pair)" if row.pairs == 1 else f" (n = {row.pairs})"
    mark = _MARK if row.verdict in ("worse", "better") else ""
    return _with_interval(value, row, digits, signed) + count + mark


def _improvement(row: Any, _: int) -> str:
    mark = _MARK if row.verdict in ("above", "below") else ""
    return _with_interval(row.improvement, row, 3, signed) + _few(row) + mark


def _similarity(row: Any, _: int) -> str:
    spread = "" if math.isnan(row.similarity_sd) else f" ± {fixed(row.similarity_sd, 3)}"
    return fixed(row.similarity, 3) + spread + (f" ({row.runs})" if spread else "")


def _in_region(row: Any, digits: int) -> str:
    return f"{fixed(row.similarity, 3)} ({fixed(row.normalised_regret, digits)})"


def _kept(row: Any, digits: int) -> str:
    kept = row.state_r2, row.distractor_r2
    return ", ".join(fixed(value, digits) for value in kept if not math.isnan(value))


def _finished(row: Any, _: int) -> str:
    failures = f", {row.failed} failed" if row.failed else ""
    if hasattr(row, "done"):
        return f"{row.done} of {row.planned}{failures}"
    fresh = f"{row.fresh_agents} of {row.planned_fresh_agents}"
    return f"{row.lives} of {row.planned_lives}, {fresh}{failures}"


def _few(row: Any) -> str:
    return "" if row.runs >= ENOUGH_RUNS else f" (n = {row.runs})"


def _with_interval(
    value: float, row: Any, digits: int = 2, text: Callable[[float, int], str] = fixed
) -> str:
    """A number with the row's interval; without it where it is unknown."""
    if math.isnan(row.low):
        return text(value, digits)
    return f"{text(value, digits)} [{text(row.low, digits)}, {text(row.high, digits)}]"


class Layout(NamedTuple):
    """How people read a table: columns whose values name its rows and its columns, and entries.

    With `each`, a column, there is a table for each of its values, which the title mentions as {}.
    """

    name: str
    title: str
    note: str
    down: Sequence[str]
    across: str
    entry: Callable[[Any, int], str]
    each: str = ""
    table: str = ""  # by default the name


_PLACE = ["class_name"]
_DIFFERENCES = Layout(
    "differences", "Difference of {}",
    f"IQM over pairs of runs on the same instance with the same seed, {_DIFFERENCE}",
    _PLACE, "pair", lambda row, digits: _change(row, digits + 1), each="metric",
)  # fmt: skip
LAYOUTS = (
    Layout(
        "offline", "Learning from data: mean similarity r̃",
        "Mean over runs ± the standard deviation over steps (its mean over runs); in brackets the "
        "number of runs, or of the behaviour policy's data sets. The constant ½ is evaluated "
        "within distribution.",
        ["class_name", "nu"], "learner", _similarity,
    ),
    Layout(
        "offline-improvement", "Learning from data: r̃ minus the behaviour policy's",
        f"Mean over runs, with its 95 % bootstrap interval from {OFFLINE_INTERVAL} runs on. "
        f"†: the interval excludes 0, with at least {ENOUGH_RUNS} runs.",
        ["class_name", "nu"], "learner", _improvement, table="improvement",
    ),
    Layout(
        "levels", "{} by class", f"IQM over runs, {_INTERVAL}.", _PLACE, "algorithm", _level,
        each="metric",
    ),
    Layout(
        "layers", "What the layers keep",
        "Held-out R² of a linear map from a layer's outputs to the state and, after the comma, to "
        "the distractors where there are any; IQM over runs, in the training cube.",
        ["class_name", "layer"], "algorithm", _kept,
    ),
    Layout(
        "agents", "{} of each agent",
        f"IQM over runs, {_INTERVAL}, over the action channels that the agent owns.",
        ["class_name", "agent"], "algorithm", _level, each="metric",
    ),
    _DIFFERENCES,
    Layout(
        "contrasts", "Change of {}, from the first class",
        f"IQM over pairs of runs, with the 95 % bootstrap interval of the change. {_MARKS}",
        ["class_name", "setting"], "algorithm", _change, each="metric",
    ),
    Layout(
        "regions", "Similarity r̃ of {} by region",
        "IQM over runs; 1 is the optimum. In brackets the normalised regret: 0 for the optimum, "
        "1 for the constant ½.",
        _PLACE, "region", _in_region, each="algorithm",
    ),
    Layout(
        "aggregates", "Aggregates of 1 − normalised regret",
        "Means over classes of a statistic over runs, with 95 % stratified bootstrap intervals. "
        "For the optimality gap less is better.",
        ["group", "label", "statistic"], "algorithm",
        lambda row, digits: _with_interval(row.value, row, digits),
    ),
    Layout(
        "improvements", "Probability of improvement",
        "That a run of the first algorithm beats one of the second, on a class drawn at random.",
        ["group", "first", "second"], "label",
        lambda row, digits: _with_interval(row.probability, row, digits),
    ),
    Layout(
        "counts", "Finished runs", "Missing runs are part of no other number.", _PLACE,
        "algorithm", _finished,
    ),
    Layout(
        "stream-metrics", "Lives in {}",
        f"IQM over lives, {_INTERVAL}, at the end of the life; the regret on the visited phase is "
        "a mean over visits, plasticity and learning transfer over those after visit 0, in which "
        "a life is a fresh agent itself. Performance is 1 − normalised regret: 1 for the optimum, "
        "0 for the constant ½. A ratio below 1 is better than a fresh agent’s. The last columns "
        "are agents that need no training.",
        ["label", "region"], "algorithm", _level, each="class_name",
    ),
    Layout(
        "stream-retention", "Retention in {}",
        "Normalised regret within distribution on the task of each phase, of the policy before "
        f"training and at the end of each visit. IQM over lives, {_INTERVAL}.",
        ["algorithm", "policy"], "phase", _level, each="class_name", table="stream_matrices",
    ),
    Layout(
        "stream-visits", "{} by visit", f"IQM over lives, {_INTERVAL}, within distribution.",
        ["class_name", "visit", "phase"], "algorithm", _level, each="metric",
        table="stream_visit_metrics",
    ),
    Layout(
        "stream-differences", "Differences between algorithms in streams",
        "IQM over pairs of lives in the same draw of the stream with the same seed, within "
        f"distribution, {_DIFFERENCE}",
        ["class_name", "label"], "pair", _change,
    ),
    Layout(
        "stream-contrasts", "Change from the first stream",
        "IQM over pairs of lives with the same number, within distribution, with the 95 % "
        f"bootstrap interval of the change. {_MARKS} Of streams with another schedule it is not "
        "one of the tasks alone.",
        ["class_name", "label"], "algorithm", _change,
    ),
    Layout(
        "stream-counts", "Finished lives and fresh agents",
        "Lives, then the fresh agents with which their plasticity is compared. A life whose fresh "
        "agents are missing has no plasticity and no learning transfer, and all other numbers.",
        _PLACE, "algorithm", _finished,
    ),
)  # fmt: skip


def text_tables(analysis: Analysis) -> list[TextTable]:
    """What people read: settings down, algorithms across. Tables without rows are left out."""
    tables = _readable(analysis)
    order = [algorithm.name for algorithm in analysis.plan.algorithms]
    return [
        text
        for layout in LAYOUTS
        if (rows := tables.get(layout.table or layout.name.replace("-", "_"))) is not None
        for text in laid_out(layout, rows, order)
    ]


def comparison_tables(differences: pd.DataFrame, *, verdicts: bool = False) -> list[TextTable]:
    """The result of `compare` for people: class, both levels, and the difference, by metric."""
    texts = []
    for key, rows in differences.groupby("metric", sort=False):
        (text,) = laid_out(_DIFFERENCES, _named(rows))
        for place, side in enumerate(("first", "second"), 1):
            levels = [fixed(value, METRICS[key].digits + 1) for value in rows[f"{side}_level"]]
            text.frame.insert(place, rows[side].iloc[0], levels)
        pair = slug(text.frame.columns[-1])
        if verdicts:
            text.frame[f"{rows['first'].iloc[0]} is"] = rows.verdict.tolist()
        texts.append(replace(text, label=f"{text.name}-{pair}"))
    return texts


def difference_caveats(rows: pd.DataFrame) -> list[str]:
    """A sentence for each reason why intervals of paired differences say less than 95 %."""
    caveats = []
    if not rows.enough_pairs.all():
        caveats.append(
            f"With fewer than {ENOUGH_RUNS} pairs on a class, an interval covers the true "
            "difference in far fewer than 95 % of cases: it is an indication only."
        )
    return [*caveats, *([_SHARED] if _share(rows) else [])]


def _share(rows: pd.DataFrame) -> bool:
    return "instances" in rows and bool((rows.pairs > rows.instances).any())


def implementation_caveats(plan: StudyPlan, names: Collection[str]) -> list[str]:
    """A sentence for each implementation that some of these algorithms have, and others not."""
    kinds = {a.name: parse_uses(a.uses)[0] for a in plan.algorithms if a.name in names}
    caveats = []
    for kind in AGENTS[1:]:
        ours = [name for name, its_kind in kinds.items() if its_kind == kind]
        if len(ours) not in (0, len(kinds)):
            caveats.append(
                f"{conjunction(ours)} {'runs' if len(ours) == 1 else 'run'} in "
                f"{BACKENDS[kind].title}, the other algorithms do not: a difference between the "
                "two is also one between implementations."
            )
    return caveats


def steps_caveats(plan: StudyPlan, names: Collection[str]) -> list[str]:
    """A sentence if those of these algorithms that learn train for different numbers of steps."""
    known = [a for a in plan.algorithms if a.name in names and not a.uses.startswith("reference:")]
    steps = {a.name: plan.steps if a.steps is None else a.steps for a in known}
    listed = ", ".join(f"{name} {count:,}" for name, count in steps.items())
    return [f"Training steps differ: {listed}."] if len({*steps.values()}) > 1 else []


def comparison_caveats(plan: StudyPlan, rows: pd.DataFrame) -> list[str]:
    """Those of the result of `compare`."""
    both = {*rows["first"], *rows["second"]}
    caveats = *implementation_caveats(plan, both), *steps_caveats(plan, both)
    return [*difference_caveats(rows), *caveats]


def laid_out(layout: Layout, rows: pd.DataFrame, order: Sequence[str] = ()) -> Iterator[TextTable]:
    """A long table as text; columns are in an order, or in that of the rows."""
    for value, part in rows.groupby(layout.each, sort=False) if layout.each else [("", rows)]:
        if part.empty:
            continue
        lines: dict[tuple[str, ...], dict[str, str]] = {}
        for row in part.itertuples():
            digits = METRICS[row.metric].digits if hasattr(row, "metric") else 2
            place = tuple(str(getattr(row, column)) for column in layout.down)
            lines.setdefault(place, {})[getattr(row, layout.across)] = layout.entry(row, digits)
        known = {name: index for index, name in enumerate(order)}
        names = sorted(dict.fromkeys(part[layout.across]), key=lambda n: known.get(n, len(known)))
        headings = [_HEADINGS.get(column, column) for column in layout.down]
        if layout.name.startswith("stream"):
            headings = [heading.replace("class", "stream") for heading in headings]
        frame = pd.DataFrame(
            [dict(zip(headings, place, strict=True)) | line for place, line in lines.items()],
            columns=[*headings, *names],
        )
        title = layout.title.format(_LABELS.get(value, value))
        name = f"{layout.name}-{slug(value)}" if value else layout.name
        caveats = difference_caveats(part) if "instances" in part else []
        yield TextTable(
            name, title[0].upper() + title[1:], " ".join([layout.note, *caveats]),
            frame.fillna(_ABSENT), len(headings), _caption(layout, part),
        )  # fmt: skip


def _caption(layout: Layout, rows: pd.DataFrame) -> str:
    """What the numbers of a table in a paper are: `IQM over 5 runs, with its 95 % …`."""
    what = re.match("IQM over ((?:pairs of )?)(runs|lives)", layout.note)
    if what is None or "low" not in rows:
        return ""
    if "reference" in rows:
        rows = rows[rows.reference.isna()]
    counts = rows["pairs" if what[1] else "runs"][rows.get("class_name", "") != ALL]
    few, many = int(counts.min()), int(counts.max())
    n = f"{few}" if few == many else f"{few} to {many}"
    caption = f"IQM over {n} {what[1]}{what[2]}, with 95 % bootstrap interval"
    if many == 1:
        caption = f"Single {what[1]}{what[2]}, without intervals"
    worse = {METRICS[metric].worse for metric in rows.metric}
    if len(worse) == 1:
        caption += f"; {'lower' if worse == {1} else 'higher'} is better"
    marks = f" {_MARKS}" if _MARKS in layout.note else ""
    of_few = f" {_OF_FEW}" if few < ENOUGH_RUNS else ""
    return f"{caption}.{marks}{of_few}" + (f" {_SHARED}" if _share(rows) else "")


def _readable(analysis: Analysis) -> dict[str, pd.DataFrame]:
    """The tables, and further rows and columns of text for people."""
    tables = {name: _named(rows) for name, rows in analysis.tables.items()}
    rows = tables["differences"]
    tables["differences"] = rows[rows["first"].isin(analysis.algorithms[:1])]
    setting = {name: info.label for name, info in analysis.classes.items()}
    tables["contrasts"]["setting"] = tables["contrasts"].class_name.map(setting)
    tables["improvement"] = tables["offline"]
    tables["offline"] = _beside_the_data(tables["offline"])
    if analysis.streams:
        tables["stream_metrics"] = pd.concat(
            [_of_lives(tables["stream_metrics"]), _of_lives(_references(analysis))]
        )
        rows = _named(analysis.rows("stream_matrices", region=WITHIN))
        tables["stream_matrices"] = rows.assign(phase="phase " + rows.phase.astype(str))
        rows = _named(analysis.rows("stream_visit_metrics", region=WITHIN))
        tables["stream_visit_metrics"] = rows[rows.metric.isin(_BY_VISIT)]
    return tables


def _named(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with the columns of text that follow from their own columns."""
    columns: dict[str, Any] = {}
    if "metric" in rows:
        columns["label"] = rows.metric.map(_LABELS)
    if "first" in rows:
        columns["pair"] = rows["first"] + " − " + rows["second"]
    if "layer" in rows:
        columns["layer"] = rows.layer.map(str).replace("0", "observation")
    if "statistic" in rows:
        columns["statistic"] = rows.statistic.str.replace("_", " ").replace("iqm", "IQM")
    if "learner" in rows:
        columns["nu"] = rows.nu.map("{:g}".format)
    if "visit" in rows:
        columns["policy"] = ("visit " + rows.visit.astype("string")).fillna("initial")
    return rows.assign(**columns)


def _beside_the_data(rows: pd.DataFrame) -> pd.DataFrame:
    """Offline learners, after the constant ½ and the behaviour policy as further learners."""
    data = rows.drop_duplicates(["class_name", "nu"])
    behaviour = data.assign(
        learner="behaviour policy",
        runs=data.data_sets,
        similarity=data.behaviour_similarity,
        similarity_sd=data.behaviour_similarity_sd,
    )
    constant = data.assign(
        learner="constant ½", similarity=data.constant_similarity, similarity_sd=math.nan
    )
    return pd.concat([constant, behaviour, rows])


def _references(analysis: Analysis) -> pd.DataFrame:
    """The reference agents in streams as further algorithms."""
    rows = _named(analysis.tables["stream_references"])
    rows = rows.assign(algorithm=rows.reference.map(LABELS), iqm=rows.value)
    return rows.assign(low=math.nan, high=math.nan, runs=ENOUGH_RUNS)


def _of_lives(rows: pd.DataFrame) -> pd.DataFrame:
    """Metrics in WD and OOD; those of training, which are the same in both, once."""
    of_training = rows.metric.isin(_OF_TRAINING)
    rows = rows[(rows.region == WITHIN) | ((rows.region == OUTSIDE) & ~of_training)]
    return rows.assign(region=rows.region.mask(of_training, ""))


def slug(name: str) -> str:
    """A name with `-` for everything but letters and digits."""
    return "".join(letter if letter.isalnum() else "-" for letter in name.replace(" − ", "-"))

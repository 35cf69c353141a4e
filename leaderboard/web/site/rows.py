"""Rows of the board's tables: what a template shows of an entry, and of a run."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from leaderboard.documents.board import hex_of
from leaderboard.documents.result import Estimate, Metric, Result, RunScore
from leaderboard.documents.submission import Run, Submission
from leaderboard.scoring.ranking import REFERENCES, RankedRow
from leaderboard.store import EntryRow
from leaderboard.web.site import charts

SHORT = 16  # hex digits of an id in an address: too many for a deliberate collision


@dataclass(frozen=True)
class MetricTab:
    """A metric as the pages show it.

    Attributes:
      key: the metric.
      page: file name of its page.
      stem: of the files with the same data.
      symbol, label: its names.
      references: the value of each reference row, by class name in the drawings.
    """

    key: Metric
    page: str
    stem: str
    symbol: str
    label: str
    references: Mapping[str, float]


TABS = (
    MetricTab("wd_regret", "index.html", "board", "N₀", "WD regret N₀", REFERENCES),
    MetricTab("ood_regret", "ood_regret.html", "ood_regret", "N̄", "OOD regret N̄", REFERENCES),
    MetricTab(
        "ood_decay",
        "ood_decay.html",
        "ood_decay",
        "N̄ − N₀",
        "OOD decay N̄ − N₀",
        dict.fromkeys(REFERENCES, 0.0),
    ),
)


@dataclass(frozen=True)
class BoardRow:
    """A row of the board.

    Attributes:
      entry: the entry.
      hex, short: digits of its id, all and some.
      first: its best rank; empty if it is not ranked.
      rank: its ranks as text; empty likewise.
      reason: why it is not ranked, a key of `REASONS`.
      estimate: its score.
      bar, spark: drawings of its score, and of N over the regions.
      code_link: an https link, or None.
    """

    entry: EntryRow
    hex: str
    short: str
    first: int | str
    rank: str
    reason: str
    estimate: Estimate
    bar: Markup
    spark: Markup
    code_link: str | None


def board_rows(ranked: Sequence[RankedRow], tab: MetricTab) -> tuple[list[BoardRow], Markup]:
    """The rows of a ranking, and the axis that their bars share."""
    scores = [row.entry.scores for row in ranked if row.entry.scores]
    estimates: list[Estimate] = [getattr(each, tab.key) for each in scores]
    scale = charts.Scale.covering(
        *(end for each in estimates for end in (each.low, each.high)), *tab.references.values()
    )
    regrets = [[each.value for each in score.normalised_regret] for score in scores]
    spark_scale = charts.Scale.covering(0.0, 1.0, *itertools.chain.from_iterable(regrets))
    lines = charts.reference_lines(scale, tab.references)
    rows = [
        BoardRow(
            entry=row.entry,
            hex=hex_of(row.entry.id),
            short=hex_of(row.entry.id)[:SHORT],
            first=row.first if row.first is not None else "",
            rank=row.ranks,
            reason=row.reason,
            estimate=estimate,
            bar=charts.interval_bar(estimate, scale, lines),
            spark=charts.sparkline(regret, spark_scale),
            code_link=https_only(row.entry.code_link),
        )
        for row, estimate, regret in zip(ranked, estimates, regrets, strict=True)
    ]
    return rows, charts.bar_axis(scale, tab.references)


@dataclass(frozen=True)
class RunRow:
    """A run as submitted and as scored; one of the two may be missing."""

    class_name: str
    spec: str | None
    artefact: str | None
    run: Run | None
    score: RunScore | None


def run_rows(
    submission: Submission, result: Result | None, class_of: Mapping[str, str]
) -> list[RunRow]:
    """The submitted runs with their scores, then the runs that were started and not listed.

    A result lists the runs in the order of the submission.

    Args:
      submission: the submission.
      result: None before scoring.
      class_of: class name by the digest of an instance.
    """
    rows = []
    for run, score in itertools.zip_longest(submission.runs, result.runs if result else ()):
        if run is None:
            rows.append(RunRow(score.class_name, None, None, None, score))
            continue
        artefact = run.artefact.sha256 if run.artefact is not None else None
        name = class_of.get(run.spec, "not in this suite")
        rows.append(RunRow(name, run.spec, artefact, run, score))
    return rows


def https_only(link: str | None) -> str | None:
    """The link if it is https: no other scheme reaches an attribute."""
    return link if link is not None and link.startswith("https://") else None


def steps_text(steps: int) -> str:
    """Environment steps with a unit: `500 k`, `1.2 M`."""
    for size, unit in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= size:
            return f"{float(f'{steps / size:.3g}'):g} {unit}"
    return str(steps)

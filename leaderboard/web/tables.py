"""What the board's tables show, on pages, in files and in a terminal; and the pages' drawings.

Drawings are inline SVG without styles, so that the pages can forbid inline styles. Their colours
come from `board.css`, for light, dark and print. All text is escaped.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from leaderboard.documents.board import BoardDocument, hex_of
from leaderboard.documents.result import (
    METRICS,
    RANKED,
    EntryRow,
    Estimate,
    Metric,
    Result,
    RunScore,
)
from leaderboard.documents.submission import Submission, skeleton
from leaderboard.scoring.ranking import RankedRow, class_mean, groups_of, never_listed
from sme_registry import SMESpec
from sme_registry.io import visible
from sme_registry.io.markup import escape_latex
from sme_registry.io.terminal import fixed
from sme_registry.spec import Setting

_INSTANCES = 100  # of a class, on the page of the suite
SHORT = 16  # hex digits of an id in an address: too many for a deliberate collision


def task_rows(document: BoardDocument) -> list[dict[str, Any]]:
    """The classes of a board's suite, with the runs that a rank needs, and the first instances."""
    return [
        {
            "name": member.name,
            "setting": setting_text(member.setting),
            "runs": len(member.seeds) * document.runs_on_each(len(member.seeds)),
            "instances": [(spec.seed, spec.digest) for spec in member.instances[:_INSTANCES]],
            "more": max(len(member.seeds) - _INSTANCES, 0),
        }
        for member in document.suite.classes
    ]


def setting_text(setting: Setting) -> str:
    """The fields of a setting that differ from a spec's defaults."""
    defaults = SMESpec().to_dict()
    fields = setting.to_dict().items()
    changed = [f"{k}={json.dumps(v)}" for k, v in fields if v != defaults.get(k)]
    return ", ".join(changed) or "the defaults"


def versions_of(entry: EntryRow, entries: list[EntryRow]) -> list[EntryRow]:
    """Other submissions of an entry's key with its method or its policies, the newest first."""
    if entry.reference:
        return []
    method = skeleton(entry.method)
    return [
        other
        for other in reversed(entries)
        if other.key == entry.key
        and other.id != entry.id
        and (skeleton(other.method) == method or other.origin == entry.origin)
    ]


@dataclass(frozen=True)
class AgentRow:
    """One agent of a class of teams, over the runs of the class as for its score."""

    class_name: str
    agent: str
    ood_regret: float
    normalised_regret: Sequence[float]  # of each region, WD first


def agent_rows(board: BoardDocument, submission: Submission, result: Result) -> list[AgentRow]:
    """The agents of each class of teams; a run without a policy counts as 1 for each of them."""
    runs = result.runs
    if not any(run.agents for run in runs):
        return []
    rows = []
    for name, members in groups_of(board, [*runs, *never_listed(board, submission)]).items():
        agents = next((run.agents for run in runs if run.agents and run.class_name == name), ())
        for index, agent in enumerate(agents):

            def regrets(run: RunScore, index: int = index) -> list[float]:
                own = run.agents[index].normalised_regret if run.agents else run.normalised_regret
                return [*own, sum(own[1:]) / len(own[1:])]

            *means, ood = class_mean(members, regrets).tolist()
            rows.append(AgentRow(name, agent.name, ood, means))
    return rows


def https_only(link: str | None) -> str | None:
    """The link if it is https: no other scheme reaches an attribute."""
    return link if link is not None and link.startswith("https://") else None


def day(time: str) -> str:
    """The date of a time of the log: `2026-11-21`."""
    return time[:10]


def minute(time: str) -> str:
    """Date and time of a time of the log, in UTC: `2026-11-21 09:30`."""
    return f"{time[:10]} {time[11:16]}"


def short(digest: str, digits: int = 12) -> str:
    return hex_of(digest)[:digits]


def steps_text(steps: int) -> str:
    """Environment steps with a unit: `500 k`, `1.2 M`."""
    for size, unit in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= size:
            return f"{float(f'{steps / size:.3g}'):g} {unit}"
    return str(steps)


_ENTRY_FIELDS = ("method", "version", "family", "knowledge", "submitter", "key")
_RECORD_FIELDS = ("runs", "steps", "steps_per_run", "oracle_like", "received", "id")
_FORMULA_STARTS = tuple("=+-@＝＋－＠|%")
_LATEX_HEAD = (
    r"\begin{tabular}{rllrrlrrr}",
    r"\toprule",
    "Rank & Method & By & Runs & Steps per run & Received & "
    + " & ".join(metric.latex for metric in RANKED.values())
    + r" \\",
    r"\midrule",
)


@dataclass(frozen=True)
class RankingFile:
    """A ranking as a file; each repeats from which board and log entry it comes."""

    rows: list[RankedRow]
    metric: Metric
    board: BoardDocument
    head: tuple[int, str]  # number and digest of the log's last entry
    date: str  # UTC, as documents write it

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return {
            "title": self.board.title,
            **self._provenance(),
            "metric": self.metric,
            "rows": [row_facts(row) for row in self.rows],
        }

    def to_csv(self) -> str:
        stream = io.StringIO()
        # Text is always quoted, so that a spreadsheet that splits at semicolons keeps it in a cell.
        writer = csv.writer(stream, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\r\n")
        for index, row in enumerate(self.rows):
            scores = row.entry.scores
            assert scores is not None  # every row of a ranking has scores
            estimates = {name: getattr(scores, name) for name in METRICS}
            estimates |= {
                f"normalised_regret_{m}": N for m, N in enumerate(scores.normalised_regret)
            }
            cells = {**_facts(row), "ranked_by": self.metric}
            for column, estimate in estimates.items():
                cells[column] = estimate.value
                cells[f"{column}_low"], cells[f"{column}_high"] = estimate.low, estimate.high
            cells |= self._provenance()
            if index == 0:
                writer.writerow(cells)
            writer.writerow(map(_csv_cell, cells.values()))
        return stream.getvalue()

    def to_latex(self) -> str:
        """A `tabular` (package booktabs), its provenance in comments above."""
        lines = [f"% {name}: {_latex(str(value))}" for name, value in self._provenance().items()]
        lines += [
            f"% ranked by {self.metric}; regrets: 0 optimal, 1 the constant policy; 95 % intervals",
            *_LATEX_HEAD,
        ]
        for row in self.rows:
            entry, scores = row.entry, row.entry.scores
            rank = row.ranks.replace("–", "--") or "--"
            cells = [rank, _latex(f"{entry.method} {entry.version}"), _latex(entry.submitter)]
            cells += [str(entry.runs), f"{entry.steps_per_run:,}", entry.received[:10]]
            shown = {name: getattr(scores, name) for name in RANKED}
            cells += map(_interval, (shown | {self.metric: row.shown(self.metric)}).values())
            lines.append(" & ".join(cells) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}"]
        return "\n".join(lines) + "\n"

    def _provenance(self) -> dict[str, Any]:
        board = self.board
        return {
            "suite": board.suite_name,
            "suite_digest": board.suite.digest,
            "protocol": board.protocol_name,
            "protocol_digest": board.protocol.digest,
            "runs_to_rank": board.runs_to_rank,
            "log_sequence": self.head[0],
            "log_digest": self.head[1],
            "date": self.date,
        }


def row_facts(row: RankedRow) -> dict[str, Any]:
    """A row of a ranking of any track as plain data, for JSON."""
    return {**_facts(row), "scores": row.entry.scores and row.entry.scores.to_dict()}


def _facts(row: RankedRow) -> dict[str, Any]:
    return {
        "first": row.first,
        "last": row.last,
        "not_ranked": row.reason,
        "rank_value": row.value.value,
        **{name: getattr(row.entry, name) for name in _ENTRY_FIELDS},
        "code": row.entry.code_link or "",
        **{name: getattr(row.entry, name) for name in _RECORD_FIELDS},
        "copied_runs": row.entry.copied_runs,
        "copy_of": row.entry.copy_of[0].id if row.entry.copy_of else "",
    }


def _csv_cell(cell: Any) -> Any:
    """A cell that no spreadsheet runs as a formula; numbers stay numbers."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(cell).lower()
    if not isinstance(cell, str):
        return cell
    text = _one_line(cell)
    return f"'{text}" if text.startswith(_FORMULA_STARTS) else text


def _latex(text: str) -> str:
    return escape_latex(_one_line(text))


def _one_line(text: str) -> str:
    return visible(" ".join(text.split()))


def _interval(estimate: Estimate) -> str:
    value = f"${fixed(estimate.value)}$"
    if estimate.interval is None:
        return value
    low, high = estimate.interval
    return f"{value} [${fixed(low)}$, ${fixed(high)}$]"


Edges = Sequence[tuple[float, float]]

_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_MARGIN = 3.0  # % of a bar's width at either end, for a dot at the end
_SPARK_WIDTH, _SPARK_HEIGHT = 84.0, 30.0
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 720.0, 360.0, 60.0, 708.0, 22.0, 296.0
_MAX_LABELS = 12  # region labels below a chart


def number(value: float, digits: int = 3) -> str:
    """A number as in every table, with a true minus sign."""
    return fixed(value, digits).replace("-", "\u2212")


@dataclass(frozen=True)
class Scale:
    """An axis."""

    low: float
    high: float  # more than `low`
    ticks: tuple[float, ...]  # round numbers from end to end

    @classmethod
    def covering(cls, *values: float) -> Scale:
        """The scale of about four round steps that covers the values."""
        low, high = min(values, default=0.0), max(values, default=1.0)
        high = high if high - low > 1e-9 else low + 1.0
        raw = (high - low) / 4
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(factor * power for factor in _STEPS if factor * power >= raw * (1 - 1e-9))
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        ticks = tuple(round(index * step, 12) + 0.0 for index in range(first, last + 1))
        return cls(ticks[0], ticks[-1], ticks)

    def part(self, value: float) -> float:
        """The position of a value along the axis, in [0, 1]."""
        return (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)


class Bars:
    """The bars of a table on one scale, which the next cell has as numbers for screen readers."""

    def __init__(self, estimates: Sequence[Estimate], references: Mapping[str, float]) -> None:
        ends = (end for each in estimates for end in each.ends)
        self._scale = Scale.covering(*ends, *references.values())
        self._references = references
        self._lines = "".join(
            f'<line class="{escape(name)}" x1="{at}" x2="{at}" y1="0" y2="100%"/>'
            for name, at in zip(references, map(self._at, references.values()), strict=True)
        )

    def bar(self, estimate: Estimate) -> Markup:
        """A 95 % interval as a bar with a dot at its value, visible even without width."""
        low, high, value = map(self._at, (*estimate.ends, estimate.value))
        return Markup(
            f'<svg class="bar" aria-hidden="true" focusable="false">{self._lines}'
            f'<line class="ci" x1="{low}" x2="{high}" y1="50%" y2="50%"/>'
            f'<circle class="dot" cx="{value}" cy="50%" r="4"/></svg>'
        )

    def axis(self) -> Markup:
        """The axis above the bars, with the names of the reference lines."""
        ticks = self._scale.ticks
        parts = [
            f'<text x="{self._at(tick)}" y="30">{_short(tick)}</text>'
            for tick in ticks[:: 1 + len(ticks) // 4]
        ]
        names: dict[float, list[str]] = {}
        for name, value in self._references.items():
            names.setdefault(value, []).append(name)
        parts += [
            f'<text class="name {_anchor(self._scale.part(value))}" x="{self._at(value)}" y="12">'
            f"{escape(', '.join(group))}</text>"
            for value, group in names.items()
        ]
        return Markup(
            f'<svg class="axis" aria-hidden="true" focusable="false">{"".join(parts)}</svg>'
        )

    def _at(self, value: float) -> str:
        return f"{_MARGIN + (100 - 2 * _MARGIN) * self._scale.part(value):.2f}%"


def sparklines(regrets: Sequence[Sequence[float]], label: str = "From WD outward") -> list[Markup]:
    """Small curves on one scale: of N_m over the regions, WD first, or as the label says."""
    scale = Scale.covering(0.0, 1.0, *itertools.chain.from_iterable(regrets))
    return [_sparkline(regret, scale, label) for regret in regrets]


def _sparkline(regret: Sequence[float], scale: Scale, label: str) -> Markup:
    height = _SPARK_HEIGHT - 6
    step = (_SPARK_WIDTH - 6) / max(1, len(regret) - 1)
    optimal, constant, *ys = [
        f"{_SPARK_HEIGHT - 3 - height * scale.part(value):.1f}" for value in (0.0, 1.0, *regret)
    ]
    points = " ".join(f"{3 + step * index:.1f},{y}" for index, y in enumerate(ys))
    text = ", ".join(number(value, 2) for value in regret)
    return Markup(
        f'<svg class="spark" viewBox="0 0 {_SPARK_WIDTH:.0f} {_SPARK_HEIGHT:.0f}" role="img" '
        f'aria-label="{label}: {text}">'
        f'<path class="optimal" d="M0 {optimal}H{_SPARK_WIDTH:.0f}"/>'
        f'<path class="constant" d="M0 {constant}H{_SPARK_WIDTH:.0f}"/>'
        f'<polyline points="{points}"/>'
        f'<circle cx="3" cy="{ys[0]}" r="2.5"/></svg>'
    )


def region_labels(edges: Edges) -> list[str]:
    """The regions on an axis: `WD`, `0–0.2`, …"""
    return ["WD" if index == 0 else f"{low:g}–{high:g}" for index, (low, high) in enumerate(edges)]


def regret_chart(regret: Sequence[Estimate], edges: Edges, name: str) -> Markup:
    """Normalised regret of an entry over the regions, WD first, with intervals."""
    axes = _Axes.covering(regret, edges)
    points = [
        (f"{axes.x(index):.1f}", *(f"{axes.y(y):.1f}" for y in (e.ends[0], e.value, e.ends[1])))
        for index, e in enumerate(regret)
    ]
    band = [f"{x},{high}" for x, _, _, high in points]
    band += [f"{x},{low}" for x, low, _, _ in reversed(points)]
    line = [f"{x},{y}" for x, _, y, _ in points]
    known = all(e.interval for e in regret)  # not where each class has a single run
    marks = "".join(
        (f'<path class="whisker" d="M{x} {low}V{high}m-5 0h10M{x} {low}m-5 0h10"/>' * known)
        + f'<circle class="dot" cx="{x}" cy="{y}" r="4.5"/>'
        for x, low, y, high in points
    )
    curve = (
        f'<polygon class="band" points="{" ".join(band)}"/>' * known
        + f'<polyline class="line" points="{" ".join(line)}"/>{marks}'
    )
    values = "; ".join(
        f"{label}: {number(e.value)}"
        + (f", from {number(e.ends[0])} to {number(e.ends[1])}" if e.interval else "")
        for label, e in zip(region_labels(edges), regret, strict=True)
    )
    title = f"Normalised regret of {name} by region"
    return axes.chart(title, f"{values}. 0 is the optimal policy, 1 the constant one.", curve)


def comparison_chart(regret: Sequence[Estimate], edges: Edges) -> Markup:
    """The axes of the comparison, which cover all entries and any choice of `board.js`."""
    return _Axes.covering(regret, edges).chart("Normalised regret by region", "", "")


@dataclass(frozen=True)
class _Axes:
    """The axes of a chart of normalised regret over the regions."""

    scale: Scale
    regions: tuple[str, ...]

    @classmethod
    def covering(cls, regret: Sequence[Estimate], edges: Edges) -> _Axes:
        scale = Scale.covering(0.0, 1.0, *(end for e in regret for end in e.ends))
        return cls(scale, tuple(region_labels(edges)))

    @property
    def step(self) -> float:
        return (_RIGHT - _LEFT) / len(self.regions)

    def x(self, region: int) -> float:
        return _LEFT + self.step * (region + 0.5)

    def y(self, value: float) -> float:
        return _BOTTOM - (_BOTTOM - _TOP) * self.scale.part(value)

    def chart(self, title: str, description: str, curve: str) -> Markup:
        """The axes and a curve, as SVG. Its data attributes let a script draw on the same axes."""
        return Markup(
            f'<svg class="profile" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" '
            'aria-labelledby="chart-title chart-desc" '
            f'data-left="{_LEFT:.0f}" data-step="{self.step:.3f}" '
            f'data-zero="{self.y(0.0):.3f}" data-one="{self.y(1.0):.3f}">'
            f'<title id="chart-title">{escape(title)}</title>'
            f'<desc id="chart-desc">{escape(description)}</desc>{self._ticks()}{curve}</svg>'
        )

    def _ticks(self) -> str:
        parts = [
            f'<path class="grid" d="M{_LEFT:.0f} {self.y(tick):.1f}H{_RIGHT:.0f}"/>'
            f'<text class="tick end" x="{_LEFT - 8:.0f}" y="{self.y(tick) + 4:.1f}">'
            f"{_short(tick)}</text>"
            for tick in self.scale.ticks
        ]
        parts += [
            f'<path class="{name}" d="M{_LEFT:.0f} {self.y(value):.1f}H{_RIGHT:.0f}"/>'
            f'<text class="tick label" x="{_RIGHT:.0f}" y="{self.y(value) - 6:.1f}">{label}</text>'
            for name, value, label in (("optimal", 0.0, "optimal"), ("constant", 1.0, "constant ½"))
        ]
        every = 1 + (len(self.regions) - 1) // _MAX_LABELS
        parts += [
            f'<text class="tick middle" x="{self.x(index):.1f}" y="{_BOTTOM + 24:.0f}">'
            f"{label}</text>"
            for index, label in enumerate(self.regions)
            if index % every == 0
        ]
        return "".join(parts) + (
            f'<text class="tick middle" x="{(_LEFT + _RIGHT) / 2:.0f}" y="{_HEIGHT - 10:.0f}">'
            "expansion ε beyond the training cube</text>"
        )


def _anchor(part: float) -> str:
    return "start" if part < 0.2 else "end" if part > 0.8 else "middle"


def _short(value: float) -> str:
    return f"{value:g}".replace("-", "\u2212")

"""A ranking as JSON, CSV or LaTeX. Each file names its suite, protocol, log entry and date.

Text from submitters is made harmless: a cell that a spreadsheet would run as a formula begins with
an apostrophe, and LaTeX commands are escaped.
"""

from __future__ import annotations

import csv
import io
from typing import Any, get_args

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import METRICS, Estimate, Metric
from leaderboard.documents.submission import now
from leaderboard.scoring.ranking import RankedRow
from sme_registry.io import to_json as plain_to_json
from sme_registry.io import visible
from sme_registry.io.markup import escape_latex
from sme_registry.io.terminal import fixed

Rows = list[RankedRow]
Head = tuple[int, str]

_METHOD_FIELDS = ("method", "version", "family", "knowledge", "submitter", "key")
_RECORD_FIELDS = ("runs", "steps", "steps_per_run", "oracle_like", "received", "id")
_RANKED: tuple[Metric, ...] = get_args(Metric)
_FORMULA_STARTS = tuple("=+-@＝＋－＠|%")


def to_dict(
    rows: Rows, metric: Metric, board: BoardDocument, head: Head, date: str | None = None
) -> dict[str, Any]:
    """A ranking as plain data.

    Args:
      rows: from `ranking`.
      metric: by which they are ranked.
      board: the board.
      head: number and digest of the log's last entry.
      date: UTC time as documents write it; None for now.
    """
    return {
        "title": board.title,
        **_provenance(board, head, date),
        "metric": metric,
        "rows": [
            {**_facts(row), "scores": row.entry.scores and row.entry.scores.to_dict()}
            for row in rows
        ],
    }


def to_json(
    rows: Rows, metric: Metric, board: BoardDocument, head: Head, date: str | None = None
) -> str:
    """A ranking as JSON. Arguments: see `to_dict`."""
    return plain_to_json(to_dict(rows, metric, board, head, date))


def to_csv(
    rows: Rows, metric: Metric, board: BoardDocument, head: Head, date: str | None = None
) -> str:
    """A ranking as CSV: a header, then one line per entry; the last cells repeat the provenance.

    Arguments: see `to_dict`.
    """
    regions = range(len(board.protocol.edges))
    columns = [*METRICS, *(f"normalised_regret_{region}" for region in regions)]
    stream = io.StringIO()
    # Text is always quoted, so that a spreadsheet that splits at semicolons keeps it in one cell.
    writer = csv.writer(stream, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\r\n")
    for index, row in enumerate(rows):
        scores = row.entry.scores
        assert scores is not None  # every row of a ranking has scores
        estimates = [getattr(scores, name) for name in METRICS] + list(scores.normalised_regret)
        cells = {**_facts(row), "ranked_by": metric}
        for column, estimate in zip(columns, estimates, strict=True):
            cells[column] = estimate.value
            cells[f"{column}_low"], cells[f"{column}_high"] = estimate.low, estimate.high
        cells |= _provenance(board, head, date)
        if index == 0:
            writer.writerow(cells)
        writer.writerow(map(_csv_cell, cells.values()))
    return stream.getvalue()


def to_latex(
    rows: Rows, metric: Metric, board: BoardDocument, head: Head, date: str | None = None
) -> str:
    """A ranking as a LaTeX `tabular` (package booktabs), its provenance in comments above.

    Arguments: see `to_dict`.
    """
    provenance = _provenance(board, head, date)
    lines = [f"% {name}: {_latex(str(value))}" for name, value in provenance.items()]
    lines += [
        f"% ranked by {metric}; regrets: 0 optimal, 1 the constant policy; 95 % intervals",
        r"\begin{tabular}{rllrrlrrr}",
        r"\toprule",
        r"Rank & Method & By & Runs & Steps per run & Received & WD regret $N_0$ "
        r"& OOD regret $\bar{N}$ & OOD decay $\bar{N} - N_0$ \\",
        r"\midrule",
    ]
    for row in rows:
        entry, scores = row.entry, row.entry.scores
        assert scores is not None  # every row of a ranking has scores
        rank = row.ranks.replace("–", "--") or "--"
        cells = [rank, _latex(f"{entry.method} {entry.version}"), _latex(entry.submitter)]
        cells += [str(entry.runs), f"{entry.steps_per_run:,}", entry.received[:10]]
        shown = {name: getattr(scores, name) for name in _RANKED} | {metric: row.shown(metric)}
        cells += map(_interval, shown.values())
        lines.append(" & ".join(cells) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _provenance(board: BoardDocument, head: Head, date: str | None) -> dict[str, Any]:
    return {
        "suite": board.suite_name,
        "suite_digest": board.suite.digest,
        "protocol": board.protocol_name,
        "protocol_digest": board.protocol.digest,
        "runs_to_rank": board.runs_to_rank,
        "log_sequence": head[0],
        "log_digest": head[1],
        "date": date or now(),
    }


def _facts(row: RankedRow) -> dict[str, Any]:
    return {
        "first": row.first,
        "last": row.last,
        "not_ranked": row.reason,
        "rank_value": row.value.value,
        **{name: getattr(row.entry, name) for name in _METHOD_FIELDS},
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

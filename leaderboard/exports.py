"""A ranking as JSON, CSV or LaTeX. Each file says what it is of: suite, protocol, log and date.

What submitters wrote is made harmless: a cell of text that a spreadsheet would take for a formula
begins with an apostrophe, and what LaTeX would take for a command is shown as it was written.
"""

from __future__ import annotations

import csv
import io
from typing import Any

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import METRICS, Estimate
from leaderboard.documents.submission import now
from leaderboard.scoring.ranking import Metric, RankedRow
from sme_registry.io import to_json as plain_to_json
from sme_registry.terminal import fixed

Head = tuple[int, str]

_FORMULA_STARTS = tuple("=+-@＝＋－＠|%")
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
}


def to_json(
    rows: list[RankedRow],
    metric: Metric,
    board: BoardDocument,
    head: Head,
    date: str | None = None,
) -> str:
    """A ranking as JSON.

    Args:
      rows: of `ranking`.
      metric: by which they were ranked.
      board: whose they are.
      head: number and digest of the log's last entry.
      date: as documents write it; None for now.

    Returns:
      The file's text.
    """
    return plain_to_json(
        {
            "title": board.title,
            **_of(board, head, date),
            "metric": metric,
            "rows": [
                {
                    **_facts(row),
                    "scores": row.entry.scores and row.entry.scores.to_dict(),
                }
                for row in rows
            ],
        }
    )


def to_csv(
    rows: list[RankedRow],
    metric: Metric,
    board: BoardDocument,
    head: Head,
    date: str | None = None,
) -> str:
    """A ranking as CSV: one line of names, one line each; what it is of, in each line's last cells.

    Arguments as of `to_json`.
    """
    regions = range(len(board.protocol.edges))
    columns = [*METRICS, *(f"normalised_regret_{region}" for region in regions)]
    stream = io.StringIO()
    # Text always in quotes: where a spreadsheet splits at semicolons, too, it stays one cell.
    writer = csv.writer(stream, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\r\n")
    for index, row in enumerate(rows):
        scores = row.entry.scores
        assert scores is not None  # whatever is in a ranking has some
        estimates = [getattr(scores, name) for name in METRICS] + list(scores.normalised_regret)
        cells: dict[str, Any] = {**_facts(row), "ranked_by": metric}
        for column, estimate in zip(columns, estimates, strict=True):
            cells |= {
                column: estimate.value,
                f"{column}_low": estimate.low,
                f"{column}_high": estimate.high,
            }
        cells |= _of(board, head, date)
        if index == 0:
            writer.writerow(cells)
        writer.writerow(map(_harmless, cells.values()))
    return stream.getvalue()


def to_latex(
    rows: list[RankedRow],
    metric: Metric,
    board: BoardDocument,
    head: Head,
    date: str | None = None,
) -> str:
    """A ranking as a `tabular` for the package booktabs; what it is of, in comments above it.

    Arguments as of `to_json`.
    """
    lines = [f"% {name}: {_latex(str(value))}" for name, value in _of(board, head, date).items()]
    lines += [
        f"% ranked by {metric}; regrets: 0 optimal, 1 the constant policy; 95 % intervals",
        r"\begin{tabular}{rllrrr}",
        r"\toprule",
        r"Rank & Method & By & WD regret $N_0$ & OOD regret $\bar{N}$ "
        r"& OOD decay $\bar{N} - N_0$ \\",
        r"\midrule",
    ]
    for row in rows:
        entry, scores = row.entry, row.entry.scores
        assert scores is not None  # whatever is in a ranking has some
        rank = "--" if row.first is None else str(row.first)
        if row.first != row.last:
            rank += f"--{row.last}"
        cells = [rank, _latex(f"{entry.method} {entry.version}"), _latex(entry.submitter)]
        cells += [
            _interval(estimate)
            for estimate in (scores.wd_regret, scores.ood_regret, scores.ood_decay)
        ]
        lines.append(" & ".join(cells) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _of(board: BoardDocument, head: Head, date: str | None) -> dict[str, Any]:
    """What a file is of."""
    return {
        "suite": board.suite_name,
        "suite_digest": board.suite.digest,
        "protocol": board.protocol_name,
        "protocol_digest": board.protocol.digest,
        "log_sequence": head[0],
        "log_digest": head[1],
        "date": date or now(),
    }


def _facts(row: RankedRow) -> dict[str, Any]:
    entry = row.entry
    return {
        "first": row.first,
        "last": row.last,
        "not_ranked": row.reason,
        "method": entry.method,
        "version": entry.version,
        "family": entry.family,
        "knowledge": entry.knowledge,
        "submitter": entry.submitter,
        "key": entry.key,
        "code": entry.code_link or "",
        "runs": entry.runs,
        "steps": entry.steps,
        "oracle_like": entry.oracle_like,
        "received": entry.received,
        "id": entry.id,
    }


def _harmless(cell: Any) -> Any:
    """A cell that no spreadsheet takes for a formula; numbers stay numbers."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(cell).lower()
    if not isinstance(cell, str):
        return cell
    text = one_line(cell)
    return f"'{text}" if text.startswith(_FORMULA_STARTS) else text


def _latex(text: str) -> str:
    """Text that LaTeX shows as it was written, on one line."""
    return "".join(_LATEX.get(letter, letter) for letter in one_line(text))


def one_line(text: str) -> str:
    """Text without line ends, and without what is not seen but turns others' direction."""
    return "".join(letter for letter in " ".join(text.split()) if letter.isprintable())


def _interval(estimate: Estimate) -> str:
    return f"${fixed(estimate.value)}$ [${fixed(estimate.low)}$, ${fixed(estimate.high)}$]"

"""What the board's tables show, on pages, in files and in a terminal."""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from leaderboard.documents.board import BoardDocument, hex_of
from leaderboard.documents.result import (
    METRICS,
    RANKED,
    Estimate,
    Metric,
    Result,
    RunScore,
)
from leaderboard.documents.signed import Receiver, Signed
from leaderboard.documents.submission import Run, Submission, Withdrawal, skeleton
from leaderboard.errors import NotPublishable
from leaderboard.scoring import ranking
from leaderboard.scoring.aggregation import class_mean, groups_of, never_listed
from leaderboard.scoring.ranking import RankedRow
from leaderboard.store import EntryRow, Store
from sme_registry import SMESpec
from sme_registry.errors import SpecError
from sme_registry.io import visible
from sme_registry.io.markup import escape_latex
from sme_registry.io.terminal import fixed
from sme_registry.spec import Setting

_INSTANCES = 100  # of a class, on the page of the suite
SHORT = 16  # hex digits of an id in an address: too many for a deliberate collision


MARKS = {
    "reference": "reference row",
    "too_few_runs": "too few runs",
    "copy": "copy",
    "superseded": "superseded",
    "not_learned": "not learned",
}
"""Short names of the reasons in `ranking.REASONS`."""


@dataclass(frozen=True)
class TaskRow:
    """A class of the suite."""

    name: str
    setting: str  # the fields that differ from a spec's defaults
    runs: int  # that a rank needs
    instances: list[tuple[int | str, str]]  # seed and digest of the first ones
    more: int  # instances that are not listed


def task_rows(document: BoardDocument) -> list[TaskRow]:
    """The classes of a board's suite."""
    rows = []
    for member in document.suite.classes:
        count, listed = len(member.seeds), member.instances[:_INSTANCES]
        rows.append(
            TaskRow(
                name=member.name,
                setting=setting_text(member.setting),
                runs=count * document.runs_on_each(count),
                instances=[(spec.seed, spec.digest) for spec in listed],
                more=count - len(listed),
            )
        )
    return rows


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


def run_rows(
    submission: Submission, result: Result | None, class_of: Mapping[str, str]
) -> list[tuple[str, Run | None, RunScore | None]]:
    """Class name, run and score of the submitted runs, then of those started and not listed.

    A result, None before scoring, lists the runs in the order of the submission. `class_of` has
    the class name by the digest of an instance.
    """
    pairs = itertools.zip_longest(submission.runs, result.runs if result else ())
    return [
        (class_of.get(run.spec, "not in this suite") if run else score.class_name, run, score)
        for run, score in pairs
    ]


@dataclass(frozen=True)
class AgentRow:
    """One agent of a class of teams, over the runs of the class as for its score."""

    class_name: str
    agent: str
    wd_regret: float
    ood_regret: float
    normalised_regret: tuple[float, ...]  # of each region, WD first


def agent_rows(board: BoardDocument, submission: Submission, result: Result) -> list[AgentRow]:
    """The agents of each class of teams; a run without a policy counts as 1 for each of them."""
    listed = result.runs[: len(submission.runs)]
    if not any(run.agents for run in listed):
        return []
    rows = []
    for name, members in groups_of(board, [*listed, *never_listed(board, submission)]).items():
        agents = next((run.agents for run in listed if run.agents and run.class_name == name), ())
        for index, agent in enumerate(agents):

            def regrets(run: RunScore, index: int = index) -> list[float]:
                own = run.agents[index].normalised_regret if run.agents else run.normalised_regret
                return [*own, sum(own[1:]) / len(own[1:])]

            *means, ood = class_mean(members, regrets).tolist()
            rows.append(AgentRow(name, agent.name, means[0], ood, tuple(means)))
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
        """A header, then one line per entry; the last cells repeat the provenance."""
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


_TEXTS = ("id", "status", "received", "withheld", "not_ranked", "fault")
_NUMBERS = ("place", "queue", "faults")


@dataclass(frozen=True)
class PublicView:
    """What the board publishes about one submission."""

    id: str
    status: str
    received: str
    signed: Signed[Submission]
    result: Result | None  # None before scoring, and while its scores are withheld
    withheld: str  # why the scores are withheld; empty if they are not
    withdrawal: Signed[Withdrawal] | None
    not_ranked: str = ""  # by any metric, a key of `ranking.REASONS`; empty without scores
    copy_of: tuple[tuple[str, int], ...] = ()  # of other keys: ids, and the number of runs alike
    place: int = 0  # in the queue, from 1; 0 if it does not wait
    queue: int = 0  # how many wait, if it does
    faults: int = 0  # of the board's machine, which ended its scoring while it waits
    fault: str = ""  # the last of them

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> PublicView:
        """The view that `to_dict` wrote, here or in an earlier version of a served board."""
        try:
            result, withdrawal = plain["result"], plain["withdrawal"]
            signed = {name: plain[name] for name in ("submission", "signature")}
            signed |= {name: plain.get(name) for name in Receiver._fields}  # absent in older ones
            values: dict[str, Any] = {name: str(plain.get(name, "")) for name in _TEXTS}
            values |= {name: int(plain.get(name, 0)) for name in _NUMBERS}
            view = cls(
                **values,
                signed=Signed[Submission].from_dict(signed),
                result=None if result is None else Result.from_dict(result),
                withdrawal=None if withdrawal is None else Signed[Withdrawal].from_dict(withdrawal),
                copy_of=tuple((str(x["id"]), int(x["runs"])) for x in plain.get("copy_of", ())),
            )
        except SpecError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SpecError(f"submission: invalid answer: {error!r:.200}. Check the URL.") from None
        if view.signed.id != view.id:
            raise SpecError(
                f"id={view.id!r:.80}: the submission has another digest. Check the URL."
            )
        return view

    def to_dict(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in (*_TEXTS, *_NUMBERS)},
            **self.signed.to_dict(),
            "result": self.result and self.result.to_dict(),
            "withdrawal": self.withdrawal and self.withdrawal.to_dict(),
            "copy_of": [{"id": id, "runs": runs} for id, runs in self.copy_of],
        }


def public_view(store: Store, entry: EntryRow) -> PublicView:
    """The public view of a submission; it has scores only while the board is publishable."""
    result, entries = store.result(entry.id), store.entries()
    queue = store.queue.places()
    withheld, reason = "", ""
    if result is not None and result.scores is not None:
        try:
            ranking.refuse_unpublishable(entries)
            rows = ranking.ranking(entries, "wd_regret")
            reason = next((row.reason for row in rows if row.entry.id == entry.id), "")
        except NotPublishable as error:
            result, withheld = None, str(error)
    return PublicView(
        id=entry.id,
        status=entry.status,
        received=entry.received,
        signed=store.submission(entry.id),
        result=result,
        withheld=withheld,
        withdrawal=store.withdrawal(entry.id),
        not_ranked=reason,
        copy_of=() if withheld else tuple((each.id, each.runs) for each in entry.copy_of),
        place=queue.get(entry.id, 0),
        queue=len(queue) if entry.id in queue else 0,
        faults=entry.faults,
        fault=entry.fault,
    )

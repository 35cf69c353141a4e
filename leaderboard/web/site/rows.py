"""What the board's tables show: the metrics, and the runs of a submission."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.checks import skeleton
from leaderboard.documents.result import Metric, Result, RunScore
from leaderboard.documents.submission import Run, Submission
from leaderboard.scoring.aggregation import class_mean, groups_of, never_listed
from leaderboard.scoring.ranking import REFERENCES
from leaderboard.store import EntryRow
from sme_registry import SMESpec
from sme_registry.spec import Setting

_INSTANCES = 100  # of a class, on the page of the suite
SHORT = 16  # hex digits of an id in an address: too many for a deliberate collision


@dataclass(frozen=True)
class MetricTab:
    """A metric as the pages show it."""

    key: Metric
    page: str
    stem: str  # of the files with the same data
    symbol: str
    label: str
    references: Mapping[str, float]  # the value of each reference row


_NO_DECAY = dict.fromkeys(REFERENCES, 0.0)
TABS = (
    MetricTab("wd_regret", "index.html", "board", "N₀", "WD regret N₀", REFERENCES),
    MetricTab("ood_regret", "ood_regret.html", "ood_regret", "N̄", "OOD regret N̄", REFERENCES),
    MetricTab("ood_decay", "ood_decay.html", "ood_decay", "N̄ − N₀", "OOD decay N̄ − N₀", _NO_DECAY),
)

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
    """A class of the suite, as the page of the suite shows it."""

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


RunRow = tuple[str, Run | None, RunScore | None]
"""Class name, the run as submitted, and as scored."""


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
) -> list[RunRow]:
    """The submitted runs with their scores, then the runs that were started and not listed.

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


def steps_text(steps: int) -> str:
    """Environment steps with a unit: `500 k`, `1.2 M`."""
    for size, unit in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= size:
            return f"{float(f'{steps / size:.3g}'):g} {unit}"
    return str(steps)

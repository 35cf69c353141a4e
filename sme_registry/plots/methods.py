"""What figures of evaluation reports draw: a line or a bar for each report, or for each method."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport
from sme_registry.spec import catalogue

Report = EvaluationReport | str | os.PathLike[str]
Reports = Report | Sequence[Report] | Mapping[str, Report | Sequence[Report]]

_EVALUATION = "evaluation.json"


class Method(NamedTuple):
    """One line or bar: a report, or the reports of a method's runs."""

    label: str
    reports: list[EvaluationReport]


def methods_of(reports: Reports) -> list[Method]:
    """The lines to draw; those of equal labels on different tasks are told apart by their task."""
    if isinstance(reports, Mapping):
        methods = [Method(name, _reports(runs)) for name, runs in reports.items()]
        for method in methods:
            if len({levels(report) for report in method.reports}) > 1:
                raise OptionError(
                    f"reports[{method.label!r}]: have different regions. Evaluate all runs of a "
                    "method with one protocol."
                )
    else:
        everything = _reports(reports)
        specs = {r.spec_digest: r.spec.named(r.task) for r in everything}
        tasks = catalogue.titles(specs.values())
        methods = [
            Method(r.policy if len(tasks) == 1 else f"{r.policy}, {tasks[r.spec_digest]}", [r])
            for r in everything
        ]
    if not methods or not all(method.reports for method in methods):
        raise OptionError("reports: must be one or more evaluation reports. Give one.")
    return methods


def _reports(given: Report | Iterable[Report]) -> list[EvaluationReport]:
    """One report or several, those given by their paths read."""
    if isinstance(given, EvaluationReport | str | os.PathLike) or not isinstance(given, Iterable):
        given = [given]
    reports = []
    for each in given:
        if isinstance(each, str | os.PathLike):
            path = Path(each) / _EVALUATION if Path(each).is_dir() else Path(each)
            reports.append(EvaluationReport.read(path))
        elif isinstance(each, EvaluationReport):
            reports.append(each)
        else:
            raise OptionError(
                f"reports={each!r:.60}: must be an EvaluationReport, the path of an "
                f"{_EVALUATION}, or the folder of a run."
            )
    return reports


def levels(report: EvaluationReport) -> tuple[float, ...]:
    """The outer ε of each region."""
    return tuple(region.epsilon_high for region in report.regions)


def only_title(reports: Iterable[EvaluationReport]) -> str | None:
    """The task's name where all reports are of one task."""
    titles = catalogue.titles(report.spec.named(report.task) for report in reports)
    return next(iter(titles.values())) if len(titles) == 1 else None

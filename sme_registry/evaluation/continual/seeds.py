"""`across_seeds`: the numbers of several runs of one stream, with intervals over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation.continual.dynamic_regret import DynamicRegret
from sme_registry.evaluation.continual.report import METRICS, StreamReport
from sme_registry.statistics import (
    DRAWS,
    Array,
    Estimate,
    Statistic,
    aggregate,
    iqm,
    stratified_bootstrap,
)


def across_seeds(
    reports: Sequence[StreamReport],
    region: str = "WD",
    *,
    draws: int = DRAWS,
    statistic: Statistic = iqm,
) -> dict[str, Estimate]:
    """The IQM over runs of every number of a region, with 95 % intervals.

    Args:
      reports: of one agent on one stream or its draws, one for each seed of its training.
      region: `WD`, `OOD 1`, …, or `OOD` for the mean over the shells.
      draws: samples of the bootstrap.
      statistic: over runs.

    Returns:
      From each name of `Retention` to values and intervals: `[V·P]` of the matrix, row by row,
      `[V]` of a metric by visit, `[1]` of any other; NaN where a run has no value, and in the ends
      of intervals of a single run. `dynamic_regret` `[1]` and `visit_dynamic_regret` `[V]` where
      every report has them, and `learning_transfer` and `visit_learning_transfer` likewise.

    Examples:
      >>> from sme_registry.evaluation import across_seeds, evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> runs = ("linear", "constant")
      >>> lives = [evaluate_stream([policy] * 2, stream, "quick-v1") for policy in runs]
      >>> across_seeds(lives)["average_performance"].value.shape
      (2,)
    """
    same_stream(reports)
    runs = {
        field: np.stack([_numbers(getattr(r.region(region).agent, field)) for r in reports])
        for field in ("normalised_regret", *METRICS)
    }
    regrets = [report.dynamic_regret for report in reports]
    logs = [regret for regret in regrets if regret is not None]
    if len(logs) == len(reports):
        runs |= _of_logs(logs, "dynamic_regret")
        if all(log.fresh_online_regret for log in logs):
            runs |= _of_logs(logs, "learning_transfer")
    digest = reports[0].stream_digest
    return {name: _estimate(values, digest, draws, statistic) for name, values in runs.items()}


def _of_logs(logs: Sequence[DynamicRegret], field: str) -> dict[str, Array]:
    """A number of lives, `[n, 1]`, and of their visits, `[n, V]`, where these are as many."""
    found = {field: np.stack([_numbers(getattr(log, field)) for log in logs])}
    by_visit = [[getattr(visit, field) for visit in log.visits] for log in logs]
    if len({len(visits) for visits in by_visit}) == 1:
        found[f"visit_{field}"] = np.stack([_numbers(visits) for visits in by_visit])
    return found


def same_stream(reports: Sequence[StreamReport]) -> None:
    """Raise OptionError unless there is a report, and all are of one stream and protocol."""
    if not reports:
        raise OptionError("reports: must be one or more stream reports. Give one for each seed.")
    streams = {report.stream_digest: report.stream for report in reports}
    found = {
        "stream_digest": {stream.family.digest for stream in streams.values()},
        "protocol_digest": {report.protocol_digest for report in reports},
    }
    for field, values in found.items():
        if len(values) > 1:
            raise OptionError(
                f"reports: have {len(values)} different values of {field}. Runs of one stream or "
                "of its draws, evaluated with one protocol, can be compared. Remove the others."
            )


def _estimate(values: Array, seed: str, draws: int, statistic: Statistic) -> Estimate:
    classes = {"": values}
    return Estimate(
        aggregate(classes, statistic), *stratified_bootstrap(classes, draws, seed, statistic)
    )


def _numbers(value: Any) -> Array:
    """A number, a row or a matrix as `[K]`; None is NaN."""
    return np.atleast_1d(np.array(value, dtype=np.float64)).ravel()

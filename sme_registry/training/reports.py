"""`write_report`: the evaluation of a finished run, its file and its figures.

A run on a task has an `EvaluationReport` of its trained model. A life in a stream has a
`StreamReport` of its snapshots, with the dynamic regret of its episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from sme_registry.envs.episodes import Episode
from sme_registry.evaluation import (
    EvaluationReport,
    StreamReport,
    dynamic_regret,
    evaluate,
    evaluate_stream,
    reference_regret,
)
from sme_registry.evaluation.measure import OnBatch
from sme_registry.io import is_installed
from sme_registry.io.terminal import Progress
from sme_registry.plots import files as plot_files
from sme_registry.plots.streams import FILE as STREAM
from sme_registry.spec import StreamSpec
from sme_registry.training.algorithms import short_name
from sme_registry.training.record import EPISODES, SNAPSHOTS, RunRecord, Snapshots, read_episodes

EVALUATION = "evaluation.json"
FILES = (EVALUATION, STREAM, *plot_files.FILES)


def write_report(
    model: Any,
    record: RunRecord,
    episodes: Sequence[Episode],
    folder: Path,
    progress: bool,
    console: Console | None,
) -> tuple[EvaluationReport | StreamReport, tuple[Path, ...]]:
    """Evaluate a finished run; write its report, and its figures if Matplotlib is installed."""
    states = record.protocol.states_per_region * len(record.protocol.edges)
    with Progress("evaluating", states, console=console, unit="states", enabled=progress) as bar:

        def on_batch(done: int, total: int) -> None:
            bar.update(done)

        if record.stream is not None:
            report = _evaluate_life(record, record.stream, folder, on_batch)
            report.write(folder / STREAM)
            return report, _draw(report, episodes, folder, model)
        evaluated = evaluate(
            model,
            record.spec,
            record.protocol,
            action_range=record.action_range,
            name=f"{'independent ' * record.independent}{short_name(record.algorithm)}",
            progress=on_batch,
        )
    evaluated.write(folder / EVALUATION)
    return evaluated, _draw(evaluated, episodes, folder, model)


def _evaluate_life(
    record: RunRecord, stream: StreamSpec, folder: Path, on_batch: OnBatch
) -> StreamReport:
    files = Snapshots(folder / SNAPSHOTS, stream)
    report = evaluate_stream(
        files.visits,
        stream,
        record.protocol,
        initial=files.initial,
        action_range=record.action_range,
        name=short_name(record.algorithm),
        progress=on_batch,
    )
    episodes = read_episodes(folder / EPISODES)  # rounded alike in every session
    if not episodes:
        return report
    step, regret, length = zip(*((e.step, e.regret, e.length) for e in episodes), strict=True)
    log = dynamic_regret(stream, step, regret, length)
    frozen: dict[str, Any] = {"frozen": files.visits[0], "training": log}
    if log.visits[0].online_regret is None:  # where no episode of the first visit is in the log
        frozen = {}
    references = reference_regret(stream, **frozen)
    return report.with_dynamic_regret(log).with_reference_regret(references)


def _draw(
    report: EvaluationReport | StreamReport, episodes: Sequence[Episode], folder: Path, model: Any
) -> tuple[Path, ...]:
    if not is_installed("matplotlib"):
        return ()
    figures: list[Path] = []
    if episodes:
        title = f"{report.policy} on {report.title}"
        visits = report.visits if isinstance(report, StreamReport) else ()
        costs = episodes[0].safety is not None
        figures += plot_files.write_training(folder / EPISODES, folder, title, visits, costs)
    if isinstance(report, StreamReport):
        return (*figures, *plot_files.write_stream(report, folder))
    return (*figures, *plot_files.write_evaluation(report, folder, model))

"""`StreamSubject`: a life in a stream to diagnose, from a run's folder or from a cell of a study.

What the agent retains and what its life cost is in its `StreamReport`. Its networks are those of
the models at the ends of the visits. In a study the fresh agents are cells of their own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import JsonValue

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, StreamReport, load_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.io import read_json
from sme_registry.plots.streams import FILE
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import Cell
from sme_registry.training import RunRecord, lives
from sme_registry.training.numpy_policy import numpy_policy

__all__ = ["Networks", "StreamSubject", "life_in_cell", "life_of_run"]

Networks = tuple[Perceptron | None, ...]  # None: of an unknown kind


@dataclass(frozen=True, eq=False)
class StreamSubject:
    """A life and what is known about it."""

    name: str  # of the run
    report: StreamReport  # with the dynamic regret and fresh agents where these are known
    plan: dict[str, JsonValue] = field(default_factory=dict)  # algorithm, seed, steps and so on
    networks: Networks | None = None  # at the end of each visit; None if they are unknown
    initial_network: Perceptron | None = None  # before training
    fresh_networks: Networks | None = None  # of the fresh agent of each phase


def life_of_run(folder: Path, name: str, record: RunRecord, plan: dict[str, Any]) -> StreamSubject:
    """The life of a run of `sme train`."""
    assert record.stream is not None  # of a life
    kept = lives.Snapshots(folder / lives.FOLDER, record.stream)
    path = folder / FILE
    if not path.exists():
        raise OptionError(
            f"run={str(folder)!r}: contains no {FILE} yet. A life in a stream is diagnosed when it "
            "has ended. Continue it with `sme train … --resume`."
        )
    missing = [file.name for file in (kept.initial, *kept.visits) if not file.exists()]
    if missing:
        raise OptionError(
            f"run={str(folder)!r}: {lives.FOLDER}/ lacks {missing[0]}. Copy the whole folder "
            "of the run, or train it again with --force."
        )
    report = StreamReport.read(path)
    if report.stream_digest != record.stream_digest:
        raise OptionError(
            f"{path}: is about the stream {report.stream_digest[:19]}…, but run.json is about "
            f"{record.stream_digest[:19]}…. Train the run again with --force."
        )
    stream, action_range = record.stream, record.action_range
    initial, *visits = _networks([kept.initial, *kept.visits], stream, action_range)
    return StreamSubject(name, report, plan, tuple(visits), initial)


def life_in_cell(
    study: Path, name: str, path: Path, cell: Cell, plan: dict[str, Any]
) -> StreamSubject:
    """The life of a cell of a study, with its fresh agents where all have finished."""
    assert cell.stream is not None  # of a life
    report = _report(read_json(path), path)
    assert isinstance(report, StreamReport)
    fresh = [path.with_stem(_stem(each)) for each in cell.fresh]
    if fresh and all(each.exists() for each in fresh):
        report = _with_fresh(report, fresh)
    kept = lives.Snapshots(lives.folder_of_cell(study, path.stem), cell.stream)
    networks = _kept(kept.visits, cell.stream, cell.action_range)
    initial = _kept([kept.initial], cell.stream, cell.action_range)
    alone = [
        _kept([lives.model_of_cell(study, each.digest)], each.document, cell.action_range)
        for each in cell.fresh
    ]
    return StreamSubject(
        name,
        report,
        plan,
        networks,
        initial[0] if initial else None,
        tuple(each[0] for each in alone if each) if alone and all(alone) else None,
    )


def _stem(cell: Cell) -> str:
    return cell.digest.removeprefix("sha256:")


def _report(result: Any, path: Path) -> EvaluationReport | StreamReport:
    """The report in the result of a cell."""
    kinds: dict[str, type[EvaluationReport] | type[StreamReport]] = {
        "report": EvaluationReport,
        "stream_report": StreamReport,
    }
    for name, kind in kinds.items():
        if isinstance(result, dict) and result.get(name):
            return kind.from_dict(result[name], str(path))
    raise OptionError(
        f"{path}: not the result of a cell: has neither {' nor '.join(kinds)}. Delete it and run "
        "the study again."
    )


def _with_fresh(report: StreamReport, paths: list[Path]) -> StreamReport:
    """The report with the fresh agents of all phases, from the results of their cells."""
    results = [read_json(path) for path in paths]
    regrets = [result.get("online_regret") for result in results]
    known = report.dynamic_regret is not None and None not in regrets
    reports = [_report(result, path) for result, path in zip(results, paths, strict=True)]
    return report.with_fresh(reports, regrets if known else None)


def _kept(paths: list[Path], document: SMESpec | StreamSpec, action_range: str) -> Networks | None:
    """The networks of models, of which a study may have kept none."""
    exist = all(path.exists() for path in paths)
    return _networks(paths, document, action_range) if exist else None


def _networks(paths: Iterable[Path], document: SMESpec | StreamSpec, action_range: str) -> Networks:
    policies = (numpy_policy(load_sb3(p), document, action_range=action_range) for p in paths)
    return tuple(each.act if isinstance(each.act, Perceptron) else None for each in policies)

"""`explorer_page` and `write_explorer`: the page of a task, or of a policy on its task."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sme_registry.diagnosis import AnySubject
from sme_registry.diagnosis.stream_subject import StreamSubject
from sme_registry.diagnosis.subject import cell_path
from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport
from sme_registry.explorer.collect import EPISODES, facts
from sme_registry.explorer.page import page
from sme_registry.io import read_json, write_atomically
from sme_registry.spec import SMESpec
from sme_registry.training import EXPLORER as FILE
from sme_registry.training.reports import EVALUATION

__all__ = ["FILE", "explorer_page", "run_report", "write_explorer"]


def write_explorer(
    path: str | os.PathLike[str],
    shown: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
) -> Path:
    """Write a page completely or not at all; equal arguments give equal bytes."""
    if Path(path).suffix != ".html":
        raise OptionError(f"{os.fspath(path)}: must end in .html.")
    content = explorer_page(shown, report=report, channels=channels, episodes=episodes, seed=seed)
    return write_atomically(path, content)


def explorer_page(
    shown: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
    static: str = "",
    remark: str = "",
) -> str:
    """The page of a task, or of a policy on its task, as HTML; equal arguments give equal text.

    `channels` are pairs of inputs, from 1 (state channels, then distractors), over which a policy
    whose network is unknown is sampled. `static` is the address of a folder with the files of
    `STATIC`, relative to the page, for a site that forbids inline code; a page without it needs no
    other file. `remark` is a text above the map.
    """
    if isinstance(shown, StreamSubject):
        raise OptionError(
            f"run={shown.name!r}: is a life in a stream, and an explorer shows one policy on one "
            "task. Give the model of one visit, such as RUN/snapshots/visit-0.zip, with --task "
            "FILE, the task of its phase."
        )
    spec, subject = (shown, None) if isinstance(shown, SMESpec) else (shown.spec, shown)
    content = facts(
        spec,
        subject,
        report=report,
        channels=channels,
        episodes=episodes,
        seed=seed,
        remark=remark,
    )
    return page(content, static)


def run_report(folder: str | os.PathLike[str], cell: str | None = None) -> EvaluationReport | None:
    """The evaluation of a run's folder, or of a finished cell of a study; None if there is none."""
    if cell is not None:
        result = read_json(cell_path(Path(folder), cell))
        return EvaluationReport.from_dict(result["report"]) if "report" in result else None
    path = Path(folder) / EVALUATION
    return EvaluationReport.read(path) if path.exists() else None

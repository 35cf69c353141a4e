"""`compare`: two algorithms of a study, or two settings of one, by their paired differences.

The runs of a pair have the same instance and seed, so what instances and seeds do to both cancels.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.io import check_writable, to_json, write_atomically
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.report.analysis import (
    DIFFERENCES,
    METRICS,
    SPECIAL_METRICS,
    Analysis,
    Metric,
    differences,
    metrics_of,
)
from sme_registry.studies.report.frames import (
    StudyFrames,
    frame,
    load,
    records,
    runs_of,
)
from sme_registry.studies.report.tables import analyse
from sme_registry.studies.report.texts import TextTable, difference_table

__all__ = ["compare", "comparison_tables", "implementation_caveats", "write_comparison"]

DEFAULT_METRICS = ("wd_regret", "ood_regret")


def compare(
    study: StudyFrames | str | os.PathLike[str],
    first: str,
    second: str,
    metrics: Sequence[str] = DEFAULT_METRICS,
) -> pd.DataFrame:
    """The paired difference first − second on each class, and its mean over all classes.

    Args:
      study: the frames of `load`, or the study's folder.
      metrics: of "wd_regret", "ood_regret", "ood_decay", "final_return", "online_regret"; where
        tasks have safety "wd_cost", "wd_safe_regret", "online_cost"; where they have distractors
        "distractor_regret", "wd_invariance".

    Returns:
      One row for each metric and class, and one for "all classes": first_level and second_level,
      IQM over the paired runs; difference, the IQM of the paired differences, with the ends low
      and high of its 95 % bootstrap interval (NaN for a single pair); pairs; instances, the
      different ones among the pairs; enough_pairs; and the verdict on the first algorithm: better,
      worse, open, or indication: the interval excludes 0 but rests on fewer than 5 pairs.
      `sme_registry.statistics` has the formulas.

    Examples:
      >>> from sme_registry import studies
      >>> differences = studies.compare("study", "linear", "constant", ["wd_regret"])
      >>> bool(differences["difference"].iloc[-1] < 0)
      True
    """
    if not isinstance(study, StudyFrames):
        _refuse_streams_alone(study)
        study = load(study)
    finished = runs_of(study.results)
    _check_names(first, second, list(dict.fromkeys(finished.algorithm)))
    chosen = [_metric(name, metrics_of(finished)) for name in metrics]
    table = frame([*differences(finished, [(first, second)], chosen)], DIFFERENCES)
    if table.empty:
        raise OptionError(
            f"{first!r} and {second!r}: no class has a run of both on the same instance with the "
            "same seed. Run more of the study's cells."
        )
    return table


def comparison_tables(table: pd.DataFrame) -> list[TextTable]:
    """The result of `compare` for people, a table for each metric."""
    return [
        difference_table(table[table.metric == key], _metric(key), levels=True)
        for key in dict.fromkeys(table.metric)
    ]


def implementation_caveats(folder: str | os.PathLike[str], first: str, second: str) -> list[str]:
    """A sentence if one of two algorithms runs in JAX and the other does not."""
    uses = {each.name: each.uses for each in Ledger(folder).study_file().plan.algorithms}
    ours = [name for name in (first, second) if in_jax(uses[name])]
    if len(ours) != 1:
        return []
    return [
        f"{ours[0]} runs in JAX and {(second if ours == [first] else first)} does not: their "
        "difference is also one between implementations."
    ]


def write_comparison(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    first: str,
    second: str,
    metrics: Sequence[str] = DEFAULT_METRICS,
) -> list[Path]:
    """Write a comparison into the folder `out`, and return the files.

    They are differences.csv and .json, a .tex for each metric, and the figures `differences` and
    `learning-curves-by-class` as PNG and PDF.

    Examples:
      >>> from sme_registry import studies
      >>> files = studies.write_comparison("study", "compared", "linear", "constant", ["wd_regret"])
      >>> sorted({path.suffix for path in files})
      ['.csv', '.json', '.pdf', '.png', '.tex']
    """
    from sme_registry.plots.style import WRITTEN
    from sme_registry.studies.report.figures import draw, draw_class_curves, draw_differences

    check_writable(Path(out) / "differences.csv")
    table = compare(folder, first, second, metrics)
    contents: dict[str, str | bytes] = {
        "differences.csv": table.to_csv(index=False, lineterminator="\n"),
        "differences.json": to_json(records(table)),
    }
    contents |= {f"{each.name}.tex": each.latex() for each in comparison_tables(table)}
    analysis = _analysis(folder, first, second)
    pictures, _ = draw((draw_differences, draw_class_curves), analysis, WRITTEN)
    for picture in pictures:
        contents |= {f"{picture.name}.{each}": picture.files[each] for each in WRITTEN}
    return [write_atomically(Path(out) / name, content) for name, content in contents.items()]


def _analysis(folder: str | os.PathLike[str], first: str, second: str) -> Analysis:
    """The tables of these two algorithms alone, the first one first."""
    ledger = Ledger(folder)
    file = ledger.study_file()
    of = {algorithm.name: algorithm for algorithm in file.plan.algorithms}
    plan = file.plan.model_copy(update={"algorithms": (of[first], of[second])})
    results = ledger.results(cell.cell.digest for cell in plan.cells)
    return analyse(file.model_copy(update={"plan": plan}), results)


def _refuse_streams_alone(folder: str | os.PathLike[str]) -> None:
    if not Ledger(folder).study_file().plan.classes:
        raise OptionError(
            f"folder={str(folder)!r}: its plan has streams alone, and runs on single tasks are "
            "compared. `sme study report` has the differences between algorithms in streams."
        )


def _check_names(first: str, second: str, known: Sequence[str]) -> None:
    for name in (first, second):
        if name not in known:
            raise UnknownNameError(
                f"{name!r}: the study has no finished run of such an algorithm."
                f"{did_you_mean(name, known)} Its algorithms: {', '.join(known) or 'none'}."
            )
    if first == second:
        raise OptionError(f"{first!r}: is given twice. Give two different algorithms.")


def _metric(name: str, metrics: Sequence[Metric] = (*METRICS, *SPECIAL_METRICS)) -> Metric:
    known = {metric.key: metric for metric in metrics}
    if name not in known:
        raise UnknownNameError(
            f"metric={name!r}: must be one of {', '.join(known)}.{did_you_mean(name, known)}"
        )
    return known[name]

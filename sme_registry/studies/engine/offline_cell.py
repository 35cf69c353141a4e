"""Cells that learn from a data set and never from the environment.

    uses                hyperparameters
    offline:bc          nu, transitions of the data set; the rest is the learner's
    offline:iql         likewise

The cell collects the data set with the behaviour policy of METHOD, section 4, and the cell's seed,
and does not keep it: the same recipe gives the same bits. `steps` are gradient steps. The
environment is used only for evaluations.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sme_registry.datasets import DatasetRecipe, collect, train_offline
from sme_registry.datasets.record import ALGORITHMS
from sme_registry.errors import OptionError, SpecError
from sme_registry.spec.study import OFFLINE, Cell
from sme_registry.studies.engine.algorithms import named_after
from sme_registry.studies.engine.result import CellResult, LearningCurve, OfflineResult, Timing
from sme_registry.task import materialize

DATA_SETTINGS = ("nu", "transitions", "batch_size")  # hyperparameters that are not the learner's
TRANSITIONS = 50_000
BATCH_SIZE = 256


def offline_name(uses: str) -> str | None:
    """The learner that `offline:…` names, as `algorithms.named_after` reads it."""
    return named_after(OFFLINE, uses, ALGORITHMS)


def run_offline(cell: Cell, name: str, progress: Callable[[int, int], None]) -> CellResult:
    """Collect the data, learn from it, and evaluate the policy as in every cell."""
    start = time.thread_time()
    settings: dict[str, Any] = dict(cell.hyperparameters)
    nu: Any = settings.get("nu")
    recipe = _recipe(cell, settings)
    data = collect(recipe, materialize(cell.spec), {})
    collected = time.thread_time()
    result = train_offline(
        data,
        algorithm=name,
        steps=cell.steps,
        batch_size=settings.pop("batch_size", BATCH_SIZE),
        seed=cell.seed,
        evaluations=max(1, cell.evaluations),
        episodes=cell.evaluation_episodes,
        hyperparameters=settings,
        spec=cell.spec,
        protocol=cell.protocol,
        progress=lambda done, total, _: progress(done, total),
    )
    end = time.thread_time()
    record, T = result.record, cell.spec.horizon
    evaluations = record.evaluations
    training = record.cpu_ms_per_step * cell.steps / 1e3
    return CellResult(
        key=cell.digest,
        cell=cell,
        curve=LearningCurve(
            steps=tuple(each.step for each in evaluations),
            episode_return=tuple(each.episode_return for each in evaluations),
            regret=tuple(1.0 - each.episode_return / T for each in evaluations),
            similarity=tuple(each.similarity for each in evaluations),
            length=(float(T),) * len(evaluations),
        ),
        report=result.report,
        offline=OfflineResult(
            nu=nu,
            transitions=recipe.transitions,
            dataset_digest=record.dataset_digest,
            behaviour_similarity=record.behaviour.similarity,
            behaviour_similarity_sd=record.behaviour.similarity_sd,
            similarity=record.similarity,
            similarity_sd=evaluations[-1].similarity_sd,
        ),
        timing=Timing(
            total=end - start,
            training=training,
            environment=collected - start,
            evaluation=max(0.0, end - collected - training),
            steps_per_second=cell.steps / max(training, 1e-9),
        ),
        versions=record.versions,
    )


def _recipe(cell: Cell, settings: dict[str, Any]) -> DatasetRecipe:
    """The recipe of a cell's data set; takes its `nu` and `transitions` out of `settings`."""
    if cell.spec.D > 0:
        raise SpecError(f"D={cell.spec.D:g}: must be 0 for an offline cell. Leave it out.")
    if "nu" not in settings:
        raise OptionError("hyperparameters.nu: is required. Give a number in [0, 1], such as 0.5.")
    return DatasetRecipe.from_dict(
        {
            "spec": cell.spec,
            "behaviours": [{"kind": "mixture", "nu": settings.pop("nu"), "weight": 1.0}],
            "transitions": settings.pop("transitions", TRANSITIONS),
            "seed": cell.seed,
            "protocol": cell.protocol,
        },
        "data set",
    )

"""`train_offline`: train BC or IQL on a data set, and evaluate the policy in the data set's task.

During training, episodes of the policy are played in the task; their mean r̃ is compared with the
exact mean r̃ of the data set. The final policy is evaluated in and out of distribution.

The folder of an offline training:
    offline.json      the record, with all evaluations
    policy.npz        the policy, for `OfflinePolicy.load` and `sme evaluate`
    evaluation.json   its final evaluation; decay_curve.png, .pdf if matplotlib is installed
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sme_registry.datasets import Dataset, Transitions
from sme_registry.evaluation import EvaluationReport, evaluate
from sme_registry.evaluation.networks import OfflinePolicy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import (
    claim_folder,
    integer_in,
    is_installed,
    require_packages,
    to_json,
    versions,
    write_atomically,
)
from sme_registry.offline.hyperparameters import ALGORITHMS, resolve_hyperparameters
from sme_registry.offline.record import Evaluation, OfflineRecord
from sme_registry.offline.source import data_source
from sme_registry.plots import files as plot_files
from sme_registry.spec import ProtocolLike, SpecLike
from sme_registry.training import known_algorithm
from sme_registry.training.record import PACKAGES
from sme_registry.training.reports import EVALUATION

RECORD = "offline.json"
POLICY = "policy.npz"
_FILES = (RECORD, POLICY, EVALUATION, *plot_files.FILES)
_ABOUT = ("algorithm", "seed", "steps", "dataset_digest", "spec_digest")  # in the policy's file

EPISODES = 10  # METHOD, section 4
MAX_STEPS = 10**9

ReportProgress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class OfflineResult:
    """A finished offline training."""

    policy: OfflinePolicy  # from observations `[B, O]` to actions `[B, A]`, for `evaluate`
    record: OfflineRecord  # the content of `offline.json`
    report: EvaluationReport  # of the policy
    folder: Path | None  # None if nothing was written


def train_offline(
    data: Dataset | Transitions | str | os.PathLike[str],
    *,
    algorithm: str = "iql",
    steps: int = 20_000,
    batch_size: int = 256,
    seed: int = 0,
    evaluations: int = 20,
    episodes: int = EPISODES,
    hyperparameters: Mapping[str, Any] | None = None,
    spec: SpecLike | None = None,
    protocol: ProtocolLike | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: ReportProgress | None = None,
) -> OfflineResult:
    """Train BC or IQL on a data set, on the CPU and one thread.

    The same arguments give the same bits on one machine; other processors and builds of PyTorch
    round differently.

    Args:
      data: a data set, its id or its path; or its arrays, with `spec`.
      algorithm: "bc" or "iql", in any case.
      steps: gradient steps, at least 1.
      batch_size: transitions in each, in [1, N]. Every transition is used once before any repeats.
      seed: in [0, 2**53): of initial weights, shuffles, and the starts of evaluation episodes,
        which depend on nothing else, so they are the same for both algorithms.
      evaluations: number of evaluations during training, evenly spaced, in [1, steps]; the last one
        is at the end.
      episodes: of each evaluation, in [1, 4096].
      hyperparameters: changes to the defaults, see `BCHyperparameters` and `IQLHyperparameters`.
      spec: the task of arrays: a spec, its fields, an id, a digest or a path.
      protocol: of the final evaluation; None takes the data set's, and "paper-v1" for arrays.
      folder: output folder, created if it is missing. None writes nothing.
      force: replace an earlier training in the folder.
      progress: called with the steps done, their total, and a note.

    Examples:
      >>> from sme_registry.offline import train_offline
      >>> result = train_offline(
      ...     "data/sme/Default-v1-nu50-seed0-v0",
      ...     algorithm="bc",
      ...     steps=10,
      ...     batch_size=32,
      ...     evaluations=1,
      ...     episodes=2,
      ...     protocol="quick-v1",
      ... )
      >>> result.record.steps
      10
    """
    algorithm = known_algorithm(algorithm, ALGORITHMS)
    settings = resolve_hyperparameters(algorithm, hyperparameters)
    steps = integer_in("steps", steps, 1, MAX_STEPS)
    seed = integer_in("seed", seed, 0, 2**53 - 1)
    evaluations = integer_in("evaluations", evaluations, 1, steps)
    episodes = integer_in("episodes", episodes, 1, 4096)
    require_packages("offline training", {"torch": "PyTorch"}, "offline")
    source = data_source(data, spec, protocol)
    transitions, task = source.transitions, source.task
    batch_size = integer_in(
        "batch_size", batch_size, 1, len(transitions), advice="The data set has no more rows."
    )
    target = None if folder is None else claim_folder(folder, _FILES, force=force)

    fields: dict[str, Any] = {
        "algorithm": algorithm,
        "hyperparameters": settings.to_dict(),
        "seed": seed,
        "steps": steps,
        "batch_size": batch_size,
        "episodes": episodes,
        **source.record_fields(),
    }
    about = {name: fields[name] for name in _ABOUT}
    start, start_cpu, learning = time.perf_counter(), time.process_time(), 0.0
    done: list[Evaluation] = []

    def report_progress(step: int) -> None:
        if progress is not None:
            progress(step, steps, f"r̃ {done[-1].similarity:.3f}" if done else "")

    from sme_registry.offline.learn import learn

    evaluate_at = [round(steps * (index + 1) / evaluations) for index in range(evaluations)]
    for section in learn(settings, transitions, batch_size, seed, evaluate_at, report_progress):
        learning += section.cpu_seconds
        policy = OfflinePolicy(section.layers, about)
        states = start_states(seed, len(done), episodes, task.spec.state_dim)
        result = rollouts(policy, task, states)
        done.append(
            Evaluation(
                step=section.step,
                similarity=result.per_step(result.similarity),
                similarity_sd=result.similarity_sd,
                episode_return=result.episode_return.mean(),
                losses=section.losses,
            )
        )
    record = OfflineRecord(
        **fields,
        evaluations=tuple(done),
        wall_seconds=round(time.perf_counter() - start, 3),
        cpu_seconds=round(time.process_time() - start_cpu, 3),
        cpu_ms_per_step=round(1e3 * learning / steps, 4),
        versions=versions(PACKAGES),
    )
    report = evaluate(policy, task.spec.named(source.name), source.protocol, name=algorithm.upper())
    if target is not None:
        (target / RECORD).unlink(missing_ok=True)
        policy.save(target / POLICY)
        report.write(target / EVALUATION)
        if is_installed("matplotlib"):
            plot_files.write_evaluation(report, target)
        # Last, so that a folder with a record is complete.
        write_atomically(target / RECORD, to_json(record.to_dict()))
    return OfflineResult(policy, record, report, target)

"""`train_offline`: train BC or IQL on a data set, and evaluate the policy in the data set's task.

The folder of an offline training:
    offline.json      the record, with all evaluations
    policy.npz        the policy, for `OfflinePolicy.load` and `sme evaluate`
    critic-0.npz, critic-1.npz     of IQL, for `sme_registry.diagnosis.critic`
    evaluation.json   its final evaluation; decay_curve.png, .pdf if matplotlib is installed

Importing this module does not import PyTorch.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.datasets.documents import (
    BehaviourQuality,
    OfflineEvaluation,
    OfflineRecord,
    check_algorithm,
)
from sme_registry.datasets.storage import Dataset, SealedDataset, open_dataset
from sme_registry.datasets.transitions import Transitions
from sme_registry.errors import OptionError, SpecError
from sme_registry.evaluation import EvaluationReport, evaluate
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.evaluation.networks import OfflinePolicy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import (
    claim_folder,
    integer_in,
    is_installed,
    require_packages,
    versions,
)
from sme_registry.plots import reports as plot_files
from sme_registry.spec import SMESpec
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.spec.suite import ProtocolLike
from sme_registry.task import Task, load, materialize

if TYPE_CHECKING:
    from sme_registry.datasets.learners import OfflineLearner

RECORD, POLICY, EVALUATION = "offline.json", "policy.npz", "evaluation.json"
CRITICS = "critic-0.npz", "critic-1.npz"
_FILES = (RECORD, POLICY, *CRITICS, EVALUATION, *plot_files.FILES)
_PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "stable_baselines3", "torch")

_CHECKED_ROWS = 64
_TOLERANCE = 1e-6  # of π* between machines, as for fingerprints

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
    episodes: int = 10,
    hyperparameters: Mapping[str, Any] | None = None,
    spec: SpecLike | None = None,
    protocol: ProtocolLike | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: ReportProgress | None = None,
) -> OfflineResult:
    """Train BC or IQL on a data set, on the CPU and one thread.

    The same arguments give the same bits on one machine. Every transition is used once before any
    repeats. `progress` is called with the steps taken, their total, and a note.

    Args:
      data: a data set, its id or its path; or its arrays, with `spec`.
      seed: in [0, 2**53): of initial weights, shuffles, and the starts of evaluation episodes,
        which are the same for both algorithms.
      evaluations: evenly spaced during training, in [1, steps]; the last one is at the end.
      hyperparameters: changes to the defaults, see `BCHyperparameters` and `IQLHyperparameters`.
      protocol: of the final evaluation; None takes the data set's, and "paper-v1" for arrays.
      folder: output folder; None writes nothing, and `force` replaces an earlier training in it.

    Examples:
      >>> from sme_registry.datasets import train_offline
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
    transitions, spec, dataset = _load(data, spec)
    if protocol is None:
        protocol = "paper-v1" if dataset is None else dataset.recipe.protocol
    protocol = resolve_protocol(protocol)
    task = materialize(spec)
    _check_task(transitions, task)
    learner = _learner(transitions, algorithm, hyperparameters, steps, batch_size, seed)
    evaluations = integer_in("evaluations", evaluations, 1, steps)
    episodes = integer_in("episodes", episodes, 1, 4096)
    target = None if folder is None else claim_folder(folder, _FILES, force=force)

    about = {**learner.about, "spec_digest": task.spec.digest}
    start, start_cpu = time.perf_counter(), time.process_time()
    played: list[OfflineEvaluation] = []

    def report(step: int) -> None:
        if progress is not None:
            progress(step, steps, f"r̃ {played[-1].similarity:.3f}" if played else "")

    for index in range(evaluations):
        learner.advance(round(steps * (index + 1) / evaluations), report)
        policy = OfflinePolicy(learner.layers, about)
        states = start_states(seed, index, episodes, task.spec.state_dim)
        result = rollouts(policy, task, states)
        played.append(
            OfflineEvaluation(
                step=learner.steps,
                similarity=result.per_step(result.similarity),
                similarity_sd=result.similarity_sd,
                episode_return=result.episode_return.mean(),
                regret=result.per_step(result.regret),
                losses=learner.losses,
            )
        )
        report(learner.steps)
    record = OfflineRecord(
        **about,
        hyperparameters=learner.hyperparameters.to_dict(),
        batch_size=batch_size,
        episodes=episodes,
        dataset=None if dataset is None else dataset.id,
        recipe_digest=None if dataset is None else dataset.record.recipe_digest,
        transitions=len(transitions),
        spec=task.spec,
        behaviour=BehaviourQuality(
            similarity=transitions.similarities.mean(),
            similarity_sd=transitions.similarities.std(),
            step_reward=transitions.step_rewards.mean(),
        ),
        evaluations=tuple(played),
        wall_seconds=round(time.perf_counter() - start, 3),
        cpu_seconds=round(time.process_time() - start_cpu, 3),
        cpu_ms_per_step=round(1e3 * learner.cpu_seconds / steps, 4),
        versions=versions(_PACKAGES),
    )
    evaluated = evaluate(policy, spec, protocol, name=record.algorithm.upper())
    if target is not None:
        (target / RECORD).unlink(missing_ok=True)
        policy.save(target / POLICY)
        for name in CRITICS:  # of an earlier training
            (target / name).unlink(missing_ok=True)
        for name, critic in zip(CRITICS, learner.critics, strict=False):
            critic.save(target / name)
        evaluated.write(target / EVALUATION)
        if is_installed("matplotlib"):
            plot_files.write_evaluation(evaluated, target)
        # Last, so that a folder with a record is complete.
        record.write(target / RECORD)
    return OfflineResult(policy, record, evaluated, target)


def train_sealed(
    data: SealedDataset | str | os.PathLike[str],
    *,
    algorithm: str = "iql",
    steps: int = 20_000,
    batch_size: int = 256,
    seed: int = 0,
    hyperparameters: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OfflinePolicy:
    """Train BC or IQL on a sealed data set, or that in a folder, on the CPU and one thread.

    As `train_offline`, but nothing is evaluated: only the season's board can.
    """
    rows = data if isinstance(data, SealedDataset) else SealedDataset.read(data)
    learner = _learner(rows, algorithm, hyperparameters, steps, batch_size, seed)

    def report(step: int) -> None:
        if progress is not None:
            progress(step, steps)

    learner.advance(steps, report)
    report(steps)
    return OfflinePolicy(learner.layers, learner.about)


def _learner(
    rows: Transitions | SealedDataset,
    algorithm: str,
    hyperparameters: Mapping[str, Any] | None,
    steps: int,
    batch_size: int,
    seed: int,
) -> OfflineLearner:
    algorithm, checked = check_algorithm(algorithm, hyperparameters)
    about = {
        "algorithm": algorithm,
        "seed": integer_in("seed", seed, 0, 2**53 - 1),
        "steps": integer_in("steps", steps, 1, 10**9),
        "dataset_digest": rows.digest,
    }
    advice = "The data set has no more rows."
    batch_size = integer_in("batch_size", batch_size, 1, len(rows), advice=advice)
    require_packages("offline training", {"torch": "PyTorch"}, "offline")
    from sme_registry.datasets.learners import OfflineLearner

    return OfflineLearner(checked, rows, batch_size, about)


def _load(data: Any, spec: SpecLike | None) -> tuple[Transitions, SMESpec, Dataset | None]:
    """The rows of a training, the spec of their task, and their data set unless they are arrays."""
    if isinstance(data, Transitions):
        if spec is None:
            raise OptionError("spec=None: is required with arrays. Give the spec of their task.")
        transitions, dataset, spec = data, None, load(spec, SMESpec)
    elif isinstance(data, Dataset | str | os.PathLike):
        dataset = data if isinstance(data, Dataset) else open_dataset(data)
        record = dataset.record
        if spec is not None and load(spec, SMESpec).digest != record.spec_digest:
            raise OptionError(
                f"spec={spec!r:.60}: the data set's task is {record.spec_digest[:19]}…. Leave it "
                "out."
            )
        transitions, spec = dataset.transitions(), record.recipe.spec.named(record.task)
    else:
        raise OptionError(
            f"data={data!r:.60}: must be a data set, its id, its path, or its Transitions."
        )
    if spec.team is not None:
        raise SpecError(
            f"team: the data set has {len(spec.team.agents)} agents, and a policy that sees all "
            "observations cannot be executed by the individual agents. Train on a single-agent "
            "data set."
        )
    return transitions, spec, dataset


def _check_task(transitions: Transitions, task: Task) -> None:
    """Raise OptionError unless arrays are finite and of this task."""
    rows, columns = len(transitions), transitions.columns()
    if rows == 0:
        raise OptionError("transitions=0: must be at least 1. Give a data set with rows.")
    widths = {"observations": task.spec.observation_dim, "actions": task.spec.action_dim}
    for name, width in {**widths, "next_observations": widths["observations"]}.items():
        if columns[name].shape != (rows, width):
            raise OptionError(
                f"{name} of shape {columns[name].shape}: must be ({rows}, {width}) for this task. "
                "Give the spec of the data set."
            )
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise OptionError(f"{name}: contains NaN or infinity. Give finite numbers.")
    some = np.linspace(0, rows - 1, min(_CHECKED_ROWS, rows)).astype(int)
    optimal = task.optimal_action(transitions.states[some])
    difference = np.abs(optimal - transitions.optimal_actions[some]).max()
    if difference > _TOLERANCE:
        raise OptionError(
            f"spec={task.spec.digest[:19]}…: is not the task of the data set: the optimal actions "
            f"differ by up to {difference:.2g}. Give the spec of the data set."
        )

"""What to diagnose: a run of `sme train`, or any policy on its task; `studies.subject` has cells.

A life in a stream is its report and the networks at the ends of the visits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
from pydantic import JsonValue

from sme_registry.datasets import offline
from sme_registry.datasets.documents import OfflineRecord
from sme_registry.diagnosis.behaviour import Log
from sme_registry.diagnosis.critics import OfflineAgent
from sme_registry.errors import OptionError, SMEError
from sme_registry.evaluation import Policy, StreamReport
from sme_registry.evaluation.models import load_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.plots.maps import STREAM
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task import load
from sme_registry.training import record as run_files
from sme_registry.training.algorithms import backend_of, find, parse_uses
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import CHECKPOINT, RunRecord

Networks = tuple[Perceptron | None, ...]


@dataclass(frozen=True, eq=False)
class Subject:
    """A policy, or those of a team, and what is known about the training."""

    name: str  # of the run or policy
    spec: SMESpec
    policy: Policy | TeamPolicy  # from observations to actions in the unit range, unclipped
    plan: dict[str, JsonValue] = field(default_factory=dict)  # algorithm, seed, steps and so on
    log: Log | None = None  # of a single agent
    checkpoint_step: int | None = None  # of an unfinished run, the steps at its checkpoint
    updates: int | None = None  # of the algorithm; None if unknown
    model: Any = None  # of Stable-Baselines3, or an OfflineAgent, which may have a critic

    @property
    def document(self) -> SMESpec:
        return self.spec

    @property
    def task(self) -> str:
        return self.spec.name


@dataclass(frozen=True, eq=False)
class StreamSubject:
    """A life in a stream and what is known about it."""

    name: str  # of the run
    report: StreamReport  # with the dynamic regret and fresh agents where these are known
    plan: dict[str, JsonValue] = field(default_factory=dict)
    # None: of an unknown kind, or not kept
    networks: Networks | None = None  # at the end of each visit
    initial_network: Perceptron | None = None  # before training
    fresh_networks: Networks | None = None  # of the fresh agent of each phase
    updates: int | None = None
    models: tuple[Path, ...] = ()  # kept at the end of each visit
    checkpoint_step: ClassVar[None] = None  # it has ended

    @property
    def document(self) -> StreamSpec:
        return self.report.stream

    @property
    def task(self) -> str:
        return self.report.name


AnySubject: TypeAlias = Subject | StreamSubject


def perceptron_of(policy: Policy) -> Perceptron | None:
    """The multilayer perceptron that a policy is, whatever trained it; None if it is another."""
    return policy.act if isinstance(policy.act, Perceptron) else None


def load_policy(
    policy: Any,
    spec: SpecLike,
    *,
    action_range: str | None = None,
    name: str | None = None,
    log: str | Path | None = None,
) -> Subject:
    """A policy in any form that `evaluate` accepts, and its task: a spec, a name or a path.

    `log` is the episodes.csv of its training, as `sme train` and `wrappers.RecordRegret` write it.

    Examples:
      >>> from sme_registry.diagnosis import load_policy
      >>> load_policy("linear", "Default").name
      'linear'
    """
    spec = load(spec, SMESpec)
    if spec.team is not None and log is not None:
        raise OptionError("log: of a team is not used. Leave it out.")
    if spec.team is None and isinstance(policy, str | Path) and str(policy).endswith(".zip"):
        policy, name = load_sb3(policy), name or Path(policy).stem
    episodes = None if log is None else _log_of_episodes(Path(log))
    return subject_of(name, policy, spec, action_range, log=episodes)


def load_run(folder: str | Path) -> AnySubject:
    """A run of `sme train`, finished or not; a life in a stream only when it has ended.

    Examples:
      >>> from sme_registry.diagnosis import load_run
      >>> load_run("runs/ppo").plan["algorithm"]
      'PPO'
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise OptionError(f"run={str(folder)!r}: no such folder. Give a folder of `sme train`.")
    if (folder / offline.RECORD).exists():
        return _offline_run(folder)
    record = RunRecord.read(folder)
    if record is None:
        advice = "Give a folder of `sme train`."
        if cell := min((folder / "cells").glob("*.json"), default=None):
            advice = f"This is the folder of a study. Add a cell: --cell {cell.stem[:12]}."
        raise OptionError(f"run={str(folder)!r}: contains no run.json. {advice}")
    name = folder.name or str(folder)
    fields = ("algorithm", "hyperparameters", "seed", "action_range", "num_envs", "steps")
    plan = {field: getattr(record, field) for field in fields}
    updates = updates_of(
        record.algorithm, record.hyperparameters, record.steps_done, record.num_envs
    )
    if record.stream is not None:
        kept = run_files.Snapshots(folder / run_files.SNAPSHOTS, record.stream)
        networks = networks_of(kept, record.stream, record.action_range)
        if not (folder / STREAM).exists():
            raise OptionError(
                f"run={str(folder)!r}: contains no {STREAM} yet. A life in a stream is diagnosed "
                "when it has ended. Continue it with `sme train … --resume`."
            )
        report, models = StreamReport.read(folder / STREAM), tuple(kept.visits)
        return StreamSubject(name, report, plan, *networks, None, updates, models)
    path, checkpoint_step = _model_of_run(folder, record)
    log = folder / run_files.EPISODES
    return subject_of(
        name,
        str(path) if record.independent else load_sb3(path),
        record.spec.named(record.task),
        record.action_range,
        plan=plan,
        log=_log_of_episodes(log) if record.spec.team is None and log.exists() else None,
        checkpoint_step=checkpoint_step,
        updates=updates,
    )


def _offline_run(folder: Path) -> Subject:
    record = OfflineRecord.read(folder / offline.RECORD)
    plan = record.to_dict()
    plan = {field: plan[field] for field in ("algorithm", "hyperparameters", "seed", "steps")}
    name = folder.name or str(folder)
    return subject_of(name, str(folder / offline.POLICY), record.spec, "unit", plan=plan)


def subject_of(
    name: str | None, model: Any, spec: SMESpec, action_range: str | None, **known: Any
) -> Subject:
    """A model on a task, by default under the policy's own name."""
    if spec.team is not None:
        team = as_policy(model, spec, action_range=action_range)
        return Subject(name or team.name, spec, team, **known)
    policy = numpy_policy(model, spec, action_range=action_range)
    model = OfflineAgent.of(model) or model
    return Subject(name or policy.name, spec, policy, model=model, **known)


def networks_of(
    kept: run_files.Snapshots, stream: StreamSpec, action_range: str
) -> tuple[Networks, Perceptron | None]:
    """The networks at the ends of a life's visits, and the one before training."""
    visits = tuple(network_of(path, stream, action_range) for path in kept.visits)
    return visits, network_of(kept.initial, stream, action_range)


def network_of(path: Path, document: SMESpec | StreamSpec, action_range: str) -> Perceptron | None:
    """The network of a model; None if it was not kept or is of another kind."""
    if not path.exists():
        return None
    return perceptron_of(numpy_policy(load_sb3(path), document, action_range=action_range))


def _model_of_run(folder: Path, record: RunRecord) -> tuple[Path, int | None]:
    """The model of a run; of an unfinished run its checkpoint, and the steps at it."""
    model, checkpoint = folder / record.model_name, folder / CHECKPOINT
    if model.exists():
        return model, None
    readable = not (record.independent or backend_of(record.algorithm).own_checkpoint)
    if checkpoint.exists() and readable:
        return checkpoint, record.steps_done
    raise OptionError(
        f"run={str(folder)!r}: has neither {record.model_name} nor a {CHECKPOINT} that can be "
        "diagnosed. Wait for it, or continue the run with `sme train … --resume`."
    )


def _log_of_episodes(path: Path) -> Log | None:
    rows = run_files.read_episodes(path)
    if not rows:
        return None
    step, regret, ended = np.array([(e.step, e.regret, e.terminated) for e in rows], float).T
    return Log("episodes", step, regret, (regret >= 1.0).astype(float), ended)


def updates_of(
    uses: str, hyperparameters: Mapping[str, Any], steps: int, num_envs: int = 1
) -> int | None:
    """How often an algorithm updated its networks, after rollouts or every `train_freq` steps."""
    name = parse_uses(uses)[1]
    if ":" in name:  # a reference, a learner of offline data or somebody's module
        return None
    try:
        fields = find(name).settings().model_fields
    except SMEError:  # it is not installed here
        return None
    settings = {name: field.default for name, field in fields.items()} | dict(hyperparameters)
    every, starts = settings.get("train_freq"), settings.get("learning_starts")
    if isinstance(every, int) and isinstance(starts, int):
        return max(0, steps - starts) // (every * num_envs)
    if isinstance(rollout := settings.get("n_steps"), int):
        return steps // (rollout * num_envs)
    return None

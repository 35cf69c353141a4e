"""What to diagnose: a run of `sme train`, a cell of a study, or any policy on its task.

A life in a stream is its report and the networks at the ends of the visits. In a study the fresh
agents are cells of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from pydantic import JsonValue

from sme_registry.datasets import offline
from sme_registry.datasets.documents import OfflineRecord
from sme_registry.diagnosis.behaviour import Log, exploration
from sme_registry.diagnosis.critics import OfflineAgent
from sme_registry.errors import OptionError, SMEError, SpecError, UnknownNameError
from sme_registry.evaluation import EvaluationReport, Policy, StreamReport
from sme_registry.evaluation.models import load_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.evaluation.references import reference_policy
from sme_registry.io import read_json
from sme_registry.plots.maps import STREAM
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import Cell
from sme_registry.task.task import Observation
from sme_registry.training import record as run_files
from sme_registry.training.algorithms import backend_of, find, parse_uses
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import CHECKPOINT, RunRecord

_MIN_DIGITS = 6
Networks = tuple[Perceptron | None, ...]


@dataclass(frozen=True, eq=False)
class Subject:
    """A policy, or those of a team, and what is known about the training."""

    name: str  # of the run or policy
    spec: SMESpec
    policy: Policy | TeamPolicy  # from observations to actions in the unit range, unclipped
    plan: dict[str, JsonValue] = field(default_factory=dict)  # algorithm, seed, steps and so on
    log: Log | None = None  # of a single agent
    explore: Callable[[Observation], Any] | None = None  # the algorithm's stochastic actions
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
    spec: SMESpec,
    *,
    action_range: str | None = None,
    name: str | None = None,
    log: str | Path | None = None,
) -> Subject:
    """A policy in any form that `evaluate` accepts, and its task.

    `log` is the episodes.csv of its training, as `sme train` and `wrappers.RecordRegret` write it.

    Examples:
      >>> from sme_registry.diagnosis import load_policy
      >>> load_policy("linear", sme_registry.load("Default")).name
      'linear'
    """
    if spec.team is not None and log is not None:
        raise OptionError("log: of a team is not used. Leave it out.")
    if spec.team is None and isinstance(policy, str | Path) and str(policy).endswith(".zip"):
        policy, name = load_sb3(policy), name or Path(policy).stem
    episodes = None if log is None else _log_of_episodes(Path(log))
    return _subject(name, policy, spec, action_range, log=episodes)


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
        if (folder / "cells").is_dir():
            advice = f"This is the folder of a study. Add a cell: --cell {_example_key(folder)}."
        raise OptionError(f"run={str(folder)!r}: contains no run.json. {advice}")
    name = folder.name or str(folder)
    fields = ("algorithm", "hyperparameters", "seed", "action_range", "num_envs", "steps")
    plan = {field: getattr(record, field) for field in fields}
    updates = _updates(record.algorithm, record.hyperparameters, record.steps_done, record.num_envs)
    if record.stream is not None:
        kept = run_files.Snapshots(folder / run_files.SNAPSHOTS, record.stream)
        networks = _networks(kept, record.stream, record.action_range)
        report, models = _report_of_life(folder), tuple(kept.visits)
        return StreamSubject(name, report, plan, *networks, None, updates, models)
    path, checkpoint_step = _model_of_run(folder, record)
    log = folder / run_files.EPISODES
    return _subject(
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
    return _subject(name, str(folder / offline.POLICY), record.spec, "unit", plan=plan)


def load_cell(study: str | Path, key: str) -> AnySubject:
    """A finished cell of a study that kept its model; a life in a stream also without its models.

    `key` is the cell's digest, with or without `sha256:`, or its first digits.
    """
    study = Path(study)
    path = cell_path(study, key)
    result = read_cell(path)
    cell = result.cell
    if parse_uses(cell.uses)[0] == "independent":
        raise OptionError(
            f"cell={path.stem[:12]!r}: has a model for each agent. Train it with `sme train "
            "--independent`, and diagnose that run."
        )
    fields = ("hyperparameters", "seed", "action_range", "steps")
    plan = {"algorithm": cell.uses, **{field: getattr(cell, field) for field in fields}}
    name = f"{cell.uses}, cell {path.stem[:12]}"
    updates = _updates(cell.uses, cell.hyperparameters, cell.steps)
    if cell.stream is not None:
        kept = run_files.Snapshots(run_files.folder_of_cell(study, path.stem), cell.stream)
        report = _with_fresh(result, path)
        visits, initial = _networks(kept, cell.stream, cell.action_range)
        fresh = tuple(
            _network(
                run_files.model_of_cell(study, alone.digest), alone.document, cell.action_range
            )
            for alone in cell.fresh
        )
        models = tuple(kept.visits)
        return StreamSubject(name, report, plan, visits, initial, fresh, updates, models)
    return _subject(
        name,
        _model_of_cell(study, path.stem, cell),
        cell.spec,
        None if parse_uses(cell.uses)[0] == "reference" else cell.action_range,
        plan=plan,
        log=result.log if cell.spec.team is None else None,
        updates=updates,
    )


def cell_path(study: Path, key: str) -> Path:
    """The result of a finished cell of a study, by its key."""
    results = sorted((study / "cells").glob("*.json"))
    if not results:
        raise OptionError(
            f"run={str(study)!r}: no study with finished cells. Give a folder of `sme study run`, "
            "or omit --cell for a run."
        )
    digits = key.removeprefix("sha256:").lower()
    matches = [path for path in results if path.stem.startswith(digits)]
    if len(matches) != 1 or len(digits) < _MIN_DIGITS:
        raise UnknownNameError(
            f"cell={key!r}: matches {len(matches)} of {len(results)} finished cells. Give "
            f"{_MIN_DIGITS} or more digits that match only one, such as {_example_key(study)}."
        )
    return matches[0]


def _example_key(study: Path) -> str:
    path = min((study / "cells").glob("*.json"), default=None)
    return path.stem[:12] if path else "KEY"


def _subject(
    name: str | None, model: Any, spec: SMESpec, action_range: str | None, **known: Any
) -> Subject:
    """A model on a task, by default under the policy's own name."""
    if spec.team is not None:
        team = as_policy(model, spec, action_range=action_range)
        return Subject(name or team.name, spec, team, **known)
    policy = numpy_policy(model, spec, action_range=action_range)
    explore, model = exploration(model, policy), OfflineAgent.of(model) or model
    return Subject(name or policy.name, spec, policy, explore=explore, model=model, **known)


def _networks(
    kept: run_files.Snapshots, stream: StreamSpec, action_range: str
) -> tuple[Networks, Perceptron | None]:
    """The networks at the ends of a life's visits, and the one before training."""
    visits = tuple(_network(path, stream, action_range) for path in kept.visits)
    return visits, _network(kept.initial, stream, action_range)


def _network(path: Path, document: SMESpec | StreamSpec, action_range: str) -> Perceptron | None:
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


def _model_of_cell(study: Path, stem: str, cell: Cell) -> Any:
    kind, name = parse_uses(cell.uses)
    if kind == "reference":
        return reference_policy(name, cell.spec)
    path = run_files.model_of_cell(study, stem)
    if not path.exists():
        raise OptionError(
            f"cell={stem[:12]!r}: its model was not kept. Finished cells are not run again, so run "
            "the study in a new folder, with --keep-models."
        )
    return load_sb3(path)


def _report_of_life(folder: Path) -> StreamReport:
    if not (folder / STREAM).exists():
        raise OptionError(
            f"run={str(folder)!r}: contains no {STREAM} yet. A life in a stream is diagnosed when "
            "it has ended. Continue it with `sme train … --resume`."
        )
    return StreamReport.read(folder / STREAM)


def _with_fresh(result: FinishedCell, path: Path) -> StreamReport:
    """The report of a cell's life, with the fresh agents of its phases once all have finished."""
    report = result.report
    assert isinstance(report, StreamReport)
    paths = [path.with_stem(fresh.digest.removeprefix("sha256:")) for fresh in result.cell.fresh]
    if not paths or not all(other.exists() for other in paths):
        return report
    fresh = [read_cell(other) for other in paths]
    regrets = [agent.online_regret for agent in fresh if agent.online_regret is not None]
    known = report.dynamic_regret is not None and len(regrets) == len(fresh)
    return report.with_fresh([agent.report for agent in fresh], regrets if known else None)


class FinishedCell(NamedTuple):
    cell: Cell
    report: EvaluationReport | StreamReport
    log: Log | None
    online_regret: float | None  # None where nothing was learned


def read_cell(path: Path) -> FinishedCell:
    """The result of a cell, in the file of a study."""
    result = read_json(path)
    try:
        cell = Cell.from_dict(result["cell"], str(path))
        report: EvaluationReport | StreamReport
        if cell.stream is None:
            report = EvaluationReport.from_dict(result["report"], str(path))
        else:
            report = StreamReport.from_dict(result["stream_report"], str(path))
        step, regret = (np.array(result["curve"][name], float) for name in ("steps", "regret"))
        log = Log("evaluations", step, regret) if len(step) else None
        return FinishedCell(cell, report, log, result.get("online_regret"))
    except SpecError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise OptionError(
            f"{path}: not the result of a cell ({type(error).__name__}: {error}). Delete it and "
            "run the study again."
        ) from None


def _log_of_episodes(path: Path) -> Log | None:
    rows = run_files.read_episodes(path)
    if not rows:
        return None
    step, regret, ended = np.array([(e.step, e.regret, e.terminated) for e in rows], float).T
    return Log("episodes", step, regret, (regret >= 1.0).astype(float), ended)


def _updates(
    uses: str, hyperparameters: Mapping[str, Any], steps: int, num_envs: int = 1
) -> int | None:
    """How often an algorithm updated its networks; None where its hyperparameters do not tell.

    An on-policy algorithm does so after each rollout, another one every `train_freq` steps after
    `learning_starts`.
    """
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

"""`Subject`: what to diagnose, loaded from a run's folder, from a cell of a study, or a policy.

A run is a folder of `sme train`. A cell is named by the study's folder and by its key: its digest,
or as many of the first digits as only one cell has. The study must have kept the cell's model.

Of a life in a stream, the `StreamReport` says what the agent retains and what its life cost. Its
networks are those of the models at the ends of the visits. In a study the fresh agents are cells
of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import JsonValue

from sme_registry.diagnosis import networks
from sme_registry.envs.types import Observation
from sme_registry.errors import OptionError, SMEError, SpecError, UnknownNameError
from sme_registry.evaluation import (
    EvaluationReport,
    Policy,
    StreamReport,
    TeamPolicy,
    as_policy,
    load_sb3,
)
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.references import reference_policy
from sme_registry.io import read_json
from sme_registry.plots.streams import FILE
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import INDEPENDENT, Cell, in_jax
from sme_registry.task.draw import Array
from sme_registry.training import Episode, RunRecord
from sme_registry.training import record as run_files
from sme_registry.training.algorithms import find
from sme_registry.training.hyperparameters import parameters_of
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import CHECKPOINT, MODEL

__all__ = [
    "AnySubject",
    "Log",
    "StreamSubject",
    "Subject",
    "cell_path",
    "load_cell",
    "load_policy",
    "load_run",
]

_MIN_DIGITS = 6
Networks = tuple[Perceptron | None, ...]  # None: of an unknown kind


@dataclass(frozen=True, eq=False)
class Log:
    """The regret of a training over its steps, `[N]` each; None in a log of evaluations."""

    source: Literal["episodes", "evaluations"]
    step: Array  # environment steps
    regret: Array  # mean regret of an episode, or of an evaluation
    unrewarded: Array | None = None  # which episodes had no reward at all
    terminated: Array | None = None  # which episodes D terminated


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


@dataclass(frozen=True, eq=False)
class StreamSubject:
    """A life in a stream and what is known about it."""

    name: str  # of the run
    report: StreamReport  # with the dynamic regret and fresh agents where these are known
    plan: dict[str, JsonValue] = field(default_factory=dict)
    networks: Networks | None = None  # at the end of each visit; None if they are unknown
    initial_network: Perceptron | None = None  # before training
    fresh_networks: Networks | None = None  # of the fresh agent of each phase
    updates: int | None = None


AnySubject: TypeAlias = Subject | StreamSubject


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
    if spec.team is not None:
        if log is not None:
            raise OptionError("log: of a team is not used. Leave it out.")
        team = as_policy(policy, spec, action_range=action_range)
        return Subject(name or team.name, spec, team)
    if isinstance(policy, str | Path) and str(policy).endswith(".zip"):
        policy, name = load_sb3(policy), name or Path(policy).stem
    act = numpy_policy(policy, spec, action_range=action_range)
    episodes = None if log is None else _log_of(run_files.read_episodes(Path(log)))
    explore = networks.exploration(policy, act)
    return Subject(name or act.name, spec, act, log=episodes, explore=explore)


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
    record = RunRecord.read(folder)
    if record is None:
        advice = "Give a folder of `sme train`."
        if (folder / "cells").is_dir():
            advice = f"This is the folder of a study. Add a cell: --cell {_example_key(folder)}."
        raise OptionError(f"run={str(folder)!r}: contains no run.json. {advice}")
    name = folder.name or str(folder)
    fields = ("algorithm", "hyperparameters", "seed", "action_range", "num_envs", "steps")
    plan = {field: getattr(record, field) for field in fields}
    if record.stream is not None:
        return _life_of_run(folder, name, record, plan)
    path, checkpoint_step = _model_of_run(folder, record)
    steps = record.steps_done if checkpoint_step is None else checkpoint_step
    updates = _updates(record.algorithm, record.hyperparameters, steps, record.num_envs)
    spec, action_range = record.spec.named(record.task), record.action_range
    if spec.team is not None:
        team = as_policy(str(path), spec, action_range=action_range)
        return Subject(name, spec, team, plan, checkpoint_step=checkpoint_step, updates=updates)
    model = load_sb3(path)
    policy = numpy_policy(model, record.spec, action_range=action_range)
    log = _episode_log(folder / run_files.EPISODES)
    explore = networks.exploration(model, policy)
    return Subject(name, spec, policy, plan, log, explore, checkpoint_step, updates)


def _model_of_run(folder: Path, record: RunRecord) -> tuple[Path, int | None]:
    """The model of a run; of an unfinished run its checkpoint, and the steps at it."""
    path = folder / record.model_name
    if path.exists():
        return path, None
    if record.independent or in_jax(record.algorithm):
        agents = "independent agents" if record.independent else "agents in JAX"
        raise OptionError(
            f"run={str(folder)!r}: {agents} are diagnosed when their training has ended. Continue "
            "it with `sme train … --resume`."
        )
    path = folder / CHECKPOINT
    if not path.exists():
        raise OptionError(
            f"run={str(folder)!r}: has neither {MODEL} nor {CHECKPOINT} yet. Wait for its "
            "first checkpoint, or continue it with `sme train … --resume`."
        )
    return path, record.steps_done


def load_cell(study: str | Path, key: str) -> AnySubject:
    """A finished cell of a study that kept its model; a life in a stream also without its models.

    `key` is the cell's digest, with or without `sha256:`, or its first digits.

    Examples:
      >>> from sme_registry.diagnosis import load_cell
      >>> from sme_registry.studies import study_status
      >>> cells = study_status("study").cells
      >>> key = next(cell.key for cell in cells if cell.planned.algorithm == "PPO")
      >>> load_cell("study", key).plan["algorithm"]
      'PPO'
    """
    study = Path(study)
    path = cell_path(study, key)
    cell, log = _read_cell(path)
    if cell.uses.startswith(INDEPENDENT):
        raise OptionError(
            f"cell={path.stem[:12]!r}: has a model for each agent. Train it with `sme train "
            "--independent`, and diagnose that run."
        )
    fields = ("hyperparameters", "seed", "action_range", "steps")
    plan = {"algorithm": cell.uses, **{field: getattr(cell, field) for field in fields}}
    name = f"{cell.uses}, cell {path.stem[:12]}"
    updates = _updates(cell.uses, cell.hyperparameters, cell.steps)
    if cell.stream is not None:
        return _life_in_cell(study, name, path, cell, plan, updates)
    model = _cell_model(study, path.stem, cell)
    reference = callable(model) or isinstance(model, dict)
    action_range = None if reference else cell.action_range
    if cell.spec.team is not None:
        team = as_policy(model, cell.spec, action_range=action_range)
        return Subject(name, cell.spec, team, plan, updates=updates)
    policy = numpy_policy(model, cell.spec, action_range=action_range)
    explore = networks.exploration(model, policy)
    return Subject(name, cell.spec, policy, plan, log, explore, updates=updates)


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


def _updates(
    uses: str, hyperparameters: Mapping[str, Any], steps: int, num_envs: int = 1
) -> int | None:
    """How often an algorithm of Stable-Baselines3, or the same in JAX, updated its networks.

    An on-policy algorithm does so after each rollout, another one every `train_freq` steps after
    `learning_starts`. None of an algorithm without these hyperparameters.
    """
    name = uses.removeprefix(INDEPENDENT).removeprefix("jax:")
    if ":" in name:  # a reference, a learner of offline data or somebody's module
        return None
    try:
        parameters = parameters_of(find(name).load())
    except SMEError:  # it is not installed here
        return None
    settings = {name: parameter.default for name, parameter in parameters.items()}
    settings |= hyperparameters
    every, starts = settings.get("train_freq"), settings.get("learning_starts")
    if isinstance(every, int) and isinstance(starts, int):
        return max(0, steps - starts) // (every * num_envs)
    if isinstance(rollout := settings.get("n_steps"), int):
        return steps // (rollout * num_envs)
    return None


def _read_cell(path: Path) -> tuple[Cell, Log | None]:
    data = read_json(path)
    try:
        cell, curve = Cell.from_dict(data["cell"], str(path)), data["curve"]
        step, regret = np.array(curve["steps"], float), np.array(curve["regret"], float)
    except SpecError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise OptionError(
            f"{path}: not the result of a cell ({type(error).__name__}: {error}). Delete it and "
            "run the study again."
        ) from None
    return cell, Log("evaluations", step, regret) if len(step) else None


def _cell_model(study: Path, stem: str, cell: Cell) -> Any:
    if cell.uses.startswith("reference:"):
        return reference_policy(cell.uses.partition(":")[2], cell.spec)
    path = run_files.model_of_cell(study, stem)
    if not path.exists():
        raise OptionError(
            f"cell={stem[:12]!r}: its model was not kept. Finished cells are not run again, so run "
            "the study in a new folder, with --keep-models."
        )
    return load_sb3(path)


def _example_key(study: Path) -> str:
    path = next(iter(sorted((study / "cells").glob("*.json"))), None)
    return path.stem[:12] if path else "KEY"


def _episode_log(path: Path) -> Log | None:
    return _log_of(run_files.read_episodes(path)) if path.exists() else None


def _log_of(rows: list[Episode]) -> Log | None:
    if not rows:
        return None
    step, regret, ended = np.array([(e.step, e.regret, e.terminated) for e in rows], float).T
    return Log("episodes", step, regret, (regret >= 1.0).astype(float), ended)


def _life_of_run(folder: Path, name: str, record: RunRecord, plan: dict[str, Any]) -> StreamSubject:
    """The life of a run of `sme train`."""
    assert record.stream is not None  # of a life
    kept = run_files.Snapshots(folder / run_files.SNAPSHOTS, record.stream)
    path = folder / FILE
    if not path.exists():
        raise OptionError(
            f"run={str(folder)!r}: contains no {FILE} yet. A life in a stream is diagnosed when it "
            "has ended. Continue it with `sme train … --resume`."
        )
    missing = [file.name for file in (kept.initial, *kept.visits) if not file.exists()]
    if missing:
        raise OptionError(
            f"run={str(folder)!r}: {run_files.SNAPSHOTS}/ lacks {missing[0]}. Copy the whole "
            "folder of the run, or train it again with --force."
        )
    report = StreamReport.read(path)
    if report.stream_digest != record.stream_digest:
        raise OptionError(
            f"{path}: is about the stream {report.stream_digest[:19]}…, but run.json is about "
            f"{record.stream_digest[:19]}…. Train the run again with --force."
        )
    stream, action_range = record.stream, record.action_range
    initial, *visits = _networks([kept.initial, *kept.visits], stream, action_range)
    updates = _updates(record.algorithm, record.hyperparameters, record.steps_done, record.num_envs)
    return StreamSubject(name, report, plan, tuple(visits), initial, updates=updates)


def _life_in_cell(
    study: Path,
    name: str,
    path: Path,
    cell: Cell,
    plan: dict[str, Any],
    updates: int | None,
) -> StreamSubject:
    """The life of a cell of a study, with its fresh agents where all have finished."""
    assert cell.stream is not None  # of a life
    report = _report(read_json(path), path)
    assert isinstance(report, StreamReport)
    fresh = [path.with_stem(_stem(other)) for other in cell.fresh]
    if fresh and all(result.exists() for result in fresh):
        report = _with_fresh(report, fresh)
    kept = run_files.Snapshots(run_files.folder_of_cell(study, path.stem), cell.stream)
    of_visits = _kept(kept.visits, cell.stream, cell.action_range)
    initial = _kept([kept.initial], cell.stream, cell.action_range)
    alone = [
        _kept([run_files.model_of_cell(study, other.digest)], other.document, cell.action_range)
        for other in cell.fresh
    ]
    return StreamSubject(
        name,
        report,
        plan,
        of_visits,
        initial[0] if initial else None,
        tuple(networks[0] for networks in alone if networks) if alone and all(alone) else None,
        updates,
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
    return tuple(policy.act if isinstance(policy.act, Perceptron) else None for policy in policies)

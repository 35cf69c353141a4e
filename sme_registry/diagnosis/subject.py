"""`Subject`: a policy to diagnose, loaded from a run's folder or from a cell of a study.

A run is a folder of `sme train`. A cell is named by the study's folder and by its key: its digest,
or as many of the first digits as only one cell has. The study must have kept the cell's model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import JsonValue

from sme_registry.diagnosis import networks
from sme_registry.diagnosis.stream_subject import StreamSubject, life_in_cell, life_of_run
from sme_registry.envs.types import Observation
from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.evaluation import Policy, TeamPolicy, as_policy, load_sb3
from sme_registry.io import read_json
from sme_registry.spec import SMESpec
from sme_registry.spec.study import INDEPENDENT, Cell, in_jax
from sme_registry.task.draw import Array
from sme_registry.training import RunRecord, lives
from sme_registry.training import episodes as episode_files
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import CHECKPOINT, MODEL

__all__ = [
    "AnySubject",
    "Log",
    "Subject",
    "TeamSubject",
    "cell_path",
    "load_cell",
    "load_policy",
    "load_run",
]

_MIN_DIGITS = 6


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
    """A policy and what is known about its training."""

    name: str  # of the run or policy
    spec: SMESpec  # of a single agent
    policy: Policy  # from observations `[B, O]` to actions `[B, A]` in the unit range, unclipped
    plan: dict[str, JsonValue]  # algorithm, seed, steps and so on; empty without a run
    log: Log | None = None
    explore: Callable[[Observation], Any] | None = None  # the algorithm's stochastic actions
    checkpoint_step: int | None = None  # of an unfinished run, the steps at its checkpoint


@dataclass(frozen=True, eq=False)
class TeamSubject:
    """The policies of a team's agents; the fields of `Subject`."""

    name: str
    spec: SMESpec  # of a team
    policy: TeamPolicy
    plan: dict[str, JsonValue]
    checkpoint_step: int | None = None


AnySubject: TypeAlias = Subject | TeamSubject | StreamSubject


def load_policy(
    policy: Any,
    spec: SMESpec,
    *,
    action_range: str | None = None,
    name: str | None = None,
    log: str | Path | None = None,
) -> Subject | TeamSubject:
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
        team = _team_policy(policy, spec, action_range)
        return TeamSubject(name or team.name, spec, team, {})
    if isinstance(policy, str | Path) and str(policy).endswith(".zip"):
        policy, name = load_sb3(policy), name or Path(policy).stem
    act = numpy_policy(policy, spec, action_range=action_range)
    episodes = None if log is None else _log_of(episode_files.read_episodes(Path(log)))
    explore = networks.exploration(policy, act)
    return Subject(name or act.name, spec, act, {}, episodes, explore)


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
        return life_of_run(folder, name, record, plan)
    path, checkpoint_step = folder / record.model_name, None
    if (record.independent or in_jax(record.algorithm)) and not path.exists():
        agents = "independent agents" if record.independent else "agents in JAX"
        raise OptionError(
            f"run={str(folder)!r}: {agents} are diagnosed when their training has ended. Continue "
            "it with `sme train … --resume`."
        )
    if not path.exists():
        path, checkpoint_step = folder / CHECKPOINT, record.steps_done
    if not path.exists():
        raise OptionError(
            f"run={str(folder)!r}: has neither {MODEL} nor {CHECKPOINT} yet. Wait for its "
            "first checkpoint, or continue it with `sme train … --resume`."
        )
    spec = record.spec.named(record.task)
    if spec.team is not None:
        team = _team_policy(str(path), spec, record.action_range)
        return TeamSubject(name, spec, team, plan, checkpoint_step)
    model = load_sb3(path)
    policy = numpy_policy(model, record.spec, action_range=record.action_range)
    return Subject(
        name,
        spec,
        policy,
        plan,
        _episode_log(folder / episode_files.FILE),
        networks.exploration(model, policy),
        checkpoint_step,
    )


def _team_policy(policy: Any, spec: SMESpec, action_range: str | None) -> TeamPolicy:
    team = as_policy(policy, spec, action_range=action_range)
    assert isinstance(team, TeamPolicy)  # of a team's spec
    return team


def load_cell(study: str | Path, key: str) -> AnySubject:
    """A finished cell of a study that kept its model; a life in a stream also without its models.

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
    if cell.stream is not None:
        return life_in_cell(study, name, path, cell, plan)
    model = _cell_model(study, path.stem, cell)
    reference = callable(model) or isinstance(model, dict)
    action_range = None if reference else cell.action_range
    if cell.spec.team is not None:
        return TeamSubject(name, cell.spec, _team_policy(model, cell.spec, action_range), plan)
    policy = numpy_policy(model, cell.spec, action_range=action_range)
    return Subject(name, cell.spec, policy, plan, log, networks.exploration(model, policy))


def cell_path(study: Path, key: str) -> Path:
    """The result of a finished cell of a study; `load_cell` has the arguments and errors."""
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
        from sme_registry.evaluation.references import reference_policy

        return reference_policy(cell.uses.partition(":")[2], cell.spec)
    path = lives.model_of_cell(study, stem)
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
    return _log_of(episode_files.read_episodes(path)) if path.exists() else None


def _log_of(rows: list[episode_files.Episode]) -> Log | None:
    if not rows:
        return None
    step, regret, ended = np.array([(e.step, e.regret, e.terminated) for e in rows], float).T
    return Log("episodes", step, regret, (regret >= 1.0).astype(float), ended)

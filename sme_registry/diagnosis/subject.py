"""`Subject`: what is diagnosed, read from where it lies: a run's folder, or a study's cell.

A run is a folder that `sme train` wrote. A study's cell is STUDY and the key of the cell (its
digest, or as many of its first digits as only one cell has), whose model was kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import JsonValue

from sme_registry.envs.shared import Observation
from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.evaluation import Policy, load_sb3
from sme_registry.io import read_json
from sme_registry.spec import SMESpec
from sme_registry.spec.study import Cell
from sme_registry.task.draw import Array
from sme_registry.training import RunRecord, checkpoint
from sme_registry.training import episodes as episode_files
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.run import MODEL

_FEWEST_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Log:
    """A training's regret over its steps, `[N]` each.

    Attributes:
      source: "episodes" or "evaluations".
      step: environment steps.
      regret: mean regret of an episode, or of an evaluation.
      unpaid: which episodes had no reward at all; None where rows are evaluations.
      terminated: which episodes D ended; None likewise.
    """

    source: Literal["episodes", "evaluations"]
    step: Array
    regret: Array
    unpaid: Array | None = None
    terminated: Array | None = None


@dataclass(frozen=True, eq=False)
class Subject:
    """A policy and what is known of how it came to be.

    Attributes:
      name: what it is called.
      spec: the task, of a single agent.
      policy: from observations `[B, S + 2]` to actions `[B, A]` of the unit range, unclipped.
      plan: algorithm, seed, steps and so on; empty for a bare policy.
      log: of its training; None where there is none.
      explore: what the algorithm would try at observations, at random; None where not known.
      note: what is special about it.
    """

    name: str
    spec: SMESpec
    policy: Policy
    plan: dict[str, JsonValue]
    log: Log | None = None
    explore: Callable[[Observation], Any] | None = None
    note: str = ""


def of_policy(
    policy: Any, spec: SMESpec, *, action_range: str | None = None, name: str | None = None
) -> Subject:
    """A policy in any form that `evaluate` takes, and the task it is for.

    Raises:
      SpecError: the task is a team's.
      PolicyError, OptionError, MissingDependencyError: see `as_policy`.
    """
    _refuse_teams(spec)
    model = policy
    if isinstance(policy, str | Path) and str(policy).endswith(".zip"):
        model, name = load_sb3(policy), name or Path(policy).stem
    found = numpy_policy(model, spec, action_range=action_range)
    name = name or found.name
    return Subject(name, spec, found, {}, explore=_explorer(model, found))


def of_run(folder: str | Path) -> Subject:
    """A run that `sme train` wrote, finished or not.

    Raises:
      OptionError: no run is there, or it has neither a model nor a checkpoint yet.
      MalformedDocumentError, SpecError: run.json is damaged; or the task is a team's.
      PolicyError, MissingDependencyError: its model cannot be loaded.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise OptionError(f"run={str(folder)!r}: there is no such folder. Give one of `sme train`.")
    record = RunRecord.read(folder)
    if record is None:
        hint = "Give the folder that `sme train` wrote."
        if (folder / "cells").is_dir():
            hint = f"It is a study's: say which cell, as in --cell {_example(folder)}."
        raise OptionError(f"run={str(folder)!r}: holds no run.json. {hint}")
    _refuse_teams(record.spec)
    path, note = folder / MODEL, ""
    if not path.exists():
        path = folder / checkpoint.FILE
        if not path.exists():
            raise OptionError(
                f"run={str(folder)!r}: has neither {MODEL} nor {checkpoint.FILE} yet. Let it train "
                "up to its first checkpoint, or go on with `sme train … --resume`."
            )
        note = f"The run is not finished: this is its checkpoint after {record.steps_done:,} steps."
    model = load_sb3(path)
    policy = numpy_policy(model, record.spec, action_range=record.action_range)
    fields = ("algorithm", "hyperparameters", "seed", "action_range", "num_envs", "steps")
    return Subject(
        folder.name or str(folder),
        record.spec,
        policy,
        {field: getattr(record, field) for field in fields},
        _episodes(folder / episode_files.FILE),
        _explorer(model, policy),
        note,
    )


def of_cell(study: str | Path, key: str) -> Subject:
    """A finished cell of a study, whose model was kept.

    Args:
      study: the study's folder.
      key: the cell's digest, with or without `sha256:`, or its first digits.

    Raises:
      OptionError: no study is there, or the cell's model was not kept.
      UnknownNameError: no finished cell, or more than one, has such a key.
      MalformedDocumentError, SpecError: its result is damaged.
      PolicyError, MissingDependencyError: its model cannot be loaded.
    """
    study, digits = Path(study), key.removeprefix("sha256:").lower()
    results = sorted((study / "cells").glob("*.json"))
    if not results:
        raise OptionError(
            f"run={str(study)!r}: is no study with finished cells. Give the folder of "
            "`sme study run`, or a run's without --cell."
        )
    found = [path for path in results if path.stem.startswith(digits)]
    if len(found) != 1 or len(digits) < _FEWEST_DIGITS:
        raise UnknownNameError(
            f"cell={key!r}: {len(found)} of {len(results)} finished cells have such a key. Give "
            f"{_FEWEST_DIGITS} or more digits that only one has, as in {_example(study)}."
        )
    data = read_json(found[0])
    try:
        cell, curve = Cell.from_dict(data["cell"], str(found[0])), data["curve"]
        step, regret = np.array(curve["steps"], float), np.array(curve["regret"], float)
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, SpecError):
            raise
        raise OptionError(
            f"{found[0]}: is no result of a cell ({type(error).__name__}: {error}). Remove it and "
            "run the study again."
        ) from None
    plan: dict[str, JsonValue] = {
        "algorithm": cell.uses,
        "hyperparameters": cell.hyperparameters,
        "seed": cell.seed,
        "action_range": cell.action_range,
        "steps": cell.steps,
    }
    name = f"{cell.uses}, cell {found[0].stem[:12]}"
    if cell.uses.startswith("reference:"):
        from sme_registry.evaluation.references import reference_policy

        model = reference_policy(cell.uses.partition(":")[2], cell.spec)
    else:
        path = study / "models" / f"{found[0].stem}.zip"
        if not path.exists():
            raise OptionError(
                f"cell={key!r}: its model was not kept. What has finished is not run again: run "
                "the study in a new folder, with --keep-models."
            )
        model = load_sb3(path)
    policy = numpy_policy(
        model, cell.spec, action_range=None if callable(model) else cell.action_range
    )
    log = Log("evaluations", step, regret) if len(step) else None
    return Subject(name, cell.spec, policy, plan, log, _explorer(model, policy))


def _refuse_teams(spec: SMESpec) -> None:
    if spec.team is not None:
        raise SpecError(
            f"team: a diagnosis is of one agent, and this task is for {len(spec.team.agents)}. "
            "`sme evaluate` judges each agent of a team."
        )


def _example(study: Path) -> str:
    path = next(iter(sorted((study / "cells").glob("*.json"))), None)
    return path.stem[:12] if path else "KEY"


def _episodes(path: Path) -> Log | None:
    rows = episode_files.read_episodes(path) if path.exists() else []
    if not rows:
        return None
    step, regret, ended = np.array([(e.step, e.regret, e.terminated) for e in rows], float).T
    return Log("episodes", step, regret, (regret >= 1.0).astype(float), ended)


def _explorer(model: Any, policy: Policy) -> Callable[[Observation], Any] | None:
    if not hasattr(model, "predict") or not hasattr(model, "get_env"):
        return None
    from sme_registry.diagnosis.networks import explorer

    return explorer(model, policy)

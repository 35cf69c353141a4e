"""`load_cell`: a finished cell of a study, to be diagnosed or explored.

The fresh agents of a life in a stream are cells of their own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.diagnosis.behaviour import Log
from sme_registry.diagnosis.subject import (
    AnySubject,
    StreamSubject,
    network_of,
    networks_of,
    subject_of,
    updates_of,
)
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation.models import load_sb3
from sme_registry.evaluation.references import reference_policy
from sme_registry.spec.study import Cell
from sme_registry.studies.ledger import CELLS, Ledger
from sme_registry.studies.result import CellResult, LearningCurve, report_of_life
from sme_registry.training.algorithms import parse_uses
from sme_registry.training.record import Snapshots

_MIN_DIGITS, _SHOWN_DIGITS = 6, 12


def load_cell(study: str | Path, key: str) -> AnySubject:
    """A finished cell of a study that kept its model; a life in a stream also without its models.

    `key` is the cell's digest, with or without `sha256:`, or its first digits.
    """
    result = find_result(study, key)
    cell, ledger = result.cell, Ledger(study)
    short = result.key.removeprefix("sha256:")[:_SHOWN_DIGITS]
    if parse_uses(cell.uses)[0] == "independent":
        raise OptionError(
            f"cell={short!r}: has a model for each agent. Train it with `sme train --independent`, "
            "and diagnose that run."
        )
    fields = ("hyperparameters", "seed", "action_range", "steps")
    known: dict[str, Any] = {
        "plan": {"algorithm": cell.uses, **{field: getattr(cell, field) for field in fields}},
        "updates": updates_of(cell.uses, cell.hyperparameters, cell.steps),
    }
    name = f"{cell.uses}, cell {short}"
    if cell.stream is not None:
        return _life(name, result, ledger, known)
    if cell.spec.team is None:
        known["log"] = _log(result.curve)
    is_reference = parse_uses(cell.uses)[0] == "reference"
    action_range = None if is_reference else cell.action_range
    return subject_of(name, _model(cell, ledger, short), cell.spec, action_range, **known)


def find_result(study: str | Path, key: str) -> CellResult:
    """The result of a finished cell of a study, by its key or the first digits of it."""
    results = sorted((Path(study) / CELLS).glob("*.json"))
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
            f"{_MIN_DIGITS} or more digits that match only one, such as "
            f"{results[0].stem[:_SHOWN_DIGITS]}."
        )
    return CellResult.read(matches[0])


def _life(name: str, result: CellResult, ledger: Ledger, known: dict[str, Any]) -> StreamSubject:
    """A life, with its fresh agents once all of them have finished."""
    cell = result.cell
    assert cell.stream is not None
    kept = Snapshots(ledger.snapshots_path(result.key), cell.stream)
    networks, initial = networks_of(kept, cell.stream, cell.action_range)
    return StreamSubject(
        name,
        report_of_life(result, ledger.results(agent.digest for agent in cell.fresh)),
        networks=networks,
        initial_network=initial,
        fresh_networks=tuple(
            network_of(ledger.model_path(agent.digest), agent.document, cell.action_range)
            for agent in cell.fresh
        ),
        models=tuple(kept.visits),
        **known,
    )


def _log(curve: LearningCurve) -> Log | None:
    step, regret = (np.array(column, float) for column in (curve.steps, curve.regret))
    return Log("evaluations", step, regret) if len(step) else None


def _model(cell: Cell, ledger: Ledger, short: str) -> Any:
    kind, name = parse_uses(cell.uses)
    if kind == "reference":
        return reference_policy(name, cell.spec)
    path = ledger.model_path(cell.digest)
    if not path.exists():
        raise OptionError(
            f"cell={short!r}: its model was not kept. Finished cells are not run again, so run "
            "the study in a new folder, with --keep-models."
        )
    return load_sb3(path)

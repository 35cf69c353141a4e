"""Runs to submit: folders of `sme train`, folders of `sme study run`, or a table, `runs.json`.

    [{"spec": "SME/Default-v1", "policy": "seed0.onnx", "steps": 100000, "seed": 0}, …]

`spec` is an id, a digest or a path. `policy` is an .onnx, a Stable-Baselines3 .zip, or null if the
run failed. Paths in a table are relative to it. A failed cell of a study is a failed run.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from leaderboard.errors import Rejection
from sme_registry import SMESpec, load
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.io import read_json, to_json
from sme_registry.spec import SuiteFile
from sme_registry.spec.document import Integer, StrictModel
from sme_registry.training import RunRecord, model_of_cell

if TYPE_CHECKING:
    from sme_registry.studies import CellStatus

_RECORD, _MODEL, _PLAN = "run.json", "model.zip", "plan.json"
_INDEPENDENT = (
    "has a model for each agent. A board takes one policy for each run, which all agents of a team "
    "share. Train a shared one."
)
_RANGES = {"unit": "[0, 1]", "symmetric": "[-1, 1]"}


@dataclass(frozen=True)
class Provenance:
    """How a run was trained, as its record says.

    Attributes:
      versions: of the packages that the policy depends on.
      settings: algorithm, hyperparameters, action range and number of environments, for people.
      seconds: the training took.
    """

    versions: dict[str, str]
    settings: str
    seconds: float


@dataclass(frozen=True)
class SubmittedRun:
    """A run to submit."""

    source: str  # its name in errors
    spec: SMESpec
    seed: int
    steps: int
    policy: Path | None  # an .onnx or a .zip; None if the run failed
    provenance: Provenance | None = None


def runs_of(path: Path, suite: SuiteFile, algorithm: str | None = None) -> list[SubmittedRun]:
    """The runs of a folder or a table.

    Args:
      path: of the folder or table.
      suite: the suite of the runs.
      algorithm: in a study, or a folder of several runs, only this algorithm's.

    Raises:
      OptionError: the path is neither, a run is not finished, or a study's algorithm is unclear.
      SpecError: a table or record is invalid.
    """
    if (path / _PLAN).is_file():
        return _cells(path, algorithm)
    if path.is_dir():
        folders = sorted(record.parent for record in path.rglob(_RECORD))
        records = [(folder, RunRecord.read(folder)) for folder in folders]
        if records:
            return [
                _trained(folder, record)
                for folder, record in records
                if record is None or algorithm is None or _same(record.algorithm, algorithm)
            ]
    elif path.suffix == ".json" and path.is_file():
        return _table(path, suite)
    raise OptionError(
        f"runs={str(path)!r}: must be a folder of `sme train` or `sme study run`, a folder that "
        "contains such folders, or a table of runs (.json). Correct the path."
    )


def _same(name: str, wanted: str) -> bool:
    return name.casefold() == wanted.casefold()


def refuse_other_specs(listed: list[SubmittedRun], suite: SuiteFile) -> None:
    """Raise if a run's spec is not an instance of the suite, and name such runs."""
    known = {spec.digest for spec in suite.suite.instances}
    unknown = [
        f"{run.source} ({run.spec.content_name})" for run in listed if run.spec.digest not in known
    ]
    if unknown:
        more = f" and {len(unknown) - 5} more" if len(unknown) > 5 else ""
        raise Rejection(
            "unknown_spec",
            f"runs: {', '.join(unknown[:5])}{more}: must be on one of the {len(known)} instances "
            f"of {suite.versioned_name} (`sme show {suite.name}`). Leave them out, or name their "
            "suite.",
        )


def listed_by_class(listed: list[SubmittedRun], suite: SuiteFile) -> dict[str, int]:
    """Number of listed runs of each class."""
    digests = Counter(run.spec.digest for run in listed)
    return {
        member.name: sum(digests[spec.digest] for spec in member.instances)
        for member in suite.suite.classes
    }


class _Row(StrictModel):
    """One run of a table."""

    spec: str
    policy: str | None
    steps: Integer
    seed: Integer


def _trained(folder: Path, record: RunRecord | None) -> SubmittedRun:
    if record is not None and record.independent:
        raise OptionError(f"{folder}: {_INDEPENDENT}")
    if record is None or record.status != "finished" or not (folder / _MODEL).is_file():
        raise OptionError(
            f"{folder}: contains an unfinished run. Resume it (`sme train --resume`), or list it "
            "in a table with policy null, which scores 1."
        )
    changes = ", ".join(f"{k}={v}" for k, v in sorted(record.hyperparameters.items()))
    settings = (
        f"{record.algorithm}, defaults{changes and f', but {changes}'}; actions in "
        f"{_RANGES[record.action_range]}; num_envs={record.num_envs}"
    )
    provenance = Provenance(record.versions, settings, record.wall_seconds)
    return SubmittedRun(
        str(folder), record.spec, record.seed, record.steps_done, folder / _MODEL, provenance
    )


def _cells(study: Path, algorithm: str | None) -> list[SubmittedRun]:
    """The cells of one algorithm of a study; failed ones have no policy."""
    cells = _chosen(study, algorithm)
    unfinished = sum(cell.state not in ("done", "failed") for cell in cells)
    if unfinished:
        raise OptionError(
            f"runs={str(study)!r}: {unfinished} of {len(cells)} runs are not finished. Run the "
            "study to its end with `sme study run`; `sme study status` shows its state."
        )
    return [_cell(study, cell) for cell in cells]


def _chosen(study: Path, algorithm: str | None) -> list[CellStatus]:
    """The cells of an algorithm; by default of the only one that ran."""
    from sme_registry.studies import study_status

    # Every cell of the plan counts, also one that no run asked for: leaving it out would select.
    cells = study_status(study, only=()).cells
    ran = [cell for cell in cells if cell.state != "waiting"]
    names = list(dict.fromkeys(cell.planned.algorithm for cell in ran or cells))
    wanted = names[0] if algorithm is None and len(names) == 1 else algorithm or ""
    chosen = [cell for cell in cells if _same(cell.planned.algorithm, wanted)]
    if not chosen:
        raise OptionError(
            f"algorithm={algorithm!r}: the study {study} has runs of {', '.join(names)}, and a "
            f"submission is of one method. Choose one, such as --algorithm {names[0]}."
        )
    return chosen


def _cell(study: Path, status: CellStatus) -> SubmittedRun:
    from sme_registry.studies import CellResult

    planned, cell = status.planned, status.planned.cell
    source = f"{study}, {planned.algorithm} on {planned.class_name}, run {planned.run}"
    if status.state == "failed":
        return SubmittedRun(source, cell.spec, cell.seed, cell.steps, None)
    stem = cell.digest.removeprefix("sha256:")
    policy = model_of_cell(study, cell.digest)
    if not policy.is_file():
        raise OptionError(
            f"{source}: its model was not kept. Run the study in a new folder with --keep-models."
        )
    if cell.uses.startswith("independent:"):
        raise OptionError(f"{source}: {_INDEPENDENT}")
    result = CellResult.from_dict(read_json(study / "cells" / f"{stem}.json"))
    steps = max((cell.steps, *result.curve.steps))  # the last rollout can exceed the plan
    changed = to_json(cell.hyperparameters) if cell.hyperparameters else "default hyperparameters"
    settings = f"{cell.uses}, {changed}; actions in {_RANGES[cell.action_range]}; num_envs=1"
    provenance = Provenance(result.versions, settings, result.timing.total)
    return SubmittedRun(source, cell.spec, cell.seed, steps, policy, provenance)


def _table(path: Path, suite: SuiteFile) -> list[SubmittedRun]:
    rows = read_json(path)
    if not isinstance(rows, list):
        raise SpecError(
            f"{path}: must be a list of runs, each with spec, policy, steps and seed. For a "
            "run of `sme train`, give its folder."
        )
    instances = {spec.digest: spec for spec in suite.suite.instances}
    listed = []
    for index, plain in enumerate(rows):
        source = f"{path}, run {index}"
        row = _Row.from_dict(plain, source)
        policy = None if row.policy is None else path.parent / row.policy
        if policy is not None and policy.suffix not in (".onnx", ".zip"):
            raise SpecError(
                f"{source}: policy={row.policy!r}: must be the path of an .onnx or a "
                "Stable-Baselines3 .zip, or null if the run failed. Correct it."
            )
        try:
            spec = instances.get(row.spec) or load(
                path.parent / row.spec if row.spec.endswith(".json") else row.spec, SMESpec
            )
        except SMEError as error:
            raise SpecError(f"{source}: {error}") from None
        listed.append(SubmittedRun(source, spec, row.seed, row.steps, policy))
    return listed

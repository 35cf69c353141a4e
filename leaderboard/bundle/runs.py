"""Runs to submit: folders that `sme train` wrote, or a table, `runs.json`.

    [{"spec": "SME/Default-v1", "policy": "seed0.onnx", "steps": 100000, "seed": 0}, …]

`spec` is an id, a digest or a path. `policy` is an .onnx, a Stable-Baselines3 .zip, or null if the
run failed. Paths in a table are relative to it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from leaderboard.errors import Rejection
from sme_registry import SMESpec, load
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.io import read_json
from sme_registry.spec import Integer, StrictModel, SuiteFile
from sme_registry.training import RunRecord

_RECORD, _MODEL = "run.json", "model.zip"


@dataclass(frozen=True)
class SubmittedRun:
    """A run to submit."""

    source: str  # its name in errors
    spec: SMESpec
    seed: int
    steps: int
    policy: Path | None  # an .onnx or a .zip; None if the run failed
    record: RunRecord | None = None  # of a run of `sme train`


def runs_of(path: Path, suite: SuiteFile) -> list[SubmittedRun]:
    """The runs of a folder or a table; `OptionError` if the path is neither."""
    if path.is_dir():
        folders = sorted(record.parent for record in path.rglob(_RECORD))
        if folders:
            return [_trained(folder) for folder in folders]
    elif path.suffix == ".json" and path.is_file():
        return _table(path, suite)
    raise OptionError(
        f"runs={str(path)!r}: must be a folder of `sme train`, a folder that contains such "
        "folders, or a table of runs (.json). Correct the path."
    )


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


def _trained(folder: Path) -> SubmittedRun:
    record = RunRecord.read(folder)
    if record is None or record.status != "finished" or not (folder / _MODEL).is_file():
        raise OptionError(
            f"{folder}: contains an unfinished run. Resume it (`sme train --resume`), or list it "
            "in a table with policy null, which scores 1."
        )
    return SubmittedRun(
        str(folder), record.spec, record.seed, record.steps_done, folder / _MODEL, record
    )


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
                path.parent / row.spec if row.spec.endswith(".json") else row.spec
            )
        except SMEError as error:
            raise SpecError(f"{source}: {error}") from None
        listed.append(SubmittedRun(source, spec, row.seed, row.steps, policy))
    return listed

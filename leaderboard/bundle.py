"""`Bundle`: a submission as a folder, and `make_bundle`, which makes one from training runs.

    submission.json             the signed submission
    artefacts/<64 hex>.onnx     each policy that it names, by the SHA-256 of its bytes

Runs are folders of `sme train` or `sme study run`, or stand in a table, `runs.json`:

    [{"spec": "SME/Default-v1", "policy": "seed0.onnx", "steps": 100000, "seed": 0}, …]

`spec` is an id, a digest or a path. `policy` is an .onnx, a Stable-Baselines3 .zip, or null if the
run failed. Paths in a table are relative to it. A failed cell of a study is a failed run.
"""

from __future__ import annotations

import errno
import os
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import MAX_BYTES, NOBODY, Receiver, Signed, SigningKey
from leaderboard.documents.submission import (
    ARTEFACTS,
    FILE,
    MAX_ARTEFACT_BYTES,
    Artefact,
    Description,
    Submission,
    Training,
    check_names,
    check_runs,
)
from leaderboard.errors import Rejection
from leaderboard.gate.sandbox import inspect_own, widths
from sme_registry import SMESpec, load, studies
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.export import onnx_bytes
from sme_registry.io import (
    build_folder,
    check_new,
    open_regular,
    read_json,
    read_regular,
    require_packages,
    sha256_of,
    to_json,
    write_atomically,
)
from sme_registry.spec import SuiteFile
from sme_registry.spec.document import Integer, StrictModel, matching
from sme_registry.training import RunRecord, model_of_cell

Progress = Callable[[int, int], None]

_RECORD, _MODEL, _PLAN = "run.json", "model.zip", "plan.json"
_INDEPENDENT = (
    "has a model for each agent. A board takes one policy for each run, which all agents of a team "
    "share. Train a shared one."
)
_RANGES = {"unit": "[0, 1]", "symmetric": "[-1, 1]"}


@dataclass(frozen=True)
class Bundle:
    """A bundle whose signature is verified: its folder, and the signed submission."""

    folder: Path
    signed: Signed[Submission]

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> Bundle:
        """Read a bundle's submission. Artefacts are read on request."""
        folder = Path(folder)
        text = _read(folder, FILE, MAX_BYTES)
        if text is None:
            raise OptionError(
                f"{folder}: contains no {FILE}. `sme-leaderboard submit --out` writes a bundle."
            )
        return cls(folder, Signed[Submission].read(text))

    def artefact(self, digest: str) -> bytes:
        """The bytes of an artefact of this digest."""
        name = f"{ARTEFACTS}/{hex_of(digest)}.onnx"
        data = _read(self.folder, name, MAX_ARTEFACT_BYTES)
        if data is None:
            raise Rejection(
                "artefact_missing",
                f"{name}: is missing from the bundle. Add it, or recreate the bundle.",
            )
        if sha256_of(data) != digest:
            raise Rejection(
                "artefact_digest",
                f"{name}: has the digest {sha256_of(data)}: must be {digest}. Recreate the bundle.",
            )
        return data


def _read(folder: Path, name: str, limit: int) -> bytes | None:
    """A regular file inside a bundle, without following links; None if it does not exist."""
    path, outside = folder / name, errno.EINVAL
    try:
        if path.is_symlink() or (folder / ARTEFACTS).is_symlink():
            raise OSError(outside, "is a link")
        return read_regular(path, limit)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise Rejection(
                "too_large",
                f"{name}: must be at most {limit:,} bytes. List fewer runs, or submit smaller "
                "networks.",
            ) from None
        if error.errno in (outside, errno.ENOTDIR):
            raise Rejection(
                "artefact_path",
                f"{name}: must be a regular file inside the bundle, not a link. Copy the file "
                "there.",
            ) from None
        raise OptionError(
            f"{path}: cannot be read: {error.strerror}. Check its permissions."
        ) from None


def make_bundle(
    folder: str | os.PathLike[str],
    description: Description,
    *,
    suite: SuiteFile,
    key: SigningKey,
    runs: Iterable[str | os.PathLike[str]],
    runs_started: dict[str, int] | None = None,
    training: Training | None = None,
    algorithm: str | None = None,
    receiver: Receiver = NOBODY,
    force: bool = False,
    progress: Progress | None = None,
) -> Bundle:
    """Export the policies of runs, and sign a submission of them, written completely or not at all.

    What the board would reject is rejected here, with the same code. A Stable-Baselines3 .zip can
    run code when it is loaded: give only files that you trust. `runs` are folders of `sme train` or
    `sme study run`, folders that contain such, and tables; of several algorithms, `algorithm` is
    the one to submit. `runs_started` are all runs ever started with this method, by class; else
    those listed. `training` is taken from the records of the runs. `receiver` is the only board
    that accepts it; by default it is open until it is sent.
    """
    folder = Path(folder)
    _refuse_existing(folder, force)
    listed = [run for path in runs for run in runs_of(Path(path), suite, algorithm)]
    of_spec = Counter(run.spec.digest for run in listed)
    of_class = {
        member.name: sum(of_spec[spec.digest] for spec in member.instances)
        for member in suite.suite.classes
    }
    fields = {
        **description.fields(key.public),
        "suite": {"name": suite.versioned_name, "digest": suite.digest},
        "runs_started": of_class | (runs_started or {}),
        "training": _training_facts(listed) if training is None else training,
    }
    # Everything that does not depend on the policies is checked before they are exported.
    placeholders = [
        None if run.policy is None else Artefact(sha256=f"sha256:{number:064x}", size=1)
        for number, run in enumerate(listed)
    ]
    unexported = _submission(fields, suite, listed, placeholders)
    Signed[Submission].read(unexported.signed(key, receiver).to_bytes())
    with build_folder(folder, force=force) as building:
        (building / ARTEFACTS).mkdir()
        artefacts = []
        for done, run in enumerate(listed, start=1):
            artefacts.append(_put_artefact(run, building))
            if progress is not None:
                progress(done, len(listed))
        signed = _submission(fields, suite, listed, artefacts).signed(key, receiver)
        write_atomically(building / FILE, signed.to_bytes())
    return Bundle(folder, signed)


def _submission(
    fields: dict[str, Any],
    suite: SuiteFile,
    listed: list[SubmittedRun],
    artefacts: Sequence[Artefact | None],
) -> Submission:
    """The submission of runs with these artefacts, checked as the board checks it."""
    runs = [
        {"spec": run.spec.digest, "seed": run.seed, "steps": run.steps, "artefact": artefact}
        for run, artefact in zip(listed, artefacts, strict=True)
    ]
    submission = Submission.from_dict({**fields, "runs": runs})
    check_names(submission)
    check_runs(suite.suite, submission, [run.source for run in listed])
    return submission


def _training_facts(listed: list[SubmittedRun]) -> Training:
    """Facts of the training from the records of the runs; empty without records."""
    known = [run for run in listed if run.versions]
    if not known:
        return Training()
    names = ("stable_baselines3", "torch", "sme_registry", "python")
    libraries = {
        ", ".join(f"{name} {each.versions[name]}" for name in names if name in each.versions)
        for each in known
    }
    seconds = [each.seconds for each in known]
    return Training(
        library=_cut("; ".join(sorted(libraries)), 200),
        hyperparameters=_cut("\n".join(sorted({each.settings for each in known})), 2000),
        hardware=f"CPU; {statistics.median(seconds):,.0f} s a run (median of {len(known)}), "
        f"{sum(seconds) / 3600:,.1f} h in total",
    )


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _put_artefact(run: SubmittedRun, bundle: Path) -> Artefact | None:
    """Write a run's policy into the bundle, named by its hash."""
    if run.policy is None:
        return None
    try:
        data = _policy_bytes(run, run.policy)
    except Rejection as error:
        raise Rejection(error.code, f"{run.source}: {error.message}") from error
    artefact = Artefact(sha256=sha256_of(data), size=len(data))
    write_atomically(bundle / ARTEFACTS / f"{hex_of(artefact.sha256)}.onnx", data)
    return artefact


def _policy_bytes(run: SubmittedRun, policy: Path) -> bytes:
    if policy.suffix == ".zip":
        libraries = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
        require_packages("exporting a model", libraries, "train")
        data = onnx_bytes(policy, run.spec)
    else:
        try:
            with open_regular(policy, links=True) as stream:
                data = stream.read(MAX_ARTEFACT_BYTES + 1)  # one more than is allowed
        except OSError as error:
            raise OptionError(
                f"{run.source}: policy={str(policy)!r}: cannot be read: {error.strerror}. "
                "Correct the path."
            ) from None
    inspect_own(data, *widths(run.spec))
    return data


def _refuse_existing(folder: Path, force: bool) -> None:
    """Raise if the folder exists, unless `force` is set and it contains nothing but a bundle."""
    check_new(folder, force=force)
    if folder.is_dir() and not folder.is_symlink():
        others = {path.name for path in folder.iterdir()} - {FILE, ARTEFACTS}
    else:
        others = {folder.name} if os.path.lexists(folder) else set()
    if others:
        raise OptionError(
            f"{folder}: is not a bundle, or contains other files, such as {min(others)!r}, and is "
            "not replaced. Give another folder."
        )


@dataclass(frozen=True)
class SubmittedRun:
    """A run to submit, and how it was trained, if there is a record of that."""

    source: str  # its name in errors
    spec: SMESpec
    seed: int
    steps: int
    policy: Path | None  # an .onnx or a .zip; None if the run failed
    versions: dict[str, str] = field(default_factory=dict)  # of the packages that it depends on
    settings: str = ""  # algorithm, hyperparameters, action range and number of environments
    seconds: float = 0.0  # the training took


def runs_of(path: Path, suite: SuiteFile, algorithm: str | None = None) -> list[SubmittedRun]:
    """The runs of a suite in a folder or a table; if an algorithm is given, only its own."""
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


_PolicyPath = Annotated[
    str,
    matching(
        r"\.(onnx|zip)$",
        "the path of an .onnx or a Stable-Baselines3 .zip, or null if the run failed",
    ),
]


def _same(name: str, wanted: str) -> bool:
    return name.casefold() == wanted.casefold()


class _Row(StrictModel):
    """One run of a table."""

    spec: str
    policy: _PolicyPath | None
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
    return SubmittedRun(
        source=str(folder),
        spec=record.spec,
        seed=record.seed,
        steps=record.steps_done,
        policy=folder / _MODEL,
        versions=record.versions,
        settings=settings,
        seconds=record.wall_seconds,
    )


def _cells(study: Path, algorithm: str | None) -> list[SubmittedRun]:
    """The cells of an algorithm of a study, by default of the only one that ran."""
    # Every cell of the plan counts, also one that no run asked for: leaving it out would select.
    cells = studies.study_status(study, only=()).cells
    ran = [cell for cell in cells if cell.state != "waiting"]
    names = list(dict.fromkeys(cell.planned.algorithm for cell in ran or cells))
    wanted = names[0] if algorithm is None and len(names) == 1 else algorithm or ""
    chosen = [cell for cell in cells if _same(cell.planned.algorithm, wanted)]
    if not chosen:
        raise OptionError(
            f"algorithm={algorithm!r}: the study {study} has runs of {', '.join(names)}, and a "
            f"submission is of one method. Choose one, such as --algorithm {names[0]}."
        )
    unfinished = sum(cell.state not in ("done", "failed") for cell in chosen)
    if unfinished:
        raise OptionError(
            f"runs={str(study)!r}: {unfinished} of {len(chosen)} runs are not finished. Run the "
            "study to its end with `sme study run`; `sme study status` shows its state."
        )
    return [_cell(study, cell) for cell in chosen]


def _cell(study: Path, status: studies.CellStatus) -> SubmittedRun:
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
    result = studies.CellResult.from_dict(read_json(study / "cells" / f"{stem}.json"))
    steps = max((cell.steps, *result.curve.steps))  # the last rollout can exceed the plan
    changed = to_json(cell.hyperparameters) if cell.hyperparameters else "default hyperparameters"
    settings = f"{cell.uses}, {changed}; actions in {_RANGES[cell.action_range]}; num_envs=1"
    return SubmittedRun(
        source=source,
        spec=cell.spec,
        seed=cell.seed,
        steps=steps,
        policy=policy,
        versions=result.versions,
        settings=settings,
        seconds=result.timing.total,
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
        try:
            spec = instances.get(row.spec) or load(
                path.parent / row.spec if row.spec.endswith(".json") else row.spec, SMESpec
            )
        except SMEError as error:
            raise SpecError(f"{source}: {error}") from None
        listed.append(SubmittedRun(source, spec, row.seed, row.steps, policy))
    return listed

"""`Bundle`: a submission as a folder; `make_bundle`: a bundle from training runs.

    submission.json             the signed submission
    artefacts/<64 hex>.onnx     each policy that it names, by the SHA-256 of its bytes

Runs are folders that `sme train` wrote, or a table, `runs.json`:

    [{"spec": "SME/Default-v1", "policy": "seed0.onnx", "steps": 100000, "seed": 0}, …]

`spec` is an id, a digest or a path. `policy` is an .onnx, a Stable-Baselines3 .zip, or null if the
run failed. Paths in a table are relative to it.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leaderboard.artefact.gate import inspect
from leaderboard.documents.board import hex_of
from leaderboard.documents.checks import check_names, check_runs
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.submission import (
    ARTEFACTS,
    FILE,
    MAX_ARTEFACT_BYTES,
    MAX_BYTES,
    Artefact,
    Knowledge,
    SignedSubmission,
    Submission,
    Training,
    now,
)
from leaderboard.errors import Rejection
from sme_registry import SMESpec, load
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.io import build_folder, read_json, refuse_existing, write_atomically
from sme_registry.spec import Integer, StrictModel, SuiteFile
from sme_registry.training import RunRecord

Progress = Callable[[int, int], None]

_RECORD, _MODEL = "run.json", "model.zip"
_RANGES = {"unit": "[0, 1]", "symmetric": "[-1, 1]"}


@dataclass(frozen=True)
class Bundle:
    """A bundle whose signature is verified.

    Attributes:
      folder: its path.
      signed: the signed submission.
    """

    folder: Path
    signed: SignedSubmission

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> Bundle:
        """Read a bundle's submission. Artefacts are read on request.

        Raises:
          Rejection: `artefact_path` if the file is a link or not a regular file, and the codes of
            `SignedSubmission.read`.
          OptionError: the folder or its submission is missing.
        """
        folder = Path(folder)
        text = _read_regular(folder, (FILE,), MAX_BYTES)
        if text is None:
            raise OptionError(
                f"{folder}: contains no {FILE}. Create a bundle with `sme-leaderboard new`."
            )
        return cls(folder, SignedSubmission.read(text))

    def artefact(self, digest: str) -> bytes:
        """The bytes of an artefact that the submission names.

        Raises:
          Rejection: `artefact_missing`; `artefact_path` if the file or its folder is a link or not
            regular; `too_large`; or `artefact_digest` if hash or size differ.
        """
        sizes = {
            run.artefact.size
            for run in self.signed.submission.runs
            if run.artefact is not None and run.artefact.sha256 == digest
        }
        if not sizes:
            raise Rejection(
                "artefact_missing", f"artefact={digest:.80}: no run of the submission names it."
            )
        name = f"{hex_of(digest)}.onnx"
        data = _read_regular(self.folder, (ARTEFACTS, name), MAX_ARTEFACT_BYTES)
        if data is None:
            raise Rejection(
                "artefact_missing",
                f"{ARTEFACTS}/{name}: is missing from the bundle. Add it, or recreate the bundle.",
            )
        if len(data) > MAX_ARTEFACT_BYTES:
            raise Rejection(
                "too_large",
                f"{ARTEFACTS}/{name}: must be at most {MAX_ARTEFACT_BYTES:,} bytes. Submit a "
                "smaller network.",
            )
        if sizes != {len(data)} or _digest_of(data) != digest:
            raise Rejection(
                "artefact_digest",
                f"{ARTEFACTS}/{name}: {len(data):,} bytes of {_digest_of(data)}: must be "
                f"{' and '.join(f'{size:,}' for size in sorted(sizes))} bytes of {digest}. "
                "Recreate the bundle.",
            )
        return data


def make_bundle(
    folder: str | os.PathLike[str],
    *,
    suite: SuiteFile,
    key: SigningKey,
    runs: Iterable[str | os.PathLike[str]],
    method: str,
    submitter: str,
    version: str = "1",
    family: str | None = None,
    knowledge: Knowledge = "generic",
    code: str | None = None,
    statement: str = "",
    runs_started: dict[str, int] | None = None,
    training: Training | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Bundle:
    """Export the policies of runs, and sign a submission of them.

    Args:
      folder: the bundle to write; written completely or not at all.
      suite: the suite of the runs.
      key: the submitter's key.
      runs: folders that `sme train` wrote, folders that contain such folders, and tables. A
        Stable-Baselines3 .zip can run code when it is loaded: give only files that you trust.
      method: its name on the board.
      submitter: the submitter's name on the board.
      version: of the method.
      family: the kind of method; None repeats the method's name.
      knowledge: what the method knows of the task, as in `Method`.
      code: a link to the method's code.
      statement: notes for readers.
      runs_started: all runs ever started with this method, by class; for other classes, the number
        of listed runs.
      training: facts of the training; None takes them from the records of the runs.
      force: replace an existing bundle.
      progress: called after each run with the number of finished runs and of all runs.

    Returns:
      The bundle, as `Bundle.read` reads it.

    Raises:
      OptionError: the folder exists, or a path in `runs` is none of the above.
      SpecError, UnknownNameError: a table or record is invalid.
      PolicyError: a model cannot be exported.
      Rejection: the board would reject the submission, with the same code.
      MissingDependencyError: exporting a .zip needs a package that is not installed.
    """
    folder = Path(folder)
    _refuse_existing(folder, force)
    listed = [run for path in runs for run in _runs_of(Path(path), suite)]
    _refuse_other_specs(listed, suite)
    fields = {
        "suite": {"name": suite.versioned_name, "digest": suite.digest},
        "method": {
            "name": method,
            "version": version,
            "family": method if family is None else family,
            "knowledge": knowledge,
        },
        "code": code,
        "submitter": {"name": submitter, "key": key.public},
        "runs_started": {**_listed_by_class(listed, suite), **(runs_started or {})},
        "training": _training_facts(listed) if training is None else training,
        "statement": statement,
    }
    # Everything that does not depend on the policies is checked before they are exported.
    unexported = _submission(fields, suite, listed, _placeholders(listed))
    SignedSubmission.read(unexported.signed(key).to_bytes())
    with build_folder(folder, force=force) as building:
        (building / ARTEFACTS).mkdir()
        artefacts = []
        for done, run in enumerate(listed, start=1):
            artefacts.append(_put_artefact(run, building))
            if progress is not None:
                progress(done, len(listed))
        signed = _submission(fields, suite, listed, artefacts).signed(key)
        write_atomically(building / FILE, signed.to_bytes())
        Bundle.read(building)
        _refuse_existing(folder, force)
    return Bundle(folder, signed)


class _Row(StrictModel):
    """One run of a table."""

    spec: str
    policy: str | None
    steps: Integer
    seed: Integer


@dataclass(frozen=True)
class _SubmittedRun:
    """A run to submit.

    Attributes:
      source: its name in errors.
      policy: an .onnx or a .zip; None if the run failed.
      record: of a run of `sme train`.
    """

    source: str
    spec: SMESpec
    seed: int
    steps: int
    policy: Path | None
    record: RunRecord | None = None


def _runs_of(path: Path, suite: SuiteFile) -> list[_SubmittedRun]:
    """The runs of a folder or a table.

    Raises:
      OptionError: the path is neither.
    """
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


def _trained(folder: Path) -> _SubmittedRun:
    record = RunRecord.read(folder)
    if record is None or record.status != "finished" or not (folder / _MODEL).is_file():
        raise OptionError(
            f"{folder}: contains an unfinished run. Resume it (`sme train --resume`), or list it "
            "in a table with policy null, which scores 1."
        )
    return _SubmittedRun(
        str(folder), record.spec, record.seed, record.steps_done, folder / _MODEL, record
    )


def _table(path: Path, suite: SuiteFile) -> list[_SubmittedRun]:
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
        listed.append(_SubmittedRun(source, spec, row.seed, row.steps, policy))
    return listed


def _refuse_other_specs(listed: list[_SubmittedRun], suite: SuiteFile) -> None:
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


def _listed_by_class(listed: list[_SubmittedRun], suite: SuiteFile) -> dict[str, int]:
    """Number of listed runs of each class."""
    digests = Counter(run.spec.digest for run in listed)
    return {
        member.name: sum(digests[spec.digest] for spec in member.instances)
        for member in suite.suite.classes
    }


def _submission(
    fields: dict[str, Any],
    suite: SuiteFile,
    listed: list[_SubmittedRun],
    artefacts: Sequence[Artefact | None],
) -> Submission:
    """The submission of runs with these artefacts, checked as the board checks it."""
    runs = [
        {"spec": run.spec.digest, "seed": run.seed, "steps": run.steps, "artefact": artefact}
        for run, artefact in zip(listed, artefacts, strict=True)
    ]
    submission = Submission.from_dict({**fields, "created": now(), "runs": runs})
    check_names(submission)
    check_runs(suite.suite, submission)
    return submission


def _training_facts(listed: list[_SubmittedRun]) -> Training:
    """Facts of the training from the records of the runs; empty without records."""
    records = [run.record for run in listed if run.record is not None]
    if not records:
        return Training()
    libraries, settings = set(), set()
    for record in records:
        versions = record.versions
        names = ("stable_baselines3", "torch", "sme_registry", "python")
        libraries.add(", ".join(f"{name} {versions[name]}" for name in names if name in versions))
        settings.add(
            f"{record.algorithm}, {record.hyperparameters}; actions in "
            f"{_RANGES[record.action_range]}; num_envs={record.num_envs}"
        )
    seconds = [record.wall_seconds for record in records]
    return Training(
        library=_shortened("; ".join(sorted(libraries)), 200),
        hyperparameters=_shortened("\n".join(sorted(settings)), 2000),
        hardware=f"CPU; {statistics.median(seconds):,.0f} s a run (median of {len(records)}), "
        f"{sum(seconds) / 3600:,.1f} h in total",
    )


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _placeholders(listed: list[_SubmittedRun]) -> list[Artefact | None]:
    """A distinct artefact for each policy that is not exported yet."""
    return [
        None if run.policy is None else Artefact(sha256=f"sha256:{number:064x}", size=1)
        for number, run in enumerate(listed)
    ]


def _put_artefact(run: _SubmittedRun, bundle: Path) -> Artefact | None:
    """Write a run's policy into the bundle, named by its hash."""
    if run.policy is None:
        return None
    try:
        data = _policy_bytes(run, run.policy, bundle)
        inspect(data, run.spec.state_dim + 2, run.spec.action_dim)
    except Rejection as error:
        raise Rejection(error.code, f"{run.source}: {error.message}") from error
    artefact = Artefact(sha256=_digest_of(data), size=len(data))
    write_atomically(bundle / ARTEFACTS / f"{hex_of(artefact.sha256)}.onnx", data)
    return artefact


def _policy_bytes(run: _SubmittedRun, policy: Path, bundle: Path) -> bytes:
    if policy.suffix == ".zip":
        from leaderboard.artefact.export_sb3 import export_sb3

        exported = export_sb3(policy, bundle / "exported.onnx", spec=run.spec)
        data = exported.read_bytes()
        exported.unlink()
        return data
    try:
        with policy.open("rb") as stream:
            return stream.read(MAX_ARTEFACT_BYTES + 1)  # one more than `inspect` allows
    except OSError as error:
        raise OptionError(
            f"{run.source}: policy={str(policy)!r}: cannot be read: {error.strerror}. "
            "Correct the path."
        ) from None


def _refuse_existing(folder: Path, force: bool) -> None:
    """Raise if the folder exists, unless `force` is set and it contains nothing but a bundle."""
    refuse_existing(folder, force=force)
    if not os.path.lexists(folder):
        return
    others = {folder.name}
    if folder.is_dir() and not folder.is_symlink():
        others = {path.name for path in folder.iterdir()} - {FILE, ARTEFACTS}
    if others:
        raise OptionError(
            f"{folder}: is not a bundle, or contains other files, such as {min(others)!r}, and is "
            "not replaced. Give another folder."
        )


def _read_regular(folder: Path, parts: tuple[str, ...], limit: int) -> bytes | None:
    """A regular file inside a folder, up to one byte above the limit; None if it does not exist.

    Each part of the path is opened relative to the one before and links are not followed, so that
    nothing outside the folder is read even if the folder changes meanwhile. Opening never blocks,
    so that a pipe is rejected. Systems without these calls (Windows) check the path instead.

    Raises:
      Rejection: `artefact_path` if a part is a link or not regular.
    """
    name = "/".join(parts)
    refused = Rejection(
        "artefact_path",
        f"{name}: must be a regular file inside the bundle, not a link. Copy the file there.",
    )
    if os.open not in os.supports_dir_fd:
        path = folder.joinpath(*parts)
        if not os.path.lexists(path):
            return None
        if not path.is_file() or path.resolve() != folder.resolve().joinpath(*parts):
            raise refused
        with path.open("rb") as stream:
            return stream.read(limit + 1)
    with contextlib.ExitStack() as opened:
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            opened.callback(os.close, handle)
            for part in parts:
                kind = os.O_NONBLOCK if part == parts[-1] else os.O_DIRECTORY
                handle = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | kind, dir_fd=handle)
                opened.callback(os.close, handle)
        except FileNotFoundError:
            return None
        except OSError as error:
            if error.errno in (errno.ELOOP, errno.ENOTDIR, errno.ENXIO):
                raise refused from None
            raise OptionError(
                f"{folder / name}: cannot be read: {error.strerror}. Check its permissions."
            ) from None
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise refused
        with open(handle, "rb", closefd=False) as stream:
            return stream.read(limit + 1)


def _digest_of(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()

"""`Bundle`: a submission as a folder, read with care; and `make_bundle`, which makes one of runs.

    submission.json             a signed submission
    artefacts/<64 hex>.onnx     each policy that it names, by the SHA-256 of its bytes

Runs come from the folders that `sme train` wrote, or from a table, `runs.json`:

    [{"spec": "SME/Default-v1", "policy": "seed0.onnx", "steps": 100000, "seed": 0}, …]

with `spec` an id, a digest or a path, and `policy` an .onnx, a Stable-Baselines3 .zip, or null
where the run failed. Paths in a table are relative to it.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import stat
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

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
from sme_registry.io import read_json, write_atomically
from sme_registry.spec import Integer, StrictModel, SuiteFile
from sme_registry.training import RunRecord

Progress = Callable[[int, int], None]

_RECORD, _MODEL = "run.json", "model.zip"
_RANGES = {"unit": "[0, 1]", "symmetric": "[-1, 1]"}


@dataclass(frozen=True)
class Bundle:
    """A bundle's folder, its submission read and its signature verified.

    Attributes:
      folder: where it is.
      signed: the submission.
    """

    folder: Path
    signed: SignedSubmission

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> Bundle:
        """Read a bundle's submission; its artefacts are read when they are asked for.

        Raises:
          Rejection: `artefact_path` where the file is a link or no plain file, and what
            `SignedSubmission.read` raises.
          OptionError: the folder or its submission is missing.
        """
        folder = Path(folder)
        text = _read_plain(folder, (FILE,), MAX_BYTES)
        if text is None:
            raise OptionError(
                f"{folder}: holds no {FILE}. Make a bundle with `sme-leaderboard new`."
            )
        return cls(folder, SignedSubmission.read(text))

    def artefact(self, digest: str) -> bytes:
        """The bytes of an artefact that the submission names.

        Raises:
          Rejection: `artefact_missing`, `artefact_path` where it, or its folder, is a link or no
            plain file, `too_large`, or `artefact_digest` where hash or size are others.
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
        data = _read_plain(self.folder, (ARTEFACTS, name), MAX_ARTEFACT_BYTES)
        if data is None:
            raise Rejection(
                "artefact_missing",
                f"{ARTEFACTS}/{name}: is not in the bundle. Put it there, or make the bundle anew.",
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
                "Make the bundle anew.",
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
      folder: of the bundle; made whole or not at all.
      suite: which suite it is for.
      key: the submitter's.
      runs: folders that `sme train` wrote, folders with such folders in them, and tables. A
        Stable-Baselines3 .zip is code: give only what you trust.
      method: its name, as the board shows it.
      submitter: likewise.
      version: of the method.
      family: the kind of method; None takes its name.
      knowledge: what the method knows of the task, as in `Method`.
      code: a link to the method's code.
      statement: what a reader should know.
      runs_started: of each class, all runs ever started with this method; of classes left out,
        the runs listed.
      training: facts of the training; None takes them from the runs' records.
      force: replace a bundle that is there.
      progress: called after each run with the runs done and the runs in all.

    Returns:
      The bundle, as `Bundle.read` reads it.

    Raises:
      OptionError: the folder exists, or a path of `runs` is none of what is described.
      SpecError, UnknownNameError: a table or record is wrong.
      PolicyError: a model cannot be exported.
      Rejection: the board would refuse the submission, with the code that it would say.
      MissingDependencyError: a .zip is given, and what exports it is not installed.
    """
    folder = Path(folder)
    _refuse_existing(folder, force)
    listed = [run for path in runs for run in _runs_of(Path(path), suite)]
    _refuse_other_specs(listed, suite)

    counts = _listed_by_class(listed, suite)
    records = [run.record for run in listed if run.record is not None]
    facts = _facts(records) if training is None else training

    def submission(artefacts: Sequence[Artefact | None]) -> Submission:
        made = Submission.from_dict(
            {
                "suite": {"name": suite.versioned_name, "digest": suite.digest},
                "method": {
                    "name": method,
                    "version": version,
                    "family": method if family is None else family,
                    "knowledge": knowledge,
                },
                "code": code,
                "submitter": {"name": submitter, "key": key.public},
                "created": now(),
                "runs": [
                    {
                        "spec": run.spec.digest,
                        "seed": run.seed,
                        "steps": run.steps,
                        "artefact": artefact,
                    }
                    for run, artefact in zip(listed, artefacts, strict=True)
                ],
                "runs_started": {**counts, **(runs_started or {})},
                "training": facts,
                "statement": statement,
            }
        )
        check_names(made)
        check_runs(suite.suite, made)
        return made

    # What is wrong whatever the policies are, is told before they are exported.
    SignedSubmission.read(submission(_smallest(listed)).signed(key).to_bytes())
    with _made_whole(folder, force) as temporary:
        artefacts = []
        for done, run in enumerate(listed, start=1):
            artefacts.append(_put_artefact(run, temporary))
            if progress is not None:
                progress(done, len(listed))
        signed = submission(artefacts).signed(key)
        write_atomically(temporary / FILE, signed.to_bytes())
        Bundle.read(temporary)
    return Bundle(folder, signed)


class _Row(StrictModel):
    """One run of a table."""

    spec: str
    policy: str | None
    steps: Integer
    seed: Integer


@dataclass(frozen=True)
class _Listed:
    """A run to be submitted.

    Attributes:
      source: what errors call it.
      policy: an .onnx or a .zip; None where the run failed.
      record: where `sme train` wrote one.
    """

    source: str
    spec: SMESpec
    seed: int
    steps: int
    policy: Path | None
    record: RunRecord | None = None


def _runs_of(path: Path, suite: SuiteFile) -> list[_Listed]:
    """The runs that a path means.

    Raises:
      OptionError: it means none.
    """
    if path.is_dir():
        folders = sorted(found.parent for found in path.rglob(_RECORD))
        if folders:
            return [_trained(folder) for folder in folders]
    elif path.suffix == ".json" and path.is_file():
        return _table(path, suite)
    raise OptionError(
        f"runs={str(path)!r}: must be a folder of `sme train`, a folder with such folders in it, "
        "or a table of runs (.json). Correct the path."
    )


def _trained(folder: Path) -> _Listed:
    record = RunRecord.read(folder)
    if record is None or record.status != "finished" or not (folder / _MODEL).is_file():
        raise OptionError(
            f"{folder}: holds a run that has not finished. Go on with it (`sme train --resume`), "
            "or list it in a table with policy null, which scores 1."
        )
    return _Listed(
        str(folder), record.spec, record.seed, record.steps_done, folder / _MODEL, record
    )


def _table(path: Path, suite: SuiteFile) -> list[_Listed]:
    rows = read_json(path)
    if not isinstance(rows, list):
        raise SpecError(
            f"{path}: must be a list of runs, each with spec, policy, steps and seed. A run's "
            "record is given by its folder."
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
                "Stable-Baselines3 .zip, or null where the run failed. Correct it."
            )
        try:
            spec = instances.get(row.spec) or load(
                path.parent / row.spec if row.spec.endswith(".json") else row.spec
            )
        except SMEError as error:
            raise SpecError(f"{source}: {error}") from None
        listed.append(_Listed(source, spec, row.seed, row.steps, policy))
    return listed


def _refuse_other_specs(listed: list[_Listed], suite: SuiteFile) -> None:
    """Raise where runs are on specs that are no instance of the suite; names them."""
    known = {spec.digest for spec in suite.suite.instances}
    strangers = [
        f"{run.source} ({run.spec.content_name})" for run in listed if run.spec.digest not in known
    ]
    if strangers:
        more = f" and {len(strangers) - 5} more" if len(strangers) > 5 else ""
        raise Rejection(
            "unknown_spec",
            f"runs: {', '.join(strangers[:5])}{more}: must be on one of the {len(known)} instances "
            f"of {suite.versioned_name} (`sme show {suite.name}`). Leave them out, or name the "
            "suite that they are of.",
        )


def _listed_by_class(listed: list[_Listed], suite: SuiteFile) -> dict[str, int]:
    """How many runs of each class are listed, 0 where none is."""
    digests = Counter(run.spec.digest for run in listed)
    return {
        member.name: sum(digests[spec.digest] for spec in member.instances)
        for member in suite.suite.classes
    }


def _facts(records: list[RunRecord]) -> Training:
    """What the runs' records say of the training; empty where there are none."""
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
        library=_cut("; ".join(sorted(libraries)), 200),
        hyperparameters=_cut("\n".join(sorted(settings)), 2000),
        hardware=f"CPU; {statistics.median(seconds):,.0f} s a run (median of {len(records)}), "
        f"{sum(seconds) / 3600:,.1f} h in all",
    )


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _smallest(listed: list[_Listed]) -> list[Artefact | None]:
    """What stands for the policies, one of its own for each, until there are any."""
    return [
        None if run.policy is None else Artefact(sha256=f"sha256:{number:064x}", size=1)
        for number, run in enumerate(listed)
    ]


def _put_artefact(run: _Listed, bundle: Path) -> Artefact | None:
    """Write a run's policy into the bundle, by its hash."""
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


def _policy_bytes(run: _Listed, policy: Path, bundle: Path) -> bytes:
    if policy.suffix == ".zip":
        from leaderboard.artefact.export_sb3 import export_sb3

        exported = export_sb3(policy, bundle / "exported.onnx", spec=run.spec)
        data = exported.read_bytes()
        exported.unlink()
        return data
    try:
        with policy.open("rb") as stream:
            return stream.read(MAX_ARTEFACT_BYTES + 1)  # one more than `inspect` lets through
    except OSError as error:
        raise OptionError(
            f"{run.source}: policy={str(policy)!r}: cannot be read: {error.strerror}. "
            "Correct the path."
        ) from None


def _refuse_existing(folder: Path, force: bool) -> None:
    """Raise where something is at the folder's path that must not be replaced."""
    if not os.path.lexists(folder):
        return
    if not force:
        raise OptionError(
            f"{folder}: is there already. Give another folder, or --force (in Python force=True) "
            "to replace the bundle."
        )
    strangers = (
        {path.name for path in folder.iterdir()} - {FILE, ARTEFACTS}
        if folder.is_dir() and not folder.is_symlink()
        else {folder.name}
    )
    if strangers:
        raise OptionError(
            f"{folder}: is no bundle, or holds other files, such as {min(strangers)!r}, and is "
            "left as it is. Give another folder."
        )


@contextlib.contextmanager
def _made_whole(folder: Path, force: bool) -> Iterator[Path]:
    """A new folder beside `folder`, put in its place if the block succeeds, removed if not."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name[:64]}.", dir=folder.parent))
    except OSError as error:
        raise _unwritable(folder, error) from None
    made, replaced = temporary / "made", temporary / "replaced"
    try:
        made.mkdir()
        (made / ARTEFACTS).mkdir()
        yield made
        for path in (made / ARTEFACTS, made):
            _sync(path)
        _refuse_existing(folder, force)
        try:
            if force and folder.exists():
                os.rename(folder, replaced)
            os.rename(made, folder)
        except OSError as error:
            if replaced.exists():
                os.rename(replaced, folder)
            raise _unwritable(folder, error) from None
        _sync(folder.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _unwritable(folder: Path, error: OSError) -> OptionError:
    return OptionError(
        f"{folder}: cannot be written: {error.strerror}. Give a path in a folder that you may "
        "write to."
    )


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read_plain(folder: Path, parts: tuple[str, ...], limit: int) -> bytes | None:
    """A plain file inside a folder, up to a byte above the limit; None where there is none.

    Opened part by part and without following links, so that nothing outside the folder is read,
    whoever changes it meanwhile; and without waiting, so that a pipe is refused and not read.

    Raises:
      Rejection: `artefact_path` where a part is a link or no plain file.
    """
    name = "/".join(parts)
    refused = Rejection(
        "artefact_path",
        f"{name}: must be a plain file inside the bundle, and no link. Copy the file there.",
    )
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
                f"{folder / name}: cannot be read: {error.strerror}. Make it readable."
            ) from None
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise refused
        with open(handle, "rb", closefd=False) as stream:
            return stream.read(limit + 1)


def _digest_of(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()

"""`make_bundle`: export the policies of training runs and sign a submission of them."""

from __future__ import annotations

import os
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from leaderboard.bundle.reading import Bundle
from leaderboard.bundle.runs import SubmittedRun, listed_by_class, refuse_other_specs, runs_of
from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import NOBODY, Receiver, Signed, SigningKey
from leaderboard.documents.submission import (
    ARTEFACTS,
    FILE,
    MAX_ARTEFACT_BYTES,
    Artefact,
    Knowledge,
    Submission,
    Training,
    check_names,
    check_runs,
    now,
)
from leaderboard.errors import Rejection
from leaderboard.gate.sandbox import inspect_own, widths
from sme_registry import SMESpec
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import load_sb3
from sme_registry.export import onnx_bytes
from sme_registry.io import (
    build_folder,
    check_new,
    require_packages,
    sha256_of,
    write_atomically,
)
from sme_registry.spec import SuiteFile

Progress = Callable[[int, int], None]


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
    algorithm: str | None = None,
    receiver: Receiver = NOBODY,
    force: bool = False,
    progress: Progress | None = None,
) -> Bundle:
    """Export the policies of runs, and sign a submission of them.

    Args:
      folder: the bundle to write; written completely or not at all.
      suite: the suite of the runs.
      key: the submitter's key.
      runs: folders of `sme train` or `sme study run`, folders that contain such, and tables. A
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
      algorithm: of folders with runs of several, the only one to submit.
      receiver: the only board that accepts it, and its address. By default it is open, until
        `submit_bundle` or `client.submit` signs for the board that it is sent to.
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
    listed = [run for path in runs for run in runs_of(Path(path), suite, algorithm)]
    refuse_other_specs(listed, suite)
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
        "runs_started": {**listed_by_class(listed, suite), **(runs_started or {})},
        "training": _training_facts(listed) if training is None else training,
        "statement": statement,
    }
    # Everything that does not depend on the policies is checked before they are exported.
    unexported = _submission(fields, suite, listed, _placeholders(listed))
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
        Bundle.read(building)
        _refuse_existing(folder, force)
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
    submission = Submission.from_dict({**fields, "created": now(), "runs": runs})
    check_names(submission)
    check_runs(suite.suite, submission, [run.source for run in listed])
    return submission


def _training_facts(listed: list[SubmittedRun]) -> Training:
    """Facts of the training from the records of the runs; empty without records."""
    known = [run.provenance for run in listed if run.provenance is not None]
    if not known:
        return Training()
    libraries = set()
    for versions in (each.versions for each in known):
        names = ("stable_baselines3", "torch", "sme_registry", "python")
        libraries.add(", ".join(f"{name} {versions[name]}" for name in names if name in versions))
    seconds = [each.seconds for each in known]
    return Training(
        library=_shortened("; ".join(sorted(libraries)), 200),
        hyperparameters=_shortened("\n".join(sorted({each.settings for each in known})), 2000),
        hardware=f"CPU; {statistics.median(seconds):,.0f} s a run (median of {len(known)}), "
        f"{sum(seconds) / 3600:,.1f} h in total",
    )


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _placeholders(listed: list[SubmittedRun]) -> list[Artefact | None]:
    """A distinct artefact for each policy that is not exported yet."""
    return [
        None if run.policy is None else Artefact(sha256=f"sha256:{number:064x}", size=1)
        for number, run in enumerate(listed)
    ]


def _put_artefact(run: SubmittedRun, bundle: Path) -> Artefact | None:
    """Write a run's policy into the bundle, named by its hash."""
    if run.policy is None:
        return None
    try:
        data = _policy_bytes(run, run.policy, bundle)
        inspect_own(data, *widths(run.spec))
    except Rejection as error:
        raise Rejection(error.code, f"{run.source}: {error.message}") from error
    artefact = Artefact(sha256=sha256_of(data), size=len(data))
    write_atomically(bundle / ARTEFACTS / f"{hex_of(artefact.sha256)}.onnx", data)
    return artefact


def _policy_bytes(run: SubmittedRun, policy: Path, bundle: Path) -> bytes:
    if policy.suffix == ".zip":
        exported = export_sb3(policy, bundle / "exported.onnx", spec=run.spec)
        data = exported.read_bytes()
        exported.unlink()
        return data
    try:
        with policy.open("rb") as stream:
            return stream.read(MAX_ARTEFACT_BYTES + 1)  # one more than is allowed
    except OSError as error:
        raise OptionError(
            f"{run.source}: policy={str(policy)!r}: cannot be read: {error.strerror}. "
            "Correct the path."
        ) from None


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


def export_sb3(
    model: Any,
    path: str | os.PathLike[str],
    *,
    vec_normalize: Any = None,
    spec: SMESpec | None = None,
) -> Path:
    """Write a model's deterministic policy as an ONNX file that boards accept.

    Args:
      model: a model of Stable-Baselines3 or sb3-contrib, or the path of its .zip (loading a .zip
        can run its author's code). Its action space is [0, 1] or [−1, 1] in every channel.
      path: the file to write, completely or not at all; an existing file is replaced.
      vec_normalize: see `sme_registry.export_onnx`.
      spec: the task, to check the widths; None skips the check.

    Returns:
      The path written.

    Raises:
      PolicyError: see `sme_registry.export_onnx`.
      Rejection: its network needs operators that no board accepts, or is too large.
      OptionError: the file cannot be written.
      MissingDependencyError: Stable-Baselines3, PyTorch, onnx or ONNX Runtime is not installed.
    """
    libraries = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages("exporting a model", libraries, "train")
    if isinstance(model, str | os.PathLike):
        model = load_sb3(model)
    if not hasattr(model, "predict"):
        raise PolicyError(
            f"model={model!r:.80}: must be a Stable-Baselines3 model or the path of its .zip."
        )
    data = onnx_bytes(model, spec, vec_normalize=vec_normalize)
    inspect_own(data, *(space.shape[0] for space in (model.observation_space, model.action_space)))
    return write_atomically(path, data)

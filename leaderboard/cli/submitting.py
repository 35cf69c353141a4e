"""`sme-leaderboard keygen · export-sb3 · new · check · submit · withdraw`."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from leaderboard.cli.options import (
    KeyFile,
    ProtocolName,
    SuiteName,
    default_key,
    find_suite,
    find_suite_file,
    is_url,
)
from leaderboard.documents.keys import SigningKey
from leaderboard.errors import Rejection
from sme_registry.errors import OptionError
from sme_registry.terminal import Progress, err, out, print_json

if TYPE_CHECKING:
    from leaderboard.documents.result import Result
    from leaderboard.documents.submission import Knowledge

BundleFolder = Annotated[Path, typer.Argument(metavar="BUNDLE", help="The submission's folder.")]
BoardOrUrl = Annotated[
    str, typer.Argument(metavar="BOARD", help="A board's folder, or the address of one.")
]


def keygen(key: KeyFile = default_key()) -> None:  # noqa: B008 - a path, the same at each call
    """Make your signing key. Whoever has it is you: keep it, and keep it secret.

    Examples:

      sme-leaderboard keygen

      sme-leaderboard keygen --key lab.key
    """
    made = SigningKey.generate()
    path = made.write(key)
    out().print(f"{escape(str(path))}\npublic key {made.public}", soft_wrap=True)


def export_sb3(
    model: Annotated[Path, typer.Argument(metavar="MODEL.zip", help="What SB3's save wrote.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", "-o", help="By default MODEL.onnx.")
    ] = None,
    vec_normalize: Annotated[
        Path | None, typer.Option(help="The statistics of VecNormalize, as saved.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the file if it is there.")
    ] = False,
) -> None:
    """An SB3 model's deterministic policy as ONNX: action range and clipping inside.

    A .zip of Stable-Baselines3 is code: open only those whose author you trust.

    Examples:

      sme-leaderboard export-sb3 runs/demo/model.zip
    """
    from leaderboard.artefact.export_sb3 import export_sb3 as export

    target = model.with_suffix(".onnx") if out_file is None else out_file
    if target.exists() and not force:
        raise OptionError(f"{target}: is there already. Give another --out, or --force.")
    path = export(model, target, vec_normalize=vec_normalize)
    out().print(f"{escape(str(path))}, {path.stat().st_size:,} bytes", soft_wrap=True)


def new(
    bundle: BundleFolder,
    runs: Annotated[
        list[str],
        typer.Option(
            "--runs",
            help="Folders that `sme train` wrote (a pattern such as 'runs/*'; repeatable), or a "
            "runs.json: a list of {spec, policy, steps, seed}, policy null where a run failed.",
        ),
    ],
    method: Annotated[str, typer.Option(help="Its name, as the board shows it.")],
    submitter: Annotated[str, typer.Option(help="Your name, or your lab's.")],
    suite: SuiteName = "smoke-v1",
    method_version: Annotated[str, typer.Option(help="Of the method.")] = "1",
    family: Annotated[str | None, typer.Option(help="Such as PPO; by default the name.")] = None,
    knowledge: Annotated[
        str,
        typer.Option(
            help="generic: nothing of the task; family: that it is an SME; oracle: its optimum."
        ),
    ] = "generic",
    code: Annotated[str | None, typer.Option(help="A link to the code, https.")] = None,
    statement: Annotated[str, typer.Option(help="What a reader should know.")] = "",
    started: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CLASS=N",
            help="Runs ever started in a class, if more than are listed; the others score 1.",
        ),
    ] = None,
    key: KeyFile = default_key(),  # noqa: B008 - a path, the same at each call
    force: Annotated[bool, typer.Option("--force", help="Replace the bundle.")] = False,
) -> None:
    """Make a submission from trained runs, and sign it.

    There must be a run on each instance of the suite; `sme show smoke` lists them.

    Examples:

      sme train sha256:dfe78aa6aba8 --algorithm TD3 --seed 0

      sme-leaderboard new td3 --runs 'runs/*-TD3-*' --method TD3 --submitter "A Lab"
    """
    from leaderboard.bundle import make_bundle

    folders = _expanded(runs)
    file = find_suite_file(suite)
    with Progress("exporting", max(1, len(folders)), console=err(), unit="runs") as progress:
        made = make_bundle(
            bundle,
            suite=file,
            key=SigningKey.read(key),
            runs=folders,
            method=method,
            version=method_version,
            family=family or method,
            knowledge=_knowledge(knowledge),
            submitter=submitter,
            code=code,
            statement=statement,
            runs_started=_started(started or []),
            force=force,
            progress=progress.update_of,
        )
    out().print(f"{made.signed.id}\n{len(made.signed.submission.runs)} runs", soft_wrap=True)
    out().print(f"Next: sme-leaderboard check {escape(str(bundle))}", soft_wrap=True)


def _expanded(patterns: list[str]) -> list[Path]:
    """The paths that patterns mean, sorted, each once.

    Raises:
      OptionError: a pattern means none.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        path = Path(pattern)
        if path.exists():
            found[path] = None
            continue
        root = Path(path.anchor) if path.is_absolute() else Path()
        matches = sorted(root.glob(str(path.relative_to(path.anchor))))
        if not matches:
            raise OptionError(f"runs={pattern!r}: no such folder or file. Correct the path.")
        found |= dict.fromkeys(matches)
    return list(found)


def _knowledge(value: str) -> Knowledge:
    if value not in ("generic", "family", "oracle"):
        raise OptionError(f"knowledge={value!r}: must be generic, family or oracle.")
    return value  # type: ignore[return-value]  # narrowed above, which mypy does not see for str


def _started(pairs: list[str]) -> dict[str, int]:
    counts = {}
    for pair in pairs:
        name, equals, count = pair.partition("=")
        if not equals or not count.strip().isdecimal():
            raise OptionError(f"started={pair!r}: must be CLASS=N, as in --started default=12.")
        counts[name.strip()] = int(count)
    return counts


def check(
    bundle: BundleFolder,
    suite: Annotated[
        str | None, typer.Option(help="Path of the suite's file, if it is in no catalogue.")
    ] = None,
    protocol: ProtocolName = "paper-v1",
    json: Annotated[bool, typer.Option("--json", help="The result as JSON.")] = False,
) -> None:
    """Run at home exactly what the scorer runs: every check, the sandbox, every number.

    Examples:

      sme-leaderboard check td3

      sme-leaderboard check td3 --protocol quick-v1
    """
    from leaderboard.bundle import Bundle
    from leaderboard.documents.board import BoardDocument
    from leaderboard.documents.checks import check_submission
    from leaderboard.scoring.score import score_submission
    from sme_registry.evaluation import resolve_protocol

    read = Bundle.read(bundle)
    submission = read.signed.submission
    name, document = find_suite(suite or submission.suite.name)
    board = BoardDocument(
        title="check",
        suite_name=name,
        suite=document,
        protocol_name=Path(protocol).stem,
        protocol=resolve_protocol(protocol),
        key="0" * 64,
    )
    check_submission(board, submission, datetime.datetime.now(datetime.UTC))
    with Progress("scoring", len(submission.runs), console=err(), unit="states") as progress:
        result = score_submission(board, submission, read.artefact, progress=progress.update_of)
    if json:
        print_json(result.to_dict())
    _refuse_rejected(result)
    if not json:
        _print_scores(result)


def _refuse_rejected(result: Result) -> None:
    if result.status == "rejected":
        raise Rejection(result.code, result.message)


def _print_scores(result: Result) -> None:
    assert result.scores is not None
    for label, value in {
        "WD regret N₀": result.scores.wd_regret,
        "OOD regret N̄": result.scores.ood_regret,
        "OOD decay N̄ − N₀": result.scores.ood_decay,
    }.items():
        out().print(f"{label:14s} {value.value:.4f}  ({value.low:.4f} to {value.high:.4f})")
    if not result.enough_runs:
        out().print("Will be listed and not ranked: too few runs in a class.")
    if result.oracle_like:
        out().print("Will be marked oracle-like, which asks for the method's code.")


def submit(
    bundle: BundleFolder,
    board: BoardOrUrl,
    key: KeyFile = default_key(),  # noqa: B008 - a path, the same at each call
) -> None:
    """Hand a submission in: to a board's folder, or to one that is served.

    Submitting the same one twice changes nothing. The key signs uploads; a folder needs none.

    Examples:

      sme-leaderboard submit td3 board

      sme-leaderboard submit td3 http://127.0.0.1:8000
    """
    from leaderboard import intake
    from leaderboard.bundle import Bundle
    from leaderboard.store import Store
    from leaderboard.web import client

    if is_url(board):
        total = len(Bundle.read(bundle).signed.submission.runs)
        with Progress("uploading", total, console=err(), unit="artefacts") as progress:
            id = client.submit(board, bundle, SigningKey.read(key), progress=progress.update_of)
    else:
        with Store.open(Path(board)) as store:
            id = intake.submit_bundle(store, bundle)
    out().print(id, soft_wrap=True)


def withdraw(
    board: BoardOrUrl,
    id: Annotated[
        str,
        typer.Argument(
            metavar="ID",
            help="The submission's id; of a board's folder, its beginning is enough.",
        ),
    ],
    reason: Annotated[str, typer.Option(help="Shown on its page.")] = "",
    key: KeyFile = default_key(),  # noqa: B008 - a path, the same at each call
) -> None:
    """Take your submission off the board. Its page stays, and says so.

    Examples:

      sme-leaderboard withdraw board 3f2a --reason "a bug in the wrapper"
    """
    from leaderboard import intake
    from leaderboard.cli.reading import find_entry
    from leaderboard.store import Store
    from leaderboard.web import client

    own = SigningKey.read(key)
    if is_url(board):
        client.withdraw(board, id, own, reason)
    else:
        with Store.open(Path(board)) as store:
            id = find_entry(store, id).id
            intake.withdraw(store, intake.withdrawal_of(id, own, reason))
    out().print(f"{id} withdrawn", soft_wrap=True)

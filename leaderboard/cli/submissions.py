"""`sme-leaderboard keygen · export-sb3 · new · check · submit · withdraw`: submit a method."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from leaderboard import admission
from leaderboard.admission import check_submission
from leaderboard.bundle import Bundle, make_bundle
from leaderboard.cli.options import (
    DEFAULT_KEY,
    Board,
    BoardOrUrl,
    BundleFolder,
    CodeLink,
    Family,
    Json,
    KeyFile,
    MethodName,
    MethodVersion,
    Statement,
    SubmitterName,
    board_document,
    board_or_url,
    complete_protocol,
    find_suite,
    is_url,
    receiver_of,
)
from leaderboard.cli.results import find_entry
from leaderboard.documents.board import RULES, BoardDocument
from leaderboard.documents.result import RANKED, Result
from leaderboard.documents.signed import NOBODY, Receiver, SigningKey
from leaderboard.documents.submission import Knowledge, Withdrawal, now
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import isolation_for_own
from leaderboard.scoring.score import score_submission
from leaderboard.web import client
from sme_registry.errors import OptionError
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import check_new
from sme_registry.io.terminal import Progress, err, out, print_json
from sme_registry.spec import SuiteFile, catalogue

app = typer.Typer()


@app.command()
def keygen(key: KeyFile = DEFAULT_KEY) -> None:
    """Create your signing key. It proves who you are: keep it, and keep it secret.

    Examples:

      sme-leaderboard keygen

      sme-leaderboard keygen --key lab.key
    """
    signing_key = SigningKey.generate()
    path = signing_key.write(key)
    out().print(f"{escape(str(path))}\npublic key {signing_key.public}", soft_wrap=True)


@app.command("export", hidden=True)
@app.command()
def export_sb3(
    model: Annotated[Path, typer.Argument(metavar="MODEL.zip", help="A model saved by SB3.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", "-o", help="MODEL.onnx by default.")
    ] = None,
    vec_normalize: Annotated[
        Path | None, typer.Option(help="The saved statistics of VecNormalize.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Export an SB3 model's deterministic policy to ONNX, action range and clipping included.

    A .zip of Stable-Baselines3 contains code: open only files from authors you trust.

    Examples:

      sme-leaderboard export-sb3 runs/demo/model.zip
    """
    from leaderboard.bundle import export_sb3 as export

    target = model.with_suffix(".onnx") if out_file is None else out_file
    check_new(target, force=force)
    path = export(model, target, vec_normalize=vec_normalize)
    out().print(f"{escape(str(path))}, {path.stat().st_size:,} bytes", soft_wrap=True)


@app.command()
def new(
    bundle: BundleFolder,
    runs: Annotated[
        list[str],
        typer.Option(
            "--runs",
            help="Run folders of `sme train`, a folder of `sme study run --keep-models`, or a file "
            "runs.json that lists spec, policy, steps and seed of each run, with policy null if it "
            "failed. Accepts patterns; repeatable.",
        ),
    ],
    method: MethodName,
    submitter: SubmitterName,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="BOARD",
            help="The folder or URL of the only board that shall accept it, whose suite the runs "
            "are of. Without it, `submit` signs it for the board that it is sent to.",
            parser=board_or_url,
        ),
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(
            help="Without --board: a suite's name (see `sme list`) or file, or a board that has "
            "it; smoke-v1 by default.",
            autocompletion=catalogue.completion(SuiteFile),
        ),
    ] = None,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm", "-a", help="Of --runs with several algorithms, the one to submit."
        ),
    ] = None,
    method_version: MethodVersion = "1",
    family: Family = None,
    knowledge: Annotated[
        Knowledge,
        typer.Option(
            metavar="LEVEL",
            help="What the method knows of the task. generic: nothing. family: that it is an SME. "
            "oracle: its optimal policy.",
        ),
    ] = "generic",
    code: CodeLink = None,
    statement: Statement = "",
    started: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CLASS=N",
            help="Number of runs started in a class, if it exceeds those listed; the others "
            "score 1. Repeatable.",
        ),
    ] = None,
    key: KeyFile = DEFAULT_KEY,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing bundle.")] = False,
) -> None:
    """Create a signed submission from trained runs.

    Every instance of the suite needs a run; `sme show smoke` lists the instances. A study of the
    suite trains on all of them.

    Examples:

      sme study run smoke --folder runs/smoke --keep-models

      sme-leaderboard new ppo --runs runs/smoke -a PPO --method PPO --submitter "A Lab"

      sme train sha256:dfe78aa6aba8 --algorithm TD3 --seed 0

      sme-leaderboard new td3 --runs 'runs/*' --method TD3 --submitter "A Lab"

      sme-leaderboard new ppo --board board --runs runs/smoke --method PPO --submitter "A Lab"
    """

    if board is not None and suite is not None:
        raise OptionError("--board, --suite: the board has a suite. Leave out --suite.")
    folders = _expanded(runs)
    document = None if board is None else board_document(board)
    file = find_suite(suite or "smoke-v1") if document is None else document.suite_file
    receiver = NOBODY if board is None else receiver_of(board)
    with Progress("exporting", max(1, len(folders)), console=err(), unit="runs") as progress:
        new_bundle = make_bundle(
            bundle,
            suite=file,
            key=SigningKey.read(key),
            runs=folders,
            method=method,
            version=method_version,
            family=family or method,
            knowledge=knowledge,
            submitter=submitter,
            code=code,
            statement=statement,
            runs_started=_runs_started(started or []),
            algorithm=algorithm,
            receiver=receiver,
            force=force,
            progress=progress.update_of,
        )
    runs_listed = len(new_bundle.signed.content.runs)
    out().print(f"{new_bundle.signed.id}\n{runs_listed} runs", soft_wrap=True)
    target = escape(board or "BOARD")
    out().print(f"Next: sme-leaderboard check {escape(str(bundle))} {target}", soft_wrap=True)


def _expanded(patterns: list[str]) -> list[Path]:
    """The paths that match, in the patterns' order, without duplicates."""
    paths: dict[Path, None] = {}
    for pattern in patterns:
        path = Path(pattern)
        matches = [path]
        if not path.exists():
            root = Path(path.anchor) if path.is_absolute() else Path()
            matches = sorted(root.glob(str(path.relative_to(path.anchor))))
        if not matches:
            raise OptionError(f"runs={pattern!r}: no such folder or file. Correct the path.")
        paths |= dict.fromkeys(matches)
    return list(paths)


def _runs_started(pairs: list[str]) -> dict[str, int]:
    counts = {}
    for pair in pairs:
        name, equals, count = pair.partition("=")
        if not equals or not count.strip().isdecimal():
            raise OptionError(f"started={pair!r}: must be CLASS=N, as in --started default=12.")
        counts[name.strip()] = int(count)
    return counts


@app.command()
def check(
    bundle: BundleFolder,
    board: Annotated[
        str | None,
        typer.Argument(
            metavar="BOARD",
            help="The folder or URL of the board to submit to; default a board of the suite with "
            "the protocol paper-v1.",
            parser=board_or_url,
        ),
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(help="Without BOARD: the suite's file, if it is not in the catalogue."),
    ] = None,
    protocol: Annotated[
        str | None,
        typer.Option(
            help="Without BOARD: a protocol's name (see `sme list`) or file.",
            autocompletion=complete_protocol,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Score a submission locally, exactly as the board does: all checks, sandbox and scores.

    Examples:

      sme-leaderboard check td3 board

      sme-leaderboard check td3 --protocol quick-v1
    """

    content = Bundle.read(bundle)
    submission = content.signed.content
    if board is None:
        document = _board_of(find_suite(suite or submission.suite.name), protocol or "paper-v1")
    elif suite is None and protocol is None:
        document = board_document(board)
    else:
        raise OptionError("--suite, --protocol: BOARD has both. Leave them out, or BOARD.")
    check_submission(document, submission, datetime.datetime.now(datetime.UTC))
    with Progress("scoring", len(submission.runs), console=err(), unit="states") as progress:
        result = score_submission(
            document,
            submission,
            content.artefact,
            progress=progress.update_of,
            isolation=isolation_for_own(),
        )
    if json:
        print_json(result.to_dict())
    if result.status == "rejected":
        raise Rejection(result.code, result.message)
    if not json:
        _print_scores(result)


def _board_of(file: SuiteFile, protocol: str) -> BoardDocument:
    """A board of a suite that does not exist, to score by."""

    return BoardDocument(
        title="check",
        suite_name=file.versioned_name,
        suite=file.suite,
        protocol_name=Path(protocol).stem,
        protocol=resolve_protocol(protocol),
        key="0" * 64,
        rules=RULES,
    )


def _print_scores(result: Result) -> None:
    for name, metric in RANKED.items():
        value = getattr(result.scores, name)
        ends = f"  ({value.low:.4f} to {value.high:.4f})" if value.interval else ""
        out().print(f"{metric.label:18s} {value.value:.4f}{ends}")
    fewest = min(member.runs for member in result.classes)
    known = result.scores is not None and result.scores.wd_regret.interval is not None
    kind = "95 % intervals over runs" if known else "no intervals: the spread of one run is unknown"
    out().print(f"{kind}; fewest runs in a class: n = {fewest}", style="dim")
    if not result.enough_runs:
        out().print("The board will list it without a rank: too few runs on an instance.")
    if result.oracle_like:
        out().print("The board will mark it oracle-like, which requires the method's code.")


@app.command()
def submit(
    bundle: BundleFolder,
    board: BoardOrUrl,
    key: KeyFile = DEFAULT_KEY,
) -> None:
    """Send a submission to a board's folder or to a served board.

    Sending the same one twice changes nothing. The key signs it for this board, unless `new
    --board` did, and signs the uploads to a served board.

    Examples:

      sme-leaderboard submit td3 board

      sme-leaderboard submit td3 http://127.0.0.1:8000
    """

    signed = Bundle.read(bundle).signed
    if is_url(board):
        total = len(signed.content.runs)
        with Progress("uploading", total, console=err(), unit="artefacts") as progress:
            id = client.submit(board, bundle, SigningKey.read(key), progress=progress.update_of)
        out().print(id, soft_wrap=True)
        err().print(client.page_of(board, id), soft_wrap=True)
        err().print(f"Next: sme-leaderboard show {escape(board)} {id}", soft_wrap=True)
    else:
        with Board.open(Path(board)) as store:
            signing_key = SigningKey.read(key) if signed.board is None else None
            out().print(admission.submit_bundle(store, bundle, signing_key), soft_wrap=True)


@app.command()
def withdraw(
    board: BoardOrUrl,
    id: Annotated[
        str,
        typer.Argument(
            metavar="ID",
            help="The submission's id: in full for a URL; its first digits suffice for a folder.",
        ),
    ],
    reason: Annotated[str, typer.Option(help="Reason, shown on its page.")] = "",
    key: KeyFile = DEFAULT_KEY,
) -> None:
    """Withdraw your submission. Its page stays and shows the withdrawal.

    A URL needs the full id, as `submit` prints it; for a folder, its first digits suffice.

    Examples:

      sme-leaderboard withdraw board 3f2a --reason "a bug in the wrapper"

      sme-leaderboard withdraw https://board.example sha256:… --reason "a bug in the wrapper"
    """

    signing_key = SigningKey.read(key)
    if is_url(board):
        client.withdraw(board, id, signing_key, reason)
    else:
        with Board.open(Path(board)) as store:
            id = find_entry(store, id).id
            withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
            store.withdraw(withdrawal.signed(signing_key, Receiver(store.document.key)))
    out().print(f"{id} withdrawn", soft_wrap=True)

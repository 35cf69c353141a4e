"""`sme-leaderboard submit · withdraw`: send a method to a board, and take it back."""

from __future__ import annotations

import datetime
import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from leaderboard import admission
from leaderboard.admission import check_submission
from leaderboard.bundle import Bundle, make_bundle
from leaderboard.cli.results import Board, BoardOrUrl, Json, SubmissionId, find_entry, is_url
from leaderboard.documents.board import FILE as BOARD
from leaderboard.documents.board import BoardDocument, Folder, refuse_unscored
from leaderboard.documents.result import RANKED, Result
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.documents.submission import FILE, Description, Knowledge, Withdrawal, now
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import isolation_for_own
from leaderboard.scoring.score import score_submission
from leaderboard.web import client
from sme_registry.errors import OptionError
from sme_registry.io.terminal import Progress, err, out, print_json, print_line, print_note
from sme_registry.spec import SuiteFile, catalogue

KEY_VARIABLE = "SME_LEADERBOARD_KEY"
DEFAULT_KEY = Path(typer.get_app_dir("sme-leaderboard")) / "ed25519.key"
KeyFile = Annotated[
    Path,
    typer.Option(
        "--key",
        envvar=KEY_VARIABLE,
        help="Your signing key, created when you first need it.",
        show_default="sme-leaderboard/ed25519.key in your settings folder",
    ),
]

ADVANCED = "Advanced"
"""The panel of the options that few need, where a command has more than ten."""

method_name = typer.Option(
    "--method", help="Name of the method: letters a–z, digits, single spaces and ._+-()."
)
submitter_name = typer.Option(
    "--submitter",
    help="Your name or your lab's; on a board it belongs to the first key that uses it.",
)
MethodName = Annotated[str, method_name]
SubmitterName = Annotated[str, submitter_name]
MethodVersion = Annotated[
    str, typer.Option(help="Version of the method.", rich_help_panel=ADVANCED)
]
Family = Annotated[
    str | None,
    typer.Option(
        help="Family such as PPO; the method's name by default.", rich_help_panel=ADVANCED
    ),
]
CodeLink = Annotated[str | None, typer.Option("--code", help="An https link to the code.")]
Statement = Annotated[
    str, typer.Option(help="A note for readers of the board.", rich_help_panel=ADVANCED)
]


def own_key(path: Path) -> SigningKey:
    """The user's signing key, created when it is first needed."""
    if not path.exists():
        SigningKey.generate().write(path)
        print_note(
            f"Created your signing key, {escape(str(path))}. It proves who you are: keep it "
            "secret, and keep a copy."
        )
    return SigningKey.read(path)


def board_document(board: str) -> BoardDocument:
    """The definition of a board, by its folder or URL."""
    return client.board_document(board) if is_url(board) else Folder(board).read()


def receiver_of(board: str) -> Receiver:
    """For whom to sign what is given to a board, by its folder or URL; errors as above."""
    return client.receiver_of(board) if is_url(board) else Receiver(Folder(board).read().key)


SuiteName = Annotated[
    str,
    typer.Option(
        help="A suite's name (see `sme list`) or file, or the board that has it.",
        autocompletion=catalogue.completion(SuiteFile),
    ),
]


def find_suite(name: str) -> SuiteFile:
    """A suite by its name in the catalogue, its file's path, or a board that has it."""
    if is_url(name) or os.path.isfile(os.path.join(name, BOARD)):
        return board_document(name).suite_file
    file = catalogue.find(SuiteFile, name)
    refuse_unscored(file.suite)
    return file


app = typer.Typer()


@app.command()
def submit(
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUNS",
            help="Folders of `sme train` or `sme study run --keep-models`, or a file runs.json "
            "that lists spec, policy, steps and seed of each run, with policy null if it failed; "
            "or the folder of a bundle that --out has written. Accepts patterns.",
        ),
    ],
    board: BoardOrUrl,
    method: Annotated[str | None, method_name] = None,
    submitter: Annotated[str | None, submitter_name] = None,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm", "-a", help="Of RUNS with several algorithms, the one to submit."
        ),
    ] = None,
    knowledge: Annotated[
        Knowledge,
        typer.Option(
            metavar="LEVEL",
            help="What the method knows of the task. generic: nothing. family: that it is an SME. "
            "oracle: its optimal policy.",
        ),
    ] = "generic",
    code: CodeLink = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Score the runs here, and send nothing.")
    ] = False,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="BUNDLE", help="Keep the signed bundle as a folder."),
    ] = None,
    key: KeyFile = DEFAULT_KEY,
    json: Json = False,
    method_version: MethodVersion = "1",
    family: Family = None,
    statement: Statement = "",
    started: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CLASS=N",
            help="Number of runs started in a class, if it exceeds those listed; the others "
            "score 1. Repeatable.",
            rich_help_panel=ADVANCED,
        ),
    ] = None,
    no_check: Annotated[
        bool,
        typer.Option(
            "--no-check", help="Send without scoring here first.", rich_help_panel=ADVANCED
        ),
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Replace the bundle of --out.", rich_help_panel=ADVANCED),
    ] = False,
) -> None:
    """Submit trained runs to a board: export, score here, sign and send them.

    The scores are those that the board computes itself. Every instance of its suite needs a run:
    `sme train --suite` trains on all. Your signing key, which proves who you are, is created when
    you first need it.

    Examples:

      sme-leaderboard submit runs/smoke board --method PPO --submitter "A Lab"

      sme-leaderboard submit runs/smoke https://board.example --method PPO --submitter "A Lab"

      sme-leaderboard submit 'runs/td3-*' board --method TD3 --submitter "A Lab" --dry-run -o td3

      sme-leaderboard submit td3 board
    """
    described = {
        "--method": method,
        "--submitter": submitter,
        "--algorithm": algorithm,
        "--code": code,
        "--out": out_folder,
        "--family": family,
        "--statement": statement,
        "--started": started,
    }
    document = board_document(board)
    folders = _expanded(runs)
    with tempfile.TemporaryDirectory() as temporary:
        if len(folders) == 1 and (folders[0] / FILE).exists():
            _refuse_described(described)
            bundle = Bundle.read(folders[0])
            signs = is_url(board) or bundle.signed.board is None
            signing_key = SigningKey.read(key) if signs else None
        else:
            if not (method and submitter):
                raise OptionError("--method, --submitter: both are required to submit runs.")
            signing_key = own_key(key)
            description = Description(
                method, submitter, method_version, family, knowledge, code, statement
            )
            total = len(folders)
            with Progress("exporting", total, console=err(), unit="runs") as progress:
                bundle = make_bundle(
                    out_folder or Path(temporary, "bundle"),
                    description,
                    suite=document.suite_file,
                    key=signing_key,
                    runs=folders,
                    runs_started=_runs_started(started or []),
                    algorithm=algorithm,
                    receiver=receiver_of(board),
                    force=force,
                    progress=progress.update,
                )
        check_submission(document, bundle.signed.content, datetime.datetime.now(datetime.UTC))
        result = None if no_check else _scored(document, bundle, dry_run)
        if result is not None and result.status == "rejected":
            raise Rejection(result.code, result.message)
        if not dry_run:
            _send(board, bundle, signing_key)
    _print_outcome(board, bundle.signed.id, result, not dry_run, json)


def _refuse_described(options: dict[str, Any]) -> None:
    """A bundle is signed: nothing of it can change."""
    given = [name for name, value in options.items() if value]
    if given:
        raise OptionError(
            f"{', '.join(given)}: RUNS is a bundle, which has them already. Leave them out, or "
            "give the runs."
        )


def _expanded(patterns: list[str]) -> list[Path]:
    """The paths that match, in the patterns' order, without duplicates."""
    paths: dict[Path, None] = {}
    for pattern in patterns:
        path = Path(pattern)
        matches = [path]
        if not path.exists():
            root = Path(path.anchor) if path.is_absolute() else Path()
            try:
                matches = sorted(root.glob(str(path.relative_to(path.anchor))))
            except (ValueError, NotImplementedError) as error:
                raise OptionError(f"runs={pattern!r}: {error}. Correct the pattern.") from None
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


def _scored(document: BoardDocument, bundle: Bundle, required: bool) -> Result | None:
    """The result that the board will compute; None where policies cannot run."""
    if sys.platform != "linux" and not required:
        print_note("Not scored here: the sandbox needs Linux. The board scores it.")
        return None
    submission = bundle.signed.content
    with Progress("scoring", len(submission.runs), console=err(), unit="states") as progress:
        return score_submission(
            document,
            submission,
            bundle.artefact,
            progress=progress.update,
            isolation=isolation_for_own(),
        )


def _send(board: str, bundle: Bundle, key: SigningKey | None) -> None:
    """Send a bundle; sending it twice changes nothing."""
    if not is_url(board):
        with Board.open(Path(board)) as store:
            admission.submit_bundle(store, bundle.folder, key)
        return
    assert key is not None  # uploads are signed
    total = len(bundle.signed.content.runs)
    with Progress("uploading", total, console=err(), unit="artefacts") as progress:
        client.submit(board, bundle.folder, key, progress=progress.update)


def _print_outcome(board: str, id: str, result: Result | None, sent: bool, json: bool) -> None:
    page = client.page_of(board, id) if sent and is_url(board) else None
    if json:
        plain = None if result is None else result.to_dict()
        print_json({"id": id, "sent": sent, "page": page, "result": plain})
        return
    if result is not None:
        _print_scores(result)
    print_line(id)
    if not sent:
        print_note("Nothing was sent.")
        return
    if page is None:
        print_note(f"Next: sme-leaderboard score {escape(board)}")
    else:
        print_note(f"{escape(page)}\nThe board scores it in its turn.")
    show = f"sme-leaderboard show {escape(board)} {id}"
    print_note(f"Its place in the queue, then its scores: {show}")


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
def withdraw(
    board: BoardOrUrl,
    id: SubmissionId,
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
            admission.withdraw(store, withdrawal.signed(signing_key, Receiver(store.document.key)))
    print_line(f"{id} withdrawn")

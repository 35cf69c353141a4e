"""`check_submission`: whether a board accepts a signed submission.

Checks that the schema cannot express, in this order. The first failure is reported:

    unsafe_name      names, texts and links contain only safe characters, and no name imitates
                     the board's own
    unknown_suite    suite is the board's
    schema           the time exists
    stale_time       and is near the board's
    unknown_spec     every run is on an instance of the suite
    duplicate_run    no run, and no artefact within one instance, is listed twice
    missing_run      every instance has a run, a run has a policy, and every class a count of the
                     runs started
    schema           that count fits into a result
    too_large        no artefact exceeds the board's limit

Reference submissions, signed by the board itself, pass the same checks.
"""

from __future__ import annotations

import datetime
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence

from leaderboard.documents.board import RULES, BoardDocument
from leaderboard.documents.signed import MAX_BYTES, Receiver, Signed
from leaderboard.documents.submission import (
    MAX_ARTEFACT_BYTES,
    MAX_RUNS,
    Artefact,
    Manifest,
    Method,
    Run,
    Submission,
    Submitter,
)
from leaderboard.errors import BoardError, Rejection
from sme_registry.spec import Suite

THE_BOARD, REFERENCE_FAMILY = "the board", "reference"
"""Submitter and family reserved for the board's own reference rows."""

MINUTES_AHEAD = 10
_MAX_RUNS_1 = 10_000  # by rules 1

# ASCII only: a similar letter of another script would let one method imitate another.
_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._+()-]| (?=[A-Za-z0-9._+()-]))*")
_LINK = re.compile(r"https://[A-Za-z0-9._~:/?#\[\]@!$&'()*+,;=%-]+")
_LOOK_ALIKE = str.maketrans(
    {"0": "o", "1": "l", "i": "l", "2": "z", "3": "e", "4": "a", "5": "s", "8": "b"}
)
_PAIRS_ALIKE = {"rn": "m", "vv": "w", "cl": "d"}  # cl after i and 1 have become l
# Control characters, format characters (some reverse the direction of text), surrogates,
# line separators and paragraph separators.
_UNSAFE_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp")


def check_submission(board: BoardDocument, submission: Submission, at: datetime.datetime) -> None:
    """Reject a submission that this board does not accept.

    Args:
      board: the board.
      submission: with a verified signature.
      at: the board's time, with a time zone.

    Raises:
      Rejection: the first code that applies, in the order above.
    """
    check_names(submission, board.key)
    expected = board.suite_reference
    if submission.suite != expected:
        raise Rejection(
            "unknown_suite",
            f"suite={submission.suite.name}, {submission.suite.digest}: must be "
            f"{expected.name}, {expected.digest}. Create a bundle for this board's suite.",
        )
    check_time(submission.created, at, board.limits.age_days)
    check_runs(board.suite, submission)
    for index, run in enumerate(submission.runs):
        if run.artefact is not None and run.artefact.size > board.limits.artefact_bytes:
            raise Rejection(
                "too_large",
                f"runs.{index}.artefact.size={run.artefact.size:,}: must be at most "
                f"{board.limits.artefact_bytes:,} bytes on this board. Submit a smaller network.",
            )


def check_receiver(board: BoardDocument, receiver: Receiver, address: str | None = None) -> None:
    """Reject (`wrong_board`) a signature that is not for this board, or not for its address.

    Otherwise a server that stands between could pass on what it was sent, and take part in another
    board under the sender's name.

    Args:
      board: the board.
      receiver: that the signature is for.
      address: of the server that it was sent to; None if it was given to the board's folder.
    """
    if board.signatures_for is None:
        raise Rejection(
            "wrong_board",
            f"board={board.key[:16]}…: follows earlier rules ({board.rules}) and accepts nothing. "
            "Submit to a board that was created later.",
        )
    if receiver.board != board.signatures_for:
        stated = "none" if receiver.board is None else f"{receiver.board[:16]}…"
        raise Rejection(
            "wrong_board",
            f"board={stated}: the signature must be for this board, {board.key[:16]}…. Send a "
            "bundle that is signed for no board with `sme-leaderboard submit`, or create it with "
            "`sme-leaderboard new --board`.",
        )
    if address not in (None, receiver.address):
        raise Rejection(
            "wrong_board",
            f"address={receiver.address or 'none'}: the signature must be for this board's "
            f"address, {address}. Send it there, with a present version of sme-registry; if the "
            "board has another address by now, its owner must state it (`serve --url`).",
        )


def check_names(manifest: Manifest, board_key: str | None = None) -> None:
    """Reject what is unsafe to show: markup, formulas, control characters, the board's own names.

    Args:
      manifest: a submission, an entry or a request for a ticket.
      board_key: the key that may use the board's names; None if the board is not known yet.

    Raises:
      Rejection: `unsafe_name`.
    """
    method, training = manifest.method, manifest.training
    for field, name in (
        ("method.name", method.name),
        ("method.version", method.version),
        ("method.family", method.family),
        ("submitter.name", manifest.submitter.name),
    ):
        if not _NAME.fullmatch(name):
            raise Rejection(
                "unsafe_name",
                f"{field}={name!a}: must begin with a letter or digit, and contain only "
                "letters a–z, digits, single spaces and '._+-()'. Rename it.",
            )
    for field, name, reserved in (
        ("submitter.name", manifest.submitter.name, THE_BOARD),
        ("method.family", method.family, REFERENCE_FAMILY),
    ):
        if skeleton(name) == skeleton(reserved) and manifest.submitter.key != board_key:
            raise Rejection(
                "unsafe_name",
                f"{field}={name!a}: reserved for the board's own reference rows. Rename it.",
            )
    if manifest.code is not None and not _LINK.fullmatch(manifest.code):
        raise Rejection(
            "unsafe_name",
            f"code={manifest.code!a}: must contain only the characters of a URL. "
            "Write others as %XX.",
        )
    for field, text in (
        ("training.library", training.library),
        ("training.hyperparameters", training.hyperparameters),
        ("training.hardware", training.hardware),
        ("statement", manifest.statement),
    ):
        check_text(field, text)


def check_text(field: str, text: str) -> None:
    """Reject (`unsafe_name`) a text whose invisible characters could disguise other text."""
    for letter in text:
        if letter != "\n" and unicodedata.category(letter) in _UNSAFE_CATEGORIES:
            raise Rejection(
                "unsafe_name",
                f"{field}: contains {letter!a}: must contain no control characters except line "
                "breaks. Remove it.",
            )


def skeleton(name: str) -> str:
    """What is left of a name without the differences that readers overlook.

    Case, spaces and punctuation do not matter, and letters and digits that look alike are one
    letter, such as O and 0; l, I and 1; or m and rn. The result is for comparison only.
    """
    folded = unicodedata.normalize("NFKC", name).casefold()
    letters = "".join(letter for letter in folded if letter.isalnum())
    letters = letters.translate(_LOOK_ALIKE)
    for pair, letter in _PAIRS_ALIKE.items():
        letters = letters.replace(pair, letter)
    return letters


def check_runs(
    suite: Suite, submission: Submission, sources: Sequence[str] = (), rules: int = RULES
) -> None:
    """Reject runs that are not on the suite's instances, listed twice, missing or not counted.

    Args:
      suite: the board's suite.
      submission: the submission.
      sources: what to call each run in an error, such as its folder; empty for `runs.0`, ….
      rules: of the board. Rules 1 admit submissions without a policy and 10,000 runs started.

    Raises:
      Rejection: `unknown_spec`, `duplicate_run`, `missing_run`, or `schema` if more runs were
        started than are allowed.
    """
    class_of = {spec.digest: member.name for member in suite.classes for spec in member.instances}
    for index, run in enumerate(submission.runs):
        if run.spec not in class_of:
            raise Rejection(
                "unknown_spec",
                f"runs.{index}.spec={run.spec}: must be the digest of one of the suite's "
                f"{len(class_of)} instances (`sme show {submission.suite.name}`). Train on those, "
                "or submit to a board of its suite.",
            )
    _check_duplicates(submission, sources or [f"runs.{i}" for i in range(len(submission.runs))])
    ran = {run.spec for run in submission.runs}
    for digest, name in class_of.items():
        if digest not in ran:
            raise Rejection(
                "missing_run",
                f"runs: none on {digest} of class {name}: every instance must have one. "
                "Train on it, or list a failed run (policy null in runs.json), which scores 1.",
            )
    if rules > 1 and all(run.artefact is None for run in submission.runs):
        raise Rejection(
            "missing_run", "runs: none has a policy: at least one must. Submit a trained policy."
        )
    listed = Counter(class_of[run.spec] for run in submission.runs)
    _check_started(submission, listed, MAX_RUNS if rules > 1 else _MAX_RUNS_1)


def refuse_unsubmittable(board: BoardDocument) -> None:
    """Refuse a board whose suite needs more runs than a submission can list.

    An entry needs `runs_to_rank` runs in each class, the same number on each instance.

    Raises:
      BoardError: they exceed the size limit of a submission.
    """
    needed, most = board.runs_needed, most_runs(board)
    if needed > most:
        raise BoardError(
            f"suite={board.suite_name}: a ranked entry needs {needed:,} runs, "
            f"{board.runs_to_rank} in each class and as many on each instance: must be at most "
            f"{most}, which fit into the {MAX_BYTES:,} bytes of a submission. Use fewer classes or "
            "instances, or lower runs_to_rank."
        )


def most_runs(board: BoardDocument) -> int:
    """Number of runs that fit into a submission to a board, with short texts."""
    digest = board.suite.digest
    run = Run(
        spec=digest,
        seed=10**6,
        steps=10**7,
        artefact=Artefact(sha256=digest, size=MAX_ARTEFACT_BYTES),
    )
    submission = Submission(
        suite=board.suite_reference,
        method=Method(name="x" * 20, version="1.0", family="x" * 20, knowledge="generic"),
        submitter=Submitter(name="x" * 20, key=board.key),
        created="2026-01-01T00:00:00Z",
        runs=(run,),
        runs_started={member.name: 100 for member in board.suite.classes},
    )
    one, two = (
        len(Signed[Submission](content=each, signature="0" * 128).to_bytes())
        for each in (submission, submission.model_copy(update={"runs": (run, run)}))
    )
    return 1 + (MAX_BYTES - one) // (two - one)


def check_time(created: str, at: datetime.datetime, age_days: int) -> None:
    """Reject a time of signing that does not exist (`schema`), or is not near `at` (`stale_time`).

    Args:
      created: as documents write it.
      at: the board's time.
      age_days: the age of the oldest accepted signature.
    """
    try:
        moment = datetime.datetime.fromisoformat(created)
    except ValueError:
        raise Rejection(
            "schema", f"created={created!r}: must be an existing time. Correct it."
        ) from None
    if moment - at > datetime.timedelta(minutes=MINUTES_AHEAD):
        raise Rejection(
            "stale_time",
            f"created={created}: must be at most {MINUTES_AHEAD} minutes ahead of the board's "
            "clock. Set your clock, and sign again.",
        )
    if at - moment > datetime.timedelta(days=age_days):
        raise Rejection(
            "stale_time",
            f"created={created}: must be at most {age_days} days old. Sign again.",
        )


def _check_duplicates(submission: Submission, sources: Sequence[str]) -> None:
    first: dict[tuple[str, str, int | str], int] = {}
    for index, run in enumerate(submission.runs):
        values: list[tuple[str, int | str]] = [("seed", run.seed)]
        if run.artefact is not None:
            values.append(("policy", run.artefact.sha256))
        for name, value in values:
            before = first.setdefault((run.spec, name, value), index)
            if before != index:
                raise Rejection(
                    "duplicate_run",
                    f"{sources[index]}: {name}={value}: {sources[before]} has the same spec and "
                    f"{name}. Remove one of them.",
                )


def _check_started(submission: Submission, listed: Counter[str], most: int) -> None:
    started = submission.runs_started
    for name in started:
        if name not in listed:
            raise Rejection(
                "missing_run",
                f"runs_started.{name}: must be a class of the suite: {', '.join(listed)}. "
                "Rename or remove it (option --started).",
            )
    for name, count in listed.items():
        if started.get(name, 0) < count:
            raise Rejection(
                "missing_run",
                f"runs_started.{name}={started.get(name)}: must be at least {count}, the number of "
                "listed runs. Count every run that was ever started with this method (option "
                "--started).",
            )
    if sum(started.values()) > most:
        raise Rejection(
            "schema",
            f"runs_started={sum(started.values())}: must be at most {most:,} in total. "
            "Count the runs of this version of the method only.",
        )

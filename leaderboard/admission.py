"""What a board accepts: uploads, submissions, and its own reference rows.

An upload is permitted by a signature for one object and ten minutes:

    Authorization: SME-Ed25519 key=…,board=…,address=…,time=<utc>,signature=<128 hex digits>
    signature = Ed25519(key, "sme-leaderboard/upload/" board "/" address "/" digest " " time)

A submission of uploaded policies is checked, then stored:

    for this board? → known? → document → policies present → gate → name → quotas → room → store

The order is fixed, so that one fault always has one code. What another submission can change is
decided once, in the transaction that stores it. The gate's verdicts are kept, so a key that is
beyond its quota costs no more than the files that it has uploaded.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

from leaderboard.bundle import Bundle
from leaderboard.documents.board import BoardDocument, check_receiver
from leaderboard.documents.signed import Receiver, Signed, SigningKey, verifies
from leaderboard.documents.submission import (
    REFERENCE_FAMILY,
    THE_BOARD,
    Artefact,
    Knowledge,
    Manifest,
    Method,
    Run,
    Submission,
    Submitter,
    Withdrawal,
    check_names,
    check_runs,
    check_text,
    now,
    shifted,
    utc,
)
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation, isolation_for_own
from leaderboard.gate.networks import constant_onnx, optimal_onnx
from leaderboard.gate.sandbox import Confined, widths
from leaderboard.store import Store, unknown_submission
from leaderboard.store.log import DAY, expire_uploads
from sme_registry.io import sha256_of
from sme_registry.spec import SMESpec

UPLOAD_MINUTES = 10
MINUTES_AHEAD = 10
_HEADER = re.compile(
    r"SME-Ed25519 key=([0-9a-f]{64}),"
    r"(?:board=([0-9a-f]{64}),)?"
    r"(?:address=([!-+\--~]{1,300}),)?"
    r"time=(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ),"
    r"signature=([0-9a-f]{128})"
)

_VERDICTS_KEPT = 10_000
ReadFile = Callable[[str], bytes]

_Case = tuple[str, int, int]
"""The digest of a policy file, and the widths of a task."""

_verdicts: dict[_Case, Rejection | None] = {}
"""Of the gate."""


def upload_header(key: SigningKey, digest: str, receiver: Receiver, time: str | None = None) -> str:
    """The value of `Authorization` that lets a key upload an object of this digest at a time."""
    time = time or now()
    signature = key.sign("upload", f"{digest} {time}", receiver)
    named = "".join(f"{name}={value}," for name, value in receiver._asdict().items() if value)
    return f"SME-Ed25519 key={key.public},{named}time={time},signature={signature}"


def uploader(board: BoardDocument, header: str | None, digest: str, address: str) -> str:
    """The public key whose header permits an upload to a server's address now; or a `Rejection`."""
    match = _HEADER.fullmatch(header or "")
    if match is None:
        raise Rejection(
            "bad_signature",
            "Authorization: must be `SME-Ed25519 key=…,board=…,address=…,time=…,signature=…`. Sign "
            "the upload.",
        )
    key, for_board, for_address, time, signature = match.groups()
    receiver = Receiver(for_board, for_address)
    check_receiver(board, receiver, address)
    if not verifies(key, signature, "upload", f"{digest} {time}", receiver):
        raise Rejection(
            "bad_signature",
            "Authorization: the signature does not match this object, this time and the key "
            f"{key[:16]}…. Sign each upload separately.",
        )
    here, fresh = now(), False
    with contextlib.suppress(ValueError):  # of a time that does not exist
        fresh = abs(_moment(here) - _moment(time)) <= datetime.timedelta(minutes=UPLOAD_MINUTES)
    if not fresh:
        raise Rejection(
            "stale_time",
            f"time={time}: must be within {UPLOAD_MINUTES} minutes of the board's {here}. "
            "Set your clock, and sign each upload just before sending it.",
        )
    return key


_moment = datetime.datetime.fromisoformat


def _a_day_ago(store: Store) -> str:
    """After which submissions and uploads count towards a day's quotas."""
    return utc(shifted(_moment(store.time), -DAY))


def check_upload(store: Store, key: str, size: int) -> None:
    """Reject so many bytes (`too_large`), or so many more of a key or on the board (`quota`)."""
    limits = store.document.limits
    if size > limits.artefact_bytes:
        raise Rejection(
            "too_large",
            f"object: {size:,} bytes: must be at most {limits.artefact_bytes:,}. "
            "Export a smaller network.",
        )
    used = store.uploaded_bytes(key, _a_day_ago(store))
    if used + size > limits.upload_bytes_per_day:
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has uploaded {used:,} of {limits.upload_bytes_per_day:,} bytes "
            "within 24 hours. Upload the rest 24 hours after the first of them.",
        )
    _check_room(store, size)


def _check_room(store: Store, size: int) -> None:
    """Reject (`quota`) so many bytes that do not fit onto a board, without expired uploads."""
    expire_uploads(store)
    if store.total_bytes() + size > store.document.limits.total_bytes:
        raise Rejection(
            "quota",
            f"board: its {store.document.limits.total_bytes:,} bytes are full. "
            "Send it again in an hour, or ask the board's owner to raise the limit.",
        )


def admit(
    store: Store,
    signed: Signed[Submission],
    policy_file: ReadFile | None = None,
    isolation: Isolation | None = None,
    address: str | None = None,
) -> bool:
    """Check a submission, its signature verified, and store it; False if the board has it.

    `policy_file` returns the bytes of a file, which are stored with it; by default the submitter's
    key has uploaded them. `address` is of the server that it was sent to; None for a folder.
    """
    check_receiver(store.document, signed.receiver, address)
    known = store.entry(signed.id)
    if known is not None:
        if known.status == "withdrawn":
            raise Rejection(
                "withdrawn",
                f"submission={signed.id}: was withdrawn by its submitter, which is final. "
                "Sign a new one.",
            )
        return False
    submission = signed.content
    key = submission.submitter.key
    # The board's own rows are signed at its opening, and added at any time.
    time = submission.created if key == store.document.key else store.time
    check_submission(store.document, submission, _moment(time))
    _check_files(store, submission, policy_file, isolation)
    with store.transaction():  # no other submission can use the quota or the name in between
        check_entrant(store, submission.submitter, len(signed.to_bytes()))
        if key != store.document.key:
            _check_queue(store)
        store_files(store, key, _policies(submission), policy_file)  # nor can `gc` take one
        return store.receive(signed)


def submit_bundle(
    store: Store, folder: str | os.PathLike[str], key: SigningKey | None = None
) -> str:
    """Admit a bundle, its policy files included, or store nothing; returns the id.

    `key`, the submitter's, signs a submission that is signed for no board yet.
    """
    bundle = Bundle.read(folder)
    signed = bundle.signed
    if key is not None:
        signed = signed.for_receiver(Receiver(store.document.key), key)
    admit(store, signed, policy_file=bundle.artefact, isolation=isolation_for_own())
    return signed.id


def withdraw(store: Store, signed: Signed[Withdrawal], address: str | None = None) -> bool:
    """Withdraw a submission, whose page stays; False if it was withdrawn before."""
    withdrawal = signed.content
    with store.transaction():
        row = store.entry(withdrawal.submission)
        if row is None:
            raise unknown_submission(withdrawal.submission)
        check_text("reason", withdrawal.reason)
        check_receiver(store.document, signed.receiver, address)
        if not signed.is_valid(signed.board, row.key):
            raise Rejection(
                "bad_signature",
                f"signature={signed.signature[:16]}…: does not match this withdrawal and the "
                f"key {row.key[:16]}…. Sign it with the key that signed the submission.",
            )
        return store.withdraw(signed)


def check_submission(board: BoardDocument, submission: Submission, at: datetime.datetime) -> None:
    """Reject what a board does not accept at its time `at`, whatever else is on it."""
    check_manifest(board, submission, at)
    expected = board.suite_reference
    if submission.suite != expected:
        raise Rejection(
            "unknown_suite",
            f"suite={submission.suite.name}, {submission.suite.digest}: must be "
            f"{expected.name}, {expected.digest}. Create a bundle for this board's suite.",
        )
    check_runs(board.suite, submission)
    for index, run in enumerate(submission.runs):
        if run.artefact is not None and run.artefact.size > board.limits.artefact_bytes:
            raise Rejection(
                "too_large",
                f"runs.{index}.artefact.size={run.artefact.size:,}: must be at most "
                f"{board.limits.artefact_bytes:,} bytes on this board. Submit a smaller network.",
            )


def check_manifest(board: BoardDocument, manifest: Manifest, at: datetime.datetime) -> None:
    """Reject unsafe names and texts, and a time that is not near the board's."""
    check_names(manifest, board.key)
    created, age_days = manifest.created, board.limits.age_days
    try:
        moment = _moment(created)
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


def check_entrant(store: Store, submitter: Submitter, size: int) -> None:
    """Decide, in the transaction that stores so many bytes, whether a key may send them.

    The board's own key has no quota: nothing is shown without the reference rows.
    """
    holder = store.holder_of_name(submitter.name)
    if holder not in (None, submitter.key):
        raise Rejection(
            "name_taken",
            f"submitter.name={submitter.name!a}: on this board it belongs to the key "
            f"{holder[:16]}…, which was the first to use it. Choose another name, or sign with "
            "that key.",
        )
    key, most = submitter.key, store.document.limits.submissions_per_day
    if key == store.document.key:
        return
    times = store.submission_times(key, _a_day_ago(store))
    if len(times) >= most:
        free = shifted(_moment(times[-most]), DAY)
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has sent {len(times)} of {most} submissions within 24 hours. Send "
            f"the next one after {utc(free)}.",
        )
    _check_room(store, size)


def _check_queue(store: Store) -> None:
    waiting = store.queue.count("queued")  # those that faults have stopped take nobody's place
    most = store.document.limits.waiting_submissions
    if waiting >= most:
        raise Rejection(
            "quota",
            f"board: the queue is full, with {waiting} of {most} waiting submissions. Send it "
            "again when some of them are scored.",
        )


def _policies(submission: Submission) -> list[Artefact]:
    """Each distinct policy file, in the order of the runs."""
    return list(
        {run.artefact.sha256: run.artefact for run in submission.runs if run.artefact}.values()
    )


def _check_files(
    store: Store,
    submission: Submission,
    policy_file: ReadFile | None,
    isolation: Isolation | None,
) -> None:
    """Check that all are present with the declared sizes; then inspect one after the other."""
    if policy_file is None:
        store_files(store, submission.submitter.key, _policies(submission), None)
    instances = store.document.instances
    cases = dict.fromkeys(
        (run.artefact.sha256, *widths(instances[run.spec][1]))
        for run in submission.runs
        if run.artefact
    )
    _inspect(policy_file or store.objects.read, list(cases), isolation)


def _inspect(read: ReadFile, cases: list[_Case], isolation: Isolation | None) -> None:
    """Raise the gate's first verdict, which depends on bytes and widths only, and is kept."""
    if len(_verdicts) >= _VERDICTS_KEPT:
        _verdicts.clear()
    unknown = [case for case in cases if case not in _verdicts]
    if unknown:
        with Confined(isolation=isolation) as confined:
            for digest, observation_dim, action_dim in unknown:
                try:
                    confined.inspect(read(digest), observation_dim, action_dim)
                except Rejection as rejection:
                    _verdicts[digest, observation_dim, action_dim] = rejection
                    break
                _verdicts[digest, observation_dim, action_dim] = None
    for case in cases:
        if (verdict := _verdicts.get(case)) is not None:
            raise Rejection(verdict.code, verdict.message)


def store_files(
    store: Store, key: str, declared: Iterable[Artefact], read: ReadFile | None
) -> None:
    """Store the files that an entrant names, or check that its key has uploaded them."""
    for each in declared:
        if read is not None:
            store.put_object(each.sha256, read(each.sha256), by=key)
        check_stored(store, key, each)


def check_stored(store: Store, key: str, declared: Artefact) -> None:
    """Check that the key has uploaded a policy file; if not, say nothing about it."""
    digest = declared.sha256
    if not (store.possesses(key, digest) and store.objects.has(digest)):
        raise Rejection(
            "artefact_missing",
            f"artefact={digest}: the submission's key has not uploaded it. Upload it before the "
            "submission.",
        )
    size = store.folder.object(digest).stat().st_size
    if size != declared.size:
        raise Rejection(
            "artefact_digest",
            f"artefact={digest}: has {size:,} bytes, but the submission declares "
            f"{declared.size:,}. Submit the runs again.",
        )


class Reference(NamedTuple):
    """A reference policy, by the name that it has everywhere; `onnx` exports it for a spec."""

    name: str
    knowledge: Knowledge
    onnx: Callable[[SMESpec], bytes]
    statement: str


REFERENCES: tuple[Reference, ...] = (
    Reference(
        "optimal",
        "oracle",
        optimal_onnx,
        "The optimal policy, computed from the public specs. Its regret is 0.",
    ),
    Reference(
        "constant",
        "family",
        constant_onnx,
        "The action ½ in every state, the best policy that ignores its input. Its regret is 1.",
    ),
)


def submit_references(store: Store) -> list[str]:
    """Submit `optimal` and `constant` as every policy is, unless they exist; returns their ids.

    The board's own key signs them at the time when the board was opened. Another version of `onnx`
    would write other bytes, so a row that exists is kept.
    """
    existing = {row.method: row.id for row in store.entries() if row.reference}
    return [existing.get(each.name) or _submit_reference(store, each) for each in REFERENCES]


def _submit_reference(store: Store, reference: Reference) -> str:
    key, instances = store.folder.signing_key(), store.document.instances
    files: dict[str, bytes] = {}
    runs = []
    for spec_digest, (_, spec) in instances.items():
        data = reference.onnx(spec)
        policy = Artefact(sha256=sha256_of(data), size=len(data))
        files[policy.sha256] = data
        runs.append(Run(spec=spec_digest, seed=0, steps=0, artefact=policy))
    submission = Submission(
        suite=store.document.suite_reference,
        method=Method(
            name=reference.name,
            version="1",
            family=REFERENCE_FAMILY,
            knowledge=reference.knowledge,
        ),
        submitter=Submitter(name=THE_BOARD, key=key.public),
        created=store.log(0, 1)[0].time,
        runs=tuple(runs),
        runs_started=dict(Counter(class_name for class_name, _ in instances.values())),
        statement=reference.statement,
    )
    signed = submission.signed(key, Receiver(key.public))
    admit(store, signed, files.__getitem__, isolation_for_own())
    return signed.id

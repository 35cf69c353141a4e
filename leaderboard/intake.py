"""What comes onto a board: uploads, submissions, withdrawals, and the board's own reference rows.

    read → known already? → document against board → quotas → artefacts there → gate → store

The order is fixed, the cheap steps first, so that the same fault always has the same code and a
stranger's megabytes are only looked at once everything said about them is in order.

An upload is allowed by a header that its key has signed, for one object and for ten minutes:

    Authorization: SME-Ed25519 key=<64 hex>,time=<utc>,signature=<128 hex>
    signature = Ed25519(key, "sme-leaderboard/upload/" digest " " time)
"""

from __future__ import annotations

import datetime
import hashlib
import os
import re
from collections.abc import Callable

from leaderboard.artefact.gate import inspect
from leaderboard.artefact.reference import constant_onnx, optimal_onnx
from leaderboard.bundle import Bundle
from leaderboard.documents.checks import REFERENCE_FAMILY, THE_BOARD, check_submission, check_text
from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.documents.submission import (
    MAX_BYTES,
    Artefact,
    Knowledge,
    Method,
    Run,
    SignedSubmission,
    SignedWithdrawal,
    Submission,
    Submitter,
    Withdrawal,
    now,
    utc,
)
from leaderboard.errors import Rejection
from leaderboard.store import Store
from sme_registry.errors import MalformedDocumentError, SpecError
from sme_registry.io import parse_json
from sme_registry.spec import SMESpec

UPLOAD_MINUTES = 10
_DAY = datetime.timedelta(days=1)
_HEADER = re.compile(
    r"SME-Ed25519 key=([0-9a-f]{64}),"
    r"time=(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ),"
    r"signature=([0-9a-f]{128})"
)


def receive(store: Store, text: bytes, at: datetime.datetime | None = None) -> str:
    """Take a submission whose artefacts the board already has.

    Args:
      store: the board.
      text: `submission.json`.
      at: the moment it came; the present one where it is left out.

    Returns:
      The submission's id; the same submission twice is one row.

    Raises:
      Rejection: with the code of the first thing that is wrong.
    """
    signed = SignedSubmission.read(text)
    admit(store, signed, at)
    return signed.id


def admit(
    store: Store,
    signed: SignedSubmission,
    at: datetime.datetime | None = None,
    artefact: Callable[[str], bytes] | None = None,
) -> bool:
    """Check a submission that has been read, and keep it.

    Args:
      store: the board.
      signed: the submission, its signature verified.
      at: the moment it came; the present one where it is left out.
      artefact: gives the bytes of an artefact by its digest, of the size that the submission says;
        the board's own objects where it is left out. What it gives is kept with the submission.

    Returns:
      Whether it is new; False where the board had it already.

    Raises:
      Rejection: with the code of the first thing that is wrong.
    """
    moment = at or datetime.datetime.now(datetime.UTC)
    known = store.entry(signed.id)
    if known is not None:
        if known.status == "withdrawn":
            raise Rejection(
                "withdrawn",
                f"submission={signed.id}: was withdrawn by its submitter, and stays so. "
                "Sign a new one.",
            )
        return False
    submission = signed.submission
    check_submission(store.document, submission, moment)
    _check_quota(store, submission.submitter.key, moment)
    _check_artefacts(store, submission, artefact)
    if artefact is not None:
        for digest in _artefacts(submission):
            if not store.objects.has(digest):
                store.put_object(digest, [artefact(digest)], by=submission.submitter.key)
    with store.transaction():  # nobody else fills the quota between its check and the row
        _check_quota(store, submission.submitter.key, moment)
        return store.receive(signed)


def submit_bundle(store: Store, folder: str | os.PathLike[str]) -> str:
    """Take a bundle: its submission, and every artefact beside it.

    Returns:
      The submission's id.

    Raises:
      Rejection: with the code of the first thing that is wrong; nothing was kept.
    """
    bundle = Bundle.read(folder)
    admit(store, bundle.signed, artefact=bundle.artefact)
    return bundle.signed.id


def submit_references(store: Store) -> list[str]:
    """Put π* and the constant ½ on the board, through the pipeline that every policy takes.

    They are signed by the board's own key at the time of its opening, and one that is there is
    left as it is, so that a board has exactly one of each, however often this is called.

    Returns:
      The ids of `optimal` and `constant`.

    Raises:
      BoardError: the board's key is not there.
    """
    opened = _moment(store.log(0, 1)[0].time)
    key = store.folder.signing_key()
    there = {row.method: row.id for row in store.entries() if row.reference}
    ids = []
    for name, knowledge, onnx, statement in _REFERENCES:
        if name in there:  # another version of `onnx` would write other bytes for it
            ids.append(there[name])
            continue
        signed, artefacts = _reference(store, key, opened, name, knowledge, onnx, statement)
        admit(store, signed, opened, artefacts.__getitem__)
        ids.append(signed.id)
    return ids


def withdrawal_of(
    id: str, key: SigningKey, reason: str = "", created: str | None = None
) -> SignedWithdrawal:
    """A signed withdrawal of a submission; the key must be the one that signed the submission."""
    withdrawal = Withdrawal(submission=id, created=created or now(), reason=reason)
    return SignedWithdrawal(
        withdrawal=withdrawal, signature=key.sign("withdrawal", withdrawal.digest)
    )


def withdraw(store: Store, signed: SignedWithdrawal) -> str:
    """Take a submission off the board, as its own submitter asks.

    Returns:
      The submission's id; a second withdrawal changes nothing.

    Raises:
      Rejection: `unknown_submission`, `unsafe_name` or `bad_signature`.
    """
    id = signed.withdrawal.submission
    if store.entry(id) is None:
        raise Rejection(
            "unknown_submission", f"submission={id}: is not on this board. Check the id."
        )
    check_text("reason", signed.withdrawal.reason)
    store.withdraw(signed)
    return id


def read_withdrawal(text: bytes) -> SignedWithdrawal:
    """The withdrawal of a file's bytes; whose it must be signed by, the board knows.

    Raises:
      Rejection: `too_large`, `not_json` or `schema`.
    """
    if len(text) > MAX_BYTES:
        raise Rejection(
            "too_large",
            f"withdrawal: {len(text):,} bytes: must be at most {MAX_BYTES:,}. Shorten the reason.",
        )
    try:
        return SignedWithdrawal.from_dict(parse_json(text, "withdrawal"), "withdrawal")
    except MalformedDocumentError as error:
        raise Rejection("not_json", str(error)) from None
    except SpecError as error:
        raise Rejection("schema", str(error)) from None


def upload_header(key: SigningKey, digest: str, time: str | None = None) -> str:
    """The value of `Authorization` that lets a key upload one object within ten minutes."""
    time = time or now()
    signature = key.sign("upload", f"{digest} {time}")
    return f"SME-Ed25519 key={key.public},time={time},signature={signature}"


def uploader(header: str | None, digest: str, at: datetime.datetime | None = None) -> str:
    """Who asks to upload this object.

    Args:
      header: the value of `Authorization`; None where there is none.
      digest: of the object.
      at: the moment it came; the present one where it is left out.

    Returns:
      The public key.

    Raises:
      Rejection: `bad_signature` or `stale_time`.
    """
    found = _HEADER.fullmatch(header or "")
    if found is None:
        raise Rejection(
            "bad_signature",
            "Authorization: must be `SME-Ed25519 key=…,time=…,signature=…`. Sign the upload.",
        )
    key, time, signature = found.groups()
    if not verifies(key, signature, "upload", f"{digest} {time}"):
        raise Rejection(
            "bad_signature",
            f"Authorization: the signature is not of this object and time by the key {key[:16]}…. "
            "Sign each upload for itself.",
        )
    moment = at or datetime.datetime.now(datetime.UTC)
    try:
        fresh = abs(moment - _moment(time)) <= datetime.timedelta(minutes=UPLOAD_MINUTES)
    except ValueError:  # the 31st of February
        fresh = False
    if not fresh:
        raise Rejection(
            "stale_time",
            f"time={time}: must be within {UPLOAD_MINUTES} minutes of the board's {utc(moment)}. "
            "Sign the upload when it is made, and set your clock.",
        )
    return key


def check_upload(
    store: Store,
    key: str,
    size: int,
    *,
    pending: int = 0,
    pending_of_key: int = 0,
    at: datetime.datetime | None = None,
) -> None:
    """Refuse an object that is too large, or that the key's or the board's quota has no room for.

    Args:
      store: the board.
      key: who uploads.
      size: of the object, in bytes.
      pending: bytes of all uploads that are under way.
      pending_of_key: of those, this key's.
      at: the moment it came; the present one where it is left out.

    Raises:
      Rejection: `too_large` or `quota`.
    """
    limits = store.document.limits
    if size > limits.artefact_bytes:
        raise Rejection(
            "too_large",
            f"object: {size:,} bytes: must be at most {limits.artefact_bytes:,}. "
            "Export a smaller network.",
        )
    moment = at or datetime.datetime.now(datetime.UTC)
    used = store.usage.uploaded_bytes(key, utc(moment - _DAY)) + pending_of_key
    if used + size > limits.upload_bytes_per_day:
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has uploaded {used:,} of {limits.upload_bytes_per_day:,} bytes "
            "within 24 hours. Upload the rest when the first of them are a day old.",
        )
    if store.usage.total_bytes() + pending + size > limits.total_bytes:
        raise Rejection(
            "quota",
            f"objects: the board has no room left of its {limits.total_bytes:,} bytes. "
            "Ask whoever keeps it to raise the limit, or to run `sme-leaderboard gc`.",
        )


def _moment(time: str) -> datetime.datetime:
    return datetime.datetime.strptime(time, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=datetime.UTC)


def _check_quota(store: Store, key: str, moment: datetime.datetime) -> None:
    limits = store.document.limits
    if key == store.document.key:
        return  # the reference rows, without which nothing is shown
    times = store.usage.submission_times(key, utc(moment - _DAY))
    if len(times) >= limits.submissions_per_day:
        free = _moment(times[-limits.submissions_per_day]) + _DAY
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has sent {len(times)} of {limits.submissions_per_day} submissions "
            f"within 24 hours. Send the next one after {utc(free)}.",
        )
    waiting = store.queue.waiting()
    if waiting >= limits.waiting_submissions:
        raise Rejection(
            "quota",
            f"board: {waiting} of {limits.waiting_submissions} submissions wait to be scored. "
            "Send it again when the first of them are.",
        )


def _artefacts(submission: Submission) -> dict[str, Artefact]:
    """Each distinct artefact, by its digest, in the order of the runs."""
    return {run.artefact.sha256: run.artefact for run in submission.runs if run.artefact}


def _check_artefacts(
    store: Store, submission: Submission, artefact: Callable[[str], bytes] | None
) -> None:
    """All there and as large as they say; then each through the gate, one in memory at a time."""
    if artefact is None:
        for digest, wanted in _artefacts(submission).items():
            if not store.objects.has(digest):
                raise Rejection(
                    "artefact_missing",
                    f"artefact={digest}: is not on the board. Upload it before the submission.",
                )
            size = store.folder.object(digest).stat().st_size
            if size != wanted.size:
                raise Rejection(
                    "artefact_digest",
                    f"artefact={digest}: has {size:,} bytes, the submission says "
                    f"{wanted.size:,}. Make the bundle again with `sme-leaderboard new`.",
                )
    instances = store.document.instances
    widths: dict[str, set[tuple[int, int]]] = {}
    for run in submission.runs:
        if run.artefact:
            spec = instances[run.spec][1]
            widths.setdefault(run.artefact.sha256, set()).add((spec.state_dim + 2, spec.action_dim))
    for digest, dimensions in widths.items():
        data = artefact(digest) if artefact else store.objects.read(digest)
        for observation_dim, action_dim in sorted(dimensions):
            inspect(data, observation_dim, action_dim)


_Reference = tuple[str, Knowledge, Callable[[SMESpec], bytes], str]
_REFERENCES: tuple[_Reference, ...] = (
    (
        "optimal",
        "oracle",
        optimal_onnx,
        "The optimal policy itself, from the public specs. Its regret is 0.",
    ),
    (
        "constant",
        "family",
        constant_onnx,
        "The action ½ in every state, the best that a policy blind to its input can do. "
        "Its regret is 1.",
    ),
)


def _reference(
    store: Store,
    key: SigningKey,
    opened: datetime.datetime,
    name: str,
    knowledge: Knowledge,
    onnx: Callable[[SMESpec], bytes],
    statement: str,
) -> tuple[SignedSubmission, dict[str, bytes]]:
    """A reference row and its artefacts by digest: one run for each instance."""
    artefacts: dict[str, bytes] = {}
    runs = []
    started: dict[str, int] = {}
    for digest, (class_name, spec) in store.document.instances.items():
        data = onnx(spec)
        content = "sha256:" + hashlib.sha256(data).hexdigest()
        artefacts[content] = data
        artefact = Artefact(sha256=content, size=len(data))
        runs.append(Run(spec=digest, seed=0, steps=0, artefact=artefact))
        started[class_name] = started.get(class_name, 0) + 1
    submission = Submission(
        track=store.document.track,
        suite=store.document.suite_reference,
        method=Method(name=name, version="1", family=REFERENCE_FAMILY, knowledge=knowledge),
        submitter=Submitter(name=THE_BOARD, key=key.public),
        created=utc(opened),
        runs=tuple(runs),
        runs_started=started,
        statement=statement,
    )
    return submission.signed(key), artefacts

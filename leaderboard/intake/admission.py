"""Submissions and withdrawals: read, checked against the board and its quotas, then stored.

    read → known? → document against board → quotas → artefacts present → gate → store

The order is fixed with cheap steps first, so that one fault always has one code, and megabytes
are read only after everything declared about them has passed.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable

from leaderboard.artefact.gate import inspect
from leaderboard.bundle import Bundle
from leaderboard.documents.checks import check_submission, check_text
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.submission import (
    MAX_BYTES,
    Artefact,
    SignedSubmission,
    SignedWithdrawal,
    Submission,
    Withdrawal,
    now,
)
from leaderboard.errors import Rejection
from leaderboard.intake.quotas import check_submissions
from leaderboard.store import Store
from sme_registry.errors import MalformedDocumentError, SpecError
from sme_registry.io import parse_json

ReadArtefact = Callable[[str], bytes]


def admit(
    store: Store,
    signed: SignedSubmission,
    at: datetime.datetime | None = None,
    artefact: ReadArtefact | None = None,
) -> bool:
    """Check a submission and store it.

    Args:
      store: the board.
      signed: the submission, its signature verified.
      at: time of arrival; now by default.
      artefact: returns an artefact's bytes by digest, of the size in the submission; they are
        stored with the submission. By default the board already has all artefacts.

    Returns:
      True if it is new, False if the board already has it.

    Raises:
      Rejection: with the code of the first fault.
    """
    moment = at or datetime.datetime.now(datetime.UTC)
    known = store.entry(signed.id)
    if known is not None:
        if known.status == "withdrawn":
            raise Rejection(
                "withdrawn",
                f"submission={signed.id}: was withdrawn by its submitter, which is final. "
                "Sign a new one.",
            )
        return False
    submission = signed.submission
    key = submission.submitter.key
    check_submission(store.document, submission, moment)
    check_submissions(store, key, moment)
    _check_artefacts(store, submission, artefact)
    if artefact is not None:
        for digest in _artefacts(submission):
            if not store.objects.has(digest):
                store.put_object(digest, [artefact(digest)], by=key)
    with store.transaction():  # no other submission can use the quota in between
        check_submissions(store, key, moment)
        return store.receive(signed)


def submit_bundle(store: Store, folder: str | os.PathLike[str]) -> str:
    """Admit a bundle: its submission and the artefacts in its folder.

    Returns:
      The submission's id.

    Raises:
      Rejection: with the code of the first fault; nothing is stored.
    """
    bundle = Bundle.read(folder)
    admit(store, bundle.signed, artefact=bundle.artefact)
    return bundle.signed.id


def withdrawal_of(id: str, key: SigningKey, reason: str = "") -> SignedWithdrawal:
    """A signed withdrawal of a submission; the key must be the one that signed the submission."""
    withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
    return SignedWithdrawal(
        withdrawal=withdrawal, signature=key.sign("withdrawal", withdrawal.digest)
    )


def withdraw(store: Store, signed: SignedWithdrawal) -> str:
    """Withdraw a submission at its submitter's request; a second withdrawal changes nothing.

    Returns:
      The submission's id.

    Raises:
      Rejection: `unknown_submission`, `unsafe_name` or `bad_signature`.
    """
    id = signed.withdrawal.submission
    if store.entry(id) is None:
        raise unknown_submission(id)
    check_text("reason", signed.withdrawal.reason)
    store.withdraw(signed)
    return id


def unknown_submission(id: str) -> Rejection:
    """The rejection of an id that no submission on the board has."""
    return Rejection("unknown_submission", f"submission={id}: is not on this board. Check the id.")


def read_withdrawal(text: bytes) -> SignedWithdrawal:
    """Parse a withdrawal; `withdraw` verifies the signature.

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


def _artefacts(submission: Submission) -> dict[str, Artefact]:
    """Each distinct artefact, by its digest, in the order of the runs."""
    return {run.artefact.sha256: run.artefact for run in submission.runs if run.artefact}


def _check_artefacts(store: Store, submission: Submission, artefact: ReadArtefact | None) -> None:
    """Check that all are present with the declared sizes; then inspect one after the other."""
    if artefact is None:
        for digest, declared in _artefacts(submission).items():
            _check_stored(store, digest, declared.size)
    instances = store.document.instances
    dimensions: dict[str, set[tuple[int, int]]] = {}
    for run in submission.runs:
        if run.artefact:
            spec = instances[run.spec][1]
            widths = spec.state_dim + 2, spec.action_dim
            dimensions.setdefault(run.artefact.sha256, set()).add(widths)
    for digest, pairs in dimensions.items():
        data = artefact(digest) if artefact else store.objects.read(digest)
        for observation_dim, action_dim in sorted(pairs):
            inspect(data, observation_dim, action_dim)


def _check_stored(store: Store, digest: str, declared: int) -> None:
    if not store.objects.has(digest):
        raise Rejection(
            "artefact_missing",
            f"artefact={digest}: is not on the board. Upload it before the submission.",
        )
    size = store.folder.object(digest).stat().st_size
    if size != declared:
        raise Rejection(
            "artefact_digest",
            f"artefact={digest}: has {size:,} bytes, but the submission declares {declared:,}. "
            "Recreate the bundle with `sme-leaderboard new`.",
        )

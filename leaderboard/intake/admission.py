"""Submissions: read, checked against the board and its quotas, then stored.

    read → for this board? → known? → document → quotas → artefacts present → gate → store

The order is fixed with cheap steps first, so that one fault always has one code, and megabytes
are read only after everything declared about them has passed.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable

from leaderboard.artefact.gate import inspect, widths
from leaderboard.bundle import Bundle
from leaderboard.documents.checks import check_board, check_submission
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.submission import Artefact, SignedSubmission, Submission, shifted, utc
from leaderboard.errors import Rejection
from leaderboard.intake.uploads import quota_window
from leaderboard.store import Store

_DAY = datetime.timedelta(days=1)
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
    check_board(store.document, signed.board)
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
    _check_quotas(store, key, moment)
    _check_artefacts(store, submission, artefact)
    if artefact is not None:
        for digest in _artefacts(submission):
            if not store.objects.has(digest):
                store.put_object(digest, [artefact(digest)], by=key)
    with store.transaction():  # no other submission can use the quota in between
        _check_quotas(store, key, moment)
        for digest, declared in _artefacts(submission).items():  # nor can `gc` take an artefact
            _check_stored(store, digest, declared.size)
        return store.receive(signed)


def submit_bundle(
    store: Store, folder: str | os.PathLike[str], key: SigningKey | None = None
) -> str:
    """Admit a bundle: its submission and the artefacts in its folder.

    Args:
      store: the board.
      folder: the bundle's.
      key: the submitter's, to sign a submission that is signed for no board yet.

    Returns:
      The submission's id.

    Raises:
      Rejection: with the code of the first fault; nothing is stored.
    """
    bundle = Bundle.read(folder)
    signed = bundle.signed if key is None else bundle.signed.for_board(store.document.key, key)
    admit(store, signed, artefact=bundle.artefact)
    return signed.id


def _check_quotas(store: Store, key: str, moment: datetime.datetime) -> None:
    """Reject one more submission of a key if its quota, or the queue, is full.

    The board's own key has no quota, because nothing is shown without the reference rows.
    """
    limits = store.document.limits
    if key == store.document.key:
        return
    times = store.submission_times(key, *quota_window(moment))
    if len(times) >= limits.submissions_per_day:
        first = datetime.datetime.fromisoformat(times[-limits.submissions_per_day])
        free = shifted(first, _DAY)
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has sent {len(times)} of {limits.submissions_per_day} submissions "
            f"within 24 hours. Send the next one after {utc(free)}.",
        )
    waiting = store.queue.waiting()
    if waiting >= limits.waiting_submissions:
        raise Rejection(
            "quota",
            f"board: the queue is full, with {waiting} of {limits.waiting_submissions} waiting "
            "submissions. Send it again when some of them are scored.",
        )


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
            dimensions.setdefault(run.artefact.sha256, set()).add(widths(instances[run.spec][1]))
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

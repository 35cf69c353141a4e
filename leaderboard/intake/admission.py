"""Submissions: read, checked against the board and its quotas, then stored.

    for this board? → known? → document → policies present → gate → name → quotas → room → store

The order is fixed, so that one fault always has one code. What another submission can change is
decided once, in the transaction that stores it. The gate's verdicts are kept, so a key that is
beyond its quota costs no more than the files that it has uploaded.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable

from leaderboard.bundle import Bundle
from leaderboard.documents.checks import check_receiver, check_submission
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Artefact, Submission, Submitter, shifted, utc
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation, isolation_for_own
from leaderboard.gate.sandbox import Confined, widths
from leaderboard.intake.uploads import a_day_ago, check_room
from leaderboard.store import Store

_DAY = datetime.timedelta(days=1)
_VERDICTS_KEPT = 10_000
ReadFile = Callable[[str], bytes]

_Case = tuple[str, int, int]
"""The digest of a policy file, and the widths of a task."""

_verdicts: dict[_Case, Rejection | None] = {}
"""Of the gate."""


def admit(
    store: Store,
    signed: Signed[Submission],
    policy_file: ReadFile | None = None,
    isolation: Isolation | None = None,
    address: str | None = None,
) -> bool:
    """Check a submission and store it.

    Args:
      store: the board.
      signed: the submission, its signature verified.
      policy_file: returns a file's bytes by digest, of the size in the submission; they are
        stored with the submission. By default the submitter's key has uploaded them.
      isolation: of the process that reads its policies; None for the one that this machine has.
      address: of the server that it was sent to; None if it was given to the board's folder.

    Returns:
      True if it is new, False if the board already has it.

    Raises:
      Rejection: with the code of the first fault.
      ScoringFault: that process does not start; nothing is judged.
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
    check_submission(store.document, submission, datetime.datetime.fromisoformat(time))
    _check_files(store, submission, policy_file, isolation)
    with store.transaction():  # no other submission can use the quota or the name in between
        check_name(store, submission.submitter)
        _check_quotas(store, key)
        if key != store.document.key:
            check_room(store, len(signed.to_bytes()))
        for digest, declared in _policies(submission).items():  # nor can `gc` take a file
            if policy_file is not None:
                store.put_object(digest, [policy_file(digest)], by=key)
            check_stored(store, key, declared)
        return store.receive(signed)


def submit_bundle(
    store: Store, folder: str | os.PathLike[str], key: SigningKey | None = None
) -> str:
    """Admit a bundle: its submission and the policy files in its folder.

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
    signed = (
        bundle.signed
        if key is None
        else bundle.signed.for_receiver(Receiver(store.document.key), key)
    )
    admit(store, signed, policy_file=bundle.artefact, isolation=isolation_for_own())
    return signed.id


def check_name(store: Store, submitter: Submitter) -> None:
    """Reject (`name_taken`) a name that another key has used, or one that looks like it."""
    holder = store.holder_of_name(submitter.name)
    if holder not in (None, submitter.key):
        raise Rejection(
            "name_taken",
            f"submitter.name={submitter.name!a}: on this board it belongs to the key "
            f"{holder[:16]}…, which was the first to use it, or a name that looks like it. Choose "
            "another name, or sign with that key.",
        )


def _check_quotas(store: Store, key: str) -> None:
    """Reject one more submission of a key if its quota, or the queue, is full.

    The board's own key has no quota, because nothing is shown without the reference rows.
    """
    limits = store.document.limits
    if key == store.document.key:
        return
    check_daily_quota(store, key)
    waiting = store.queue.queued()  # those that faults have stopped take nobody's place
    if waiting >= limits.waiting_submissions:
        raise Rejection(
            "quota",
            f"board: the queue is full, with {waiting} of {limits.waiting_submissions} waiting "
            "submissions. Send it again when some of them are scored.",
        )


def check_daily_quota(store: Store, key: str) -> None:
    """Reject (`quota`) one more submission or entry of a key that has sent a day's number."""
    limits = store.document.limits
    times = store.submission_times(key, a_day_ago(store))
    if len(times) >= limits.submissions_per_day:
        first = datetime.datetime.fromisoformat(times[-limits.submissions_per_day])
        free = shifted(first, _DAY)
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has sent {len(times)} of {limits.submissions_per_day} submissions "
            f"within 24 hours. Send the next one after {utc(free)}.",
        )


def _policies(submission: Submission) -> dict[str, Artefact]:
    """Each distinct policy file, by its digest, in the order of the runs."""
    return {run.artefact.sha256: run.artefact for run in submission.runs if run.artefact}


def _check_files(
    store: Store,
    submission: Submission,
    policy_file: ReadFile | None,
    isolation: Isolation | None,
) -> None:
    """Check that all are present with the declared sizes; then inspect one after the other."""
    if policy_file is None:
        for declared in _policies(submission).values():
            check_stored(store, submission.submitter.key, declared)
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
            f"{declared.size:,}. Recreate the bundle with `sme-leaderboard new`.",
        )

"""Quotas: submissions and uploads of a key within 24 hours, and the limits of the whole board."""

from __future__ import annotations

import datetime

from leaderboard.documents.submission import utc
from leaderboard.errors import Rejection
from leaderboard.store import Store

_DAY = datetime.timedelta(days=1)


def check_submissions(store: Store, key: str, moment: datetime.datetime) -> None:
    """Reject one more submission of a key if its quota, or the queue, is full.

    The board's own key has no quota, because nothing is shown without the reference rows.

    Raises:
      Rejection: `quota`.
    """
    limits = store.document.limits
    if key == store.document.key:
        return
    times = store.usage.submission_times(key, utc(moment - _DAY))
    if len(times) >= limits.submissions_per_day:
        free = parse_utc(times[-limits.submissions_per_day]) + _DAY
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


def check_upload(
    store: Store,
    key: str,
    size: int,
    *,
    pending: int = 0,
    pending_of_key: int = 0,
    at: datetime.datetime | None = None,
) -> None:
    """Reject an upload that is too large, or exceeds the key's or the board's quota.

    Args:
      store: the board.
      key: the uploader's public key.
      size: of the object, in bytes.
      pending: bytes of all uploads in progress.
      pending_of_key: bytes of this key's uploads in progress.
      at: time of arrival; now by default.

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
            "within 24 hours. Upload the rest 24 hours after the first of them.",
        )
    if store.usage.total_bytes() + pending + size > limits.total_bytes:
        raise Rejection(
            "quota",
            f"objects: the board's {limits.total_bytes:,} bytes are full. "
            "Ask its owner to raise the limit or to run `sme-leaderboard gc`.",
        )


def parse_utc(time: str) -> datetime.datetime:
    """The moment of a time in the form of `submission.now()`.

    Raises:
      ValueError: there is no such moment, as on 31 February.
    """
    return datetime.datetime.strptime(time, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=datetime.UTC)

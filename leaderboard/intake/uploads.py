"""Uploads: a signed permission for one object and ten minutes, and the quotas in bytes.

Authorization: SME-Ed25519 key=<64 hex>,board=<64 hex>,address=<url>,time=<utc>,signature=<128 hex>
signature = Ed25519(key, "sme-leaderboard/upload/" board "/" address "/" digest " " time)
"""

from __future__ import annotations

import datetime
import re

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.checks import check_receiver
from leaderboard.documents.signed import Receiver, SigningKey, verifies
from leaderboard.documents.submission import now, shifted, utc
from leaderboard.errors import Rejection
from leaderboard.store import Store, make_room

UPLOAD_MINUTES = 10
_DAY = datetime.timedelta(days=1)
_HEADER = re.compile(
    r"SME-Ed25519 key=([0-9a-f]{64}),"
    r"(?:board=([0-9a-f]{64}),)?"
    r"(?:address=([!-+\--~]{1,300}),)?"
    r"time=(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ),"
    r"signature=([0-9a-f]{128})"
)


def upload_header(key: SigningKey, digest: str, receiver: Receiver, time: str | None = None) -> str:
    """The value of `Authorization` that lets a key upload one object within ten minutes.

    Args:
      key: the submitter's.
      digest: of the object.
      receiver: the board, and the address that the object is sent to.
      time: of signing, as documents write it; now by default.
    """
    time = time or now()
    signature = key.sign("upload", f"{digest} {time}", receiver)
    named = "".join(f"{name}={value}," for name, value in receiver._asdict().items() if value)
    return f"SME-Ed25519 key={key.public},{named}time={time},signature={signature}"


def uploader(
    board: BoardDocument,
    header: str | None,
    digest: str,
    address: str,
    at: datetime.datetime | None = None,
) -> str:
    """The public key that signed an upload.

    Args:
      board: the board.
      header: the value of `Authorization`; None if there is none.
      digest: of the object.
      address: of the server that it was sent to.
      at: time of arrival; now by default.

    Raises:
      Rejection: `bad_signature`, `wrong_board` or `stale_time`.
    """
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
    moment = at or datetime.datetime.fromisoformat(now())
    try:
        age = abs(moment - datetime.datetime.fromisoformat(time))
        fresh = age <= datetime.timedelta(minutes=UPLOAD_MINUTES)
    except ValueError:
        fresh = False
    if not fresh:
        raise Rejection(
            "stale_time",
            f"time={time}: must be within {UPLOAD_MINUTES} minutes of the board's {utc(moment)}. "
            "Set your clock, and sign each upload just before sending it.",
        )
    return key


def a_day_ago(store: Store) -> str:
    """After which submissions and uploads count towards a day's quotas."""
    return utc(shifted(datetime.datetime.fromisoformat(store.time), -_DAY))


def check_upload(
    store: Store,
    key: str,
    size: int,
) -> None:
    """Reject an upload that is too large, or exceeds the key's or the board's quota.

    Args:
      store: the board.
      key: the uploader's public key.
      size: of the object, in bytes.

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
    used = store.uploaded_bytes(key, a_day_ago(store))
    if used + size > limits.upload_bytes_per_day:
        raise Rejection(
            "quota",
            f"key={key[:16]}…: has uploaded {used:,} of {limits.upload_bytes_per_day:,} bytes "
            "within 24 hours. Upload the rest 24 hours after the first of them.",
        )
    check_room(store, size)


def check_room(store: Store, size: int) -> None:
    """Reject (`quota`) so many bytes that do not fit onto a board, even without old uploads."""
    if not make_room(store, size):
        raise Rejection(
            "quota",
            f"board: its {store.document.limits.total_bytes:,} bytes are full. "
            "Send it again in a few minutes, or ask the board's owner to raise the limit.",
        )

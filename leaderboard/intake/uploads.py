"""Upload permissions: a header, signed by the uploader's key, for one object and ten minutes.

Authorization: SME-Ed25519 key=<64 hex>,time=<utc>,signature=<128 hex>
signature = Ed25519(key, "sme-leaderboard/upload/" digest " " time)
"""

from __future__ import annotations

import datetime
import re

from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.documents.submission import now, utc
from leaderboard.errors import Rejection
from leaderboard.intake.quotas import parse_utc

UPLOAD_MINUTES = 10
_HEADER = re.compile(
    r"SME-Ed25519 key=([0-9a-f]{64}),"
    r"time=(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ),"
    r"signature=([0-9a-f]{128})"
)


def upload_header(key: SigningKey, digest: str, time: str | None = None) -> str:
    """The value of `Authorization` that lets a key upload one object within ten minutes."""
    time = time or now()
    signature = key.sign("upload", f"{digest} {time}")
    return f"SME-Ed25519 key={key.public},time={time},signature={signature}"


def uploader(header: str | None, digest: str, at: datetime.datetime | None = None) -> str:
    """The public key that signed an upload.

    Args:
      header: the value of `Authorization`; None if there is none.
      digest: of the object.
      at: time of arrival; now by default.

    Returns:
      The public key.

    Raises:
      Rejection: `bad_signature` or `stale_time`.
    """
    match = _HEADER.fullmatch(header or "")
    if match is None:
        raise Rejection(
            "bad_signature",
            "Authorization: must be `SME-Ed25519 key=…,time=…,signature=…`. Sign the upload.",
        )
    key, time, signature = match.groups()
    if not verifies(key, signature, "upload", f"{digest} {time}"):
        raise Rejection(
            "bad_signature",
            "Authorization: the signature does not match this object, this time and the key "
            f"{key[:16]}…. Sign each upload separately.",
        )
    moment = at or datetime.datetime.now(datetime.UTC)
    try:
        fresh = abs(moment - parse_utc(time)) <= datetime.timedelta(minutes=UPLOAD_MINUTES)
    except ValueError:
        fresh = False
    if not fresh:
        raise Rejection(
            "stale_time",
            f"time={time}: must be within {UPLOAD_MINUTES} minutes of the board's {utc(moment)}. "
            "Set your clock, and sign each upload just before sending it.",
        )
    return key

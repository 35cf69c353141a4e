"""What a board accepts: uploads, submissions, withdrawals, and its own reference rows."""

from leaderboard.intake.admission import (
    admit,
    read_withdrawal,
    submit_bundle,
    unknown_submission,
    withdraw,
    withdrawal_of,
)
from leaderboard.intake.quotas import check_upload
from leaderboard.intake.references import submit_references
from leaderboard.intake.uploads import UPLOAD_MINUTES, upload_header, uploader

__all__ = [
    "UPLOAD_MINUTES",
    "admit",
    "check_upload",
    "read_withdrawal",
    "submit_bundle",
    "submit_references",
    "unknown_submission",
    "upload_header",
    "uploader",
    "withdraw",
    "withdrawal_of",
]

"""What a board accepts: uploads, submissions, withdrawals, and its own reference rows."""

from leaderboard.intake.admission import admit, submit_bundle, unknown_submission, withdraw
from leaderboard.intake.references import submit_references
from leaderboard.intake.uploads import UPLOAD_MINUTES, check_upload, upload_header, uploader

__all__ = [
    "UPLOAD_MINUTES",
    "admit",
    "check_upload",
    "submit_bundle",
    "submit_references",
    "unknown_submission",
    "upload_header",
    "uploader",
    "withdraw",
]

"""What a board accepts: uploads, submissions, and its own reference rows."""

from leaderboard.intake.admission import admit, submit_bundle
from leaderboard.intake.references import submit_references
from leaderboard.intake.uploads import UPLOAD_MINUTES, check_upload, upload_header, uploader

__all__ = [
    "UPLOAD_MINUTES",
    "admit",
    "check_upload",
    "submit_bundle",
    "submit_references",
    "upload_header",
    "uploader",
]

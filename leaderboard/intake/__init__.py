"""What a board accepts: uploads, submissions, sealed entries, and its own reference rows."""

from leaderboard.intake.admission import admit, receive, submit_bundle
from leaderboard.intake.references import submit_references
from leaderboard.intake.uploads import UPLOAD_MINUTES, check_upload, upload_header, uploader
from leaderboard.seasons.admission import enter, receive_entry, refuse_other_sender, start_ticket

__all__ = [
    "UPLOAD_MINUTES",
    "admit",
    "check_upload",
    "enter",
    "receive",
    "receive_entry",
    "refuse_other_sender",
    "start_ticket",
    "submit_bundle",
    "submit_references",
    "upload_header",
    "uploader",
]

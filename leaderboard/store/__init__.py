"""A board's folder: submissions, results and artefacts in files that are complete or absent.

The signed log is authoritative, the other files hold the documents that it names, and
`index.sqlite` indexes both and can be rebuilt at any time. Any process may die at any point; the
next one continues from the state it leaves.
"""

from leaderboard.documents.result import Copies, EntryRow
from leaderboard.store.index import Index
from leaderboard.store.log import (
    EMPTY,
    Garbage,
    Head,
    Log,
    LogEntry,
    Objects,
    collect_garbage,
    digest_of,
    expire_uploads,
    read_document,
)
from leaderboard.store.queue import Claim, Queue
from leaderboard.store.store import Store, unknown_submission

__all__ = [
    "EMPTY",
    "Claim",
    "Copies",
    "EntryRow",
    "Garbage",
    "Head",
    "Index",
    "Log",
    "LogEntry",
    "Objects",
    "Queue",
    "Store",
    "collect_garbage",
    "digest_of",
    "expire_uploads",
    "read_document",
    "unknown_submission",
]

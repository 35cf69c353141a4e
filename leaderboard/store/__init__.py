"""A board's folder: what was submitted and found, in files that are whole or absent.

The signed log is the truth, the other files hold what it names, and `index.sqlite` is an index
of both that can be made anew at any time. Any process may die at any point: what it leaves is a
state from which the next one goes on.
"""

from leaderboard.store.documents import digest_of, read_document
from leaderboard.store.index import EntryRow, Index, IndexUnusable
from leaderboard.store.log import EMPTY, Head, Log, LogEntry
from leaderboard.store.objects import Objects
from leaderboard.store.store import Claim, Garbage, Store

__all__ = [
    "EMPTY",
    "Claim",
    "EntryRow",
    "Garbage",
    "Head",
    "Index",
    "IndexUnusable",
    "Log",
    "LogEntry",
    "Objects",
    "Store",
    "digest_of",
    "read_document",
]

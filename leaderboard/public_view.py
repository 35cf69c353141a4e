"""What may be told of one submission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal
from leaderboard.errors import NotPublishable
from leaderboard.scoring.ranking import refuse_unpublishable
from leaderboard.store import EntryRow, Store


@dataclass(frozen=True)
class Told:
    """What may be told of one submission.

    Attributes:
      entry: its row.
      signed: as it was signed.
      result: None where there is none, or where its scores are withheld.
      withheld: why they are; empty where they are not.
      withdrawal: None where it stands.
    """

    entry: EntryRow
    signed: SignedSubmission
    result: Result | None
    withheld: str
    withdrawal: SignedWithdrawal | None

    def to_dict(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "id": self.entry.id,
            "status": self.entry.status,
            "received": self.entry.received,
            **self.signed.to_dict(),
            "result": self.result and self.result.to_dict(),
            "withheld": self.withheld,
            "withdrawal": self.withdrawal and self.withdrawal.to_dict(),
        }


def told(store: Store, entry: EntryRow) -> Told:
    """What may be told of a submission: its scores only where the board shows any number."""
    result = store.result(entry.id)
    withheld = ""
    if result is not None and result.scores is not None:
        try:
            refuse_unpublishable(store.entries())
        except NotPublishable as error:
            result, withheld = None, str(error)
    return Told(entry, store.submission(entry.id), result, withheld, store.withdrawal(entry.id))

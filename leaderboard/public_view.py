"""`public_view`: what the board publishes about one submission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal
from leaderboard.errors import NotPublishable
from leaderboard.scoring.ranking import refuse_unpublishable
from leaderboard.store import EntryRow, Store


@dataclass(frozen=True)
class PublicView:
    """What the board publishes about one submission.

    Attributes:
      entry: its row.
      signed: the submission as signed.
      result: None before scoring, and while its scores are withheld.
      withheld: why the scores are withheld; empty if they are not.
      withdrawal: None unless the submission is withdrawn.
    """

    entry: EntryRow
    signed: SignedSubmission
    result: Result | None
    withheld: str
    withdrawal: SignedWithdrawal | None

    def to_dict(self) -> dict[str, Any]:
        """The view as plain data."""
        return {
            "id": self.entry.id,
            "status": self.entry.status,
            "received": self.entry.received,
            **self.signed.to_dict(),
            "result": self.result and self.result.to_dict(),
            "withheld": self.withheld,
            "withdrawal": self.withdrawal and self.withdrawal.to_dict(),
        }


def public_view(store: Store, entry: EntryRow) -> PublicView:
    """The public view of a submission; it has scores only while the board is publishable."""
    result = store.result(entry.id)
    withheld = ""
    if result is not None and result.scores is not None:
        try:
            refuse_unpublishable(store.entries())
        except NotPublishable as error:
            result, withheld = None, str(error)
    return PublicView(
        entry, store.submission(entry.id), result, withheld, store.withdrawal(entry.id)
    )

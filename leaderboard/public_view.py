"""`public_view`: what the board publishes about one submission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal
from leaderboard.errors import NotPublishable
from leaderboard.scoring.ranking import refuse_unpublishable
from leaderboard.store import EntryRow, Store
from sme_registry.errors import SpecError


@dataclass(frozen=True)
class PublicView:
    """What the board publishes about one submission.

    Attributes:
      id: the submission's digest.
      status: waiting, scored, rejected or withdrawn.
      received: when the board received it.
      signed: the submission as signed.
      result: None before scoring, and while its scores are withheld.
      withheld: why the scores are withheld; empty if they are not.
      withdrawal: None unless the submission is withdrawn.
    """

    id: str
    status: str
    received: str
    signed: SignedSubmission
    result: Result | None
    withheld: str
    withdrawal: SignedWithdrawal | None

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> PublicView:
        """The view that `to_dict` wrote, as a served board answers it.

        Raises:
          SpecError: it is not such a view.
        """
        try:
            id, status, received, withheld = (
                str(plain[name]) for name in ("id", "status", "received", "withheld")
            )
            documents = plain["result"], plain["withdrawal"]
            signed = {name: plain[name] for name in ("submission", "signature")}
        except KeyError as error:
            raise SpecError(f"submission: field {error} is missing. Check the URL.") from None
        view = cls(
            id=id,
            status=status,
            received=received,
            signed=SignedSubmission.from_dict(signed),
            result=None if documents[0] is None else Result.from_dict(documents[0]),
            withheld=withheld,
            withdrawal=None if documents[1] is None else SignedWithdrawal.from_dict(documents[1]),
        )
        if view.signed.id != id:
            raise SpecError(f"id={id!r:.80}: the submission has another digest. Check the URL.")
        return view

    def to_dict(self) -> dict[str, Any]:
        """The view as plain data."""
        return {
            "id": self.id,
            "status": self.status,
            "received": self.received,
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
    signed, withdrawal = store.submission(entry.id), store.withdrawal(entry.id)
    return PublicView(entry.id, entry.status, entry.received, signed, result, withheld, withdrawal)

"""`public_view`: what the board publishes about one submission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal
from leaderboard.errors import NotPublishable
from leaderboard.scoring.ranking import ranking, refuse_unpublishable
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
      not_ranked: why it has no rank by any metric, a key of `ranking.REASONS`; empty if it has one,
        or no scores.
      copy_of: earlier submissions of other keys that its policies behave like: their ids, and the
        number of its runs that do.
      faults, fault: how often a fault of the board's machine ended its scoring while it waits, and
        the last of them.
    """

    id: str
    status: str
    received: str
    signed: SignedSubmission
    result: Result | None
    withheld: str
    withdrawal: SignedWithdrawal | None
    not_ranked: str = ""
    copy_of: tuple[tuple[str, int], ...] = ()
    faults: int = 0
    fault: str = ""

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
            signed["board"] = plain.get("board")  # absent on boards of rules 1
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
            **_facts(plain),
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
            "not_ranked": self.not_ranked,
            "copy_of": [{"id": id, "runs": runs} for id, runs in self.copy_of],
            "faults": self.faults,
            "fault": self.fault,
        }


def public_view(store: Store, entry: EntryRow) -> PublicView:
    """The public view of a submission; it has scores only while the board is publishable."""
    result = store.result(entry.id)
    withheld, reason = "", ""
    if result is not None and result.scores is not None:
        entries = store.entries()
        try:
            refuse_unpublishable(entries)
            rows = ranking(entries, "wd_regret")
            reason = next((row.reason for row in rows if row.entry.id == entry.id), "")
        except NotPublishable as error:
            result, withheld = None, str(error)
    return PublicView(
        id=entry.id,
        status=entry.status,
        received=entry.received,
        signed=store.submission(entry.id),
        result=result,
        withheld=withheld,
        withdrawal=store.withdrawal(entry.id),
        not_ranked=reason,
        copy_of=() if withheld else tuple((each.id, each.runs) for each in entry.copy_of),
        faults=entry.faults,
        fault=entry.fault,
    )


def _facts(plain: dict[str, Any]) -> dict[str, Any]:
    """The fields that answers of earlier servers lack."""
    try:
        return {
            "not_ranked": str(plain.get("not_ranked", "")),
            "copy_of": tuple(
                (str(row["id"]), int(row["runs"])) for row in plain.get("copy_of", ())
            ),
            "faults": int(plain.get("faults", 0)),
            "fault": str(plain.get("fault", "")),
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise SpecError(f"submission: invalid answer: {error}. Check the URL.") from None

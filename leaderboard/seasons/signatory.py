"""`Signatory`: the key that signs the answers of a ticket, as the entrant's request names it."""

from __future__ import annotations

from dataclasses import dataclass

from leaderboard.documents.signed import Receiver, Signed
from leaderboard.errors import Rejection
from leaderboard.seasons.entry import Answers, TicketRequest
from sme_registry.errors import SpecError


@dataclass(frozen=True)
class Signatory:
    """Who signs the answers of a ticket.

    Attributes:
      key: public key of the answers.
      receiver: that the signatures are for, as in the request.
      request: id of the request.
      ticket: its number.
    """

    key: str
    receiver: Receiver
    request: str
    ticket: int

    @classmethod
    def named_in(cls, request: Signed[TicketRequest], ticket: int) -> Signatory | None:
        """That of a request; None if it is older than signed answers."""
        key = request.content.answers_key
        return None if key is None else cls(key, request.receiver, request.id, ticket)

    def signed(self, instance: int, answers: str, journal: str, signature: str) -> Signed[Answers]:
        """The signed statement of an instance.

        Args:
          instance: its number in the ticket, from 0.
          answers, journal: their digests.
          signature: as it was sent.

        Raises:
          Rejection: `bad_signature`.
        """
        statement = Answers(
            request=self.request,
            ticket=self.ticket,
            instance=instance,
            answers=answers,
            journal=journal,
        )
        try:
            signed = Signed[Answers](
                content=statement, signature=signature, **self.receiver._asdict()
            )
            valid = signed.is_valid(self.receiver.board, self.key)
        except SpecError:
            valid = False
        if not valid:
            raise Rejection(
                "bad_signature",
                f"signature={signature[:16]!a}: must be that of the key {self.key[:16]}…, which "
                "the request for the ticket names, for these answers and the journal's digest. "
                "Use the ticket's file as `sme-leaderboard ticket` wrote it.",
            )
        return signed

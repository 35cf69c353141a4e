"""`Entry`, `TicketRequest`, `SignedAnswers`: what an entrant of a sealed season signs.

    id = "sha256:" + hex(SHA-256(canonical JSON of the entry or request))

Offline an entry names the answers: for each hidden instance, in the order of the season's classes,
one .npy file of float32 actions `[regions · n, A]` in the challenge states, in their order. Online
a request starts a ticket; the answers of each instance follow, signed by a key that it names.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, field_validator

from leaderboard.documents.keys import PublicKey, SigningKey, verifies
from leaderboard.documents.submission import (
    Artefact,
    Manifest,
    Method,
    SignedDocument,
    SignedManifest,
)
from leaderboard.seasons.season import MAX_OFFLINE_INSTANCES
from sme_registry.seasons.wire import Signer, Statement
from sme_registry.spec.document import Digest, matching


class SealedManifest(Manifest):
    """What every entrant of a season signs.

    Attributes:
      season: digest of the season.
    """

    season: Digest

    @field_validator("method")
    @classmethod
    def _has_no_oracle(cls, method: Method) -> Method:
        if method.knowledge == "oracle":
            raise ValueError(
                "knowledge='oracle': must be 'generic' or 'family' in a sealed season, whose "
                "optimal policies nobody but the organiser knows. Correct it."
            )
        return method


class Entry(SealedManifest):
    """The signed content of an offline entry.

    Attributes:
      answers: of each hidden instance; null where the method failed, which scores 1 there.
    """

    answers: Annotated[
        tuple[Artefact | None, ...],
        Field(strict=False, min_length=1, max_length=MAX_OFFLINE_INSTANCES),
    ]

    def signed(self, key: SigningKey, board: str | None = None) -> SignedEntry:
        """This entry, signed as `SignedManifest.sign` says."""
        return SignedEntry.sign(self, key, board)


class TicketRequest(SealedManifest):
    """The signed content of a request for a ticket.

    Attributes:
      nonce: 64 hex digits that the entrant has drawn at random, for this ticket alone. The tasks
        depend on it, and on the ticket's number, which the board assigns later.
      answers_key: signs the answers; null in requests that are older than it.
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("answers_key",)

    nonce: Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits, drawn at random")]
    answers_key: PublicKey | None = None

    def signed(self, key: SigningKey, board: str | None = None) -> SignedTicketRequest:
        """This request, signed as `SignedManifest.sign` says."""
        return SignedTicketRequest.sign(self, key, board)


class SignedSealed(SignedManifest):
    """A signed entry, or a signed request for a ticket."""

    @property
    def content(self) -> SealedManifest:
        """What is signed."""
        content: SealedManifest = getattr(self, self.KIND)
        return content


class SignedEntry(SignedSealed):
    """`entries/<64 hex>.json` of a season, and the entrant's `entry.json`."""

    KIND = "entry"
    COMMAND = "enter"

    entry: Entry


class SignedTicketRequest(SignedSealed):
    """`tickets/<number>/ticket.json` of a season."""

    KIND = "ticket"
    COMMAND = "ticket"

    ticket: TicketRequest

    def signer(self, key: SigningKey) -> Signer | None:
        """What signs the answers of the ticket, if the request names `SigningKey.of_answers`.

        Args:
          key: the entrant's.
        """
        answers = key.of_answers(self.ticket.nonce)
        if self.board is None or self.ticket.answers_key != answers.public:
            return None
        return Signer(board=self.board, request=self.id, key=answers.secret)


class SignedAnswers(SignedDocument):
    """`tickets/<number>/<instance>.json` of a season, beside the answers and the journal.

    Attributes:
      statement: what the key that the ticket's request names has signed.
    """

    statement: Statement

    def is_valid(self, key: str) -> bool:
        """Whether this public key made the signature, for this statement and board."""
        return verifies(key, self.signature, "answers", self.statement.digest, self.board)

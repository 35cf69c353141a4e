"""`Entry` and `TicketRequest`: what an entrant signs to take part in a sealed season.

    id = "sha256:" + hex(SHA-256(canonical JSON of the entry or request))

Offline an entry names the answers: for each hidden instance, in the order of the season's classes,
one .npy file of float32 actions `[regions · n, A]` in the challenge states, in their order. Online
a request starts a ticket, whose answers follow.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from leaderboard.documents.keys import SigningKey
from leaderboard.documents.season import MAX_OFFLINE_INSTANCES
from leaderboard.documents.submission import Artefact, Manifest, Method, SignedManifest
from sme_registry.spec import Digest


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
    """

    nonce: Annotated[
        str, Field(pattern=r"^[0-9a-f]{64}$", description="64 hex digits, drawn at random")
    ]

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

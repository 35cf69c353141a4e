"""`Entry`, `TicketRequest`, `Answers`: what an entrant of a sealed season signs.

    id = "sha256:" + hex(SHA-256(canonical JSON of the entry or request))

Offline an entry names the answers: for each hidden instance, in the order of the season's classes,
one .npy file of float32 actions `[regions · n, A]` in the challenge states, in their order. Online
a request starts a ticket; the answers of each instance follow, signed by a key that it names.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, field_validator

from leaderboard.documents.signed import PublicKey, Signable, Signed, SigningKey
from leaderboard.documents.submission import Artefact, Manifest, Method
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

    PURPOSE, FIELD, COMMAND = "entry", "entry", "enter"

    answers: Annotated[
        tuple[Artefact | None, ...],
        Field(strict=False, min_length=1, max_length=MAX_OFFLINE_INSTANCES),
    ]


class TicketRequest(SealedManifest):
    """The signed content of a request for a ticket.

    Attributes:
      nonce: 64 hex digits that the entrant has drawn at random, for this ticket alone. The tasks
        depend on it, and on the ticket's number, which the board assigns later.
      answers_key: signs the answers; null in requests that are older than it.
    """

    PURPOSE, FIELD, COMMAND = "ticket", "ticket", "ticket"
    fields_added_later: ClassVar[tuple[str, ...]] = ("answers_key",)

    nonce: Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits, drawn at random")]
    answers_key: PublicKey | None = None


class Answers(Signable, Statement):
    """What the key that a ticket's request names signs of one instance.

    Signed, it is `tickets/<number>/<instance>.json`, beside the answers and the journal.
    """

    PURPOSE, FIELD, COMMAND = "answers", "statement", "answer"


def signer_of(request: Signed[TicketRequest], key: SigningKey) -> Signer | None:
    """What signs the answers of a ticket, if the request names `SigningKey.of_answers` of a key."""
    answers = key.of_answers(request.content.nonce)
    if request.board is None or request.content.answers_key != answers.public:
        return None
    return Signer(
        board=request.board, address=request.address, request=request.id, key=answers.secret
    )

"""`Entry`, `TicketRequest`, `InstanceHead`: what an entrant of a sealed season signs.

    id = "sha256:" + hex(SHA-256(canonical JSON of the entry or request))

Offline an entry names the answers: for each hidden instance, in the order of the season's classes,
one .npy file of float32 actions `[regions · n, A]` in the challenge states, in their order. Online
a request starts a ticket; the `transcript` of each instance follows, signed by a key that it names.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from leaderboard.documents.signed import PublicKey, Signable, Signed, SigningKey, verifies
from leaderboard.documents.submission import Artefact, Manifest, Method
from leaderboard.seasons.season import MAX_OFFLINE_INSTANCES
from sme_registry.seasons.transcript import Count, Head, Signer, TicketHeads
from sme_registry.spec.document import Digest, Document, matching


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
      answers_key: signs what follows; null in requests that are older than it.
      transcript: the version of the transcripts that it signs; null in requests that are older, of
        which it signs `Answers`.
    """

    PURPOSE, FIELD, COMMAND = "ticket", "ticket", "ticket"
    fields_added_later: ClassVar[tuple[str, ...]] = ("answers_key", "transcript")

    nonce: Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits, drawn at random")]
    answers_key: PublicKey | None = None
    transcript: Literal[1] | None = None


class InstanceHead(Signable, Head):
    """Signed, it is `tickets/<number>/<instance>.json`, for the last signature of a transcript."""

    PURPOSE, FIELD, COMMAND = "answers", "head", "answer"


class AllHeads(Signable, TicketHeads):
    """Signed, it is `tickets/<number>/end.json`."""

    PURPOSE, FIELD, COMMAND = "answers", "end", "answer"


class Answers(Signable):
    """What was signed of an instance, in place of its head, before there were transcripts."""

    PURPOSE, FIELD, COMMAND = "answers", "statement", "answer"

    request: Digest  # id of the request for the ticket
    ticket: Count
    instance: Count
    answers: Digest  # SHA-256 of the answers' .npy file
    journal: Digest  # SHA-256 of the bodies of all requests for steps, in order


def has_signed(request: Signed[TicketRequest], signature: str, document: Document) -> bool:
    """Whether the key that a request names has signed a document of its ticket."""
    key = request.content.answers_key
    return key is not None and verifies(
        key, signature, "answers", document.digest, request.receiver
    )


def signer_of(request: Signed[TicketRequest], key: SigningKey) -> Signer | None:
    """What signs a ticket's transcripts, if the request names `SigningKey.of_answers` of a key."""
    answers = key.of_answers(request.content.nonce)
    if request.board is None or request.content.answers_key != answers.public:
        return None
    return Signer(
        board=request.board, address=request.address, request=request.id, key=answers.secret
    )

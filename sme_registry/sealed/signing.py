"""`Signer`: signs an entrant's answers, so that no board can replace them, or the steps, unnoticed.

    signature = Ed25519(key, "sme-leaderboard/answers/" board "/" digest of the `Statement`)

The request for the ticket names the key's public half, and is signed by the entrant's own key. The
ticket's file has the private half, so that a machine can step and answer without the entrant's.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sme_registry.io import require_packages
from sme_registry.spec import Digest, Document, Integer, matching

_Hex = Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits")]
_Secret = Annotated[_Hex, Field(repr=False)]
_Number = Annotated[Integer, Field(ge=0)]


class Statement(Document):
    """What an entrant signs of one instance.

    Attributes:
      request: id of the request for the ticket, which names the season and the key.
      ticket, instance: their numbers.
      answers: SHA-256 of the answers' .npy file.
      journal: SHA-256 of the bodies of all requests for steps, in order.
    """

    request: Digest
    ticket: _Number
    instance: _Number
    answers: Digest
    journal: Digest


class Signer(Document):
    """The key of a ticket's answers; `repr` does not show it.

    Attributes:
      board: public key of the board.
      request: id of the request for the ticket.
      key: Ed25519's 32 private bytes.
    """

    board: _Hex
    request: Digest
    key: _Secret

    def sign(self, statement: Statement) -> str:
        """The signature of a statement, 128 hex digits; requires PyNaCl."""
        require_signatures()
        from nacl.signing import SigningKey

        message = f"sme-leaderboard/answers/{self.board}/{statement.digest}".encode()
        return SigningKey(bytes.fromhex(self.key)).sign(message).signature.hex()


def require_signatures() -> None:
    require_packages("signatures", {"nacl": "PyNaCl"}, "leaderboard")

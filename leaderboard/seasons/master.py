"""`Master`: the secret of a season, from which its hidden tasks, states and data follow.

    secret of a purpose = HMAC-SHA256(master, canonical JSON of ["sme-seal/1", purpose, …])

The list holds public texts and numbers: the season's id, the class, the instance, and on the online
track the ticket and its entrant's nonce. Its canonical JSON is unambiguous, so no two purposes,
classes, instances or tickets share a secret. Whoever knows any number of these secrets learns
nothing of the master or of the others.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from leaderboard.documents.signed import parse_secret, plain_json, write_secret
from leaderboard.errors import BoardError
from sme_registry.io import read_regular, sha256_of

SEAL = "sme-seal/1"
BYTES = 32
Purpose = Literal["task", "states", "data", "starts", "token"]
"""An instance's seed, challenge states, data set and episode starts; the password of a ticket."""


@dataclass(frozen=True)
class Place:
    """Where a secret belongs.

    Attributes:
      season: the season's id.
      class_name, instance: the class, and the number of the instance in it, from 0.
      ticket, nonce: of the online track; empty offline.
    """

    season: str
    class_name: str
    instance: int
    ticket: str = ""
    nonce: str = ""


@dataclass(frozen=True)
class Master:
    """The 32 secret bytes of a season; `repr` never shows them."""

    raw: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.raw) != BYTES:
            raise BoardError(f"master: has {len(self.raw)} bytes: must have {BYTES}.")

    @classmethod
    def generate(cls) -> Master:
        """A new master from the operating system's randomness."""
        return cls(secrets.token_bytes(BYTES))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Master:
        """Read a master from a file.

        Raises:
          BoardError: the file is missing or contains no master.
        """
        try:
            data = read_regular(Path(path), 4096)
        except OSError as error:
            raise _no_master(path, str(error.strerror)) from None
        try:
            return cls(parse_secret(data))
        except (ValueError, BoardError):
            raise _no_master(path, "not 64 hex digits") from None

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the master into a new file that only its owner can read.

        Raises:
          BoardError: the file exists (an overwritten master is lost) or cannot be written.
        """
        return write_secret(path, self.raw)

    def commitment_to(self, terms: bytes) -> str:
        """SHA-256 of the seal, this master and a season's terms: `sha256:` and 64 hex digits."""
        return sha256_of(SEAL.encode() + self.raw + terms)

    def secret(self, purpose: Purpose, place: Place) -> bytes:
        """The 32 bytes for a purpose in a place."""
        parts = [SEAL, purpose, place.season, place.class_name, place.instance]
        message = plain_json([*parts, place.ticket, place.nonce])
        return hmac.new(self.raw, message, hashlib.sha256).digest()

    def seed(self, place: Place, purpose: Purpose = "task") -> str:
        """The seed of an instance's spec, or of its data: `0x` and up to 64 hex digits.

        All 256 bits: whoever could try every seed would recognise the data set that follows from
        it, and with its noise the optimum in each row.
        """
        return f"0x{int.from_bytes(self.secret(purpose, place)):x}"

    def states_seed(self, place: Place) -> int:
        """The seed of an instance's challenge states, which are published, in [0, 2⁵³)."""
        return int.from_bytes(self.secret("states", place)[:8]) >> 11


def _no_master(path: str | os.PathLike[str], reason: str) -> BoardError:
    return BoardError(
        f"{path}: no master secret: {reason}. `sme-leaderboard season new` creates one; without "
        "it nobody can reveal the season."
    )

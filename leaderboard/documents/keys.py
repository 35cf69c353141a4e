"""Ed25519 keys of submitters and boards.

A key is 32 random bytes; its public half, 64 hex digits, is the identity. A signature
covers the SHA-256 digest of a document, a purpose and the public key of a board, and is invalid
for any other purpose or board.

    signature = Ed25519(key, "sme-leaderboard/" purpose "/" board "/" digest)

`board "/"` is left out in a board's own log, where a submission is signed for no board yet, and on
boards of rules 1.

Readers of a board compute the digests of thousands of entries: `PlainDocument` takes little time.
"""

from __future__ import annotations

import hashlib
import hmac
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from leaderboard.errors import BoardError
from sme_registry.io import read_regular, require_packages
from sme_registry.spec.document import matching

if TYPE_CHECKING:
    from nacl import signing


import json
from typing import Any

from sme_registry.spec.document import Document

Purpose = Literal["submission", "entry", "ticket", "answers", "withdrawal", "log", "upload"]
PublicKey = Annotated[str, matching(r"^[0-9a-f]{64}$", "an ed25519 public key, 64 hex digits")]
Signature = Annotated[str, matching(r"^[0-9a-f]{128}$", "an ed25519 signature, 128 hex digits")]


@dataclass(frozen=True)
class SigningKey:
    """A private key; `repr` never shows it."""

    _private: signing.SigningKey

    @classmethod
    def generate(cls) -> SigningKey:
        """A new key from the operating system's randomness."""
        _require_nacl()
        from nacl import signing

        return cls(signing.SigningKey.generate())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SigningKey:
        """Read a key from a file.

        Raises:
          BoardError: the file is missing or contains no key.
        """
        _require_nacl()
        try:
            data = read_regular(path, 4096, links=True)
        except OSError as error:
            raise _no_key(path, str(error.strerror)) from None
        return cls.parse(data, path)

    @classmethod
    def parse(cls, data: bytes, path: str | os.PathLike[str]) -> SigningKey:
        """The key in the bytes of a file; an error names its path.

        Raises:
          BoardError: they are no key.
        """
        _require_nacl()
        from nacl import signing

        try:
            return cls(signing.SigningKey(parse_secret(data)))
        except ValueError:
            raise _no_key(path, "not 64 hex digits") from None

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the key into a new file that only its owner can read.

        Raises:
          BoardError: the file exists (an overwritten key is lost) or cannot be written.
        """
        return write_secret(path, self._private.encode())

    @property
    def public(self) -> str:
        """The public half, 64 hex digits."""
        return self._private.verify_key.encode().hex()

    def of_answers(self, nonce: str) -> SigningKey:
        """The key that signs the answers of a ticket, from the nonce in its request.

        Whoever has it learns nothing of this one, and can sign for no other ticket.
        """
        from nacl import signing

        label = f"sme-leaderboard/key of answers/{nonce}".encode()
        return SigningKey(
            signing.SigningKey(hmac.digest(self._private.encode(), label, hashlib.sha256))
        )

    @property
    def secret(self) -> str:
        """The private half, 64 hex digits."""
        return self._private.encode().hex()

    def sign(self, purpose: Purpose, digest: str, board: str | None = None) -> str:
        """The signature of a digest (or other short text), 128 hex digits.

        Args:
          purpose: the signature is valid for this one only.
          digest: of the document.
          board: the public key of the only board that may take it; None for no board.
        """
        return self._private.sign(_message(purpose, digest, board)).signature.hex()

    def __repr__(self) -> str:
        return f"SigningKey(public={self.public!r})"


def verifies(
    public: str, signature: str, purpose: Purpose, digest: str, board: str | None = None
) -> bool:
    """Whether this public key signed this digest for this purpose and board.

    False for every public key outside the group of prime order: with one of small order, some
    signatures fit every document (RFC 8032, section 8.9; libsodium refuses them, too).
    """
    _require_nacl()
    from nacl.bindings import crypto_core_ed25519_is_valid_point
    from nacl.exceptions import CryptoError
    from nacl.signing import VerifyKey

    try:
        key = bytes.fromhex(public)
        if not crypto_core_ed25519_is_valid_point(key):
            return False
        VerifyKey(key).verify(_message(purpose, digest, board), bytes.fromhex(signature))
    except (CryptoError, ValueError):
        return False
    return True


def _no_key(path: str | os.PathLike[str], reason: str) -> BoardError:
    return BoardError(
        f"{path}: no signing key: {reason}. Create one with `sme-leaderboard keygen`."
    )


def _require_nacl() -> None:
    """Imported where it is used, so that commands can show their help without it."""
    require_packages("signatures", {"nacl": "PyNaCl"}, "leaderboard")


def _message(purpose: Purpose, digest: str, board: str | None) -> bytes:
    parts = ["sme-leaderboard", purpose, *([] if board is None else [board]), digest]
    return "/".join(parts).encode()


def write_secret(path: str | os.PathLike[str], secret: bytes) -> Path:
    """Write a secret into a new file that only its owner can read.

    Raises:
      BoardError: the file exists (an overwritten secret is lost) or cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise BoardError(f"{path} already exists and is not replaced. Give another path.") from None
    except OSError as error:
        raise BoardError(f"{path}: cannot be written: {error.strerror}.") from None
    with os.fdopen(handle, "w") as stream:
        stream.write(secret.hex() + "\n")
        stream.flush()
        os.fsync(stream.fileno())
    return path


def parse_secret(data: bytes) -> bytes:
    """The bytes in the contents of such a file.

    Raises:
      ValueError: they are not hex digits.
    """
    return bytes.fromhex(data.decode("ascii").strip())


def plain_json(value: Any) -> bytes:
    """RFC 8785's canonical JSON of texts and integers below 2⁵³, in lists and under ASCII names.

    For such data the standard library writes the same as `rfc8785`, which also writes fractions,
    and is about thirty times as fast.
    """
    return json.dumps(value, ensure_ascii=False, sort_keys=True, separators=(",", ":")).encode()


class PlainDocument(Document):
    """A document of texts and integers below 2⁵³, in lists and under ASCII names."""

    def canonical_json(self) -> bytes:
        """The RFC 8785 canonical JSON of every field."""
        return plain_json(self.to_dict())

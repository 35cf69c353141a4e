"""Ed25519 keys of submitters and boards.

A key is 32 random bytes; its public half, 64 hex digits, is the identity. A signature
covers the SHA-256 digest of a document and a purpose, and is invalid for any other purpose.

    signature = Ed25519(key, "sme-leaderboard/" purpose "/" digest)
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from leaderboard.errors import BoardError
from sme_registry.io import require_packages

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

Purpose = Literal["submission", "withdrawal", "log", "upload"]
PublicKey = Annotated[
    str, Field(pattern=r"^[0-9a-f]{64}$", description="an ed25519 public key, 64 hex digits")
]
Signature = Annotated[
    str, Field(pattern=r"^[0-9a-f]{128}$", description="an ed25519 signature, 128 hex digits")
]


@dataclass(frozen=True)
class SigningKey:
    """A private key; `repr` never shows it."""

    _private: Ed25519PrivateKey

    @classmethod
    def generate(cls) -> SigningKey:
        """A new key from the operating system's randomness."""
        _require_cryptography()
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        return cls(Ed25519PrivateKey.generate())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SigningKey:
        """Read a key from a file.

        Raises:
          BoardError: the file is missing or contains no key.
        """
        _require_cryptography()
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        try:
            text = Path(path).read_text("ascii").strip()
            return cls(Ed25519PrivateKey.from_private_bytes(bytes.fromhex(text)))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "not 64 hex digits"
            raise BoardError(
                f"{path}: no signing key: {reason}. Create one with `sme-leaderboard keygen`."
            ) from None

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the key into a new file that only its owner can read.

        Raises:
          BoardError: the file exists (an overwritten key is lost) or cannot be written.
        """
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            raise BoardError(
                f"{path} already exists and is not replaced. Give another path with --key."
            ) from None
        except OSError as error:
            raise BoardError(f"{path}: cannot be written: {error.strerror}.") from None
        with os.fdopen(handle, "w") as stream:
            stream.write(self._private.private_bytes_raw().hex() + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        return path

    @property
    def public(self) -> str:
        """The public half, 64 hex digits."""
        return self._private.public_key().public_bytes_raw().hex()

    def sign(self, purpose: Purpose, digest: str) -> str:
        """The signature of a digest (or other short text) for a purpose, 128 hex digits."""
        return self._private.sign(_message(purpose, digest)).hex()

    def __repr__(self) -> str:
        return f"SigningKey(public={self.public!r})"


def verifies(public: str, signature: str, purpose: Purpose, digest: str) -> bool:
    """Whether the signature of this digest and purpose is by this public key."""
    _require_cryptography()
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public))
        key.verify(bytes.fromhex(signature), _message(purpose, digest))
    except (InvalidSignature, ValueError):
        return False
    return True


def _require_cryptography() -> None:
    """Imported where it is used, so that commands can show their help without it."""
    require_packages("signatures", {"cryptography": "cryptography"}, "leaderboard")


def _message(purpose: Purpose, digest: str) -> bytes:
    return f"sme-leaderboard/{purpose}/{digest}".encode()

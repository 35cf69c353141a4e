"""Ed25519 keys of submitters and boards, and `Signed`: the one envelope of all that entrants sign.

    id        = "sha256:" + hex(SHA-256(canonical JSON of the content))
    signature = Ed25519(key, "sme-leaderboard/" purpose "/" board "/" address "/" id)

A key is 32 random bytes; its public half, 64 hex digits, is the identity. A signature is valid for
one purpose, one board and one address only. `address "/"` is left out in documents of earlier
versions, and in those that are given to a board's folder; `board "/"` in a board's own log, and
where a submission is signed for no board yet.

Readers of a board compute the digests of thousands of entries: `PlainDocument` takes little time.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    NamedTuple,
    Self,
    TypeVar,
)

import rfc8785
from pydantic import SerializerFunctionWrapHandler, model_serializer, model_validator

from leaderboard.errors import BoardError, Rejection
from sme_registry.errors import MalformedDocumentError, SpecError
from sme_registry.io import parse_json, read_regular, require_packages, sha256_of, to_json
from sme_registry.spec.document import Document, StrictModel, matching

if TYPE_CHECKING:
    from nacl import signing

MAX_BYTES = 64 * 2**10
"""Of a signed document."""

Purpose = Literal["submission", "entry", "ticket", "answers", "withdrawal", "log", "upload"]
PublicKey = Annotated[str, matching(r"^[0-9a-f]{64}$", "an ed25519 public key, 64 hex digits")]
Signature = Annotated[str, matching(r"^[0-9a-f]{128}$", "an ed25519 signature, 128 hex digits")]
Address = Annotated[
    str, matching(r"^https?://[!-+\--~]+$", "the address of a served board", max_length=300)
]


class Receiver(NamedTuple):
    """Who may take a signature."""

    board: str | None = None  # by its public key; None for no board yet
    address: str | None = None  # where the signer has reached it; None for the board's folder


NOBODY = Receiver()


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
    def read(cls, path: str | os.PathLike[str], *, links: bool = True) -> SigningKey:
        """Read a key from a file; `BoardError` if it has none, or is a link without `links`."""
        _require_nacl()
        from nacl import signing

        remedy = "Restore it; `sme-leaderboard submit` creates one."
        return cls(signing.SigningKey(read_secret(path, "signing key", remedy, links=links)))

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the key into a new file that only its owner can read."""
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

    def sign(self, purpose: Purpose, digest: str, receiver: Receiver = NOBODY) -> str:
        """The signature of a digest (or other short text) for a purpose, 128 hex digits."""
        return self._private.sign(_message(purpose, digest, receiver)).signature.hex()

    def __repr__(self) -> str:
        return f"SigningKey(public={self.public!r})"


def verifies(
    public: str, signature: str, purpose: Purpose, digest: str, receiver: Receiver = NOBODY
) -> bool:
    """Whether this public key signed this digest for this purpose and receiver.

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
        VerifyKey(key).verify(_message(purpose, digest, receiver), bytes.fromhex(signature))
    except (CryptoError, ValueError):
        return False
    return True


def _require_nacl() -> None:
    """Imported where it is used, so that commands can show their help without it."""
    require_packages("signatures", {"nacl": "PyNaCl"}, "leaderboard")


def _message(purpose: Purpose, digest: str, receiver: Receiver) -> bytes:
    # An address begins with "http", and a digest does not: no text has two meanings.
    return "/".join(["sme-leaderboard", purpose, *filter(None, receiver), digest]).encode()


def write_secret(path: str | os.PathLike[str], secret: bytes) -> Path:
    """Write a secret into a new file that only its owner can read; one that exists is kept."""
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


def read_secret(
    path: str | os.PathLike[str], what: str, remedy: str, *, links: bool = False
) -> bytes:
    """The 32 bytes in such a file; `BoardError` if it has none, or is a link without `links`."""
    try:
        secret = bytes.fromhex(read_regular(path, 4096, links=links).decode("ascii").strip())
        reason = "" if len(secret) == 32 else f"{len(secret)} bytes, not 32"
    except OSError as error:
        reason = str(error.strerror)
    except ValueError:
        reason = "not 64 hex digits"
    if reason:
        raise BoardError(f"{path}: no {what}: {reason}. {remedy}")
    return secret


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


class Signable(PlainDocument):
    """What an entrant signs."""

    PURPOSE: ClassVar[Purpose]
    FIELD: ClassVar[str]  # of the content in the envelope
    COMMAND: ClassVar[str]  # of `sme-leaderboard`, which writes the file

    @property
    def signer(self) -> str | None:
        """The public key that must sign it, if it names that."""
        return None

    def signed(self, key: SigningKey, receiver: Receiver = NOBODY) -> Signed[Self]:
        """This content, signed for a receiver."""
        signature = key.sign(self.PURPOSE, self.digest, receiver)
        envelope: Any = Signed.__class_getitem__(type(self))
        signed: Signed[Self] = envelope(content=self, signature=signature, **receiver._asdict())
        return signed


class Seal(StrictModel):
    """A signature for one content, and who may take it: see `Receiver`."""

    signature: Signature
    board: PublicKey | None = None
    address: Address | None = None

    @property
    def receiver(self) -> Receiver:
        """Who may take it."""
        return Receiver(self.board, self.address)

    def fits(self, key: str, purpose: Purpose, digest: str) -> bool:
        """Whether this public key made the signature, for this digest and receiver."""
        return verifies(key, self.signature, purpose, digest, self.receiver)


Kind = TypeVar("Kind", bound=Signable, covariant=True)


class Signed(Seal, Generic[Kind]):
    """A document with the signature of the entrant's key, for one receiver.

    In the JSON, the content is called `Kind.FIELD`, and comes first; `board` and `address` are left
    out where they are None.
    """

    content: Kind

    @model_validator(mode="before")
    @classmethod
    def _content_named(cls, plain: Any) -> Any:
        name = cls._kind().FIELD
        if isinstance(plain, dict) and name in plain:
            return {"content" if field == name else field: plain[field] for field in plain}
        return plain

    @model_serializer(mode="wrap")
    def _content_first(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        content = {self.content.FIELD: plain.pop("content")}
        unnamed = {name for name in Receiver._fields if plain[name] is None}
        return content | {name: value for name, value in plain.items() if name not in unnamed}

    @classmethod
    def _kind(cls) -> type[Signable]:
        kind: Any = cls.model_fields["content"].annotation
        return kind  # type: ignore[no-any-return]

    @property
    def id(self) -> str:
        """The digest of the content."""
        return self.content.digest

    def is_valid(self, board: str | None, key: str | None = None) -> bool:
        """Whether it was signed for this board, with the key that it names, or a given one."""
        key = key or self.content.signer
        if key is None or self.board != board:
            return False
        return self.fits(key, self.content.PURPOSE, self.id)

    @classmethod
    def read(cls, text: bytes) -> Self:
        """Read a document, whose content names its key, from the bytes of a file.

        Anyone can send one, so what costs time, and answers at length, follows the verification of
        its signature. A `Rejection` is `too_large`, `not_json`, `schema` or `bad_signature`.
        """
        kind = cls._kind()
        plain = _parse(text, kind)
        id = _verified_id(plain, kind)
        signed = cls._validated(plain)
        if signed.id != id:
            raise Rejection(
                "schema",
                f"{kind.FIELD}.json: the signature must cover every field, those at their defaults "
                f"included. Create it with `sme-leaderboard {kind.COMMAND}`.",
            )
        return signed

    @classmethod
    def read_unverified(cls, text: bytes) -> Self:
        """Read a document whose content names no key; the caller verifies its signature."""
        return cls._validated(_parse(text, cls._kind()))

    @classmethod
    def _validated(cls, plain: Any) -> Self:
        try:
            return cls.from_dict(plain, f"{cls._kind().FIELD}.json")
        except SpecError as error:
            raise Rejection("schema", str(error)) from None

    def for_receiver(self, receiver: Receiver, key: SigningKey) -> Self:
        """The same content, signed for a receiver; what is for another board is not sent to it."""
        if self.receiver == receiver:
            return self
        if self.board not in (None, receiver.board):
            raise Rejection(
                "wrong_board",
                f"board={receiver.board}: must be {self.board}, which it is signed for. Send it "
                "there, or create it again for this board.",
            )
        own = self.content.signer or ""
        if key.public != own:
            raise Rejection(
                "bad_signature",
                f"key={key.public[:16]}…: must be the {self.content.FIELD}'s, {own[:16]}…, to sign "
                "it for this board. Give that key's file (option --key).",
            )
        signature = key.sign(self.content.PURPOSE, self.id, receiver)
        return self.model_copy(update={"signature": signature, **receiver._asdict()})

    def to_bytes(self) -> bytes:
        """The bytes of the file."""
        return to_json(self.to_dict()).encode()


def _parse(text: bytes, kind: type[Signable]) -> Any:
    if len(text) > MAX_BYTES:
        raise Rejection(
            "too_large",
            f"{kind.FIELD}.json: must be at most {MAX_BYTES:,} bytes. List fewer runs, or shorten "
            "the texts.",
        )
    try:
        return parse_json(text, f"{kind.FIELD}.json")
    except MalformedDocumentError as error:
        raise Rejection("not_json", str(error)) from None


def _verified_id(plain: Any, kind: type[Signable]) -> str:
    """The digest of the content as it arrived, whose signature is verified."""
    file, remedy = f"{kind.FIELD}.json", f"Create it with `sme-leaderboard {kind.COMMAND}`."
    if isinstance(plain, dict) and "signature" not in plain:
        raise Rejection("bad_signature", f"{file}: signature: missing. {remedy}")
    seal = dict(plain) if isinstance(plain, dict) else {}
    content = seal.pop(kind.FIELD, None)
    match content:
        case {"submitter": {"key": str(key)}}:
            pass
        case _:
            raise Rejection(
                "schema",
                f"{file}: must have the field {kind.FIELD}, with its submitter's key. {remedy}",
            )
    try:
        parsed = Seal.from_dict(seal, file)
    except SpecError as error:
        raise Rejection("schema", str(error)) from None
    id = _raw_digest(content, file)
    if not parsed.fits(key, kind.PURPOSE, id):
        raise Rejection(
            "bad_signature",
            f"signature={parsed.signature[:16]}…: invalid for this {kind.FIELD}, its board and "
            f"address, and the key {key[:16]!a}…. Sign it again after the last change.",
        )
    return id


def _raw_digest(content: dict[str, Any], file: str) -> str:
    try:
        return sha256_of(rfc8785.dumps(content))
    except RecursionError:
        raise Rejection(
            "not_json", f"{file}: nested too deeply. Valid documents have at most ten levels."
        ) from None
    except ValueError:  # rfc8785's errors, and those of lone surrogates
        raise Rejection(
            "schema",
            f"{file}: contains a number or a character that JSON cannot exchange (RFC 8785): "
            "integers must be in [-(2^53 - 1), 2^53 - 1], and other numbers finite. Correct it.",
        ) from None

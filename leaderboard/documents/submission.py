"""`Submission`: the document that a submitter signs. It names policies by hash and has no scores.

    id = "sha256:" + hex(SHA-256(canonical JSON of the submission))

A bundle is the submitted folder: `submission.json` (a `SignedSubmission`) and one file
`artefacts/<64 hex digits of its SHA-256>.onnx` for each artefact.
"""

from __future__ import annotations

import datetime
import re
import time
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

import rfc8785
from pydantic import BeforeValidator, Field, SerializerFunctionWrapHandler, model_serializer

from leaderboard.documents.keys import PlainDocument, PublicKey, Signature, SigningKey, verifies
from leaderboard.errors import Rejection
from sme_registry.errors import MalformedDocumentError, SpecError
from sme_registry.io import parse_json, sha256_of, to_json
from sme_registry.spec.document import (
    Digest,
    Document,
    Integer,
    Name,
    SchemaVersion,
    StrictModel,
    matching,
)

FILE = "submission.json"
ARTEFACTS = "artefacts"
MAX_BYTES = 64 * 2**10
MAX_ARTEFACT_BYTES = 8 * 2**20
MAX_ENTRIES = 1000
"""Most runs listed, and most classes counted."""
MAX_RUNS = 1000
"""Largest total of `runs_started`."""

Track = Literal["open"]
Knowledge = Literal["generic", "family", "oracle"]

_Model = TypeVar("_Model", bound=StrictModel)
_Line = Annotated[str, Field(min_length=1, max_length=80)]
_Text = Annotated[str, Field(max_length=2000)]
_Link = Annotated[
    str,
    matching(
        r"^https://[!-~]+$",
        "an https:// link of at most 300 characters, without spaces",
        max_length=300,
    ),
]
_Count = Annotated[Integer, Field(ge=0, le=10**12)]
UtcTime = Annotated[
    str,
    matching(r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ$", "a time in UTC, as in 2026-11-21T09:30:00Z"),
]


def _at_most_entries(value: Any) -> Any:
    """Refuse a long list before each of its entries is validated, which takes longer."""
    if isinstance(value, list | tuple | dict) and len(value) > MAX_ENTRIES:
        raise ValueError(f"must have at most {MAX_ENTRIES:,} entries. List fewer.")
    return value


class SuiteReference(StrictModel):
    """A suite: its versioned name for readers, its digest as identity."""

    name: Name
    digest: Digest


class Method(StrictModel):
    """The method that was run.

    Attributes:
      name, version: as the board shows them; letters, digits, spaces and `._+-()`.
      family: the kind of method, such as "PPO" or "model-based".
      knowledge: about the task, beyond its interface. "generic": none. "family": that it is an SME,
        and how SMEs are built. "oracle": the optimal policy of this task.
    """

    name: _Line
    version: _Line
    family: _Line
    knowledge: Knowledge


class Submitter(StrictModel):
    """The submitter: the key is the identity, the name is for display."""

    name: _Line
    key: PublicKey


class Artefact(StrictModel):
    """The ONNX file of a policy, identified by its content."""

    sha256: Digest
    size: Annotated[Integer, Field(ge=1, le=MAX_ARTEFACT_BYTES)]


class Run(StrictModel):
    """One training run on one instance of the suite.

    Attributes:
      spec: digest of the instance.
      seed: of the training run.
      steps: environment steps taken.
      artefact: the policy; null if the run failed. It then scores 1 in every metric.
    """

    spec: Digest
    seed: Annotated[Integer, Field(ge=0, lt=2**53)]
    steps: _Count
    artefact: Artefact | None = None


class Training(StrictModel):
    """Facts of the training, in the submitter's words.

    Attributes:
      library: with its version.
      hyperparameters: those that differ from the library's defaults.
      hardware: with the training time.
    """

    library: Annotated[str, Field(max_length=200)] = ""
    hyperparameters: _Text = ""
    hardware: Annotated[str, Field(max_length=200)] = ""


class Manifest(PlainDocument):
    """What every track asks of an entrant.

    Attributes:
      code: a link to the method's code, or null.
      created: time of signing.
      statement: notes for readers.
    """

    schema_version: SchemaVersion = 1
    method: Method
    code: _Link | None = None
    submitter: Submitter
    created: UtcTime
    training: Training = Training()
    statement: _Text = ""


class Submission(Manifest):
    """The signed content of the open track.

    Attributes:
      runs: at least one on each instance of the suite.
      runs_started: all runs ever started with this method, by class. Runs that are not listed in
        `runs` score 1 in every metric, so omitting a run helps only if it was worse than that.
    """

    track: Track = "open"
    suite: SuiteReference
    runs: Annotated[
        tuple[Run, ...],
        Field(min_length=1, max_length=MAX_ENTRIES, strict=False),
        BeforeValidator(_at_most_entries),
    ]
    runs_started: Annotated[dict[Name, _Count], BeforeValidator(_at_most_entries)]

    @model_serializer(mode="wrap")
    def _in_the_order_of_released_files(
        self, handler: SerializerFunctionWrapHandler
    ) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        return {name: plain[name] for name in _ORDER}

    def signed(self, key: SigningKey, board: str | None = None) -> SignedSubmission:
        """This submission, signed as `SignedManifest.sign` says."""
        return SignedSubmission.sign(self, key, board)


_ORDER = (
    *("schema_version", "track", "suite", "method", "code", "submitter", "created"),
    *("runs", "runs_started", "training", "statement"),
)


class SignedDocument(StrictModel):
    """A document with the signature of the submitter's key, for one board or for none.

    Attributes:
      signature: of the submitter's key, for this document and board.
      board: the public key of the only board that accepts it; None if it is not known yet. It is
        left out of the JSON where it is None, as in boards of rules 1.
    """

    signature: Signature
    board: PublicKey | None = None

    @model_serializer(mode="wrap")
    def _content_first(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = handler(self)
        signature, board = plain.pop("signature"), plain.pop("board")
        return {**plain, "signature": signature, **({} if board is None else {"board": board})}


class SignedManifest(SignedDocument):
    """A manifest, in the field `KIND`, with its signature.

    Attributes:
      KIND: the field, and the purpose of the signature.
      COMMAND: of `sme-leaderboard`, which writes the file.
    """

    KIND: ClassVar[Literal["submission", "entry", "ticket"]]
    COMMAND: ClassVar[str]

    @classmethod
    def sign(cls, content: Manifest, key: SigningKey, board: str | None = None) -> Self:
        """A manifest, signed with the submitter's key.

        Args:
          content: of the type that the field has.
          key: the submitter's.
          board: the public key of the only board that accepts it; None if it is not known yet.
        """
        signature = key.sign(cls.KIND, content.digest, board)
        fields: dict[str, Any] = {cls.KIND: content, "signature": signature, "board": board}
        return cls(**fields)

    @classmethod
    def read(cls, text: bytes) -> Self:
        """Read a document from the bytes of a file and verify its signature.

        Raises:
          Rejection: `too_large`, `not_json`, `schema` or `bad_signature`.
        """
        return Envelope.read(text, cls).open()

    @property
    def content(self) -> Manifest:
        """What is signed."""
        content: Manifest = getattr(self, self.KIND)
        return content

    @property
    def is_valid(self) -> bool:
        """Whether the submitter's key made the signature, for this content and board."""
        key = self.content.submitter.key
        return verifies(key, self.signature, self.KIND, self.id, self.board)

    def for_board(self, board: str, key: SigningKey) -> Self:
        """The same content, signed for a board if it is signed for none.

        Args:
          board: the board's public key.
          key: the submitter's.

        Raises:
          Rejection: `bad_signature` if `key` is not the submitter's.
        """
        if self.board is not None:
            return self
        own = self.content.submitter.key
        if key.public != own:
            raise Rejection(
                "bad_signature",
                f"key={key.public[:16]}…: must be the {self.KIND}'s, {own[:16]}…, to sign it for "
                "this board. Give that key's file (option --key).",
            )
        return self.sign(self.content, key, board)

    @property
    def id(self) -> str:
        """The id of the document: the digest of its content."""
        return self.content.digest

    def to_bytes(self) -> bytes:
        """The bytes of the file."""
        return to_json(self.to_dict()).encode()


_SignedKind = TypeVar("_SignedKind", bound=SignedManifest)


class SignedSubmission(SignedManifest):
    """`submission.json`."""

    KIND = "submission"
    COMMAND = "new"

    submission: Submission


@dataclass(frozen=True)
class Envelope(Generic[_SignedKind]):
    """A signed manifest whose signature is verified, and whose content is not validated yet.

    Anyone can send a document, so what costs time, and answers at length, follows the signature.

    Attributes:
      id: the digest of the content's canonical JSON.
      key: the submitter's public key, which made the signature.
      board: the public key of the board that the signature is for; None if it is for none.
      plain: the whole document.
      kind: its type.
    """

    id: str
    key: str
    board: str | None
    plain: dict[str, Any]
    kind: type[_SignedKind]

    @classmethod
    def read(cls, text: bytes, kind: type[_SignedKind]) -> Envelope[_SignedKind]:
        """Parse the bytes of a file and verify the signature.

        Raises:
          Rejection: `too_large`, `not_json`, `schema` or `bad_signature`.
        """
        plain = _parse(text, f"{kind.KIND}.json", "List fewer runs, or shorten the texts.")
        if isinstance(plain, dict) and "signature" not in plain:
            raise Rejection(
                "bad_signature",
                f"signature: missing. Sign it with `sme-leaderboard {kind.COMMAND} --key`.",
            )
        content, key, signature, board = _parts(plain, kind)
        id = _raw_digest(content, f"{kind.KIND}.json")
        if not verifies(key, signature, kind.KIND, id, board):
            raise Rejection(
                "bad_signature",
                f"signature={signature[:16]}…: invalid for this {kind.KIND}, its board and the key "
                f"{key[:16]}…. Sign it again after the last change.",
            )
        return cls(id, key, board, plain, kind)

    def open(self) -> _SignedKind:
        """The validated document.

        Raises:
          Rejection: `schema`.
        """
        name = self.kind.KIND
        signed = _validate(self.kind, self.plain, f"{name}.json")
        if signed.id != self.id:
            raise Rejection(
                "schema",
                f"{name}.json: the signature must cover every field of the {name}, those at their "
                f"defaults included. Create it with `sme-leaderboard {self.kind.COMMAND}`.",
            )
        return signed


def _parts(plain: Any, kind: type[SignedManifest]) -> tuple[dict[str, Any], str, str, str | None]:
    """Content, public key, signature and board of a document that nothing has validated."""
    match plain:
        case {"signature": str(signature), **others}:
            content: Any = others.pop(kind.KIND, None)
            board: Any = others.pop("board", None)
            match content:
                case {"submitter": {"key": str(key)}}:
                    keys = [key] if board is None else [key, board]
                    digits = _is_hex(signature, 128) and all(_is_hex(each, 64) for each in keys)
                    if digits and not others:
                        return content, key, signature, board
    raise Rejection(
        "schema",
        f"{kind.KIND}.json: must have the fields {kind.KIND}, with the key of its submitter, "
        "signature, and board unless it is signed for none: keys of 64 and a signature of 128 hex "
        f"digits. Create it with `sme-leaderboard {kind.COMMAND}`.",
    )


def _is_hex(value: Any, digits: int) -> bool:
    return isinstance(value, str) and re.fullmatch(rf"[0-9a-f]{{{digits}}}", value) is not None


def _raw_digest(content: dict[str, Any], file: str) -> str:
    """The digest of a document's content as it arrived."""
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


class Withdrawal(Document):
    """Signed by a submitter to withdraw a submission; its page remains, marked as withdrawn."""

    schema_version: SchemaVersion = 1
    submission: Digest
    created: UtcTime
    reason: Annotated[str, Field(max_length=300)] = ""


class SignedWithdrawal(SignedDocument):
    """A withdrawal, signed with the key of the submission."""

    withdrawal: Withdrawal

    @classmethod
    def create(
        cls, id: str, key: SigningKey, reason: str = "", *, board: str | None = None
    ) -> SignedWithdrawal:
        """A new withdrawal.

        Args:
          id: the submission's.
          key: the one that signed the submission.
          reason: shown on the submission's page; up to 300 characters.
          board: the public key of the submission's board.
        """
        withdrawal = Withdrawal(submission=id, created=now(), reason=reason)
        signature = key.sign("withdrawal", withdrawal.digest, board)
        return cls(withdrawal=withdrawal, signature=signature, board=board)

    def is_valid(self, key: str) -> bool:
        """Whether this public key made the signature, for this withdrawal and board."""
        return verifies(key, self.signature, "withdrawal", self.withdrawal.digest, self.board)

    @classmethod
    def read(cls, text: bytes) -> SignedWithdrawal:
        """Parse a withdrawal. `Store.withdraw` verifies the signature, with the submission's key.

        Raises:
          Rejection: `too_large`, `not_json` or `schema`.
        """
        plain = _parse(text, "withdrawal", f"It has {len(text):,}. Shorten the reason.")
        return _validate(cls, plain, "withdrawal")


def _parse(text: bytes, name: str, remedy: str) -> Any:
    if len(text) > MAX_BYTES:
        raise Rejection("too_large", f"{name}: must be at most {MAX_BYTES:,} bytes. {remedy}")
    try:
        return parse_json(text, name)
    except MalformedDocumentError as error:
        raise Rejection("not_json", str(error)) from None


def _validate(kind: type[_Model], plain: Any, name: str) -> _Model:
    try:
        return kind.from_dict(plain, name)
    except SpecError as error:
        raise Rejection("schema", str(error)) from None


def utc(moment: datetime.datetime) -> str:
    """A time as documents write it."""
    # Not strftime, which does not write the year 1 with four digits everywhere.
    plain = moment.astimezone(datetime.UTC).replace(microsecond=0, tzinfo=None)
    return f"{plain.isoformat()}Z"


def shifted(moment: datetime.datetime, by: datetime.timedelta) -> datetime.datetime:
    """A time in UTC later by so much, at most the last or the first one that Python knows."""
    try:
        return moment + by
    except OverflowError:
        end = datetime.datetime.max if by > datetime.timedelta() else datetime.datetime.min
        return end.replace(tzinfo=datetime.UTC)


def now() -> str:
    """The machine's time as documents write it."""
    return utc(datetime.datetime.fromtimestamp(time.time(), datetime.UTC))

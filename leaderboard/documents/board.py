"""`BoardDocument`: the definition of a board; `Folder`: the paths of a board's files.

    board.json                   the board: suite, protocol, limits, public key
    board.key                    its private key
    log/00000000.json …          signed entries, each with the digest of the one before
    objects/ab/cdef…             documents that the log names, and policy files, by their SHA-256
    seasons/<64 hex>/            files of sealed seasons, by the digest of the season
    index.sqlite                 an index of all these, which `reindex` recreates

The log is authoritative. A board has one suite and one protocol. Boards of rules 2, which are only
read, have their documents in submissions/, withdrawals/, results/ and seasons/.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator

from leaderboard.documents.signed import MAX_BYTES as MAX_SIGNED_BYTES
from leaderboard.documents.signed import PublicKey, Receiver, SigningKey
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES, SuiteReference, Track
from leaderboard.errors import BoardError, Rejection
from sme_registry.errors import SMEError, SpecError
from sme_registry.io import parse_json, read_regular
from sme_registry.spec import EvaluationProtocol, SMESpec, Suite, SuiteFile
from sme_registry.spec.document import Document, Integer, Name, SchemaVersion, StrictModel

RULES: Final = 3
"""The rules of new boards."""

FILE = "board.json"
KEY = "board.key"
MAX_BYTES = 2**20
"""Of board.json; that of the largest suite that fits a board has about a tenth."""

MAX_INSTANCES = 1000
"""Of a board's suite, each of which takes a run of every submission."""

MOST_LISTED = 200
"""Runs that fit into the bytes of a submission, with short texts."""

RUNS_TO_RANK = 10
"""Runs in each class that a rank needs, unless the board is for practice."""


class Limits(StrictModel):
    """Limits of a board.

    Attributes:
      submissions_per_day, upload_bytes_per_day: of each key.
      waiting_submissions: submissions of all keys that are not scored yet.
      artefact_bytes: size of an artefact.
      age_days: age of a submission's signature.
      total_bytes: size of all artefacts, submissions, results, journals and answers.
    """

    submissions_per_day: Annotated[Integer, Field(ge=1)] = 20
    upload_bytes_per_day: Annotated[Integer, Field(ge=1)] = 2**30
    waiting_submissions: Annotated[Integer, Field(ge=1)] = 1000
    artefact_bytes: Annotated[Integer, Field(ge=1, le=MAX_ARTEFACT_BYTES)] = MAX_ARTEFACT_BYTES
    age_days: Annotated[Integer, Field(ge=1, le=3650)] = 14
    total_bytes: Annotated[Integer, Field(ge=1)] = 2**36


def refuse_unscored(suite: Suite) -> None:
    """Raise SpecError if a suite has what boards do not score: streams, or more than plain tasks.

    A rank by distance from the optimum alone would favour agents that break limits.
    """
    suite.check_no_streams("a leaderboard")
    extended = ", ".join(member.name for member in suite.classes if not member.setting.is_plain)
    if extended:
        raise SpecError(
            f"suite: has classes with safety, observation, shaping or noise ({extended}), and a "
            "leaderboard scores none of these. Choose a suite without them; studies train on them: "
            "`sme study new --suite`."
        )


class BoardDocument(Document):
    """`board.json`. Fields younger than version 1 are left out of the JSON at their defaults.

    Attributes:
      title: in the header of its pages.
      suite_name: the suite's versioned name, such as `smoke-v1`.
      suite_description, suite_tags: of the suite's file.
      protocol_name: the protocol's, such as `paper-v1`.
      key: the public key of the log's signatures.
      rules: version of the rules of files and scores. Boards of version 2 can be read and verified,
        and accept nothing.
      runs_to_rank: runs that a ranked entry needs in each class, spread over its instances; below
        10 the board is for practice, and says so.
      draws: number of bootstrap resamples.
    """

    fields_added_later = ("suite_description", "suite_tags")

    schema_version: SchemaVersion = 1
    title: Annotated[str, Field(min_length=1, max_length=80)]
    track: Track = "open"
    suite_name: Name
    suite: Suite
    suite_description: Annotated[str, Field(max_length=2000)] = ""
    suite_tags: Annotated[tuple[Name, ...], Field(strict=False, max_length=64)] = ()
    protocol_name: Name
    protocol: EvaluationProtocol
    key: PublicKey
    rules: Literal[2, 3]
    runs_to_rank: Annotated[Integer, Field(ge=1, le=1000)] = RUNS_TO_RANK
    draws: Annotated[Integer, Field(ge=100, le=10**6)] = 10_000
    limits: Limits = Limits()

    @field_validator("suite")
    @classmethod
    def _can_be_scored(cls, suite: Suite) -> Suite:
        try:
            refuse_unscored(suite)
        except SpecError as error:
            raise ValueError(str(error)) from None
        return suite

    @property
    def practice(self) -> bool:
        """Whether entries are ranked by so few runs that the ranking proves little."""
        return self.runs_to_rank < RUNS_TO_RANK

    @property
    def runs_needed(self) -> int:
        """Runs of a ranked entry, in all classes."""
        return sum(
            len(member.seeds) * self.runs_on_each(len(member.seeds))
            for member in self.suite.classes
        )

    def runs_on_each(self, instances: int) -> int:
        """Runs that a ranked entry needs on each instance of a class with this many, at least 1."""
        return math.ceil(self.runs_to_rank / instances)

    @property
    def suite_file(self) -> SuiteFile:
        """The suite as a file, from which others train on it."""
        name, _, version = self.suite_name.rpartition("-v")
        if not (name and version.isdecimal()):
            name, version = self.suite_name, "1"
        return SuiteFile(
            name=name,
            version=int(version),
            description=self.suite_description,
            tags=self.suite_tags,
            digest=self.suite.digest,
            suite=self.suite,
        )

    @property
    def suite_reference(self) -> SuiteReference:
        """The board's suite as submissions name it."""
        return SuiteReference(name=self.suite_name, digest=self.suite.digest)

    @property
    def instances(self) -> dict[str, tuple[str, SMESpec]]:
        """Class name and spec of each instance, by the spec's digest, in the suite's order.

        Computed on each access: store it before a loop.
        """
        return {
            spec.digest: (member.name, spec)
            for member in self.suite.classes
            for spec in member.instances
        }


class Folder:
    """The paths of a board's files; creates and reads nothing by itself."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.board = self.path / FILE
        self.key = self.path / KEY
        self.log = self.path / "log"
        self.objects = self.path / "objects"
        self.seasons = self.path / "seasons"
        self.index = self.path / "index.sqlite"

    def read(self) -> BoardDocument:
        """The board's document."""
        if not os.path.lexists(self.board):
            raise BoardError(
                f"{self.path}: contains no board (no {FILE}). Give a board's folder, or create a "
                "board with `sme-leaderboard init`."
            )
        try:
            data = read_regular(self.board, MAX_BYTES)
            plain = parse_json(data, str(self.board))
            if isinstance(plain, dict) and plain.get("rules", 1) == 1:
                raise BoardError(
                    f"{self.board}: is of rules 1, which commit 37293a8d is the last to read."
                )
            document = BoardDocument.from_dict(plain, str(self.board))
        except OSError as error:
            raise BoardError(f"{self.board}: cannot be read: {error.strerror}.") from None
        except SMEError as error:
            raise BoardError(str(error)) from None
        count = sum(len(member.seeds) for member in document.suite.classes)
        if count > MAX_INSTANCES:
            raise BoardError(
                f"{self.board}: suite: has {count:,} instances, and a board has at most "
                f"{MAX_INSTANCES:,}. No submission could list a run on each."
            )
        return document

    def signing_key(self) -> SigningKey:
        """The board's private key; `BoardError` if it is missing, or a link."""
        return SigningKey.read(self.key, links=False)

    def object(self, digest: str) -> Path:
        """The path of a document or policy file, by its digest."""
        digits = hex_of(digest)
        return self.objects / digits[:2] / digits[2:]

    def log_entry(self, sequence: int) -> Path:
        """The path of a log entry, by its number, 0 for the first."""
        return self.log / f"{sequence:08d}.json"


def hex_of(digest: str) -> str:
    """The 64 hex digits of a digest, a safe file name; ValueError if it is not a digest."""
    digits = digest.removeprefix("sha256:")
    if len(digits) != 64 or not set(digits) <= set("0123456789abcdef"):
        raise ValueError(f"not a digest: {digest!r:.90}")
    return digits


def check_receiver(board: BoardDocument, receiver: Receiver, address: str | None = None) -> None:
    """Reject (`wrong_board`) a signature that is not for this board, or not for its address.

    Otherwise a server that stands between could pass on what it was sent, and take part in another
    board under the sender's name. `address` is of the server that it was sent to; None if it was
    given to the board's folder.
    """
    if board.rules != RULES:
        raise Rejection(
            "wrong_board",
            f"board={board.key[:16]}…: follows earlier rules ({board.rules}) and accepts nothing. "
            "Submit to a board that was created later.",
        )
    if receiver.board != board.key:
        stated = "none" if receiver.board is None else f"{receiver.board[:16]}…"
        raise Rejection(
            "wrong_board",
            f"board={stated}: the signature must be for this board, {board.key[:16]}…. Submit "
            "the runs to this one.",
        )
    if address not in (None, receiver.address):
        raise Rejection(
            "wrong_board",
            f"address={receiver.address or 'none'}: the signature must be for this board's "
            f"address, {address}. Send it there, with a present version of sme-registry; if the "
            "board has another address by now, its owner must state it (`serve --url`).",
        )


def refuse_unsubmittable(board: BoardDocument) -> None:
    """Raise `BoardError` if a rank needs more runs than fit into a submission."""
    if board.runs_needed > MOST_LISTED:
        raise BoardError(
            f"suite={board.suite_name}: a ranked entry needs {board.runs_needed:,} runs, "
            f"{board.runs_to_rank} in each class and as many on each instance: must be at most "
            f"{MOST_LISTED}, which fit into the {MAX_SIGNED_BYTES:,} bytes of a submission. Use "
            "fewer classes or instances, or lower runs_to_rank."
        )

"""`BoardDocument`: what a board is of; and the folder in which everything of a board lies.

    board.json                   the board: suite, protocol, limits, public key
    board.key                    its private key
    log/00000000.json …          signed, each entry holding the digest of the one before: the truth
    submissions/<64 hex>.json    as they were signed, by id
    withdrawals/<64 hex>.json    likewise, by the submission's id
    results/<64 hex>.json        by the submission's id
    objects/ab/cdef…             artefacts, by the SHA-256 of their bytes
    index.sqlite                 an index of all these, which `reindex` makes anew

One board is of one suite and one protocol; another suite is another board.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from leaderboard.documents.keys import PublicKey, SigningKey
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES, SuiteReference, Track
from leaderboard.errors import BoardError
from sme_registry.errors import SMEError
from sme_registry.io import read_json
from sme_registry.spec import (
    Document,
    EvaluationProtocol,
    Integer,
    Name,
    SchemaVersion,
    SMESpec,
    StrictModel,
    Suite,
)

FILE = "board.json"
KEY = "board.key"


class Limits(StrictModel):
    """Of one key, and of the whole board.

    Attributes:
      submissions_per_day, upload_bytes_per_day: of one key.
      waiting_submissions: not scored yet, of all keys together.
      artefact_bytes: of one artefact.
      age_days: how old a submission's signature may be.
      total_bytes: of all objects.
    """

    submissions_per_day: Annotated[Integer, Field(ge=1)] = 20
    upload_bytes_per_day: Annotated[Integer, Field(ge=1)] = 2**30
    waiting_submissions: Annotated[Integer, Field(ge=1)] = 1000
    artefact_bytes: Annotated[Integer, Field(ge=1, le=MAX_ARTEFACT_BYTES)] = MAX_ARTEFACT_BYTES
    age_days: Annotated[Integer, Field(ge=1, le=3650)] = 14
    total_bytes: Annotated[Integer, Field(ge=1)] = 2**36


class BoardDocument(Document):
    """`board.json`.

    Attributes:
      title: as the page's header shows it.
      suite_name: the suite's versioned name, such as `smoke-v1`.
      protocol_name: likewise, such as `paper-v1`.
      key: the public key that signs the log.
      runs_to_rank: fewest runs in each class for an entry to be ranked.
      draws: of the bootstrap.
    """

    schema_version: SchemaVersion = 1
    title: Annotated[str, Field(min_length=1, max_length=80)]
    track: Track = "open"
    suite_name: Name
    suite: Suite
    protocol_name: Name
    protocol: EvaluationProtocol
    key: PublicKey
    runs_to_rank: Annotated[Integer, Field(ge=1, le=1000)] = 10
    draws: Annotated[Integer, Field(ge=100, le=10**6)] = 10_000
    limits: Limits = Limits()

    @property
    def suite_reference(self) -> SuiteReference:
        """How submissions name this board's suite."""
        return SuiteReference(name=self.suite_name, digest=self.suite.digest)

    @property
    def instances(self) -> dict[str, tuple[str, SMESpec]]:
        """Class name and spec of each instance, by the spec's digest, in the suite's order.

        Made anew at each call: keep it over a loop.
        """
        return {
            spec.digest: (member.name, spec)
            for member in self.suite.classes
            for spec in member.instances
        }


class Folder:
    """The paths of a board; makes and reads nothing by itself.

    Args:
      path: the board's folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.board = self.path / FILE
        self.key = self.path / KEY
        self.log = self.path / "log"
        self.submissions = self.path / "submissions"
        self.withdrawals = self.path / "withdrawals"
        self.results = self.path / "results"
        self.objects = self.path / "objects"
        self.index = self.path / "index.sqlite"

    def read(self) -> BoardDocument:
        """The board's document.

        Raises:
          BoardError: the folder holds no board, or a broken one.
        """
        if not self.board.is_file():
            raise BoardError(
                f"{self.path}: holds no board. Make one with `sme-leaderboard init {self.path}`."
            )
        try:
            return BoardDocument.from_dict(read_json(self.board), str(self.board))
        except SMEError as error:
            raise BoardError(str(error)) from None

    def signing_key(self) -> SigningKey:
        """The board's private key.

        Raises:
          BoardError: it is not there.
        """
        return SigningKey.read(self.key)

    def submission(self, id: str) -> Path:
        """The path of a submission, by its id."""
        return self.submissions / f"{hex_of(id)}.json"

    def withdrawal(self, id: str) -> Path:
        """The path of a submission's withdrawal, by the submission's id."""
        return self.withdrawals / f"{hex_of(id)}.json"

    def result(self, id: str) -> Path:
        """The path of a submission's result, by the submission's id."""
        return self.results / f"{hex_of(id)}.json"

    def object(self, digest: str) -> Path:
        """The path of an artefact, by its digest."""
        digits = hex_of(digest)
        return self.objects / digits[:2] / digits[2:]

    def log_entry(self, sequence: int) -> Path:
        """The path of a log entry, by its number, 0 for the first."""
        return self.log / f"{sequence:08d}.json"


def hex_of(digest: str) -> str:
    """The 64 hex digits of a digest, and so a safe file name.

    Raises:
      ValueError: it is no digest; whoever asks has to check what comes from outside.
    """
    digits = digest.removeprefix("sha256:")
    if len(digits) != 64 or not set(digits) <= set("0123456789abcdef"):
        raise ValueError(f"not a digest: {digest!r:.90}")
    return digits

"""`Submission`: the document that a submitter signs. It names policies by hash and has no scores.

    id = "sha256:" + hex(SHA-256(canonical JSON of the submission))

A bundle is the submitted folder: `submission.json` (a `Signed[Submission]`) and one file
`artefacts/<64 hex digits of its SHA-256>.onnx` for each artefact.
"""

from __future__ import annotations

import datetime
import time
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, SerializerFunctionWrapHandler, model_serializer

from leaderboard.documents.signed import PublicKey, Signable
from sme_registry.spec.document import (
    Digest,
    Integer,
    Name,
    SchemaVersion,
    StrictModel,
    matching,
)

FILE = "submission.json"
ARTEFACTS = "artefacts"
MAX_ARTEFACT_BYTES = 8 * 2**20
MAX_ENTRIES = 1000
"""Most runs listed, and most classes counted."""
MAX_RUNS = 1000
"""Largest total of `runs_started`."""

Track = Literal["open"]
Knowledge = Literal["generic", "family", "oracle"]

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


class Manifest(Signable):
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

    @property
    def signer(self) -> str:
        """The submitter's key."""
        return self.submitter.key


class Submission(Manifest):
    """The signed content of the open track.

    Attributes:
      runs: at least one on each instance of the suite.
      runs_started: all runs ever started with this method, by class. Runs that are not listed in
        `runs` score 1 in every metric, so omitting a run helps only if it was worse than that.
    """

    PURPOSE, FIELD, COMMAND = "submission", "submission", "new"

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


_ORDER = (
    *("schema_version", "track", "suite", "method", "code", "submitter", "created"),
    *("runs", "runs_started", "training", "statement"),
)


class Withdrawal(Signable):
    """Signed by a submitter to withdraw a submission; its page remains, marked as withdrawn."""

    PURPOSE, FIELD, COMMAND = "withdrawal", "withdrawal", "withdraw"

    schema_version: SchemaVersion = 1
    submission: Digest
    created: UtcTime
    reason: Annotated[str, Field(max_length=300)] = ""


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

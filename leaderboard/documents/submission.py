"""`Submission`: the document that a submitter signs, and the checks that its schema cannot express.

It names policies by hash and has no scores.

    id = "sha256:" + hex(SHA-256(canonical JSON of the submission))

A bundle is the submitted folder: `submission.json` (a `Signed[Submission]`) and one file
`artefacts/<64 hex digits of its SHA-256>.onnx` for each artefact.
"""

from __future__ import annotations

import datetime
import operator
import re
import time
import unicodedata
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, SerializerFunctionWrapHandler, model_serializer

from leaderboard.documents.signed import PublicKey, Signable
from leaderboard.errors import Rejection
from sme_registry.spec import Suite
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

THE_BOARD, REFERENCE_FAMILY = "the board", "reference"
"""Submitter and family reserved for the board's own reference rows."""

# ASCII only: a similar letter of another script would let one method imitate another.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+()-]*(?: [A-Za-z0-9._+()-]+)*")
_LINK = re.compile(r"https://[A-Za-z0-9._~:/?#\[\]@!$&'()*+,;=%-]+")
_LOOK_ALIKE = str.maketrans(
    {"0": "o", "1": "l", "i": "l", "2": "z", "3": "e", "4": "a", "5": "s", "8": "b"}
)
_PAIRS_ALIKE = {"rn": "m", "vv": "w", "cl": "d"}  # cl after i and 1 have become l
# Control characters, format characters (some reverse the direction of text), surrogates,
# line separators and paragraph separators.
_UNSAFE_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp")

Track = Literal["open"]
Knowledge = Literal["generic", "family", "oracle"]

_Line = Annotated[str, Field(min_length=1, max_length=80)]
SafeName = Annotated[
    str,
    matching(
        rf"^(?:{_NAME.pattern})$",
        "a name: a letter or digit first, then also single spaces and '._+-()'",
        max_length=80,
    ),
]
"""The names that `check_names` allows."""

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


class Description(NamedTuple):
    """What an entrant says of a method, on every track; validated as part of a `Manifest`."""

    method: str
    submitter: str
    version: str = "1"
    family: str | None = None  # by default the method
    knowledge: str = "generic"
    code: str | None = None
    statement: str = ""

    def fields(self, key: str) -> dict[str, Any]:
        """Those of a manifest that a public key signs now."""
        kind = {"family": self.family or self.method, "knowledge": self.knowledge}
        return {
            "method": {"name": self.method, "version": self.version, **kind},
            "code": self.code,
            "submitter": {"name": self.submitter, "key": key},
            "created": now(),
            "statement": self.statement,
        }


def check_names(manifest: Manifest, board_key: str | None = None) -> None:
    """Reject what is unsafe to show (`unsafe_name`): markup, formulas, control characters.

    So are the board's own names, but for its key; None if the board is not known yet.
    """
    for field in ("method.name", "method.version", "method.family", "submitter.name"):
        name = operator.attrgetter(field)(manifest)
        if not _NAME.fullmatch(name):
            raise Rejection(
                "unsafe_name",
                f"{field}={name!a}: must begin with a letter or digit, and contain only "
                "letters a–z, digits, single spaces and '._+-()'. Rename it.",
            )
        reserved = {"submitter.name": THE_BOARD, "method.family": REFERENCE_FAMILY}.get(field, "")
        own = manifest.submitter.key == board_key
        if reserved and skeleton(name) == skeleton(reserved) and not own:
            raise Rejection(
                "unsafe_name",
                f"{field}={name!a}: reserved for the board's own reference rows. Rename it.",
            )
    if manifest.code is not None and not _LINK.fullmatch(manifest.code):
        raise Rejection(
            "unsafe_name",
            f"code={manifest.code!a}: must contain only the characters of a URL. "
            "Write others as %XX.",
        )
    for field in ("training.library", "training.hyperparameters", "training.hardware", "statement"):
        check_text(field, operator.attrgetter(field)(manifest))


def check_text(field: str, text: str) -> None:
    """Reject (`unsafe_name`) a text whose invisible characters could disguise other text."""
    for letter in text:
        if letter != "\n" and unicodedata.category(letter) in _UNSAFE_CATEGORIES:
            raise Rejection(
                "unsafe_name",
                f"{field}: contains {letter!a}: must contain no control characters except line "
                "breaks. Remove it.",
            )


def skeleton(name: str) -> str:
    """What is left of a name without the differences that readers overlook.

    Case, spaces and punctuation do not matter, and letters and digits that look alike are one
    letter, such as O and 0; l, I and 1; or m and rn. The result is for comparison only.
    """
    folded = unicodedata.normalize("NFKC", name).casefold()
    letters = "".join(letter for letter in folded if letter.isalnum())
    letters = letters.translate(_LOOK_ALIKE)
    for pair, letter in _PAIRS_ALIKE.items():
        letters = letters.replace(pair, letter)
    return letters


def check_runs(suite: Suite, submission: Submission, sources: Sequence[str] = ()) -> None:
    """Reject runs that are not on the suite's instances, listed twice, missing or not counted.

    That is `unknown_spec`, `duplicate_run`, `missing_run`, or `schema` if more runs were started
    than are allowed. `sources` are what to call each run, such as its folder; else `runs.0`, ….
    """
    class_of = {spec.digest: member.name for member in suite.classes for spec in member.instances}
    names = sources or [f"runs.{index}" for index in range(len(submission.runs))]
    for name, run in zip(names, submission.runs, strict=True):
        if run.spec not in class_of:
            raise Rejection(
                "unknown_spec",
                f"{name}: spec={run.spec}: must be the digest of one of the suite's "
                f"{len(class_of)} instances (`sme show {submission.suite.name}`). Train on those, "
                "or submit to a board of its suite.",
            )
    _check_duplicates(submission, names)
    ran = {run.spec for run in submission.runs}
    for digest, name in class_of.items():
        if digest not in ran:
            raise Rejection(
                "missing_run",
                f"runs: none on {digest} of class {name}: every instance must have one. "
                "Train on it, or list a failed run (policy null in runs.json), which scores 1.",
            )
    if all(run.artefact is None for run in submission.runs):
        raise Rejection(
            "missing_run", "runs: none has a policy: at least one must. Submit a trained policy."
        )
    listed = Counter(class_of[run.spec] for run in submission.runs)
    _check_started(submission, listed)


def _check_duplicates(submission: Submission, sources: Sequence[str]) -> None:
    first: dict[tuple[str, str, int | str], int] = {}
    for index, run in enumerate(submission.runs):
        policy = None if run.artefact is None else run.artefact.sha256
        for name, value in (("seed", run.seed), ("policy", policy)):
            before = index if value is None else first.setdefault((run.spec, name, value), index)
            if before != index:
                raise Rejection(
                    "duplicate_run",
                    f"{sources[index]}: {name}={value}: {sources[before]} has the same spec and "
                    f"{name}. Remove one of them.",
                )


def _check_started(submission: Submission, listed: Counter[str]) -> None:
    started = submission.runs_started
    for name in started:
        if name not in listed:
            raise Rejection(
                "missing_run",
                f"runs_started.{name}: must be a class of the suite: {', '.join(listed)}. "
                "Rename or remove it (option --started).",
            )
    for name, count in listed.items():
        if started.get(name, 0) < count:
            raise Rejection(
                "missing_run",
                f"runs_started.{name}={started.get(name)}: must be at least {count}, the number of "
                "listed runs. Count every run that was ever started with this method (option "
                "--started).",
            )
    if sum(started.values()) > MAX_RUNS:
        raise Rejection(
            "schema",
            f"runs_started={sum(started.values())}: must be at most {MAX_RUNS:,} in total. "
            "Count the runs of this version of the method only.",
        )

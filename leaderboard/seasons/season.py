"""`Season`: a competition on tasks that nobody but the organiser knows until it is revealed.

    commitment = SHA-256("sme-seal/1" ‖ master ‖ canonical JSON of the terms)

The master is a secret of 32 bytes, from which every hidden task follows. The commitment fixes it,
and with it the tasks, before anyone enters; `Reveal` publishes it at the end.

    secret of a purpose = HMAC-SHA256(master, canonical JSON of ["sme-seal/1", purpose, …])

The list holds public texts and numbers: the season's id, the class, the instance, and on the online
track the ticket and its entrant's nonce. Its canonical JSON is unambiguous, so no two purposes,
classes, instances or tickets share a secret. Whoever knows any number of these secrets learns
nothing of the master or of the others.

    sealed-offline   entrants learn from published data sets, and act in challenge states
    sealed-online    each ticket has hidden instances of its own, which the board's server steps

What entrants sign: an `Entry` names the answers, for each hidden instance one .npy file of float32
actions `[regions · n, A]` in the challenge states, in their order. A `TicketRequest` starts a
ticket; the transcript of each instance follows, signed by a key that the request names.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import hmac
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import rfc8785
from pydantic import Field, field_serializer, field_validator, model_validator

from leaderboard.documents.result import ClassScore, RunScore, Scores
from leaderboard.documents.signed import (
    PublicKey,
    Signable,
    plain_json,
    read_secret,
    write_secret,
)
from leaderboard.documents.submission import Artefact, Manifest, Method, SafeName, UtcTime
from leaderboard.errors import Rejection
from sme_registry.errors import ActionError, WireError
from sme_registry.io import sha256_of
from sme_registry.seasons.transcript import Count, Head, TicketHeads
from sme_registry.seasons.wire import MAX_INSTANCES, Hidden, HiddenClass, instances_of, unpack_table
from sme_registry.spec import EvaluationProtocol, Setting
from sme_registry.spec.document import (
    Digest,
    Document,
    Integer,
    Name,
    Real,
    SchemaVersion,
    StrictModel,
    matching,
)

LEAST_COMPLEXITY = 5
MAX_OFFLINE_INSTANCES = 400
"""Of a sealed-offline season: an entry lists an answer of each, in at most 64 KiB."""

PLANNED = "sha256:" + "0" * 64
"""The commitment of a season that is not generated yet."""

SealedTrack = Literal["sealed-offline", "sealed-online"]
Float32 = npt.NDArray[np.float32]


class SealedData(StrictModel):
    """The data set of each instance of a class, of a sealed-offline season.

    Attributes:
      nu: ν of the behaviour policy, a mixture of the optimum and a random network. With 0 the
        data set's actions would be the optimum.
      transitions: number of rows.
    """

    nu: Annotated[Real, Field(gt=0, le=1)]
    transitions: Annotated[Integer, Field(ge=1, le=10**7)]


class SeasonClass(HiddenClass):
    """One kind of task. Its setting is public, the seeds of its instances are not.

    Attributes:
      budget: steps that an entrant takes on each instance, over all lanes; null offline.
      data: the data set of each instance; null online.
    """

    budget: Annotated[Integer | None, Field(ge=1, le=10**8)] = None
    data: SealedData | None = None

    @field_validator("setting")
    @classmethod
    def _cannot_be_solved_by_hand(cls, setting: Setting) -> Setting:
        if setting.complexity < LEAST_COMPLEXITY:
            raise ValueError(
                f"complexity={setting.complexity}: must be at least {LEAST_COMPLEXITY} in a sealed "
                "season: three hundred random steps determine the optimum of a single layer "
                "without any learning. Use a deeper setting."
            )
        if setting.team is not None or not setting.is_plain:
            fields = ("team", "safety", "observation", "shaping", "noise")
            field = next(name for name in fields if getattr(setting, name) is not None)
            raise ValueError(
                f"{field}: must be null in a sealed season, whose scores are the normalised regret "
                "of one agent. Leave it out."
            )
        return setting


class Digests(StrictModel):
    """What is published of one instance of a sealed-offline season, by the digests of its arrays.

    Attributes:
      class_name, instance: the class, and the number of the instance in it, from 0.
      data: of the names, types, shapes and bytes of the arrays in the data set.
      challenge: SHA-256 of the challenge states' .npy file.
    """

    class_name: Name
    instance: Annotated[Integer, Field(ge=0)]
    data: Digest
    challenge: Digest


class Season(Document):
    """`season.json`.

    Attributes:
      id: the season's name, in paths and addresses.
      title: for its page.
      admission: who may take part: "open", or "listed", those keys that the organiser admits.
      opens, closes: entries count, and tickets start, from the first moment up to the second.
      protocol_name, protocol: the regions and numbers of the challenge states; its seed is 0, as
        the seed of each instance's states is secret.
      ticket_hours: time from the start of a ticket to its deadline, such as 0.5 for a rehearsal;
        null offline.
      tickets, tickets_per_key: the most tickets of the season, and of one key; null offline.
      published: of each instance in order; empty online.
      versions: of the organiser's packages, by which data sets are rounded.
      commitment: to the master and the other fields; see the head of this module.
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("admission",)

    schema_version: SchemaVersion = 1
    id: Name
    title: Annotated[str, Field(min_length=1, max_length=80)]
    track: SealedTrack
    classes: Annotated[tuple[SeasonClass, ...], Field(min_length=1, max_length=64, strict=False)]
    opens: UtcTime
    closes: UtcTime
    protocol_name: Name
    protocol: EvaluationProtocol
    ticket_hours: Annotated[Real | None, Field(ge=0.01, le=8760)] = None
    tickets: Annotated[Integer | None, Field(ge=1, le=100_000)] = None
    tickets_per_key: Annotated[Integer | None, Field(ge=1, le=1000)] = None
    published: Annotated[tuple[Digests, ...], Field(strict=False, max_length=MAX_INSTANCES)] = ()
    versions: Annotated[dict[str, str], Field(default_factory=dict, max_length=16)]
    admission: Literal["open", "listed"] = "open"
    commitment: Digest

    @model_validator(mode="after")
    def _classes_and_times_fit(self) -> Self:
        if self.opens >= self.closes:  # as text: the form is fixed
            raise ValueError(f"closes={self.closes}: must be after opens={self.opens}.")
        names = [member.name for member in self.classes]
        if len(set(names)) < len(names):
            raise ValueError(f"classes={names}: must have different names. Rename one.")
        count = self.count
        most = MAX_INSTANCES if self.track == "sealed-online" else MAX_OFFLINE_INSTANCES
        if count > most:
            raise ValueError(
                f"classes: have {count:,} instances: must be at most {most:,} together on the "
                f"track {self.track}. Use fewer."
            )
        return self

    @model_validator(mode="after")
    def _track_fits(self) -> Self:
        online = self.track == "sealed-online"
        own = ("ticket_hours", "tickets", "tickets_per_key")
        fields = [(name, getattr(self, name), online) for name in own]
        for member in self.classes:
            fields.append((f"classes.{member.name}.budget", member.budget, online))
            fields.append((f"classes.{member.name}.data", member.data, not online))
        for field, value, wanted in fields:
            if (value is not None) != wanted:
                must = "given" if wanted else "null"
                raise ValueError(f"{field}: must be {must} on the track {self.track}.")
        listed = [(each.class_name, each.instance) for each in self.published]
        hidden = [] if online else [(each.member.name, each.instance) for each in self.hidden]
        if listed != hidden and (listed or self.commitment != PLANNED):
            raise ValueError(
                "published: must list every instance in the order of the classes offline, and be "
                "empty online. Create the season with `sme-leaderboard season new`."
            )
        return self

    @field_validator("opens", "closes")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        try:
            datetime.datetime.fromisoformat(value)
        except ValueError as error:
            raise ValueError(f"{value}: is no date ({error}). Correct it.") from None
        return value

    @field_validator("protocol")
    @classmethod
    def _states_are_secret(cls, protocol: EvaluationProtocol) -> EvaluationProtocol:
        if protocol.seed:
            raise ValueError(
                f"seed={protocol.seed}: must be 0 in a season, which draws the challenge states of "
                "each instance from its secret. Leave it out."
            )
        return protocol

    @field_serializer("ticket_hours")
    def _as_in_earlier_files(self, hours: float | None) -> int | float | None:
        return int(hours) if hours is not None and hours.is_integer() else hours

    @property
    def count(self) -> int:
        """The number of hidden instances, of each ticket or of all entries."""
        return sum(member.instances for member in self.classes)

    @property
    def hidden(self) -> Iterator[Hidden[SeasonClass]]:
        """Every hidden instance, class by class."""
        return instances_of(self.classes)

    def commit(self, master: Master) -> Self:
        """This season, committed to a master."""
        terms = self.to_dict()
        del terms["commitment"]
        commitment = sha256_of(_SEAL.encode() + master.raw + rfc8785.dumps(terms))
        return self.model_copy(update={"commitment": commitment})

    def is_committed_to(self, master: Master) -> bool:
        """Whether the commitment is to this master and these terms."""
        return hmac.compare_digest(self.commitment, self.commit(master).commitment)


class Admitted(Document):
    """That the organiser admits a key to a season, under the name that the season shows."""

    schema_version: SchemaVersion = 1
    season: Digest
    key: PublicKey
    name: SafeName


class Reveal(Document):
    """`reveal.json`: the master of a season, published after its close."""

    schema_version: SchemaVersion = 1
    season: Digest
    master: Annotated[str, matching(r"^[0-9a-f]{64}$", "a master secret, 64 hex digits")]


class SealedManifest(Manifest):
    """What every entrant of a season signs.

    Attributes:
      season: digest of the season.
    """

    season: Digest

    @field_validator("method")
    @classmethod
    def _has_no_oracle(cls, method: Method) -> Method:
        if method.knowledge == "oracle":
            raise ValueError(
                "knowledge='oracle': must be 'generic' or 'family' in a sealed season, whose "
                "optimal policies nobody but the organiser knows. Correct it."
            )
        return method


class Entry(SealedManifest):
    """The signed content of an offline entry.

    Attributes:
      answers: of each hidden instance; null where the method failed, which scores 1 there.
    """

    PURPOSE, FIELD, COMMAND = "entry", "entry", "enter"

    answers: Annotated[
        tuple[Artefact | None, ...],
        Field(strict=False, min_length=1, max_length=MAX_OFFLINE_INSTANCES),
    ]


class TicketRequest(SealedManifest):
    """The signed content of a request for a ticket.

    Attributes:
      nonce: 64 hex digits that the entrant has drawn at random, for this ticket alone. The tasks
        depend on it, and on the ticket's number, which the board assigns later.
      answers_key: signs what follows; null in requests that are older than it.
      transcript: the version of the transcripts that it signs; null in requests that are older, of
        which it signs `Answers`.
    """

    PURPOSE, FIELD, COMMAND = "ticket", "ticket", "ticket"
    fields_added_later: ClassVar[tuple[str, ...]] = ("answers_key", "transcript")

    nonce: Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits, drawn at random")]
    answers_key: PublicKey | None = None
    transcript: Literal[1] | None = None


class InstanceHead(Signable, Head):
    """Signed, it is `tickets/<number>/<instance>.json`, for the last signature of a transcript."""

    PURPOSE, FIELD, COMMAND = "answers", "head", "answer"


class AllHeads(Signable, TicketHeads):
    """Signed, it is `tickets/<number>/end.json`."""

    PURPOSE, FIELD, COMMAND = "answers", "end", "answer"


class Answers(Signable):
    """What was signed of an instance, in place of its head, before there were transcripts."""

    PURPOSE, FIELD, COMMAND = "answers", "statement", "answer"

    request: Digest  # id of the request for the ticket
    ticket: Count
    instance: Count
    answers: Digest  # SHA-256 of the answers' .npy file
    journal: Digest  # SHA-256 of the bodies of all requests for steps, in order


def rows_of(protocol: EvaluationProtocol) -> int:
    """The number of challenge states of an instance: of each region as many."""
    return protocol.states_per_region * len(protocol.edges)


def read_answers(data: bytes, setting: Setting, protocol: EvaluationProtocol) -> Float32:
    """The answers in the bytes of a file: `[regions · n, A]`, finite, and not clipped yet."""
    try:
        return unpack_table(data, setting.action_dim, rows_of(protocol))
    except WireError as error:
        raise Rejection("answer_shape", str(error)) from None
    except ActionError as error:
        raise Rejection("answer_not_finite", str(error)) from None


class Stepping(Document):
    """The steps taken on one instance of a ticket, as the board's journal has them."""

    fields_added_later: ClassVar[tuple[str, ...]] = ("signed",)

    steps: Annotated[Integer, Field(ge=0)]
    # Σ regret / Σ regret of the constant ½ in the same states, over the budget, and over each of at
    # most 100 equal parts of it. Steps that were not taken count like the constant's.
    normalised_online_regret: Annotated[Real, Field(ge=0)]
    learning_curve: Annotated[tuple[Real, ...], Field(strict=False, min_length=1, max_length=100)]
    signed: Digest | None = None  # of the file in which the entrant signed answers and journal


class SealedResult(Document):
    """The outcome of a sealed entry or ticket, by the id of the entry or of the request.

    Its runs are one on each hidden instance, in the season's order. Their `spec` is null, as is
    `evaluation_seed`: until the reveal, neither is public. `artefact` is the digest of the answers;
    null where there are none, and the run scores 1. Online, `stepping` has as many entries.
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("signed",)

    schema_version: SchemaVersion = 1
    season: Digest
    subject: Digest
    scores: Scores
    classes: Annotated[tuple[ClassScore, ...], Field(strict=False, min_length=1)]
    runs: Annotated[tuple[RunScore, ...], Field(strict=False, min_length=1)]
    stepping: Annotated[tuple[Stepping, ...], Field(strict=False)] = ()
    oracle_like: bool = False
    versions: dict[str, str] = Field(default_factory=dict)
    signed: Digest | None = None  # of the file with the signature that ended a ticket


_SEAL, _BYTES = "sme-seal/1", 32
Purpose = Literal["task", "states", "data", "starts", "token"]
"""An instance's seed, challenge states, data set and episode starts; the password of a ticket."""


class Place(NamedTuple):
    """Where a secret belongs: in a season, by its id; a ticket and its nonce, online."""

    season: str
    class_name: str
    instance: int
    ticket: str = ""
    nonce: str = ""


@dataclasses.dataclass(frozen=True)
class Master:
    """The 32 secret bytes of a season; `repr` never shows them."""

    raw: bytes = dataclasses.field(repr=False)

    @classmethod
    def generate(cls) -> Master:
        """A new master from the operating system's randomness."""
        return cls(secrets.token_bytes(_BYTES))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Master:
        """Read a master from a file."""
        remedy = (
            "`sme-leaderboard season new` creates one; without it nobody can reveal the season."
        )
        return cls(read_secret(path, "master secret", remedy))

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the master into a new file that only its owner can read."""
        return write_secret(path, self.raw)

    def secret(self, purpose: Purpose, place: Place) -> bytes:
        """The 32 bytes for a purpose in a place."""
        message = plain_json([_SEAL, purpose, *place])
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

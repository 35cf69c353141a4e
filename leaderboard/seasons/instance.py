"""`Instance`: one hidden instance of a ticket, from its first step to its answers.

    waiting ── start ──▶ stepping ── finish, or no step fits the budget ──▶ answering ──▶ answered

In the ticket's folder, `<number>.journal` has the actions, `<number>.json` the head of the
transcript that the entrant has signed last, `<number>.challenge` the challenge states,
`<number>.npy` the answers, and `<number>.npz` a snapshot of its `Play`, of when the entrant signed
or the instance left memory: the journal is read from there on. Each method may be called again
after a lost answer, without a further effect.
"""

from __future__ import annotations

import contextlib
import io as streams
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from leaderboard.documents.signed import Signable, Signed, verifies
from leaderboard.errors import Rejection, TamperedError
from leaderboard.seasons.journal import Journal, Play, no_steps
from leaderboard.seasons.scoring import Answered
from leaderboard.seasons.season import (
    Answers,
    InstanceHead,
    SeasonClass,
    Stepping,
    TicketRequest,
    read_answers,
    rows_of,
)
from sme_registry import io
from sme_registry.errors import ActionError, SMEError, WireError
from sme_registry.io import read_regular
from sme_registry.seasons.transcript import EVERY, Chain, answers_head, challenge_head
from sme_registry.seasons.wire import MAX_LANES, InstanceStatus, table_bytes
from sme_registry.spec.document import Document

if TYPE_CHECKING:
    from leaderboard.seasons.tickets import Ticket

SignedHead = Signed[InstanceHead]
_Kind = TypeVar("_Kind", bound=Signable)
Phase = Literal["waiting", "stepping", "answering", "answered"]
_MAX_SIGNED, _MAX_SNAPSHOT = 2**20, 2**24  # an end names a thousand heads
_QUICK_PRODUCTS = 2**23
"""Of weights and lanes, in steps short enough for the event loop: a few milliseconds."""


class SignedFile(Generic[_Kind]):
    """The file of a ticket in which its entrant has signed a document."""

    def __init__(
        self, path: Path, kind: type[Signed[_Kind]], request: Signed[TicketRequest]
    ) -> None:
        self.path, self._kind, self._request = path, kind, request

    @property
    def digest(self) -> str | None:
        """Of the file; None where there is none."""
        return io.sha256_of(read_regular(self.path, _MAX_SIGNED)) if self.path.exists() else None

    def read(self) -> Signed[_Kind] | None:
        """What it has; None where there is nothing to read."""
        try:
            data = read_regular(self.path, _MAX_SIGNED)
            return self._kind.from_dict(io.parse_json(data, self.path.name))
        except (OSError, SMEError):
            return None

    def is_of(self, document: Document) -> bool:
        """Whether the entrant has signed this document in it."""
        signed = self.read()
        return (
            signed is not None
            and signed.id == document.digest
            and self._verifies(document, signed.signature)
        )

    def with_signature(self, document: _Kind, signature: str, what: str) -> bytes:
        """Its bytes once a document is signed; a `Rejection` unless the entrant has signed it."""
        if not self._verifies(document, signature):
            raise Rejection(
                "bad_signature",
                f"signature={signature[:16]!a}: must be of {what}, by the key that the request for "
                "the ticket names. Use the ticket's file, and the transcripts beside it.",
            )
        receiver = self._request.receiver._asdict()
        return self._kind(content=document, signature=signature, **receiver).to_bytes()

    def tampered(self, what: str) -> TamperedError:
        where = "/".join(self.path.parts[-5:])
        return TamperedError(where, f"is not the entrant's signature of {what}")

    def _verifies(self, document: Document, signature: str) -> bool:
        key, receiver = self._request.content.answers_key, self._request.receiver
        return key is not None and verifies(key, signature, "answers", document.digest, receiver)


class Instance:
    """One hidden instance of a ticket, for any number of threads.

    What the disk does not take raises OSError, and has changed nothing.
    """

    def __init__(self, ticket: Ticket, number: int, member: SeasonClass) -> None:
        self._ticket, self._number, self._setting = ticket, number, member.setting
        self._chain = Chain(request=ticket.id, ticket=ticket.number, instance=number)
        self._is_old = ticket.request.content.transcript is None
        assert member.budget is not None  # the track is online
        self.budget = member.budget
        name = ticket.folder / str(number)
        self._journal_path = name.with_suffix(".journal")
        self._answers_path = name.with_suffix(".npy")
        self._signature = SignedFile(name.with_suffix(".json"), SignedHead, ticket.request)
        self._snapshot_path = name.with_suffix(".npz")
        self._challenge_path = name.with_suffix(".challenge")
        self._lock = threading.RLock()
        self._journal: Journal | None = None
        self._play: Play | None = None

    @property
    def status(self) -> InstanceStatus:
        """What the entrant may know."""
        with self._lock:
            journal = self.journal
            if journal is None:
                return InstanceStatus(phase="waiting", lanes=None, requests=0, used=0)
            is_over = journal.ended or self._is_spent(journal)
            return InstanceStatus(
                phase="answered" if self.answered else "answering" if is_over else "stepping",
                lanes=journal.lanes,
                requests=journal.requests,
                used=journal.steps,
            )

    def _is_spent(self, journal: Journal) -> bool:
        return journal.steps + journal.lanes > self.budget

    @property
    def journal(self) -> Journal | None:
        with self._lock:
            if self._journal is None and self._journal_path.exists():
                snapshot = self._snapshot()
                known = 0 if snapshot is None else int(snapshot["requests"])
                with storage():
                    self._journal = self._open_journal(None if self._ticket.is_scored else known)
            return self._journal

    def _open_journal(self, known: int | None = 0) -> Journal:
        return Journal.open(self._journal_path, self._setting.action_dim, known)

    @property
    def answered(self) -> bool:
        """Whether its answers are stored, with the entrant's signature where that is required."""
        with self._lock:
            if self._is_old or not self._answers_path.exists():
                return self._answers_path.exists()
            signed, journal = self.signed, self.journal
            return bool(signed and journal and signed.content.hashes == journal.requests + 2)

    @property
    def signed(self) -> SignedHead | None:
        """What the entrant has signed last; None where there is nothing to read."""
        return self._signature.read()

    @property
    def answers(self) -> Answered:
        """The answers `[regions · n, A]` and the digest of their file."""
        if not self.answered:
            return None, None
        data = read_regular(self._answers_path, self.answer_bytes)
        return read_answers(data, self._setting, self._ticket.season.protocol), io.sha256_of(data)

    @property
    def answer_bytes(self) -> int:
        return table_bytes(rows_of(self._ticket.season.protocol), self._setting.action_dim)

    @property
    def weights(self) -> int:
        """The number of weights of the task's network, without biases."""
        setting = self._setting
        S, A, H = setting.state_dim, setting.action_dim, setting.hidden_width
        return H * (S + (setting.complexity - 2) * H + A)

    @property
    def is_ready(self) -> bool:
        """Whether the next step is small, waits for no disk, and has no other request before it."""
        play, journal = self._play, self._journal
        if play is None or journal is None or journal.lanes * self.weights > _QUICK_PRODUCTS:
            return False
        if _is_due(play) or not self._lock.acquire(blocking=False):
            return False
        self._lock.release()
        return True

    def start(self, lanes: int) -> bytes:
        """Begin, or go on after a lost connection; the present observations."""
        with self._lock:
            self._ticket.check_running()
            journal = self.journal
            if journal is None:
                most = min(MAX_LANES, self.budget)
                if not 1 <= lanes <= most:
                    raise Rejection(
                        "lanes_invalid", f"lanes={lanes}: must be in [1, {most}]. Correct it."
                    )
                journal = Journal.create(self._journal_path, lanes, self._setting.action_dim)
                self._journal = journal
            if lanes != journal.lanes:
                message = f"lanes={lanes}: the instance was started with {journal.lanes}."
                raise Rejection("start_conflict", f"{message} Go on with these.")
            return self._playing().started

    def step(self, body: bytes, signature: str = "") -> bytes:
        """Take the steps of a request, signed where due, or answer the last one again."""
        with self._lock:
            self._ticket.check_running()
            play = self._playing()
            try:
                number = play.unpack(body)
            except (WireError, ActionError) as error:
                raise Rejection("step_invalid", str(error)) from None
            if number == play.requests and body == play.last[0]:
                return play.last[1]
            journal = self._started()
            self._check_next(journal, number)
            if _is_due(play):
                self._sign(play, signature)
            journal.append(body[8:])
            # Whatever raises between here and the end, such as a lack of memory: the step is taken.
            self._play = None
            answer = play.take(body)
            self._play = play
            return answer

    def finish(self, signature: str) -> None:
        with self._lock:
            self._ticket.check_running()
            journal = self._started()
            if not journal.ended:
                self._sign(self._playing(), signature)
                journal.end()
            self.release()

    def challenge(self) -> bytes:
        with self._lock:
            if not self._started().ended:
                raise _wrong_phase(self.status.phase, "Finish it before the challenge.")
            if not self._challenge_path.exists():
                write_whole(self._challenge_path, self._ticket.hidden(self._number).challenge)
            return read_regular(self._challenge_path, 2**28)

    def answer(self, data: bytes, signature: str) -> bool:
        """Store the answers to the challenge, an .npy file; False if the same ones are stored."""
        with self._lock:
            if self.answered and read_regular(self._answers_path, len(data) + 1) == data:
                io.sync_folder(self._answers_path.parent)  # which may have failed the first time
                return False
            self._ticket.check_running()
            states = self.challenge()
            read_answers(data, self._setting, self._ticket.season.protocol)
            if self.answered:
                raise Rejection(
                    "answer_conflict",
                    "answers: others were stored for this instance, and count. Go on with the "
                    "next instance.",
                )
            play = self._playing()
            head = answers_head(challenge_head(play.head, states), data)
            signed = self._signed(play.requests + 2, head, signature)
            write_whole(self._answers_path, data)
            write_whole(self._signature.path, signed)
            io.sync_folder(self._answers_path.parent)
            self.release()
            return True

    @property
    def final_head(self) -> str | None:
        signed = self.signed
        return signed.content.head if signed is not None and self.answered else None

    def stepping(self) -> Stepping:
        """The regret of the steps that the entrant has signed, which are taken again."""
        signed, is_stated = self.signed, self.answered or not self._is_old
        digest = self._signature.digest if is_stated else None
        if not self._journal_path.exists():
            return no_steps(self.budget)
        journal = self._open_journal()
        play = self._new_play(journal.lanes)
        last = journal.requests
        if not self._is_old:
            last = 0 if signed is None else min(last, signed.content.hashes)
        for body in journal.bodies(0, last):
            play.take(body)
        self._check_signed(journal, play, signed)
        return play.stepping.model_copy(update={"signed": digest})

    def _check_signed(self, journal: Journal, play: Play, signed: SignedHead | None) -> None:
        """Raise TamperedError unless the entrant has signed the transcript and the answers."""
        answers = read_regular(self._answers_path, self.answer_bytes) if self.answered else b""
        if self._is_old:
            is_right = not answers or self._has_stated(journal, answers)
        elif signed is None:
            is_right = not self._signature.path.exists()
        else:
            head, number = play.head, signed.content.hashes
            if number > journal.requests:
                head = answers_head(
                    challenge_head(head, self._ticket.hidden(self._number).challenge), answers
                )
            is_right = self._signature.is_of(self._chain.at(number, head))
        if not is_right:
            raise self._signature.tampered("this transcript")

    def _has_stated(self, journal: Journal, answers: bytes) -> bool:
        """Whether the entrant has signed answers and journal, before there were transcripts."""
        if self._ticket.request.content.answers_key is None:
            return True
        digests = io.sha256_of(answers), io.sha256_of(b"".join(journal.bodies()))
        statement = Answers(**dict(self._chain), answers=digests[0], journal=digests[1])
        file = SignedFile(self._signature.path, Signed[Answers], self._ticket.request)
        return file.is_of(statement)

    def sync(self) -> None:
        """Make the steps taken survive a loss of power; raises OSError if the disk fails."""
        journal = self._journal
        if journal is not None:
            journal.sync()

    def forget(self) -> None:
        with contextlib.suppress(OSError):
            self._snapshot_path.unlink(missing_ok=True)

    def release(self) -> None:
        """Free memory, after the request in progress; the next steps go on from the snapshot."""
        with self._lock:
            with contextlib.suppress(OSError):  # the steps survive all but a loss of power
                self.sync()
                if self._play is not None:
                    write_whole(self._snapshot_path, self._play.snapshot())
            self._play = None

    def _new_play(self, lanes: int) -> Play:
        hidden = self._ticket.hidden(self._number)
        return Play(hidden.spec, hidden.starts, self._chain, lanes, self.budget)

    def _playing(self) -> Play:
        if self._play is None:
            journal, snapshot = self._started(), self._snapshot()
            play = self._new_play(journal.lanes)
            if snapshot is not None and snapshot["requests"] <= journal.requests:
                play.restore(snapshot)
            for body in journal.bodies(play.requests):
                play.take(body)
            self._play = play
        return self._play

    def _snapshot(self) -> dict[str, npt.NDArray[Any]] | None:
        """The last one; None where there is none to read."""
        try:
            data = read_regular(self._snapshot_path, _MAX_SNAPSHOT)
            with np.load(streams.BytesIO(data), allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, EOFError, ValueError, zipfile.BadZipFile):
            return None

    def _sign(self, play: Play, signature: str) -> None:
        """Store the entrant's signature of all steps so far."""
        signed = self._signed(play.requests, play.head, signature)
        self.sync()
        write_whole(self._signature.path, signed)
        write_whole(self._snapshot_path, play.snapshot())

    def _signed(self, number: int, head: bytes, signature: str) -> bytes:
        """The file with the entrant's signature of so many requests, whose hash is the head."""
        document = InstanceHead(**dict(self._chain.at(number, head)))
        what = f"the transcript after {number} requests, whose hash is {document.head[:19]}… here"
        return self._signature.with_signature(document, signature, what)

    def _started(self) -> Journal:
        """The journal, or a rejection before the start."""
        journal = self.journal
        if journal is None:
            raise _wrong_phase("waiting", "Start it first.")
        return journal

    def _check_next(self, journal: Journal, number: int) -> None:
        """Refuse steps that are not the next ones, or not in the budget."""
        following = journal.requests + 1
        if number < following:
            raise Rejection(
                "step_conflict",
                f"number={number}: these steps were taken with other actions, or long ago. The "
                f"next number is {following}.",
            )
        if number > following:
            raise Rejection(
                "step_ahead",
                f"number={number}: must be {following}, the next one. Send that first.",
            )
        if journal.ended:
            raise _wrong_phase(self.status.phase, "No more steps can be taken.")
        if self._is_spent(journal):
            raise Rejection(
                "budget_spent",
                f"steps: {journal.steps} of {self.budget} are taken, and {journal.lanes} more do "
                "not fit. Answer the challenge.",
            )


def _is_due(play: Play) -> bool:
    """Whether the entrant signs the transcript with its next request."""
    return play.requests > 0 and play.requests % EVERY == 0


def _wrong_phase(phase: Phase, advice: str) -> Rejection:
    return Rejection("instance_phase", f"instance: is {phase}. {advice}")


def write_whole(path: Path, data: bytes) -> None:
    with io.atomic_file(path) as stream:
        stream.write(data)


@contextlib.contextmanager
def storage() -> Iterator[None]:
    """Reject what the disk does not take."""
    try:
        yield
    except OSError as error:
        raise Rejection(
            "storage_full",
            f"storage: {error.strerror}. Nothing was changed. Send it again later, and tell the "
            "board's owner.",
        ) from None

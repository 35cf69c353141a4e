"""`SteppedInstance`: one hidden instance of a ticket, from its first step to its answers.

    waiting ── start ──▶ stepping ── finish, or no step fits the budget ──▶ answering ──▶ answered

Its files are `<number>.journal`, `<number>.npy` with the answers, and `<number>.json` with the
entrant's signature of both, in the ticket's folder. Its state follows from them. Each method may be
called again after a lost answer, without a further effect.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

from leaderboard.documents.signed import Signed
from leaderboard.errors import Rejection, TamperedError
from leaderboard.seasons.entry import Answers
from leaderboard.seasons.journal import Journal
from leaderboard.seasons.season import MAX_LANES, Float32, SeasonClass, read_answers, rows_of
from leaderboard.seasons.signatory import Signatory
from leaderboard.seasons.stepping import Lanes, Start
from sme_registry import EvaluationProtocol, io
from sme_registry.errors import ActionError, SMEError, WireError
from sme_registry.io import read_regular
from sme_registry.seasons.wire import InstanceStatus, StepFormat, table_bytes

Phase = Literal["waiting", "stepping", "answering", "answered"]
_MAX_SIGNED = 4096
_QUICK_PRODUCTS = 2**23
"""Of weights and lanes, in steps short enough for the event loop: a few milliseconds."""


class SteppedInstance:
    """One hidden instance, for any number of threads.

    Args:
      folder: the ticket's.
      number: of the instance in the ticket, from 0.
      member: its class.
      protocol: the season's.
      start: derives what is hidden; called when it is needed.
      signatory: signs the answers; None in tickets that are older than signed answers.

    Attributes:
      budget: steps over all lanes.
    """

    def __init__(
        self,
        folder: Path,
        number: int,
        member: SeasonClass,
        protocol: EvaluationProtocol,
        start: Callable[[], Start],
        signatory: Signatory | None = None,
    ) -> None:
        self._number, self._signatory = number, signatory
        self._journal_path = folder / f"{number}.journal"
        self._answers_path = folder / f"{number}.npy"
        self._signed_path = folder / f"{number}.json"
        self._member = member
        assert member.budget is not None  # the track is online
        self.budget = member.budget
        self._protocol = protocol
        self._start = start
        self._lock = threading.RLock()
        self._journal: Journal | None = None
        self._journal_digest = ""  # once no more steps can be taken
        self._lanes: Lanes | None = None
        self._format: StepFormat | None = None
        self._last = b"", b""  # actions and answer of the last request
        self._answered, self._closed = self._answers_path.exists(), False

    @property
    def phase(self) -> Phase:
        """How far the entrant is."""
        with self._lock:
            journal = self._opened()
            if self._answered:
                return "answered"
            if journal is None:
                return "waiting"
            spent = journal.steps + journal.lanes > self.budget
            return "answering" if journal.ended or spent else "stepping"

    @property
    def status(self) -> InstanceStatus:
        """What the entrant may know."""
        with self._lock:
            journal = self._opened()
            return InstanceStatus(
                phase=self.phase,
                lanes=None if journal is None else journal.lanes,
                requests=0 if journal is None else journal.requests,
                used=0 if journal is None else journal.steps,
            )

    @property
    def is_played(self) -> bool:
        """Whether it has steps, answers, or a journal that is none."""
        with self._lock:
            try:
                journal = self._opened()
            except TamperedError:
                return True
            return self._answered or (journal is not None and journal.requests > 0)

    @property
    def lanes(self) -> int:
        """L; 0 before the start."""
        journal = self._opened()
        return 0 if journal is None else journal.lanes

    @property
    def journal(self) -> Journal | None:
        """The steps; None before the start."""
        with self._lock:
            return self._opened()

    @property
    def stored_answers(self) -> tuple[Float32, str] | tuple[None, None]:
        """The answers `[regions · n, A]` and the digest of their file; nothing without any.

        Raises:
          Rejection: `answer_shape` if the file was altered, `storage_full` if it cannot be read.
        """
        if not self._answered:
            return None, None
        with _storage():
            data = read_regular(self._answers_path, self.answer_bytes)
        return read_answers(data, self._member.setting, self._protocol), io.sha256_of(data)

    @property
    def signed_digest(self) -> str | None:
        """The digest of the file with the entrant's signature; None where there is none to read."""
        with contextlib.suppress(OSError):
            if self._answered and self._signatory is not None:
                return io.sha256_of(read_regular(self._signed_path, _MAX_SIGNED))
        return None

    @property
    def is_signed(self) -> bool:
        """Whether the entrant has signed these answers and this journal, where that is required.

        Raises:
          Rejection, TamperedError: a file cannot be read.
        """
        if not self._answered or self._signatory is None:
            return True
        _, answers = self.stored_answers
        try:
            data = read_regular(self._signed_path, _MAX_SIGNED)
            stored = Signed[Answers].from_dict(io.parse_json(data, "signature"))
            return stored == self._signed(str(answers), stored.signature)
        except (OSError, SMEError):
            return False

    @property
    def answer_bytes(self) -> int:
        """The most bytes of the answers' file."""
        return table_bytes(rows_of(self._protocol), self._member.setting.action_dim)

    @property
    def answered(self) -> bool:
        """Whether its answers are stored."""
        return self._answered

    @property
    def weights(self) -> int:
        """The number of weights of the task's network, without biases."""
        setting = self._member.setting
        S, A, H = setting.state_dim, setting.action_dim, setting.hidden_width
        return H * (S + (setting.complexity - 2) * H + A)

    @property
    def is_ready(self) -> bool:
        """Whether the next step is small, needs no replay, and has no other request before it."""
        if self._lanes is None or self.lanes * self.weights > _QUICK_PRODUCTS:
            return False
        if not self._lock.acquire(blocking=False):
            return False
        self._lock.release()
        return True

    def start(self, lanes: int) -> bytes:
        """Begin, or go on after a lost connection; the present observations.

        Raises:
          Rejection: `start_conflict`, `lanes_invalid`, `instance_phase` or `storage_full`.
        """
        with self._lock:
            self._refuse_closed()
            journal = self._opened()
            if journal is None:
                most = min(MAX_LANES, self.budget)
                if not 1 <= lanes <= most:
                    raise Rejection(
                        "lanes_invalid", f"lanes={lanes}: must be in [1, {most}]. Correct it."
                    )
                journal = self._create(lanes)
            if lanes != journal.lanes:
                raise Rejection(
                    "start_conflict",
                    f"lanes={lanes}: the instance was started with {journal.lanes}. Go on with "
                    "these.",
                )
            self._refuse_answered()
            observation = self._present(journal).observation
            assert self._format is not None  # with the lanes
            return self._format.pack(journal.requests, observation)

    def step(self, body: bytes) -> bytes:
        """Take the steps of a request, or answer the last one again.

        Raises:
          Rejection: `instance_phase`, `step_invalid`, `step_conflict`, `step_ahead`,
            `budget_spent` or `storage_full`. No step was taken.
        """
        with self._lock:
            self._refuse_closed()
            journal = self._started()
            self._refuse_answered()
            lanes = self._present(journal)
            assert self._format is not None  # with the lanes
            try:
                number, actions = self._format.unpack_request(body)
            except (WireError, ActionError) as error:
                raise Rejection("step_invalid", str(error)) from None
            raw = body[-actions.nbytes :]
            if number == journal.requests and raw == self._last[0]:
                return self._last[1]
            self._refuse_step(journal, number)
            with _storage():
                journal.append(raw)
            # Whatever raises between here and the end, such as a lack of memory: the step is taken.
            self._lanes, form = None, self._format
            self._last = raw, form.pack_steps(lanes.step(actions))
            self._lanes = lanes
            return self._last[1]

    def finish(self) -> None:
        """Take no more steps.

        Raises:
          Rejection: `ticket_ended` or `storage_full`.
        """
        with self._lock:
            self._refuse_closed()
            journal = self._opened() or self._create(1)
            if self.phase == "stepping":
                with _storage():
                    journal.end()

    def refuse_challenge(self) -> None:
        """Raise `Rejection` (`instance_phase`) as long as steps may follow."""
        phase = self.phase
        if phase in ("waiting", "stepping"):
            raise _wrong_phase(phase, "Take all steps, or finish it, before the challenge.")

    def journal_digest(self) -> str:
        """`Journal.digest` of the steps.

        Raises:
          Rejection: `instance_phase` as long as steps may follow, or `storage_full`.
        """
        self.refuse_challenge()
        with self._lock:
            if not self._journal_digest:
                with _storage():
                    self._journal_digest = self._started().digest()
            return self._journal_digest

    def has_stored(self, data: bytes) -> bool:
        """Whether these are its answers, which a client sends again if the reply was lost.

        Raises:
          Rejection: `storage_full` if they are, and might not survive a loss of power.
        """
        with _storage():
            if not self._answered or read_regular(self._answers_path, len(data) + 1) != data:
                return False
            io.sync_folder(self._answers_path.parent)  # which may have failed the first time
        return True

    def answer(self, data: bytes, signature: str) -> bool:
        """Store the answers to the challenge.

        Args:
          data: an .npy file of float32 actions `[rows, A]`, one for each challenge state.
          signature: of the `Statement` of them and the journal.

        Returns:
          False if the same ones are stored.

        Raises:
          Rejection: `instance_phase`, `answer_shape`, `answer_not_finite`, `answer_conflict`,
            `bad_signature` or `storage_full`.
        """
        with self._lock:
            self._refuse_closed()
            self.refuse_challenge()
            read_answers(data, self._member.setting, self._protocol)
            if self.has_stored(data):
                return False
            if self._answered:
                raise Rejection(
                    "answer_conflict",
                    "answers: others were stored for this instance, and count. Go on with the "
                    "next instance.",
                )
            if self._signatory is not None:
                signed = self._signed(io.sha256_of(data), signature)
                with _storage(), io.atomic_file(self._signed_path) as stream:
                    stream.write(io.to_json(signed.to_dict()).encode())
            try:  # the answers come last: with them, the instance is answered
                with _storage(), io.atomic_file(self._answers_path, new=True) as stream:
                    stream.write(data)
                with _storage():
                    io.sync_folder(self._answers_path.parent)
            finally:  # the file may be there even if the folder could not be synced
                self._answered = self._answers_path.exists()
            self.release()
            return True

    def sync(self) -> None:
        """Make the steps taken survive a loss of power; raises OSError if the disk fails."""
        journal = self._journal
        if journal is not None:
            journal.sync()

    def close(self) -> None:
        """Refuse all further requests, after those in progress."""
        with self._lock:
            self._closed = True
            self.release()

    def release(self) -> None:
        """Free memory; the next steps replay the journal."""
        with self._lock:
            with contextlib.suppress(OSError):  # the steps survive all but a loss of power
                self.sync()
            self._lanes = self._format = None

    def _signed(self, answers: str, signature: str) -> Signed[Answers]:
        assert self._signatory is not None
        return self._signatory.signed(self._number, answers, self.journal_digest(), signature)

    def _opened(self) -> Journal | None:
        """The journal; None before the start."""
        if self._journal is None and self._journal_path.exists():
            with _storage():
                self._journal = Journal.open(self._journal_path)
        return self._journal

    def _create(self, lanes: int) -> Journal:
        with _storage():
            A = self._member.setting.action_dim
            self._journal = Journal.create(self._journal_path, lanes, A)
        return self._journal

    def _started(self) -> Journal:
        """The journal, or a rejection before the start."""
        journal = self._opened()
        if journal is None:
            raise _wrong_phase("waiting", "Start it first.")
        return journal

    def _present(self, journal: Journal) -> Lanes:
        """The lanes after the journal's steps, which are replayed where they are not in memory."""
        if self._lanes is None:
            setting = self._member.setting
            lanes = Lanes(self._start(), journal.lanes)
            wire = StepFormat(journal.lanes, setting.state_dim, setting.action_dim)
            for actions in journal.actions():
                steps = lanes.step(actions)
            if journal.requests:
                self._last = actions.tobytes(), wire.pack_steps(steps)
            self._lanes, self._format = lanes, wire
        return self._lanes

    def _refuse_step(self, journal: Journal, number: int) -> None:
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
            raise _wrong_phase(self.phase, "No more steps can be taken.")
        if journal.steps + journal.lanes > self.budget:
            raise Rejection(
                "budget_spent",
                f"steps: {journal.steps} of {self.budget} are taken, and {journal.lanes} more do "
                "not fit. Answer the challenge.",
            )

    def _refuse_closed(self) -> None:
        if self._closed:
            raise Rejection("ticket_ended", "ticket: has ended. What it had counts.")

    def _refuse_answered(self) -> None:
        if self._answered:
            raise _wrong_phase("answered", "Go on with the next instance.")


def _wrong_phase(phase: Phase, advice: str) -> Rejection:
    return Rejection("instance_phase", f"instance: is {phase}. {advice}")


@contextlib.contextmanager
def _storage() -> Iterator[None]:
    """Reject what the disk does not take."""
    try:
        yield
    except OSError as error:
        raise Rejection(
            "storage_full",
            f"storage: {error.strerror}. Nothing was changed. Send it again later, and tell the "
            "board's owner.",
        ) from None

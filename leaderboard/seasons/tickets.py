"""`Ticket`: hidden tasks for one entrant, stepped by the board; `Sessions`: those of a season.

The answer to a request for a ticket has the ticket's password, and a board keeps requests where
others may read them. So a request is sent with a header `Authorization` as for an upload, whose
signature is at most ten minutes old, and nobody else can repeat it.
"""

from __future__ import annotations

import contextlib
import datetime
import hmac
import logging
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from leaderboard.admission import check_entrant, check_manifest, uploader
from leaderboard.documents.board import check_receiver
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import shifted, utc
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.worker import beside
from leaderboard.seasons.instance import Instance, SignedFile, storage, write_whole
from leaderboard.seasons.journal import played_bytes
from leaderboard.seasons.scoring import HiddenTask, score_runs, sealed_result
from leaderboard.seasons.season import (
    AllHeads,
    Master,
    Place,
    SealedResult,
    Season,
    TicketRequest,
)
from leaderboard.seasons.store import SealedRow, SeasonStore
from leaderboard.store import Store
from sme_registry import seasons
from sme_registry.io import file_lock
from sme_registry.seasons.wire import MAX_LANES, StepFormat, TicketStatus

_T = TypeVar("_T")


def deadline(season: Season, row: SealedRow) -> str:
    """When a ticket of an online season ends at the latest."""
    assert season.ticket_hours is not None  # the track is online
    started = datetime.datetime.fromisoformat(row.received)
    return utc(shifted(started, datetime.timedelta(hours=season.ticket_hours)))


class Ticket:
    """One ticket: it runs until the entrant ends it, or its deadline has passed."""

    def __init__(self, store: SeasonStore, season: Season, master: Master, row: SealedRow) -> None:
        self.number, self.id = row.number, row.id
        self._store, self.season, self._master = store, season, master
        self.request = store.request_of(row)
        place = Place(season.id, "", 0, str(row.number), self.request.content.nonce)
        self.token = master.secret("token", place).hex()
        self.deadline = deadline(season, row)
        self.is_scored = self._closed = row.result is not None
        self.folder = store.ticket_folder(row.track, row.number)
        self.signed_end = SignedFile(self.folder / "end.json", Signed[AllHeads], self.request)
        self._hidden = tuple(season.hidden)
        self.instances = tuple(
            Instance(self, number, hidden.member) for number, hidden in enumerate(self._hidden)
        )

    @property
    def document(self) -> seasons.Ticket:
        return seasons.Ticket.from_dict(
            {
                "season": self.season.id,
                "ticket": self.number,
                "token": self.token,
                "deadline": self.deadline,
                "lanes": MAX_LANES,
                "classes": [member.model_dump(exclude={"data"}) for member in self.season.classes],
            }
        )

    def is_over(self, now: str) -> bool:
        """Whether nothing can change any more, at a time of the board."""
        return self._closed or now >= self.deadline or self.signed_end.path.exists()

    def check_running(self) -> None:
        """Raise `Rejection` (`ticket_ended`) if the ticket is over, or older than transcripts."""
        is_over = self._closed or self._store.clock.received() >= self.deadline
        if is_over or self.request.content.transcript is None:
            raise Rejection(
                "ticket_ended",
                f"ticket={self.number}: has ended, at the latest at {self.deadline}. What it "
                "had counts.",
            )

    def end(self, signature: str) -> None:
        """End the ticket, all of which is answered, with a signature of all transcripts."""
        what = "the transcripts of all instances"
        data = self.signed_end.with_signature(self._heads, signature, what)
        if not self.signed_end.path.exists():
            self.check_running()
            with storage():
                write_whole(self.signed_end.path, data)

    @property
    def _heads(self) -> AllHeads:
        heads = tuple(filter(None, (each.final_head for each in self.instances)))
        if len(heads) < len(self.instances):
            raise Rejection(
                "instance_phase",
                f"instances: {len(heads)} of {len(self.instances)} have answers. Answer all of "
                "them before the ticket's end.",
            )
        return AllHeads(request=self.id, ticket=self.number, heads=heads)

    @property
    def is_ended(self) -> bool:
        """Whether the entrant has signed its end; or answered all of it, before transcripts."""
        is_answered = all(each.answered for each in self.instances)
        if self.request.content.transcript is None:
            return is_answered
        if not self.signed_end.path.exists():
            return False
        if not (is_answered and self.signed_end.is_of(self._heads)):
            raise self.signed_end.tampered("all transcripts")
        return True

    @property
    def status(self) -> TicketStatus:
        return TicketStatus(
            ticket=self.number,
            phase="ended" if self.is_over(self._store.clock.time) else "running",
            deadline=self.deadline,
            instances=tuple(each.status for each in self.instances),
        )

    def instance(self, number: int) -> Instance:
        if number >= len(self.instances):
            raise Rejection(
                "instance_unknown",
                f"instance={number}: must be in [0, {len(self.instances) - 1}]. Correct it.",
            )
        return self.instances[number]

    def hidden(self, number: int) -> HiddenTask:
        nonce, hidden = self.request.content.nonce, self._hidden[number]
        return HiddenTask.of(self.season, self._master, hidden, str(self.number), nonce)

    def close(self) -> None:
        """End the ticket: wait for the requests in progress, and refuse all others."""
        self._closed = True
        for each in self.instances:
            each.release()

    def score(self) -> SealedResult:
        """Its result when it is over, from its journals and answers."""
        runs, stepping = [], []
        versions: dict[str, str] = {}
        board, season = self._store.document, self.season
        for number, instance in enumerate(self.instances):
            [(run, used)] = score_runs(self.hidden(number), [instance.answers], board.rules)
            versions |= used
            runs.append(run)
            stepping.append(instance.stepping())
        result = sealed_result(season, self.id, runs, versions, board.draws, stepping, board.rules)
        return result.model_copy(update={"signed": self.signed_end.digest})

    def finish(self) -> None:
        """Score it, and log its result."""
        not_before = "" if self.is_ended else self.deadline
        self._store.finish(self.score(), not_before)
        for each in self.instances:
            each.forget()


MOST_HELD_LANES, _FIXED_LANES, _WEIGHTS_OF_A_LANE = 2**17, 128, 100
"""In memory, of all instances together; what each takes besides its lanes, and its network.

Those used longest ago go on from their snapshots.
"""


class Sessions:
    """The tickets of one season, for any number of threads; `close` frees the season."""

    def __init__(self, store: SeasonStore, season: Season, master: Master) -> None:
        self.season, self.master, self.digest = season, master, season.digest
        folder = store.season_folder(self.digest)
        folder.mkdir(parents=True, exist_ok=True)
        lock = file_lock(folder / ".stepping")
        if lock is None:
            raise BoardError(f"season={season.id}: another server steps it. Stop that one first.")
        self._process_lock = lock
        self._store = store
        self._lock = threading.Lock()
        self._running: dict[int, Ticket] = {}
        self._held: OrderedDict[Instance, int] = OrderedDict()
        self._held_lanes = 0

    @classmethod
    def of_master(cls, store: SeasonStore, secret: str | os.PathLike[str]) -> list[Sessions]:
        """Those of each online season that is committed to the master in a file."""
        master = Master.read(secret)
        terms = [row.terms for row in store.seasons() if row.terms.track == "sealed-online"]
        found = [cls(store, each, master) for each in terms if each.is_committed_to(master)]
        if not found:
            raise BoardError(
                f"{secret}: is the master of no sealed-online season of this board. Give the file "
                "that `sme-leaderboard season new` wrote."
            )
        return found

    def ticket(self, number: int) -> Ticket:
        found = self._running.get(number)
        if found is None:
            row = self._store.ticket(self.digest, number)
            found = Ticket(self._store, self.season, self.master, row)
            with self._lock:
                found = self._running.setdefault(number, found)
        return found

    @property
    def step_bytes(self) -> int:
        """The most bytes of a request for steps, of any instance."""
        dims = (member.setting.action_dim for member in self.season.classes)
        return StepFormat(MAX_LANES, 1, max(dims)).request_bytes

    def open(self, number: int, token: str) -> Ticket:
        """A ticket, for whoever has its password."""
        ticket = self.ticket(number)
        if not hmac.compare_digest(token.encode(), ticket.token.encode()):
            raise Rejection(
                "token_wrong",
                f"ticket={number}: the token in the header Authorization is not its own. "
                "Send `Bearer` and the token that the board answered when the ticket started.",
            )
        return ticket

    def use(self, number: int, token: str, instance: int, use: Callable[[Instance], _T]) -> _T:
        """What a function returns of an instance of a ticket, for whoever has its password."""
        with storage():
            used = self.open(number, token).instance(instance)
            result = use(used)
            self.hold(used)
        return result

    def is_ready(self, number: int, instance: int) -> bool:
        """Whether the next step of an instance does not block."""
        ticket = self._running.get(number)
        instances = () if ticket is None else ticket.instances
        return instance < len(instances) and instances[instance].is_ready

    def over(self) -> list[int]:
        """The numbers of tickets that are over and have no result, in order."""
        waiting, now = [], self._store.time
        for row in self._store.entrants(self.digest):
            if row.result is None:
                waiting.append(row)
            else:
                self._running.pop(row.number, None)  # closed, and so its files are final
        over = []
        for row in waiting:
            # An altered request holds up no other ticket; `verify` names its file.
            with contextlib.suppress(TamperedError):
                ticket = self.ticket(row.number)
                ticket.deadline = deadline(self.season, row)  # a wrong clock's date is corrected
                if ticket.is_over(now):
                    over.append(row.number)
        return over

    def attend(self) -> None:
        """Sync the journals, and let tickets that are over be scored."""
        try:
            self.sync()
            over = [self.ticket(number) for number in self.over()]
            for ticket in over:
                ticket.close()
            if over:
                self._store.queue.add_jobs(each.id for each in over)
        except Exception as error:  # the board is locked, or has no memory or files left
            # Nothing but the kind of an error is logged: its text may name what is hidden.
            _log.error("season: cannot be attended to: %s", type(error).__name__)

    def sync(self) -> None:
        with self._lock:
            held = list(self._held)
        for each in held:
            with contextlib.suppress(OSError):  # the next steps fail, too, and say so
                each.sync()

    def close(self) -> None:
        """End what this server does for the season; another one can go on."""
        for ticket in list(self._running.values()):
            for each in ticket.instances:
                each.release()
        self._process_lock.release()

    def hold(self, instance: Instance) -> None:
        """Note that an instance was used, and free others if too many are held."""
        freed = []
        with self._lock:
            if instance not in self._held:
                network = instance.weights // _WEIGHTS_OF_A_LANE
                self._held[instance] = (instance.status.lanes or 0) + _FIXED_LANES + network
                self._held_lanes += self._held[instance]
            self._held.move_to_end(instance)
            while self._held_lanes > MOST_HELD_LANES:
                oldest, lanes = self._held.popitem(last=False)
                self._held_lanes -= lanes
                freed.append(oldest)
        for each in freed:
            each.release()


_SECONDS = 1.0
_log = logging.getLogger(__name__)


def attending(sessions: Collection[Sessions]) -> AbstractContextManager[None]:
    """Sync, and end tickets, in a thread while the block runs."""
    if not sessions:
        return contextlib.nullcontext()

    def attend(stop: threading.Event) -> None:
        while not stop.wait(_SECONDS):
            for each in sessions:
                each.attend()

    return beside("seasons", attend)


@dataclass(frozen=True)
class ScoreTicket:
    """The job of a scorer, in its own process: score a ticket that is over, and log its result."""

    secrets: tuple[Path, ...]  # files of the masters of the seasons that a server steps

    def __call__(self, store: Store, id: str) -> None:
        """Score the ticket that was started by the request of this id."""
        assert isinstance(store, SeasonStore)
        row = store.entrant(id)
        if row is None or row.result is not None:
            return
        season = store.season(row.track)
        masters = map(Master.read, self.secrets)
        master = next(each for each in masters if season.is_committed_to(each))
        Ticket(store, season, master, row).finish()


def refuse_other_sender(
    store: SeasonStore, signed: Signed[TicketRequest], header: str | None, address: str
) -> None:
    """Reject a request whose header does not show that its own key has just sent it, here."""
    sender = uploader(store.document, header, signed.id, address)
    key = signed.content.submitter.key
    if sender != key:
        raise Rejection(
            "bad_signature",
            f"Authorization: is signed by the key {sender[:16]}…: must be by {key[:16]}…, "
            "which signed the request. Sign both with one key.",
        )


def start_ticket(
    store: SeasonStore, signed: Signed[TicketRequest], address: str | None = None
) -> tuple[int, bool]:
    """Start a ticket: its number, and whether it is new; `address` is as in `enter`."""
    check_receiver(store.document, signed.receiver, address)
    known = store.entrant(signed.id)
    if known is not None:
        return known.number, False
    request = signed.content
    if request.answers_key is None or request.transcript is None:
        raise Rejection(
            "schema",
            "ticket.answers_key, ticket.transcript: missing: must be the public key that signs the "
            "transcripts, and 1. Create the request with `sme-leaderboard ticket`.",
        )
    check_manifest(store.document, request, datetime.datetime.fromisoformat(store.time))
    size = len(signed.to_bytes()) + played_bytes(store.season(request.season))
    with store.transaction():  # no other entrant can take the name, or the room, in between
        check_entrant(store, request.submitter, size)
        return store.add(signed)

"""`Sessions`: the tickets of an online season whose master this server has, as they are played.

Beside requests, every second the journals are synced, and tickets that are over are closed and
scored, one after the other in a process of their own, so that steps go on. A ticket that cannot be
scored is tried again after all others, after growing pauses of up to five minutes.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from leaderboard.errors import BoardError, TamperedError
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.master import Master
from leaderboard.seasons.season import MAX_LANES, Season
from leaderboard.seasons.tickets import Ticket, deadline, score_ticket, unplayed_result
from leaderboard.store import Store
from sme_registry.io import file_lock
from sme_registry.seasons.wire import StepFormat, TicketStatus

MOST_HELD_LANES, _FIXED_LANES, _WEIGHTS_OF_A_LANE = 2**17, 128, 100
"""In memory, of all instances together; what each takes besides its lanes, and its network.

Those used longest ago go on from their snapshots.
"""


class Sessions:
    """The tickets of one season, for any number of threads; `close` frees the season.

    Args:
      store: the board.
      secret: the path of the season's master.
      season: digest of the season; by default the first that is committed to the master.

    Raises:
      BoardError: no online season of the board is committed to the master, or another server steps
        the season.

    Attributes:
      season, digest: the season, and the digest of its document.
      board, secret: paths of the board's folder and of the master.
    """

    def __init__(
        self, store: Store, secret: str | os.PathLike[str], season: str | None = None
    ) -> None:
        self.master = Master.read(secret)
        seasons = _seasons_of(store, self.master, secret)
        self.season = seasons[0] if season is None else store.season(season)
        self.digest = self.season.digest
        folder = store.season_folder(self.digest)
        folder.path.mkdir(parents=True, exist_ok=True)
        lock = file_lock(folder.stepping)
        if lock is None:
            raise BoardError(
                f"season={self.season.id}: another server steps it. Stop that one first."
            )
        self._process_lock = lock
        self._store = store
        self.board, self.secret = store.folder.path, Path(secret)
        self._lock = threading.Lock()
        self._running: dict[int, Ticket] = {}
        self._held: OrderedDict[Instance, int] = OrderedDict()
        self._held_lanes = 0

    @classmethod
    def of_master(cls, store: Store, secret: str | os.PathLike[str]) -> list[Sessions]:
        """Those of each online season that is committed to a master; errors as of the class."""
        seasons = _seasons_of(store, Master.read(secret), secret)
        return [cls(store, secret, season.digest) for season in seasons]

    def ticket(self, number: int) -> Ticket:
        """A ticket by its number.

        Raises:
          Rejection: `ticket_unknown`.
        """
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

    def status(self, number: int, token: str) -> TicketStatus:
        """How far an entrant is, with the password of the ticket."""
        ticket = self.ticket(number)
        ticket.check_token(token)
        return ticket.status(self._store.clock.time)

    def open(self, number: int, token: str, instance: int, *, ended: bool = False) -> Instance:
        """An instance, with the password of its ticket, which runs, or may have `ended`.

        Raises:
          Rejection: `ticket_unknown`, `token_wrong`, `instance_unknown` or `ticket_ended`.
        """
        ticket = self.ticket(number)
        ticket.check_token(token)
        if not ended:
            ticket.check_running(self._store.clock.received())
        return ticket.instance(instance)

    def is_ready(self, number: int, instance: int) -> bool:
        """Whether the next step of an instance does not block."""
        ticket = self._running.get(number)
        instances = () if ticket is None else ticket.instances
        return instance < len(instances) and instances[instance].is_ready

    def end(self, number: int, token: str, signature: str) -> None:
        """`Ticket.end`, with the password of the ticket; again after its end, too."""
        ticket = self.ticket(number)
        ticket.check_token(token)
        if not ticket.is_over(""):
            ticket.check_running(self._store.clock.received())
        ticket.end(signature)

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

    def close_ticket(self, number: int) -> None:
        """Refuse all further requests for a ticket, after those in progress."""
        self.ticket(number).close()

    def end_unplayed(self, numbers: Sequence[int], most: int) -> list[int]:
        """Log the results of tickets that are over and that nobody has played.

        Args:
          numbers: of tickets that are over.
          most: results to log at a time.

        Returns:
          The numbers of the others.
        """
        unplayed = {number for number in numbers if self.ticket(number).is_unplayed}
        for number in sorted(unplayed)[:most]:
            ticket = self.ticket(number)
            ticket.close()
            if ticket.is_unplayed:  # still: requests were in progress
                result = unplayed_result(self._store, self.season, ticket)
                self._store.end_ticket(self.digest, number, result)
                ticket.forget()
        return [number for number in numbers if number not in unplayed]

    def sync(self) -> None:
        """Make all steps taken survive a loss of power."""
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


def _seasons_of(store: Store, master: Master, secret: str | os.PathLike[str]) -> list[Season]:
    online = [store.season(row.id) for row in store.seasons() if row.track == "sealed-online"]
    found = [season for season in online if season.is_committed_to(master)]
    if not found:
        raise BoardError(
            f"{secret}: is the master of no sealed-online season of this board. Give the file that "
            "`sme-leaderboard season new` wrote."
        )
    return found


_SECONDS = 1.0
_AT_ONCE = 100  # tickets: of a process, or unplayed ones of a second
_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 300.0
_STOP_SECONDS = 10.0
_log = logging.getLogger(__name__)


@contextlib.contextmanager
def attending(tickets: Collection[Sessions]) -> Iterator[None]:
    """Sync, end and score in a thread while the block runs."""
    if not tickets:
        yield
        return
    stop = threading.Event()
    attendants = [Attendant(each) for each in tickets]

    def attend() -> None:
        while not stop.wait(_SECONDS):
            for each in attendants:
                each.attend()

    thread = threading.Thread(target=attend, name="seasons", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        for each in attendants:
            each.stop()


class Attendant:
    """What a server does for one season beside requests."""

    def __init__(self, tickets: Sessions) -> None:
        self._sessions = tickets
        self._process: BaseProcess | None = None
        self._numbers: list[int] = []  # of the tickets that the process scores
        self._at_once = _AT_ONCE
        self._failed: set[int] = set()
        self._pause, self._retry_at = _FIRST_PAUSE, 0.0

    def attend(self) -> None:
        """Sync the journals, and score the next tickets that are over."""
        try:
            self._sessions.sync()
            is_scoring = self._is_scoring()
            played = self._sessions.end_unplayed(self._sessions.over(), _AT_ONCE)
            if is_scoring:
                return
            waiting = [number for number in played if number not in self._failed]
            if waiting:
                self._numbers = waiting[: self._at_once]
                for number in self._numbers:
                    self._sessions.close_ticket(number)
                self._process = self._start()
            elif time.monotonic() >= self._retry_at:
                self._failed.clear()
        except Exception as error:  # the board is locked, or has no memory or files left
            # Nothing but the kind of an error is logged: its text may name what is hidden.
            _log.error("season: cannot be attended to: %s", type(error).__name__)

    def stop(self) -> None:
        """End the scoring; the next server does it."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(_STOP_SECONDS)

    def _start(self) -> BaseProcess:
        # Not forked: this process has threads, connections and locks.
        process = multiprocessing.get_context("spawn").Process(
            target=_score,
            args=(
                self._sessions.board,
                self._sessions.digest,
                self._sessions.secret,
                self._numbers,
            ),
            name="tickets",
        )
        process.start()
        return process

    def _is_scoring(self) -> bool:
        if self._process is None or self._process.is_alive():
            return self._process is not None
        failed = self._process.exitcode != 0
        self._process.close()
        self._process = None
        if failed:  # others first
            _log.error("season: a ticket could not be scored; it is tried again")
            self._failed.update(self._numbers)  # those with a result are not over any more
            self._retry_at = time.monotonic() + self._pause
        self._pause = min(2.0 * self._pause, _LONGEST_PAUSE) if failed else _FIRST_PAUSE
        # The process may have died before it came to the others.
        self._at_once = 1 if failed else _AT_ONCE
        return False


def _score(board: Path, season: str, secret: Path, numbers: Sequence[int]) -> None:
    """Score tickets and log their results, in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends it
    failed = False
    for number in numbers:
        try:
            with Store.open(board) as store:
                of, row = store.season(season), store.ticket(season, number)
                ticket = Ticket(store, of, Master.read(secret), row)
                store.end_ticket(season, number, score_ticket(store, of, ticket))
                ticket.forget()
        except Exception as error:
            _log.error("season: scoring ticket %d failed: %s", number, type(error).__name__)
            failed = True
    raise SystemExit(failed)

"""`Sessions`: the tickets of an online season whose master this server has, as they are played.

Beside requests, every second the journals are synced, and tickets that are over are closed, and put
into the board's queue of what is scored.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from leaderboard.errors import BoardError, TamperedError
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.master import Master
from leaderboard.seasons.season import MAX_LANES, Season
from leaderboard.seasons.store import SeasonStore
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

    `secret` is the path of its master, and `season` its digest; by default it is the first that is
    committed to the master.
    """

    def __init__(
        self, store: SeasonStore, secret: str | os.PathLike[str], season: str | None = None
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
        self.secret = Path(secret)
        self._lock = threading.Lock()
        self._running: dict[int, Ticket] = {}
        self._held: OrderedDict[Instance, int] = OrderedDict()
        self._held_lanes = 0

    @classmethod
    def of_master(cls, store: SeasonStore, secret: str | os.PathLike[str]) -> list[Sessions]:
        """Those of each online season that is committed to a master; errors as of the class."""
        seasons = _seasons_of(store, Master.read(secret), secret)
        return [cls(store, secret, season.digest) for season in seasons]

    def ticket(self, number: int) -> Ticket:
        """A ticket by its number."""
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

    def open(self, number: int, token: str, instance: int) -> Instance:
        """An instance, with the password of its ticket."""
        ticket = self.ticket(number)
        ticket.check_token(token)
        return ticket.instance(instance)

    def is_ready(self, number: int, instance: int) -> bool:
        """Whether the next step of an instance does not block."""
        ticket = self._running.get(number)
        instances = () if ticket is None else ticket.instances
        return instance < len(instances) and instances[instance].is_ready

    def end(self, number: int, token: str, signature: str) -> None:
        """`Ticket.end`, with the password of the ticket."""
        ticket = self.ticket(number)
        ticket.check_token(token)
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

    def attend(self) -> None:
        """Sync the journals; end the tickets that nobody has played, and let others be scored."""
        try:
            self.sync()
            over = [self.ticket(number) for number in self.over()]
            for ticket in over:
                ticket.close()
            self._store.queue.add_jobs(each.id for each in over if not each.is_unplayed)
            for ticket in [each for each in over if each.is_unplayed][:_AT_ONCE]:
                result = unplayed_result(self._store, self.season, ticket)
                self._store.end_ticket(self.digest, ticket.number, result, ticket.deadline)
                ticket.forget()
        except Exception as error:  # the board is locked, or has no memory or files left
            # Nothing but the kind of an error is logged: its text may name what is hidden.
            _log.error("season: cannot be attended to: %s", type(error).__name__)

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


def _seasons_of(store: SeasonStore, master: Master, secret: str | os.PathLike[str]) -> list[Season]:
    online = [store.season(row.id) for row in store.seasons() if row.track == "sealed-online"]
    found = [season for season in online if season.is_committed_to(master)]
    if not found:
        raise BoardError(
            f"{secret}: is the master of no sealed-online season of this board. Give the file that "
            "`sme-leaderboard season new` wrote."
        )
    return found


_SECONDS = 1.0
_AT_ONCE = 100  # results of unplayed tickets, of a second
_log = logging.getLogger(__name__)


@contextlib.contextmanager
def attending(sessions: Collection[Sessions]) -> Iterator[None]:
    """Sync, and end tickets, in a thread while the block runs."""
    if not sessions:
        yield
        return
    stop = threading.Event()

    def attend() -> None:
        while not stop.wait(_SECONDS):
            for each in sessions:
                each.attend()

    thread = threading.Thread(target=attend, name="seasons", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


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
        season = store.season(row.season)
        masters = map(Master.read, self.secrets)
        master = next(each for each in masters if season.is_committed_to(each))
        ticket = Ticket(store, season, master, row)
        not_before = "" if ticket.is_ended else ticket.deadline
        result = score_ticket(store, season, ticket)
        store.end_ticket(row.season, row.number, result, not_before)
        ticket.forget()

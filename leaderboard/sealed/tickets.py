"""`Tickets`: those of one sealed-online season, whose master this server has."""

from __future__ import annotations

import contextlib
import datetime
import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

from leaderboard.documents.master import Master
from leaderboard.documents.season import MAX_LANES, Season
from leaderboard.errors import BoardError, TamperedError
from leaderboard.sealed.instance import SteppedInstance
from leaderboard.sealed.scores import unplayed_result
from leaderboard.sealed.ticket import RunningTicket
from leaderboard.store import Store
from sme_registry.io import file_lock
from sme_registry.seasons.wire import StepFormat, TicketStatus

MOST_HELD_LANES, _FIXED_LANES, _WEIGHTS_OF_A_LANE = 2**17, 128, 100
"""In memory, of all instances together; what each takes besides its lanes, and its network.

Those used longest ago are replayed when they go on.
"""

_SURE_SECONDS = 60.0


class Clock:
    """The board's time, which does not go back while the server runs.

    Args:
      start: the store's time, as documents write it.
    """

    def __init__(self, start: str) -> None:
        first = max(datetime.datetime.fromisoformat(start).timestamp(), time.time())
        self._offset = first - time.monotonic()
        self._forward_since = math.inf  # uptime

    @property
    def now(self) -> float:
        """Seconds since 1970."""
        return max(time.time(), self._offset + time.monotonic())

    @property
    def sure(self) -> float:
        """The same for what cannot be undone: a clock set forward counts after a minute."""
        uptime = time.monotonic()
        if time.time() - uptime - self._offset < _SURE_SECONDS:
            self._forward_since = math.inf
        else:
            self._forward_since = min(self._forward_since, uptime)
            if uptime - self._forward_since >= _SURE_SECONDS:
                self._offset = time.time() - uptime
        return self._offset + uptime


class Tickets:
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
        lock = file_lock(folder.stepping)
        if lock is None:
            raise BoardError(
                f"season={self.season.id}: another server steps it. Stop that one first."
            )
        self._process_lock = lock
        self._store = store
        self.board, self.secret = store.folder.path, Path(secret)
        self._clock = Clock(store.time)
        self._lock = threading.Lock()
        self._running: dict[int, RunningTicket] = {}
        self._held: OrderedDict[SteppedInstance, int] = OrderedDict()
        self._held_lanes = 0

    @classmethod
    def of_master(cls, store: Store, secret: str | os.PathLike[str]) -> list[Tickets]:
        """Those of each online season that is committed to a master; errors as of the class."""
        seasons = _seasons_of(store, Master.read(secret), secret)
        return [cls(store, secret, season.digest) for season in seasons]

    def ticket(self, number: int) -> RunningTicket:
        """A ticket by its number.

        Raises:
          Rejection: `ticket_unknown`.
        """
        found = self._running.get(number)
        if found is None:
            row = self._store.ticket(self.digest, number)
            found = RunningTicket(self._store, self.season, self.master, row)
            with self._lock:
                found = self._running.setdefault(number, found)
        return found

    @property
    def now(self) -> float:
        """The board's time in seconds since 1970."""
        return self._clock.now

    @property
    def step_bytes(self) -> int:
        """The most bytes of a request for steps, of any instance."""
        dims = (member.setting.action_dim for member in self.season.classes)
        return StepFormat(MAX_LANES, 1, max(dims)).request_bytes

    def status(self, number: int, token: str) -> TicketStatus:
        """How far an entrant is, with the password of the ticket."""
        ticket = self.ticket(number)
        ticket.refuse_token(token)
        return ticket.status(self.now)

    def answer_bytes(self, number: int, token: str, instance: int) -> int:
        """The most bytes of an instance's answers, with the password of the ticket."""
        ticket = self.ticket(number)
        ticket.refuse_token(token)
        return ticket.instance(instance).answer_bytes

    def start(self, number: int, token: str, instance: int, lanes: int) -> bytes:
        """`SteppedInstance.start`, with the password of the ticket."""
        chosen = self._chosen(number, token, instance)
        answer = chosen.start(lanes)
        self._hold(chosen)
        return answer

    def step(self, number: int, token: str, instance: int, body: bytes) -> bytes:
        """`SteppedInstance.step`, with the password of the ticket."""
        chosen = self._chosen(number, token, instance)
        answer = chosen.step(body)
        self._hold(chosen)
        return answer

    def quick_step(self, number: int, token: str, instance: int, body: bytes) -> bytes | None:
        """`step`, which does not block; None where it would."""
        ticket = self._running.get(number)
        instances = () if ticket is None else ticket.instances
        if instance >= len(instances) or not instances[instance].is_ready:
            return None
        return self.step(number, token, instance, body)

    def finish(self, number: int, token: str, instance: int) -> None:
        """`SteppedInstance.finish`, with the password of the ticket."""
        self._chosen(number, token, instance).finish()

    def refuse_challenge(self, number: int, token: str, instance: int) -> None:
        """`SteppedInstance.refuse_challenge`, with the password of the ticket."""
        self._chosen(number, token, instance).refuse_challenge()

    def challenge(self, number: int, token: str, instance: int) -> bytes:
        """`RunningTicket.challenge`, with the password of the ticket."""
        self._chosen(number, token, instance)
        return self.ticket(number).challenge(instance)

    def journal_digest(self, number: int, token: str, instance: int) -> str:
        """`SteppedInstance.journal_digest`, with the password of the ticket; also after its end."""
        ticket = self.ticket(number)
        ticket.refuse_token(token)
        return ticket.instance(instance).journal_digest()

    def answer(
        self, number: int, token: str, instance: int, data: bytes, signature: str = ""
    ) -> bool:
        """`SteppedInstance.answer`, with the password of the ticket.

        The same answers are confirmed after the ticket's end, too: the last ones are what ends it.
        """
        ticket = self.ticket(number)
        ticket.refuse_token(token)
        chosen = ticket.instance(instance)
        if chosen.has_stored(data):
            return False
        ticket.refuse_over(self.now)
        return chosen.answer(data, signature)

    def over(self) -> list[int]:
        """The numbers of tickets that are over and have no result, in order."""
        waiting, now = [], self._clock.sure
        for row in self._store.entrants(self.digest):
            if row.result is None:
                waiting.append(row.number)
            else:
                self._running.pop(row.number, None)  # closed, and so its files are final
        over = []
        for number in waiting:
            # An altered request holds up no other ticket; `verify` names its file.
            with contextlib.suppress(TamperedError):
                if self.ticket(number).is_over(now):
                    over.append(number)
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

    def _chosen(self, number: int, token: str, instance: int) -> SteppedInstance:
        ticket = self.ticket(number)
        ticket.refuse_token(token)
        ticket.refuse_over(self.now)
        return ticket.instance(instance)

    def _hold(self, instance: SteppedInstance) -> None:
        """Note that an instance was used, and free others if too many are held."""
        freed = []
        with self._lock:
            if instance not in self._held:
                network = instance.weights // _WEIGHTS_OF_A_LANE
                self._held[instance] = instance.lanes + _FIXED_LANES + network
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

"""`RunningTicket`: one ticket of a sealed-online season, its password, deadline and instances."""

from __future__ import annotations

import datetime
import hmac
from functools import partial
from itertools import islice

from leaderboard.documents.submission import shifted, utc
from leaderboard.errors import Rejection
from leaderboard.seasons.instance import SteppedInstance
from leaderboard.seasons.master import Master, Place
from leaderboard.seasons.scoring import Instance, challenge, instances
from leaderboard.seasons.season import MAX_LANES, Season
from leaderboard.seasons.signatory import Signatory
from leaderboard.seasons.stepping import Start
from leaderboard.store import SealedRow, Store
from sme_registry import seasons
from sme_registry.seasons import wire


def deadline(season: Season, row: SealedRow) -> str:
    """When a ticket of an online season ends at the latest."""
    assert season.ticket_hours is not None  # the track is online
    started = datetime.datetime.fromisoformat(row.entrant.received)
    return utc(shifted(started, datetime.timedelta(hours=season.ticket_hours)))


class RunningTicket:
    """One ticket: it runs until all instances are answered, or its deadline has passed.

    Args:
      store: the board.
      season, master: the season.
      row: the ticket's.

    Attributes:
      number: in the season, from 1.
      deadline: its end.
      instances: in the season's order.
    """

    def __init__(self, store: Store, season: Season, master: Master, row: SealedRow) -> None:
        self.number = row.number
        self._season, self._master = season, master
        request = store.request_of(row)
        self._nonce = request.content.nonce
        place = Place(season.id, "", 0, str(row.number), self._nonce)
        self._token = master.secret("token", place).hex()
        self.deadline = deadline(season, row)
        self._closed = row.result is not None
        folder = store.season_folder(row.season).ticket(row.number)
        self.instances = tuple(
            SteppedInstance(
                *(folder, number, hidden.member, season.protocol, partial(self.start, number)),
                Signatory.named_in(request, row.number),
            )
            for number, hidden in enumerate(season.hidden)
        )

    @property
    def document(self) -> seasons.Ticket:
        """What the entrant gets; it holds the password."""
        return seasons.Ticket.from_dict(
            {
                "season": self._season.id,
                "ticket": self.number,
                "token": self._token,
                "deadline": self.deadline,
                "lanes": MAX_LANES,
                "classes": [member.model_dump(exclude={"data"}) for member in self._season.classes],
            }
        )

    def refuse_token(self, token: str) -> None:
        """Raise `Rejection` (`token_wrong`) unless this is the ticket's password."""
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            raise Rejection(
                "token_wrong",
                f"ticket={self.number}: the token in the header Authorization is not its own. "
                "Send `Bearer` and the token that the board answered when the ticket started.",
            )

    def is_over(self, now: str) -> bool:
        """Whether nothing can change any more, at a time of the board."""
        return self._closed or now >= self.deadline or all(each.answered for each in self.instances)

    @property
    def is_unplayed(self) -> bool:
        """Whether it has neither steps nor answers."""
        return not any(each.is_played for each in self.instances)

    def refuse_over(self, now: str) -> None:
        """Raise `Rejection` (`ticket_ended`) if the ticket is over."""
        if self._closed or now >= self.deadline:
            raise Rejection(
                "ticket_ended",
                f"ticket={self.number}: has ended, at the latest at {self.deadline}. What it "
                "had counts.",
            )

    def status(self, now: str) -> wire.TicketStatus:
        """How far the entrant is."""
        return wire.TicketStatus(
            ticket=self.number,
            phase="ended" if self.is_over(now) else "running",
            deadline=self.deadline,
            instances=tuple(each.status for each in self.instances),
        )

    def instance(self, number: int) -> SteppedInstance:
        """Instance i of the ticket.

        Raises:
          Rejection: `instance_unknown`.
        """
        if number >= len(self.instances):
            raise Rejection(
                "instance_unknown",
                f"instance={number}: must be in [0, {len(self.instances) - 1}]. Correct it.",
            )
        return self.instances[number]

    def challenge(self, number: int) -> bytes:
        """The challenge states of instance i, once its steps are taken: an .npy file.

        Raises:
          Rejection: `instance_unknown` or `instance_phase`.
        """
        self.instance(number).refuse_challenge()
        hidden = self.hidden(number)
        return wire.pack_table(challenge(hidden.spec, hidden.protocol))

    def hidden(self, number: int) -> Instance:
        """What is hidden of instance i."""
        every = instances(self._season, self._master, str(self.number), self._nonce)
        return next(islice(every, number, None))

    def start(self, number: int) -> Start:
        """What the steps of instance i follow from."""
        hidden = self.hidden(number)
        return Start(hidden.spec, int.from_bytes(self._master.secret("starts", hidden.place)))

    def close(self) -> None:
        """End the ticket: wait for the requests in progress, and refuse all others."""
        self._closed = True
        for each in self.instances:
            each.close()

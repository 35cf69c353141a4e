"""`Ticket`: hidden tasks for one entrant, stepped by the board; and its result, once it is over.

An instance without answers, or whose answers the entrant has not signed, scores 1 in every metric,
whatever its steps.
"""

from __future__ import annotations

import contextlib
import datetime
import hmac
from functools import partial
from itertools import islice

from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.documents.submission import shifted, utc
from leaderboard.errors import Rejection, TamperedError
from leaderboard.scoring.aggregation import failed_run
from leaderboard.seasons.entry import AllHeads, has_signed
from leaderboard.seasons.events import SealedRow
from leaderboard.seasons.instance import Instance, storage
from leaderboard.seasons.master import Master, Place
from leaderboard.seasons.scoring import HiddenTask, challenge, instances, score_run, sealed_result
from leaderboard.seasons.season import MAX_LANES, SealedResult, Season
from leaderboard.seasons.stepping import Start, no_steps
from leaderboard.seasons.store import SeasonStore
from sme_registry import seasons
from sme_registry.errors import SMEError
from sme_registry.io import parse_json, read_regular, to_json, write_atomically
from sme_registry.seasons import wire
from sme_registry.seasons.transcript import Place as InstancePlace


def deadline(season: Season, row: SealedRow) -> str:
    """When a ticket of an online season ends at the latest."""
    assert season.ticket_hours is not None  # the track is online
    started = datetime.datetime.fromisoformat(row.entrant.received)
    return utc(shifted(started, datetime.timedelta(hours=season.ticket_hours)))


class Ticket:
    """One ticket: it runs until the entrant ends it, or its deadline has passed.

    Its `id` is that of the request; its `instances` are in the season's order.
    """

    def __init__(self, store: SeasonStore, season: Season, master: Master, row: SealedRow) -> None:
        self.number, self.id = row.number, row.entrant.id
        self._season, self._master, self._clock = season, master, store.clock
        self._request = request = store.request_of(row)
        self._nonce = request.content.nonce
        place = Place(season.id, "", 0, str(row.number), self._nonce)
        self._token = master.secret("token", place).hex()
        self.deadline = deadline(season, row)
        self._closed = row.result is not None
        folder = store.season_folder(row.season).ticket(row.number)
        self._end_path = folder / "end.json"
        self.instances = tuple(
            Instance(
                *(folder, self._place(number), request, hidden.member, season.protocol),
                *(partial(self.start, number), partial(self._states, number), self.check_running),
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

    def check_token(self, token: str) -> None:
        """Raise `Rejection` (`token_wrong`) unless this is the ticket's password."""
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            raise Rejection(
                "token_wrong",
                f"ticket={self.number}: the token in the header Authorization is not its own. "
                "Send `Bearer` and the token that the board answered when the ticket started.",
            )

    def is_over(self, now: str) -> bool:
        """Whether nothing can change any more, at a time of the board."""
        return self._closed or now >= self.deadline or self._end_path.exists()

    @property
    def is_unplayed(self) -> bool:
        """Whether the entrant has neither signed nor answered anything."""
        return not any(each.is_played for each in self.instances)

    def check_running(self) -> None:
        """Raise `Rejection` (`ticket_ended`) if the ticket is over, or older than transcripts."""
        is_over = self._closed or self._clock.received() >= self.deadline
        if is_over or self._request.content.transcript is None:
            raise Rejection(
                "ticket_ended",
                f"ticket={self.number}: has ended, at the latest at {self.deadline}. What it "
                "had counts.",
            )

    def end(self, signature: str) -> None:
        """End the ticket, all of which is answered, with a signature of all transcripts."""
        heads = self._heads
        if not has_signed(self._request, signature, heads):
            raise Rejection(
                "bad_signature",
                f"signature={signature[:16]!a}: must be of the transcripts of all instances. Use "
                "the ticket's file, and the transcripts beside it.",
            )
        if not self._end_path.exists():
            self.check_running()
            receiver = self._request.receiver._asdict()
            signed = Signed[AllHeads](content=heads, signature=signature, **receiver)
            with storage():
                write_atomically(self._end_path, to_json(signed.to_dict()))

    @property
    def _heads(self) -> AllHeads:
        heads = []
        for number, instance in enumerate(self.instances):
            head = instance.final_head()
            if head is None:
                raise Rejection(
                    "instance_phase",
                    f"instance={number}: has no answers. Answer it before the ticket's end.",
                )
            heads.append(head)
        return AllHeads(request=self.id, ticket=self.number, heads=tuple(heads))

    @property
    def is_ended(self) -> bool:
        """Whether the entrant has signed its end; or answered all of it, before transcripts."""
        if self._request.content.transcript is None:
            return all(each.answered for each in self.instances)
        if not self._end_path.exists():
            return False
        with contextlib.suppress(SMEError):
            data = read_regular(self._end_path, MAX_BYTES)
            signed = Signed[AllHeads].from_dict(parse_json(data, self._end_path.name))
            if signed.content == self._heads and has_signed(
                self._request, signed.signature, signed.content
            ):
                return True
        where = "/".join(self._end_path.parts[-5:])
        raise TamperedError(where, "is not the entrant's signature of all transcripts")

    def status(self, now: str) -> wire.TicketStatus:
        """How far the entrant is."""
        return wire.TicketStatus(
            ticket=self.number,
            phase="ended" if self.is_over(now) else "running",
            deadline=self.deadline,
            instances=tuple(each.status for each in self.instances),
        )

    def instance(self, number: int) -> Instance:
        """Instance i of the ticket."""
        if number >= len(self.instances):
            raise Rejection(
                "instance_unknown",
                f"instance={number}: must be in [0, {len(self.instances) - 1}]. Correct it.",
            )
        return self.instances[number]

    def hidden(self, number: int) -> HiddenTask:
        """What is hidden of instance i."""
        every = instances(self._season, self._master, str(self.number), self._nonce)
        return next(islice(every, number, None))

    def start(self, number: int) -> Start:
        """What the steps of instance i follow from."""
        hidden = self.hidden(number)
        seed = int.from_bytes(self._master.secret("starts", hidden.place))
        return Start(hidden.spec, seed, self._place(number))

    def _place(self, number: int) -> InstancePlace:
        return InstancePlace(request=self.id, ticket=self.number, instance=number)

    def _states(self, number: int) -> bytes:
        hidden = self.hidden(number)
        return wire.pack_table(challenge(hidden.spec, hidden.protocol))

    def forget(self) -> None:
        """Remove what only playing and scoring needed."""
        for each in self.instances:
            each.forget()

    def close(self) -> None:
        """End the ticket: wait for the requests in progress, and refuse all others."""
        self._closed = True
        for each in self.instances:
            each.release()


def score_ticket(
    store: SeasonStore, season: Season, ticket: Ticket, *, replay: bool = False
) -> SealedResult:
    """Score a ticket from its snapshots and answers; or `replay` its journals, too.

    Nothing of the ticket may change any more. A TamperedError names what is not the entrant's.
    """
    runs, stepping = [], []
    versions: dict[str, str] = {}
    for index, instance in enumerate(ticket.instances):
        answers, digest = instance.answers
        run, used = score_run(ticket.hidden(index), answers, digest, store.document.rules)
        runs.append(run)
        versions |= used
        stepping.append(instance.replayed() if replay else instance.stepping())
    draws, rules = store.document.draws, store.document.rules
    return sealed_result(season, ticket.id, runs, versions, draws, stepping, rules)


def unplayed_result(store: SeasonStore, season: Season, ticket: Ticket) -> SealedResult:
    """What `score_ticket` computes for a ticket of which nothing is signed, and at no cost."""
    runs = [failed_run(season.protocol, hidden.member.name, None) for hidden in season.hidden]
    stepping = [no_steps(each.budget, each.status.lanes or 1) for each in ticket.instances]
    return sealed_result(season, ticket.id, runs, {}, store.document.draws, stepping)

"""`SeasonStore`: a board with seasons; and what it admits of entries and requests for tickets.

What may change when follows from the time at which the log receives it. Before, what is sent is
checked: the answers of an entry come first, as uploads of the entrant's key, and nothing is scored
before the reveal. The answer to a request for a ticket has the ticket's password, and a board keeps
requests where others may read them. So a request is sent with a header `Authorization` as for an
upload, whose signature is at most ten minutes old, and nobody else can repeat it.
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterator
from pathlib import Path

from leaderboard.admission import ReadFile, check_entrant, check_manifest, check_stored, uploader
from leaderboard.documents.board import check_receiver, hex_of
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import Artefact
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.events import (
    SEASON_KINDS,
    SealedRow,
    SeasonRow,
    Seasons,
    played_bytes,
    unknown_season,
)
from leaderboard.seasons.season import (
    Admitted,
    Entry,
    Master,
    Reveal,
    SealedResult,
    SealedTrack,
    Season,
    TicketRequest,
    read_answers,
)
from leaderboard.store import Store


class SeasonStore(Store):
    """A board with seasons, each by its digest; `name` is its id or digest."""

    kinds = SEASON_KINDS

    @contextlib.contextmanager
    def _reading(self) -> Iterator[Seasons]:
        with self.reading() as index:
            yield Seasons(index)

    def seasons(self) -> list[SeasonRow]:
        with self._reading() as seasons:
            return seasons.rows()

    def season_row(self, name: str) -> SeasonRow:
        with self._reading() as seasons:
            row = seasons.row(name)
        if row is None:
            raise unknown_season(name)
        return row

    def season(self, name: str) -> Season:
        return self.objects.document(Season, self.season_row(name).document)

    def season_folder(self, digest: str) -> Path:
        """`published` has data sets and challenge states, `tickets` what was played."""
        return self.folder.seasons / hex_of(digest)

    def ticket_folder(self, season: str, number: int) -> Path:
        return self.season_folder(season) / "tickets" / str(number)

    def admitted(self, season: str) -> dict[str, str]:
        with self._reading() as seasons:
            return seasons.admitted(season)

    def entrants(self, season: str) -> list[SealedRow]:
        """The entries or tickets of a season, in the log's order."""
        with self._reading() as seasons:
            return seasons.entrants(season)

    def entrant(self, id: str) -> SealedRow | None:
        with self._reading() as seasons:
            return seasons.entrant(id)

    def ticket(self, season: str, number: int) -> SealedRow:
        with self._reading() as seasons:
            row = seasons.ticket(season, number)
        if row is None:
            raise Rejection(
                "ticket_unknown",
                f"ticket={number}: the season has no ticket of this number. Start one with "
                "`sme-leaderboard ticket`.",
            )
        return row

    def entry_of(self, row: SealedRow) -> Signed[Entry]:
        return self.objects.document(Signed[Entry], row.document)

    def request_of(self, row: SealedRow) -> Signed[TicketRequest]:
        return self.objects.document(Signed[TicketRequest], row.document)

    def sealed_result(self, row: SealedRow) -> SealedResult | None:
        return None if row.result is None else self.objects.document(SealedResult, row.result)

    def revealed_master(self, name: str) -> Master:
        """The published master of a season; `Rejection` (`season_not_closed`) before the reveal."""
        row = self.season_row(name)
        if row.reveal is None:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: is not revealed yet. `sme-leaderboard season reveal` publishes "
                "its master after the close.",
            )
        return Master(bytes.fromhex(self.objects.document(Reveal, row.reveal).master))

    def open_season(self, name: str, track: SealedTrack, key: str) -> SeasonRow:
        """`Seasons.open`, now."""
        with self._reading() as seasons:
            return seasons.open(name, track, key, self.clock.time)

    def announce(self, season: Season) -> bool:
        """Publish a season and its commitment; False if the board already has it."""
        with self.transaction() as index:
            row = Seasons(index).row(season.id)
            if row is not None and row.digest == season.digest:
                return False
            if row is not None:
                raise BoardError(
                    f"id={season.id}: another season of this board has it. Choose another id."
                )
            if season.closes <= self.clock.time:
                raise BoardError(
                    f"closes={season.closes}: must be after the board's time, {self.clock.time}. "
                    "Choose a later one."
                )
            self.record("season", season.digest, season)
        return True

    def admit(self, season: str, key: str, name: str) -> bool:
        """Add a key to the list of a season, under the name that pages show; False if it is on it.

        `season` is its id.
        """
        with self.transaction() as index:
            row = self.season_row(season)
            if row.reveal is not None:
                raise Rejection("season_revealed", f"season={row.id}: its tasks are public now.")
            admitted = Admitted.from_dict({"season": row.digest, "key": key, "name": name})
            if key in Seasons(index).admitted(row.digest):
                return False
            self.record("admitted", row.digest, admitted)
        return True

    def enter(self, signed: Signed[Entry]) -> bool:
        """Add an entry, which was admitted, to an open season; False if the board has it."""
        return self._add("entry", signed)[1]

    def start_ticket(self, signed: Signed[TicketRequest]) -> tuple[int, bool]:
        """Start a ticket in an open season: its number, and whether it is new."""
        return self._add("ticket", signed)

    def _add(self, event: str, signed: Signed[Entry] | Signed[TicketRequest]) -> tuple[int, bool]:
        with self.transaction() as index:
            known = Seasons(index).entrant(signed.id)
            if known is not None:
                return known.number, False
            number = Seasons(index).next_number(signed.content.season)
            self.record(event, signed.id, signed)
        return number, True

    def finish(self, result: SealedResult, not_before: str = "") -> bool:
        """Log the result of an entry or ticket; False if it has one.

        `not_before` is a ticket's deadline, unless its entrant has ended it.
        """
        with self.transaction() as index:
            row = Seasons(index).entrant(result.subject)
            if row is None:
                raise BoardError(f"entry={result.subject}: is not on this board.")
            if self.clock.received() < not_before:
                raise BoardError(
                    f"ticket={row.number}: it is {self.clock.time}, and the ticket ends at "
                    f"{not_before}. Try again then."
                )
            if row.result is not None:
                return False
            online = self.season_row(row.season).track == "sealed-online"
            self.record("ended" if online else "ranked", result.subject, result)
        return True

    def reveal(self, reveal: Reveal) -> bool:
        """Publish the master of a season that is over; False if it was published."""
        with self.transaction():
            row = self.season_row(reveal.season)
            if row.reveal is not None and self.objects.document(Reveal, row.reveal) == reveal:
                return False
            self.record("revealed", row.digest, reveal)
        return True


def enter(
    store: SeasonStore,
    signed: Signed[Entry],
    answers: ReadFile | None = None,
    address: str | None = None,
) -> bool:
    """Check an entry, its signature verified, and store it; False if the board has it.

    Args:
      store, signed: the board and the entry.
      answers: returns the bytes of an answer by digest; they are stored with the entry. By default
        the entrant's key has uploaded them.
      address: of the server that it was sent to; None if it was given to the board's folder.
    """
    check_receiver(store.document, signed.receiver, address)
    if store.entrant(signed.id) is not None:
        return False
    entry, key = signed.content, signed.content.submitter.key
    check_manifest(store.document, entry, datetime.datetime.fromisoformat(store.time))
    store.open_season(entry.season, "sealed-offline", key)
    season = store.season(entry.season)
    given = _check_answers(store, season, signed, answers)
    with store.transaction():  # no other entrant can take the name, nor `gc` an answer in between
        check_entrant(store, entry.submitter, len(signed.to_bytes()))
        _check_newest(store, season, entry)
        for answer in given:
            if answers is not None:
                store.put_object(answer.sha256, [answers(answer.sha256)], by=key)
            check_stored(store, key, answer)
        return store.enter(signed)


def _check_newest(store: SeasonStore, season: Season, entry: Entry) -> None:
    """Refuse an entry that would not count, as its key has signed a later one of its method."""
    own = entry.submitter.key, entry.method.name.casefold()
    for row in store.entrants(season.digest):
        if row.method == own and row.created > entry.created:
            raise Rejection(
                "stale_time",
                f"created={entry.created}: entry {row.number} of the same key and method was "
                f"signed later, at {row.created}. The one signed last counts: check your clock, "
                "and sign this one again.",
            )


def _check_answers(
    store: SeasonStore, season: Season, signed: Signed[Entry], read: ReadFile | None
) -> list[Artefact]:
    """The answers that are not null, each in the shape of its instance's challenge."""
    entry, hidden = signed.content, list(season.hidden)
    if len(entry.answers) != len(hidden):
        raise Rejection(
            "answer_missing",
            f"answers: has {len(entry.answers)}: must have {len(hidden)}, one for each instance of "
            f"the season {season.id}, null where the method failed.",
        )
    given, checked = [], set()
    for number, (answer, each) in enumerate(zip(entry.answers, hidden, strict=True)):
        if answer is None:
            continue
        if read is None:
            check_stored(store, entry.submitter.key, answer)
        # Many instances may have the same answers, which are read once for each shape.
        form = answer.sha256, each.member.setting.action_dim
        try:
            if form not in checked:
                data = (read or store.objects.read)(answer.sha256)
                read_answers(data, each.member.setting, season.protocol)
                checked.add(form)
        except Rejection as error:
            where = f"answers.{number} (class {each.member.name}, instance {each.instance})"
            raise Rejection(error.code, f"{where}: {error.message}") from None
        given.append(answer)
    return given


def refuse_other_season(signed: Signed[Entry] | Signed[TicketRequest], season: str) -> None:
    """Reject what was sent to another season than the one of this digest, for which it is."""
    if signed.content.season != season:
        raise Rejection(
            "season_unknown",
            f"season={signed.content.season}: the {signed.content.FIELD} was sent to the season "
            f"{season}. Send it to its own.",
        )


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
        return store.start_ticket(signed)

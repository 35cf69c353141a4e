"""`SeasonStore`: a board with seasons, each change under the board's transaction.

What may change when follows from the time at which the log receives it.
"""

from __future__ import annotations

from typing import Literal

from leaderboard.documents.signed import Signed
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.entry import Entry, TicketRequest
from leaderboard.seasons.events import SEASON_KINDS, SealedRow, SeasonRow, Seasons, unknown_season
from leaderboard.seasons.season import (
    Admitted,
    Master,
    Reveal,
    SealedResult,
    SealedTrack,
    Season,
    SeasonFolder,
)
from leaderboard.store import Store


class SeasonStore(Store):
    """A board with seasons."""

    kinds = SEASON_KINDS

    def announce(self, season: Season) -> bool:
        """Publish a season and its commitment.

        Returns:
          False if the board already has it.

        Raises:
          BoardError: its id is taken, it is over, or it cannot be written.
        """
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

    def seasons(self) -> list[SeasonRow]:
        """All seasons, in the order in which they were announced."""
        with self.reading() as index:
            return Seasons(index).rows()

    def season_row(self, name: str) -> SeasonRow:
        """The season of this id or digest.

        Raises:
          Rejection: `season_unknown`.
        """
        with self.reading() as index:
            row = Seasons(index).row(name)
        if row is None:
            raise unknown_season(name)
        return row

    def season(self, name: str) -> Season:
        """The document of the season of this id or digest.

        Raises:
          Rejection: `season_unknown`.
          TamperedError: its file differs from the logged one.
        """
        row = self.season_row(name)
        with self.reading() as index:
            return Seasons(index).read(row)

    def season_folder(self, digest: str) -> SeasonFolder:
        """The folder of a season, by its digest."""
        return SeasonFolder(self.folder, digest)

    def admit(self, season: str, key: str, name: str) -> bool:
        """Add a key to the list of a season, by its id, under the name that pages show.

        Returns:
          False if it is on the list.

        Raises:
          Rejection: `season_unknown` or `season_revealed`.
          SpecError: the key or the name is none.
          BoardError: it cannot be written.
        """
        with self.transaction() as index:
            row = self.season_row(season)
            if row.reveal is not None:
                raise Rejection("season_revealed", f"season={row.id}: its tasks are public now.")
            fields = {"season": row.digest, "key": key, "name": name}
            admitted = Admitted.from_dict(fields)
            if key in Seasons(index).admitted(row.digest):
                return False
            self.record("admitted", row.digest, admitted)
        return True

    def admitted(self, season: str) -> dict[str, str]:
        """The names of the admitted keys of a season, by its digest."""
        with self.reading() as index:
            return Seasons(index).admitted(season)

    def enter(self, signed: Signed[Entry]) -> bool:
        """Add an entry, which was admitted, to an open season.

        Returns:
          False if the board already has it.

        Raises:
          Rejection: `season_unknown`, `season_track`, `season_not_open`, `season_closed`,
            `season_revealed` or `not_admitted`.
          BoardError: it cannot be written.
        """
        with self.transaction() as index:
            if Seasons(index).entrant(signed.id) is not None:
                return False
            self.record("entry", signed.id, signed)
        return True

    def start_ticket(self, signed: Signed[TicketRequest]) -> int:
        """Start a ticket in an open season; the same request starts no second one.

        Returns:
          Its number: 1 for the season's first, in the log's order.

        Raises:
          Rejection: `season_unknown`, `season_track`, `season_not_open`, `season_closed`,
            `season_revealed`, `not_admitted`, or `ticket_limit` of the submitter's key.
          BoardError: it cannot be written.
        """
        with self.transaction() as index:
            known = Seasons(index).entrant(signed.id)
            if known is not None:
                return known.number
            number = Seasons(index).next_number(signed.content.season)
            self.record("ticket", signed.id, signed)
        return number

    def end_ticket(
        self, season: str, number: int, result: SealedResult, not_before: str = ""
    ) -> bool:
        """Log the result of a ticket.

        Args:
          season: digest of the season.
          number: the ticket's.
          result: of this season and ticket.
          not_before: the ticket's deadline, unless its entrant has ended it.

        Returns:
          False if it has one.

        Raises:
          Rejection: `ticket_unknown`.
          BoardError: it cannot be written, or the clock has gone back to before the deadline.
        """
        with self.transaction():
            if self.clock.received() < not_before:
                raise BoardError(
                    f"ticket={number}: it is {self.clock.time}, and the ticket ends at "
                    f"{not_before}. Try again then."
                )
            return self._finish("ended", self.ticket(season, number), result)

    def rank(self, result: SealedResult) -> bool:
        """Log the result of an offline entry, after the reveal; False if it has one.

        Raises:
          Rejection: `season_not_closed` before the reveal.
          BoardError: no such entry exists, or the result cannot be written.
        """
        with self.transaction() as index:
            row = Seasons(index).entrant(result.subject)
            if row is None:
                raise BoardError(f"entry={result.subject}: is not on this board.")
            self.revealed_master(row.season)
            return self._finish("ranked", row, result)

    def reveal(self, reveal: Reveal) -> bool:
        """Publish the master of a season that is over.

        Returns:
          False if the same one was published.

        Raises:
          Rejection: `season_unknown`, `season_not_closed` while entries or tickets are accepted or
            a ticket runs, also of another season with this master, or `reveal_mismatch`.
          BoardError: it cannot be written.
        """
        with self.transaction():
            row = self.season_row(reveal.season)
            if row.reveal is not None and self.objects.document(Reveal, row.reveal) == reveal:
                return False
            self.record("revealed", row.digest, reveal)
        return True

    def revealed_master(self, name: str) -> Master:
        """The published master of the season of this id or digest.

        Raises:
          Rejection: `season_unknown`, or `season_not_closed` before the reveal.
          TamperedError: its file differs from the logged one.
        """
        row = self.season_row(name)
        if row.reveal is None:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: is not revealed yet. `sme-leaderboard season reveal` publishes "
                "its master after the close.",
            )
        reveal = self.objects.document(Reveal, row.reveal)
        return Master(bytes.fromhex(reveal.master))

    def entrants(self, season: str) -> list[SealedRow]:
        """The entries or tickets of a season, by its digest, in the log's order."""
        with self.reading() as index:
            return Seasons(index).entrants(season)

    def entrant(self, id: str) -> SealedRow | None:
        """The entry or ticket of this id; None if there is none."""
        with self.reading() as index:
            return Seasons(index).entrant(id)

    def ticket(self, season: str, number: int) -> SealedRow:
        """A ticket by its season's digest and its number.

        Raises:
          Rejection: `ticket_unknown`.
        """
        with self.reading() as index:
            row = Seasons(index).ticket(season, number)
        if row is None:
            raise Rejection(
                "ticket_unknown",
                f"ticket={number}: the season has no ticket of this number. Start one with "
                "`sme-leaderboard ticket`.",
            )
        return row

    def entry_of(self, row: SealedRow) -> Signed[Entry]:
        """An entry as it was signed; raises `TamperedError` if its file was altered."""
        return self.objects.document(Signed[Entry], row.document)

    def request_of(self, row: SealedRow) -> Signed[TicketRequest]:
        """A ticket's request as it was signed; raises `TamperedError` if its file was altered."""
        return self.objects.document(Signed[TicketRequest], row.document)

    def sealed_result(self, row: SealedRow) -> SealedResult | None:
        """The result of an entry or ticket; None if it has none.

        Raises:
          TamperedError: its file differs from the logged one.
        """
        return None if row.result is None else self.objects.document(SealedResult, row.result)

    def open_season(self, name: str, track: SealedTrack, key: str) -> SeasonRow:
        """The season of this id or digest, which must be of a track, and open to a key now.

        Raises:
          Rejection: `season_unknown`, `season_track`, `season_not_open`, `season_closed`,
            `season_revealed` or `not_admitted`.
        """
        with self.reading() as index:
            return Seasons(index).open(name, track, key, self.clock.time)

    def _finish(
        self, event: Literal["ended", "ranked"], row: SealedRow, result: SealedResult
    ) -> bool:
        """Log a result; False if there is one."""
        if (result.season, result.subject) != (row.season, row.entrant.id):
            raise ValueError(f"result of {result.subject} does not match {row.entrant.id}")
        if row.result is not None:
            return False
        self.record(event, row.entrant.id, result)
        return True

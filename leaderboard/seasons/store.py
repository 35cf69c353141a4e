"""`SeasonStore`: a board with seasons, whose tracks are seasons with entries and tickets.

What it has of them is a function of the log and of public documents, and holds nothing of a hidden
instance. What may change when follows from the time at which the log receives it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from leaderboard.documents.board import hex_of
from leaderboard.documents.result import EntryRow
from leaderboard.documents.signed import Signed
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.journal import played_bytes
from leaderboard.seasons.season import (
    Admitted,
    Entry,
    Master,
    Reveal,
    SealedManifest,
    SealedResult,
    SealedTrack,
    Season,
    TicketRequest,
)
from leaderboard.store import Store
from leaderboard.store.index import Kinds
from leaderboard.store.log import LogEntry

_Signed = TypeVar("_Signed", bound=Signed[SealedManifest])


class SeasonRow(NamedTuple):
    """One season of a board: its terms, and what the log has of it."""

    terms: Season
    digest: str  # of the terms
    sequence: int
    announced: str  # time of the log entry
    reveal: str | None  # SHA-256 of reveal.json; None until the reveal
    revealed: str  # when; empty likewise

    @property
    def id(self) -> str:
        return self.terms.id

    def state(self, time: str) -> str:
        if self.reveal is not None:
            return "revealed"
        if time < self.terms.opens:
            return "announced"
        return "open" if time < self.terms.closes else "closed"


@dataclass(frozen=True, kw_only=True)
class SealedRow(EntryRow):
    """An entry or a ticket, which started when it was received.

    Its `runs` are on hidden instances, and `policies` are answers.
    """

    track: str  # digest of its season
    number: int  # 1 for the first of its season, in the log's order
    created: str  # when it was signed, as the entrant says
    document: str  # SHA-256 of its file
    result: str | None  # SHA-256 of its result's file; None without one
    finished: str  # when it got its result; empty likewise

    @property
    def attempt(self) -> tuple[str, str]:
        """What it is of: a key, and the method's name in lower case."""
        return self.key, self.method.casefold()


class SeasonStore(Store):
    """A board with seasons, each by its digest; `name` is its id or digest."""

    @property
    def kinds(self) -> Kinds:
        return {
            "season": self._announced,
            "admitted": self._admitted,
            "entry": self._entered,
            "ticket": self._started,
            "ended": self._finished,
            "ranked": self._finished,
            "revealed": self._revealed,
        }

    def seasons(self) -> list[SeasonRow]:
        return self._rows("ORDER BY sequence")

    def _find(self, name: str) -> SeasonRow | None:
        return next(iter(self._rows("WHERE digest = ?1 OR id = ?1", name)), None)

    def _rows(self, which: str, *values: str) -> list[SeasonRow]:
        columns = "document, digest, sequence, announced, reveal, revealed"
        return [
            SeasonRow(self.objects.document(Season, document), *facts)
            for document, *facts in self.query(f"SELECT {columns} FROM track {which}", *values)
        ]

    def season_row(self, name: str) -> SeasonRow:
        row = self._find(name)
        if row is None:
            raise Rejection(
                "season_unknown",
                f"season={name[:80]}: is not on this board. `sme-leaderboard season show` lists "
                "its seasons.",
            )
        return row

    def season_of_track(self, name: str, track: SealedTrack) -> SeasonRow:
        row = self.season_row(name)
        if row.terms.track != track:
            raise Rejection(
                "season_track",
                f"season={row.id}: its track is {row.terms.track}: must be {track}. Offline "
                "seasons take entries, online ones start tickets.",
            )
        return row

    def season(self, name: str) -> Season:
        return self.season_row(name).terms

    def season_folder(self, digest: str) -> Path:
        """`published` has data sets and challenge states, `tickets` what was played."""
        return self.folder.seasons / hex_of(digest)

    def admitted(self, season: str) -> dict[str, str]:
        """The names of the admitted keys of a season, by its digest."""
        return dict(self.query("SELECT key, name FROM admitted WHERE track = ?", season))

    def entrants(self, season: str) -> list[SealedRow]:
        return self._sealed("track = ?", season)

    def entrant(self, id: str) -> SealedRow | None:
        return next(iter(self._sealed("id = ? AND track <> ''", id)), None)

    def ticket(self, season: str, number: int) -> SealedRow:
        rows = self._sealed("track = ? AND number = ?", season, number)
        if not rows:
            raise Rejection(
                "ticket_unknown",
                f"ticket={number}: the season has no ticket of this number. Start one with "
                "`sme-leaderboard ticket`.",
            )
        return rows[0]

    def _sealed(self, where: str, *values: Any) -> list[SealedRow]:
        with self.reading() as index:
            return list(index.entrants(SealedRow, where, *values))

    def _next_number(self, season: str) -> int:
        [(number,)] = self.query("SELECT count(*) + 1 FROM entry WHERE track = ?", season)
        return int(number)

    def ticket_folder(self, season: str, number: int) -> Path:
        return self.season_folder(season) / "tickets" / str(number)

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

    def announce(self, season: Season) -> bool:
        """False if the board already has it."""
        with self.transaction():
            row = self._find(season.id)
            if row is not None:
                if row.digest == season.digest:
                    return False
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
        """Add a key to a season's list, under the name that pages show; False if it is on it."""
        with self.transaction():
            row = self.season_row(season)
            admitted = Admitted.from_dict({"season": row.digest, "key": key, "name": name})
            if row.reveal is None and key in self.admitted(row.digest):
                return False
            self.record("admitted", row.digest, admitted)
        return True

    def add(self, signed: Signed[Entry] | Signed[TicketRequest]) -> tuple[int, bool]:
        """Add what was admitted to an open season: its number, and whether it is new."""
        with self.transaction():
            known = self.entrant(signed.id)
            if known is not None:
                return known.number, False
            number = self._next_number(signed.content.season)
            self.record(signed.content.PURPOSE, signed.id, signed)
        return number, True

    def finish(self, result: SealedResult, not_before: str = "") -> bool:
        """Log the result of an entry or ticket; False if it has one.

        `not_before` is a ticket's deadline, unless its entrant has ended it.
        """
        with self.transaction():
            row = self.entrant(result.subject)
            assert row is not None  # what was scored is on the board
            if self.clock.received() < not_before:
                raise BoardError(
                    f"ticket={row.number}: it is {self.clock.time}, and the ticket ends at "
                    f"{not_before}. Try again then."
                )
            if row.result is not None:
                return False
            online = self.season(row.track).track == "sealed-online"
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

    def _announced(self, entry: LogEntry) -> None:
        season = self._connected.read(Season, entry)
        entry.check_subject(season.digest)
        if self._find(season.digest) or self._find(season.id):
            raise entry.contradiction("announces a season twice")
        values = {
            "digest": entry.subject,
            "sequence": entry.sequence,
            "announced": entry.time,
            "document": entry.document,
            "id": season.id,
        }
        self._connected.insert("track", values)

    def _admitted(self, entry: LogEntry) -> None:
        admitted = self._connected.read(Admitted, entry)
        row = self._find(admitted.season)
        if row is None or entry.subject != row.digest:
            raise entry.contradiction("the season is unknown")
        if row.reveal is not None:
            raise _is_revealed(row)
        if admitted.key in self.admitted(row.digest):
            raise entry.contradiction("admits a key twice")
        self._connected.insert(
            "admitted", {"track": row.digest, "key": admitted.key, "name": admitted.name}
        )

    def _entered(self, entry: LogEntry) -> None:
        season, signed = self._signed(entry, "sealed-offline", Signed[Entry])
        answers = signed.content.answers
        count = season.terms.count
        if len(answers) != count:
            raise Rejection(
                "answer_missing",
                f"answers: has {len(answers)}: must have {count}, one for each instance of the "
                f"season {season.terms.id}, null where the method failed.",
            )
        given = [answer for answer in answers if answer is not None]
        self._add(entry, season, signed.content, len(given), 0)
        for answer in given:
            self._connected.name_artefact(answer, signed.content.submitter.key, entry)

    def _started(self, entry: LogEntry) -> None:
        row, signed = self._signed(entry, "sealed-online", Signed[TicketRequest])
        self._check_limits(row.terms, signed.content.submitter.key)
        self._add(entry, row, signed.content, row.terms.count, played_bytes(row.terms))

    def _signed(
        self, entry: LogEntry, track: SealedTrack, kind: type[_Signed]
    ) -> tuple[SeasonRow, _Signed]:
        signed = self._connected.read(kind, entry)
        entry.check_subject(signed.id)
        key = signed.content.submitter.key
        return self.open_season(signed.content.season, track, key, entry.time), signed

    def open_season(self, name: str, track: SealedTrack, key: str, time: str) -> SeasonRow:
        """The season of this id or digest; a `Rejection` unless it is open to a key at a time."""
        row = self.season_of_track(name, track)
        if row.reveal is not None:
            raise _is_revealed(row)
        terms = row.terms
        if time < terms.opens:
            raise Rejection(
                "season_not_open",
                f"season={row.id}: opens at {terms.opens}, and it is {time}. Come back then.",
            )
        if time >= terms.closes:
            raise Rejection("season_closed", f"season={row.id}: closed at {terms.closes}.")
        if terms.admission == "listed" and key not in self.admitted(row.digest):
            raise Rejection(
                "not_admitted",
                f"key={key[:16]}…: the organiser of the season {row.id} has not admitted it. Send "
                "the public key to the organiser, who adds it with `sme-leaderboard season admit`.",
            )
        return row

    def _check_limits(self, season: Season, key: str) -> None:
        assert season.tickets is not None  # the track is online
        assert season.tickets_per_key is not None
        mine = "SELECT count(*) FROM entry WHERE track = ? AND key = ?"
        [(own,)] = self.query(mine, season.digest, key)
        if own >= season.tickets_per_key:
            raise Rejection(
                "ticket_limit",
                f"key={key[:16]}…: has started {own} of {season.tickets_per_key} tickets of "
                f"the season {season.id}. Every one of them counts.",
            )
        if self._next_number(season.digest) > season.tickets:
            raise Rejection(
                "ticket_limit",
                f"season={season.id}: all of its {season.tickets} tickets were started. Ask the "
                "board's owner for another season.",
            )

    def _add(
        self, entry: LogEntry, row: SeasonRow, manifest: SealedManifest, policies: int, played: int
    ) -> None:
        key, name = manifest.submitter.key, manifest.submitter.name
        self._connected.add_entrant(
            entry,
            manifest,
            track=row.digest,
            number=self._next_number(row.digest),
            created=manifest.created,
            submitter=self.admitted(row.digest).get(key, name),
            runs=row.terms.count,
            policies=policies,
            reserved=played,
        )

    def _finished(self, entry: LogEntry) -> None:
        row = self.entrant(entry.subject)
        if row is None or row.result is not None:
            raise entry.contradiction("the entry or ticket is unknown, or has a result")
        season = self.season_row(row.track)
        online, count = season.terms.track == "sealed-online", season.terms.count
        if online != (entry.event == "ended") or not (online or season.reveal):
            raise entry.contradiction("of another track, or before the reveal")
        result = self._connected.read(SealedResult, entry)
        entry.check_subject(result.subject)
        sizes = len(result.runs), len(result.stepping)
        if result.season != row.track or sizes != (count, count * online):
            raise entry.contradiction("names a result of another season")
        self._connected.connection.execute(
            "UPDATE entry SET status = 'scored', result = ?, finished = ?, policies = ?, "
            "steps = ?, oracle_like = ?, scores = ?, reserved = ? WHERE id = ?",
            (
                *(entry.document, entry.time),
                sum(run.artefact is not None for run in result.runs),
                sum(each.steps for each in result.stepping),
                *(result.oracle_like, result.scores.to_text()),
                played_bytes(season.terms, result) if online else 0,
                entry.subject,
            ),
        )

    def _revealed(self, entry: LogEntry) -> None:
        row = self._find(entry.subject)
        if row is None or row.digest != entry.subject:
            raise entry.contradiction("the season is unknown")
        reveal = self._connected.read(Reveal, entry)
        entry.check_subject(reveal.season)
        master = Master(bytes.fromhex(reveal.master))
        if not row.terms.is_committed_to(master):
            raise Rejection(
                "reveal_mismatch",
                f"master: does not match the commitment of the season {row.id}. Give the file "
                "that `sme-leaderboard season new` wrote.",
            )
        if row.reveal is not None:
            raise entry.contradiction("the season is already revealed")
        for other in self.seasons():  # whose tasks may follow from the same secret
            if other.reveal is None and other.terms.is_committed_to(master):
                self._check_over(other, entry.time)
        self._connected.connection.execute(
            "UPDATE track SET reveal = ?, revealed = ? WHERE digest = ?",
            (entry.document, entry.time, entry.subject),
        )

    def check_closed(self, row: SeasonRow, time: str) -> None:
        if time < row.terms.closes:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: closes at {row.terms.closes}, and it is {time}. Its tasks stay "
                "secret until then.",
            )

    def _check_over(self, row: SeasonRow, time: str) -> None:
        """Reject (`season_not_closed`) a reveal while entrants can still play."""
        self.check_closed(row, time)
        running = [each.number for each in self.entrants(row.digest) if each.result is None]
        if row.terms.track == "sealed-online" and running:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: {len(running)} tickets run, the first of them number "
                f"{running[0]}. Serve the board until their deadlines have passed.",
            )


def _is_revealed(row: SeasonRow) -> Rejection:
    return Rejection("season_revealed", f"season={row.id}: its tasks are public now.")

"""What log entries of seasons do to the index: its tracks are seasons, with entries and tickets.

Its rows are a function of the log and of public documents, and hold nothing of a hidden instance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from leaderboard.documents.result import Scores
from leaderboard.documents.signed import Signed
from leaderboard.errors import Rejection
from leaderboard.seasons.season import (
    MAX_LANES,
    Admitted,
    Entry,
    Master,
    Reveal,
    SealedManifest,
    SealedResult,
    SealedTrack,
    Season,
    TicketRequest,
    rows_of,
)
from leaderboard.store.index import KINDS, Index, Kinds
from leaderboard.store.log import LogEntry
from leaderboard.store.rows import EntryRow
from sme_registry.seasons.transcript import EVERY
from sme_registry.seasons.wire import table_bytes

_Signed = TypeVar("_Signed", bound=Signed[SealedManifest])
_RECORD_BYTES, _HEAD_BYTES = 12, 4096  # of a journal; heads with the signature's file
_SNAPSHOT_BYTES, _NUMBERS_OF_A_LANE = 2**14, 40  # of a snapshot; bytes of a lane, for each channel


def played_bytes(season: Season, result: SealedResult | None = None) -> int:
    """The most bytes that the journals, challenges, answers and snapshots of a ticket take.

    A journal is longest where a single lane is stepped: then each step has a record of its own.
    After the ticket's result nothing more is written.
    """
    total = 0
    rows = rows_of(season.protocol)
    for number, (member, _) in enumerate(season.hidden):
        S, A = member.setting.state_dim, member.setting.action_dim
        steps, answered = member.budget or 0, True
        if result is not None:  # what was not signed may be in the journal, too
            steps = min(steps, result.stepping[number].steps + EVERY * MAX_LANES)
            answered = result.runs[number].artefact is not None
        total += steps * (_RECORD_BYTES + 4 * A) + table_bytes(rows, S + 2) + _HEAD_BYTES
        total += 4 * MAX_LANES * A  # the record that ends a journal
        total += table_bytes(rows, A) * answered
        if result is None:
            total += _SNAPSHOT_BYTES + MAX_LANES * _NUMBERS_OF_A_LANE * (S + A + 4)
    return total


class SeasonRow(NamedTuple):
    """One season, as pages need it."""

    digest: str  # of season.json's content
    sequence: int
    announced: str  # time of the log entry
    document: str  # SHA-256 of season.json
    id: str
    title: str
    track: SealedTrack
    opens: str
    closes: str
    instances: int  # number of hidden ones, of each ticket or of all entries
    reveal: str | None  # SHA-256 of reveal.json; None until the reveal
    revealed: str  # when; empty likewise

    def state(self, time: str) -> str:
        """What it is at a time: announced, open, closed or revealed."""
        if self.reveal is not None:
            return "revealed"
        return "announced" if time < self.opens else "open" if time < self.closes else "closed"


@dataclass(frozen=True)
class SealedRow:
    """One entry or ticket.

    Of its `entrant`, `received` is when the ticket started, `runs` the number of hidden instances,
    and `policies` that of answers. `enough_runs` is false: `scoring` counts them over all tickets
    of a method.
    """

    season: str  # digest
    number: int  # 1 for the first of its season, in the log's order
    created: str  # when it was signed, as the entrant says
    document: str  # SHA-256 of its file
    result: str | None  # SHA-256 of its result's file; None without one
    finished: str  # when it got its result; empty likewise
    entrant: EntryRow

    @property
    def method(self) -> tuple[str, str]:
        """What it is of: a key, and the method's name in lower case."""
        return self.entrant.key, self.entrant.method.casefold()


class Seasons:
    """The seasons of a board's index."""

    def __init__(self, index: Index) -> None:
        self._index = index

    def rows(self) -> list[SeasonRow]:
        return [SeasonRow(*row) for row in self._all(f"{_SEASONS} ORDER BY sequence")]

    def row(self, name: str) -> SeasonRow | None:
        rows = self._all(f"{_SEASONS} WHERE digest = ?1 OR id = ?1", name)
        return SeasonRow(*rows[0]) if rows else None

    def entrants(self, season: str) -> list[SealedRow]:
        return [
            _sealed(row) for row in self._all(f"{_SEALED} WHERE track = ? ORDER BY number", season)
        ]

    def entrant(self, id: str) -> SealedRow | None:
        rows = self._all(f"{_SEALED} WHERE id = ? AND track <> ''", id)
        return _sealed(rows[0]) if rows else None

    def ticket(self, season: str, number: int) -> SealedRow | None:
        rows = self._all(f"{_SEALED} WHERE track = ? AND number = ?", season, number)
        return _sealed(rows[0]) if rows else None

    def next_number(self, season: str) -> int:
        [(number,)] = self._all("SELECT count(*) + 1 FROM entry WHERE track = ?", season)
        return int(number)

    def read(self, row: SeasonRow) -> Season:
        return self._index.objects.document(Season, row.document)

    def _season(self, entry: LogEntry) -> None:
        season = self._index.read(Season, entry)
        entry.check_subject(season.digest)
        if self.row(season.digest) is not None or self.row(season.id) is not None:
            raise entry.contradiction("announces a season twice")
        values = {
            "digest": entry.subject,
            "sequence": entry.sequence,
            "announced": entry.time,
            "document": entry.document,
            "id": season.id,
            "title": season.title,
            "kind": season.track,
            "opens": season.opens,
            "closes": season.closes,
            "instances": sum(1 for _ in season.hidden),
        }
        self._index.insert("track", values)

    def _admitted(self, entry: LogEntry) -> None:
        admitted = self._index.read(Admitted, entry)
        row = self.row(admitted.season)
        if row is None or row.reveal is not None or entry.subject != row.digest:
            raise entry.contradiction("the season is unknown or revealed")
        if admitted.key in self.admitted(row.digest):
            raise entry.contradiction("admits a key twice")
        self._index.insert(
            "admitted", {"track": row.digest, "key": admitted.key, "name": admitted.name}
        )

    def admitted(self, season: str) -> dict[str, str]:
        """The names of the keys that the organiser has admitted to a season, by its digest."""
        return dict(self._all("SELECT key, name FROM admitted WHERE track = ?", season))

    def _entry(self, entry: LogEntry) -> None:
        season, signed = self._signed(entry, "sealed-offline", Signed[Entry])
        answers = signed.content.answers
        if len(answers) != season.instances:
            raise entry.contradiction("names more or fewer answers than there are instances")
        given = [answer for answer in answers if answer is not None]
        self._add(entry, season, signed, policies=len(given), played=0)
        for answer in given:
            self._index.name_artefact(answer, signed.content.submitter.key, entry)

    def _ticket(self, entry: LogEntry) -> None:
        row, signed = self._signed(entry, "sealed-online", Signed[TicketRequest])
        season = self.read(row)
        self._check_limits(season, signed.content.submitter.key)
        self._add(entry, row, signed, policies=row.instances, played=played_bytes(season))

    def _signed(
        self, entry: LogEntry, track: SealedTrack, kind: type[_Signed]
    ) -> tuple[SeasonRow, _Signed]:
        """The document that an entry names, and its season, which is open."""
        signed = self._index.read(kind, entry)
        entry.check_subject(signed.id)
        key = signed.content.submitter.key
        return self.open(signed.content.season, track, key, entry.time), signed

    def open(self, name: str, track: SealedTrack, key: str, time: str) -> SeasonRow:
        """The season of this id or digest, which must be of a track, and open to a key at a time.

        A `Rejection` is `season_unknown`, `season_track`, `season_not_open`, `season_closed`,
        `season_revealed` or `not_admitted`.
        """
        row = self.row(name)
        if row is None:
            raise unknown_season(name)
        if row.track != track:
            raise Rejection(
                "season_track",
                f"season={row.id}: its track is {row.track}: must be {track}. Offline seasons take "
                "entries, online ones start tickets.",
            )
        if row.reveal is not None:
            raise Rejection("season_revealed", f"season={row.id}: its tasks are public now.")
        if time < row.opens:
            raise Rejection(
                "season_not_open",
                f"season={row.id}: opens at {row.opens}, and it is {time}. Come back then.",
            )
        if time >= row.closes:
            raise Rejection("season_closed", f"season={row.id}: closed at {row.closes}.")
        if self.read(row).admission == "listed" and key not in self.admitted(row.digest):
            raise Rejection(
                "not_admitted",
                f"key={key[:16]}…: the organiser of the season {row.id} has not admitted it. Send "
                "the public key to the organiser, who adds it with `sme-leaderboard season admit`.",
            )
        return row

    def _check_limits(self, season: Season, key: str) -> None:
        """Reject (`ticket_limit`) one more ticket than a key, or all keys, may start."""
        assert season.tickets is not None  # the track is online
        assert season.tickets_per_key is not None
        own = self._index.number(
            "SELECT count(*) FROM entry WHERE track = ? AND key = ?", season.digest, key
        )
        if own >= season.tickets_per_key:
            raise Rejection(
                "ticket_limit",
                f"key={key[:16]}…: has started {own} of {season.tickets_per_key} tickets of "
                f"the season {season.id}. Every one of them counts.",
            )
        if self.next_number(season.digest) > season.tickets:
            raise Rejection(
                "ticket_limit",
                f"season={season.id}: all of its {season.tickets} tickets were started. Ask the "
                "board's owner for another season.",
            )

    def _add(
        self,
        entry: LogEntry,
        season: SeasonRow,
        signed: Signed[SealedManifest],
        *,
        policies: int,
        played: int,
    ) -> None:
        key, name = signed.content.submitter.key, signed.content.submitter.name
        self._index.add_entrant(
            entry,
            signed.content,
            status="entered",
            track=season.digest,
            number=self.next_number(season.digest),
            created=signed.content.created,
            submitter=self.admitted(season.digest).get(key, name),
            runs=season.instances,
            policies=policies,
            reserved=played,
        )

    def _result(self, entry: LogEntry) -> None:
        row = self.entrant(entry.subject)
        season = None if row is None else self.row(row.season)
        if row is None or season is None or row.result is not None:
            raise entry.contradiction("the entry or ticket is unknown, or has a result")
        online = season.track == "sealed-online"
        if online != (entry.event == "ended") or not (online or season.reveal):
            raise entry.contradiction("of another track, or before the reveal")
        result = self._index.read(SealedResult, entry)
        entry.check_subject(result.subject)
        sizes = len(result.runs), len(result.stepping)
        if result.season != row.season or sizes != (season.instances, season.instances * online):
            raise entry.contradiction("names a result of another season")
        self._index.connection.execute(
            "UPDATE entry SET status = 'scored', result = ?, finished = ?, policies = ?, "
            "steps = ?, oracle_like = ?, scores = ?, reserved = ? WHERE id = ?",
            (
                *(entry.document, entry.time),
                sum(run.artefact is not None for run in result.runs),
                sum(each.steps for each in result.stepping),
                *(result.oracle_like, result.scores.to_text()),
                played_bytes(self.read(season), result) if online else 0,
                entry.subject,
            ),
        )

    def _revealed(self, entry: LogEntry) -> None:
        row = self.row(entry.subject)
        if row is None or row.digest != entry.subject:
            raise entry.contradiction("the season is unknown")
        reveal = self._index.read(Reveal, entry)
        entry.check_subject(reveal.season)
        master = Master(bytes.fromhex(reveal.master))
        if not self.read(row).is_committed_to(master):
            raise Rejection(
                "reveal_mismatch",
                f"master: does not match the commitment of the season {row.id}. Give the file "
                "that `sme-leaderboard season new` wrote.",
            )
        if row.reveal is not None:
            raise entry.contradiction("the season is already revealed")
        for other in self.rows():  # whose tasks may follow from the same secret
            if other.reveal is None and self.read(other).is_committed_to(master):
                self._check_over(other, entry.time)
        self._index.connection.execute(
            "UPDATE track SET reveal = ?, revealed = ? WHERE digest = ?",
            (entry.document, entry.time, entry.subject),
        )

    def _check_over(self, row: SeasonRow, time: str) -> None:
        """Reject (`season_not_closed`) a reveal while entrants can still play."""
        if time < row.closes:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: closes at {row.closes}, and it is {time}. Its tasks stay secret "
                "until then.",
            )
        running = [each.number for each in self.entrants(row.digest) if each.result is None]
        if row.track == "sealed-online" and running:
            raise Rejection(
                "season_not_closed",
                f"season={row.id}: {len(running)} tickets run, the first of them number "
                f"{running[0]}. Serve the board until their deadlines have passed.",
            )

    def _all(self, statement: str, *values: Any) -> list[tuple[Any, ...]]:
        return self._index.connection.execute(statement, values).fetchall()


def unknown_season(name: str) -> Rejection:
    """The rejection of an id or digest that no season of the board has."""
    return Rejection(
        "season_unknown",
        f"season={name[:80]}: is not on this board. `sme-leaderboard season show` lists its "
        "seasons.",
    )


_OF_SEASONS = {
    "season": Seasons._season,
    "admitted": Seasons._admitted,
    "entry": Seasons._entry,
    "ticket": Seasons._ticket,
    "ended": Seasons._result,
    "ranked": Seasons._result,
    "revealed": Seasons._revealed,
}


def _apply(index: Index, entry: LogEntry) -> None:
    _OF_SEASONS[entry.event](Seasons(index), entry)


SEASON_KINDS: Kinds = {**KINDS, **dict.fromkeys(_OF_SEASONS, _apply)}
"""Of log entries, those of seasons, too."""

_SEASONS = (
    "SELECT digest, sequence, announced, document, id, title, kind, opens, closes, instances, "
    "reveal, revealed FROM track"
)
_OF_ENTRANT = (
    *("id", "sequence", "received", "method", "version", "family", "knowledge", "submitter", "key"),
    *("code_link", "runs", "steps", "policies", "oracle_like", "scores"),
)
_SEALED = (
    f"SELECT track, number, created, document, result, finished, {', '.join(_OF_ENTRANT)} "
    "FROM entry"
)


def _sealed(row: tuple[Any, ...]) -> SealedRow:
    season, number, created, document, result, finished, *rest = row
    values = dict(zip(_OF_ENTRANT, rest, strict=True))
    scores = values.pop("scores")
    entrant = EntryRow(
        **{**values, "oracle_like": bool(values["oracle_like"])},
        status="waiting" if scores is None else "scored",
        code="",
        enough_runs=False,
        reference=False,
        scores=None if scores is None else Scores.from_text(scores),
    )
    return SealedRow(season, number, created, document, result, finished, entrant)

"""`verify_seasons`: what follows from the terms and the master of each season, scored again.

Opening the board has checked each document against the log, and each master against its commitment.
What is left are the signatures, the terms, and after the reveal data sets, challenge states and
scores: of offline entries from their answers, of tickets from what was played, which the entrants
signed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from leaderboard.documents.result import RunScore
from leaderboard.errors import TamperedError
from leaderboard.scoring.aggregation import failed_run
from leaderboard.scoring.verify import (
    RESCORED,
    Difference,
    Note,
    Progress,
    Row,
    compared,
    contradiction,
    difference,
    other_versions,
    refuse_contradiction,
    with_metrics,
)
from leaderboard.seasons.events import SealedRow, SeasonRow
from leaderboard.seasons.publication import check_published, follows, read_season
from leaderboard.seasons.scoring import counting, instances, scored_entries, sealed_result
from leaderboard.seasons.season import Master, SealedResult, Season
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import Ticket, deadline, score_ticket


def verify_seasons(
    store: SeasonStore, progress: Progress, published: Sequence[str | Path] = ()
) -> tuple[list[Row], list[Note]]:
    """Verify all seasons of a board, whose log was followed.

    `published` are folders as `season new` wrote them, of seasons whose board has no copy. A
    `TamperedError` names the first entry, ticket or value that does not follow, a `BoardError` a
    published file that differs from its digest.
    """
    folders = {read_season(folder).digest: Path(folder) for folder in published}
    rows, notes = [], []
    for row in store.seasons():
        verifier = _SeasonVerifier(store, row, progress, folders)
        verifier.check()
        rows += verifier.rows
        notes += verifier.notes
    return rows, notes


@dataclass
class _SeasonVerifier:
    """The checks of one season, and what they have found."""

    store: SeasonStore
    of: SeasonRow
    progress: Progress
    folders: Mapping[str, Path]
    rows: list[Row] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.season: Season = self.store.season(self.of.digest)
        self.entrants = self.store.entrants(self.of.digest)
        self.is_online = self.season.track == "sealed-online"

    def check(self) -> None:
        self.check_ends()
        for row in self.entrants:
            self.check_signature(row)
        self.report("signatures of entrants", len(self.entrants))
        for result in filter(None, map(self.store.sealed_result, self.entrants)):
            refuse_contradiction(self.contradiction(result), self.name(result.subject))
        if self.of.reveal is None:
            self.check_published()
            count = len(self.entrants)
            self.report("results, scored again", 0, count, "not yet revealed" * bool(count))
            return
        master = self.store.revealed_master(self.of.digest)
        self.generate_again(master)
        self.score_again(master)

    def report(self, what: str, checked: int, unchecked: int = 0, why: str = "") -> None:
        self.rows.append(Row(f"{self.of.id}: {what}", checked, unchecked, why))

    def name(self, subject: str) -> str:
        """What to call an entry or ticket, by its id."""
        return f"{self.of.id}, {subject}"

    def check_signature(self, row: SealedRow) -> None:
        """Check an entrant's signature, which the board's own key cannot forge."""
        signed = self.store.request_of(row) if self.is_online else self.store.entry_of(row)
        if not signed.is_valid(self.store.document.key):
            self.refuse(row, "its signature does not match the entrant's key")

    def check_ends(self) -> None:
        """Check that no ticket ended early; all else that is forbidden no log can have."""
        for row in self.entrants if self.is_online else ():
            if row.result is not None and row.entrant.policies < row.entrant.runs:
                self.refuse_early(row, "without all answers")

    def refuse_early(self, row: SealedRow, lack: str) -> None:
        """Refuse a ticket that ended before its deadline, though something is lacking."""
        end = deadline(self.season, row)
        if row.finished < end:
            self.refuse(
                row, f"ended at {row.finished}, {lack}: must not be before {end}, its deadline"
            )

    def published(self) -> Path | None:
        copy = self.store.season_folder(self.of.digest) / "published"
        return copy if copy.is_dir() else self.folders.get(self.of.digest)

    def check_published(self) -> None:
        """Before the reveal: check the published files against their digests."""
        count, folder = len(self.season.published), self.published()
        if folder is None:
            self.report("data sets", 0, count, "not in this folder" * bool(count))
            return
        self.report("data sets, by their digests", check_published(self.season, folder))

    def generate_again(self, master: Master) -> None:
        if not self.season.published:
            return
        outcomes: Counter[str] = Counter()
        for instance, expected in zip(
            instances(self.season, master), self.season.published, strict=True
        ):
            outcome = follows(instance, master, expected, self.published())
            if outcome == "no":
                where = f"{self.of.id}: published {expected.class_name} {expected.instance}"
                message = "its data set or challenge states do not follow from the master"
                raise TamperedError(where, message)
            outcomes[outcome] += 1
            self.progress(f"{expected.class_name} {expected.instance}")
        why = "this processor rounds otherwise, and the published arrays are not here"
        unknown, rounded = outcomes["unknown"], outcomes["within rounding"]
        self.report("data sets", outcomes["exactly"], unknown, why * bool(unknown))
        if rounded:
            self.report("data sets, within 1e-6", rounded, 0, "this processor rounds otherwise")

    def score_again(self, master: Master) -> None:
        counted = counting(self.store, self.season)
        scored = [row for row in self.entrants if row.result is not None]
        for row in scored:
            if row not in counted:
                self.refuse(row, "has a result, and does not count")
        whole, others = [row for row in scored if self.has_answers(row)], Counter[str]()
        for row, again in zip(whole, self.scored(master, whole), strict=True):
            recorded = self.store.sealed_result(row)
            assert recorded is not None
            found = difference(compared(recorded), compared(again), RESCORED)
            if found is not None:
                self.notes.append(Note(self.name(row.entrant.id), found))
            others.update(other_versions(recorded.versions, again.versions))
            self.progress(row.entrant.id)
        left = sum(row.result is None for row in counted)
        reasons = (
            (left, "not scored yet: repeat `sme-leaderboard season reveal`"),
            (len(scored) - len(whole), "their answers are not here"),
        )
        why = "; ".join(f"{number} {reason}" for number, reason in reasons if number)
        count = len(whole)
        self.report("results, scored again", count, left + len(scored) - count, why)
        for other, number in others.items():
            self.report("results of other versions", number, 0, other)

    def has_answers(self, row: SealedRow) -> bool:
        """Whether the answers of an offline entry are here; those of a ticket lie beside it."""
        if self.is_online:
            return True
        answers = self.store.entry_of(row).content.answers
        return all(each is None or self.store.objects.has(each.sha256) for each in answers)

    def scored(self, master: Master, rows: Sequence[SealedRow]) -> Iterator[SealedResult]:
        if not self.is_online:
            yield from scored_entries(self.store, self.season, master, rows)
            return
        for row in rows:
            ticket = Ticket(self.store, self.season, master, row)
            if not ticket.is_ended:
                self.refuse_early(row, "without the entrant's end")
            yield score_ticket(self.store, self.season, ticket, replay=True)

    def contradiction(self, result: SealedResult) -> Difference | None:
        """The first value of a result that does not follow from the regrets of its runs."""
        board, season, runs = self.store.document, self.season, []
        hidden = list(season.hidden)
        if len(result.runs) != len(hidden):
            return Difference("runs", str(len(result.runs)), str(len(hidden)))
        for number, (run, place) in enumerate(zip(result.runs, hidden, strict=True)):
            name = place.member.name
            expected: RunScore | None = failed_run(season.protocol, name, None)
            if run.artefact is not None:
                expected = with_metrics(run, season.protocol, board.rules)
            if expected is None:
                return Difference(f"runs.{number}", "other regions", "those of the protocol")
            runs.append(expected.model_copy(update={"class_name": name}))
        rest = result.versions, board.draws, result.stepping, board.rules
        again = sealed_result(season, result.subject, runs, *rest)
        return contradiction(result, again.model_copy(update={"signed": result.signed}))

    def refuse(self, row: SealedRow, message: str) -> NoReturn:
        kind = "ticket" if self.is_online else "entry"
        raise TamperedError(f"{self.of.id}: {kind} {row.number} ({row.entrant.id})", message)

"""`verify`: check a board's files against its signed log, and its numbers against its runs.

The order decides which altered row is named first: the log's chain and signatures, the document of
each entry, files that the log does not name, the index, the submitters' signatures, the artefacts
and the numbers.

Entries cut off the log's end leave no trace in it, and neither does a log that the board itself
has rewritten and signed. Both show if an entry's digest was kept elsewhere: `contains`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn

from leaderboard.documents.board import BoardDocument, Folder, hex_of
from leaderboard.documents.result import Result, RunScore
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import Submission, Withdrawal
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.aggregation import (
    failed_run,
    levels_of,
    never_listed,
    result_of,
    run_metrics,
)
from leaderboard.scoring.rescore import RESCORED, RescoreNote, draw, rescore
from leaderboard.scoring.score import Progress, agent_names, evaluation_seed
from leaderboard.seasons.verify import check_sealed_signatures, count_unlogged_of_seasons
from leaderboard.store import (
    Index,
    IndexUnusable,
    Log,
    LogEntry,
    Objects,
    Store,
    digest_of,
    read_document,
)
from sme_registry.errors import OptionError
from sme_registry.io import TEMPORARY, integer_in

EXACT = 1e-9
"""Tolerance for numbers recomputed from the same runs: another machine may sum in another order."""


# An index that is larger than its log can explain is not copied into memory.
_INDEX_BYTES, _INDEX_BYTES_OF_ENTRY = 2**26, 2**17


@dataclass(frozen=True)
class VerifyReport:
    """What was verified.

    Attributes:
      entries: number of log entries.
      log_sequence, log_digest: of the last entry. Keep the digest elsewhere to detect later
        whether the log was cut or rewritten.
      submissions, withdrawals, results, objects: number of each.
      unlogged: number of submissions and withdrawals, and of documents of seasons, whose process
        died before it logged them; the board does not show them.
      seasons, sealed: number of seasons, and of their entries and tickets.
      rows: number of index rows, equal to those of a rebuilt index; 0 if there is no index.
      rescored: number of submissions scored again.
      rescore_seed: of their draw, which repeats it; None if none was scored again.
      tolerance: of their new numbers, where no note states a larger one.
      notes: differences that prove no tampering.
    """

    entries: int
    log_sequence: int
    log_digest: str
    submissions: int
    withdrawals: int
    results: int
    objects: int
    unlogged: int
    rows: int
    rescored: int = 0
    rescore_seed: int | None = None
    tolerance: float = RESCORED
    seasons: int = 0
    sealed: int = 0
    notes: tuple[RescoreNote, ...] = ()


def verify(
    path: str | Path,
    *,
    rescore: int | Literal["all"] = 0,
    seed: int | None = None,
    contains: str | None = None,
    progress: Progress | None = None,
) -> VerifyReport:
    """Verify everything about a board without writing anything.

    Args:
      path: the board's folder.
      rescore: number of results, drawn at random, whose submissions to score again; or "all".
      seed: of that draw, to repeat one; None for the system's randomness, which nobody predicts.
      contains: digest of an entry that the log once had; None to skip this check.
      progress: called with the rows done and the rows in all.

    Returns:
      The counts.

    Raises:
      TamperedError: names the first altered row, such as `results/….json`.
      BoardError: the folder holds no board.
      ScoringFault: this machine cannot score a submission again.
      OptionError: `rescore` or `seed` is negative, or `contains` is not a digest.
    """
    if rescore != "all":
        integer_in("rescore", rescore, 0, advice="Leave it out for none.")
    seed = secrets.randbits(53) if seed is None else integer_in("seed", seed, 0)
    digest = None if contains is None else _entry_digest(contains)
    folder = Folder(path)
    folder.read()
    document = read_document(folder, folder.board, BoardDocument)
    with contextlib.closing(Index.empty(folder, document)) as index:
        verifier = _Verifier(index, rescore, progress)
        verifier.check_opening()
        verifier.follow_log()
        with Store.open(path, read_only=True) as store:
            with store.locked():
                verifier.follow_log()  # entries logged in the meantime
                verifier.check_numbering()
                verifier.check_contains(digest)
                unlogged = verifier.count_unlogged() + count_unlogged_of_seasons(index)
                rows = verifier.check_index()
            verifier.check_signatures()
            seasons, entrants = check_sealed_signatures(index)
            objects = verifier.check_objects()
            results = verifier.check_numbers(store)
            drawn = draw(verifier.scored_ids(), rescore, seed)
            notes = [note for id in drawn for note in verifier.rescore(store, id)]
        entries, head = index.entries(), index.head
    return VerifyReport(
        entries=head.sequence + 1,
        log_sequence=head.sequence,
        log_digest=head.digest,
        submissions=len(entries),
        withdrawals=sum(entry.status == "withdrawn" for entry in entries),
        results=results,
        objects=objects,
        unlogged=unlogged,
        rows=rows,
        rescored=len(drawn),
        rescore_seed=seed if drawn else None,
        seasons=seasons,
        sealed=entrants,
        notes=tuple(notes),
    )


def _entry_digest(text: str) -> str:
    try:
        return f"sha256:{hex_of(text)}"
    except ValueError:
        raise OptionError(
            f"contains={text!r:.90}: must be 'sha256:' and 64 hex digits. Copy it from the earlier "
            "output of `sme-leaderboard verify` or from the board's log page."
        ) from None


class _Verifier:
    """The checks of one board; `follow_log` fills its empty index from the log."""

    def __init__(
        self, index: Index, rescore: int | Literal["all"], progress: Progress | None
    ) -> None:
        self.index = index
        self.folder, self.document = index.folder, index.document
        self.log = Log(self.folder, self.document.key)
        self.objects = Objects(self.folder)
        self.digests: set[str] = set()
        self._progress = progress
        self._done = 0
        results = len(_names(self.folder.results))
        self._total = sum(1 for _ in self.objects.paths()) + len(_names(self.folder.log)) + results
        self._total += results if rescore == "all" else min(rescore, results)

    def count_row(self) -> None:
        """Report one more row as done; the total is an estimate."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, max(self._done, self._total))

    def check_opening(self) -> None:
        """Check that the log is this board's, so that board.json is named if it is not."""
        if not self.log.has(0):
            raise TamperedError("log/00000000.json", "is missing; every log starts with it")
        first = read_document(self.folder, self.folder.log_entry(0), LogEntry)
        if first.document != digest_of(self.document):
            raise TamperedError("board.json", "differs from the board that the log opened")
        key = self.folder.key
        if key.exists() and self.folder.signing_key().public != self.document.key:
            raise TamperedError("board.key", "is not the key in board.json")

    def follow_log(self) -> None:
        """Check chain, signatures and documents, from the index's last entry to the log's end."""
        head = self.index.head
        while self.log.has(head.sequence + 1):
            entry = self.log.read_after(head)
            self.index.apply(entry)
            head = entry.head
            self.digests.add(head.digest)
            self.count_row()

    def check_numbering(self) -> None:
        """Check that the log's folder has no gap and no other files."""
        following = self.index.head.sequence + 1
        for name in _names(self.folder.log):
            if not re.fullmatch(r"[0-9]{8,}\.json", name):
                raise TamperedError(f"log/{name}", "is not a log entry")
            if int(name[:-5]) >= following:
                self._refuse(
                    self.folder.log_entry(following), "is missing, but later entries exist"
                )

    def check_contains(self, digest: str | None) -> None:
        """Check that the log has the entry with this digest."""
        if digest is not None and digest not in self.digests:
            raise TamperedError(
                "log",
                f"has no entry with the digest {digest}. If it was an entry of this board, the log "
                "was cut or rewritten since",
            )

    def count_unlogged(self) -> int:
        """Check that no file passes for a logged one; count those about to be logged."""
        unlogged = 0
        for part, column in (
            (self.folder.submissions, "document"),
            (self.folder.withdrawals, "withdrawal"),
            (self.folder.results, "result"),
        ):
            for name in _names(part):
                where = f"{part.name}/{name}"
                if not re.fullmatch(r"[0-9a-f]{64}\.json", name):
                    raise TamperedError(where, "is not a file of a board")
                id = f"sha256:{name[:64]}"
                if self.index.one(f"SELECT 1 FROM entry WHERE id = ? AND {column} IS NOT NULL", id):
                    continue
                if column == "result":
                    raise TamperedError(
                        where,
                        "is in no log entry. If a scorer was killed while writing it, opening the "
                        "board for writing removes it, as `sme-leaderboard score` does",
                    )
                if column == "document" and self._submission(id).id != id:
                    raise TamperedError(where, "holds another submission than its name says")
                unlogged += 1
        return unlogged

    def check_index(self) -> int:
        """Compare the board's index with the rebuilt one, row by row; returns the rows."""
        try:
            limit = _INDEX_BYTES + _INDEX_BYTES_OF_ENTRY * (self.index.head.sequence + 1)
            index = Index.open(self.folder, self.document, in_memory=True, limit=limit)
        except IndexUnusable as error:
            if not os.path.lexists(self.folder.index):
                return 0
            _refuse_index("index.sqlite", str(error))
        rows = 0
        with contextlib.closing(index):
            last = self.index.head.sequence
            if index.head.sequence > last:
                self._refuse(
                    self.folder.log_entry(last + 1), "is missing, but the index recorded it"
                )
            try:
                while index.head.sequence < last:  # a process died between log entry and index
                    index.apply(self.log.read(index.head.sequence + 1))
            except TamperedError as error:  # of a log that was verified before
                _refuse_index("index.sqlite: head 0", f"contradicts its rows: {error}")
            for pair in itertools.zip_longest(index.derived_rows(), self.index.derived_rows()):
                if pair[0] != pair[1]:
                    # Tables are sorted by their keys: the lesser row is extra, missing or altered.
                    present = (row for row in pair if row is not None)
                    table, key, _ = min(present, key=lambda row: row[:2])
                    _refuse_index(
                        f"index.sqlite: {table} {key}", "does not follow from log and documents"
                    )
                rows += 1
        return rows

    def check_signatures(self) -> None:
        """Check the submitters' signatures, which the board's own key cannot forge."""
        for id, withdrawal in self.index.connection.execute(
            "SELECT id, withdrawal FROM entry ORDER BY sequence"
        ):
            key = self._submission(id).content.submitter.key
            if withdrawal is not None:
                path = self.folder.withdrawal(id)
                signed = read_document(self.folder, path, Signed[Withdrawal])
                if not signed.is_valid(self.document.signatures_for, key):
                    self._refuse(path, "its signature does not match the submission's key")

    def _submission(self, id: str) -> Signed[Submission]:
        path = self.folder.submission(id)
        signed = read_document(self.folder, path, Signed[Submission])
        if not signed.is_valid(self.document.signatures_for):
            self._refuse(path, "its signature does not match the submitter's key")
        return signed

    def check_objects(self) -> int:
        """Check that every artefact has its digest and its signed size; returns their number."""
        count = 0
        for digest, path in self.objects.paths():
            try:
                size = len(self.objects.read(digest))
            except ValueError:
                self._refuse(path, "is not an artefact")
            except BoardError as error:
                self._refuse(path, f"cannot be read: {error}")
            signed = self.index.one("SELECT size FROM object WHERE digest = ?", digest)
            if signed is not None and signed[0] != size:
                self._refuse(path, f"has {size:,} bytes, not {signed[0]:,}")
            count += 1
            self.count_row()
        for (digest,) in self.index.connection.execute("SELECT digest FROM object ORDER BY digest"):
            if not self.objects.has(digest):
                self._refuse(self.folder.object(digest), "is missing")
        return count

    def scored_ids(self) -> list[str]:
        """The submissions with a result, rejections too, in the order of submission."""
        rows = self.index.connection.execute(
            "SELECT id FROM entry WHERE result IS NOT NULL ORDER BY sequence"
        )
        return [id for (id,) in rows]

    def check_numbers(self, store: Store) -> int:
        """Check that the scores of each result follow from its runs; returns their number."""
        ids = self.scored_ids()
        for id in ids:
            result = store.result(id)
            assert result is not None
            if result.status == "scored":
                _check_runs(store, result)
                _check_scores(store, result)
            self.count_row()
        return len(ids)

    def rescore(self, store: Store, id: str) -> list[RescoreNote]:
        """Score a submission again and compare."""
        notes = rescore(store, id)
        self.count_row()
        return notes

    def _refuse(self, path: Path, message: str) -> NoReturn:
        raise TamperedError(path.relative_to(self.folder.path).as_posix(), message)


def _refuse_index(where: str, message: str) -> NoReturn:
    raise TamperedError(
        where,
        f"{message}. Nothing else is altered: rebuild the index with `sme-leaderboard reindex`",
    )


def _names(folder: Path) -> list[str]:
    """The names of a folder's files, sorted, without half-written ones."""
    if not folder.is_dir():  # version control keeps no empty folders
        return []
    return sorted(path.name for path in folder.iterdir() if not path.match(TEMPORARY))


def _refuse_result(id: str, message: str) -> NoReturn:
    raise TamperedError(f"results/{hex_of(id)}.json", message)


def _check_runs(store: Store, result: Result) -> None:
    """Check that the scores are of the submitted runs on their own states; failed runs score 1."""
    document, instances = store.document, store.document.instances
    submission = store.submission(result.submission).content
    regions = len(document.protocol.edges)
    listed = result.runs[: len(submission.runs)]
    for number, (run, score) in enumerate(itertools.zip_longest(submission.runs, listed)):
        if score is None:
            matches = False
        elif run.artefact is None:
            matches = score == failed_run(document.protocol, instances[run.spec][0], run.spec)
        else:
            class_name, spec = instances[run.spec]
            digest = run.artefact.sha256
            seed = evaluation_seed(document.protocol.digest, run.spec, digest)
            matches = (score.spec, score.class_name, score.artefact, score.evaluation_seed) == (
                *(run.spec, class_name, digest, seed),
            ) and [agent.name for agent in score.agents] == agent_names(spec)
            matches = matches and all(len(each) == regions for each in _by_region(score))
        if not matches:
            _refuse_result(result.submission, f"runs.{number}: does not match the submitted run")


def _by_region(run: RunScore) -> list[tuple[float, ...]]:
    """The lists of numbers of a run with a policy that have one for each region."""
    agents = [agent.normalised_regret for agent in run.agents]
    return [run.normalised_regret, run.similarity or (), *agents]


def _check_scores(store: Store, result: Result) -> None:
    """Check that each run's metrics follow from its regions, and the scores from the runs."""
    document = store.document
    submission = store.submission(result.submission).content
    for number, run in enumerate(result.runs):
        for name, value in run_metrics(
            run.normalised_regret, run.similarity, levels_of(document.protocol)
        ).items():
            if not close(value, getattr(run, name), EXACT):
                _refuse_result(
                    result.submission, f"runs.{number}.{name}: does not follow from its regions"
                )
    try:
        unlisted = never_listed(document, submission)
    except Rejection as error:
        _refuse_result(result.submission, f"its submission cannot be scored: {error}")
    expected = result_of(
        document,
        result.submission,
        result.runs[: len(submission.runs)],
        result.versions,
        unlisted=unlisted,
        isolation=result.isolation,
    )
    if not close(expected.to_dict(), result.to_dict(), EXACT):
        _refuse_result(result.submission, "its runs or scores do not follow from its submission")


def close(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two pieces of plain data are equal up to a tolerance of their numbers."""
    match one, other:
        case {"low": None}, {"low": float(low), "high": float(high), "value": float(value)}:
            # Earlier versions gave single runs an interval of zero width.
            return low == high == value and close(one["value"], value, tolerance)
        case dict(), dict():
            return one.keys() == other.keys() and all(
                close(value, other[key], tolerance) for key, value in one.items()
            )
        case ((list() | tuple()), (list() | tuple())):
            return len(one) == len(other) and all(
                close(left, right, tolerance) for left, right in zip(one, other, strict=True)
            )
        case float(), float():
            return abs(one - other) <= tolerance * max(1.0, abs(one))
    return bool(one == other)

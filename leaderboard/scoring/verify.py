"""`verify`: whether a board's files are what its signed log says, and its numbers what they make.

In this order, so that the first row named is the one to look at: the log's chain and signatures,
each entry's document, what the log does not name, the artefacts, the numbers, the index.

Entries cut off the log's end leave no trace in it, nor does a log that the board itself wrote and
signed anew. Both show where the digest of an entry was kept elsewhere: `contains`.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leaderboard.documents.board import BoardDocument, Folder, hex_of
from leaderboard.documents.keys import verifies
from leaderboard.documents.result import Result
from leaderboard.documents.submission import Artefact, Run, SignedSubmission, SignedWithdrawal
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.metrics import run_metrics
from leaderboard.scoring.score import (
    evaluation_seed,
    failed_run,
    never_listed,
    result_of,
    score_submission,
)
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
from sme_registry.io import TEMPORARY

Progress = Callable[[int, int], None]

EXACT = 1e-9
"""Between numbers recomputed from the same runs: sums may be ordered otherwise elsewhere."""

RESCORED = 1e-5
"""Between scores of the same policy: another machine or version of onnxruntime rounds its float32
actions otherwise, by about 1e-7 each, and similar actions are then divided by a regret that may be
as small as a tenth."""


@dataclass(frozen=True)
class VerifyReport:
    """How many of each were verified.

    Attributes:
      entries: of the log.
      log_sequence, log_digest: of its last entry; kept elsewhere, the digest tells later whether
        the log was cut or written anew.
      unlogged: submissions and withdrawals whose process was killed before it logged them;
        nobody is shown them.
      rows: of the index, equal to those of one made anew; 0 where there is no index.
      rescored: submissions scored anew.
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
    rescored: int


def verify(
    path: str | Path,
    *,
    rescore: int = 0,
    seed: int = 0,
    contains: str | None = None,
    progress: Progress | None = None,
) -> VerifyReport:
    """Verify everything about a board; writes nothing.

    Args:
      path: the board's folder.
      rescore: how many submissions, drawn at random from those scored, to score anew.
      seed: of the draw.
      contains: digest of an entry that the log had once; None where none was kept.
      progress: called with the rows done and the rows in all.

    Returns:
      The counts.

    Raises:
      TamperedError: has the first altered row, such as `results/….json`.
      BoardError: the folder holds no board.
      OptionError: `rescore` is negative, or `contains` is no digest.
    """
    if rescore < 0:
        raise OptionError(f"rescore={rescore}: must be at least 0. Leave it out for none.")
    kept = None if contains is None else _digest_of_entry(contains)
    folder = Folder(path)
    folder.read()
    document = read_document(folder, folder.board, BoardDocument)
    count = _Counter(folder, rescore, progress)
    with contextlib.closing(Index.empty(None, folder, document)) as fresh:
        log = Log(folder, document.key)
        _verify_opening(folder, document, log)
        found = _follow(log, fresh, count, kept)
        with Store.open(path, read_only=True) as store:
            with store.locked():
                found |= _follow(log, fresh, count, kept)  # what came meanwhile
                _verify_numbering(folder, fresh)
                if kept is not None and not found:
                    raise TamperedError(
                        "log",
                        f"holds no entry of digest {kept}. If that was an entry of this board's, "
                        "its log was cut or written anew since",
                    )
                unlogged = _verify_nothing_unlogged(folder, fresh)
                rows = _verify_index(folder, document, log, fresh)
            _verify_signatures(folder, fresh)
            objects = _verify_objects(folder, fresh, count)
            results = _verify_numbers(store, fresh, count)
            scored = [entry.id for entry in fresh.entries() if entry.status == "scored"]
            drawn = random.Random(seed).sample(scored, min(rescore, len(scored)))
            for id in drawn:
                _rescore(store, id)
                count.one_more()
        entries = fresh.entries()
        return VerifyReport(
            entries=fresh.head.sequence + 1,
            log_sequence=fresh.head.sequence,
            log_digest=fresh.head.digest,
            submissions=len(entries),
            withdrawals=sum(entry.status == "withdrawn" for entry in entries),
            results=results,
            objects=objects,
            unlogged=unlogged,
            rows=rows,
            rescored=len(drawn),
        )


class _Counter:
    """Rows done, of about as many as the board's folder has files."""

    def __init__(self, folder: Folder, rescore: int, progress: Progress | None) -> None:
        self._progress = progress
        self._done = 0
        self._total = rescore + sum(1 for _ in Objects(folder).paths())
        for part in (folder.log, folder.results):
            self._total += len(_names(part))

    def one_more(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, max(self._done, self._total))


def _names(folder: Path) -> list[str]:
    """The names of a folder's files, sorted, without the half-written ones."""
    if not folder.is_dir():  # no version control keeps an empty folder
        return []
    return sorted(path.name for path in folder.iterdir() if not path.match(TEMPORARY))


def _verify_opening(folder: Folder, document: BoardDocument, log: Log) -> None:
    """That the log is of this board: said of board.json, and not of each signature after."""
    if not log.has(0):
        raise TamperedError("log/00000000.json", "is missing: a board begins with it")
    first = read_document(folder, folder.log_entry(0), LogEntry)
    if first.document != digest_of(document):
        raise TamperedError("board.json", "is not the board that the log opened")
    if folder.key.exists() and folder.signing_key().public != document.key:
        raise TamperedError("board.key", "is not the key that board.json names")


def _digest_of_entry(text: str) -> str:
    try:
        return f"sha256:{hex_of(text)}"
    except ValueError:
        raise OptionError(
            f"contains={text!r:.90}: must be 'sha256:' and 64 hex digits. Copy it from what "
            "`sme-leaderboard verify` or the board's log page said then."
        ) from None


def _follow(log: Log, fresh: Index, count: _Counter, kept: str | None) -> bool:
    """Chain, signatures and documents, from where `fresh` is to the end; whether it has `kept`."""
    found = False
    head = fresh.head
    while log.has(head.sequence + 1):
        entry = log.read_after(head)
        fresh.apply(entry)
        head = entry.head
        found |= head.digest == kept
        count.one_more()
    return found


def _verify_numbering(folder: Folder, fresh: Index) -> None:
    """That no entry is left out, and nothing else is there."""
    following = fresh.head.sequence + 1
    for name in _names(folder.log):
        if not re.fullmatch(r"[0-9]{8,}\.json", name):
            raise TamperedError(f"log/{name}", "is no file of a log")
        if int(name[:-5]) >= following:
            where = _where(folder, folder.log_entry(following))
            raise TamperedError(where, "is missing, and later entries are there")


def _verify_signatures(folder: Folder, fresh: Index) -> None:
    """Of the submitters: the board's own key cannot make these."""
    for id, withdrawal in fresh.connection.execute(
        "SELECT id, withdrawal FROM entry ORDER BY sequence"
    ):
        signed = _signed_submission(folder, id)
        if withdrawal is not None:
            _verify_withdrawal(folder, id, signed.submission.submitter.key)


def _signed_submission(folder: Folder, id: str) -> SignedSubmission:
    signed = read_document(folder, folder.submission(id), SignedSubmission)
    key = signed.submission.submitter.key
    if not verifies(key, signed.signature, "submission", id):
        raise TamperedError(
            f"submissions/{hex_of(id)}.json", "its signature is not by the submitter's key"
        )
    return signed


def _verify_withdrawal(folder: Folder, id: str, key: str) -> None:
    signed = read_document(folder, folder.withdrawal(id), SignedWithdrawal)
    if not verifies(key, signed.signature, "withdrawal", signed.withdrawal.digest):
        raise TamperedError(
            f"withdrawals/{hex_of(id)}.json", "its signature is not by the submission's key"
        )


def _verify_nothing_unlogged(folder: Folder, fresh: Index) -> int:
    """That no file stands there as if it were the log's; how many are on their way to it."""
    unlogged = 0
    for part, column in (
        (folder.submissions, "document"),
        (folder.withdrawals, "withdrawal"),
        (folder.results, "result"),
    ):
        for name in _names(part):
            where = f"{part.name}/{name}"
            if not re.fullmatch(r"[0-9a-f]{64}\.json", name):
                raise TamperedError(where, "is no file of a board")
            id = f"sha256:{name[:64]}"
            if fresh.one(f"SELECT 1 FROM entry WHERE id = ? AND {column} IS NOT NULL", id):
                continue
            if column == "result":
                raise TamperedError(
                    where,
                    "is in no entry of the log. If a scorer was killed in mid-write, opening the "
                    "board for writing removes it, as `sme-leaderboard score` does",
                )
            if column == "document" and _signed_submission(folder, id).id != id:
                raise TamperedError(where, "holds another submission than its name says")
            unlogged += 1
    return unlogged


def _verify_index(folder: Folder, document: BoardDocument, log: Log, fresh: Index) -> int:
    """Row by row against the one made anew."""
    try:
        index = Index.snapshot(folder.index, folder, document)
    except IndexUnusable as error:
        if not folder.index.exists():
            return 0
        raise _odd_row("", str(error)) from None
    rows = 0
    with contextlib.closing(index):
        if index.head.sequence > fresh.head.sequence:
            where = f"log/{fresh.head.sequence + 1:08d}.json"
            raise TamperedError(where, "is missing, but the index remembers it")
        try:
            while index.head.sequence < fresh.head.sequence:  # a process was killed between the two
                index.apply(log.read(index.head.sequence + 1))
        except TamperedError as error:  # of a log that has been followed already
            raise _odd_row("head 0", f"lies about what it holds: {error}") from None
        for found, expected in itertools.zip_longest(index.derived_rows(), fresh.derived_rows()):
            if found != expected:
                # The tables are sorted by their keys: the lesser one of the two is the odd one.
                rows_there = (row for row in (found, expected) if row is not None)
                table, key, _ = min(rows_there, key=lambda row: row[:2])
                raise _odd_row(f"{table} {key}", "is not what log and documents make")
            rows += 1
    return rows


def _odd_row(row: str, message: str) -> TamperedError:
    return TamperedError(
        f"index.sqlite: {row}" if row else "index.sqlite",
        f"{message}. Nothing else is altered: make the index anew with `sme-leaderboard reindex`",
    )


def _verify_objects(folder: Folder, fresh: Index, count: _Counter) -> int:
    """Every artefact's hash; that none is missing, and that its size is the one signed."""
    objects = Objects(folder)
    found = 0
    for digest, path in objects.paths():
        size = len(_hashed(folder, digest, path, objects))
        signed = fresh.one("SELECT size FROM object WHERE digest = ?", digest)
        if signed is not None and signed[0] != size:
            raise TamperedError(_where(folder, path), f"has {size:,} bytes, not {signed[0]:,}")
        found += 1
        count.one_more()
    for (digest,) in fresh.connection.execute("SELECT digest FROM object ORDER BY digest"):
        if not objects.has(digest):
            raise TamperedError(_where(folder, folder.object(digest)), "is missing")
    return found


def _hashed(folder: Folder, digest: str, path: Path, objects: Objects) -> bytes:
    try:
        return objects.read(digest)
    except ValueError:
        raise TamperedError(_where(folder, path), "is no artefact") from None
    except BoardError as error:
        raise TamperedError(_where(folder, path), f"cannot be read: {error}") from None


def _where(folder: Folder, path: Path) -> str:
    return path.relative_to(folder.path).as_posix()


def _verify_numbers(store: Store, fresh: Index, count: _Counter) -> int:
    """What each result says of its runs, and makes of them."""
    results = 0
    levels = [high for _, high in store.document.protocol.edges]
    for (id,) in fresh.connection.execute(
        "SELECT id FROM entry WHERE result IS NOT NULL ORDER BY sequence"
    ).fetchall():
        result = store.result(id)
        assert result is not None
        if result.status == "scored":
            where = f"results/{hex_of(id)}.json"
            _verify_runs(store, result, where)
            for number, run in enumerate(result.runs):
                metrics = run_metrics(run.normalised_regret, run.similarity, levels)
                for name, value in metrics.items():
                    if not _close(value, getattr(run, name), EXACT):
                        raise TamperedError(where, f"runs.{number}.{name}: is not of its regions")
            anew = result_of(store.document, id, result.runs, result.versions)
            if not _close(anew.to_dict(), result.to_dict(), EXACT):
                raise TamperedError(where, "its scores are not those of its runs")
        results += 1
        count.one_more()
    return results


def _verify_runs(store: Store, result: Result, where: str) -> None:
    """That the runs scored are those submitted, on their own states, and those without policy 1."""
    submission, document = store.submission(result.submission).submission, store.document
    instances = document.instances
    try:
        unlisted = never_listed(document, submission, instances)
    except Rejection as error:
        raise TamperedError(where, f"is of a submission that cannot be scored: {error}") from None
    pairs = itertools.zip_longest([*submission.runs, *unlisted], result.runs)
    for number, (run, found) in enumerate(pairs):
        match run:
            case Run(spec=spec, artefact=Artefact(sha256=digest)):
                seed = evaluation_seed(document.protocol.digest, spec, digest)
                right = found is not None and (
                    (found.spec, found.class_name, found.artefact, found.evaluation_seed)
                    == (spec, instances[spec][0], digest, seed)
                )
            case Run(spec=spec):
                right = found == failed_run(document, instances[spec][0], spec)
            case _:
                right = found == run
        if not right:
            raise TamperedError(where, f"runs.{number}: is not of the run that was submitted")


def _rescore(store: Store, id: str) -> None:
    """The policies once more, through gate, sandbox and evaluation."""
    where = f"results/{hex_of(id)}.json"
    stored = store.result(id)
    anew = score_submission(store.document, store.submission(id).submission, store.objects.read)
    assert stored is not None
    if anew.status != stored.status:
        raise TamperedError(where, f"scored anew it is rejected: {anew.code}: {anew.message}")
    for number, (run, found) in enumerate(zip(anew.runs, stored.runs, strict=True)):
        for name in ("normalised_regret", "similarity"):
            if not _close(getattr(run, name), getattr(found, name), RESCORED):
                raise TamperedError(
                    where, f"runs.{number}.{name}: scored anew it differs by more than {RESCORED}"
                )


def _close(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two pieces of plain data are equal but for a difference of their numbers."""
    match one, other:
        case dict(), dict():
            return one.keys() == other.keys() and all(
                _close(one[key], other[key], tolerance) for key in one
            )
        case ((list() | tuple()), (list() | tuple())):
            return len(one) == len(other) and all(
                _close(mine, yours, tolerance) for mine, yours in zip(one, other, strict=True)
            )
        case float(), float():
            return abs(one - other) <= tolerance * max(1.0, abs(one))
    return bool(one == other)

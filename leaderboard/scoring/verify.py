"""`verify`: follow a board's log, score again, and compare.

Opening a board follows its log: chain, signatures, the rules for each entry, and every document
that an entry names. Then come the entrants' signatures, the policy files, and the numbers, twice:

    from its runs      a result must follow from the regrets of its runs in each region, within 1e-9
    scored again       a submission must have its result's numbers, within 1e-5, and its verdict

Whatever contradicts the log, or a result's own runs, was altered. Other numbers, or another
verdict, mean that this machine does not confirm the entry, and are no proof of tampering: other
processors and versions of libraries round otherwise. Whoever repeats it on another machine learns
which it is.

Entries cut off the log's end leave no trace in it, and neither does a log that the board itself has
rewritten and signed. Both show if an entry's digest was kept elsewhere: `contains`.
"""

from __future__ import annotations

import random
import re
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from leaderboard.documents.board import BoardDocument, Folder, hex_of
from leaderboard.documents.result import Result, RunScore
from leaderboard.documents.submission import Run
from leaderboard.errors import Rejection, TamperedError
from leaderboard.scoring.ranking import failed_run, levels_of, never_listed, result_of, run_metrics
from leaderboard.scoring.score import agent_names, evaluation_seed, score_submission
from leaderboard.store import Store
from leaderboard.store.log import LogEntry, digest_of, read_document
from sme_registry import SMESpec
from sme_registry.errors import OptionError
from sme_registry.io import TEMPORARY, integer_in
from sme_registry.spec import EvaluationProtocol

EXACT = 1e-9
"""Tolerance for numbers recomputed from the same runs: another machine may sum in another order."""

RESCORED = 1e-5
"""Tolerance for new scores of the same policy: another machine or version of onnxruntime changes
its float32 actions by about 1e-7, and similar actions are divided by a regret as small as 0.1."""

_MARKS = ("rounding", "sketch", "actions")
_NOT_COMPARED = ("versions", "isolation", "message", *_MARKS)

Progress = Callable[[str], None]
"""Called with what was just checked."""


@dataclass(frozen=True)
class Row:
    """How much of a kind was checked, how much was not, and why."""

    what: str
    checked: int
    unchecked: int = 0
    why: str = ""


@dataclass(frozen=True)
class Difference:
    """The first value that differs: its path, as in `runs.0.wd_regret`, and both values."""

    path: str
    recorded: str
    here: str


@dataclass(frozen=True)
class Note:
    """An entry that this machine does not confirm, and the first value that differs."""

    entry: str
    difference: Difference


@dataclass
class Findings:
    """What was checked, what this machine does not confirm, and what is not in this folder."""

    progress: Progress = field(compare=False, repr=False)
    log_sequence: int = -1  # of the last log entry
    log_digest: str = ""  # which, kept elsewhere, shows later whether the log was cut or rewritten
    rows: list[Row] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # published files
    rescore_seed: int | None = None  # repeats the draw of the submissions that were scored again

    @property
    def is_confirmed(self) -> bool:
        """Whether nothing that was checked differs, and nothing that is public is missing."""
        return not self.notes and not self.missing

    def report(self, what: str, checked: int, unchecked: int = 0, why: str = "") -> None:
        self.rows.append(Row(what, checked, unchecked, why))

    def compare(
        self, results: Iterable[tuple[str, Any, Any]], *unchecked: tuple[int, str], of: str = ""
    ) -> None:
        """Note the entries, by name, whose recorded result differs from one that is scored here."""
        count, others = 0, Counter[str]()
        for name, recorded, here in results:
            found = _other_result(recorded, here)
            if found is not None:
                self.notes.append(Note(name, found))
            others.update(
                f"{package} {version}, here {here.versions[package]}"
                for package, version in recorded.versions.items()
                if version != here.versions.get(package, version)
            )
            count += 1
            self.progress(name)
        why = "; ".join(f"{number} {reason}" for number, reason in unchecked if number)
        self.report(f"{of}results, scored again", count, sum(n for n, _ in unchecked), why)
        for other, number in others.items():
            self.report(f"{of}results of other versions", number, 0, other)


Part = Callable[[Store, Findings], None]
"""Verifies a part of a board whose log was followed."""


def verify(
    path: str | Path,
    *,
    rescore: int | Literal["all"] = 0,
    seed: int | None = None,
    contains: str | None = None,
    board: type[Store] = Store,
    parts: Sequence[Part] = (),
    progress: Progress | None = None,
) -> Findings:
    """Verify a board without writing anything; a `TamperedError` names the first altered value.

    `rescore` submissions are scored again, drawn by `seed`, by default the system's randomness,
    which nobody predicts. `contains` is the digest of an entry that the log once had. A board with
    further tracks needs its class, and what verifies them, `parts`.
    """
    if rescore != "all":
        integer_in("rescore", rescore, 0, advice="Leave it out for none.")
    seed = secrets.randbits(53) if seed is None else integer_in("seed", seed, 0)
    digest = None if contains is None else _entry_digest(contains)
    _check_opening(Folder(path))
    with board.open(path, read_only=True) as store:
        with store.locked():
            head = store.head
            _check_numbering(store, head.sequence + 1)
        if digest is not None:
            _check_contains(store, digest)
        findings = Findings(progress or (lambda _: None), head.sequence, head.digest)
        findings.report("log entries, and their documents", head.sequence + 1)
        verifier = _Verifier(store, findings)
        verifier.check_signatures()
        verifier.check_files()
        scored = verifier.check_results()
        drawn = draw(scored, rescore, seed)
        findings.rescore_seed = seed if drawn else None
        verifier.score_again(drawn, len(scored))
        for part in parts:
            part(store, findings)
    return findings


def draw(ids: Sequence[str], count: int | Literal["all"], seed: int) -> list[str]:
    """The submissions to score again, in the order of `ids`."""
    if count == "all" or count >= len(ids):
        return list(ids)
    drawn = set(random.Random(seed).sample(ids, count))
    return [id for id in ids if id in drawn]


def difference(recorded: Any, here: Any, tolerance: float, path: str = "") -> Difference | None:
    """The first value of plain data that differs by more than a tolerance; None if none does."""
    match recorded, here:
        case {"low": float(low), "high": float(high), "value": float(value)}, {"low": None}:
            if low == high == value:  # earlier versions gave single runs an interval of no width
                return difference(value, here["value"], tolerance, f"{path}.value")
        case dict(), dict() if recorded.keys() == here.keys():
            return _first(recorded, here, recorded, tolerance, path)
        case list() | tuple(), list() | tuple() if len(recorded) == len(here):
            return _first(recorded, here, range(len(here)), tolerance, path)
        case float(), float() if abs(recorded - here) <= tolerance * max(1.0, abs(here)):
            return None
    return None if recorded == here else Difference(path, _short(recorded), _short(here))


def _first(
    recorded: Any, here: Any, keys: Iterable[Any], tolerance: float, path: str
) -> Difference | None:
    for key in keys:
        where = f"{path}.{key}" if path else str(key)
        found = difference(recorded[key], here[key], tolerance, where)
        if found is not None:
            return found
    return None


def _short(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"{len(value)} values"
    return f"{value}"[:80]


def _other_result(recorded: Any, here: Any) -> Difference | None:
    verdicts = [getattr(each, "code", "") or "scored" for each in (recorded, here)]
    if verdicts[0] != verdicts[1]:
        return Difference("verdict", *verdicts)
    return difference(compared(recorded), compared(here), RESCORED)


def compared(result: Any) -> dict[str, Any]:
    """What is compared of a result, or of one of its runs: all but versions, marks and messages."""
    plain = result.to_dict()
    runs = [{k: v for k, v in run.items() if k not in _NOT_COMPARED} for run in plain["runs"]]
    return {"runs": runs} | {k: v for k, v in plain.items() if k not in (*_NOT_COMPARED, "runs")}


def contradiction(recorded: Any, again: Any) -> Difference | None:
    """The first value of a result that does not follow from its runs; these come first."""
    one, other = recorded.to_dict(), again.to_dict()
    return difference({"runs": one["runs"], **one}, {"runs": other["runs"], **other}, EXACT)


def with_metrics(run: RunScore, protocol: EvaluationProtocol, rules: int) -> RunScore | None:
    """A run with the metrics that follow from its regions; None if these are not the protocol's."""
    of_agents = [agent.normalised_regret for agent in run.agents]
    lists = (run.normalised_regret, run.similarity or (), *of_agents)
    if {len(each) for each in lists} != {len(protocol.edges)}:
        return None
    metrics = run_metrics(run.normalised_regret, run.similarity, levels_of(protocol), rules)
    return run.model_copy(update=metrics)


def refuse_contradiction(found: Difference | None, entry: str) -> None:
    """Raise `TamperedError` if an entry's result contradicts itself."""
    if found is not None:
        raise TamperedError(
            f"result of {entry}: {found.path}",
            f"is {found.recorded}, and {found.here} follows from its runs",
        )


def _entry_digest(text: str) -> str:
    try:
        return f"sha256:{hex_of(text)}"
    except ValueError:
        raise OptionError(
            f"contains={text!r:.90}: must be 'sha256:' and 64 hex digits. Copy it from the earlier "
            "output of `sme-leaderboard verify` or from the board's log page."
        ) from None


def _check_opening(folder: Folder) -> None:
    """Check that the log opens with board.json, and that a private key is the board's."""
    folder.read()
    document = read_document(folder, folder.board, BoardDocument)
    if folder.log_entry(0).exists():  # otherwise the log says so
        first = read_document(folder, folder.log_entry(0), LogEntry)
        if first.document != digest_of(document):
            raise TamperedError("board.json", "differs from the board that the log opened")
    if folder.key.exists() and folder.signing_key().public != document.key:
        raise TamperedError("board.key", "is not the key in board.json")


def _check_numbering(store: Store, following: int) -> None:
    """Check that the log's folder has no gap and no other files."""
    names = sorted(each.name for each in store.folder.log.iterdir() if not each.match(TEMPORARY))
    for name in names:
        if not re.fullmatch(r"[0-9]{8,}\.json", name):
            raise TamperedError(f"log/{name}", "is not a log entry")
        if int(name[:-5]) >= following:
            raise TamperedError(f"log/{following:08d}.json", "is missing, but later entries exist")


def _check_contains(store: Store, digest: str) -> None:
    entries: Iterator[LogEntry] = (
        entry for start in range(0, store.head.sequence + 1, 100) for entry in store.log(start)
    )
    if all(entry.digest != digest for entry in entries):
        raise TamperedError(
            "log",
            f"has no entry with the digest {digest}. If it was an entry of this board, the log was "
            "cut or rewritten since",
        )


@dataclass
class _Verifier:
    """The checks of one board, whose log was followed."""

    store: Store
    findings: Findings

    def check_signatures(self) -> None:
        """Check the submitters' signatures, which the board's own key cannot forge."""
        count = 0
        for entry in self.store.entries():
            signed, withdrawal = self.store.submission(entry.id), self.store.withdrawal(entry.id)
            board = self.store.document.key
            ours = signed.is_valid(board)
            ours = ours and (withdrawal is None or withdrawal.is_valid(board, entry.key))
            if not ours:
                what = "submission, or its withdrawal," if withdrawal else "submission"
                raise TamperedError(
                    entry.id, f"the signature of this {what} does not match the submitter's key"
                )
            count += 1 + (withdrawal is not None)
        self.findings.report("signatures of submitters", count)

    def check_files(self) -> None:
        """Check that every file in objects/ has its digest, and that none is missing."""
        count = 0
        for digest, path in self.store.objects.paths():
            if not re.fullmatch(r"sha256:[0-9a-f]{64}", digest):
                where = path.relative_to(self.store.folder.path).as_posix()
                raise TamperedError(where, "is not a file of a board")
            self.store.objects.read(digest)
            count += 1
            self.findings.progress(digest)
        named = self.store.named_objects()
        absent = [digest for digest in named if not self.store.objects.has(digest)]
        missing = [digest for digest in absent if self.store.is_public(digest)]
        self.findings.missing += missing
        secret = len(absent) - len(missing)
        why = "not published" * bool(secret)
        self.findings.report("files by their digests", count, secret, why)
        if missing:
            self.findings.report("published files", 0, len(missing), "not in this folder")

    def check_results(self) -> list[str]:
        """Check that the scores of each result follow from its runs; returns the submissions."""
        ids, runs = [], 0
        for entry in self.store.entries():
            result = self.store.result(entry.id)
            if result is None:
                continue
            if result.status == "scored":
                refuse_contradiction(self._contradiction(result), entry.id)
            ids.append(entry.id)
            runs += sum(run.artefact is not None for run in result.runs)
            self.findings.progress(entry.id)
        self.findings.report("results, from their runs", len(ids))
        if runs:
            reason = "copies show only where all bits of actions are equal"
            if self.store.document.rules == 2:
                reason = "earlier versions computed rounding, sketches and copies"
            self.findings.report("marks of runs", 0, runs, reason)
        return ids

    def score_again(self, drawn: Sequence[str], scored: int) -> None:
        """Score submissions again, through gate, sandbox and evaluation, and compare."""
        submissions = {id: self.store.submission(id).content for id in drawn}
        document, objects = self.store.document, self.store.objects
        whole = {
            id: each
            for id, each in submissions.items()
            if all(objects.has(run.artefact.sha256) for run in each.runs if run.artefact)
        }
        self.findings.compare(
            (
                (id, self.store.result(id), score_submission(document, submission, objects.read))
                for id, submission in whole.items()
            ),
            (scored - len(drawn), "not drawn: --rescore"),
            (len(drawn) - len(whole), "their policy files are not here"),
        )

    def _contradiction(self, result: Result) -> Difference | None:
        """The first value of a result that does not follow from the regrets of its runs."""
        board = self.store.document
        submission = self.store.submission(result.submission).content
        try:
            unlisted = never_listed(board, submission)
        except Rejection as error:
            return Difference("status", "scored", error.code)
        if len(result.runs) != len(submission.runs):
            return Difference("runs", str(len(result.runs)), str(len(submission.runs)))
        expected, instances = [], board.instances
        for number, (run, score) in enumerate(zip(submission.runs, result.runs, strict=True)):
            of_run = _expected_run(board, *instances[run.spec], run, score)
            if of_run is None:
                return Difference(f"runs.{number}", "other regions or agents", "those of its spec")
            expected.append(of_run)
        again = result_of(
            board,
            result.submission,
            expected,
            result.versions,
            unlisted=unlisted,
            isolation=result.isolation,
        )
        return contradiction(result, again)


def _expected_run(
    board: BoardDocument, class_name: str, spec: SMESpec, run: Run, score: RunScore
) -> RunScore | None:
    """What follows from the regrets of a submitted run; None if these do not fit its instance."""
    if run.artefact is None:
        return failed_run(board.protocol, class_name, run.spec)
    expected = with_metrics(score, board.protocol, board.rules)
    if expected is None or [agent.name for agent in score.agents] != agent_names(spec):
        return None
    digest = run.artefact.sha256
    return expected.model_copy(
        update={
            "spec": run.spec,
            "class_name": class_name,
            "artefact": digest,
            "evaluation_seed": evaluation_seed(board.protocol.digest, run.spec, digest),
        }
    )

"""What is published of a sealed-offline season, and how all of a season is verified.

    season.json
    datasets/sealed/<season>/<class>-<instance>-v0/data/…   in Minari's format
    challenges/<class>-<instance>.npy                       float32 `[regions · n, S + 2]`

All of it follows from the terms and the master, and `season.json` has its digests.

Opening a board has checked each document against the log, and each master against its commitment.
What is left to `verify_seasons` are signatures, and after the reveal data sets, challenge states
and scores: of offline entries from their answers, of tickets from what was played and signed.
"""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from leaderboard.documents.result import RunScore
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.ranking import failed_run
from leaderboard.scoring.verify import (
    Difference,
    Findings,
    contradiction,
    refuse_contradiction,
    with_metrics,
)
from leaderboard.seasons.scoring import (
    HiddenTask,
    Progress,
    counting,
    instances,
    scored_entries,
    sealed_result,
)
from leaderboard.seasons.season import (
    PLANNED,
    Digests,
    Master,
    SealedResult,
    Season,
    SeasonClass,
    rows_of,
)
from leaderboard.seasons.store import SealedRow, SeasonRow, SeasonStore
from leaderboard.seasons.tickets import Ticket, deadline
from leaderboard.store import Store
from leaderboard.web.client import Files
from sme_registry.datasets import DatasetRecipe, SealedDataset
from sme_registry.errors import SMEError
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import (
    build_folder,
    open_regular,
    read_json,
    read_regular,
    sha256_of,
    to_json,
    versions,
)
from sme_registry.seasons.wire import Hidden, table_bytes
from sme_registry.task.engine import chosen_backend

SEASON = "season.json"


def challenge_path(folder: Path, hidden: Hidden[SeasonClass]) -> Path:
    return folder / "challenges" / f"{hidden.name}.npy"


def dataset_path(folder: Path, season: str, hidden: Hidden[SeasonClass]) -> Path:
    return folder / "datasets" / _dataset_id(season, hidden)


def refuse_unfit(plan: Season, limit: int, runs_to_rank: int) -> None:
    """Refuse a season whose answers a board does not take, or in which nobody has a rank."""
    for member in plan.classes:
        size = table_bytes(rows_of(plan.protocol), member.setting.action_dim)
        if size > limit:
            raise BoardError(
                f"classes.{member.name}: its answers have {size:,} bytes: must be at most "
                f"{limit:,}, the board's limit on artefacts. Use fewer states per region."
            )
        most = member.instances * (plan.tickets_per_key or 1)
        if most < runs_to_rank:
            raise BoardError(
                f"classes.{member.name}: a key has at most {most} runs in it: must be at least "
                f"{runs_to_rank}, which a rank on this board needs. Use more instances"
                f"{' or tickets_per_key' if plan.track == 'sealed-online' else ''}, or a board "
                "for practice."
            )


def read_plan(plan: Any, source: str = "plan") -> Season:
    """A season that is not generated yet: `protocol` and what follows later may be left out."""
    if isinstance(plan, dict):
        plan = {"commitment": PLANNED, **plan}
        name = plan.get("protocol_name")
        if "protocol" not in plan and isinstance(name, str):
            plan["protocol"] = resolve_protocol(name).model_copy(update={"seed": 0}).to_dict()
    return Season.from_dict(plan, source)


def create_season(
    plan: Season,
    master: Master,
    folder: str | os.PathLike[str],
    progress: Progress | None = None,
) -> Season:
    """Generate all that is published of a season, into a new folder, completely or not at all."""
    with build_folder(Path(folder)) as building:
        published = []
        if plan.track == "sealed-offline":
            every = list(instances(plan, master))
            for done, instance in enumerate(every, start=1):
                published.append(_publish(instance, plan.id, master, Path(building)))
                if progress is not None:
                    progress(done, len(every))
        numba = ["numba"] if chosen_backend() == "numba" else []
        fields = {
            **plan.to_dict(),
            "published": [each.to_dict() for each in published],
            "versions": versions(["numpy", "scipy", *numba]),
        }
        season = Season.from_dict(fields).commit(master)
        (Path(building) / SEASON).write_text(to_json(season.to_dict()))
    return season


def read_season(folder: str | os.PathLike[str]) -> Season:
    """The season in a folder that `create_season` wrote, or in a downloaded copy."""
    path = Path(folder) / SEASON
    return Season.from_dict(read_json(path), str(path))


def copy_published(season: Season, source: Path, target: Path) -> None:
    """Copy what is published of a season, and nothing else, completely or not at all."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with build_folder(target) as building:
        for path in _published_files(season):
            (building / path).parent.mkdir(parents=True, exist_ok=True)
            try:
                stream = open_regular(source / path)
            except OSError as error:
                raise BoardError(
                    f"{source / path}: cannot be read: {error.strerror}. Create the season again."
                ) from None
            with stream, open(building / path, "wb") as copy:
                shutil.copyfileobj(stream, copy)


def _published_files(season: Season) -> Iterator[Path]:
    """The paths of all that is published of a season."""
    yield Path(SEASON)
    for hidden in season.hidden:
        yield challenge_path(Path(), hidden)
        yield from (dataset_path(Path(), season.id, hidden) / name for name in SealedDataset.FILES)


def files_of_seasons(store: Store) -> Iterator[Files]:
    """The public files of a board's seasons, for `fetch`."""
    assert isinstance(store, SeasonStore)
    for row in store.seasons():
        folder = store.season_folder(row.digest)
        named = {f"published/{path.as_posix()}" for path in _published_files(row.terms)}
        tickets = {str(each.number) for each in store.entrants(row.digest)} if row.reveal else set()
        is_named = partial(_is_named, named, tickets)
        check = partial(check_published, row.terms, folder / "published")
        yield Files(f"/api/seasons/{row.id}/files", folder, is_named, check)


_OF_TICKET = re.compile(r"tickets/(\d+)/\w{1,99}\.(?:journal|json|challenge|npy|npz)", re.ASCII)


def _is_named(published: Collection[str], tickets: Collection[str], path: str) -> bool:
    """Whether a path is of a published file, or of one in the folder of a revealed ticket."""
    ticket = _OF_TICKET.fullmatch(path)
    return path in published or (ticket is not None and ticket[1] in tickets)


def check_published(
    season: Season, folder: str | os.PathLike[str], progress: Progress | None = None
) -> None:
    """Check data sets and challenge states against their digests; a copy may be without any."""
    folder = Path(folder)
    if not folder.is_dir():
        return
    for done, (hidden, digests) in enumerate(
        zip(season.hidden, season.published, strict=False), start=1
    ):
        path = dataset_path(folder, season.id, hidden)
        data = SealedDataset.read(path)
        _refuse_other_digest(path, data.digest, digests.data)
        setting, promised = hidden.member.setting, hidden.member.data
        assert promised is not None  # the track is offline
        found = (*data.observations.shape, data.actions.shape[1])
        shape = (promised.transitions, setting.state_dim + 2, setting.action_dim)
        if found != shape:
            raise BoardError(
                f"{path}: has {found} rows, observation entries and action channels: must have "
                f"{shape}, as {SEASON} says. The organiser must create the season again."
            )
        path = challenge_path(folder, hidden)
        size = table_bytes(rows_of(season.protocol), setting.state_dim + 2)
        try:
            states = read_regular(path, size)
        except OSError as error:
            reason = f"cannot be read: {error.strerror}. Download it again."
            raise BoardError(f"{path}: {reason}") from None
        _refuse_other_digest(path, sha256_of(states), digests.challenge)
        if progress is not None:
            progress(done, len(season.published))


def _refuse_other_digest(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise BoardError(
            f"{path}: has the digest {found[:19]}…: must be {expected[:19]}…, as in {SEASON}. "
            "Download it again."
        )


def recipe(instance: HiddenTask, master: Master) -> DatasetRecipe:
    """What the data set of an instance is generated from; secret until the reveal."""
    data = instance.hidden.member.data
    assert data is not None  # the track is offline
    return DatasetRecipe.from_dict(
        {
            "spec": instance.spec.to_dict(),
            "behaviours": [{"kind": "mixture", "nu": data.nu}],
            "transitions": data.transitions,
            "seed": master.seed(instance.place, "data"),
        }
    )


def _publish(instance: HiddenTask, season: str, master: Master, folder: Path) -> Digests:
    hidden, states = instance.hidden, instance.challenge
    data = SealedDataset.collect(recipe(instance, master)).rounded()
    data.write(_dataset_id(season, hidden), folder / "datasets")
    path = challenge_path(folder, hidden)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(states)
    return Digests(
        class_name=hidden.member.name,
        instance=hidden.instance,
        data=data.digest,
        challenge=sha256_of(states),
    )


def _dataset_id(season: str, hidden: Hidden[SeasonClass]) -> str:
    return f"sealed/{season}/{hidden.name}-v0"


def verify_seasons(
    store: SeasonStore, findings: Findings, published: Sequence[str | Path] = ()
) -> None:
    """Verify all seasons of a board; `published` are folders of those of which it has no copy."""
    folders = {read_season(folder).digest: Path(folder) for folder in published}
    for row in store.seasons():
        _SeasonVerifier(store, row, findings, folders).check()


@dataclass
class _SeasonVerifier:
    """The checks of one season."""

    store: SeasonStore
    of: SeasonRow
    findings: Findings
    folders: Mapping[str, Path]

    def __post_init__(self) -> None:
        self.season = self.of.terms
        self.entrants = self.store.entrants(self.of.digest)
        self.is_online = self.season.track == "sealed-online"

    def check(self) -> None:
        for row in self.entrants:
            self.check_signature(row)
            if self.is_online and row.result is not None and row.policies < row.runs:
                self.refuse_early(row, "without all answers")
        self.report("signatures of entrants", len(self.entrants))
        for result in filter(None, map(self.store.sealed_result, self.entrants)):
            refuse_contradiction(self.contradiction(result), f"{self.season.id}, {result.subject}")
        if self.of.reveal is None:
            self.check_published()
            count = len(self.entrants)
            self.report("results, scored again", 0, count, "not yet revealed" * bool(count))
            return
        master = self.store.revealed_master(self.of.digest)
        self.generate_again(master)
        if self.published() is not None:
            self.check_published()
        self.score_again(master)

    def report(self, what: str, checked: int, unchecked: int = 0, why: str = "") -> None:
        self.findings.report(f"{self.season.id}: {what}", checked, unchecked, why)

    def check_signature(self, row: SealedRow) -> None:
        """Check an entrant's signature, which the board's own key cannot forge."""
        signed = self.store.request_of(row) if self.is_online else self.store.entry_of(row)
        if not signed.is_valid(self.store.document.key):
            self.refuse(row, "its signature does not match the entrant's key")

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
        """Check the published files against their digests."""
        count, folder = len(self.season.published), self.published()
        if folder is None:
            self.report("data sets", 0, count, "not in this folder" * bool(count))
            return
        try:
            check_published(self.season, folder)
        except SMEError as error:
            raise TamperedError(f"{self.season.id}: published", str(error)) from None
        self.report("data sets, by their digests", count)

    def generate_again(self, master: Master) -> None:
        """Compare what was published with what the master gives."""
        if not self.season.published:
            return
        outcomes: Counter[str] = Counter()
        for instance, expected in zip(
            instances(self.season, master), self.season.published, strict=True
        ):
            outcomes[self.outcome(instance, master, expected)] += 1
            self.findings.progress(f"{expected.class_name} {expected.instance}")
        why = "this processor rounds otherwise, and the published arrays are not here"
        unknown, rounded = outcomes["unknown"], outcomes["within rounding"]
        self.report("data sets", outcomes["exactly"], unknown, why * bool(unknown))
        if rounded:
            self.report("data sets, within 1e-6", rounded, 0, "this processor rounds otherwise")

    def outcome(self, instance: HiddenTask, master: Master, expected: Digests) -> str:
        """How what was published of an instance follows from the master.

        Other processors and versions of NumPy may round otherwise: then data sets are compared.
        """
        data, folder = SealedDataset.collect(recipe(instance, master)), self.published()
        follows = sha256_of(instance.challenge) == expected.challenge
        if follows and expected.data in (data.digest, data.rounded().digest):
            return "exactly"  # the first in seasons before float32
        if follows and folder is None:
            return "unknown"
        if follows and folder is not None:
            path = dataset_path(folder, self.season.id, instance.hidden)
            published = SealedDataset.read(path)
            _refuse_other_digest(path, published.digest, expected.data)
            follows = data.agrees_with(published)
        if not follows:
            raise TamperedError(
                f"{self.season.id}: published {expected.class_name} {expected.instance}",
                "its data set or challenge states do not follow from the master",
            )
        return "within rounding"

    def score_again(self, master: Master) -> None:
        counted = counting(self.store, self.season)
        scored = [row for row in self.entrants if row.result is not None]
        for row in scored:
            if row not in counted:
                self.refuse(row, "has a result, and does not count")
        whole = [row for row in scored if self.has_answers(row)]
        left = sum(row.result is None for row in counted)
        self.findings.compare(
            (
                (f"{self.season.id}, {row.id}", self.store.sealed_result(row), here)
                for row, here in zip(whole, self.scored(master, whole), strict=True)
            ),
            (left, "not scored yet: repeat `sme-leaderboard season reveal`"),
            (len(scored) - len(whole), "their answers are not here"),
            of=f"{self.season.id}: ",
        )

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
            try:
                if not ticket.is_ended:
                    self.refuse_early(row, "without the entrant's end")
                score = ticket.score()
            except (OSError, Rejection) as error:
                raise TamperedError(f"{ticket.folder}", f"cannot be scored: {error}") from None
            yield score

    def contradiction(self, result: SealedResult) -> Difference | None:
        """The first value of a result that does not follow from the regrets of its runs."""
        board, season, runs = self.store.document, self.season, []
        for number, (run, place) in enumerate(zip(result.runs, season.hidden, strict=True)):
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
        raise TamperedError(f"{self.season.id}: {kind} {row.number} ({row.id})", message)

"""What is published of a sealed-offline season: a data set and challenge states of each instance.

    season.json
    datasets/sealed/<season>/<class>-<instance>-v0/data/…   in Minari's format
    challenges/<class>-<instance>.npy                       float32 `[regions · n, S + 2]`

All of it follows from the terms and the master, and `season.json` has its digests.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

from leaderboard.errors import BoardError
from leaderboard.seasons.scoring import HiddenTask, challenge, instances
from leaderboard.seasons.season import (
    MAX_INSTANCES,
    Digests,
    Hidden,
    Master,
    Season,
    Terms,
    rows_of,
)
from leaderboard.seasons.store import SeasonStore
from leaderboard.store import Store
from leaderboard.web.client import Files
from sme_registry.datasets import DatasetRecipe, SealedDataset
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import build_folder, read_json, read_regular, sha256_of, to_json, versions
from sme_registry.seasons.wire import instance_name, pack_table, table_bytes
from sme_registry.task.engine import chosen_backend

Progress = Callable[[int, int], None]

SEASON = "season.json"
_UNKNOWN = "sha256:" + "0" * 64


def name_of(hidden: Hidden) -> str:
    """The name of an instance in files: its class and its number in it."""
    return instance_name(hidden.member.name, hidden.instance)


def challenge_path(folder: Path, hidden: Hidden) -> Path:
    """The file with the challenge states of an instance."""
    return folder / "challenges" / f"{name_of(hidden)}.npy"


def dataset_path(folder: Path, season: str, hidden: Hidden) -> Path:
    """The folder of the data set of an instance."""
    return folder / "datasets" / _dataset_id(season, hidden)


def refuse_large_answers(terms: Terms, limit: int) -> None:
    """Refuse a season whose answers are larger than a board's artefacts may be.

    Raises:
      BoardError: names the class.
    """
    for member in terms.classes:
        size = table_bytes(rows_of(terms.protocol), member.setting.action_dim)
        if size > limit:
            raise BoardError(
                f"classes.{member.name}: its answers have {size:,} bytes: must be at most "
                f"{limit:,}, the board's limit on artefacts. Use fewer states per region."
            )


def refuse_unrankable(terms: Terms, runs_to_rank: int) -> None:
    """Refuse a season in which nobody can have the runs that a board's ranks need.

    Raises:
      BoardError: names the class.
    """
    for member in terms.classes:
        most = member.instances * (terms.tickets_per_key or 1)
        if most < runs_to_rank:
            raise BoardError(
                f"classes.{member.name}: a key has at most {most} runs in it: must be at least "
                f"{runs_to_rank}, which a rank on this board needs. Use more instances"
                f"{' or tickets_per_key' if terms.track == 'sealed-online' else ''}, or a board "
                "for practice."
            )


def read_plan(plan: Any, source: str = "plan") -> Terms:
    """The terms of a season whose data sets and challenge states are not generated yet.

    Args:
      plan: the fields of `Terms`, without `published`. `protocol` may be left out for the one in
        the catalogue that `protocol_name` names.
      source: what errors call it.

    Returns:
      The terms, with digests of zeros.

    Raises:
      SpecError, UnknownNameError: a field is invalid.
    """
    fields = dict(plan) if isinstance(plan, dict) else {}
    name = fields.get("protocol_name")
    if "protocol" not in fields and isinstance(name, str):
        fields["protocol"] = resolve_protocol(name).model_copy(update={"seed": 0}).to_dict()
    if fields.get("track") == "sealed-offline":
        fields["published"] = _unknown(fields.get("classes"))
    return Terms.from_dict(fields if fields else plan, source)


def _unknown(classes: Any) -> list[dict[str, Any]]:
    """The list of instances of classes that may be invalid, with digests of zeros."""
    listed = []
    for member in classes if isinstance(classes, list) else []:
        match member:
            case {"name": name, "instances": int(count)}:
                listed += [
                    {"class_name": name, "instance": i, "data": _UNKNOWN, "challenge": _UNKNOWN}
                    for i in range(min(count, MAX_INSTANCES))
                ]
    return listed


def create_season(
    plan: Terms,
    master: Master,
    folder: str | os.PathLike[str],
    progress: Progress | None = None,
) -> Season:
    """Generate all that is published of a season, into a new folder.

    Args:
      plan: as `read_plan` returns it.
      master: the season's secret.
      folder: it gets `season.json` and, offline, data sets and challenge states; completely or not
        at all.
      progress: called with the number of instances done, and of all.

    Returns:
      The season, committed to the master.

    Raises:
      BoardError, NameTakenError, OptionError: the folder exists or cannot be written.
      ResourceLimitError, MissingDependencyError: a data set cannot be generated or written.
    """
    with build_folder(Path(folder)) as building:
        published = []
        if plan.track == "sealed-offline":
            every = list(instances(plan, master))
            for done, instance in enumerate(every, start=1):
                published.append(_publish(instance, plan.id, master, Path(building)))
                if progress is not None:
                    progress(done, len(every))
        fields = {
            **plan.to_dict(),
            "published": [each.to_dict() for each in published],
            "versions": _versions(),
        }
        season = Terms.from_dict(fields).commit(master)
        (Path(building) / SEASON).write_text(to_json(season.to_dict()))
    return season


def _versions() -> dict[str, str]:
    numba = ["numba"] if chosen_backend() == "numba" else []
    return versions(["numpy", "scipy", *numba])


def read_season(folder: str | os.PathLike[str]) -> Season:
    """The season in a folder that `create_season` wrote, or in a downloaded copy.

    Raises:
      SpecError: there is none.
    """
    path = Path(folder) / SEASON
    return Season.from_dict(read_json(path), str(path))


def copy_published(season: Season, source: Path, target: Path) -> None:
    """Copy what is published of a season, and nothing else, completely or not at all."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with build_folder(target) as building:
        shutil.copy(source / SEASON, building)
        for hidden in season.hidden:
            path = challenge_path(Path(building), hidden)
            path.parent.mkdir(exist_ok=True)
            shutil.copy(challenge_path(source, hidden), path)
            shutil.copytree(
                dataset_path(source, season.id, hidden),
                dataset_path(Path(building), season.id, hidden),
            )


def _check_copy(season: Season, folder: Path) -> None:
    if season.published and folder.is_dir():
        check_published(season, folder)


def files_of_seasons(store: Store) -> Iterator[Files]:
    """The public files of a board's seasons, for `fetch`."""
    assert isinstance(store, SeasonStore)
    for row in store.seasons():
        season, folder = store.season(row.digest), store.season_folder(row.digest)
        check = partial(_check_copy, season, folder.published)
        yield Files(f"/api/seasons/{row.id}/files", folder.path, check)


def check_published(
    season: Season, folder: str | os.PathLike[str], progress: Progress | None = None
) -> int:
    """Check that data sets and challenge states are those that a season was committed to.

    Returns:
      Their number.

    Raises:
      BoardError: a file is missing, or differs from its digest.
    """
    folder = Path(folder)
    for done, (hidden, digests) in enumerate(
        zip(season.hidden, season.published, strict=False), start=1
    ):
        path = dataset_path(folder, season.id, hidden)
        data = SealedDataset.read(path)
        _refuse_other_digest(path, data.digest, digests.data)
        _refuse_other_sizes(path, data, hidden)
        path = challenge_path(folder, hidden)
        _refuse_other_digest(path, _file_digest(path, season, hidden), digests.challenge)
        if progress is not None:
            progress(done, len(season.published))
    return len(season.published)


def _refuse_other_digest(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise BoardError(
            f"{path}: has the digest {found[:19]}…: must be {expected[:19]}…, as in {SEASON}. "
            "Download it again."
        )


def _refuse_other_sizes(path: Path, data: SealedDataset, hidden: Hidden) -> None:
    """Refuse a data set that is committed to, but is not what the season's terms promise."""
    assert hidden.member.data is not None  # the track is offline
    setting = hidden.member.setting
    found = (*data.observations.shape, data.actions.shape[1])
    promised = (hidden.member.data.transitions, setting.state_dim + 2, setting.action_dim)
    if found != promised:
        raise BoardError(
            f"{path}: has {found} rows, observation entries and action channels: must have "
            f"{promised}, as the terms in {SEASON} say. The organiser must create the season again."
        )


def follows(
    instance: HiddenTask, master: Master, expected: Digests, folder: Path | None = None
) -> Literal["exactly", "within rounding", "unknown", "no"]:
    """Whether what was published of an instance is what the master gives when generated again.

    Args:
      instance: the instance.
      master: the season's secret.
      expected: the digests in the season's document.
      folder: a copy of all that was published, to compare data sets where digests differ: other
        processors and other versions of NumPy may round a value otherwise.

    Returns:
      "unknown" if the data set's digest differs and there is no copy.

    Raises:
      BoardError: the copy's data set has another digest.
    """
    data, states = _generate(instance, master)
    if sha256_of(states) != expected.challenge:
        return "no"
    if expected.data in (data.digest, data.rounded().digest):  # in seasons before float32 the first
        return "exactly"
    if folder is None:
        return "unknown"
    path = dataset_path(folder, instance.place.season, instance.hidden)
    published = SealedDataset.read(path)
    _refuse_other_digest(path, published.digest, expected.data)
    return "within rounding" if data.agrees_with(published) else "no"


def _generate(instance: HiddenTask, master: Master) -> tuple[SealedDataset, bytes]:
    data = SealedDataset.collect(recipe(instance, master))
    return data, pack_table(challenge(instance.spec, instance.protocol))


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
    data, states = _generate(instance, master)
    data = data.rounded()
    data.write(_dataset_id(season, instance.hidden), folder / "datasets")
    path = challenge_path(folder, instance.hidden)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(states)
    return _digests(instance.hidden, data, states)


def _digests(hidden: Hidden, data: SealedDataset, states: bytes) -> Digests:
    return Digests(
        class_name=hidden.member.name,
        instance=hidden.instance,
        data=data.digest,
        challenge=sha256_of(states),
    )


def _dataset_id(season: str, hidden: Hidden) -> str:
    return f"sealed/{season}/{name_of(hidden)}-v0"


def _file_digest(path: Path, season: Season, hidden: Hidden) -> str:
    size = table_bytes(rows_of(season.protocol), hidden.member.setting.state_dim + 2)
    try:
        return sha256_of(read_regular(path, size))
    except OSError as error:
        raise BoardError(f"{path}: cannot be read: {error.strerror}. Download it again.") from None

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

import numpy as np

from leaderboard.errors import BoardError
from leaderboard.seasons.scoring import HiddenTask, instances
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
from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, SealedDataset
from sme_registry.evaluation import resolve_protocol
from sme_registry.io import build_folder, read_json, read_regular, sha256_of, to_json, versions
from sme_registry.seasons.wire import instance_name, table_bytes
from sme_registry.spec import Setting
from sme_registry.task.engine import chosen_backend

Progress = Callable[[int, int], None]

SEASON = "season.json"
_UNKNOWN = "sha256:" + "0" * 64


def name_of(hidden: Hidden) -> str:
    return instance_name(hidden.member.name, hidden.instance)


def challenge_path(folder: Path, hidden: Hidden) -> Path:
    return folder / "challenges" / f"{name_of(hidden)}.npy"


def dataset_path(folder: Path, season: str, hidden: Hidden) -> Path:
    return folder / "datasets" / _dataset_id(season, hidden)


def refuse_unfit(terms: Terms, limit: int, runs_to_rank: int) -> None:
    """Refuse a season with answers of more bytes than a board takes, or in which nobody has a rank.

    A rank on the board needs so many runs in each class.
    """
    for member in terms.classes:
        size = table_bytes(rows_of(terms.protocol), member.setting.action_dim)
        if size > limit:
            raise BoardError(
                f"classes.{member.name}: its answers have {size:,} bytes: must be at most "
                f"{limit:,}, the board's limit on artefacts. Use fewer states per region."
            )
        most = member.instances * (terms.tickets_per_key or 1)
        if most < runs_to_rank:
            raise BoardError(
                f"classes.{member.name}: a key has at most {most} runs in it: must be at least "
                f"{runs_to_rank}, which a rank on this board needs. Use more instances"
                f"{' or tickets_per_key' if terms.track == 'sealed-online' else ''}, or a board "
                "for practice."
            )


def read_plan(plan: Any, source: str = "plan") -> Terms:
    """The terms of a season that is not generated yet, with digests of zeros.

    `plan` has the fields of `Terms`, without `published`. `protocol` may be left out for the one in
    the catalogue that `protocol_name` names. Errors call the plan `source`.
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
    """Generate all that is published of a season, into a new folder, completely or not at all.

    It gets `season.json` and, offline, data sets and challenge states. `progress` is called with
    the number of instances done, and of all.
    """
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
        season = Terms.from_dict(fields).commit(master)
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
    if folder.is_dir():  # a copy may be without data
        check_published(season, folder)


def files_of_seasons(store: Store) -> Iterator[Files]:
    """The public files of a board's seasons, for `fetch`."""
    assert isinstance(store, SeasonStore)
    for row in store.seasons():
        folder = store.season_folder(row.digest)
        check = partial(_check_copy, store.season(row.digest), folder / "published")
        yield Files(f"/api/seasons/{row.id}/files", folder, check)


def check_published(
    season: Season, folder: str | os.PathLike[str], progress: Progress | None = None
) -> int:
    """Check that data sets and challenge states are those that a season was committed to.

    Returns their number.
    """
    folder = Path(folder)
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
    return len(season.published)


def _refuse_other_digest(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise BoardError(
            f"{path}: has the digest {found[:19]}…: must be {expected[:19]}…, as in {SEASON}. "
            "Download it again."
        )


def follows(
    instance: HiddenTask, master: Master, expected: Digests, folder: Path | None = None
) -> Literal["exactly", "within rounding", "unknown", "no"]:
    """Whether what was published of an instance is what the master gives when generated again.

    Where digests differ, as other processors and versions of NumPy may round otherwise, data sets
    are compared, if `folder` is a copy of all that was published: otherwise it is unknown.
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
    return SealedDataset.collect(recipe(instance, master)), instance.challenge


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
    hidden = instance.hidden
    data, states = _generate(instance, master)
    data = data.rounded()
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


def _dataset_id(season: str, hidden: Hidden) -> str:
    return f"sealed/{season}/{name_of(hidden)}-v0"


# With few state channels a table of states, of which the nearest answer, fills the cube.
EASY = 0.1
"""Below it a table leaves little to learn."""

MOST_ROWS = 10_000
_NEIGHBOURS = (1, 8)
_SEEDS = (0, 1)  # public: nothing is measured on hidden tasks
_QUESTIONS = 300


def table_regret(setting: Setting, rows: int) -> float:
    """The normalised regret N₀ within the cube of a table of random states and their optima.

    `rows` is the size of the data set, or the steps of the budget; at most `MOST_ROWS` are taken.
    It is the mean over public tasks of this setting, of the better of the nearest state's optimum
    and the mean of the eight nearest ones. Labels are exact, so data with noise do worse.
    """
    return float(np.mean([_regret(setting, rows, seed) for seed in _SEEDS]))


def _regret(setting: Setting, rows: int, seed: int) -> float:
    from scipy.spatial import cKDTree

    task = materialize(SMESpec.from_dict({**setting.to_dict(), "seed": seed}))
    random = np.random.default_rng(seed)
    states = random.random((min(rows, MOST_ROWS), setting.state_dim))
    asked = random.random((_QUESTIONS, setting.state_dim))
    labels, optimum = task.optimal_action(states), task.optimal_action(asked)
    tree = cKDTree(states)
    errors = []
    for count in _NEIGHBOURS:
        _, nearest = tree.query(asked, range(1, min(count, len(states)) + 1))
        errors.append(np.abs(labels[nearest].mean(axis=1) - optimum).mean())
    return float(min(errors) / np.abs(0.5 - optimum).mean())

"""A data set on disk, as Minari's HDF5: written whole or not at all, read back and checked.

    <folder>/<namespace>/<name>-v<N>/data/main_data.hdf5   episode_0, episode_1, … of Minari
                                          metadata.json    Minari's, and under "sme" our record

The folder is Minari's own (MINARI_DATASETS_PATH, else ~/.minari/datasets), or one that is given.
A set is put together beside its place, in a folder whose name begins with a dot, which neither
Minari nor we list, and then renamed: a kill or a full disk leaves nothing that looks like a set.

Of an episode of T steps: `observations` `[T + 1, O]` and `infos/state` `[T + 1, S]` end with what
followed the last step. Minari wants every info to be of length T + 1: the last entry of the others
repeats the one before it and means nothing.

Minari writes resizable datasets, which take several times the room where episodes are short. This
writes plain ones; what Minari then cannot do is append steps to an episode that is there.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt
from pydantic import Field

from sme_registry.datasets.arrays import Transitions, agents_of
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.scores import ReferenceScores
from sme_registry.errors import (
    DigestMismatchError,
    MalformedDocumentError,
    MissingDependencyError,
    NameTakenError,
    OptionError,
    SMEError,
    SpecError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import read_json, to_json
from sme_registry.registration import env_spec
from sme_registry.spec import Digest, Integer, StrictModel
from sme_registry.spec.sme_spec import Seed

NAMESPACE = "sme"
KEY = "sme"  # of our record in Minari's metadata
DATA, METADATA, NAMESPACE_METADATA = "main_data.hdf5", "metadata.json", "namespace_metadata.json"
_PARTS = re.compile(r"(?P<namespace>(?:[A-Za-z0-9_-]+/)*)(?P<name>[A-Za-z0-9_-]+)-v(?P<v>[0-9]+)")
_INFOS = {
    "optimal_action": "optimal_actions",
    "similarity": "similarities",
    "step_reward": "step_rewards",
    "regret": "regrets",
    "agent_reward": "agent_rewards",
}


class Seeds(StrictModel):
    """Of the task, and of the data: starts, α, ã and random actions."""

    task: Seed
    data: Integer


class DatasetRecord(StrictModel):
    """What a set says of itself, beside Minari's own metadata.

    Attributes:
      recipe, recipe_digest: what it was made from.
      spec_digest, protocol_digest: of the recipe's task, and of where policies are to be judged.
      seeds: all of them.
      nu: ν where one mixture acted; null where several did, or another policy.
      trajectories: E, Minari's episodes.
      scores: of the behaviour, and the references.
      arrays_digest: over every array, see `Transitions.digest`.
      versions: of what the numbers depend on.
    """

    schema_version: Literal[1] = 1
    recipe: DatasetRecipe
    recipe_digest: Digest
    spec_digest: Digest
    protocol_digest: Digest
    seeds: Seeds
    nu: float | None
    trajectories: Annotated[Integer, Field(ge=1)]
    scores: ReferenceScores
    arrays_digest: Digest
    versions: dict[str, str]

    @classmethod
    def open(cls, data: Any, source: str) -> DatasetRecord:
        """Validate a record, and that every digest in it is of what it holds.

        Args:
          data: plain data.
          source: what to call it in an error, such as its path.

        Raises:
          SpecError: a field is wrong, or it is of another schema.
          DigestMismatchError: a digest is of another document.
        """
        version = data.get("schema_version") if isinstance(data, dict) else None
        if type(version) is int and version != 1:
            age = "an older" if version < 1 else "a newer"
            raise SpecError(
                f"{source}: {KEY}.schema_version={version}: must be 1. The set is of {age} version "
                "of this package: read it with that one, or with Minari alone, or make it anew "
                "from its recipe. It is left as it is."
            )
        record = cls.from_dict(data, f"{source}: {KEY}")
        for field, document in (
            ("recipe_digest", record.recipe),
            ("spec_digest", record.recipe.spec),
            ("protocol_digest", record.recipe.protocol),
        ):
            said = getattr(record, field)
            if said != document.digest:
                raise DigestMismatchError(
                    f"{source}: {KEY}.{field}={said!r}: the {field.removesuffix('_digest')} in it "
                    f"has {document.digest!r}. One of them was changed after the set was made: "
                    "take the set again from its source, or make it anew."
                )
        return record


@dataclass(frozen=True)
class Dataset:
    """A set on disk, its metadata read and checked.

    Attributes:
      id: as Minari calls it, `sme/Default-v1-nu50-seed7-v0`.
      path: its folder, which holds `data/`.
      record: what it says of itself.
    """

    id: str
    path: Path
    record: DatasetRecord

    @property
    def recipe(self) -> DatasetRecipe:
        """What it was made from."""
        return self.record.recipe

    @property
    def size_bytes(self) -> int:
        """Of its files."""
        return sum(file.stat().st_size for file in (self.path / "data").iterdir())

    def minari(self) -> Any:
        """The set as a `minari.MinariDataset`.

        Raises:
          MissingDependencyError: Minari is not installed.
        """
        require_minari()
        import minari

        return minari.MinariDataset(self.path / "data")

    def transitions(self) -> Transitions:
        """Every transition, as aligned arrays, to the bits that were written.

        Raises:
          MissingDependencyError: Minari with its HDF5 extra is not installed.
          MalformedDocumentError: the data cannot be read.
          DigestMismatchError: they are not the arrays that the set was made with.
        """
        require_minari()
        file = self.path / "data" / DATA
        try:
            found = _read_hdf5(file, self.record)
        except (OSError, KeyError, ValueError, RuntimeError) as error:
            raise MalformedDocumentError(
                f"{file}: cannot be read: {str(error).strip(chr(39))}. Take the set again from "
                "its source, or make it anew (--force)."
            ) from None
        if found.digest != self.record.arrays_digest:
            raise DigestMismatchError(
                f"{file}: its arrays have {found.digest[:19]}…: must be "
                f"{self.record.arrays_digest[:19]}…, as made. They were changed or added to since: "
                "take the set again from its source, make it anew (--force), or read it with "
                "Minari, which does not check."
            )
        return found


def require_minari() -> None:
    """Raise where the optional packages for data sets are absent.

    Raises:
      MissingDependencyError: names the extra.
    """
    missing = [name for name in ("minari", "h5py") if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"data sets need {' and '.join(missing)}, which is not installed. "
            "Run `pip install 'sme-registry[offline]'`."
        )


def datasets_folder(folder: str | os.PathLike[str] | None = None) -> Path:
    """The folder given, else Minari's: MINARI_DATASETS_PATH, else ~/.minari/datasets."""
    if folder is not None:
        return Path(folder)
    own = os.environ.get("MINARI_DATASETS_PATH")
    return Path(own) if own is not None else Path.home() / ".minari" / "datasets"


def checked_id(dataset_id: str) -> str:
    """An id that Minari takes, in ASCII and with a version.

    Raises:
      OptionError: it is none; says which are.
    """
    match = _PARTS.fullmatch(dataset_id)
    namespace = match["namespace"] if match else ""
    parts = namespace.split("/")[:-1]
    # Minari's own pattern wants two characters of a namespace; `data` is the folder inside a set.
    if match is None or "data" in parts or (namespace and len(namespace) < 3):
        raise OptionError(
            f"name={dataset_id!r}: must be [namespace/]name-v<number> of letters, digits, '_' and "
            "'-' (a namespace of two characters or more, and not 'data'), as in 'sme/mine-v0'."
        )
    return dataset_id


def refuse_existing(target: Path, folder: Path, recipe: DatasetRecipe, force: bool) -> None:
    """Raise where a set cannot be put in its place.

    Args:
      target: its place.
      folder: where sets lie.
      recipe: of the set, beside which an error puts that of a set that is there.
      force: replace a set of ours.

    Raises:
      NameTakenError: something is there, and either `force` is not given or it is no set of ours.
      OptionError: the place is inside another set.
    """
    for parent in target.relative_to(folder).parents:
        if parent != Path() and (folder / parent / "data").exists():
            raise OptionError(
                f"name: {folder / parent} is a data set, and Minari lists none inside another. "
                "Give another namespace."
            )
    if not os.path.lexists(target):
        return
    if not force:
        raise NameTakenError(
            f"{target}: is there already{_beside(target, recipe)}. Give another --name or --out, "
            "or --force to replace it (in Python force=True)."
        )
    try:
        ours = KEY in read_json(target / "data" / METADATA)
    except (SMEError, TypeError):
        ours = False
    if not ours:
        raise NameTakenError(
            f"{target}: is there already and is no data set of this package, so it is not "
            "replaced. Give another --name or --out, or remove it yourself."
        )


def _beside(target: Path, recipe: DatasetRecipe) -> str:
    """How a set that is there compares with one that is asked for: its id alone tells too little.

    Nothing where what is there cannot be opened.
    """
    try:
        there = open_dataset(target).recipe
    except SMEError:
        return ""
    if there.digest != recipe.digest:
        return f", of another recipe: {'; '.join(there.differences(recipe))}"
    if any(
        behaviour.kind == "policy" and behaviour.sha256 is None for behaviour in there.behaviours
    ):
        return ", of the same recipe as far as the name of a policy without a file tells"
    return ", and is the same set"


def write(
    dataset_id: str,
    record: DatasetRecord,
    transitions: Transitions,
    folder: Path,
    *,
    force: bool = False,
) -> Dataset:
    """Write a set, whole or not at all.

    Args:
      dataset_id: Minari's id of it.
      record: what it says of itself.
      transitions: the arrays.
      folder: where sets lie.
      force: replace a set of ours that is there; it stays as it is until the new one is complete.

    Raises:
      OptionError: the name is none of Minari's, or the folder cannot be written to.
      NameTakenError: see `refuse_existing`.
      MissingDependencyError: Minari with its HDF5 extra is not installed.
    """
    require_minari()
    target = folder / checked_id(dataset_id)
    refuse_existing(target, folder, record.recipe, force)
    metadata = _metadata(dataset_id, record)
    content = _hdf5(transitions, record)
    # As Minari counts them: in MB, of the files as they are then.
    metadata["dataset_size"] = round(len(content) / 1e6, 1)
    building: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _describe_namespaces(target.parent, folder)
        building = Path(tempfile.mkdtemp(prefix=f".{target.name[:64]}.", dir=target.parent))
        (building / "data").mkdir()
        _write_through(building / "data" / DATA, content)
        _write_through(building / "data" / METADATA, to_json(metadata).encode())
        umask = os.umask(0)
        os.umask(umask)
        building.chmod(0o777 & ~umask)  # mkdtemp's 0700 would hide the set from colleagues
        _put_in_place(building, target)
        building = None
    except OSError as error:
        raise OptionError(
            f"{target}: cannot be written: {error.strerror or error}. Nothing is left of it; make "
            "room, or give another --out."
        ) from None
    finally:
        if building is not None:
            shutil.rmtree(building, ignore_errors=True)
    return Dataset(dataset_id, target, record)


def open_dataset(
    id_or_path: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None
) -> Dataset:
    """Open a set of ours by its id or its path. Reads the metadata alone.

    Args:
      id_or_path: an id, or the path of a set's folder (or of `data/` in it).
      folder: where ids are looked for; None for Minari's folder.

    Raises:
      UnknownNameError: there is no such set.
      MalformedDocumentError: it is none of ours, or its metadata cannot be read.
      SpecError: a field of its record is wrong, or of another schema version.
      DigestMismatchError: its spec, recipe or protocol is not the one that it was made with.
    """
    place = datasets_folder(folder)
    given = Path(id_or_path)
    given = given.parent if given.name == "data" else given
    is_id = isinstance(id_or_path, str) and _PARTS.fullmatch(id_or_path)
    path = place / id_or_path if is_id and (place / id_or_path / "data").is_dir() else given
    if not (path / "data").is_dir():
        known = [dataset_id for dataset_id, _ in _folders(place)]
        raise UnknownNameError(
            f"{os.fspath(id_or_path)!r}: no data set of this id is in {place}, nor is it the path "
            f"of one.{did_you_mean(os.fspath(id_or_path), known)} `sme dataset list` shows what "
            "there is."
        )
    source = path / "data" / METADATA
    metadata = read_json(source)
    if not isinstance(metadata, dict) or KEY not in metadata:
        raise MalformedDocumentError(
            f"{source}: is no data set of `sme dataset make`. Minari can open it: "
            "minari.MinariDataset(path)."
        )
    record = DatasetRecord.open(metadata[KEY], str(source))
    expected = {
        "total_steps": record.recipe.transitions,
        "total_episodes": record.trajectories,
    }
    for field, right in expected.items():
        if metadata.get(field) != right:
            raise DigestMismatchError(
                f"{source}: {field}={metadata.get(field)!r}: must be {right}, as made. The set was "
                "added to since: take it again from its source, or read it with Minari alone."
            )
    return Dataset(str(metadata.get("dataset_id")), path, record)


def refuse_misplaced(dataset: Dataset, folder: str | os.PathLike[str] | None = None) -> None:
    """Raise where a set does not lie where its id says.

    Below the folder its path must be its id, as for Minari; elsewhere its path must end with it.

    Args:
      dataset: the set.
      folder: where sets lie; None for Minari's folder.

    Raises:
      SpecError: it lies elsewhere, so that its id finds another set or none.
    """
    # Not resolved: a link in the right place is in the right place.
    path, place = (
        Path(os.path.abspath(given)) for given in (dataset.path, datasets_folder(folder))
    )
    own = tuple(dataset.id.split("/"))
    inside = path.is_relative_to(place)
    if own != (path.relative_to(place).parts if inside else path.parts[-len(own) :]):
        home = place / dataset.id if inside else f"a folder {dataset.id}"
        raise SpecError(
            f"{path}: holds the set {dataset.id}: move or copy it back to {home}, or remove it if "
            "that is there already. For a set of another name, make it with --name."
        )


def list_datasets(
    folder: str | os.PathLike[str] | None = None,
) -> tuple[list[Dataset], dict[Path, str]]:
    """Every set of ours in a folder, and those that cannot be opened or do not lie in their place.

    Args:
      folder: where sets lie; None for Minari's folder.

    Returns:
      The sets by id, and for each other of ours why it is not one of them.
    """
    place = datasets_folder(folder)
    found, broken = [], {}
    for dataset_id, path in _folders(place):
        try:
            dataset = open_dataset(path)
            refuse_misplaced(dataset, place)
            found.append(dataset)
        except SMEError as error:
            if "is no data set of `sme dataset make`" not in str(error):
                broken[place / dataset_id] = str(error)
    return found, broken


def _folders(place: Path, namespace: str = "") -> Iterator[tuple[str, Path]]:
    """`(id, folder)` of everything that Minari takes for a set, in order."""
    here = place / namespace
    try:
        children = sorted(child.name for child in here.iterdir() if child.is_dir())
    except OSError:
        return
    if "data" in children and namespace:
        yield namespace, here
        return
    for child in children:
        if not child.startswith("."):
            yield from _folders(place, f"{namespace}/{child}" if namespace else child)


def spaces(record: DatasetRecord) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The spaces of a set's observations and actions; of a team the joint ones."""
    spec = record.recipe.spec
    width = spec.state_dim + 1 + agents_of(spec)
    return (
        gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32),
        gymnasium.spaces.Box(0.0, 1.0, (spec.action_dim,), np.float32),
    )


def _metadata(dataset_id: str, record: DatasetRecord) -> dict[str, Any]:
    """Minari's metadata, with our record in it."""
    import minari
    from minari.serialization import serialize_space

    recipe, scores = record.recipe, record.scores
    observation_space, action_space = spaces(record)
    metadata: dict[str, Any] = {
        "total_episodes": record.trajectories,
        "total_steps": recipe.transitions,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": serialize_space(observation_space),
        "action_space": serialize_space(action_space),
        "dataset_id": dataset_id,
        "algorithm_name": " + ".join(
            f"{behaviour.weight:g} × {behaviour.label}" for behaviour in recipe.behaviours
        ),
        "description": (
            f"{recipe.transitions:,} transitions of the Synthetic Monitoring Environment "
            f"{recipe.spec.content_name}, with π*, similarity and regret of each. The reference "
            "scores are returns: the least of the constant action 0.5, the greatest of π*."
        ),
        "requirements": [f"sme-registry>={record.versions['sme_registry']}"],
        "minari_version": minari.__version__,
    }
    if recipe.spec.team is None:  # Gymnasium's environments are for one agent
        metadata["env_spec"] = env_spec(recipe.spec).to_json()
    floor, ceiling = scores.constant.rollouts, scores.optimum.rollouts
    if floor is not None and ceiling is not None:
        metadata |= {
            "ref_min_score": floor.mean_return,
            "ref_max_score": ceiling.mean_return,
            "num_episodes_average_score": floor.episodes,
        }
    return {**metadata, KEY: record.to_dict()}


def _hdf5(transitions: Transitions, record: DatasetRecord) -> bytes:
    """`main_data.hdf5` in Minari's layout, as bytes; the same arrays give the same bytes.

    In memory, so that what fails on the disk fails in one write, and not in the middle of HDF5.
    Through h5py's low level, at half the time: short episodes are many objects of a few bytes.
    """
    import h5py

    types: dict[Any, Any] = {}
    shapes: dict[tuple[int, ...], Any] = {}
    plain = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plain.set_obj_track_times(False)

    def put(group: Any, name: str, array: npt.NDArray[Any]) -> None:
        if array.dtype not in types:
            types[array.dtype] = h5py.h5t.py_create(array.dtype, logical=True)
        if array.shape not in shapes:
            shapes[array.shape] = h5py.h5s.create_simple(array.shape)
        made = h5py.h5d.create(group, name.encode(), types[array.dtype], shapes[array.shape], plain)
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(array))

    columns = transitions.columns()
    infos = {info: columns[name] for info, name in _INFOS.items() if name in columns}
    S = record.recipe.spec.state_dim
    # The task's own truncation, which a termination in the same step does not hide.
    out_of_time = transitions.next_observations[:, S] == 1.0
    truncations = transitions.timeouts | out_of_time
    with h5py.File("memory", "w", driver="core", backing_store=False, block_size=2**22) as file:
        first = 0
        for number, end in enumerate(transitions.ends.tolist()):
            rows, last = slice(first, end), slice(end - 1, end)
            episode = file.create_group(f"episode_{number}")
            episode.attrs["id"] = number
            episode.attrs["total_steps"] = end - first
            episode.attrs["behaviour"] = int(transitions.components[first])
            seen, after = transitions.observations, transitions.next_observations
            put(episode.id, "observations", np.concatenate([seen[rows], after[last]]))
            put(episode.id, "actions", transitions.actions[rows])
            put(episode.id, "rewards", transitions.rewards[rows])
            put(episode.id, "terminations", transitions.terminations[rows])
            put(episode.id, "truncations", truncations[rows])
            group = episode.create_group("infos").id
            states = np.concatenate([transitions.states[rows], transitions.next_states[last]])
            put(group, "state", states)
            for info, column in infos.items():
                put(group, info, np.concatenate([column[rows], column[last]]))
            first = end
        file.flush()
        return bytes(file.id.get_file_image())


def _read_hdf5(path: Path, record: DatasetRecord) -> Transitions:
    """The arrays of a file, through h5py's low level as in `_hdf5`."""
    import h5py

    team = record.recipe.spec.team is not None
    parts: dict[str, list[npt.NDArray[Any]]] = {}

    def get(group: Any, name: str) -> npt.NDArray[Any]:
        stored = h5py.h5d.open(group, name.encode())
        array = np.empty(stored.shape, stored.dtype)
        stored.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
        return array

    def add(**arrays: npt.NDArray[Any]) -> None:
        for name, array in arrays.items():
            parts.setdefault(name, []).append(array)

    with h5py.File(path, "r") as file:
        for number in range(record.trajectories):
            episode = file[f"episode_{number}"]
            seen = get(episode.id, "observations")
            terminations = get(episode.id, "terminations")
            add(
                observations=seen[:-1],
                actions=get(episode.id, "actions"),
                rewards=get(episode.id, "rewards"),
                next_observations=seen[1:],
                terminations=terminations,
                timeouts=get(episode.id, "truncations") & ~terminations,
                episodes=np.full(len(terminations), number, np.int64),
                components=np.full(len(terminations), episode.attrs["behaviour"], np.int64),
            )
            infos = h5py.h5g.open(episode.id, b"infos")
            states = get(infos, "state")
            add(states=states[:-1], next_states=states[1:])
            for info, name in _INFOS.items():
                if team or info != "agent_reward":
                    add(**{name: get(infos, info)[:-1]})
    return Transitions(**{name: np.concatenate(arrays) for name, arrays in parts.items()})


def _write_through(path: Path, content: bytes) -> None:
    """Write a file and wait until it is on the disk."""
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _put_in_place(building: Path, target: Path) -> None:
    """Rename a finished set over its place; one that stood there goes only once it is replaced."""
    if not os.path.lexists(target):
        os.rename(building, target)
        return
    before = Path(tempfile.mkdtemp(prefix=f".{target.name[:64]}.replaced.", dir=target.parent))
    os.rename(target, before / "set")
    try:
        os.rename(building, target)
    except BaseException:
        os.rename(before / "set", target)
        before.rmdir()
        raise
    shutil.rmtree(before, ignore_errors=True)


def _describe_namespaces(parent: Path, folder: Path) -> None:
    """The file by which Minari knows a namespace, in each folder between; as Minari writes it."""
    while parent != folder:
        path = parent / NAMESPACE_METADATA
        if not path.exists():
            with contextlib.suppress(FileExistsError), path.open("x") as stream:
                json.dump({}, stream)
        parent = parent.parent

"""Data sets on disk, in Minari's folders: written completely or not at all, and checked on reading.

    <folder>/<namespace>/<name>-v<N>/data/main_data.hdf5   the arrays, see `minari_format`
                                          metadata.json    Minari's, with `DatasetRecord` as "sme"

The folder is MINARI_DATASETS_PATH, else ~/.minari/datasets, unless another one is passed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.minari_format import (
    DATA,
    METADATA,
    NAMESPACE_METADATA,
    minari_dataset,
    minari_metadata,
    read_hdf5,
    require_minari,
    to_hdf5,
)
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.record import KEY, DatasetRecord
from sme_registry.errors import (
    DigestMismatchError,
    MalformedDocumentError,
    NameTakenError,
    OptionError,
    SMEError,
    SpecError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import build_folder, read_json, refuse_unwritable, to_json, write_atomically

NAMESPACE = "sme"
_ID = re.compile(r"([A-Za-z0-9_-]+/)*[A-Za-z0-9_-]+-v[0-9]+")


@dataclass(frozen=True)
class Dataset:
    """A data set on disk, with its metadata read and checked.

    Examples:
      >>> from sme_registry.datasets import open_dataset
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> data.transitions().observations.shape
      (200, 10)
    """

    id: str  # Minari's, such as `sme/Default-v1-nu50-seed7-v0`
    path: Path  # its folder, which contains `data/`
    record: DatasetRecord

    @property
    def recipe(self) -> DatasetRecipe:
        return self.record.recipe

    @property
    def size_bytes(self) -> int:
        return sum(file.stat().st_size for file in (self.path / "data").iterdir())

    def minari(self) -> Any:
        """The data set as a `minari.MinariDataset`."""
        return minari_dataset(self.path / "data")

    def transitions(self) -> Transitions:
        """All transitions as aligned arrays, bit for bit as they were written."""
        require_minari()
        path = self.path / "data" / DATA
        try:
            transitions = read_hdf5(path, self.record)
        except (OSError, KeyError, ValueError, RuntimeError) as error:
            raise MalformedDocumentError(
                f"{path}: cannot be read: {str(error).strip(chr(39))}. Download the data set "
                "again, or generate it again (--force)."
            ) from None
        if transitions.digest != self.record.arrays_digest:
            raise DigestMismatchError(
                f"{path}: its arrays have {transitions.digest[:19]}…: must be "
                f"{self.record.arrays_digest[:19]}…, as generated. They were changed or extended. "
                "Download the data set again, generate it again (--force), or read it with Minari, "
                "which does not check digests."
            )
        return transitions


def datasets_folder(folder: str | os.PathLike[str] | None = None) -> Path:
    """The folder passed, else Minari's: MINARI_DATASETS_PATH, else ~/.minari/datasets.

    Examples:
      >>> from sme_registry.datasets import datasets_folder
      >>> datasets_folder("data").name
      'data'
    """
    default = os.environ.get("MINARI_DATASETS_PATH", Path.home() / ".minari" / "datasets")
    return Path(default if folder is None else folder)


def check_id(dataset_id: str) -> str:
    """Raise OptionError if Minari does not accept an id; it must be ASCII and have a version."""
    *namespace, _ = dataset_id.split("/")
    # Minari's own pattern requires two characters; `data` is the folder inside a data set.
    short = len("/".join(namespace)) == 1
    if not _ID.fullmatch(dataset_id) or "data" in namespace or short:
        raise OptionError(
            f"name={dataset_id!r}: must be [namespace/]name-v<number> of letters, digits, '_' and "
            "'-' (a namespace of two characters or more, and not 'data'), as in 'sme/mine-v0'."
        )
    return dataset_id


def check_target(target: Path, folder: Path, recipe: DatasetRecipe, force: bool) -> None:
    """Check that a data set may be written to a path in the root of all data sets."""
    for parent in target.relative_to(folder).parents:
        if parent != Path() and (folder / parent / "data").exists():
            raise OptionError(
                f"name: {folder / parent} is a data set, and Minari lists none inside another. "
                "Give another namespace."
            )
    refuse_unwritable(target)
    if not os.path.lexists(target):
        return
    if not force:
        raise NameTakenError(
            f"{target} already exists{_comparison(target, recipe)}. Give another --name or --out, "
            "or --force to replace it (in Python, force=True)."
        )
    try:
        replaceable = KEY in _read_metadata(target)
    except SMEError:
        replaceable = False
    if not replaceable:
        raise NameTakenError(
            f"{target} already exists and is not a data set of this package, so it is not "
            "replaced. Give another --name or --out, or remove it yourself."
        )


def _comparison(target: Path, recipe: DatasetRecipe) -> str:
    """How an existing data set differs from a new one; empty if it cannot be opened."""
    try:
        existing = open_dataset(target).recipe
    except SMEError:
        return ""
    if existing.digest != recipe.digest:
        return f", with another recipe: {'; '.join(existing.differences(recipe))}"
    if any(
        behaviour.kind == "policy" and behaviour.sha256 is None for behaviour in existing.behaviours
    ):
        return ", with the same recipe (a policy without a file is compared by its name)"
    return " and is the same data set"


def write_dataset(
    dataset_id: str,
    record: DatasetRecord,
    transitions: Transitions,
    folder: Path,
    *,
    force: bool = False,
) -> Dataset:
    """Write a data set completely or not at all; with `force` an old one remains until then."""
    target = folder / dataset_id
    check_target(target, folder, record.recipe, force)
    content = to_hdf5(transitions, record)
    metadata = minari_metadata(dataset_id, record, len(content))
    write_minari(target, folder, content, metadata, force=force)
    return Dataset(dataset_id, target, record)


def write_minari(
    target: Path, folder: Path, content: bytes, metadata: dict[str, Any], *, force: bool
) -> None:
    with build_folder(target, force=force) as building:
        _write_namespaces(target.parent, folder)
        (building / "data").mkdir()
        (building / "data" / DATA).write_bytes(content)
        (building / "data" / METADATA).write_bytes(to_json(metadata).encode())


def _write_namespaces(namespace: Path, folder: Path) -> None:
    """Write the empty metadata by which Minari recognises a namespace, and those above it."""
    while namespace != folder:
        path = namespace / NAMESPACE_METADATA
        if not path.exists():
            write_atomically(path, "{}")
        namespace = namespace.parent


def open_dataset(
    id_or_path: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None
) -> Dataset:
    """Open a data set of this package by its id or its path. Reads only the metadata.

    The path is that of its folder, or of the `data/` in it; `folder` is the root of all data sets,
    None for Minari's. Its digests are checked, its arrays are not: `Dataset.transitions` does.

    Examples:
      >>> from sme_registry.datasets import open_dataset
      >>> open_dataset("sme/Default-v1-nu50-seed0-v0", "data").recipe.transitions
      200
    """
    root = datasets_folder(folder)
    path = Path(id_or_path)
    path = path.parent if path.name == "data" else path
    is_id = isinstance(id_or_path, str) and _ID.fullmatch(id_or_path)
    if is_id and (root / id_or_path / "data").is_dir():
        path = root / id_or_path
    if not (path / "data").is_dir():
        known = [dataset_id for dataset_id, _ in _folders(root)]
        raise UnknownNameError(
            f"{os.fspath(id_or_path)!r}: is neither the id of a data set in {root} nor the path of "
            f"one.{did_you_mean(os.fspath(id_or_path), known)} `sme dataset list` lists them."
        )
    metadata = _read_metadata(path)
    if KEY not in metadata:
        raise MalformedDocumentError(
            f"{path / 'data' / METADATA}: was not written by `sme dataset make`. Minari can open "
            "it: minari.MinariDataset(path)."
        )
    return _dataset(path, metadata)


def _read_metadata(path: Path) -> dict[str, Any]:
    """The metadata of a data set's folder; empty if it is not a JSON object."""
    metadata = read_json(path / "data" / METADATA)
    return metadata if isinstance(metadata, dict) else {}


def _dataset(path: Path, metadata: dict[str, Any]) -> Dataset:
    source = path / "data" / METADATA
    record = DatasetRecord.from_dict(metadata[KEY], str(source))
    for field, expected in (
        ("total_steps", record.recipe.transitions),
        ("total_episodes", record.trajectories),
    ):
        if metadata.get(field) != expected:
            raise DigestMismatchError(
                f"{source}: {field}={metadata.get(field)!r}: must be {expected}, as generated. The "
                "data set was extended. Download it again, or read it with Minari."
            )
    return Dataset(str(metadata.get("dataset_id")), path, record)


def check_location(dataset: Dataset, folder: str | os.PathLike[str] | None = None) -> None:
    """Raise SpecError if the path of a data set disagrees with its id, which would open another.

    Inside the root of all data sets (None for Minari's folder), the path relative to it must equal
    the id, as in Minari; elsewhere the path must end with the id.

    Examples:
      >>> from sme_registry.datasets import check_location, open_dataset
      >>> check_location(open_dataset("sme/Default-v1-nu50-seed0-v0", "data"), "data")
    """
    # Not resolved: a symbolic link in the right place is correct.
    path, root = Path(os.path.abspath(dataset.path)), Path(os.path.abspath(datasets_folder(folder)))
    inside = path.is_relative_to(root)
    id_parts = tuple(dataset.id.split("/"))
    if id_parts != (path.relative_to(root).parts if inside else path.parts[-len(id_parts) :]):
        home = root / dataset.id if inside else f"a folder {dataset.id}"
        raise SpecError(
            f"{path}: contains the data set {dataset.id}. Move or copy it back to {home}, or "
            "remove it if that already exists. To change its name, generate it with --name."
        )


def list_datasets(
    folder: str | os.PathLike[str] | None = None,
) -> tuple[list[Dataset], dict[Path, str]]:
    """All data sets of this package in a root, by id, and by its path the error of each broken one.

    Examples:
      >>> from sme_registry.datasets import list_datasets
      >>> valid, broken = list_datasets("data")
      >>> [dataset.id for dataset in valid], broken
      (['sme/Default-v1-nu50-seed0-v0'], {})
    """
    root = datasets_folder(folder)
    datasets: list[Dataset] = []
    errors: dict[Path, str] = {}
    for dataset_id, path in _folders(root):
        try:
            metadata = _read_metadata(path)
            if KEY in metadata:
                dataset = _dataset(path, metadata)
                check_location(dataset, root)
                datasets.append(dataset)
        except SMEError as error:
            errors[root / dataset_id] = str(error)
    return datasets, errors


def _folders(root: Path) -> Iterator[tuple[str, Path]]:
    for folder, children, _ in os.walk(root, followlinks=True):
        path = Path(folder)
        if "data" in children and path != root:
            yield path.relative_to(root).as_posix(), path
            children.clear()
        children[:] = sorted(child for child in children if not child.startswith("."))

"""Data sets on disk, in Minari's folders: written completely or not at all, and checked on reading.

    <folder>/<namespace>/<name>-v<N>/data/main_data.hdf5   the arrays
                                          metadata.json    Minari's, with `DatasetRecord` as "sme"

The folder is MINARI_DATASETS_PATH, else ~/.minari/datasets, unless another one is passed. A sealed
data set has the columns that an agent sees, and no record.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.collect import ReportProgress, collect, reference_scores
from sme_registry.datasets.documents import (
    KEY,
    DatasetRecipe,
    DatasetRecord,
    Seeds,
    parse_behaviour,
)
from sme_registry.datasets.minari_format import (
    DATA,
    METADATA,
    VISIBLE,
    about_task,
    metadata_of,
    minari_dataset,
    read_columns,
    require_minari,
    to_hdf5,
)
from sme_registry.datasets.transitions import AlignedArrays, Arrays, Transitions
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
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io import (
    build_folder,
    check_writable,
    choice,
    is_regular,
    read_json,
    to_json,
    versions,
    write_atomically,
)
from sme_registry.spec import SMESpec, catalogue
from sme_registry.spec.sme_spec import ACTION_RANGES, SpecLike
from sme_registry.spec.suite import ProtocolLike
from sme_registry.task import load, materialize
from sme_registry.task.task import Array, Mask, Observation

_SEALED = "sealed/"  # begins the id of a season's data set
_NAMESPACE = "namespace_metadata.json"
_SHA256 = "sme_sha256"  # in the metadata: of the file of arrays; data sets of before have none
_ID = re.compile(r"([A-Za-z0-9_-]+/)*[A-Za-z0-9_-]+-v[0-9]+")
_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "h5py", "minari")


@dataclass(frozen=True)
class Dataset:
    """A data set on disk, with its metadata read and checked."""

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
        return minari_dataset(self.path / "data")

    def transitions(self) -> Transitions:
        """All transitions as aligned arrays, bit for bit as they were written."""
        columns = read_columns(self.path, visible=False)
        timeouts = columns.pop("truncations") & ~columns["terminations"]
        transitions = Transitions(**columns, timeouts=timeouts)
        if transitions.digest != self.record.arrays_digest:
            raise DigestMismatchError(
                f"{self.path / 'data' / DATA}: its arrays have {transitions.digest[:19]}…: must "
                f"be {self.record.arrays_digest[:19]}…, as generated. They were changed or "
                "extended. Download the data set again, generate it again (--force), or read it "
                "with Minari, which does not check digests."
            )
        data = self.path / "data" / DATA
        written = _read_metadata(self.path).get(_SHA256)
        if written is not None and written != hashlib.sha256(data.read_bytes()).hexdigest():
            raise DigestMismatchError(
                f"{data}: other bytes than were written, though its arrays are the same. Download "
                "the data set again, or generate it again (--force)."
            )
        return transitions


@dataclass(frozen=True, eq=False)
class SealedDataset(AlignedArrays):
    """What entrants of a season get of a data set: aligned arrays, and nothing that tells its task.

    The columns are those of `Transitions`, but that `rewards` may be float32. `truncations` `[N]`
    are true where an episode ended at the horizon, or the data set does: bootstrap, unless the same
    row terminates.
    """

    FILES: ClassVar = (f"data/{DATA}", f"data/{METADATA}")  # in its folder

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: Array | npt.NDArray[np.float32]
    next_observations: Observation
    terminations: Mask
    truncations: Mask

    @classmethod
    def collect(cls, recipe: DatasetRecipe, progress: ReportProgress | None = None) -> Self:
        """Generate the transitions of a recipe of mixtures."""
        rows = collect(recipe, materialize(recipe.spec), progress=progress)
        return cls(**{name: getattr(rows, name) for name in VISIBLE})

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a data set's folder, which contains `data/`."""
        return cls(**read_columns(Path(path), visible=True))

    def rounded(self) -> Self:
        """The same with float32 rewards: their bits hardly ever depend on the processor."""
        return replace(self, rewards=self.rewards.astype(np.float32))

    def agrees_with(self, other: Self) -> bool:
        """Whether the other has the same transitions, up to 1e-6: machines round differently."""
        columns = other.columns()
        return all(
            mine.shape == columns[name].shape and np.allclose(mine, columns[name], 1e-6, 1e-6)
            for name, mine in self.columns().items()
        )

    def write(self, dataset_id: str, folder: str | os.PathLike[str]) -> Path:
        """Write the data set in Minari's format, completely or not at all; returns its folder."""
        require_minari()
        target = Path(folder) / check_id(dataset_id)
        if os.path.lexists(target):
            raise NameTakenError(
                f"{target} already exists and is not replaced. Remove it yourself."
            )
        return _write(dataset_id, Path(folder), self.columns())


def make_dataset(
    spec_or_id: SpecLike,
    nu: float | None = None,
    *,
    mix: Sequence[tuple[Any, float]] | None = None,
    transitions: int = 50_000,
    seed: int | str = 0,
    coverage: float | None = None,
    protocol: ProtocolLike = "paper-v1",
    action_range: str | None = None,
    name: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: ReportProgress | None = None,
) -> Dataset:
    """Generate a data set of a chosen quality and write it in Minari's HDF5 format.

    It is written completely or not at all. The same arguments give the same bits of every array and
    the same bytes of the file. `progress` is called with the transitions collected and their total.

    Args:
      nu: ν in [0, 1] of the mixture that acts: 0 is the optimum, 1 the worst. The default is 0.5
        unless `mix` is given.
      mix: several behaviour policies instead of `nu`: pairs of a policy (ν as a number; "random"; a
        callable, a Stable-Baselines3 model, or the path of its .zip or of an .onnx) and its share
        of the transitions. The shares must add up to 1.
      transitions: N, the exact number; the last episode of each behaviour is truncated.
      seed: of the starts, each α, ã and random actions; independent of the task's. An integer in
        [0, 2⁵³), or hexadecimal text such as '0x9f86'.
      coverage: ε in (−1, 0]: keeps only transitions from {s : ‖s − ½‖_∞ ≤ (1 + ε)/2}.
      protocol: for the evaluation of policies that learn from the data set.
      action_range: of the policies' actions in `mix`; None takes their own.
      name: Minari's id, `[namespace/]name-v<number>`; None generates a descriptive one. A name that
        is taken is a NameTakenError, unless `force` replaces a data set of this package.
      folder: the root of all data sets; None for Minari's folder.

    Examples:
      >>> from sme_registry.datasets import make_dataset
      >>> data = make_dataset("Default", 0.3, transitions=200, folder="mine", protocol="quick-v1")
      >>> len(data.transitions())
      200
    """
    require_minari()
    if nu is not None and mix is not None:
        raise OptionError("nu, mix: give only one of them. `mix` accepts ν as a policy.")
    if action_range is not None:
        choice("action_range", action_range, ACTION_RANGES)
    pairs = [(0.5 if nu is None else nu, 1.0)] if mix is None else _pairs(mix)
    behaviours = [parse_behaviour(policy, weight, action_range) for policy, weight in pairs]
    if action_range is not None and all(b.kind != "policy" for b in behaviours):
        raise OptionError(f"action_range={action_range!r}: is of policies in `mix`. Leave it out.")
    recipe = DatasetRecipe.from_dict(
        {
            "spec": load(spec_or_id, SMESpec),
            "behaviours": behaviours,
            "transitions": transitions,
            "seed": seed,
            "coverage": coverage,
            "protocol": resolve_protocol(protocol),
        },
        "data set",
    )
    policies = dict(enumerate(policy for policy, _ in pairs))
    dataset_id = check_id(_default_id(recipe) if name is None else name)
    root = datasets_folder(folder)
    _check_target(root / dataset_id, root, recipe, force)

    task = materialize(recipe.spec)
    arrays = collect(recipe, task, policies, progress=progress)
    record = DatasetRecord(
        recipe=recipe,
        recipe_digest=recipe.digest,
        spec_digest=recipe.spec.digest,
        task=recipe.spec.name,
        protocol_digest=recipe.protocol.digest,
        seeds=Seeds(task=recipe.spec.seed, data=recipe.seed),
        nu=recipe.behaviours[0].nu if len(pairs) == 1 else None,
        trajectories=len(arrays.ends),
        scores=reference_scores(recipe, task, arrays, policies),
        arrays_digest=arrays.digest,
        versions=versions(_PACKAGES),
    )
    columns = {**arrays.columns(), "truncations": arrays.truncations}
    return Dataset(dataset_id, _write(dataset_id, root, columns, record, force=force), record)


def _default_id(recipe: DatasetRecipe) -> str:
    """`sme/Default-v1-nu50-side80-seed7-v0`: task, behaviour, the sub-cube's side, data seed."""
    title = catalogue.unique_name(recipe.spec)
    behaviour = recipe.behaviours[0]
    if len(recipe.behaviours) > 1:
        acting = f"mix-{recipe.digest.removeprefix('sha256:')[:8]}"
    elif behaviour.nu is not None:
        acting = f"nu{_hundredths(behaviour.nu)}"
    elif behaviour.kind == "random":
        acting = "random"
    else:
        acting = "policy-" + re.sub("[^A-Za-z0-9]", "_", behaviour.label)
    side = "" if not recipe.coverage else f"-side{_hundredths(1.0 + recipe.coverage)}"
    return f"sme/{title}-{acting}{side}-seed{recipe.seed}-v0"


def _hundredths(value: float) -> str:
    """0.5 as `50`, 0.125 as `12_5`."""
    return f"{100 * value:.10g}".replace(".", "_").replace("-", "m").replace("+", "")


def _pairs(mix: Any) -> list[tuple[Any, float]]:
    try:
        return [(policy, share) for policy, share in mix]
    except (TypeError, ValueError):
        text = f"mix={mix!r:.60}: must be pairs of a policy and its share: [(0.5, 1)]."
        raise OptionError(text) from None


def check_id(dataset_id: str) -> str:
    """Raise OptionError if Minari does not accept an id; it must be ASCII and have a version."""
    dataset_id = str(dataset_id)
    *namespace, _ = dataset_id.split("/")
    # Minari's own pattern requires two characters; `data` is the folder inside a data set.
    short = len("/".join(namespace)) == 1
    if not _ID.fullmatch(dataset_id) or "data" in namespace or short:
        raise OptionError(
            f"name={dataset_id!r}: must be [namespace/]name-v<number> of letters, digits, '_' and "
            "'-' (a namespace of two characters or more, and not 'data'), as in 'sme/mine-v0'."
        )
    return dataset_id


def _check_target(target: Path, root: Path, recipe: DatasetRecipe, force: bool) -> None:
    for parent in target.relative_to(root).parents[:-1]:
        if (root / parent / "data").exists():
            raise OptionError(
                f"name: {root / parent} is a data set, and Minari lists none inside another. "
                "Give another namespace."
            )
    check_writable(target)
    if not os.path.lexists(target):
        return
    if not force:
        raise NameTakenError(
            f"{target} already exists{_comparison(target, recipe)}. Give another --name or --out, "
            "or --force to replace it (in Python, force=True)."
        )
    try:
        is_ours = KEY in _read_metadata(target)
    except SMEError:
        is_ours = False
    if not is_ours:
        raise NameTakenError(
            f"{target} already exists and is not a data set of this package, so it is not "
            "replaced. Give another --name or --out, or remove it yourself."
        )


def _comparison(target: Path, recipe: DatasetRecipe) -> str:
    """How an existing data set compares with a new one."""
    try:
        is_same = open_dataset(target).recipe.digest == recipe.digest
    except SMEError:
        return ""
    return f", with {'the same' if is_same else 'another'} recipe"


def _write(
    dataset_id: str,
    root: Path,
    columns: Arrays,
    record: DatasetRecord | None = None,
    *,
    force: bool = False,
) -> Path:
    target = root / dataset_id
    content = to_hdf5(columns)
    metadata = metadata_of(dataset_id, columns, len(content))
    if record is not None:
        metadata |= about_task(record)
        metadata[_SHA256] = hashlib.sha256(content).hexdigest()
    with build_folder(target, force=force) as building:
        for namespace in target.relative_to(root).parents[:-1]:
            path = root / namespace / _NAMESPACE  # by which Minari recognises it
            if not path.exists():
                write_atomically(path, "{}")
        (building / "data").mkdir()
        (building / "data" / DATA).write_bytes(content)
        (building / "data" / METADATA).write_bytes(to_json(metadata).encode())
    return target


def datasets_folder(folder: str | os.PathLike[str] | None = None) -> Path:
    """The folder passed, else Minari's: MINARI_DATASETS_PATH, else ~/.minari/datasets."""
    default = os.environ.get("MINARI_DATASETS_PATH", Path.home() / ".minari" / "datasets")
    return Path(default if folder is None else folder)


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
            f"one.{did_you_mean(os.fspath(id_or_path), known)} `sme data list` lists them."
        )
    dataset = _open(path)
    if dataset is None:
        raise MalformedDocumentError(
            f"{path / 'data' / METADATA}: was not written by `sme data make`. Minari can open "
            "it: minari.MinariDataset(path)."
        )
    return dataset


def is_sealed(path: str | os.PathLike[str]) -> bool:
    """Whether a folder is that of a season's data set, which does not name its task."""
    if not is_regular(Path(path) / "data" / METADATA):
        return False
    return str(_read_metadata(Path(path)).get("dataset_id")).startswith(_SEALED)


def _read_metadata(path: Path) -> dict[str, Any]:
    metadata = read_json(path / "data" / METADATA)
    return metadata if isinstance(metadata, dict) else {}


def _open(path: Path) -> Dataset | None:
    """The data set in a folder; None if another package wrote it."""
    metadata, source = _read_metadata(path), path / "data" / METADATA
    if KEY not in metadata:
        return None
    record = DatasetRecord.from_dict(metadata[KEY], str(source))
    sizes = {"total_steps": record.recipe.transitions, "total_episodes": record.trajectories}
    for field, expected in sizes.items():
        if metadata.get(field) != expected:
            raise DigestMismatchError(
                f"{source}: {field}={metadata.get(field)!r}: must be {expected}, as generated. The "
                "data set was extended. Download it again, or read it with Minari."
            )
    return Dataset(str(metadata.get("dataset_id")), path, record)


def check_location(dataset: Dataset, folder: str | os.PathLike[str] | None = None) -> None:
    """Check that the path of a data set agrees with its id, else SpecError; and its namespaces."""
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
    for namespace in path.parents[: len(id_parts) - 1]:
        file = namespace / _NAMESPACE
        if file.exists() and not isinstance(read_json(file), dict):
            raise MalformedDocumentError(
                f"{file}: must be a JSON object, such as {{}}: Minari reads it. Correct it."
            )


def list_datasets(
    folder: str | os.PathLike[str] | None = None,
) -> tuple[list[Dataset], dict[Path, str]]:
    """This package's data sets in a root, by id, and by its path the error of each broken one."""
    root = datasets_folder(folder)
    datasets: list[Dataset] = []
    errors: dict[Path, str] = {}
    for dataset_id, path in _folders(root):
        try:
            dataset = _open(path)
            if dataset is not None:
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

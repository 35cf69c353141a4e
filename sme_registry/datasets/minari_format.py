"""Minari's layout of a data set: its columns as an HDF5 file, and the file's metadata.

An episode of T steps holds `observations` `[T + 1, O]`, `infos/state` `[T + 1, S]` and, where the
task has distractors, `infos/distractors` `[T + 1, m]`. Minari requires length T + 1 for every info:
the last row of the others repeats the row before it. A sealed data set has no infos.

Minari writes resizable HDF5 datasets, which take several times the space if episodes are short.
These are of fixed size.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.datasets.documents import KEY, DatasetRecord
from sme_registry.datasets.transitions import Arrays, Transitions
from sme_registry.errors import MalformedDocumentError
from sme_registry.io import require_packages
from sme_registry.registration import env_spec

DATA, METADATA = "main_data.hdf5", "metadata.json"
VISIBLE = {  # what an agent sees: types and number of dimensions
    "observations": ((np.float32,), 2),
    "actions": ((np.float32,), 2),
    "rewards": ((np.float64, np.float32), 1),
    "next_observations": ((np.float32,), 2),
    "terminations": ((np.bool_,), 1),
    "truncations": ((np.bool_,), 1),
}
_INFOS = {  # the column of an info's rows, and that of the row after the last step
    "state": ("states", "next_states"),
    "distractors": ("distractors", "next_distractors"),
    "optimal_action": ("optimal_actions", "optimal_actions"),
    "similarity": ("similarities", "similarities"),
    "step_reward": ("step_rewards", "step_rewards"),
    "regret": ("regrets", "regrets"),
    "agent_reward": ("agent_rewards", "agent_rewards"),
    "cost": ("costs", "costs"),
    "limit": ("limits", "limits"),
    "safe_action": ("safe_actions", "safe_actions"),
    "safe_regret": ("safe_regrets", "safe_regrets"),
    "price": ("prices", "prices"),
    "shaping": ("shapings", "shapings"),
    "reward_noise": ("reward_noises", "reward_noises"),
    "transition_noise": ("transition_noises", "transition_noises"),
}
_REQUIRED = {field.name for field in fields(Transitions) if field.default is MISSING}


def require_minari() -> None:
    require_packages("data sets", {"minari": "Minari", "h5py": "h5py"}, "offline")


def minari_dataset(data_folder: Path) -> Any:
    require_minari()
    import minari

    return minari.MinariDataset(data_folder)


def _ends(columns: Arrays) -> list[int]:
    """The index after the last row of each episode."""
    ended = columns["terminations"] | columns["truncations"]
    ends: list[int] = (np.flatnonzero(ended) + 1).tolist()
    return ends


def metadata_of(dataset_id: str, columns: Arrays, size_bytes: int) -> dict[str, Any]:
    """Minari's metadata of a data set; nothing in them is about the task."""
    import minari
    from minari.serialization import serialize_space

    observation_space, action_space = (
        gymnasium.spaces.Box(0.0, 1.0, columns[name].shape[1:], np.float32)
        for name in ("observations", "actions")
    )
    return {
        "total_episodes": len(_ends(columns)),
        "total_steps": len(columns["rewards"]),
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": serialize_space(observation_space),
        "action_space": serialize_space(action_space),
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
        "dataset_size": round(size_bytes / 1e6, 1),
    }


def about_task(record: DatasetRecord) -> dict[str, Any]:
    recipe, scores = record.recipe, record.scores
    metadata: dict[str, Any] = {
        "algorithm_name": " + ".join(
            f"{behaviour.weight:g} × {behaviour.label}" for behaviour in recipe.behaviours
        ),
        "description": (
            f"{recipe.transitions:,} transitions of the Synthetic Monitoring Environment "
            f"{recipe.spec.content_name}, with π*, similarity and regret of each. The reference "
            "scores are returns: the least of the constant action 0.5, the greatest of π*."
        ),
        "requirements": [f"sme-registry>={record.versions['sme_registry']}"],
    }
    if recipe.spec.team is None:  # Gymnasium has no environments for several agents
        metadata["env_spec"] = env_spec(recipe.spec).to_json()
    floor, ceiling = scores.constant.rollouts, scores.optimum.rollouts
    if floor is not None and ceiling is not None:
        metadata |= {
            "ref_min_score": floor.mean_return,
            "ref_max_score": ceiling.mean_return,
            "num_episodes_average_score": floor.episodes,
        }
    return {**metadata, KEY: record.to_dict()}


def to_hdf5(columns: Arrays) -> bytes:
    """The content of `main_data.hdf5` with these columns; the same arrays give the same bytes.

    Built in memory, so that a full disk fails one write.
    """
    import h5py

    infos = {info: pair for info, pair in _INFOS.items() if pair[0] in columns}
    with h5py.File("memory", "w", driver="core", backing_store=False, block_size=2**22) as file:
        for number, (first, end) in enumerate(itertools.pairwise([0, *_ends(columns)])):
            rows, last = slice(first, end), slice(end - 1, end)
            episode = file.create_group(f"episode_{number}")
            episode.attrs["id"] = number
            episode.attrs["total_steps"] = end - first
            if "components" in columns:
                episode.attrs["behaviour"] = int(columns["components"][first])
            seen = columns["observations"][rows], columns["next_observations"][last]
            episode.create_dataset("observations", data=np.concatenate(seen))
            for name in ("actions", "rewards", "terminations", "truncations"):
                episode.create_dataset(name, data=columns[name][rows])
            group = episode.create_group("infos")
            for info, (before, after) in infos.items():
                stored = columns[before][rows], columns[after][last]
                group.create_dataset(info, data=np.concatenate(stored))
        file.flush()
        return bytes(file.id.get_file_image())


def read_columns(folder: Path, *, visible: bool) -> Arrays:
    """The columns of a data set; of a stranger's file, only what `to_hdf5` writes."""
    require_minari()
    path = folder / "data" / DATA
    try:
        return _read_hdf5(path, visible)
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        raise MalformedDocumentError(
            f"{path}: cannot be read: {str(error).strip(chr(39))}. Download the data set again, or "
            "generate it again (--force)."
        ) from None


def _read_hdf5(path: Path, visible: bool) -> Arrays:
    import h5py

    if not path.is_file():  # a pipe would be waited for
        raise OSError("no such file")
    with h5py.File(path, "r") as file:
        source = _Source(path)
        episodes = []
        for number in range(len(file)):
            group = source.group(file, f"episode_{number}")
            columns = _visible_columns(source, group)
            if not visible:
                columns |= _hidden_columns(source, group)
                _check_rest(group, number, len(columns["rewards"]))
                columns["episodes"] = np.full(len(columns["rewards"]), number, np.int64)
            episodes.append(columns)
    if not episodes:
        raise ValueError("it has no episodes")
    return {name: np.concatenate([part[name] for part in episodes]) for name in episodes[0]}


def _visible_columns(source: _Source, group: Any) -> Arrays:
    observations = source.array(group, "observations")
    columns = {"observations": observations[:-1], "next_observations": observations[1:]}
    columns |= {name: source.array(group, name) for name in VISIBLE if name not in columns}
    steps = len(columns["rewards"])
    for name, (dtypes, ndim) in VISIBLE.items():
        column = columns[name]
        if column.dtype not in dtypes or column.ndim != ndim or len(column) != steps:
            raise ValueError(
                f"{group.name}: its {name} are {column.dtype} of shape {column.shape}: must be "
                f"{np.dtype(dtypes[0])} in {ndim} dimensions, of {steps} steps"
            )
    return columns


def _hidden_columns(source: _Source, group: Any) -> Arrays:
    infos, columns = source.group(group, "infos"), {}
    for info, (before, after) in _INFOS.items():
        if before in _REQUIRED or info in infos:
            column = source.array(infos, info)
            columns[after] = column[1:]
            columns[before] = column[:-1]  # last, for those of which `after` has no meaning
            if after == before and column[-1:].tobytes() != column[-2:-1].tobytes():
                raise ValueError(f"{group.name}: the last row of {info} is not the one before it")
    columns["components"] = np.full(len(columns["states"]), group.attrs["behaviour"], np.int64)
    return columns


def _check_rest(group: Any, number: int, steps: int) -> None:
    """Check what no digest of arrays is about, and Minari reads."""
    for name, expected in (("id", number), ("total_steps", steps)):
        if group.attrs[name] != expected:
            raise ValueError(f"{group.name}: {name}={group.attrs[name]}: must be {expected}")


class _Source:
    """A file whose arrays must lie in it as plain numbers.

    HDF5 could otherwise take them from any file of this machine (external storage, links), invent
    them (chunks that were never written), or make pointers of them (texts of variable length).
    """

    def __init__(self, path: Path) -> None:
        self._left = path.stat().st_size

    def group(self, parent: Any, name: str) -> Any:
        import h5py

        return self._member(parent, name, h5py.Group)

    def array(self, parent: Any, name: str) -> npt.NDArray[Any]:
        import h5py

        stored = self._member(parent, name, h5py.Dataset).id
        plan, dtype, shape = stored.get_create_plist(), stored.dtype, stored.shape
        size = math.prod(shape) * dtype.itemsize
        self._left -= size
        if (
            dtype.kind not in "biuf"
            or plan.get_layout() != h5py.h5d.CONTIGUOUS
            or plan.get_external_count()
            or stored.get_storage_size() != size
            or self._left < 0
        ):
            raise ValueError(
                f"{name}: {dtype} of shape {shape} that the file does not hold as such"
            )
        array = np.empty(shape, dtype)
        stored.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
        return array

    @staticmethod
    def _member(parent: Any, name: str, kind: type) -> Any:
        import h5py

        if name not in parent:
            raise KeyError(f"{name} is missing")
        if not isinstance(parent.get(name, getlink=True), h5py.HardLink):  # to another file
            raise ValueError(f"{name}: is a link")
        if not issubclass(parent.get(name, getclass=True), kind):
            raise ValueError(f"{name}: is no {kind.__name__.lower()}")
        return parent[name]

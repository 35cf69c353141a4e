"""Minari's HDF5 layout of a data set: its arrays as a file, and the file's metadata.

An episode of T steps holds `observations` `[T + 1, O]`, `infos/state` `[T + 1, S]` and, where the
task has distractors, `infos/distractors` `[T + 1, m]`, whose last rows follow the last step. Minari
requires length T + 1 for every info: the last row of the others repeats the row before it and has
no meaning.

Minari writes resizable HDF5 datasets, which take several times the space if episodes are short.
These are of fixed size, so Minari cannot append steps to an existing episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.record import KEY, DatasetRecord
from sme_registry.envs.types import Mask, Observation
from sme_registry.io import require_packages
from sme_registry.registration import env_spec
from sme_registry.spec import SMESpec
from sme_registry.task.draw import agents

DATA, METADATA, NAMESPACE_METADATA = "main_data.hdf5", "metadata.json", "namespace_metadata.json"
_INFOS = {
    "optimal_action": "optimal_actions",
    "similarity": "similarities",
    "step_reward": "step_rewards",
    "regret": "regrets",
}
_TEAM_INFOS = {"agent_reward": "agent_rewards"}
_SAFETY_INFOS = {
    "cost": "costs",
    "limit": "limits",
    "safe_action": "safe_actions",
    "safe_regret": "safe_regrets",
}


def _infos(spec: SMESpec) -> dict[str, str]:
    """The infos of a task's data sets that are about a step, and the columns that they hold."""
    team = {} if spec.team is None else _TEAM_INFOS
    return _INFOS | team | ({} if spec.safety is None else _SAFETY_INFOS)


def _position_infos(spec: SMESpec) -> dict[str, tuple[str, str]]:
    """Those that are about where a step begins and ends, and their two columns."""
    distractors = {"distractors": ("distractors", "next_distractors")} if spec.distractors else {}
    return {"state": ("states", "next_states"), **distractors}


def require_minari() -> None:
    """Raise MissingDependencyError if Minari or h5py is not installed; imports neither."""
    require_packages("data sets", {"minari": "Minari", "h5py": "h5py"}, "offline")


def minari_dataset(data_folder: Path) -> Any:
    require_minari()
    import minari

    return minari.MinariDataset(data_folder)


def minari_metadata(dataset_id: str, record: DatasetRecord, size_bytes: int) -> dict[str, Any]:
    """Minari's metadata of a data set, with our record in it."""
    recipe, scores = record.recipe, record.scores
    observation_dim = recipe.spec.observation_dim - 1 + len(agents(recipe.spec))
    widths = observation_dim, recipe.spec.action_dim
    metadata = {
        **plain_metadata(dataset_id, widths, record.trajectories, recipe.transitions, size_bytes),
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


def plain_metadata(
    dataset_id: str, widths: tuple[int, int], episodes: int, steps: int, size_bytes: int
) -> dict[str, Any]:
    """The metadata that Minari needs; nothing in it is about the task but its dimensions."""
    import minari
    from minari.serialization import serialize_space

    observation_space, action_space = (
        gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32) for width in widths
    )
    return {
        "total_episodes": episodes,
        "total_steps": steps,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": serialize_space(observation_space),
        "action_space": serialize_space(action_space),
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
        "dataset_size": round(size_bytes / 1e6, 1),
    }


class Episode(NamedTuple):
    """One episode of a file: its attributes, its arrays, and its infos by name."""

    attributes: dict[str, int]
    arrays: dict[str, npt.NDArray[Any]]
    infos: dict[str, npt.NDArray[Any]]


def visible_episode(
    number: int,
    observations: Observation,
    last_observation: Observation,
    **arrays: npt.NDArray[Any],
) -> Episode:
    """An episode as its agent saw it: `[T, …]` arrays of its steps, and `[1, O]` after the last."""
    seen = np.concatenate([observations, last_observation])
    attributes = {"id": number, "total_steps": len(observations)}
    return Episode(attributes, {"observations": seen, **arrays}, {})


def to_hdf5(transitions: Transitions, record: DatasetRecord) -> bytes:
    return hdf5_content(_episodes(transitions, record.recipe.spec))


def _episodes(transitions: Transitions, spec: SMESpec) -> Iterator[Episode]:
    columns = transitions.columns()
    truncations = truncations_of(transitions, spec)
    infos = {info: columns[name] for info, name in _infos(spec).items()}
    first = 0
    for number, end in enumerate(transitions.ends.tolist()):
        rows, last = slice(first, end), slice(end - 1, end)
        episode = visible_episode(
            number,
            transitions.observations[rows],
            transitions.next_observations[last],
            actions=transitions.actions[rows],
            rewards=transitions.rewards[rows],
            terminations=transitions.terminations[rows],
            truncations=truncations[rows],
        )
        episode.attributes["behaviour"] = int(transitions.components[first])
        for info, (before, after) in _position_infos(spec).items():
            episode.infos[info] = np.concatenate([columns[before][rows], columns[after][last]])
        for info, column in infos.items():
            episode.infos[info] = np.concatenate([column[rows], column[last]])
        yield episode
        first = end


def truncations_of(transitions: Transitions, spec: SMESpec) -> Mask:
    """`[N]` truncations: the task also truncates at its horizon when that step terminates."""
    at_horizon: Mask = transitions.next_observations[:, spec.observation_dim - 2] == 1.0
    return transitions.timeouts | at_horizon


def hdf5_content(episodes: Iterable[Episode]) -> bytes:
    """The content of `main_data.hdf5` with these episodes; the same arrays give the same bytes.

    Built in memory, so that a full disk fails one write instead of HDF5 in the middle of its work.
    h5py's low-level interface takes half the time: short episodes are many tiny objects.
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
        dataset = h5py.h5d.create(
            group, name.encode(), types[array.dtype], shapes[array.shape], plain
        )
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(array))

    with h5py.File("memory", "w", driver="core", backing_store=False, block_size=2**22) as file:
        for episode in episodes:
            group = file.create_group(f"episode_{episode.attributes['id']}")
            for name, value in episode.attributes.items():
                group.attrs[name] = value
            for name, array in episode.arrays.items():
                put(group.id, name, array)
            infos = group.create_group("infos").id
            for name, array in episode.infos.items():
                put(infos, name, array)
        file.flush()
        return bytes(file.id.get_file_image())


def read_hdf5(path: Path, record: DatasetRecord) -> Transitions:
    import h5py

    spec = record.recipe.spec
    parts: dict[str, list[npt.NDArray[Any]]] = {}

    def add(**arrays: npt.NDArray[Any]) -> None:
        for name, array in arrays.items():
            parts.setdefault(name, []).append(array)

    with h5py.File(path, "r") as file:
        arrays = _Arrays(path)
        for number in range(record.trajectories):
            episode = file[f"episode_{number}"]
            truncations = arrays.get(episode.id, "truncations")
            add(**(seen := arrays.visible(episode.id)))
            add(
                timeouts=truncations & ~seen["terminations"],
                episodes=np.full(len(truncations), number, np.int64),
                components=np.full(len(truncations), episode.attrs["behaviour"], np.int64),
            )
            infos = h5py.h5g.open(episode.id, b"infos")
            for info, (before, after) in _position_infos(spec).items():
                positions = arrays.get(infos, info)
                add(**{before: positions[:-1], after: positions[1:]})
            for info, name in _infos(spec).items():
                add(**{name: arrays.get(infos, info)[:-1]})
    return Transitions(**{name: np.concatenate(column) for name, column in parts.items()})


def read_visible(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a `main_data.hdf5` that agents see, with the truncations.

    The file may be a stranger's: it is read only as far as it is what `hdf5_content` writes.
    """
    import h5py

    if not path.is_file():  # a pipe would be waited for
        raise OSError("no such file")
    with h5py.File(path, "r") as file:
        arrays = _Arrays(path)
        parts = []
        for number in range(len(file)):
            name = f"episode_{number}"
            _refuse_link(file.id, name)
            episode = h5py.h5g.open(file.id, name.encode())
            columns = {
                **arrays.visible(episode),
                "truncations": arrays.get(episode, "truncations"),
            }
            _refuse_other_columns(name, columns)
            parts.append(columns)
    if not parts:
        raise ValueError("it has no episodes")
    return {name: np.concatenate([part[name] for part in parts]) for name in _VISIBLE}


_VISIBLE = {  # type and number of dimensions
    "observations": (np.float32, 2),
    "actions": (np.float32, 2),
    "rewards": (np.float64, 1),
    "next_observations": (np.float32, 2),
    "terminations": (np.bool_, 1),
    "truncations": (np.bool_, 1),
}


def _refuse_other_columns(episode: str, columns: dict[str, npt.NDArray[Any]]) -> None:
    steps = len(columns["rewards"])
    for name, (dtype, ndim) in _VISIBLE.items():
        column = columns[name]
        if column.dtype != dtype or column.ndim != ndim or len(column) != steps:
            raise ValueError(
                f"{episode}: its {name} are {column.dtype} of shape {column.shape}: must be "
                f"{np.dtype(dtype)} in {ndim} dimensions, of {steps} steps"
            )


def _refuse_link(group: Any, name: str) -> None:
    import h5py

    if group.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:  # may lead to other files
        raise ValueError(f"{name}: is a link")


class _Arrays:
    """Reads the arrays of a file, of which each must lie in the file as plain numbers.

    HDF5 could otherwise take them from any file of this machine (external storage, links), invent
    them (chunks that were never written), or make pointers of them (texts of variable length).
    """

    def __init__(self, path: Path) -> None:
        self._left = path.stat().st_size

    def get(self, group: Any, name: str) -> npt.NDArray[Any]:
        import h5py

        _refuse_link(group, name)
        stored = h5py.h5d.open(group, name.encode())
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

    def visible(self, episode: Any) -> dict[str, npt.NDArray[Any]]:
        observations = self.get(episode, "observations")
        return {
            "observations": observations[:-1],
            "actions": self.get(episode, "actions"),
            "rewards": self.get(episode, "rewards"),
            "next_observations": observations[1:],
            "terminations": self.get(episode, "terminations"),
        }

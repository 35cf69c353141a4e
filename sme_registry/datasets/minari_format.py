"""Minari's HDF5 layout of a data set: its arrays as a file, and the file's metadata.

An episode of T steps holds `observations` `[T + 1, O]`, `infos/state` `[T + 1, S]` and, where the
task has distractors, `infos/distractors` `[T + 1, m]`, whose last rows follow the last step. Minari
requires length T + 1 for every info: the last row of the others repeats the row before it and has
no meaning.

Minari writes resizable HDF5 datasets, which take several times the space if episodes are short.
These are of fixed size, so Minari cannot append steps to an existing episode.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.record import KEY, DatasetRecord
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
    """The `minari.MinariDataset` of a folder; see `require_minari`."""
    require_minari()
    import minari

    return minari.MinariDataset(data_folder)


def minari_metadata(dataset_id: str, record: DatasetRecord, size_bytes: int) -> dict[str, Any]:
    """Minari's metadata of a data set, with our record in it."""
    import minari
    from minari.serialization import serialize_space

    recipe, scores = record.recipe, record.scores
    observation_dim = recipe.spec.observation_dim - 1 + len(agents(recipe.spec))
    observation_space, action_space = (
        gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        for width in (observation_dim, recipe.spec.action_dim)
    )
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
    if recipe.spec.team is None:  # Gymnasium has no environments for several agents
        metadata["env_spec"] = env_spec(recipe.spec).to_json()
    floor, ceiling = scores.constant.rollouts, scores.optimum.rollouts
    if floor is not None and ceiling is not None:
        metadata |= {
            "ref_min_score": floor.mean_return,
            "ref_max_score": ceiling.mean_return,
            "num_episodes_average_score": floor.episodes,
        }
    return {**metadata, KEY: record.to_dict(), "dataset_size": round(size_bytes / 1e6, 1)}


def to_hdf5(transitions: Transitions, record: DatasetRecord) -> bytes:
    """The content of `main_data.hdf5`; the same arrays give the same bytes.

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

    columns, spec = transitions.columns(), record.recipe.spec
    infos = {info: columns[name] for info, name in _infos(spec).items()}
    observations, next_observations = transitions.observations, transitions.next_observations
    # The task also truncates at its horizon when the same step terminates the episode.
    at_horizon = next_observations[:, spec.observation_dim - 2] == 1.0
    truncations = transitions.timeouts | at_horizon
    with h5py.File("memory", "w", driver="core", backing_store=False, block_size=2**22) as file:
        first = 0
        for number, end in enumerate(transitions.ends.tolist()):
            rows, last = slice(first, end), slice(end - 1, end)
            episode = file.create_group(f"episode_{number}")
            episode.attrs["id"] = number
            episode.attrs["total_steps"] = end - first
            episode.attrs["behaviour"] = int(transitions.components[first])
            seen = np.concatenate([observations[rows], next_observations[last]])
            put(episode.id, "observations", seen)
            put(episode.id, "actions", transitions.actions[rows])
            put(episode.id, "rewards", transitions.rewards[rows])
            put(episode.id, "terminations", transitions.terminations[rows])
            put(episode.id, "truncations", truncations[rows])
            group = episode.create_group("infos").id
            for info, (before, after) in _position_infos(spec).items():
                put(group, info, np.concatenate([columns[before][rows], columns[after][last]]))
            for info, column in infos.items():
                put(group, info, np.concatenate([column[rows], column[last]]))
            first = end
        file.flush()
        return bytes(file.id.get_file_image())


def read_hdf5(path: Path, record: DatasetRecord) -> Transitions:
    """The arrays of a `main_data.hdf5`.

    Raises:
      OSError, KeyError, ValueError, RuntimeError: h5py cannot read it, or a part is missing.
    """
    import h5py

    spec = record.recipe.spec
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
            observations = get(episode.id, "observations")
            terminations = get(episode.id, "terminations")
            add(
                observations=observations[:-1],
                actions=get(episode.id, "actions"),
                rewards=get(episode.id, "rewards"),
                next_observations=observations[1:],
                terminations=terminations,
                timeouts=get(episode.id, "truncations") & ~terminations,
                episodes=np.full(len(terminations), number, np.int64),
                components=np.full(len(terminations), episode.attrs["behaviour"], np.int64),
            )
            infos = h5py.h5g.open(episode.id, b"infos")
            for info, (before, after) in _position_infos(spec).items():
                positions = get(infos, info)
                add(**{before: positions[:-1], after: positions[1:]})
            for info, name in _infos(spec).items():
                add(**{name: get(infos, info)[:-1]})
    return Transitions(**{name: np.concatenate(arrays) for name, arrays in parts.items()})

"""`checkpoint.zip`: an SB3 model and its replay buffer in one file, written atomically.

It is a model's .zip that SB3 can load, with one more member: the filled part of the replay buffer.
With two files, a kill between the writes would pair a model with the wrong buffer. That of an agent
in JAX is an .npz of all arrays of its program.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically

FILE = "checkpoint.zip"
_MEMBER = "sme_replay_buffer.npz"
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save(model: Any, path: Path) -> None:
    """Write a checkpoint; raises OptionError if that fails, and the previous one is unchanged."""
    archive = io.BytesIO(saved_sb3(model))
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.size()
        arrays = {name: getattr(buffer, name)[:filled] for name in _ARRAYS}
        replay = io.BytesIO()
        np.savez(replay, pos=buffer.pos, full=buffer.full, **arrays)
        with zipfile.ZipFile(archive, "a") as members:
            members.writestr(_MEMBER, replay.getvalue())
    write_atomically(path, archive.getvalue())


def load(algorithm: Any, path: Path, env: Any, **kwargs: Any) -> Any:
    """The model of a checkpoint, with its replay buffer."""
    try:
        with zipfile.ZipFile(path) as members:
            if _MEMBER not in members.namelist():
                return algorithm.load(path, env=env, device="cpu", **kwargs)
            replay = dict(np.load(io.BytesIO(members.read(_MEMBER)), allow_pickle=False))
        if "buffer_size" in kwargs:
            kwargs["buffer_size"] = max(kwargs["buffer_size"], replay["rewards"].size)
        model = algorithm.load(path, env=env, device="cpu", **kwargs)
        _refill(model.replay_buffer, replay)
        return model
    except Exception as error:
        raise unloadable(path, error) from error


def unloadable(path: Path, error: BaseException) -> PolicyError:
    """The error for a checkpoint that is damaged or of another program."""
    return PolicyError(
        f"{path}: cannot be loaded: {type(error).__name__}: {error}. Start again with --force "
        "(in Python, force=True), or in another folder."
    )


def _refill(buffer: Any, replay: dict[str, Any]) -> None:
    filled = len(replay["rewards"])
    for name in _ARRAYS:
        getattr(buffer, name)[:filled] = replay[name]
    # A buffer that was full and is now larger continues after its last row. This changes the order
    # of the ring, which does not matter because batches are sampled at random.
    was_full = bool(replay["full"])
    buffer.full = was_full and filled >= buffer.buffer_size
    buffer.pos = filled if was_full and not buffer.full else int(replay["pos"])

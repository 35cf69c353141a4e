"""`checkpoint.zip`: an SB3 model with its replay buffer, in one file that is whole or absent.

It is a model's .zip that SB3 can load, with one member more: the filled part of the replay buffer.
In two files a kill between them would pair a model with another model's buffer.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import PolicyError
from sme_registry.io import write_atomically

FILE = "checkpoint.zip"
_MEMBER = "sme_replay_buffer.npz"
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save(model: Any, path: Path) -> None:
    """Write a checkpoint, whole or not at all.

    Raises:
      OptionError: it cannot be written; the one before is untouched.
    """
    archive = io.BytesIO()
    model.save(archive)
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
    """The model of a checkpoint, its replay buffer filled as it was.

    Args:
      algorithm: the SB3 class that saved it.
      path: the file. Loading one can run code of whoever made it.
      env: the environment that it goes on in.
      **kwargs: fields of the model to change, such as `buffer_size`; that one is raised to what
        the checkpoint holds.

    Raises:
      PolicyError: not a checkpoint that can be loaded.
    """
    try:
        with zipfile.ZipFile(path) as members:
            has_replay = _MEMBER in members.namelist()
            stored = io.BytesIO(members.read(_MEMBER)) if has_replay else None
        replay = None if stored is None else dict(np.load(stored, allow_pickle=False))
        if replay is not None and "buffer_size" in kwargs:
            kwargs["buffer_size"] = max(kwargs["buffer_size"], replay["rewards"].size)
        model = algorithm.load(path, env=env, device="cpu", **kwargs)
        if replay is not None:
            _refill(model.replay_buffer, replay)
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be resumed from: {type(error).__name__}: {error}. "
            "Begin anew with --force (in Python force=True), or in another folder."
        ) from error
    return model


def _refill(buffer: Any, replay: dict[str, Any]) -> None:
    filled = len(replay["rewards"])
    for name in _ARRAYS:
        getattr(buffer, name)[:filled] = replay[name]
    # A buffer that was full and has grown since goes on behind what it holds, in another order
    # than the ring it was; its samples are drawn at random, so the order does not matter.
    was_full = bool(replay["full"])
    buffer.full = was_full and filled >= buffer.buffer_size
    buffer.pos = filled if was_full and not buffer.full else int(replay["pos"])

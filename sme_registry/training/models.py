"""Models of Stable-Baselines3 and of its kind, by the names of their algorithms.

A function that is named as an algorithm returns a model:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> Model

so anything with `learn` and `predict` can be trained. Agents in JAX have one, too, with the same
weights: evaluation, export to ONNX, diagnosis and leaderboards take it as any other.

A checkpoint is a model's .zip that SB3 can load with one more member, the filled part of the replay
buffer: with two files, a kill between the writes would pair a model with the wrong buffer. That of
an agent in JAX is an .npz of all arrays of its program.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import inspect
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.sb3 import SMEVecEnv
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.spec.study import parse_uses
from sme_registry.training.algorithms import find, is_sb3, replay_settings, silence
from sme_registry.training.hyperparameters import policy_alias, refuse_unknown, resolved

_MEMBER = "sme_replay_buffer.npz"
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Model(Protocol):
    """What learns, such as a model of Stable-Baselines3."""

    def learn(self, total_timesteps: int) -> Any:
        """Learn from at least this many steps of the environment."""

    def predict(self, observation: Any, *, deterministic: bool) -> Any:
        """Actions `[B, A]` in the range of `env.action_space`, or a tuple that begins with them."""


def new_model(
    uses: str,
    env: Any,
    *,
    seed: int,
    steps: int,
    hyperparameters: Mapping[str, Any],
    field: str = "uses",
) -> Model:
    """Create a model that learns in a `VecEnv`, from so many steps of all its lanes."""
    algorithm = find(uses, field).load(field)
    refuse_unknown(algorithm, uses, hyperparameters)
    settings = resolved(hyperparameters)
    if isinstance(algorithm, type) and is_sb3(algorithm):
        settings = {**replay_settings(algorithm, steps + env.num_envs), **settings}
        try:
            policy = policy_alias(algorithm)
            model = algorithm(policy, env, seed=seed, device="cpu", **settings)
        except (AssertionError, MemoryError, TypeError, ValueError) as error:
            raise OptionError(
                f"{field}={uses!r}: rejects the task or the hyperparameters "
                f"{sorted(hyperparameters)}: {error}. Change them, or create the learner in a "
                "function and give module:function."
            ) from error
    else:
        try:
            inspect.signature(algorithm).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"{field}={uses!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give only those that it accepts."
            ) from None
        model = algorithm(env, seed=seed, **settings)
    missing = [name for name in ("learn", "predict") if not hasattr(model, name)]
    if missing:
        raise OptionError(
            f"{field}={uses!r}: returned a {type(model).__name__}, which has no "
            f"{' and no '.join(missing)}. Return a learner like those of Stable-Baselines3."
        )
    if is_sb3(model):
        silence(model)
    return model  # type: ignore[no-any-return]


def new_sb3_model(
    uses: str,
    document: SMESpec | StreamSpec,
    *,
    seed: int,
    action_range: ActionRange,
    hyperparameters: Mapping[str, Any],
    steps: int,
) -> Any:
    """An untrained model. Make it before the training, so that what it refuses is refused then."""
    settings = dict(hyperparameters)
    if "buffer_size" in settings:
        settings["buffer_size"] = min(settings["buffer_size"], max(1, steps))
    return new_model(
        parse_uses(uses)[1],
        SMEVecEnv(document, 1, action_range=action_range),
        seed=seed,
        steps=steps,
        hyperparameters=settings,
        field="algorithm",
    )


def set_weights(model: Any, weights: Mapping[str, npt.NDArray[Any]], steps: int) -> None:
    """Give a model the weights of an agent in JAX; its optimiser stays new."""
    names = model.policy.state_dict().keys()
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    model.policy.load_state_dict({name: tensors[name] for name in names})
    for name in tensors.keys() - names:
        getattr(model, name).data.copy_(tensors[name])
    model.num_timesteps = steps


def save_checkpoint(model: Any, path: Path) -> None:
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


def load_checkpoint(algorithm: Any, path: Path, env: Any, **kwargs: Any) -> Any:
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

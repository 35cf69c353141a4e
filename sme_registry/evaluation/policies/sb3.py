"""Models of Stable-Baselines3: loading a .zip, and acting deterministically.

A .zip is code: open only those whose author you trust.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.io import require_packages
from sme_registry.spec import ActionRange

_LOW: dict[ActionRange, float] = {"unit": 0.0, "symmetric": -1.0}

# A saved model does not name its algorithm, but its fields identify it: the first match decides.
_ALGORITHM_MARKS = {
    "clip_range": "PPO",
    "target_entropy": "SAC",
    "policy_delay": "TD3",  # DDPG is TD3 with other settings and loads as TD3
    "gae_lambda": "A2C",
}


def load_sb3(path: str | os.PathLike[str]) -> Any:
    """Load a model that Stable-Baselines3 saved, on the CPU and without its environment.

    Args:
      path: a .zip of PPO, SAC, TD3, A2C or DDPG (which loads as TD3). Loading it can run code
        of its author.

    Raises:
      PolicyError: it does not exist, is not such a file, or is of an unknown algorithm.
      MissingDependencyError: Stable-Baselines3 is not installed.
    """
    path = Path(path)
    fields = _saved_fields(path)
    algorithm = next((name for mark, name in _ALGORITHM_MARKS.items() if mark in fields), None)
    if algorithm is None:
        raise PolicyError(
            f"{path}: a model of an unknown algorithm; known: PPO, SAC, TD3, A2C, DDPG. Load it "
            "yourself and pass the model, or a callable that wraps it."
        )
    packages = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages(f"loading {path}", packages, "train")
    import stable_baselines3

    try:
        # Otherwise the replay buffer is allocated at its full size, though acting never uses it.
        return getattr(stable_baselines3, algorithm).load(
            path, device="cpu", custom_objects={"buffer_size": 1}
        )
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be loaded as a {algorithm} model: {type(error).__name__}: {error}. "
            "Save it again with the installed stable-baselines3, or load it yourself and pass "
            "the model."
        ) from error


def predictor(model: Any) -> Callable[[Observation], Any]:
    """A model's deterministic actions; those of an SB3 model before they are clipped."""
    sb3 = sys.modules.get("stable_baselines3.common.policies")
    network = getattr(model, "policy", model)
    if sb3 is None or not isinstance(network, sb3.BasePolicy):

        def predict(observations: Observation) -> Any:
            predicted = model.predict(observations, deterministic=True)
            return predicted[0] if isinstance(predicted, tuple) else predicted

        return predict

    import torch

    def act(observations: Observation) -> Any:
        was_training = network.training
        network.set_training_mode(False)
        try:
            with torch.no_grad():
                batch = torch.as_tensor(observations, device=network.device)
                # `predict` also clips a Gaussian's mean, which hides the share that is clipped.
                chosen = network._predict(batch, deterministic=True).cpu().numpy()
        finally:
            network.set_training_mode(was_training)
        return network.unscale_action(chosen) if network.squash_output else chosen

    return act


def check_not_normalised(model: Any) -> None:
    """Raise `PolicyError` if a model was trained on observations normalised by VecNormalize."""
    normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    if getattr(normaliser, "norm_obs", False):
        raise PolicyError(
            "policy: it was trained on observations normalised by VecNormalize, which an "
            "evaluation does not apply. Pass a callable: "
            "lambda obs: model.predict(vec_normalize.normalize_obs(obs), deterministic=True)[0]."
        )


def action_range_of(model: Any) -> ActionRange:
    """The action range of a model's action space; "unit" if it has no space."""
    space = getattr(model, "action_space", None)
    if space is None:
        return "unit"
    with contextlib.suppress(AttributeError):
        for range_, low in _LOW.items():
            if np.all(space.low == low) and np.all(space.high == 1.0):
                return range_
    raise PolicyError(
        f"policy: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of them, or pass a callable that rescales its actions."
    )


def _saved_fields(path: Path) -> set[str]:
    """The names of a saved model's fields. Reads JSON only and runs no code."""
    if not path.is_file():
        raise PolicyError(f"{path} does not exist. Give the path of a saved model (.zip).")
    try:
        with zipfile.ZipFile(path) as archive:
            fields = json.loads(archive.read("data"))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError):
        fields = None
    if not isinstance(fields, dict):
        raise PolicyError(
            f"{path}: not a model that Stable-Baselines3 saved. Give the .zip that `model.save` "
            "wrote, or in Python a callable."
        )
    return set(fields)

"""Policies: whatever a user has, as one function from observations to actions of the unit range.

A policy is a callable `[B, S + 2] → [B, A]`, a Stable-Baselines3 model or policy, or the path of an
SB3 model's .zip. An SB3 .zip is code: open only those whose author you trust.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from sme_registry.envs import actions
from sme_registry.errors import ActionError, MissingDependencyError, OptionError, PolicyError
from sme_registry.spec import SMESpec
from sme_registry.task.draw import Array

ActionRange = Literal["unit", "symmetric"]
_LOW = {"unit": 0.0, "symmetric": -1.0}

# A saved model does not name its algorithm. These fields do; the first that is there decides.
_ALGORITHM_MARKS = {
    "clip_range": "PPO",
    "target_entropy": "SAC",
    "policy_delay": "TD3",  # DDPG is TD3 with other settings, and loads as one
    "gae_lambda": "A2C",
}


@dataclass(frozen=True)
class Policy:
    """A policy ready to be asked.

    Attributes:
      name: what reports call it.
      action_range: the range of what `act` returns, "unit" or "symmetric".
      act: observations `[B, S + 2]` float32 to actions; unchecked.
      action_dim: A.
    """

    name: str
    action_range: ActionRange
    act: Callable[[npt.NDArray[np.float32]], Any]
    action_dim: int

    def __call__(self, observations: npt.NDArray[np.float32]) -> Array:
        """Actions `[B, A]` in units of the unit range, not yet clipped to it.

        Raises:
          PolicyError: it fails, or returns something else than `[B, A]` finite numbers.
        """
        try:
            returned = self.act(observations)
            shape = (len(observations), self.action_dim)
            a = actions.checked(returned, shape, self.action_range == "symmetric")
            if not np.isfinite(a).all():
                raise actions.not_finite()
            return a
        except ActionError as error:
            raise PolicyError(
                f"policy {self.name!r}: {error} It is given observations "
                f"[{len(observations)}, {observations.shape[1]}] and must return one action a row."
            ) from None
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(
                f"policy {self.name!r} failed on observations of shape {observations.shape}: "
                f"{type(error).__name__}: {error}"
            ) from error


def as_policy(
    policy: Any, spec: SMESpec, *, action_range: str | None = None, name: str | None = None
) -> Policy:
    """A policy given in any of the forms that this module's head lists.

    Args:
      policy: the policy.
      spec: the task it is for.
      action_range: the range of its actions; None takes an SB3 model's own action space, and
        "unit" for a callable.
      name: what reports call it; None takes the file's, algorithm's or function's name.

    Raises:
      PolicyError: it is none of these, cannot be loaded, or is made for other spaces.
      OptionError: `action_range` is neither "unit" nor "symmetric".
      MissingDependencyError: a .zip is given and Stable-Baselines3 is not installed.
    """
    if action_range not in (None, *_LOW):
        raise OptionError(f"action_range={action_range!r}: must be 'unit' or 'symmetric'.")
    if isinstance(policy, str | os.PathLike):
        name = Path(policy).stem if name is None else name
        policy = load_sb3(policy)
    if hasattr(policy, "predict"):
        _refuse_other_spaces(policy, spec)
        act = _predictor(policy)
        range_ = action_range or _range_of(policy)
    elif callable(policy):
        act, range_ = policy, action_range or "unit"
    else:
        raise PolicyError(
            f"policy={policy!r:.80}: must be a callable from observations [B, {spec.state_dim + 2}]"
            f" to actions [B, {spec.action_dim}], a Stable-Baselines3 model, or a model's .zip."
        )
    return Policy(
        name or _name_of(policy), cast(ActionRange, range_), act, action_dim=spec.action_dim
    )


def load_sb3(path: str | os.PathLike[str]) -> Any:
    """Load a model that Stable-Baselines3 saved, on the CPU and without its environment.

    Args:
      path: a .zip of PPO, SAC, TD3, A2C or DDPG (which loads as TD3). Loading one can run code
        of whoever made it.

    Raises:
      PolicyError: missing, not such a file, or of an unknown algorithm.
      MissingDependencyError: Stable-Baselines3 is not installed.
    """
    path = Path(path)
    fields = _saved_fields(path)
    algorithm = next((name for mark, name in _ALGORITHM_MARKS.items() if mark in fields), None)
    if algorithm is None:
        raise PolicyError(
            f"{path}: a model of an unknown algorithm; known: PPO, SAC, TD3, A2C, DDPG. Load it "
            "yourself and give the model, or a callable around it."
        )
    try:
        import stable_baselines3
    except ImportError:
        raise MissingDependencyError(
            f"{path}: Stable-Baselines3 is needed to load it and is not installed. "
            "Run `pip install 'sme-registry[train]'`."
        ) from None
    try:
        # A replay buffer would be allocated at its full size, to act without ever being used.
        return getattr(stable_baselines3, algorithm).load(
            path, device="cpu", custom_objects={"buffer_size": 1}
        )
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be loaded as a {algorithm} model: {type(error).__name__}: {error}. "
            "Save it again with the installed stable-baselines3, or load it yourself and give "
            "the model."
        ) from error


def _saved_fields(path: Path) -> set[str]:
    """The names of a saved model's fields; reads JSON only, runs nothing."""
    if not path.is_file():
        raise PolicyError(f"{path}: there is no such file. Give the path of a saved model (.zip).")
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


def _predictor(model: Any) -> Callable[[npt.NDArray[np.float32]], Any]:
    """The deterministic actions of an object with `predict`, before clipping where it is SB3's."""
    sb3 = sys.modules.get("stable_baselines3.common.policies")
    network = getattr(model, "policy", model)
    if sb3 is None or not isinstance(network, sb3.BasePolicy):

        def predict(observations: npt.NDArray[np.float32]) -> Any:
            predicted = model.predict(observations, deterministic=True)
            return predicted[0] if isinstance(predicted, tuple) else predicted

        return predict

    import torch

    def act(observations: npt.NDArray[np.float32]) -> Any:
        was_training = network.training
        network.set_training_mode(False)
        try:
            with torch.no_grad():
                batch = torch.as_tensor(observations, device=network.device)
                # `predict` would also clip a Gaussian's mean, and hide how much of it is clipped.
                chosen = network._predict(batch, deterministic=True).cpu().numpy()
        finally:
            network.set_training_mode(was_training)
        return network.unscale_action(chosen) if network.squash_output else chosen

    return act


def _refuse_other_spaces(model: Any, spec: SMESpec) -> None:
    expected = {"observation": (spec.state_dim + 2,), "action": (spec.action_dim,)}
    for what, shape in expected.items():
        found = getattr(getattr(model, f"{what}_space", None), "shape", shape)
        if found != shape:
            raise PolicyError(
                f"policy: its {what}s have shape {found}: must be {shape} for "
                f"state_dim={spec.state_dim}, action_dim={spec.action_dim}. "
                "Evaluate it on the task it was trained for."
            )
    normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    if getattr(normaliser, "norm_obs", False):
        raise PolicyError(
            "policy: it was trained on observations that VecNormalize rescaled, and here are "
            "none. Give a callable: "
            "lambda obs: model.predict(vec_normalize.normalize_obs(obs), deterministic=True)[0]."
        )


def _range_of(model: Any) -> str:
    """The action range that a model's own action space is."""
    space = getattr(model, "action_space", None)
    if space is None:
        return "unit"
    with contextlib.suppress(AttributeError):
        for range_, low in _LOW.items():
            if np.all(space.low == low) and np.all(space.high == 1.0):
                return range_
    raise PolicyError(
        f"policy: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of them, or give a callable that rescales its actions."
    )


def _name_of(policy: Any) -> str:
    name = getattr(policy, "__name__", type(policy).__name__)
    return "policy" if name in ("<lambda>", "function") else str(name)

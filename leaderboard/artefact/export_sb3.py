"""`export_sb3`: a Stable-Baselines3 model as an ONNX file that `evaluate` can run.

The graph contains every step from an observation to an action in the unit range:

    x = clip((o − mean) / √(var + ε), ±clip)    in float64, with VecNormalize
    y = the network's deterministic action
    a = clip((y + 1)/2, 0, 1)                   if y is squashed, or symmetric in [−1, 1]
    a = clip(y, 0, 1)                           otherwise

A file whose actions differ from the model's is never written.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from leaderboard.artefact.gate import inspect
from sme_registry import SMESpec
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import load_sb3
from sme_registry.io import require_packages, write_atomically
from sme_registry.training import RunRecord

if TYPE_CHECKING:
    import torch

OPSET = 17
TOLERANCE = 1e-6
# Float32 networks are exact only up to rounding: trained TD3s differed from float64 by up to
# 1.2e-6, and from themselves row by row by 7e-7. So 99 of 100 actions must be within the tolerance,
# and the others within this.
_LARGEST_DIFFERENCE = 1e-5
_CHECKED_ROWS = 1024
# Warnings of PyTorch's exporter. Its successor is ten times slower and needs another package.
_EXPORTER_WARNINGS = (
    "You are using the legacy TorchScript-based ONNX export",
    "The feature will be removed. Please remove usage of this function",
)

_Rows = npt.NDArray[np.float32]


def export_sb3(
    model: Any,
    path: str | os.PathLike[str],
    *,
    vec_normalize: Any = None,
    spec: SMESpec | None = None,
) -> Path:
    """Write a model's deterministic policy as an ONNX file, and check it against the model.

    Args:
      model: a PPO, A2C, SAC, TD3 or DDPG model, or the path of its .zip (loading a .zip can run
        its author's code). Its action space is [0, 1] or [−1, 1] in every channel.
      path: the file to write, completely or not at all. Its folder is created if it is missing,
        and an existing file is replaced.
      vec_normalize: the `VecNormalize` that rescaled observations in training, or the path of its
        saved file (which can run code too). None takes that of the model's environment, if any. A
        model's .zip does not contain it.
      spec: the task, to check the widths; None skips the check.

    Returns:
      The path written: input `observations` `[B, S + 2]` float32, output `actions` `[B, A]`
      float32 in [0, 1], opset 17, weights inside.

    Raises:
      PolicyError: the model cannot be loaded, is a team's, has other spaces, or its ONNX file
        differs from its `predict` by more than 1e-6 beyond float32 rounding.
      Rejection: its network needs operators that no board accepts, or is too large.
      OptionError: the file cannot be written.
      MissingDependencyError: Stable-Baselines3, PyTorch, onnx or ONNX Runtime is not installed.
    """
    libraries = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages("exporting a model", libraries, "train")
    libraries = {"onnx": "onnx", "onnxruntime": "ONNX Runtime"}
    require_packages("exporting a model", libraries, "leaderboard")
    _refuse_team(model)
    if isinstance(model, str | os.PathLike):
        model = load_sb3(model)
    network = _network(model)
    S_2, A = _widths(network, spec)
    symmetric = _is_symmetric(network)
    normaliser = _normaliser(model, vec_normalize, S_2)

    was_training = network.training
    network.set_training_mode(False)  # as `predict` does
    try:
        data = _to_onnx(_unit_policy(network, normaliser, symmetric), S_2)
    finally:
        network.set_training_mode(was_training)
    inspect(data, S_2, A)
    _refuse_difference(data, model, normaliser, symmetric, S_2)
    return write_atomically(path, data)


def _refuse_team(model: Any) -> None:
    """Raise if the model's environment or its run's record shows that it is a team's."""
    from sme_registry.sb3 import SMETeamVecEnv

    if isinstance(model, str | os.PathLike):
        record = None
        with contextlib.suppress(SMEError):  # a run.json of another program
            record = RunRecord.read(Path(model).parent)
        of_a_team = record is not None and record.spec.team is not None
    else:
        env = getattr(model, "get_env", lambda: None)()
        of_a_team = isinstance(getattr(env, "unwrapped", None), SMETeamVecEnv)
    if of_a_team:
        raise PolicyError(
            "model: acts for the agents of a team, from their shared observation. Boards have "
            "single agents only. Give a model trained on a spec without a team."
        )


def _network(model: Any) -> Any:
    """The model's policy, a PyTorch module with SB3's `_predict`."""
    from stable_baselines3.common.policies import BasePolicy

    network = getattr(model, "policy", None)
    if not isinstance(network, BasePolicy):
        raise PolicyError(
            f"model={model!r:.80}: must be a Stable-Baselines3 model or the path of its .zip."
        )
    return network


def _widths(network: Any, spec: SMESpec | None) -> tuple[int, int]:
    """S + 2 and A, entries of the model's observations and actions."""
    widths = []
    for what in ("observation", "action"):
        shape = getattr(getattr(network, f"{what}_space"), "shape", None)
        if shape is None or len(shape) != 1:
            raise PolicyError(
                f"model: its {what}s have shape {shape}: must be vectors. Give a model trained "
                "on an SME."
            )
        widths.append(int(shape[0]))
    if spec is not None and spec.team is not None:
        raise PolicyError(
            f"spec: a team of {len(spec.team.agents)}: boards have single agents only."
        )
    if spec is not None and widths != [spec.state_dim + 2, spec.action_dim]:
        raise PolicyError(
            f"model: takes {widths[0]} observations to {widths[1]} actions: must be "
            f"{spec.state_dim + 2} and {spec.action_dim} for this task. Give a model trained on "
            "it."
        )
    return widths[0], widths[1]


def _is_symmetric(network: Any) -> bool:
    """Whether the action space is [−1, 1] and not [0, 1]; others are rejected."""
    space = network.action_space
    for low in (0.0, -1.0):
        if np.all(getattr(space, "low", None) == low) and np.all(space.high == 1.0):
            return low < 0.0
    raise PolicyError(
        f"model: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of these."
    )


def _normaliser(model: Any, vec_normalize: Any, width: int) -> Any:
    """The VecNormalize that rescales observations, or None."""
    from stable_baselines3.common.vec_env import VecNormalize

    normaliser = vec_normalize
    if vec_normalize is None:
        normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    elif isinstance(vec_normalize, str | os.PathLike):
        try:
            normaliser = pickle.loads(Path(vec_normalize).read_bytes())
        except Exception as error:
            raise PolicyError(
                f"vec_normalize={str(vec_normalize)!r}: cannot be loaded: {type(error).__name__}: "
                f"{error}. Give a file that `VecNormalize.save` wrote."
            ) from error
    if normaliser is None:
        return None
    if not isinstance(normaliser, VecNormalize):
        raise PolicyError(
            f"vec_normalize={normaliser!r:.80}: must be a VecNormalize or the path of a saved one."
        )
    if not normaliser.norm_obs:
        return None
    shape = getattr(getattr(normaliser, "obs_rms", None), "mean", np.empty(0)).shape
    if shape != (width,):
        raise PolicyError(
            f"vec_normalize: for observations of shape {shape}: must be {(width,)} for this model. "
            "Give the one from its training."
        )
    return normaliser


def _unit_policy(network: Any, normaliser: Any, symmetric: bool) -> torch.nn.Module:
    """The PyTorch module from observations to unit actions."""
    import torch

    class UnitPolicy(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network
            if normaliser is not None:
                deviation = np.sqrt(normaliser.obs_rms.var + normaliser.epsilon)
                self.mean = torch.as_tensor(normaliser.obs_rms.mean, device=network.device)
                self.deviation = torch.as_tensor(deviation, device=network.device)

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            if normaliser is not None:
                scaled = (x.double() - self.mean) / self.deviation
                x = scaled.clamp(-normaliser.clip_obs, normaliser.clip_obs).float()
            y = _deterministic(self.network, x)
            if symmetric or self.network.squash_output:
                y = (y + 1.0) * 0.5
            return y.clamp(0.0, 1.0)

    return UnitPolicy()


def _deterministic(network: Any, x: torch.Tensor) -> torch.Tensor:
    """The network's `_predict` without distributions, whose broadcasting no board accepts."""
    import torch
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.sac.policies import SACPolicy

    if isinstance(network, ActorCriticPolicy):
        latent = network.mlp_extractor.forward_actor(network.pi_features_extractor(x))
        mean: torch.Tensor = network.action_net(latent)
        return torch.tanh(mean) if network.squash_output else mean
    if isinstance(network, SACPolicy):
        return torch.tanh(network.actor.get_action_dist_params(x)[0])
    action: torch.Tensor = network._predict(x, deterministic=True)
    return action


def _to_onnx(policy: Any, width: int) -> bytes:
    """The module as ONNX bytes, traced."""
    import torch

    stream: Any = io.BytesIO()
    rows = torch.zeros((2, width), device=policy.network.device)
    with warnings.catch_warnings(), torch.no_grad():
        for message in _EXPORTER_WARNINGS:
            warnings.filterwarnings("ignore", message, DeprecationWarning)
        torch.onnx.export(
            policy,
            (rows,),
            stream,
            dynamo=False,
            opset_version=OPSET,
            input_names=["observations"],
            output_names=["actions"],
            dynamic_axes={"observations": {0: "batch"}, "actions": {0: "batch"}},
        )
    return bytes(stream.getvalue())


def _refuse_difference(
    data: bytes, model: Any, normaliser: Any, symmetric: bool, width: int
) -> None:
    """Raise if the file's actions differ from the model's, inside or outside the cube."""
    import onnxruntime

    random = np.random.default_rng(0)
    inside = random.random((_CHECKED_ROWS, width), dtype=np.float32)
    observations: _Rows = np.concatenate([inside, 2.0 * inside[::-1] - np.float32(0.5)])

    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    actions = session.run(None, {"observations": observations})[0]
    inputs = observations if normaliser is None else normaliser.normalize_obs(observations)
    expected = model.predict(inputs, deterministic=True)[0]
    if symmetric:
        expected = (expected + 1.0) / 2.0
    differences = np.abs(actions - np.clip(expected, 0.0, 1.0))
    difference = float(differences.max())
    typical = float(np.quantile(differences, 0.99))
    if not (typical <= TOLERANCE and difference <= _LARGEST_DIFFERENCE):
        raise PolicyError(
            f"model: its ONNX file differs from its predict by {difference:.1e}: must be at most "
            f"{TOLERANCE:g}. Check that its policy is deterministic and depends only on the "
            "observation, or write the ONNX file yourself."
        )

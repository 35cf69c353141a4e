"""Models of Stable-Baselines3 as ONNX.

x = clip((o − mean) / √(var + ε), ±clip)    in float64, with VecNormalize
y = the network's deterministic action
a = (y + 1)/2                               if y is squashed, or symmetric in [−1, 1]
a = y                                       otherwise
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.evaluation.models import Interface
from sme_registry.export.network import Network
from sme_registry.export.torch_modules import traced
from sme_registry.spec import ActionRange

if TYPE_CHECKING:
    import torch


def sb3_network(
    model: Any,
    interface: Interface | None,
    action_range: ActionRange | None = None,
    vec_normalize: Any = None,
) -> Network:
    """A model whose policy is a PyTorch module of SB3; the arguments are those of `export_onnx`."""
    network = _network(model)
    S_2, A = _widths(network)
    if interface is not None:
        interface.check("model", observations=(S_2,), actions=(A,))
    symmetric = _is_symmetric(network) if action_range is None else action_range == "symmetric"
    normaliser = _normaliser(model, vec_normalize, S_2)

    def act(observations: Observation) -> Any:
        inputs = observations if normaliser is None else normaliser.normalize_obs(observations)
        actions = model.predict(inputs, deterministic=True)[0]
        return (actions + 1.0) / 2.0 if symmetric else actions

    unit_policy = _unit_policy(network, normaliser, symmetric)
    return Network(S_2, act, lambda: traced(unit_policy, S_2))


def _network(model: Any) -> Any:
    """The model's policy, a PyTorch module with SB3's `_predict`."""
    from stable_baselines3.common.policies import BasePolicy

    network = getattr(model, "policy", None)
    if not isinstance(network, BasePolicy):
        raise PolicyError(
            f"model={model!r:.80}: must be a Stable-Baselines3 model or the path of its .zip."
        )
    if hasattr(network, "projection"):
        raise PolicyError(
            f"model: its policy is a {type(network).__name__}, which projects actions onto the "
            "task's limits, and a projection cannot be exported. Export a model of another "
            "algorithm, such as PPOLagrangian."
        )
    return network


def _widths(network: Any) -> tuple[int, int]:
    """O and A, entries of the model's observations and actions."""
    widths = []
    for what in ("observation", "action"):
        shape = getattr(getattr(network, f"{what}_space"), "shape", None)
        if shape is None or len(shape) != 1:
            raise PolicyError(
                f"model: its {what}s have shape {shape}: must be vectors. Give a model trained "
                "on an SME."
            )
        widths.append(int(shape[0]))
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

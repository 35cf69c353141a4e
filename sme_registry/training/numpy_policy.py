"""`numpy_policy`: a model's deterministic policy as matrix products in NumPy, for fast evaluation.

A Stable-Baselines3 model spends most of a short batch outside its network: in checks, in
conversions, in PyTorch's dispatch. Its deterministic actions are those of a multilayer perceptron,

    x ← f(x W + b)  for each layer,  f one of identity, ReLU, tanh

computed here in float32, as in the model. The sums run in another order, so the last bits of an
action may differ from the model's, as they do between batch sizes of the model itself. Any other
network, and one whose actions differ on a few probes, is called directly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import Policy
from sme_registry.evaluation.models import torch_policy
from sme_registry.evaluation.networks import Layer, Perceptron
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task import draw

_PROBES = 16
_TOLERANCE = 1e-5  # of an action; another order of the same sums moves it by 1e-6


def numpy_policy(
    model: Any, document: SMESpec | StreamSpec, *, action_range: str | None = None
) -> Policy:
    """The deterministic policy of a model with its current weights, as a callable for `evaluate`.

    Maps observations `[B, O]` (of a stream that shows the phase, with its one-hot) to actions
    `[B, A]` of the unit range, which the environment clips. The network of a model is copied, so
    later training does not change it; what is no such model is called directly.
    """
    spec, phases = document.specs[0], document.observed_phases
    policy = as_policy(model, spec, action_range=action_range, observed_phases=phases)
    if not isinstance(policy, Policy):
        raise SpecError("team: must be null here. Evaluate a team with `evaluate`.")
    return _fast(policy, model, document.observation_dim)


def numpy_team_policy(model: Any, spec: SMESpec, *, action_range: str | None = None) -> TeamPolicy:
    """The same for a team: of one model that all agents share, or of a dict from agent to model."""
    policy = as_policy(model, spec, action_range=action_range)
    if not isinstance(policy, TeamPolicy):
        raise SpecError("team: must not be null here. Evaluate a single agent with `evaluate`.")
    members = []
    for member in policy.members:
        own = model[member.agent] if isinstance(model, Mapping) else model
        space = getattr(own, "observation_space", None)
        fast = member.policy if space is None else _fast(member.policy, own, space.shape[0])
        members.append(member._replace(policy=fast))
    return replace(policy, members=tuple(members))


def _fast(policy: Policy, model: Any, observation_dim: int) -> Policy:
    """A policy whose model is called as matrix products where it can be."""
    perceptron = _perceptron(torch_policy(model))
    if perceptron is None:
        return policy
    probes = draw.uniform(0, "actor/probes", _PROBES * observation_dim)
    observations = probes.reshape(_PROBES, -1).astype(np.float32)
    expected, actions = policy.act(observations), perceptron(observations)
    # A subclass may do more than its layers say. NaN counts as a difference.
    same = expected.shape == actions.shape and np.allclose(
        actions, expected, rtol=_TOLERANCE, atol=_TOLERANCE
    )
    if not same:
        return policy
    return replace(policy, act=perceptron, episodes=None, hidden=perceptron.hidden)


def _perceptron(network: Any) -> Perceptron | None:
    """A copy of a PyTorch policy of SB3; None if there is none or it has other layers."""
    packages = ("stable_baselines3.", "sb3_contrib.")  # whose policies act as their layers say
    if network is None or not type(network)._predict.__module__.startswith(packages):
        return None
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from torch import nn

    try:
        extractor, parts = _parts(network)
    except AttributeError:  # a policy class of another package
        return None
    if type(extractor) is not FlattenExtractor:
        return None
    names: dict[type, str] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    layers: list[Layer] = []
    for module in _flat(parts):
        if type(module) is nn.Linear and module.bias is not None:
            W, b = (part.detach().cpu().numpy() for part in (module.weight, module.bias))
            layers.append((W.T, b, "identity"))
        elif type(module) in names and layers and layers[-1][2] == "identity":
            layers[-1] = (*layers[-1][:2], names[type(module)])
        else:
            return None
    space: Any = network.action_space if network.squash_output else None
    try:
        return Perceptron(layers, *(() if space is None else (space.low, space.high)))
    except PolicyError:  # weights that are not finite
        return None


def _parts(network: Any) -> tuple[Any, tuple[Any, ...]]:
    """The features extractor, and the modules from features to action, in order."""
    from torch import nn

    actor = getattr(network, "actor", None)
    if actor is None:  # PPO, A2C, TRPO: the mean of a Gaussian
        return network.pi_features_extractor, (network.mlp_extractor.policy_net, network.action_net)
    if hasattr(actor, "latent_pi"):  # SAC, TQC: the mean of a Gaussian, squashed
        return actor.features_extractor, (actor.latent_pi, actor.mu, nn.Tanh())
    return actor.features_extractor, (actor.mu,)  # TD3, DDPG


def _flat(modules: Iterable[Any]) -> Iterator[Any]:
    from torch import nn

    for module in modules:
        if type(module) is nn.Sequential:
            yield from _flat(module)
        else:
            yield module

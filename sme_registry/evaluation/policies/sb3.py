"""Models with the interface of Stable-Baselines3: acting deterministically, and their action range.

A model's own `predict` is the definition. That of SB3's plain PyTorch policies also clips a
Gaussian's mean, which hides the share that is clipped: these networks are called directly.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.spec import ActionRange

_LOW: dict[ActionRange, float] = {"unit": 0.0, "symmetric": -1.0}


def torch_policy(model: Any) -> Any:
    """The PyTorch policy that SB3's own `predict` calls; None if a model predicts otherwise."""
    policies = sys.modules.get("stable_baselines3.common.policies")
    models = sys.modules.get("stable_baselines3.common.base_class")
    if policies is None or models is None:  # not imported: not an SB3 model
        return None
    network, predict = getattr(model, "policy", model), getattr(type(model), "predict", None)
    standard = (models.BaseAlgorithm.predict, policies.BasePolicy.predict)
    is_plain = (
        predict in standard
        and isinstance(network, policies.BasePolicy)
        and type(network).predict is policies.BasePolicy.predict
    )
    return network if is_plain else None


def predictor(model: Any) -> Callable[[Observation], Any]:
    """A model's deterministic actions; those of a plain SB3 model before they are clipped."""
    network = torch_policy(model)
    if network is None:
        return lambda observations: _predicted(model, observations)[0]

    import torch

    def act(observations: Observation) -> Any:
        was_training = network.training
        network.set_training_mode(False)
        try:
            with torch.no_grad():
                batch = torch.as_tensor(observations, device=network.device)
                chosen = network._predict(batch, deterministic=True).cpu().numpy()
        finally:
            network.set_training_mode(was_training)
        return network.unscale_action(chosen) if network.squash_output else chosen

    return act


def episode_predictor(model: Any) -> Callable[[], Callable[[Observation], Any]] | None:
    """Begins episodes: as `predictor`, with the model's state kept from call to call, by row."""
    return functools.partial(_stateful, model) if torch_policy(model) is None else None


def _stateful(model: Any) -> Callable[[Observation], Any]:
    state = None

    def act(observations: Observation) -> Any:
        nonlocal state
        actions, state = _predicted(model, observations, state)
        return actions

    return act


def _predicted(model: Any, observations: Observation, state: Any = None) -> tuple[Any, Any]:
    """Actions of `predict`, and the state of a recurrent model after them, or None."""
    carried = {} if state is None else {"state": state}
    predicted = model.predict(observations, deterministic=True, **carried)
    return (predicted[0], predicted[1]) if isinstance(predicted, tuple) else (predicted, None)


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

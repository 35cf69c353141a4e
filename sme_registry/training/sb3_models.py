"""Models of Stable-Baselines3 for agents in JAX: `new_sb3_model`, and `set_weights` to act alike.

Saved, it is what `sme train` and studies keep of such an agent: evaluation, export to ONNX,
diagnosis and leaderboards take it as any other model.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from sme_registry.sb3 import SMEVecEnv
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.spec.study import JAX
from sme_registry.training.learners import new_learner


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
    return new_learner(
        uses.removeprefix(JAX),
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

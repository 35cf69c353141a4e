"""`sb3_model`: the weights of an agent in JAX in a model of Stable-Baselines3, which acts alike.

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
from sme_registry.spec import ActionRange, SMESpec
from sme_registry.spec.study import JAX
from sme_registry.training.learners import new_learner


def sb3_model(
    uses: str,
    weights: Mapping[str, npt.NDArray[Any]],
    spec: SMESpec,
    *,
    seed: int,
    action_range: ActionRange,
    hyperparameters: Mapping[str, Any],
    steps: int,
) -> Any:
    """A model with these weights, untrained otherwise: its optimiser is new.

    Args:
      uses: `jax:PPO`, `jax:TD3` or `jax:SAC`.
      weights: of one lane, by the names of the policy's `state_dict`; others are tensors of the
        model itself.
      spec: the task.
      seed: of the run.
      action_range: of the policy's actions.
      hyperparameters: of the run.
      steps: that were trained.
    """
    env = SMEVecEnv(spec, 1, action_range=action_range)
    model: Any = new_learner(
        uses.removeprefix(JAX), env, seed=seed, steps=steps, hyperparameters=hyperparameters
    )
    names = model.policy.state_dict().keys()
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    model.policy.load_state_dict({name: tensors[name] for name in names})
    for name in tensors.keys() - names:
        getattr(model, name).data.copy_(tensors[name])
    model.num_timesteps = steps
    return model

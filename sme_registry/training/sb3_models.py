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
    """An untrained model. Make it before the training, so that what it refuses is refused then.

    Its replay buffer is no larger than the training needs, as in JAX: whoever loads the model gets
    one of this size.

    Args:
      uses: `jax:PPO`, `jax:TD3` or `jax:SAC`.
      document: the task or the stream in whose observations the model acts.
      seed: of the run.
      action_range: of the policy's actions.
      hyperparameters: of the run.
      steps: that it trains.

    Raises:
      OptionError: Stable-Baselines3 rejects a hyperparameter's value or the task.
    """
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
    """Give a model the weights of an agent in JAX; its optimiser stays new.

    Args:
      model: of `new_sb3_model`.
      weights: of one lane, by the names of the policy's `state_dict`; others are tensors of the
        model itself.
      steps: that were trained.
    """
    names = model.policy.state_dict().keys()
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    model.policy.load_state_dict({name: tensors[name] for name in names})
    for name in tensors.keys() - names:
        getattr(model, name).data.copy_(tensors[name])
    model.num_timesteps = steps

"""`PPOProjection`: PPO whose actions are projected onto the limits, which it is given.

    a ← min(a, ℓ(s) − 10⁻⁵)

ℓ are the task's own limits: an oracle, which no agent without a model of its constraints has. s is
the state as the observation shows it. The projection is a part of the policy, so a saved model has
it, too. Up to L = 10 such a policy never costs anything, and deeper limits are violated by rounding
at most. Its shortfall from the best safe action is what PPO has not learned. It is a safety layer
(Dalal et al., 2018) whose constraints are known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnvWrapper, unwrap_vec_normalize

from sme_registry.errors import OptionError
from sme_registry.sb3.ppo_lagrangian import spec_with_limits
from sme_registry.spec import SMESpec
from sme_registry.task import materialize

_Array = npt.NDArray[np.float32]

# Observations are float32, so limits computed from them are off: by 1e-7 at L = 1, 1e-6 at L = 10
# and 3e-5 at L = 50, at most, in 60,000 states. So limits of L = 50 can be violated, by 2e-5.
_MARGIN = 1e-5


class Projection:
    """The projection of actions onto a task's limits."""

    def __init__(self, spec: SMESpec, low: float) -> None:
        self._task, self._low = materialize(spec), low

    def __call__(self, actions: _Array, observations: _Array) -> _Array:
        """The projected actions `[B, A]`, float32; observations are `[B, O]`."""
        states = observations[:, : self._task.spec.state_dim]
        limits = self._low + (1.0 - self._low) * (self._task.limit(states) - _MARGIN)
        return np.minimum(actions, limits.astype(np.float32))


class ProjectedPolicy(ActorCriticPolicy):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """PPO's policy, whose actions are projected where it acts; see the module."""

    def __init__(self, *args: Any, _limits_of: dict[str, Any], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        space: Any = self.action_space
        self.projection = Projection(SMESpec(**_limits_of), float(space.low[0]))

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        actions = super()._predict(observation, deterministic)
        projected = self.projection(actions.cpu().numpy(), observation.cpu().numpy())
        return torch.as_tensor(projected, device=actions.device)


class ProjectedVecEnv(VecEnvWrapper):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Environments that execute projected actions; PPO learns from the actions it samples."""

    def __init__(self, venv: Any, spec: SMESpec) -> None:
        super().__init__(venv)
        self._projection = Projection(spec, float(venv.action_space.low[0]))
        self._observations: Any = None

    def reset(self) -> Any:
        """Begin an episode in every lane."""
        self._observations = self.venv.reset()
        return self._observations

    def step_async(self, actions: Any) -> None:
        """Store the projected actions for `step_wait`."""
        self.venv.step_async(self._projection(actions, self._observations))

    def step_wait(self) -> Any:
        """One step of every lane."""
        result = self.venv.step_wait()
        self._observations = result[0]
        return result


class PPOProjection(PPO):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """PPO with actions projected onto the limits, for tasks with `safety`; see the module.

    Observations must begin with the state as it is: no mixing, no wrapper that changes them.

    Examples:
      >>> from sme_registry.sb3 import PPOProjection, SMEVecEnv
      >>> env = SMEVecEnv("Safety20")
      >>> model = PPOProjection("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1).learn(64)
      >>> model.num_timesteps
      64
    """

    policy_aliases = {"MlpPolicy": ProjectedPolicy}  # noqa: RUF012  # as in PPO

    def _setup_model(self) -> None:
        if self.env is not None:
            limits_of = _spec(self.env).to_dict()
            self.policy_kwargs = {**self.policy_kwargs, "_limits_of": limits_of}
        super()._setup_model()

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Go on in another environment of the same task, whose limits are those of the policy."""
        venv = self._wrap_env(env, self.verbose)
        here, other = SMESpec(**self.policy_kwargs["_limits_of"]), _spec(venv)
        if here.digest != other.digest:
            raise OptionError(
                f"PPOProjection: set_env: the environment's task is {other.digest[:19]}…, and the "
                f"policy projects onto the limits of {here.digest[:19]}…. Use an environment of "
                "that task, or load the model with the other: load(path, env=env)."
            )
        super().set_env(venv, force_reset)

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> Any:
        venv = PPO._wrap_env(env, verbose, monitor_wrapper)
        return venv if isinstance(venv, ProjectedVecEnv) else ProjectedVecEnv(venv, _spec(venv))


def _spec(env: Any) -> SMESpec:
    """The spec of environments whose observations show the state; OptionError for any other."""
    spec = spec_with_limits("PPOProjection", env)
    observation = spec.observation
    if observation is not None and observation.mixing != "none":
        raise OptionError(
            f"PPOProjection: observation.mixing={observation.mixing!r}: must be 'none', since the "
            "limits follow from the state, which mixed observations do not show. Train "
            "PPOLagrangian."
        )
    space, normalised = Box(0.0, 1.0, (spec.observation_dim,), np.float32), _normalises(env)
    if normalised or env.observation_space != space:
        shown = "normalised" if normalised else f"{env.observation_space}"
        raise OptionError(
            f"PPOProjection: observations are {shown}: must be those of the environment itself, "
            f"{space}, since the limits follow from the state with which they begin. Take off the "
            "wrappers that change observations, and use VecNormalize with norm_obs=False."
        )
    return spec


def _normalises(env: Any) -> bool:
    normaliser = unwrap_vec_normalize(env)
    return normaliser is not None and normaliser.norm_obs

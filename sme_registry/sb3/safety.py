"""PPO for tasks with `safety`: `PPOLagrangian` and `PPOProjection`.

`PPOLagrangian` keeps the mean cost of a step below a limit, by a Lagrange multiplier.

    λ ← max(0, λ + η (c̄ − d))        after each rollout, before PPO's update
    A  = (A_r − λ A_c) / (1 + λ)      the advantages from which PPO learns

c̄ is the mean cost of the rollout's steps, d `cost_limit` and η `multiplier_learning_rate`. A_r and
A_c are the generalised advantages of rewards and costs; each has a critic of its own, and all else
is Stable-Baselines3's PPO. At λ = 0 its weights are PPO's, bit for bit.

Source: Ray, Achiam & Amodei (2019), Benchmarking Safe Exploration in Deep Reinforcement Learning;
with gradient steps for λ instead of Adam's.

Where r̂ > 0, the best safe action maximises r − λ c for each λ > 8τ, and the optimum for each
λ < 8τ: a reward of 4/A and a cost of 1/(2τA) are lost with each unit of an action. So λ settles
near 8τ where the limit is neither 0 nor above the optimum's cost, which is near τ/3.

`PPOProjection` projects its actions onto the limits, which it is given.

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
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnvWrapper, unwrap_vec_normalize

from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError
from sme_registry.io import number_in
from sme_registry.spec import SMESpec
from sme_registry.task import materialize

_Array = npt.NDArray[np.float32]


def _spec_with_limits(algorithm: str, env: Any) -> SMESpec:
    try:
        spec: SMESpec = env.get_attr("sme_spec")[0]
    except AttributeError:
        raise OptionError(
            f"{algorithm}: the environment has no `sme_spec`. Use an environment of sme_registry."
        ) from None
    check_has_limits(algorithm, spec)
    return spec


class PPOLagrangian(PPO):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """PPO with a limit on the mean cost of a step, for tasks with `safety`; see the module.

    `cost_limit` is d in [0, 1], `multiplier` λ, at the start and then at present, and
    `multiplier_learning_rate` η, where 0 keeps λ.

    Examples:
      >>> from sme_registry.sb3 import PPOLagrangian, SMEVecEnv
      >>> env = SMEVecEnv("Safety20")
      >>> model = PPOLagrangian("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1).learn(64)
      >>> model.num_timesteps
      64
    """

    def __init__(
        self,
        policy: Any,
        env: Any,
        *,
        cost_limit: float = 0.01,
        multiplier: float = 0.0,
        multiplier_learning_rate: float = 1.0,
        **settings: Any,
    ) -> None:
        self.cost_limit = number_in("cost_limit", cost_limit, 0.0, 1.0)
        self.multiplier = number_in("multiplier", multiplier, 0.0)
        self.multiplier_learning_rate = number_in(
            "multiplier_learning_rate", multiplier_learning_rate, 0.0
        )
        super().__init__(policy, env, **settings)
        if self.env is not None:
            _spec_with_limits(type(self).__name__, self.env)

    def _setup_model(self) -> None:
        super()._setup_model()
        # A second policy, of which only the critic learns. Neither it nor its minibatches may move
        # PPO's random numbers.
        with torch.random.fork_rng(devices=[]):
            self.cost_critic: Any = self.policy_class(
                self.observation_space,
                self.action_space,
                self.lr_schedule,
                use_sde=self.use_sde,
                **self.policy_kwargs,
            ).to(self.device)
        self._minibatches = np.random.default_rng(self.seed)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "cost_critic", "cost_critic.optimizer"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_costs", "_cut"]  # the last rollout

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        self._costs: list[_Array] = []  # [lanes] of each step
        self._cut: list[tuple[int, int, Any]] = []  # step, lane and last observation, if truncated
        return bool(super().collect_rollouts(*args, **kwargs))

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: npt.NDArray[Any] | None = None
    ) -> None:
        super()._update_info_buffer(infos, dones)
        self._cut += [
            (len(self._costs), lane, info["terminal_observation"])
            for lane, info in enumerate(infos)
            if info.get("TimeLimit.truncated") and "terminal_observation" in info
        ]
        try:
            self._costs.append(np.array([info["cost"] for info in infos], np.float32))
        except KeyError:
            raise OptionError(
                "the environment's infos have no 'cost'. Use an environment of sme_registry whose "
                "task has safety, with wrappers that keep its infos."
            ) from None

    def train(self) -> None:
        """Update the multiplier, the critic of costs, and then the policy as PPO does."""
        costs = np.array(self._costs)
        mean = float(costs.mean())
        step = self.multiplier_learning_rate * (mean - self.cost_limit)
        self.multiplier = max(0.0, self.multiplier + step)
        # PPO's buffer flattens its arrays in the update.
        observations = self.rollout_buffer.observations.copy()
        advantages, returns = self._cost_advantages(costs, observations)
        if self.multiplier > 0.0:
            rewards = self.rollout_buffer.advantages
            weighted = rewards - np.float32(self.multiplier) * advantages
            self.rollout_buffer.advantages = weighted / np.float32(1.0 + self.multiplier)
        super().train()
        self._train_cost_critic(observations, returns)
        self.logger.record("train/cost", mean)
        self.logger.record("train/multiplier", self.multiplier)

    def _cost_advantages(self, costs: _Array, observations: Any) -> tuple[_Array, _Array]:
        """Advantages and returns of costs, `[steps, lanes]` each; the critic continues cut ones."""
        steps, lanes = costs.shape
        for step, lane, observation in self._cut:
            costs[step, lane] += self.gamma * self._cost_values(observation[None])[0]
        buffer = RolloutBuffer(
            steps,
            self.observation_space,
            self.action_space,
            gae_lambda=self.gae_lambda,
            gamma=self.gamma,
            n_envs=lanes,
        )
        flat = observations.reshape(-1, *observations.shape[2:])
        buffer.rewards, buffer.values = costs, self._cost_values(flat).reshape(steps, lanes)
        buffer.episode_starts = self.rollout_buffer.episode_starts
        last = torch.as_tensor(self._cost_values(self._last_obs))
        ended: Any = self._last_episode_starts
        buffer.compute_returns_and_advantage(last, ended)
        return buffer.advantages, buffer.returns

    def _cost_values(self, observations: Any) -> _Array:
        """The critic's discounted costs from observations `[B, O]` on, `[B]`."""
        with torch.no_grad():
            values = self.cost_critic.predict_values(obs_as_tensor(observations, self.device))
        return np.asarray(values.cpu().numpy().reshape(-1))

    def _train_cost_critic(self, observations: Any, returns: _Array) -> None:
        inputs = torch.as_tensor(observations.reshape(-1, *observations.shape[2:]))
        targets = torch.as_tensor(returns.reshape(-1))
        self._update_learning_rate(self.cost_critic.optimizer)
        for _ in range(self.n_epochs):
            order = self._minibatches.permutation(len(targets))
            for start in range(0, len(order), self.batch_size):
                batch = order[start : start + self.batch_size]
                values = self.cost_critic.predict_values(inputs[batch].to(self.device)).flatten()
                loss: Any = torch.nn.functional.mse_loss(values, targets[batch].to(self.device))
                self.cost_critic.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.cost_critic.parameters(), self.max_grad_norm)
                self.cost_critic.optimizer.step()


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
        self._observations = self.venv.reset()
        return self._observations

    def step_async(self, actions: Any) -> None:
        self.venv.step_async(self._projection(actions, self._observations))

    def step_wait(self) -> Any:
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
    spec = _spec_with_limits("PPOProjection", env)
    observation = spec.observation
    if observation is not None and observation.mixing != "none":
        raise OptionError(
            f"PPOProjection: observation.mixing={observation.mixing!r}: must be 'none', since the "
            "limits follow from the state, which mixed observations do not show. Train "
            "PPOLagrangian."
        )
    space = Box(0.0, 1.0, (spec.observation_dim,), np.float32)
    normaliser = unwrap_vec_normalize(env)
    normalised = normaliser is not None and normaliser.norm_obs
    if normalised or env.observation_space != space:
        shown = "normalised" if normalised else f"{env.observation_space}"
        raise OptionError(
            f"PPOProjection: observations are {shown}: must be those of the environment itself, "
            f"{space}, since the limits follow from the state with which they begin. Take off the "
            "wrappers that change observations, and use VecNormalize with norm_obs=False."
        )
    return spec

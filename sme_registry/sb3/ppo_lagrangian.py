"""`PPOLagrangian`: PPO that keeps the mean cost of a step below a limit, by a Lagrange multiplier.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.utils import obs_as_tensor

from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError
from sme_registry.io import number_in
from sme_registry.spec import SMESpec

_Array = npt.NDArray[np.float32]


def spec_with_limits(algorithm: str, env: Any) -> SMESpec:
    """The spec of an environment's task, which must have `safety`."""
    try:
        spec: SMESpec = env.get_attr("sme_spec")[0]
    except AttributeError:
        raise OptionError(
            f"{algorithm}: the environment has no `sme_spec`. Use an environment of sme_registry."
        ) from None
    check_has_limits(algorithm, spec)
    return spec


def _costs_in(infos: Sequence[dict[str, Any]]) -> _Array:
    """The cost of a step in each lane, `[lanes]`, from its infos."""
    try:
        return np.array([info["cost"] for info in infos], np.float32)
    except KeyError:
        raise OptionError(
            "the environment's infos have no 'cost'. Use an environment of sme_registry whose "
            "task has safety, with wrappers that keep its infos."
        ) from None


class PPOLagrangian(PPO):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """PPO with a limit on the mean cost of a step, for tasks with `safety`; see the module.

    `cost_limit` is d, the mean cost of a step that is allowed while exploring, in [0, 1];
    `multiplier` λ at the start; `multiplier_learning_rate` η, where 0 keeps λ.

    Attributes:
      multiplier: the present λ.

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
            spec_with_limits(type(self).__name__, self.env)

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
        """Collect a rollout as PPO does, and its costs."""
        self._costs: list[_Array] = []  # [lanes] of each step
        self._cut: list[tuple[int, int, Any]] = []  # step, lane and last observation, if truncated
        collected: bool = super().collect_rollouts(*args, **kwargs)
        return collected

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: npt.NDArray[Any] | None = None
    ) -> None:
        super()._update_info_buffer(infos, dones)
        self._cut += [
            (len(self._costs), lane, info["terminal_observation"])
            for lane, info in enumerate(infos)
            if info.get("TimeLimit.truncated") and "terminal_observation" in info
        ]
        self._costs.append(_costs_in(infos))

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
        flat: _Array = values.cpu().numpy().reshape(-1)
        return flat

    def _train_cost_critic(self, observations: Any, returns: _Array) -> None:
        """Fit the critic to returns, in as many minibatches as PPO's critic."""
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

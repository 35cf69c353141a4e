"""Train PPO in one file of plain PyTorch, in the style of CleanRL, and log the exact regret.

    pip install '.[fast]' torch
    python examples/cleanrl_style_ppo.py --env SME/DefaultSymmetric-v1 --steps 16384

Gaussian exploration needs actions in [-1, 1]: an id that ends in `Symmetric-v1`. A short planning
horizon (γ = 0.5) is enough where every step is rewarded and no episode ends early (k = 1, D = 0).
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import torch
from torch import nn

import sme_registry

ENVS, ROLLOUT, EPOCHS, MINIBATCH, GAMMA, LAMBDA, CLIP = 8, 128, 10, 128, 0.5, 0.9, 0.2


class Agent(nn.Module):
    """Actor and critic with two hidden layers each, and a standard deviation for each action."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.actor, self.critic = (
            nn.Sequential(
                *(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()),
                nn.Linear(64, outputs),
            )
            for outputs in (actions, 1)
        )
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))

    def distribution(self, observations: torch.Tensor) -> torch.distributions.Distribution:
        """The normal distribution of the actions `[B, A]` for observations `[B, S + 2]`."""
        normal = torch.distributions.Normal(self.actor(observations), self.log_std.exp())
        return torch.distributions.Independent(normal, 1)

    @torch.no_grad()
    def mean_actions(self, observations: np.ndarray) -> np.ndarray:
        """The policy to evaluate: observations `[B, S + 2]` to actions `[B, A]` in [-1, 1]."""
        return self.actor(torch.as_tensor(observations)).clamp(-1, 1).numpy()


def learn(agent: Agent, optimiser: torch.optim.Optimizer, rollout: list, last: np.ndarray) -> None:
    """PPO's update from a rollout of (observation, action, reward, done), each `[ENVS, …]`."""
    observations, actions, rewards, dones = (
        torch.as_tensor(np.stack(column), dtype=torch.float32)
        for column in zip(*rollout, strict=True)
    )
    with torch.no_grad():
        log_probs = agent.distribution(observations).log_prob(actions)
        values = agent.critic(observations).squeeze(-1)
        following = [*values[1:], agent.critic(torch.as_tensor(last)).squeeze(-1)]
        advantages, advantage = torch.zeros_like(rewards), torch.zeros(ENVS)
        for t in reversed(range(ROLLOUT)):
            going_on = 1 - dones[t]
            error = rewards[t] + GAMMA * going_on * following[t] - values[t]
            advantages[t] = advantage = error + GAMMA * LAMBDA * going_on * advantage
    data = observations, actions, log_probs, advantages, advantages + values
    observations, actions, log_probs, advantages, returns = (x.flatten(0, 1) for x in data)
    for _ in range(EPOCHS):
        for i in torch.randperm(len(returns)).split(MINIBATCH):
            ratio = (agent.distribution(observations[i]).log_prob(actions[i]) - log_probs[i]).exp()
            a = (advantages[i] - advantages[i].mean()) / (advantages[i].std() + 1e-8)
            policy_loss = -torch.min(a * ratio, a * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
            value_loss = (agent.critic(observations[i]).squeeze(-1) - returns[i]).pow(2).mean()
            optimiser.zero_grad()
            (policy_loss + value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="SME/DefaultSymmetric-v1", help="actions in [-1, 1]")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)  # networks this small are slower on several threads
    # In this mode, as in CleanRL, the observation after an episode's end is that of the next reset.
    envs = gymnasium.make_vec(arguments.env, num_envs=ENVS, autoreset_mode="SameStep")
    task = envs.unwrapped.sme_spec
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=1e-3)

    def evaluate() -> None:
        report = sme_registry.evaluate(
            agent.mean_actions, task, "quick-v1", action_range="symmetric"
        )
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    evaluate()
    observations, _ = envs.reset(seed=arguments.seed)
    for rollout_index in range(max(1, arguments.steps // (ENVS * ROLLOUT))):
        rollout, regrets = [], []
        for _ in range(ROLLOUT):
            with torch.no_grad():
                actions = agent.distribution(torch.as_tensor(observations)).sample().numpy()
            following, rewards, terminated, truncated, infos = envs.step(actions.clip(-1, 1))
            rollout.append((observations, actions, rewards, terminated | truncated))
            regrets.extend(infos["regret"][infos["_regret"]])  # exact; the mask leaves out resets
            observations = following
        learn(agent, optimiser, rollout, observations)
        steps = (rollout_index + 1) * ENVS * ROLLOUT
        print(f"{steps:7} steps, exploring: regret {np.mean(regrets):.3f}", flush=True)
    evaluate()


if __name__ == "__main__":
    main()

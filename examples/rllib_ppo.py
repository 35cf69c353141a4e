"""Train PPO with RLlib, on one agent or on a team, and log the exact regret of each agent.

    make frameworks                    # an environment with the version tried, then this example
    python examples/rllib_ppo.py --env SME/Default-v1
    python examples/rllib_ppo.py --env SME/Team4-v1

The prefix `sme_registry:` lets RLlib's worker processes find the id. A team is trained by
independent PPO: each agent has its own network. RLlib scales actions itself, so both action ranges
work. γ = 0.5 is enough where every step is rewarded and no episode ends early (k = 1, D = 0).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

import sme_registry

try:
    import ray
    import torch
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env
except ModuleNotFoundError as error:
    sys.exit(
        f"{error.name} is not installed. pip install 'ray[rllib]' has it, and all else that RLlib "
        "needs; docs/guides/training.md says what it replaces."
    )

ROLLOUT = 2048


def log_regret(*, episode: Any, metrics_logger: Any, **_: Any) -> None:
    """Log the mean exact regret of an episode: over its steps, and for a team over its agents."""
    agents = getattr(episode, "agent_episodes", {"": episode}).values()
    regret = np.mean([info["regret"] for agent in agents for info in agent.get_infos()[1:]])
    metrics_logger.log_value("regret", regret, window=20)


def policy(module: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The mean actions `[B, A]` in [0, 1] of a trained module, for observations `[B, inputs]`."""

    def act(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            outputs = module.forward_inference({"obs": torch.as_tensor(observations)})
        means, _ = outputs["action_dist_inputs"].chunk(2, dim=-1)
        return (means.clamp(-1, 1).numpy() + 1) / 2

    return act


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="SME/Default-v1", help="an id: of one agent or of a team")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    arguments = parser.parse_args()
    spec = sme_registry.load(arguments.env)
    config = (
        PPOConfig()
        .env_runners(num_env_runners=0, num_envs_per_env_runner=1 if spec.team else 8)
        .callbacks(on_episode_end=log_regret)
        .training(train_batch_size=ROLLOUT, minibatch_size=128, num_epochs=10, lr=1e-3, gamma=0.5)
    )
    names = []
    if spec.team:
        names = sme_registry.make_parallel(spec).possible_agents
        register_env(
            "team", lambda _: ParallelPettingZooEnv(sme_registry.make_parallel(arguments.env))
        )
        config.environment("team").multi_agent(
            policies=set(names), policy_mapping_fn=lambda agent, *_, **__: agent
        )
    else:
        config.environment(f"sme_registry:{arguments.env}")
    algorithm = config.build_algo()

    def evaluate() -> None:
        policies = {name: policy(algorithm.get_module(name)) for name in names}
        single = None if names else policy(algorithm.get_module())
        report = sme_registry.evaluate(policies or single, spec, "quick-v1", action_range="unit")
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    evaluate()
    for i in range(max(1, arguments.steps // ROLLOUT)):
        regret = algorithm.train()["env_runners"]["regret"]
        print(f"{(i + 1) * ROLLOUT:7} steps, exploring: regret {regret:.3f}", flush=True)
    evaluate()
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()

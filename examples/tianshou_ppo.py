"""Train PPO with Tianshou, and log the exact regret.

    make frameworks                    # an environment with the version tried, then this example
    python examples/tianshou_ppo.py --env SME/DefaultSymmetric-v1

Worker processes (`SubprocVectorEnv`) need the prefix of the id, `sme_registry:SME/…`. γ = 0.5 is
enough where every step is rewarded and no episode ends early (k = 1, D = 0).
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import gymnasium
import numpy as np

import sme_registry

try:
    import torch
    from tianshou.algorithm import PPO
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OnPolicyTrainerParams
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is not installed. docs/guides/training.md has the command.")

ENVS, ROLLOUT = 8, 1024


def normal(means_and_deviations: tuple[torch.Tensor, torch.Tensor]) -> Any:
    """The distribution of the actions `[B, A]`."""
    return torch.distributions.Independent(torch.distributions.Normal(*means_and_deviations), 1)


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="SME/DefaultSymmetric-v1", help="actions in [-1, 1]")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small are slower on several threads
    envs = DummyVectorEnv([lambda: gymnasium.make(arguments.env)] * ENVS)
    envs.seed(0)
    env = gymnasium.make(arguments.env)
    task = env.unwrapped.sme_spec
    inputs, actions = env.observation_space.shape[0], env.action_space.shape[0]

    def network() -> Net:
        return Net(state_shape=inputs, hidden_sizes=(64, 64), activation=torch.nn.Tanh)

    actor = ContinuousActorProbabilistic(
        preprocess_net=network(), action_shape=actions, unbounded=True
    )
    policy = ProbabilisticActorPolicy(
        actor=actor, dist_fn=normal, action_space=env.action_space, deterministic_eval=True
    )
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(preprocess_net=network()),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=0.5,
    )
    regrets: list[float] = []

    def log(_: Any, batch: Any) -> None:
        """Collect the exact regret of each step; print its mean over each rollout."""
        regrets.extend(batch.info.regret)
        if len(regrets) % ROLLOUT == 0:
            regret = np.mean(regrets[-ROLLOUT:])
            print(f"{len(regrets):7} steps, exploring: regret {regret:.3f}", flush=True)

    def act(observations: np.ndarray) -> np.ndarray:
        """The policy to evaluate: observations `[B, S + 2]` to actions `[B, A]` in [-1, 1]."""
        with torch.no_grad():
            (means, _), _ = actor(observations)
        return means.clamp(-1, 1).numpy()

    def evaluate() -> None:
        report = sme_registry.evaluate(act, task, "quick-v1", action_range="symmetric")
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    evaluate()
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=Collector(
                policy, envs, VectorReplayBuffer(ROLLOUT, ENVS), on_step_hook=log
            ),
            max_epochs=1,
            epoch_num_steps=arguments.steps,
            collection_step_num_env_steps=ROLLOUT,
            batch_size=128,
            update_step_num_repetitions=10,
            verbose=False,
            show_progress=False,
        )
    )
    evaluate()


if __name__ == "__main__":
    main()

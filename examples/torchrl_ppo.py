"""Train PPO with TorchRL's collector and loss, and log the exact regret.

    pip install -c constraints.txt '.[fast]' torchrl
    python examples/torchrl_ppo.py --env SME/DefaultSymmetric-v1

`GymWrapper` takes the batch of environments, and TorchRL keeps its infos. `GymEnv` and its worker
processes need the prefix of the id: `GymEnv("sme_registry:SME/DefaultSymmetric-v1")`. γ = 0.5 is
enough where every step is rewarded and no episode ends early (k = 1, D = 0).
"""

from __future__ import annotations

import argparse
import sys

import gymnasium
import numpy as np

import sme_registry

try:
    import torch
    from tensordict.nn import TensorDictModule
    from tensordict.nn.distributions import NormalParamExtractor
    from torchrl.collectors import Collector
    from torchrl.envs import GymWrapper
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import ClipPPOLoss, ValueEstimators
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is not installed. docs/guides/training.md has the command.")

ENVS, ROLLOUT, EPOCHS, MINIBATCH = 8, 1024, 10, 128


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="SME/DefaultSymmetric-v1", help="actions in [-1, 1]")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small are slower on several threads
    envs = gymnasium.make_vec(arguments.env, num_envs=ENVS, autoreset_mode="SameStep")
    env, task = GymWrapper(envs), envs.unwrapped.sme_spec
    env.set_seed(0)
    inputs, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    sizes = {"in_features": inputs, "num_cells": [64, 64]}
    network = torch.nn.Sequential(MLP(out_features=2 * actions, **sizes), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        spec=env.action_spec_unbatched,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,  # in [-1, 1]
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(out_features=1, **sizes), in_keys=["observation"])
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.5, lmbda=0.9)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)

    def act(observations: np.ndarray) -> np.ndarray:
        """The policy to evaluate: observations `[B, S + 2]` to actions `[B, A]` in [-1, 1]."""
        with torch.no_grad():
            return network(torch.as_tensor(observations))[0].tanh().numpy()

    def evaluate() -> None:
        report = sme_registry.evaluate(act, task, "quick-v1", action_range="symmetric")
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    evaluate()
    total = max(1, arguments.steps // ROLLOUT) * ROLLOUT
    collector = Collector(
        env,
        actor,
        frames_per_batch=ROLLOUT,
        total_frames=total,
        auto_register_policy_transforms=False,
    )
    for i, batch in enumerate(collector):
        with torch.no_grad():
            loss.value_estimator(batch)
        for indices in (j for _ in range(EPOCHS) for j in torch.randperm(ROLLOUT).split(MINIBATCH)):
            losses = loss(batch.reshape(-1)[indices])
            optimiser.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimiser.step()
        regret = batch["next", "regret"].mean().item()  # exact, of the actions taken
        print(f"{(i + 1) * ROLLOUT:7} steps, exploring: regret {regret:.3f}", flush=True)
    evaluate()


if __name__ == "__main__":
    main()

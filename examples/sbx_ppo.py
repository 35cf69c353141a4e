"""Train PPO of sbx, Stable-Baselines3's algorithms in JAX, and log the exact regret.

    make frameworks                    # an environment with the version tried, then this example
    python examples/sbx_ppo.py --env Default

`SMEVecEnv` is the batch that Stable-Baselines3 takes, and its callbacks work in sbx. γ = 0.5 is
enough where every step is rewarded and no episode ends early (k = 1, D = 0).
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

import sme_registry

try:
    from sbx import PPO
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is not installed. docs/guides/training.md has the command.")

ENVS, ROLLOUT = 8, 1024


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="Default", help="a task: an id, a path or a digest")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    arguments = parser.parse_args()
    envs = sme_registry.sb3.SMEVecEnv(arguments.env, ENVS, action_range="symmetric")
    settings = {"n_steps": ROLLOUT // ENVS, "batch_size": 128, "gamma": 0.5, "learning_rate": 1e-3}
    model = PPO("MlpPolicy", envs, seed=0, **settings)

    def evaluate() -> None:
        report = sme_registry.evaluate(model, arguments.env, "quick-v1", action_range="symmetric")
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    evaluate()
    callback = sme_registry.sb3.RegretCallback()  # the exact regret of each episode
    model.learn(arguments.steps, callback=callback)
    regrets = [episode.regret for episode in callback.episodes]
    for first in range(0, len(regrets), ENVS):
        regret = np.mean(regrets[first : first + ENVS])
        print(f"episodes {first + 1:3} to {first + ENVS:3}, exploring: regret {regret:.3f}")
    evaluate()


if __name__ == "__main__":
    main()

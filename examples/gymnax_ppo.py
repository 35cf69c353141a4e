"""Train PPO of rejax, agent and environment in one compiled program, and log the exact regret.

    make frameworks                    # an environment with the version tried, then this example
    python examples/gymnax_ppo.py --env Default

rejax trains in environments of gymnax before 1.0; gymnax has wrappers that log episodes and that
give its present environments, such as ours, the former interface. γ = 0.5 is enough where every
step is rewarded and no episode ends early (k = 1, D = 0); there, regret is 1 − return / T.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

import sme_registry

try:
    import jax
    from gymnax.wrappers import LegacyStepAPIWrapper, LogWrapper
    from rejax import PPO

    from sme_registry.jax.gymnax import Environment
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is not installed. docs/guides/training.md has the command.")

ENVS, ROLLOUT = 8, 1024


class FormerInterface(LegacyStepAPIWrapper):
    """gymnax's wrapper, shared by copies: rejax copies its arguments, and it cannot be copied."""

    def __deepcopy__(self, memo: Any) -> FormerInterface:
        return self


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="Default", help="a task: an id, a path or a digest")
    parser.add_argument("--steps", type=int, default=16_384, help="environment steps")
    arguments = parser.parse_args()
    environment = Environment(arguments.env)
    task = environment.sme_spec

    def last_episodes(algorithm: Any, state: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return state.global_step, state.env_state.returned_episode_returns.mean()

    ppo = PPO.create(
        env=FormerInterface(LogWrapper(environment)),
        env_params=environment.default_params,
        eval_freq=ROLLOUT,
        skip_initial_evaluation=True,
        total_timesteps=arguments.steps,
        num_envs=ENVS,
        num_steps=ROLLOUT // ENVS,
        num_minibatches=8,
        num_epochs=10,
        gamma=0.5,
        learning_rate=1e-3,
        ent_coef=0.0,
        agent_kwargs={"activation": "tanh"},
    ).replace(eval_callback=last_episodes)

    def evaluate(state: Any) -> None:
        actor, weights = ppo.actor, state.actor_ts.params

        @jax.jit
        def means(observations: jax.Array) -> jax.Array:
            return actor.apply(weights, observations, method="_action_dist").mean()

        def act(observations: np.ndarray) -> np.ndarray:
            return np.asarray(means(observations)).clip(-1, 1)

        report = sme_registry.evaluate(act, task, "quick-v1", action_range="symmetric")
        print(f"WD regret {report.wd_regret:.3f}, OOD regret {report.ood_regret:.3f}", flush=True)

    start = ppo.init_state(jax.random.key(0))
    evaluate(start)
    state, (steps, returns) = jax.jit(ppo.train)(train_state=start)
    for step, episode_return in zip(steps.tolist(), returns.tolist(), strict=True):
        regret = 1.0 - episode_return / task.horizon
        print(f"{step:7} steps, exploring: regret {regret:.3f}")
    evaluate(state)


if __name__ == "__main__":
    main()

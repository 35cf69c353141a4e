"""Stable-Baselines3: a task as a batch for its algorithms, and two of our own for safety.

    from stable_baselines3 import PPO, TD3
    from sme_registry.sb3 import RegretCallback, SMETeamVecEnv, SMEVecEnv
    TD3("MlpPolicy", SMEVecEnv("Default", num_envs=4)).learn(20_000, callback=RegretCallback())
    PPO("MlpPolicy", SMETeamVecEnv("Team4", num_envs=8)).learn(20_000)  # one policy for all agents

`PPOLagrangian` and `PPOProjection` are for tasks with `safety`.

Bit for bit the numbers of SB3's `DummyVecEnv` of as many single environments or, for a team, of as
many `SMETeamEnv`s stepped in a loop.
"""

from sme_registry.io import require_packages

try:
    from sme_registry.sb3.safety import PPOLagrangian, PPOProjection
    from sme_registry.sb3.vec_env import RegretCallback, SMETeamVecEnv, SMEVecEnv
except ImportError:
    require_packages("sme_registry.sb3", {"stable_baselines3": "Stable-Baselines3"}, "train")
    raise

__all__ = [
    "PPOLagrangian",
    "PPOProjection",
    "RegretCallback",
    "SMETeamVecEnv",
    "SMEVecEnv",
]

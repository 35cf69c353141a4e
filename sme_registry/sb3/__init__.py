"""A batch of one task as a Stable-Baselines3 `VecEnv`, stepped by machine code.

    from stable_baselines3 import PPO, TD3
    from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
    TD3("MlpPolicy", SMEVecEnv("Default", num_envs=4)).learn(20_000)
    PPO("MlpPolicy", SMETeamVecEnv("Team4", num_envs=8)).learn(20_000)  # one policy for all agents

Bit for bit the numbers of SB3's `DummyVecEnv` of as many single environments or, for a team, of as
many `SMETeamEnv`s stepped in a loop.
"""

from sme_registry.sb3.lanes import LanesVecEnv
from sme_registry.sb3.vec_envs import SMETeamVecEnv, SMEVecEnv

__all__ = ["LanesVecEnv", "SMETeamVecEnv", "SMEVecEnv"]

"""`RegretCallback`: the exact regret of every episode, in the log of a Stable-Baselines3 training.

callback = RegretCallback()
model.learn(20_000, callback=callback)     # rollout/regret, in TensorBoard and on the screen
plots.training_curve(callback.episodes, "regret.png")
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sme_registry.envs.episodes import Episode, Episodes, info_of_lanes


def log_episode(logger: Any, episode: Episode, agents: Sequence[str] = ()) -> None:
    """Add an episode to the means that SB3's logger shows."""
    logger.record_mean("rollout/regret", episode.regret)
    logger.record_mean("rollout/similarity", episode.similarity)
    for agent, regret in zip(agents, episode.agents_regret, strict=True):
        logger.record_mean(f"rollout/regret/{agent}", regret)
    for name, value in episode.safety._asdict().items() if episode.safety else ():
        logger.record_mean(f"rollout/{name}", value)


def episodes_of(env: Any, steps: int = 0, **options: Any) -> Episodes:
    """`Episodes` for a `VecEnv` of our environments, after so many steps."""
    agents = max(1, len(getattr(env, "agents", ())))
    spec = lambda: env.get_attr("sme_spec")[0]  # noqa: E731
    return Episodes(env.num_envs // agents, agents, spec, steps=steps, **options)


def finished_in(
    episodes: Episodes, rewards: Any, dones: Any, infos: Sequence[dict[str, Any]]
) -> list[Episode]:
    """Add a step of a `VecEnv`; returns the episodes that ended in it."""
    terminated = [not info.get("TimeLimit.truncated", False) for info in infos]
    return episodes.add(rewards, info_of_lanes(infos), terminated, dones)


class RegretCallback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Logs the exact regret of each finished episode: its mean over the episode, not its last step.

    Works with every `VecEnv` of our environments: `SMEVecEnv`, `SMETeamVecEnv`, and SB3's
    `DummyVecEnv` and `SubprocVecEnv` with or without `Monitor`. SB3's logger shows the mean over
    the episodes that ended since its last output, as `rollout/regret` and `rollout/similarity`;
    for a team also `rollout/regret/<agent>`, and for a task with `safety` also `rollout/cost`,
    `rollout/violating_share` and `rollout/safe_regret`.

    Attributes:
      episodes: the finished episodes, oldest first. `plots.training_curve` draws them.

    Examples:
      >>> from stable_baselines3 import PPO
      >>> from sme_registry.sb3 import RegretCallback, SMEVecEnv
      >>> callback = RegretCallback()
      >>> model = PPO("MlpPolicy", SMEVecEnv("Default"), n_steps=128, batch_size=64, n_epochs=1)
      >>> model = model.learn(128, callback=callback)
      >>> callback.episodes[0].step
      100
    """

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.episodes: list[Episode] = []
        self._sums: Episodes | None = None
        self._agents: Sequence[str] = ()

    def _on_training_start(self) -> None:
        # A second `learn` without a reset continues the present episodes.
        if self._sums is None or self.locals.get("reset_num_timesteps", True):
            agents = getattr(self.training_env, "agents", ())
            self._agents = agents if len(agents) > 1 else ()
            steps = int(self.model.num_timesteps) // max(1, len(agents))
            self._sums = episodes_of(self.training_env, steps)

    def _on_step(self) -> bool:
        assert self._sums is not None
        step = (self.locals[name] for name in ("rewards", "dones", "infos"))
        for episode in finished_in(self._sums, *step):
            self.episodes.append(episode._replace(episode=len(self.episodes) + 1))
            log_episode(self.logger, episode, self._agents)
        return True

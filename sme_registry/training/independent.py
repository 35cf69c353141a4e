"""`IndependentLearner`: one on-policy model for each agent of a team, trained at the same time.

Each sees what its agent observes, (s[O_i], t/T, r_cum/k), acts on its agent's channels, and learns
from its agent's reward alone. For each the others are part of the environment, which changes while
they learn (de Witt et al. 2020, "Is Independent Learning All You Need in the StarCraft Multi-Agent
Challenge?"). Their steps are collected here, for all models together, as
`OnPolicyAlgorithm.collect_rollouts` of Stable-Baselines3 collects them for one.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import functools
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from sme_registry.envs.episodes import Episode
from sme_registry.errors import OptionError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.task import materialize
from sme_registry.training.learn import Watch
from sme_registry.training.models import SB3Learner, new_model, random_seed, unloadable

Floats = npt.NDArray[np.float32]
_MODEL = "{}.zip"  # of an agent, in the folder of models and in the checkpoint


class _OfAgent(gymnasium.Env[Any, Any]):
    """The spaces of one agent, for the constructor of its model: it is stepped with the others."""

    def __init__(self, inputs: int, low: float, width: int) -> None:
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (inputs,), np.float32)
        self.action_space = gymnasium.spaces.Box(low, 1.0, (width,), np.float32)


class IndependentLearner(SB3Learner):
    """A model for each agent of a team, in environments that they share."""

    def _lanes(self, env: Any) -> int:
        return int(env.num_teams)

    def _new_models(self) -> dict[str, Any]:
        task, run = materialize(self.env.sme_spec), self.run
        S, teams = task.spec.state_dim, self.env.num_teams
        self._columns = [[*observed, S, S + 1] for observed in task.observed]
        self._widths = [owned.stop - owned.start for owned in task.owned]
        low = float(self.env.action_space.low.min())
        models = {}
        shapes = zip(task.names, self._columns, self._widths, strict=True)
        for agent, (agent_name, columns, width) in enumerate(shapes):
            of_agent = functools.partial(_OfAgent, len(columns), low, width)
            models[agent_name] = new_model(
                self.name,
                DummyVecEnv([of_agent] * teams),
                # An agent's initial weights do not change when another one is added.
                seed=random_seed(run.seed, agent),
                steps=run.steps,
                hyperparameters=self.hyperparameters,
            )
            _check(models[agent_name], self.name)
        return models

    @property
    def model(self) -> Any:
        return self.models

    def _learn(self, watch: Watch, first_step: int) -> None:
        set_random_seed(self._seed)
        self.env.seed(self._seed)
        observations = self._split(self.env.reset())
        starts = np.ones(self.env.num_teams, bool)
        while self.steps < self.run.steps:
            watch.on_pause()
            observations, starts = self._collect(observations, starts)
            for model in self.models.values():
                model._update_current_progress_remaining(model.num_timesteps, self.run.steps)
                model.train()
                model.logger.dump(model.num_timesteps)

    def save(self, path: Path) -> None:
        """Write the models as `<agent>.zip` into a folder; into one file if it has a suffix."""
        if path.suffix:
            self.save_checkpoint(path)
            return
        path.mkdir(exist_ok=True)
        for name, model in self.models.items():
            write_atomically(path / _MODEL.format(name), saved_sb3(model))

    def save_checkpoint(self, path: Path, sums: Any = None) -> None:
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as members:
            for name, model in self.models.items():
                members.writestr(_MODEL.format(name), saved_sb3(model))
        write_atomically(path, archive.getvalue())

    def restore(self, checkpoint: Path) -> None:
        try:
            with zipfile.ZipFile(checkpoint) as members:
                for name, model in self.models.items():
                    content = io.BytesIO(members.read(_MODEL.format(name)))
                    self.models[name] = type(model).load(content, env=model.env, device="cpu")
        except Exception as error:
            raise unloadable(checkpoint, error) from error
        self.env.steps = next(iter(self.models.values())).num_timesteps
        # Another stream than the first session's, the same whenever this session is repeated.
        self._seed = random_seed(self._seed, self.env.steps)

    def log(self, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            by_agent = episode.agents_regret or (episode.regret,)
            for model, regret in zip(self.models.values(), by_agent, strict=True):
                model.logger.record_mean("rollout/regret", regret)

    def _collect(
        self, observations: list[Floats], starts: npt.NDArray[Any]
    ) -> tuple[list[Floats], npt.NDArray[Any]]:
        """One rollout of every model; returns the last observations and which begin an episode."""
        n = len(self.models)
        models = list(self.models.values())
        for model in models:
            model.policy.set_training_mode(False)
            model.rollout_buffer.reset()
        for _ in range(models[0].n_steps):
            acted = [_act(model, seen) for model, seen in zip(models, observations, strict=True)]
            joint = self._join([clipped for *_, clipped in acted])
            rows, rewards, dones, infos = self.env.step(joint)
            for agent, model in enumerate(models):
                model.num_timesteps += self.env.num_teams
                seen, (actions, values, log_probs, _) = observations[agent], acted[agent]
                own_rewards = self._bootstrapped(agent, model, rewards[agent::n], infos[agent::n])
                model.rollout_buffer.add(seen, actions, own_rewards, starts, values, log_probs)
            observations, starts = self._split(rows), dones[::n]
        for model, seen in zip(models, observations, strict=True):
            with torch.no_grad():
                last = model.policy.predict_values(torch.as_tensor(seen))
            model.rollout_buffer.compute_returns_and_advantage(last_values=last, dones=starts)
        return observations, starts

    def _bootstrapped(
        self, agent: int, model: Any, rewards: Floats, infos: list[dict[str, Any]]
    ) -> Floats:
        """Rewards, with the value of the last state where the horizon cut an episode off."""
        rewards = rewards.copy()
        for row in np.flatnonzero([info["TimeLimit.truncated"] for info in infos]):
            seen = infos[row]["terminal_observation"][None, self._columns[agent]]
            with torch.no_grad():
                value = model.policy.predict_values(torch.as_tensor(seen)).item()
            rewards[row] += model.gamma * value
        return rewards

    def _split(self, rows: Any) -> list[Floats]:
        """Each agent's own observations `[teams, |O_i| + 2]`, from the shared ones of all lanes."""
        by_agent = rows.reshape(self.env.num_teams, len(self._columns), -1)
        return [np.ascontiguousarray(by_agent[:, i, c]) for i, c in enumerate(self._columns)]

    def _join(self, actions: list[Floats]) -> Floats:
        """Actions of all lanes `[teams · n, max a_i]`, from each agent's `[teams, a_i]`."""
        joint = np.zeros((self.env.num_teams, len(actions), max(self._widths)), np.float32)
        for agent, of_agent in enumerate(actions):
            joint[:, agent, : of_agent.shape[1]] = of_agent
        return joint.reshape(self.env.num_envs, -1)


def _act(model: Any, observations: Floats) -> tuple[Floats, Any, Any, Floats]:
    """Sampled actions, their values and log π, and the actions clipped to the action space."""
    with torch.no_grad():
        sampled, values, log_probs = model.policy(torch.as_tensor(observations))
    actions = sampled.numpy()
    space = model.action_space
    return actions, values, log_probs, np.clip(actions, space.low, space.high)


def _check(model: Any, uses: str) -> None:
    kind = type(model)
    usual = isinstance(model, OnPolicyAlgorithm) and (
        kind.collect_rollouts is OnPolicyAlgorithm.collect_rollouts
    )
    if not usual or model.use_sde:
        raise OptionError(
            f"algorithm={uses!r}: independent learners need an on-policy algorithm whose rollouts "
            "are Stable-Baselines3's own, such as PPO or A2C, without use_sde."
        )

"""Independent learners of a team: one on-policy model for each agent, trained at the same time.

All agents act in the same environments. Each model sees what its agent observes, (s[O_i], t/T,
r_cum/k), acts on its agent's channels, and learns from its agent's reward alone. For each of them
the others are part of the environment, which changes while they learn (independent learning; de
Witt et al. 2020, "Is Independent Learning All You Need in the StarCraft Multi-Agent Challenge?").

The steps are collected here, for all models together, as `OnPolicyAlgorithm.collect_rollouts` of
Stable-Baselines3 collects them for one; the updates are its `train`.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Never

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from sme_registry.envs.lanes import Lane
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.sb3 import LanesVecEnv, SMETeamVecEnv
from sme_registry.task import materialize
from sme_registry.training.learners import new_learner
from sme_registry.training.record import RunRecord

_MODEL = "{}.zip"  # of an agent, in the folder of models and in the checkpoint
Floats = npt.NDArray[np.float32]
OnStep = Callable[[npt.NDArray[Any], npt.NDArray[Any], list[dict[str, Any]]], None]


class _AgentLanes(LanesVecEnv):
    """The spaces of one agent in each environment, for the constructor of its model."""

    def reset(self) -> Never:
        raise NotImplementedError("The models of a team are stepped together.")

    step_wait = reset


class IndependentLearners:
    """The models of a team's agents, and the environments that they share."""

    def __init__(self, record: RunRecord) -> None:
        task = materialize(record.spec)
        self.env = SMETeamVecEnv(record.spec, record.num_envs, action_range=record.action_range)
        S = task.spec.state_dim
        self._columns = [[*observed, S, S + 1] for observed in task.observed]
        self._widths = [owned.stop - owned.start for owned in task.owned]
        low = float(self.env.action_space.low.min())  # type: ignore[attr-defined]
        # An agent's initial weights do not change when another one is added.
        seeds = [
            int(np.random.SeedSequence([record.seed, agent]).generate_state(1)[0] >> 1)
            for agent in range(len(task.names))
        ]
        self.models: dict[str, Any] = {}
        shapes = zip(task.names, self._columns, self._widths, seeds, strict=True)
        for name, columns, width, seed in shapes:
            lane = _lane(self.env, len(columns), width, low)
            self.models[name] = new_learner(
                record.algorithm,
                _AgentLanes([lane] * record.num_envs),
                seed=seed,
                steps=record.steps,
                hyperparameters=record.hyperparameters,
                field="algorithm",
            )
            _check(self.models[name], record.algorithm)
        self._seed = record.seed

    @property
    def num_timesteps(self) -> int:
        """Steps of the team over all environments."""
        return int(next(iter(self.models.values())).num_timesteps)

    @property
    def n_steps(self) -> int:
        """Steps of a rollout in each environment."""
        return int(next(iter(self.models.values())).n_steps)

    def learn(self, steps: int, on_step: OnStep, on_rollout: Callable[[], None]) -> None:
        """Learn until `num_timesteps` is at least `steps`."""
        set_random_seed(self._seed)
        self.env.seed(self._seed)
        observations = self._split(self.env.reset())
        starts = np.ones(self.env.num_teams, bool)
        while self.num_timesteps < steps:
            on_rollout()
            observations, starts = self._collect(observations, starts, on_step)
            for model in self.models.values():
                model._update_current_progress_remaining(model.num_timesteps, steps)
                model.train()
                model.logger.dump(model.num_timesteps)

    def save(self, folder: Path) -> None:
        """Write the model of each agent as `<agent>.zip` into a folder."""
        folder.mkdir(exist_ok=True)
        for name, model in self.models.items():
            write_atomically(folder / _MODEL.format(name), saved_sb3(model))

    def save_checkpoint(self, path: Path) -> None:
        """Write all models into one file, whole or not at all."""
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as members:
            for name, model in self.models.items():
                members.writestr(_MODEL.format(name), saved_sb3(model))
        write_atomically(path, archive.getvalue())

    def load_checkpoint(self, path: Path) -> None:
        """Continue from the models in a file, which must come from a trusted source."""
        try:
            with zipfile.ZipFile(path) as members:
                for name, model in self.models.items():
                    content = io.BytesIO(members.read(_MODEL.format(name)))
                    self.models[name] = type(model).load(content, env=model.env, device="cpu")
        except Exception as error:
            raise PolicyError(
                f"{path}: cannot be loaded: {type(error).__name__}: {error}. Start again with "
                "--force (in Python, force=True), or in another folder."
            ) from error
        # Another stream than the first session's, the same whenever this session is repeated.
        sequence = np.random.SeedSequence([self._seed, self.num_timesteps])
        self._seed = int(sequence.generate_state(1)[0] >> 1)

    def _collect(
        self, observations: list[Floats], starts: npt.NDArray[Any], on_step: OnStep
    ) -> tuple[list[Floats], npt.NDArray[Any]]:
        """One rollout of every model; returns the last observations and which begin an episode."""
        n = len(self.models)
        models = list(self.models.values())
        for model in models:
            model.policy.set_training_mode(False)
            model.rollout_buffer.reset()
        for _ in range(self.n_steps):
            acted = [_act(model, seen) for model, seen in zip(models, observations, strict=True)]
            joint = self._join([clipped for *_, clipped in acted])
            rows, rewards, dones, infos = self.env.step(joint)
            for agent, model in enumerate(models):
                model.num_timesteps += self.env.num_teams
                seen, (actions, values, log_probs, _) = observations[agent], acted[agent]
                own_rewards = self._bootstrapped(agent, model, rewards[agent::n], infos[agent::n])
                model.rollout_buffer.add(seen, actions, own_rewards, starts, values, log_probs)
            observations, starts = self._split(rows), dones[::n]
            on_step(rewards, dones, infos)
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


def _lane(env: Any, observation_dim: int, action_dim: int, low: float) -> Lane:
    """An environment as an agent sees it: its spaces."""
    box = gymnasium.spaces.Box
    observation_space = box(0.0, 1.0, (observation_dim,), np.float32)
    action_space = box(low, 1.0, (action_dim,), np.float32)
    return Lane(
        env, 0, observation_space=observation_space, action_space=action_space, render_mode=None
    )


def _act(model: Any, observations: Floats) -> tuple[Floats, Any, Any, Floats]:
    """Sampled actions, their values and log π, and the actions clipped to the action space."""
    with torch.no_grad():
        sampled, values, log_probs = model.policy(torch.as_tensor(observations))
    actions = sampled.numpy()
    space = model.action_space
    return actions, values, log_probs, np.clip(actions, space.low, space.high)


def _check(model: Any, uses: str) -> None:
    """Raise OptionError if a model does not collect rollouts as this module does."""
    kind = type(model)
    usual = isinstance(model, OnPolicyAlgorithm) and (
        kind.collect_rollouts is OnPolicyAlgorithm.collect_rollouts
    )
    if not usual or model.use_sde:
        raise OptionError(
            f"algorithm={uses!r}: independent learners need an on-policy algorithm whose rollouts "
            "are Stable-Baselines3's own, such as PPO or A2C, without use_sde."
        )

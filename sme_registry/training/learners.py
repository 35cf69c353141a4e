"""`Learner`: what a cell trains, a model of Stable-Baselines3's kind in its environments.

A single agent learns in one environment, as its algorithm is defined. The agents of a team share a
model, which gets the transitions of each, or have one each. A step of a team is one step of all its
agents.

Independent learners of a team are one on-policy model for each agent, trained at the same time.
Each sees what its agent observes, (s[O_i], t/T, r_cum/k), acts on its agent's channels, and learns
from its agent's reward alone. For each the others are part of the environment, which changes while
they learn (de Witt et al. 2020, "Is Independent Learning All You Need in the StarCraft Multi-Agent
Challenge?"). Their steps are collected here, for all models together, as
`OnPolicyAlgorithm.collect_rollouts` of Stable-Baselines3 collects them for one.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import copy
import io
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Never

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnvWrapper

from sme_registry.envs.vector import EnvView
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Perceptron, Policy, TeamPolicy
from sme_registry.evaluation.models import saved_sb3, torch_policy
from sme_registry.io import write_atomically
from sme_registry.sb3 import LanesVecEnv, SMETeamVecEnv
from sme_registry.sb3.vec_env import SingleVecEnv
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.task import materialize
from sme_registry.training.algorithms import default_num_envs, find, is_sb3
from sme_registry.training.hyperparameters import for_lanes
from sme_registry.training.models import new_model
from sme_registry.training.numpy_policy import numpy_policy, numpy_team_policy

_MODEL = "{}.zip"  # of an agent, in the folder of models and in the checkpoint
Floats = npt.NDArray[np.float32]


class CountedVecEnv(VecEnvWrapper):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Environments that count their steps, regret, cost and CPU seconds of this thread.

    Every model steps its environment, so counting here needs no hook in the model. `after_step` is
    called with `steps` after each step, for example to evaluate the model; its time is not counted.
    """

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.names: tuple[str, ...] = tuple(getattr(venv, "agents", ("",)))
        self.steps, self.seconds = 0, 0.0
        self.regret = np.zeros(len(self.names))  # sums over steps, by agent
        self.cost: float | None = None if venv.sme_spec.safety is None else 0.0
        self.last: tuple[Any, Any, list[dict[str, Any]]] = (0, 0, [])  # rewards, dones, infos
        self.after_step: Callable[[int], None] = lambda steps: None

    def reset(self) -> Any:
        """Begin an episode in every lane."""
        observations = self.venv.reset()
        self.reset_infos = self.venv.reset_infos
        return observations

    def step_wait(self) -> Any:
        """One step of every lane."""
        begun = time.thread_time()
        result = self.venv.step_wait()
        self.last = result[1:]
        infos = result[3]
        regret = np.array([info["regret"] for info in infos])
        self.regret += regret.reshape(-1, len(self.names)).sum(axis=0)
        if self.cost is not None:
            self.cost += sum(info["cost"] for info in infos)
        self.steps += self.num_envs // len(self.names)
        self.seconds += time.thread_time() - begun
        self.after_step(self.steps)
        return result


class _AgentLanes(LanesVecEnv):
    """The spaces of one agent in each environment, for the constructor of its model."""

    def reset(self) -> Never:
        raise NotImplementedError("The models of a team are stepped together.")

    step_wait = reset


class IndependentModels:
    """The models of a team's agents, in environments (`SMETeamVecEnv`) that they share."""

    def __init__(
        self, algorithm: str, env: Any, *, seed: int, steps: int, hyperparameters: Mapping[str, Any]
    ) -> None:
        task = materialize(env.sme_spec)
        self.env = env
        S = task.spec.state_dim
        self._columns = [[*observed, S, S + 1] for observed in task.observed]
        self._widths = [owned.stop - owned.start for owned in task.owned]
        low = float(env.action_space.low.min())
        # An agent's initial weights do not change when another one is added.
        seeds = [
            int(np.random.SeedSequence([seed, agent]).generate_state(1)[0] >> 1)
            for agent in range(len(task.names))
        ]
        self.models: dict[str, Any] = {}
        shapes = zip(task.names, self._columns, self._widths, seeds, strict=True)
        for name, columns, width, own_seed in shapes:
            lane = _lane(env, len(columns), width, low)
            self.models[name] = new_model(
                algorithm,
                _AgentLanes([lane] * env.num_teams),
                seed=own_seed,
                steps=steps,
                hyperparameters=hyperparameters,
                field="algorithm",
            )
            _check(self.models[name], algorithm)
        self._seed = seed

    @property
    def num_timesteps(self) -> int:
        """Steps of the team over all environments."""
        return int(next(iter(self.models.values())).num_timesteps)

    @property
    def n_steps(self) -> int:
        """Steps of a rollout in each environment."""
        return int(next(iter(self.models.values())).n_steps)

    def learn(self, steps: int, on_rollout: Callable[[], None] = lambda: None) -> None:
        """Learn until `num_timesteps` is at least `steps`."""
        set_random_seed(self._seed)
        self.env.seed(self._seed)
        observations = self._split(self.env.reset())
        starts = np.ones(self.env.num_teams, bool)
        while self.num_timesteps < steps:
            on_rollout()
            observations, starts = self._collect(observations, starts)
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
        self, observations: list[Floats], starts: npt.NDArray[Any]
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


def _lane(env: Any, observation_dim: int, action_dim: int, low: float) -> EnvView:
    """An environment as an agent sees it: its spaces."""
    box = gymnasium.spaces.Box
    observation_space = box(0.0, 1.0, (observation_dim,), np.float32)
    action_space = box(low, 1.0, (action_dim,), np.float32)
    return EnvView(
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


class Learner:
    """A model, or a model for each agent of a team, in its environments: a single run.

    Attributes:
      env: the environments, which count the steps of the task.
      model: what learns in them; of independent agents, all their models.
    """

    def __init__(
        self,
        uses: str,
        document: SMESpec | StreamSpec,
        *,
        seed: int,
        steps: int,
        hyperparameters: Mapping[str, Any],
        action_range: ActionRange,
    ) -> None:
        self._uses, self._document, self._action_range = uses, document, action_range
        spec = document if isinstance(document, SMESpec) else document.phases[0].spec
        entry = find(uses)
        self._single = spec.team is None
        self.env: Any
        if spec.team is None:
            self.env = CountedVecEnv(SingleVecEnv(document, action_range=action_range))
        else:
            algorithm = entry.load()
            num_envs = default_num_envs(spec, algorithm)
            self.env = CountedVecEnv(SMETeamVecEnv(spec, num_envs, action_range=action_range))
            lanes = num_envs if entry.kind == "independent" else self.env.num_envs
            hyperparameters = {
                **for_lanes(algorithm, lanes, hyperparameters),
                **hyperparameters,
            }
        self._independent = entry.kind == "independent"
        self._steps = steps if self._independent else steps * len(self.env.names)
        options: dict[str, Any] = {"seed": seed, "hyperparameters": hyperparameters}
        if self._independent:
            self.model: Any = IndependentModels(entry.name, self.env, steps=steps, **options)
        else:
            self.model = new_model(uses, self.env, steps=self._steps, **options)

    def learn(self) -> None:
        """Learn from at least the steps of the run."""
        self.model.learn(self._steps)

    def policy(self) -> Policy | TeamPolicy:
        """The present policy. Training may change it."""
        range_ = self._action_range
        if self._single:
            return numpy_policy(self.model, self._document, action_range=range_)
        models = self.model.models if self._independent else self.model
        return numpy_team_policy(models, self.env.sme_spec, action_range=range_)

    def lasting_policy(self) -> Policy:
        """The present policy of a single agent, which further training does not change."""
        policy = self.policy()
        assert isinstance(policy, Policy)  # streams have no teams
        if isinstance(policy.act, Perceptron):
            return policy  # a copy
        network = torch_policy(self.model)
        try:
            copied = copy.deepcopy(network or self.model, {id(self.env): self.env})
        except Exception as error:
            raise PolicyError(
                f"uses={self._uses!r}: cannot live in a stream, since its learner cannot be copied "
                f"at the end of a visit: {type(error).__name__}: {error}. Give it a __deepcopy__."
            ) from error
        return numpy_policy(copied, self._document, action_range=self._action_range)

    def save(self, path: Path) -> None:
        """Write the model; nothing of one that cannot be saved."""
        if self._independent:
            self.model.save_checkpoint(path)
        elif is_sb3(self.model):
            write_atomically(path, saved_sb3(self.model))
        elif hasattr(self.model, "save"):
            archive = io.BytesIO()
            self.model.save(archive)
            write_atomically(path, archive.getvalue())

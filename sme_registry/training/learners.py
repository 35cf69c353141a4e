"""`SB3Learner`: a model of Stable-Baselines3's kind, or one for each agent of a team.

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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Never

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.envs.vector import EnvView
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Perceptron, Policy, TeamPolicy
from sme_registry.evaluation.models import saved_sb3, torch_policy
from sme_registry.io import is_installed, write_atomically
from sme_registry.sb3 import LanesVecEnv, SMETeamVecEnv, SMEVecEnv
from sme_registry.sb3.vec_env import SingleVecEnv, finished_in, log_episode
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.task import materialize
from sme_registry.training.algorithms import default_num_envs, find, is_sb3, silence
from sme_registry.training.hyperparameters import for_lanes
from sme_registry.training.learn import Watch
from sme_registry.training.models import load_checkpoint, new_model, save_checkpoint
from sme_registry.training.numpy_policy import numpy_policy, numpy_team_policy
from sme_registry.training.record import VisitEnds

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


class SB3Learner:
    """A model, or a model for each agent of a team, in its environments: a `Learner`.

    With `num_envs` they are those of `sme train`, which log the returns of episodes.

    Attributes:
      env: the environments, which count the steps of the task.
      model: what learns in them; of independent agents, a dict from each to its model.
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
        num_envs: int | None = None,
        field: str = "uses",
    ) -> None:
        self._uses, self._document, self._action_range = uses, document, action_range
        self._seed, self._steps = seed, steps
        spec = document if isinstance(document, SMESpec) else document.phases[0].spec
        entry = find(uses, field)
        self._single, monitored = spec.team is None, num_envs is not None
        env: Any
        if spec.team is not None:
            algorithm = entry.load(field)
            num_envs = num_envs or default_num_envs(spec, algorithm)
            env = SMETeamVecEnv(spec, num_envs, action_range=action_range)
            lanes = num_envs if entry.kind == "independent" else env.num_envs
            hyperparameters = {**for_lanes(algorithm, lanes, hyperparameters), **hyperparameters}
        elif num_envs in (None, 1):
            env = SingleVecEnv(document, action_range=action_range)
        else:
            env = SMEVecEnv(document, num_envs, action_range=action_range)
        options: dict[str, Any] = {"seed": seed, "hyperparameters": hyperparameters}
        self._independent: IndependentModels | None = None
        if entry.kind == "independent":
            self.env: Any = CountedVecEnv(env)
            self._independent = IndependentModels(entry.name, self.env, steps=steps, **options)
            self.model: Any = self._independent.models
            return
        self.env = CountedVecEnv(VecMonitor(env) if monitored else env)
        transitions = steps * len(self.env.names)
        self.model = new_model(uses, self.env, steps=transitions, field=field, **options)

    @property
    def _models(self) -> list[Any]:
        return [self.model] if self._independent is None else list(self.model.values())

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.env.steps)

    @property
    def total(self) -> int:
        """Environment steps at the end: on-policy algorithms collect whole rollouts."""
        first = self._models[0]
        rollout: int = first.n_steps if hasattr(first, "rollout_buffer") else 1
        chunk: int = rollout * self.env.num_envs // len(self.env.names)
        return self.steps + -(-max(0, self._steps - self.steps) // chunk) * chunk

    def learn(self, watch: Watch) -> None:
        """Take at least the steps that are left; after each of them, `watch.on_steps`."""
        stream, first_step = self._document, self.steps
        visits = None
        if isinstance(stream, StreamSpec):
            visits = VisitEnds(stream, watch.on_visit, first_step)

        def after_step(steps: int) -> None:
            watch.on_steps()
            if visits is not None:
                visits.after_step(steps)

        self.env.after_step = after_step
        if first_step < self._steps:
            self._learn(watch, first_step)
        watch.on_pause()
        if visits is not None:  # the last one ends with the training
            visits.finish(self.steps)

    def _learn(self, watch: Watch, first_step: int) -> None:
        left = (self._steps - first_step) * len(self.env.names)
        if self._independent is not None:
            self._independent.learn(self._steps, watch.on_pause)
        elif watch.pauses:
            self.model.learn(left, callback=_Pauses(watch), reset_num_timesteps=first_step == 0)
        else:
            self.model.learn(left)

    def add_to(self, sums: Episodes) -> list[Episode]:
        """Add the last step to sums; returns the episodes that ended in it."""
        return finished_in(sums, *self.env.last)

    def policy(self) -> Policy | TeamPolicy:
        """The present policy. Training may change it."""
        range_ = self._action_range
        if self._single:
            return numpy_policy(self.model, self._document, action_range=range_)
        return numpy_team_policy(self.model, self.env.sme_spec, action_range=range_)

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

    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        weights = (weight for model in self._models for weight in model.policy.parameters())
        # Squared: products of weights that are finite and huge are not, and nor are the actions.
        return all(bool(torch.isfinite(weight.square()).all()) for weight in weights)

    def restore(self, checkpoint: Path) -> None:
        """Go on from a checkpoint, with random numbers of its own."""
        if self._independent is not None:
            self._independent.load_checkpoint(checkpoint)
            self.env.steps = self._independent.num_timesteps
            return
        changes: dict[str, Any] = {}
        if hasattr(self.model, "buffer_size"):
            changes["buffer_size"] = self.model.buffer_size
        self.model = model = load_checkpoint(type(self.model), checkpoint, self.env, **changes)
        # Another stream than the first session's, the same whenever this session is repeated.
        sequence = np.random.SeedSequence([self._seed, model.num_timesteps])
        model.set_random_seed(int(sequence.generate_state(1)[0] >> 1))
        self.env.steps = int(model.num_timesteps) // len(self.env.names)
        if isinstance(self._document, StreamSpec):  # a seed begins a new life, here where it was
            self.env.set_options({"lifetime": self.env.steps})

    def save_checkpoint(self, path: Path, sums: Any = None) -> None:
        """Write a checkpoint; the present episodes restart, so their sums are not in it."""
        if self._independent is not None:
            self._independent.save_checkpoint(path)
        else:
            save_checkpoint(self.model, path)

    def save(self, path: Path) -> None:
        """Write the model, of independent agents a folder; nothing of one that cannot be saved."""
        if self._independent is not None:
            save = self._independent.save_checkpoint if path.suffix else self._independent.save
            save(path)
        elif is_sb3(self.model):
            write_atomically(path, saved_sb3(self.model))
        elif hasattr(self.model, "save"):
            archive = io.BytesIO()
            self.model.save(archive)
            write_atomically(path, archive.getvalue())

    def begin_log(self, folder: Path) -> None:
        """Log to TensorBoard in a folder if it is installed; independent agents each in its own."""
        for model in self._models:
            silence(model)
        if not is_installed("tensorboard"):
            return
        if self._independent is None:
            self.model.set_logger(configure(str(folder), ["tensorboard"]))
            return
        for name, model in self.model.items():
            model.set_logger(configure(str(folder / name), ["tensorboard"]))

    def log(self, episodes: Sequence[Episode]) -> None:
        """Log finished episodes."""
        names = self.env.names
        for episode in episodes:
            if self._independent is None:
                log_episode(self.model.logger, episode, names if len(names) > 1 else ())
                continue
            by_agent = episode.agents_regret or (episode.regret,)
            for model, regret in zip(self._models, by_agent, strict=True):
                model.logger.record_mean("rollout/regret", regret)

    def close(self) -> None:
        """Close the logs and the environments."""
        for model in self._models:
            model.logger.close()
        self.env.close()


class _Pauses(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Calls `watch.on_pause` between rollouts.

    There the model is consistent: it has learnt from all transitions, and they are in its replay
    buffer. For off-policy algorithms that is after each environment step.
    """

    def __init__(self, watch: Watch) -> None:
        super().__init__()
        self._watch = watch

    def _on_rollout_start(self) -> None:
        self._watch.on_pause()

    def _on_step(self) -> bool:
        return True

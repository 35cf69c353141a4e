"""`IndependentLearner` and `JAXLearner`, and which learner of Stable-Baselines3 a name gets.

Independent learners of a team are one on-policy model for each agent, trained at the same time.
Each sees what its agent observes, (s[O_i], t/T, r_cum/k), acts on its agent's channels, and learns
from its agent's reward alone. For each the others are part of the environment, which changes while
they learn (de Witt et al. 2020, "Is Independent Learning All You Need in the StarCraft Multi-Agent
Challenge?"). Their steps are collected here, for all models together, as
`OnPolicyAlgorithm.collect_rollouts` of Stable-Baselines3 collects them for one.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Never

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from sme_registry.compiled.arrays import Array
from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.errors import OptionError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, read_arrays, write_arrays, write_atomically
from sme_registry.sb3.vec_env import LanesVecEnv, log_episode
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import parse_uses
from sme_registry.task import materialize
from sme_registry.training.algorithms import jax_package
from sme_registry.training.learn import Learner, Watch
from sme_registry.training.models import (
    SB3Learner,
    new_model,
    new_sb3_model,
    random_seed,
    set_weights,
    unloadable,
)
from sme_registry.training.record import RunRecord

if TYPE_CHECKING:
    from sme_registry.jax.program import Program, StepLog

Floats = npt.NDArray[np.float32]
_MODEL = "{}.zip"  # of an agent, in the folder of models and in the checkpoint


def new_learner(uses: str, document: SMESpec | StreamSpec, **options: Any) -> SB3Learner:
    """The learner of an algorithm of Stable-Baselines3; the options are those of `SB3Learner`."""
    independent = parse_uses(uses)[0] == "independent"
    return (IndependentLearner if independent else SB3Learner)(uses, document, **options)


class _AgentLanes(LanesVecEnv):
    """The spaces of one agent in each environment, for the constructor of its model."""

    def reset(self) -> Never:
        raise NotImplementedError("The models of a team are stepped together.")

    step_wait = reset


class IndependentLearner(SB3Learner):
    """A model for each agent of a team, in environments that they share."""

    def _lanes(self, env: Any) -> int:
        return int(env.num_teams)

    def _new_models(self) -> dict[str, Any]:
        task, name = materialize(self.env.sme_spec), parse_uses(self._uses)[1]
        S, teams = task.spec.state_dim, self.env.num_teams
        self._columns = [[*observed, S, S + 1] for observed in task.observed]
        self._widths = [owned.stop - owned.start for owned in task.owned]
        low = float(self.env.action_space.low.min())
        models = {}
        shapes = zip(task.names, self._columns, self._widths, strict=True)
        for agent, (agent_name, columns, width) in enumerate(shapes):
            lane = SimpleNamespace(
                observation_space=gymnasium.spaces.Box(0.0, 1.0, (len(columns),), np.float32),
                action_space=gymnasium.spaces.Box(low, 1.0, (width,), np.float32),
                render_mode=None,
            )
            models[agent_name] = new_model(
                name,
                _AgentLanes([lane] * teams),
                # An agent's initial weights do not change when another one is added.
                seed=random_seed(self._seed, agent),
                steps=self._steps,
                hyperparameters=self.hyperparameters,
                field="algorithm",
            )
            _check(models[agent_name], name)
        return models

    @property
    def model(self) -> Any:
        return self.models

    def _learn(self, watch: Watch, first_step: int) -> None:
        set_random_seed(self._seed)
        self.env.seed(self._seed)
        observations = self._split(self.env.reset())
        starts = np.ones(self.env.num_teams, bool)
        while self.steps < self._steps:
            watch.on_pause()
            observations, starts = self._collect(observations, starts)
            for model in self.models.values():
                model._update_current_progress_remaining(model.num_timesteps, self._steps)
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


_PIECE = 100  # steps between two reports of progress, and the longest wait for Ctrl-C
_EPISODE = "episode"  # of the checkpoint: the sums of the present episode


class JAXLearner(Learner):
    """A program of one run in JAX, and the model of SB3 that gets its weights.

    Its checkpoint holds everything: a resumed run continues with the same bits.
    """

    def __init__(self, record: RunRecord) -> None:
        options: dict[str, Any] = {
            "hyperparameters": record.hyperparameters,
            "action_range": record.action_range,
            "steps": record.steps,
        }
        uses, document, seed = record.algorithm, record.document, record.seed
        self._program: Program = jax_package().run.new_program(
            uses, [document], [seed], device=record.device or None, **options
        )
        self._model = new_sb3_model(uses, document, seed=seed, **options)
        self._in_stream = record.stream is not None
        self._steps, self._piece = record.steps, min(_PIECE, record.checkpoint_every)
        self._sums = 4 if record.spec.safety is None else 7
        self.hyperparameters = record.hyperparameters
        self._log: StepLog | None = None
        self._logger = Logger(None, [])

    @property
    def steps(self) -> int:
        return int(self._program.steps)

    @property
    def total(self) -> int:
        rollout = self._program.rollout
        return -(-max(self._steps, self.steps) // rollout) * rollout

    @property
    def model(self) -> Any:
        set_weights(self._model, self._program.weights(0), self.steps)
        return self._model

    def learn(self, watch: Watch) -> None:
        watch.prepare("compiling …")

        def on_log(log: StepLog) -> None:
            self._check_finite()
            self._log = log
            watch.on_steps()

        jax_package().run.run(
            self._program,
            on_log=on_log,
            on_visit=(lambda visit, _: watch.on_visit(visit)) if self._in_stream else None,
            after_piece=watch.on_pause,
            piece=self._piece,
        )
        self._check_finite()

    def _check_finite(self) -> None:
        if not self.is_finite():
            raise ValueError("The weights are not finite.")

    def add_to(self, sums: Episodes) -> list[Episode]:
        log = self._log
        assert log is not None
        ended = np.logical_or(log.terminated, log.truncated)
        info = {name: value for name, value in log._asdict().items() if value is not None}
        return sums.add(log.reward, info, log.terminated, ended)

    def is_finite(self) -> bool:
        return not self._program.failed()[0]

    def restore(self, checkpoint: Path) -> Array:
        sums = np.zeros((7, 1, 1))
        try:
            arrays = read_arrays(checkpoint)
            sums[: self._sums, 0, 0] = arrays.pop(_EPISODE)
            self._program.restore(arrays)
        except (KeyError, OptionError) as error:
            raise unloadable(checkpoint, error.__cause__ or error) from None
        return sums

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        write_arrays(path, {**self._program.save(), _EPISODE: sums[: self._sums, 0, 0]})

    def save(self, path: Path) -> None:
        write_atomically(path, saved_sb3(self.model))

    def begin_log(self, folder: Path) -> None:
        if is_installed("tensorboard"):
            self._logger = configure(str(folder), ["tensorboard"])

    def log(self, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            self._logger.record_mean("rollout/ep_rew_mean", episode.episode_return)
            self._logger.record_mean("rollout/ep_len_mean", episode.length)
            log_episode(self._logger, episode)
        self._logger.dump(self.steps)

    def close(self) -> None:
        self._logger.close()

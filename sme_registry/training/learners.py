"""`SB3Learner` and `JAXLearner`: what runs and cells train, each a `Learner` (`learn`).

A single agent learns in one environment, as its algorithm is defined. The agents of a team share a
model, which gets the transitions of each, or have one each. A step of a team is one step of all its
agents.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import copy
import io
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from sme_registry.compiled.arrays import Array
from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Perceptron, Policy, TeamPolicy
from sme_registry.evaluation.models import saved_sb3, torch_policy
from sme_registry.io import is_installed, read_arrays, write_arrays, write_atomically
from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
from sme_registry.sb3.vec_env import SingleVecEnv, finished_in, log_episode
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.training.algorithms import default_num_envs, find, for_lanes, is_sb3, silence
from sme_registry.training.learn import Watch
from sme_registry.training.models import (
    IndependentModels,
    load_checkpoint,
    new_model,
    new_sb3_model,
    save_checkpoint,
    set_weights,
    unloadable,
)
from sme_registry.training.numpy_policy import numpy_policy, numpy_team_policy
from sme_registry.training.record import RunRecord, VisitEnds

if TYPE_CHECKING:
    from sme_registry.jax.program import Program, StepLog


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
        spec = document.specs[0]
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


_PIECE = 100  # steps between two reports of progress, and the longest wait for Ctrl-C
_EPISODE = "episode"  # of the checkpoint: the sums of the present episode


class JAXLearner:
    """Agents in JAX: a program of one run, and the model of SB3 that gets its weights.

    Its checkpoint holds everything, so a run that is resumed continues with the same bits.
    """

    def __init__(self, record: RunRecord) -> None:
        options: dict[str, Any] = {
            "hyperparameters": record.hyperparameters,
            "action_range": record.action_range,
            "steps": record.steps,
        }
        uses, document, seed = record.algorithm, record.document, record.seed
        from sme_registry.jax.run import new_program

        self._program: Program = new_program(
            uses, [document], [seed], device=record.device or None, **options
        )
        self._model = new_sb3_model(uses, document, seed=seed, **options)
        self._in_stream = record.stream is not None
        self._steps, self._piece = record.steps, min(_PIECE, record.checkpoint_every)
        self._sums = 4 if record.spec.safety is None else 7
        self._log: StepLog | None = None
        self._logger: Any = None

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self._program.steps)

    @property
    def total(self) -> int:
        """Environment steps at the end: PPO collects whole rollouts."""
        rollout = self._program.rollout
        return -(-max(self._steps, self.steps) // rollout) * rollout

    @property
    def model(self) -> Any:
        """The model of Stable-Baselines3, with the present weights."""
        set_weights(self._model, self._program.weights(0), self.steps)
        return self._model

    def learn(self, watch: Watch) -> None:
        """Take the steps that are left; after each piece of them, `watch.on_steps`."""
        from sme_registry.jax.run import run

        program, begin = self._program, self.steps
        watch.prepare("compiling …")

        def on_log(log: StepLog) -> None:
            self._check_finite()
            self._log = log
            watch.on_steps()
            if program.steps - begin > max(self._piece, program.rollout):
                watch.prepared()  # PPO's updates are compiled in the second piece

        run(
            program,
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
        """Add the last piece to sums; returns the episodes that ended in it."""
        log = self._log
        assert log is not None
        ended = np.logical_or(log.terminated, log.truncated)
        info = {name: value for name, value in log._asdict().items() if value is not None}
        return sums.add(log.reward, info, log.terminated, ended)

    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        return not self._program.failed()[0]

    def restore(self, checkpoint: Path) -> Array:
        """Go on from a checkpoint; returns the sums of the present episode."""
        sums = np.zeros((7, 1, 1))
        try:
            arrays = read_arrays(checkpoint)
            sums[: self._sums, 0, 0] = arrays.pop(_EPISODE)
            self._program.restore(arrays)
        except (KeyError, OptionError) as error:
            raise unloadable(checkpoint, error.__cause__ or error) from None
        return sums

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        """Write a checkpoint, with the sums of the present episode."""
        write_arrays(path, {**self._program.save(), _EPISODE: sums[: self._sums, 0, 0]})

    def save(self, path: Path) -> None:
        """Write the model of Stable-Baselines3."""
        write_atomically(path, saved_sb3(self.model))

    def begin_log(self, folder: Path) -> None:
        """Log to TensorBoard in a folder if it is installed."""
        if is_installed("tensorboard"):
            self._logger = configure(str(folder), ["tensorboard"])

    def log(self, episodes: Sequence[Episode]) -> None:
        """Log the means of the episodes that ended in a piece."""
        if self._logger is None:
            return
        for episode in episodes:
            self._logger.record_mean("rollout/ep_rew_mean", episode.episode_return)
            self._logger.record_mean("rollout/ep_len_mean", episode.length)
            log_episode(self._logger, episode)
        self._logger.dump(self.steps)

    def close(self) -> None:
        """Close the log."""
        if self._logger is not None:
            self._logger.close()

"""Models of Stable-Baselines3 and of its kind, and `SB3Learner`, in whose environments they learn.

A function that is named as an algorithm returns a model:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> model

so anything can be trained that has `learn(total_timesteps)`, which takes at least so many steps,
and `predict(observation, *, deterministic)`, which returns actions `[B, A]` in the range of
`env.action_space`, or a tuple that begins with them. Agents in JAX have a model of
Stable-Baselines3, too, with the same weights: evaluation, export to ONNX, diagnosis and
leaderboards take it as any other.

A checkpoint is a model's .zip that SB3 can load with one more member, the filled part of the replay
buffer: with two files, a kill between the writes would pair a model with the wrong buffer.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import copy
import inspect
import io
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnvWrapper

from sme_registry.envs.episodes import Episode, info_of_envs
from sme_registry.errors import OptionError, PolicyError, SMEError
from sme_registry.evaluation import Perceptron, Policy
from sme_registry.evaluation.models import saved_sb3, torch_policy
from sme_registry.evaluation.policies import TeamPolicy
from sme_registry.io import import_object, is_installed, write_atomically
from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
from sme_registry.sb3.vec_env import log_episode
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.training.algorithms import (
    arguments_of,
    default_num_envs,
    is_on_policy,
    is_sb3,
    load_algorithm,
    parse_uses,
    policy_alias,
)
from sme_registry.training.learn import Learner, Run, Steps, Watch
from sme_registry.training.numpy_policy import numpy_policy, numpy_team_policy
from sme_registry.training.record import VisitEnds

_MAX_REPLAY = 1_000_000  # SB3's default
_ROLLOUT, _MIN_ROLLOUT = 2048, 16  # SB3's default for PPO in one environment; ours at least
_MEMBER = "sme_replay_buffer.npz"
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def new_model(
    name: str,
    env: Any,
    *,
    seed: int,
    steps: int,
    hyperparameters: Mapping[str, Any],
) -> Any:
    """Create a model that learns in a `VecEnv`, from so many steps of all its lanes."""
    algorithm = load_algorithm(name)
    settings = resolved(hyperparameters)
    if isinstance(algorithm, type) and is_sb3(algorithm):
        if is_off_policy(algorithm):
            settings = {"buffer_size": min(_MAX_REPLAY, steps + env.num_envs), **settings}
        try:
            policy = policy_alias(algorithm)
            model = algorithm(policy, env, seed=seed, device="cpu", **settings)
        except (AssertionError, MemoryError, TypeError, ValueError) as error:
            raise _rejected(name, hyperparameters, error) from error
    else:
        try:
            inspect.signature(algorithm).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"algorithm={name!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give only those that it accepts."
            ) from None
        model = algorithm(env, seed=seed, **settings)
    missing = [method for method in ("learn", "predict") if not hasattr(model, method)]
    if missing:
        raise OptionError(
            f"algorithm={name!r}: returned a {type(model).__name__}, which has no "
            f"{' and no '.join(missing)}. Return a learner like those of Stable-Baselines3."
        )
    if is_sb3(model):
        silence(model)
    return model


def _rejected(name: str, hyperparameters: Iterable[str], error: Exception) -> OptionError:
    """The error for what an algorithm of Stable-Baselines3 cannot learn with."""
    return OptionError(
        f"algorithm={name!r}: rejects the task or the hyperparameters {sorted(hyperparameters)}: "
        f"{error}. Change them, or create the learner in a function and give module:function."
    )


def new_sb3_model(
    uses: str,
    document: SMESpec | StreamSpec,
    *,
    seed: int,
    action_range: ActionRange,
    hyperparameters: Mapping[str, Any],
    steps: int,
) -> Any:
    """An untrained model. Make it before the training, so that what it refuses is refused then."""
    settings = dict(hyperparameters)
    if "buffer_size" in settings:
        settings["buffer_size"] = min(settings["buffer_size"], max(1, steps))
    return new_model(
        parse_uses(uses)[1],
        SMEVecEnv(document, 1, action_range=action_range),
        seed=seed,
        steps=steps,
        hyperparameters=settings,
    )


def set_weights(model: Any, weights: Mapping[str, npt.NDArray[Any]], steps: int) -> None:
    """Give a model the weights of an agent in JAX; its optimiser stays new."""
    names = model.policy.state_dict().keys()
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    model.policy.load_state_dict({name: tensors[name] for name in names})
    for name in tensors.keys() - names:
        getattr(model, name).data.copy_(tensors[name])
    model.num_timesteps = steps
    if hasattr(model, "learning_starts"):
        every = model.train_freq.frequency
        updates = model.gradient_steps if model.gradient_steps >= 0 else every
        model._n_updates = max(0, steps - model.learning_starts) // every * updates


def save_checkpoint(model: Any, path: Path) -> None:
    """Write a checkpoint; raises OptionError if that fails, and the previous one is unchanged."""
    archive = io.BytesIO(saved_sb3(model))
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.size()
        arrays = {name: getattr(buffer, name)[:filled] for name in _ARRAYS}
        replay = io.BytesIO()
        np.savez(replay, pos=buffer.pos, full=buffer.full, **arrays)
        with zipfile.ZipFile(archive, "a") as members:
            members.writestr(_MEMBER, replay.getvalue())
    write_atomically(path, archive.getvalue())


def load_checkpoint(algorithm: Any, path: Path, env: Any, **kwargs: Any) -> Any:
    try:
        with zipfile.ZipFile(path) as members:
            if _MEMBER not in members.namelist():
                return algorithm.load(path, env=env, device="cpu", **kwargs)
            replay = dict(np.load(io.BytesIO(members.read(_MEMBER)), allow_pickle=False))
        if "buffer_size" in kwargs:
            kwargs["buffer_size"] = max(kwargs["buffer_size"], replay["rewards"].size)
        model = algorithm.load(path, env=env, device="cpu", **kwargs)
        _refill(model.replay_buffer, replay)
        return model
    except Exception as error:
        raise unloadable(path, error) from error


def unloadable(path: Path, error: BaseException) -> PolicyError:
    """The error for a checkpoint that is damaged or of another program."""
    return PolicyError(
        f"{path}: cannot be loaded: {type(error).__name__}: {error}. Start again with --force "
        "(in Python, force=True), or in another folder."
    )


def _refill(buffer: Any, replay: dict[str, Any]) -> None:
    filled = len(replay["rewards"])
    for name in _ARRAYS:
        getattr(buffer, name)[:filled] = replay[name]
    # A buffer that was full and is now larger continues after its last row. This changes the order
    # of the ring, which does not matter because batches are sampled at random.
    was_full = bool(replay["full"])
    buffer.full = was_full and filled >= buffer.buffer_size
    buffer.pos = filled if was_full and not buffer.full else int(replay["pos"])


def resolved(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values for a constructor: tuples for lists, and the classes named in `policy_kwargs`."""
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in hyperparameters.items()}
    policy_kwargs = values.get("policy_kwargs")
    if isinstance(policy_kwargs, Mapping):
        values["policy_kwargs"] = {
            name: import_object(value, f"hyperparameters.policy_kwargs.{name}", OptionError)
            if isinstance(value, str) and ":" in value
            else value
            for name, value in policy_kwargs.items()
        }
    return values


def is_off_policy(algorithm: Any) -> bool:
    return isinstance(algorithm, type) and issubclass(algorithm, OffPolicyAlgorithm)


def for_lanes(algorithm: Any, lanes: int, chosen: Iterable[str] = ()) -> dict[str, int]:
    """The changes to SB3's defaults that keep an algorithm the same in several lanes at once.

    A lane is an environment, or one agent of a team. SB3's `n_steps` counts the steps of each: PPO
    in 8 would collect 16,384 transitions for one update, so the rollout of 2,048 is divided. And
    TD3 in 8 would learn an eighth as often, so it gets one update for each transition.

    On Team4, r̃ was 0.77 after 16,384 steps of PPO with SB3's defaults, and 0.85 divided.
    """
    if lanes == 1:
        return {}
    if is_on_policy(algorithm) and "n_steps" not in chosen:
        default: int = arguments_of(algorithm).model_fields["n_steps"].default
        n_steps = min(default, max(_MIN_ROLLOUT, _ROLLOUT // lanes))
        return {} if n_steps == default else {"n_steps": n_steps}
    of_updates = {"gradient_steps", "train_freq"} & set(chosen)
    return {"gradient_steps": -1} if is_off_policy(algorithm) and not of_updates else {}


def silence(model: Any) -> None:
    """Disable the logger of an SB3 model; by default it creates a temporary folder."""
    model.set_logger(Logger(None, []))


def random_seed(*numbers: int) -> int:
    """A seed that follows from others."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)


def log_of_run(logger: Any, episode: Episode, agents: Sequence[str] = ()) -> None:
    """Log an episode as Stable-Baselines3 does, and its exact regret."""
    logger.record_mean("rollout/ep_rew_mean", episode.episode_return)
    logger.record_mean("rollout/ep_len_mean", episode.length)
    log_episode(logger, episode, agents)


class WatchedVecEnv(VecEnvWrapper):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Environments that count their steps and CPU seconds, and say what happened in each step."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.names: tuple[str, ...] = venv.agents
        self.steps, self.seconds = 0, 0.0
        self.on_steps: Callable[[Steps], None] = lambda steps: None

    def reset(self) -> Any:
        observations = self.venv.reset()
        self.reset_infos = self.venv.reset_infos
        return observations

    def step_wait(self) -> Any:
        begun = time.thread_time()
        result = self.venv.step_wait()
        self.seconds += time.thread_time() - begun
        self.steps += self.num_envs // len(self.names)
        _, rewards, dones, infos = result
        terminated = [not info["TimeLimit.truncated"] for info in infos]
        self.on_steps(Steps(rewards, info_of_envs(infos), terminated, dones))
        return result


class SB3Learner(Learner):
    """A model of a single agent, or that the agents of a team share, in its environments.

    A single agent learns in one environment, as its algorithm is defined. A shared model gets the
    transitions of each agent. A step of a team is one step of all its agents.

    `models` are by agent; one that is shared has no name.
    """

    def __init__(self, name: str, run: Run) -> None:
        super().__init__(name, run)
        self._seed, spec = run.seed, run.document.specs[0]
        algorithm = load_algorithm(name)
        num_envs = run.num_envs or default_num_envs(spec, algorithm)
        kind: Any = SMEVecEnv if spec.team is None else SMETeamVecEnv
        env = kind(run.document, num_envs, action_range=run.action_range)
        changes = for_lanes(algorithm, self._lanes(env), run.hyperparameters)
        self.hyperparameters = {**changes, **run.hyperparameters}
        self.env: Any = WatchedVecEnv(env)
        self.models = self._new_models()

    def _lanes(self, env: Any) -> int:
        """The lanes from which a model learns."""
        return int(env.num_envs)

    def _new_models(self) -> dict[str, Any]:
        model = new_model(
            self.name,
            self.env,
            seed=self.run.seed,
            steps=self.run.steps * len(self.env.names),
            hyperparameters=self.hyperparameters,
        )
        return {"": model}

    @property
    def model(self) -> Any:
        return self.models[""]

    @property
    def steps(self) -> int:
        return int(self.env.steps)

    @property
    def total(self) -> int:
        first = next(iter(self.models.values()))
        rollout: int = first.n_steps if hasattr(first, "rollout_buffer") else 1
        chunk: int = rollout * self.env.num_envs // len(self.env.names)
        return self.steps + -(-max(0, self.run.steps - self.steps) // chunk) * chunk

    @property
    def seconds(self) -> float:
        return float(self.env.seconds)

    def learn(self, watch: Watch) -> None:
        stream, first_step = self.run.document, self.steps
        visits = None
        if isinstance(stream, StreamSpec):
            visits = VisitEnds(stream, watch.on_visit, first_step)

        def on_steps(steps: Steps) -> None:
            watch.on_steps(steps)
            if visits is not None:
                visits.after_step(self.steps)

        self.env.on_steps = on_steps
        if first_step < self.run.steps:
            try:
                self._learn(watch, first_step)
            except (SMEError, OSError, MemoryError):
                raise
            except Exception as error:  # of Stable-Baselines3, which checks few hyperparameters
                if not (self._of_sb3 and self.run.hyperparameters):
                    raise
                raise _rejected(self.name, self.run.hyperparameters, error) from error
        watch.on_pause()
        if visits is not None:  # the last one ends with the training
            visits.finish(self.steps)

    def _learn(self, watch: Watch, first_step: int) -> None:
        left = (self.run.steps - first_step) * len(self.env.names)
        if is_sb3(self.model):
            self.model.learn(left, callback=_Pauses(watch), reset_num_timesteps=first_step == 0)
            return
        self.model.learn(left)
        if self.steps < self.run.steps:
            raise PolicyError(
                f"algorithm={self.name!r}: learn({left}) returned after {self.steps} steps of its "
                "environment. It must take all of them, in that environment."
            )

    def policy(self) -> Policy | TeamPolicy:
        document, range_ = self.run.document, self.run.action_range
        if document.specs[0].team is None:
            return numpy_policy(self.model, document, action_range=range_)
        return numpy_team_policy(self.model, document.specs[0], action_range=range_)

    def lasting_policy(self) -> Policy:
        policy = self.policy()
        assert isinstance(policy, Policy)  # streams have no teams
        if isinstance(policy.act, Perceptron):
            return policy  # a copy
        network = torch_policy(self.model)
        try:
            copied = copy.deepcopy(network or self.model, {id(self.env): self.env})
        except Exception as error:
            raise PolicyError(
                f"algorithm={self.name!r}: cannot live in a stream, since its learner cannot be "
                f"copied at the end of a visit: {type(error).__name__}: {error}. Give it a "
                "__deepcopy__."
            ) from error
        return numpy_policy(copied, self.run.document, action_range=self.run.action_range)

    @property
    def _of_sb3(self) -> dict[str, Any]:
        """The models that can be logged and resumed, by agent."""
        return {agent: model for agent, model in self.models.items() if is_sb3(model)}

    def is_finite(self) -> bool:
        models = self._of_sb3.values()
        weights = (weight for model in models for weight in model.policy.parameters())
        # Squared: products of weights that are finite and huge are not, and nor are the actions.
        return all(bool(torch.isfinite(weight.square()).all()) for weight in weights)

    def restore(self, checkpoint: Path) -> None:
        changes: dict[str, Any] = {}
        if hasattr(self.model, "buffer_size"):
            changes["buffer_size"] = self.model.buffer_size
        model = load_checkpoint(type(self.model), checkpoint, self.env, **changes)
        self.models[""] = model
        # Another stream than the first session's, the same whenever this session is repeated.
        model.set_random_seed(random_seed(self._seed, model.num_timesteps))
        self.env.steps = int(model.num_timesteps) // len(self.env.names)
        if isinstance(self.run.document, StreamSpec):  # a seed begins a new life, here where it was
            self.env.set_options({"lifetime": self.env.steps})

    def save_checkpoint(self, path: Path, sums: Any = None) -> None:
        """Write a checkpoint; the present episodes restart, so their sums are not in it."""
        for model in self._of_sb3.values():
            save_checkpoint(model, path)

    def save(self, path: Path) -> None:
        if is_sb3(self.model):
            write_atomically(path, saved_sb3(self.model))
        elif hasattr(self.model, "save"):
            archive = io.BytesIO()
            self.model.save(archive)
            write_atomically(path, archive.getvalue())

    def begin_log(self, folder: Path) -> None:
        for name, model in self._of_sb3.items():
            silence(model)
            if is_installed("tensorboard"):
                model.set_logger(configure(str(folder / name), ["tensorboard"]))

    def log(self, episodes: Sequence[Episode]) -> None:
        names = self.env.names
        for model in self._of_sb3.values():
            for episode in episodes:
                log_of_run(model.logger, episode, names if len(names) > 1 else ())

    def close(self) -> None:
        for model in self._of_sb3.values():
            model.logger.close()
        self.env.close()


class _Pauses(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Calls `watch.on_pause` where a model has learnt from all transitions: between rollouts."""

    def __init__(self, watch: Watch) -> None:
        super().__init__()
        self._watch = watch

    def _on_rollout_start(self) -> None:
        self._watch.on_pause()

    def _on_step(self) -> bool:
        return True

"""Models of Stable-Baselines3 and of its kind, by the names of their algorithms.

A function that is named as an algorithm returns a model:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> Model

so anything with `learn` and `predict` can be trained. Agents in JAX have one, too, with the same
weights: evaluation, export to ONNX, diagnosis and leaderboards take it as any other.

Independent learners of a team (`IndependentModels`) are one on-policy model for each agent, trained
at the same time. Each sees what its agent observes, (s[O_i], t/T, r_cum/k), acts on its agent's
channels, and learns from its agent's reward alone. For each the others are part of the environment,
which changes while they learn (de Witt et al. 2020, "Is Independent Learning All You Need in the
StarCraft Multi-Agent Challenge?"). Their steps are collected here, for all models together, as
`OnPolicyAlgorithm.collect_rollouts` of Stable-Baselines3 collects them for one.

A checkpoint is a model's .zip that SB3 can load with one more member, the filled part of the replay
buffer: with two files, a kill between the writes would pair a model with the wrong buffer. That of
an agent in JAX is an .npz of all arrays of its program.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import inspect
import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Never, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from sme_registry.envs.vector import EnvView
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.sb3 import LanesVecEnv, SMEVecEnv
from sme_registry.spec import ActionRange, SMESpec, StreamSpec
from sme_registry.spec.study import parse_uses
from sme_registry.task import materialize
from sme_registry.training.algorithms import (
    find,
    is_sb3,
    policy_alias,
    refuse_unknown,
    replay_settings,
    resolved,
    silence,
)

Floats = npt.NDArray[np.float32]
_MODEL = "{}.zip"  # of an agent, in the folder of models and in the checkpoint
_MEMBER = "sme_replay_buffer.npz"
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Model(Protocol):
    """What learns, such as a model of Stable-Baselines3."""

    def learn(self, total_timesteps: int) -> Any:
        """Learn from at least this many steps of the environment."""

    def predict(self, observation: Any, *, deterministic: bool) -> Any:
        """Actions `[B, A]` in the range of `env.action_space`, or a tuple that begins with them."""


def new_model(
    uses: str,
    env: Any,
    *,
    seed: int,
    steps: int,
    hyperparameters: Mapping[str, Any],
    field: str = "uses",
) -> Model:
    """Create a model that learns in a `VecEnv`, from so many steps of all its lanes."""
    algorithm = find(uses, field).load(field)
    refuse_unknown(algorithm, uses, hyperparameters)
    settings = resolved(hyperparameters)
    if isinstance(algorithm, type) and is_sb3(algorithm):
        settings = {**replay_settings(algorithm, steps + env.num_envs), **settings}
        try:
            policy = policy_alias(algorithm)
            model = algorithm(policy, env, seed=seed, device="cpu", **settings)
        except (AssertionError, MemoryError, TypeError, ValueError) as error:
            raise OptionError(
                f"{field}={uses!r}: rejects the task or the hyperparameters "
                f"{sorted(hyperparameters)}: {error}. Change them, or create the learner in a "
                "function and give module:function."
            ) from error
    else:
        try:
            inspect.signature(algorithm).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"{field}={uses!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give only those that it accepts."
            ) from None
        model = algorithm(env, seed=seed, **settings)
    missing = [name for name in ("learn", "predict") if not hasattr(model, name)]
    if missing:
        raise OptionError(
            f"{field}={uses!r}: returned a {type(model).__name__}, which has no "
            f"{' and no '.join(missing)}. Return a learner like those of Stable-Baselines3."
        )
    if is_sb3(model):
        silence(model)
    return model  # type: ignore[no-any-return]


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
        field="algorithm",
    )


def set_weights(model: Any, weights: Mapping[str, npt.NDArray[Any]], steps: int) -> None:
    """Give a model the weights of an agent in JAX; its optimiser stays new."""
    names = model.policy.state_dict().keys()
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    model.policy.load_state_dict({name: tensors[name] for name in names})
    for name in tensors.keys() - names:
        getattr(model, name).data.copy_(tensors[name])
    model.num_timesteps = steps


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
    """The model of a checkpoint, with its replay buffer."""
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
            raise unloadable(path, error) from error
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

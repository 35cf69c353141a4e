"""A batch of one task as a Stable-Baselines3 `VecEnv`, and the regret of episodes in SB3's log."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch
from sme_registry.envs.episodes import Episode, Episodes, info_of_envs
from sme_registry.envs.rendering import METADATA, Frame, batch_renderer, html_card
from sme_registry.envs.schedule import Schedule, renamed_by_content
from sme_registry.envs.vector import EnvView
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.io import integer_in
from sme_registry.registration import registered_or_new
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import title
from sme_registry.spec.sme_spec import ActionRange, SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.task.task import REWARD, Array, Mask, Observation
from sme_registry.teams import shared_action_dim, shared_observation, shared_observation_dim

StepResult: TypeAlias = tuple[Observation, npt.NDArray[np.float32], Mask, list[dict[str, Any]]]
"""Observations, rewards, dones and infos."""


class LanesVecEnv(VecEnv):  # type: ignore[misc, unused-ignore]  # an untyped class without SB3
    """A `VecEnv` apart from how its lanes are stepped; `lanes` have their attributes."""

    def __init__(self, lanes: list[Any]) -> None:
        self._lanes = lanes
        self._actions: npt.NDArray[Any] | None = None
        super().__init__(len(lanes), lanes[0].observation_space, lanes[0].action_space)

    @property
    def sme_spec(self) -> SMESpec:
        spec: SMESpec = self._lanes[0].sme_spec
        return spec

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        self._actions = actions

    def _take_actions(self) -> npt.NDArray[Any]:
        if self._actions is None:
            raise EpisodeError("step_wait: there are no actions. Call step_async(actions) first.")
        actions, self._actions = self._actions, None
        return actions

    def _clear_reset_arguments(self) -> None:
        self._reset_seeds()
        self._reset_options()

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each lane: `task`, `sme_spec`, `spec`, `state`, or one set before."""
        return [getattr(self._lanes[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for i in self._get_indices(indices):
            setattr(self._lanes[i], attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **method_kwargs) for method in methods]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """False for each lane: wrap the `VecEnv` instead, as `VecMonitor` does."""
        return [False for _ in self._get_indices(indices)]


class _BatchVecEnv(LanesVecEnv):
    """Every agent of every team of a `Batch` is a lane; a single agent is a team of one."""

    def __init__(
        self,
        batch: Batch,
        action_range: str,
        observation_dim: int,
        action_dim: int,
        env_spec: EnvSpec | None = None,
        render_mode: str | None = None,
        render_lanes: Sequence[int] | None = None,
    ) -> None:
        task = batch.task
        self.num_teams, self.agents = batch.num_envs, task.names
        self._task, self._batch, self._action_dim = task, batch, action_dim
        self._begun, self._owned = False, task.owned
        action_space, self._rescaled = arguments.action_space(action_range, action_dim)
        observation_space = gymnasium.spaces.Box(0.0, 1.0, (observation_dim,), np.float32)
        shared = {
            "render_mode": render_mode, "spec": env_spec,
            "observation_space": observation_space, "action_space": action_space,
        }  # fmt: skip
        teams = range(self.num_teams)
        super().__init__(
            [EnvView(self, team, agent=a, **shared) for team in teams for a in self.agents]
        )
        self._renderer = batch_renderer(render_mode, render_lanes, batch, self._rescaled)
        self.metadata = {**self.metadata, "render_fps": METADATA["render_fps"]}

    def __repr__(self) -> str:
        lanes = f"num_envs={self.num_envs}"
        if self.num_envs != self.num_teams:
            lanes += f", {self.num_teams} teams of {len(self.agents)} agents"
        return f"{type(self).__name__}({title(self.document)}, {lanes})"

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What the lanes run: their spec, or a stream."""
        return self._batch.document

    def _repr_html_(self) -> str:
        spaces = self.observation_space, self.action_space
        return html_card(self, *spaces, autoreset=AutoresetMode.SAME_STEP.value)

    def get_images(self) -> list[Frame]:
        """The frames of the chosen lanes or teams, each `[H, W, 3]` uint8; `render` tiles them."""
        return [] if self._renderer is None else [*self._renderer.frames()]

    def _info_at_reset(self, lane: int) -> dict[str, Any]:
        owned = self._owned[lane % len(self.agents)]
        life = self._batch.life_of(lane // len(self.agents))
        columns = self._batch.schedule.columns
        return {**columns.at_reset(owned.stop - owned.start), **life}

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed team e with seed + e at the next reset; None draws a seed."""
        first = list(super().seed(seed))
        self._seeds = [first[lane // len(self.agents)] for lane in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Observation:
        joint = self._batch.observe()
        for team in range(self.num_teams):
            self._begin(team, joint)
        self._begun = True
        if self._renderer is not None:
            self._renderer.record(range(self.num_teams))
        self.reset_infos = [self._info_at_reset(lane) for lane in range(self.num_envs)]
        self._clear_reset_arguments()
        return self._observations(joint)

    def _begin(self, team: int, joint: Observation) -> None:
        """Begin a team's episode, with its seed and the options of its lanes."""
        first, n, spec = team * len(self.agents), len(self.agents), self._task.spec
        seed, options = arguments.checked_seed(self._seeds[first]), self._options[first : first + n]
        for of_lane in options:
            arguments.check_options(of_lane, self._batch.schedule.reset_options)
        shape = (spec.state_dim,)
        states = [arguments.initial_states(of["state"], shape) for of in options if "state" in of]
        if states and (len(states) < n or len({*map(tuple, states)}) > 1):
            raise OptionError("options: a team has one state. Give the same to each of its lanes.")
        # Teams have neither distractors nor a lifetime.
        distractors = arguments.initial_values("distractors", options[0], (spec.distractors,), 1)
        lifetime = arguments.lifetime_in(options[0])
        if seed is not None:
            self._batch.seed(team, seed)
        if lifetime is not None:
            self._batch.live(team, lifetime)
        state = states[0][None] if states else None
        self._batch.begin(np.array([team]), joint, state, distractors)

    def step_wait(self) -> StepResult:
        actions = self._take_actions()
        if not self._begun:
            raise EpisodeError("step: the episodes have not begun. Call reset() first.")
        n, shape = len(self.agents), (self.num_envs, self._action_dim)
        unit = arguments.to_unit(actions, shape, self._rescaled)
        joint = self._joint_actions(unit)
        step = self._batch.advance(joint)

        values = step.values.swapaxes(1, 2).reshape(len(step.values), -1)
        of_step = self._batch.schedule.columns
        in_range = arguments.from_unit(step.actions, self._rescaled)
        columns: dict[str, list[Any]] = {
            **{
                key: [row[part] for row in rows for part in self._owned]
                for key, rows in zip(of_step.actions, in_range, strict=True)
            },
            **{key: list(values[row]) for key, row in of_step.numbers.items()},
            **{key: list(values) for key, values in self._batch.lived.items()},
            "TimeLimit.truncated": np.repeat(step.truncated & ~step.terminated, n).tolist(),
        }
        rows = zip(*columns.values(), strict=True)
        lane_infos: list[dict[str, Any]] = [dict(zip(columns, row, strict=True)) for row in rows]
        ended: Mask = step.terminated | step.truncated
        dones = np.repeat(ended, n)
        if ended.any():
            last = self._observations(step.observation.copy())
            self._batch.begin(np.flatnonzero(ended), step.observation)
            for lane in np.flatnonzero(dones).tolist():
                lane_infos[lane]["terminal_observation"] = last[lane]
                self.reset_infos[lane] = self._info_at_reset(lane)
        if self._renderer is not None:
            self._renderer.record(np.flatnonzero(ended).tolist(), joint, step)
        reward = values[REWARD].astype(np.float32)
        return self._observations(step.observation), reward, dones, lane_infos

    def _observations(self, joint: Observation) -> Observation:
        return joint

    def _joint_actions(self, unit: Array) -> Array:
        return unit


class SMEVecEnv(_BatchVecEnv):
    """`num_envs` lanes of one task or stream for SB3's algorithms and `VecEnv` wrappers.

    As in SB3's `VecEnv`s, a finished lane begins its next episode at once, its last observation is
    `terminal_observation` in its info, `TimeLimit.truncated` is True where it was truncated and
    not terminated, and `seed(n)` seeds lane i with n + i at the next reset. Observations are
    `[B, S + m + 2]`, as those of `SMEEnv`. A stream's lives go on at each `reset()` without a seed.

    `action_range` "symmetric", [−1, 1], suits SB3's Gaussian policies; `render_mode` "rgb_array" is
    for `VecVideoRecorder`, with `render_lanes` the lanes to draw; `**overrides` change the spec.

    Examples:
      >>> from sme_registry.sb3 import SMEVecEnv
      >>> env = SMEVecEnv("Default", num_envs=4)
      >>> env.reset().shape
      (4, 10)
    """

    def __init__(
        self,
        spec_or_id: SpecLike | StreamLike,
        num_envs: int = 1,
        *,
        action_range: ActionRange = "symmetric",
        render_mode: str | None = None,
        render_lanes: Sequence[int] | None = None,
        **overrides: Any,
    ) -> None:
        named, num_envs = registered_or_new(spec_or_id), integer_in("num_envs", num_envs, 1)
        document: Any = named.kwargs.get("stream", named.kwargs.get("spec"))
        batch = Batch(Schedule.load(type(self), document, overrides), num_envs)
        kwargs = {**named.kwargs, "action_range": action_range, **overrides}
        env_spec = renamed_by_content(dataclasses.replace(named, kwargs=kwargs), batch.document)
        A, width = batch.document.action_dim, batch.observation_dim
        super().__init__(batch, action_range, width, A, env_spec, render_mode, render_lanes)


class SMETeamVecEnv(_BatchVecEnv):
    """`num_envs` teams of one task, each of their agents a lane: one policy for all agents.

    Lane e·n + i is agent i of team e. Its *shared observation* `[S + 2 + n]` in [0, 1] is the state
    with the channels that it does not observe set to 0, t/T, its own r_cum/k, and the one-hot of i.
    Its action is `[max a_i]`, of which its first a_i are used. Reward and info are that agent's,
    with the keys of `SMEEnv`. All agents of a team end together, and the team begins its next
    episode at once. `seed(n)` seeds team e with n + e at the next reset. All lanes of a team
    take the same options. The other arguments are as in `SMEVecEnv`.

    Examples:
      >>> from sme_registry.sb3 import SMETeamVecEnv
      >>> SMETeamVecEnv("Team4", num_envs=2).num_envs  # teams times agents
      8
    """

    def __init__(
        self,
        spec_or_id: SpecLike,
        num_envs: int = 1,
        *,
        action_range: ActionRange = "symmetric",
        render_mode: str | None = None,
        render_lanes: Sequence[int] | None = None,
        **overrides: Any,
    ) -> None:
        task = arguments.load_team(type(self), spec_or_id, overrides)
        # For each channel of the joint action: the agent that owns it, and the entry of its action.
        self._owner = np.repeat(np.arange(len(task.owned)), [o.stop - o.start for o in task.owned])
        self._entry = np.concatenate([np.arange(part.stop - part.start) for part in task.owned])
        observation_dim, action_dim = shared_observation_dim(task), shared_action_dim(task)
        batch = Batch(task, integer_in("num_envs", num_envs, 1))
        super().__init__(
            batch, action_range, observation_dim, action_dim,
            render_mode=render_mode, render_lanes=render_lanes,
        )  # fmt: skip

    def _observations(self, joint: Observation) -> Observation:
        return shared_observation(self._task, joint).reshape(self.num_envs, -1)

    def _joint_actions(self, unit: Array) -> Array:
        # Every entry must be finite, also the last ones of agents that own fewer channels.
        if not np.isfinite(unit).all():
            raise arguments.not_finite_error()
        by_agent = unit.reshape(self.num_teams, len(self.agents), -1)
        return np.ascontiguousarray(by_agent[:, self._owner, self._entry])


def log_episode(logger: Any, episode: Episode, agents: Sequence[str] = ()) -> None:
    """Add an episode to the means that SB3's logger shows."""
    logger.record_mean("rollout/regret", episode.regret)
    logger.record_mean("rollout/similarity", episode.similarity)
    for agent, regret in zip(agents, episode.agents_regret, strict=True):
        logger.record_mean(f"rollout/regret/{agent}", regret)
    for name, value in episode.safety._asdict().items() if episode.safety else ():
        logger.record_mean(f"rollout/{name}", value)


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
        self._env: Any = None
        self._normaliser: Any = None
        self._agents: Sequence[str] = ()

    def _on_training_start(self) -> None:
        env: Any = self.training_env
        # A second `learn` in the same environments without a reset continues the episodes.
        if self._env is not env or self.locals.get("reset_num_timesteps", True):
            self._env, self._normaliser = env, unwrap_vec_normalize(env)
            agents = getattr(env, "agents", ())
            self._agents, n = agents if len(agents) > 1 else (), max(1, len(agents))
            steps = int(self.model.num_timesteps) // n
            self._sums = Episodes(
                env.num_envs // n, n, lambda: env.get_attr("sme_spec")[0], steps=steps
            )

    def _on_step(self) -> bool:
        assert self._sums is not None
        rewards, dones, infos = (self.locals[name] for name in ("rewards", "dones", "infos"))
        if self._normaliser is not None:
            rewards = self._normaliser.get_original_reward()
        terminated = [not info.get("TimeLimit.truncated", False) for info in infos]
        for episode in self._sums.add(rewards, info_of_envs(infos), terminated, dones):
            self.episodes.append(episode._replace(episode=len(self.episodes) + 1))
            log_episode(self.logger, episode, self._agents)
        return True

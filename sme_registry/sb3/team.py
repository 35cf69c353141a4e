"""`SMETeamVecEnv`: every agent of every team is a lane, so that one policy acts for all agents."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch
from sme_registry.envs.shared import (
    shared_action_dim,
    shared_observation,
    shared_observation_dim,
)
from sme_registry.envs.types import Array, Mask, Observation
from sme_registry.errors import EpisodeError, OptionError
from sme_registry.io import integer_in
from sme_registry.sb3.lanes import Lane, LanesVecEnv, StepResult, infos_by_lane
from sme_registry.spec import ActionRange, SpecLike
from sme_registry.task import load_task


class SMETeamVecEnv(LanesVecEnv):
    """`num_envs` teams of one task, each of their agents a lane: one policy for all agents.

    Lane e·n + i is agent i of team e. Its *shared observation* `[S + 2 + n]` in [0, 1] is the state
    with the channels that it does not observe set to 0, t/T, its own r_cum/k, and the one-hot of i.
    Its action is `[max a_i]`, of which its first a_i are used. Reward and info are that agent's,
    with the keys of `SMEEnv`. All agents of a team end together, and the team begins its next
    episode at once. `seed(n)` seeds team e with n + e at the next reset. All lanes of a team
    take the same options.

    Args:
      spec_or_id: the task: a spec, its fields, an id, a digest or a path. One without a team is a
        team of one.
      num_envs: the teams, at least 1; `num_envs` of the VecEnv is the lanes, teams times agents.
      action_range: "symmetric", [−1, 1], or "unit", [0, 1].
      **overrides: spec fields to change.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: see `SMETeamEnv`.
    """

    def __init__(
        self,
        spec_or_id: SpecLike,
        num_envs: int = 1,
        *,
        action_range: ActionRange = "symmetric",
        **overrides: Any,
    ) -> None:
        num_envs = integer_in("num_envs", num_envs, 1)
        task = load_task(spec_or_id, **overrides)
        self._width = shared_action_dim(task)
        action_space, self._rescaled = arguments.action_space(action_range, self._width)
        shape = (shared_observation_dim(task),)
        shared = {
            "render_mode": None, "spec": None, "sme_spec": task.spec, "task": task,
            "observation_space": gymnasium.spaces.Box(0.0, 1.0, shape, np.float32),
            "action_space": action_space,
        }  # fmt: skip
        self.num_teams, self.agents = num_envs, task.names
        self._task, self._batch, self._begun = task, Batch(task, num_envs), False
        # For each channel of the joint action: the agent that owns it, and the entry of its action.
        self._owner = np.repeat(np.arange(len(task.owned)), [o.stop - o.start for o in task.owned])
        self._entry = np.concatenate([np.arange(part.stop - part.start) for part in task.owned])
        super().__init__(
            [
                Lane(self._batch, team, agent=name, **shared)
                for team in range(num_envs)
                for name in self.agents
            ]
        )

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed team e with seed + e at the next reset; None draws a seed.

        Returns:
          The seed of each lane, its team's.
        """
        first = list(super().seed(seed))
        self._seeds = [first[lane // len(self.agents)] for lane in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Observation:
        """Begin an episode in every team, with the seeds and options set before.

        Returns:
          Shared observations, `[B n, S + 2 + n]` float32.

        Raises:
          StateError, OptionError: the options of `set_options` are invalid.
        """
        n, starts = len(self.agents), {}
        for team in range(self.num_teams):
            start = self._start(self._options[team * n : (team + 1) * n])
            if start is not None:
                starts[team] = start
        for team, seed in enumerate(self._seeds[::n]):
            if seed is not None:
                self._batch.initial_states.seed(team, seed)
        joint = self._batch.observe()
        for team in range(self.num_teams):
            self._batch.begin(np.array([team]), joint, starts.get(team))
        self._begun = True
        self._clear_reset_arguments()
        return self._shared(joint)

    def _start(self, options: list[dict[str, Any]]) -> Array | None:
        """The initial state of a team, `[1, S]`, from the options of its lanes; None: draw it."""
        for lane in options:
            arguments.refuse_unknown_options(lane, ("state",))
        shape = (self._task.spec.state_dim,)
        states = [
            arguments.initial_states(lane["state"], shape) for lane in options if "state" in lane
        ]
        if not states:
            return None
        if len(states) < len(options) or any((state != states[0]).any() for state in states):
            raise OptionError("options: a team has one state. Give the same to each of its lanes.")
        return states[0][None]

    def step_wait(self) -> StepResult:
        """One step of every team.

        Returns:
          Shared observations `[B n, S + 2 + n]`, rewards `[B n]` float32, dones `[B n]`, infos.

        Raises:
          ActionError: wrong shape, not numbers, or not finite; no state has changed then.
          EpisodeError: before the first reset.
        """
        actions = self._take_actions()
        if not self._begun:
            raise EpisodeError("step: the episode has not begun. Call reset() first.")
        B, n, width = self.num_teams, len(self.agents), self._width
        unit = arguments.to_unit(actions, (B * n, width), self._rescaled)
        # Every entry must be finite, also the last ones of agents that own fewer channels.
        if not np.isfinite(unit).all():
            raise arguments.not_finite_error()
        joint = np.ascontiguousarray(unit.reshape(B, n, width)[:, self._owner, self._entry])
        done = self._batch.advance(joint)

        similarity, step_reward, regret, reward, accumulated = (
            agents.T.reshape(-1) for agents in done.values
        )
        optimal = arguments.from_unit(done.optimal, self._rescaled)
        columns: dict[str, list[Any]] = {
            "optimal_action": [row[part] for row in optimal for part in self._task.owned],
            "similarity": similarity.tolist(),
            "step_reward": step_reward.tolist(),
            "regret": regret.tolist(),
            "accumulated_reward": accumulated.tolist(),
        }
        observations = last = self._shared(done.observation)
        ended: Mask = done.terminated | done.truncated
        if ended.any():
            self._batch.begin(np.flatnonzero(ended), done.observation)
            observations = self._shared(done.observation)
        dones = np.repeat(ended, n)
        timed_out = np.repeat(done.truncated & ~done.terminated, n)
        infos = list(infos_by_lane(columns, timed_out, dones, last))
        return observations, reward.astype(np.float32), dones, infos

    def _shared(self, joint: Observation) -> Observation:
        return shared_observation(self._task, joint).reshape(self.num_envs, -1)

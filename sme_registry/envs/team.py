"""`SMETeamEnv`: a team's task as a PettingZoo environment, each agent with its exact regret.

Agent i owns a_i action channels and observes the state channels O_i, t/T, and its own r_cum/k.
What it is paid is of its own channels (`reward="individual"`) or of all (`"team"`). Its optimal
policy maps what *it* observes to its own channels, so its regret is exact and can be brought to 0.
A task without a team is a team of one, `agent_0`. Source: METHOD, section 5.
"""

from __future__ import annotations

import os
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from pettingzoo import ParallelEnv

from sme_registry.envs import actions as action_ranges
from sme_registry.envs.batch import Array, Batch, BatchStep, Observation
from sme_registry.envs.options import checked_seed, initial_states
from sme_registry.errors import ActionError, EpisodeError, OptionError, did_you_mean
from sme_registry.spec import SMESpec
from sme_registry.task import Task, load_task

_ONE = np.zeros(1, np.int64)  # the only lane


def observed_columns(task: Task) -> tuple[npt.NDArray[np.int64], ...]:
    """For each agent, the columns of the joint observation that it sees: O_i, t/T, its r_cum/k."""
    S = task.spec.state_dim
    return tuple(
        np.array([*channels, S, S + 1 + agent], np.int64)
        for agent, channels in enumerate(task.observed)
    )


class SMETeamEnv(ParallelEnv[str, Observation, npt.NDArray[Any]]):  # type: ignore[misc]
    """A team in parallel: every agent acts at every step, and all end together.

    Observation of agent i: `[|O_i| + 2]` float32 in [0, 1]. Action: `[a_i]`, in [0, 1]
    (`action_range="unit"`) or [−1, 1] (`"symmetric"`), clipped. `infos[agent]` of each step has the
    keys of `SMEEnv`, that agent's own; `similarity` is always over its own channels, while
    `step_reward`, `regret` and `accumulated_reward` are of what it is paid for.

    Args:
      spec: the task: a spec, its fields, an id, a digest or a path.
      action_range: "unit" or "symmetric".
      render_mode: None, "rgb_array" or "human".
      **overrides: spec fields to change.

    Raises:
      SpecError, UnknownNameError, ResourceLimitError, OptionError: as `SMEEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "sme_v1",
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        spec: SMESpec | dict[str, Any] | str | os.PathLike[str] = "Team2-v1",
        *,
        action_range: Literal["unit", "symmetric"] = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise OptionError(f"render_mode={render_mode!r}: must be None, 'human' or 'rgb_array'.")
        self.render_mode = render_mode
        self._task = load_task(spec, **overrides)
        self._batch = Batch(self._task, 1, reuse=True)
        columns = observed_columns(self._task)
        self._every_column = np.concatenate(columns)
        ends = np.cumsum([len(part) for part in columns]).tolist()
        self.possible_agents = list(self._task.names)
        parts = [slice(*part) for part in pairwise([0, *ends])]
        self._seen = list(zip(self.possible_agents, parts, strict=True))
        self._parts = [
            (agent, name, own)
            for agent, (name, own) in enumerate(
                zip(self.possible_agents, self._task.owned, strict=True)
            )
        ]
        self.agents: list[str] = []
        self._begun = False
        self._renderer: Any = None

        self._action_spaces, self._observation_spaces = {}, {}
        for agent, name, own in self._parts:
            width = own.stop - own.start
            self._action_spaces[name], self._rescaled = action_ranges.space(action_range, width)
            self._observation_spaces[name] = gymnasium.spaces.Box(
                0.0, 1.0, (len(columns[agent]),), np.float32
            )
        self._arrange()
        self._joint_space, _ = action_ranges.space(action_range, self.sme_spec.action_dim)
        self.state_space = gymnasium.spaces.Box(0.0, 1.0, (self.sme_spec.state_dim,), np.float64)

    def _arrange(self) -> None:
        """The joint action `[1, A]`, and each agent's part of it: a view to write into."""
        self._joint_action = np.zeros((1, self.sme_spec.action_dim))
        row = self._joint_action[0]
        self._slots = [(name, row[own].shape, row[own]) for _, name, own in self._parts]

    # A copied view is a view no longer: the parts are laid out again where the copy lives.
    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_joint_action", "_slots")
        return {name: value for name, value in self.__dict__.items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._arrange()

    @property
    def task(self) -> Task:
        """The drawn task: W, b, each agent's layers, the equations, and credit."""
        return self._task

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is really run, overrides included."""
        return self._task.spec

    def observation_space(self, agent: str) -> gymnasium.spaces.Box:
        """The space of an agent's observations, the same object each time."""
        return self._observation_spaces[self._known(agent)]

    def action_space(self, agent: str) -> gymnasium.spaces.Box:
        """The space of an agent's actions, the same object each time."""
        return self._action_spaces[self._known(agent)]

    def state(self) -> Array:
        """The state s, `[S]` float64 in [0, 1] (a copy), whatever each agent observes of it."""
        state: Array = self._batch.state[0]
        return state

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode at a state drawn uniformly from the cube, or at a given one.

        Args:
          seed: seeds the environment's generator; None goes on with the present one.
          options: `{"state": s}` begins at s `[S]`, each entry in [0, 1]. Others are ignored, as
            PettingZoo's are, but for those that look like a mistyped "state".

        Returns:
          Each agent's observation, and an empty info for each.

        Raises:
          StateError: the state has the wrong shape or lies outside the cube.
          OptionError: a bad seed or a mistyped option.
        """
        states = None
        for name in options or {}:
            if name != "state" and did_you_mean(str(name), ["state"]):
                raise OptionError(f"options={{{name!r}: …}}: unknown option. Did you mean 'state'?")
        if options and "state" in options:
            states = initial_states(options["state"], (self.sme_spec.state_dim,))[None]
        seed = checked_seed(seed)
        if seed is not None:
            self._batch.initial_states.seed(0, seed)
        observation = self._batch.observe()
        self._batch.begin(_ONE, observation, states)
        self.agents = self.possible_agents[:]
        self._begun = True
        if self.render_mode is not None:
            self._frame(None)
        return self._shown(observation), {name: {} for name in self.agents}

    def step(
        self, actions: dict[str, npt.NDArray[Any]]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """One step of the whole team.

        Args:
          actions: each agent's action `[a_i]`, finite; clipped to the action range.

        Returns:
          Observations, rewards (payouts, each in [0, k]), terminations, truncations and infos,
          each by agent.

        Raises:
          ActionError: an agent is missing or unknown, or its action is of the wrong shape, not
            numbers, or not finite; says whose. Nothing has moved then.
          EpisodeError: there is no episode under way.
        """
        joint = self._joint(actions)
        try:
            done = self._batch.advance(joint)
        except ActionError:
            raise self._not_finite(joint) from None
        terminated, truncated = done.terminated.item(), done.truncated.item()
        values = done.values.ravel().tolist()
        infos = self._infos(done.optimal[0].copy(), values)
        if terminated or truncated:
            self.agents = []
        if self.render_mode is not None:
            self._frame((joint, done))
        names, n = self.possible_agents, len(self.possible_agents)
        return (
            self._shown(done.observation),
            dict(zip(names, values[3 * n : 4 * n])),  # noqa: B905  # a keyword costs a percent
            dict.fromkeys(names, terminated),
            dict.fromkeys(names, truncated),
            infos,
        )

    def _infos(self, optimal: Array, values: list[float]) -> dict[str, dict[str, Any]]:
        """Each agent's info, of the values `[5 · n]` of `BatchStep`."""
        if self._rescaled:
            optimal = action_ranges.to_range(optimal, self._rescaled)
        n = len(self.possible_agents)
        return {
            name: {
                "optimal_action": optimal[own],
                "similarity": values[agent],
                "step_reward": values[n + agent],
                "regret": values[2 * n + agent],
                "accumulated_reward": values[4 * n + agent],
            }
            for agent, name, own in self._parts
        }

    def _shown(self, observation: Observation) -> dict[str, Observation]:
        """What each agent sees of the joint observation; fresh arrays, apart from each other."""
        seen = observation.take(self._every_column)  # of the one row that there is
        return {name: seen[part] for name, part in self._seen}

    def _joint(self, actions: dict[str, npt.NDArray[Any]]) -> Array:
        """The joint action `[1, A]`, float64 of the unit range."""
        if not self.agents:
            what = "has ended" if self._begun else "has not begun"
            raise EpisodeError(f"step: the episode {what}. Call reset() first.")
        for name, shape, own in self._slots:
            try:
                action = actions[name]
            except (KeyError, TypeError, IndexError):
                raise self._bad_keys(actions) from None
            # Most actions are arrays as they should be, and checking costs as much as the step.
            usual = type(action) is np.ndarray and action.dtype.char in "fd"
            own[...] = action if usual and action.shape == shape else self._checked(name, action)
        if len(actions) != len(self.possible_agents):
            raise self._bad_keys(actions)
        return (self._joint_action + 1.0) / 2.0 if self._rescaled else self._joint_action

    def _checked(self, name: str, action: Any) -> Array:
        """One agent's action as float64, in the environment's range."""
        try:
            return action_ranges.checked(action, self._action_spaces[name].shape, rescaled=False)
        except ActionError as error:
            raise ActionError(f"{name}: {error}") from None

    def check_action(self, agent: str, action: npt.NDArray[Any]) -> None:
        """Raise what `step` would raise of this action.

        Args:
          agent: whose it is.
          action: `[a_i]`, finite.

        Raises:
          ActionError: of the wrong shape, not numbers, or not finite.
          OptionError: there is no such agent.
        """
        if not np.isfinite(self._checked(self._known(agent), action)).all():
            raise ActionError(f"{agent}: {action_ranges.not_finite()}")

    def _bad_keys(self, actions: Any) -> ActionError:
        """What to raise where the actions are not one for each agent."""
        if not isinstance(actions, dict):
            return ActionError(
                f"actions={actions!r:.60}: must be a dict from each agent's name to its action."
            )
        missing = [name for name in self.possible_agents if name not in actions]
        unknown = [name for name in actions if name not in self.possible_agents]
        said = []
        if missing:
            said.append(f"{', '.join(missing)}: action missing.")
        if unknown:
            hint = did_you_mean(str(unknown[0]), missing or self.possible_agents)
            said.append(f"{', '.join(map(repr, unknown))}: no such agent.{hint}")
        return ActionError(
            f"actions: {' '.join(said)} Give one for each of {', '.join(self.possible_agents)}."
        )

    def _not_finite(self, joint: Array) -> ActionError:
        for _, name, own in self._parts:
            if not np.isfinite(joint[0, own]).all():
                return ActionError(f"{name}: {action_ranges.not_finite()}")
        return action_ranges.not_finite()

    def _known(self, agent: str) -> str:
        if agent not in self._action_spaces:
            raise OptionError(
                f"agent={agent!r}: no such agent.{did_you_mean(str(agent), self.possible_agents)} "
                f"Agents: {', '.join(self.possible_agents)}."
            )
        return agent

    def _frame(self, last: tuple[Array, BatchStep] | None) -> None:
        """Draw the team as one: all channels, and the mean over the agents of their numbers."""
        if self._renderer is None:
            from sme_registry.envs.rendering import Renderer

            self._renderer = Renderer(self.sme_spec, cast(str, self.render_mode), self.metadata)
        shown = SimpleNamespace(state=self.state(), action_space=self._joint_space)
        if last is None:
            self._renderer.record(shown, None)
            return
        joint, done = last
        similarity, step_reward, regret, _, accumulated = done.values[:, :, 0].mean(axis=1).tolist()
        info = {
            "optimal_action": action_ranges.to_range(done.optimal[0], self._rescaled),
            "similarity": similarity,
            "step_reward": step_reward,
            "regret": regret,
            "accumulated_reward": accumulated,
        }
        self._renderer.record(shown, (action_ranges.to_range(joint[0], self._rescaled), info))

    def render(self) -> Any:
        """The frame of this step: `[H, W, 3]` uint8 for "rgb_array"; None for "human", shown.

        Raises:
          EpisodeError: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs a render_mode, given when the team is made.")
            return None
        if self._renderer is None:
            raise EpisodeError("render: the episode has not begun. Call reset() first.")
        return self._renderer.frame()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __repr__(self) -> str:
        return f"SMETeamEnv({self.sme_spec.content_name}, {len(self.possible_agents)} agents)"

    __str__ = __repr__

"""Teams as PettingZoo environments, by the names that PettingZoo's own modules use.

    from sme_registry import teams
    env = teams.parallel_env("SME/Team4-v1")

In a parallel environment all agents act at once. In an AEC environment they act in turn, and the
step happens when the last one has acted. `sme_registry.make_parallel` and `make_aec` are the same.

Agent i owns a_i action channels and observes the state channels O_i, t/T, and its own r_cum/k.
Source: METHOD, section 5. Where one policy acts for every agent, it is called for each agent in
turn, with that agent's *shared observation* `[B, S + 2 + n]`

    (s with the channels that the agent does not observe set to 0, t/T, its r_cum/k, one-hot of i)

and returns `[B, max a_i]`, of which the agent's first a_i are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from sme_registry.envs import arguments
from sme_registry.envs.batch import Batch
from sme_registry.envs.rendering import RENDER_MODES, RenderMixin, html_card
from sme_registry.envs.schedule import Schedule
from sme_registry.errors import ActionError, EpisodeError, OptionError, did_you_mean
from sme_registry.spec.catalogue import title
from sme_registry.spec.sme_spec import ActionRange, SpecLike
from sme_registry.task import Task
from sme_registry.task.task import REWARD, Array, Indices, Observation

__all__ = ["SMETeamEnv", "env", "parallel_env"]


def parallel_env(
    spec: SpecLike = "Team2-v1", *, max_cycles: int | None = None, **kwargs: Any
) -> SMETeamEnv:
    """A team's task as a PettingZoo parallel environment; see `make_parallel`.

    `max_cycles` is PettingZoo's name of the spec's `horizon`.

    Examples:
      >>> from sme_registry import teams
      >>> team = teams.parallel_env("Team2", max_cycles=10)
      >>> observations, infos = team.reset(seed=0)
      >>> actions = {agent: team.action_space(agent).sample() for agent in team.agents}
      >>> observations, rewards, terminations, truncations, infos = team.step(actions)
      >>> sorted(rewards)
      ['agent_0', 'agent_1']
    """
    if max_cycles is not None and kwargs.setdefault("horizon", max_cycles) != max_cycles:
        raise OptionError(
            f"max_cycles={max_cycles!r}: must equal horizon={kwargs['horizon']!r}, as both are the "
            "length of an episode. Leave one of them out."
        )
    return SMETeamEnv(spec, **kwargs)


def env(
    spec: SpecLike = "Team2-v1", **kwargs: Any
) -> AECEnv[str, Observation, npt.NDArray[np.float64]]:
    """A team's task as a PettingZoo AEC environment; arguments and errors as in `parallel_env`.

    Examples:
      >>> from sme_registry import teams
      >>> team = teams.env("Team2")
      >>> team.reset(seed=0)
      >>> team.step(team.action_space("agent_0").sample())
      >>> team.agent_selection
      'agent_1'
    """
    return TurnBasedTeam(parallel_env(spec, **kwargs))


class TurnBasedTeam(OrderEnforcingWrapper):  # type: ignore[misc]
    """A team, from its parallel environment, whose agents act in turn.

    It rejects an invalid action in its agent's own turn, when it can still be corrected.
    """

    def __init__(self, parallel: Any) -> None:
        super().__init__(parallel_to_aec_wrapper(parallel))

    def _repr_html_(self) -> str:
        """The card of the parallel environment, for notebooks."""
        return cast(str, self.unwrapped._repr_html_())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.unwrapped!r})"

    __str__ = __repr__

    def step(self, action: npt.NDArray[Any] | None) -> None:
        if not self._has_reset:
            raise EpisodeError("step: the episode has not begun. Call reset() first.")
        if not self.agents:
            raise EpisodeError("step: the episode has ended. Call reset() first.")
        name = self.agent_selection
        if not (self.terminations[name] or self.truncations[name]):
            self.unwrapped.check_action(name, action)
        elif action is not None:
            raise EpisodeError(f"{name}: the episode has ended. Pass None, or call reset().")
        super().step(action)


_ONLY: Indices = np.zeros(1, np.int64)


def observed_columns(task: Task) -> tuple[npt.NDArray[np.int64], ...]:
    """For each agent, the columns of the joint observation it observes: O_i, t/T, its r_cum/k."""
    S = task.spec.state_dim
    return tuple(
        np.array([*channels, S, S + 1 + agent], np.int64)
        for agent, channels in enumerate(task.observed)
    )


class SMETeamEnv(RenderMixin, ParallelEnv[str, Observation, npt.NDArray[Any]]):  # type: ignore[misc]
    """A team in parallel: every agent acts at every step, and all end together.

    Observation of agent i: `[|O_i| + 2]` float32 in [0, 1]. Action: `[a_i]`, in [0, 1]
    (`action_range="unit"`) or [−1, 1] (`"symmetric"`), clipped. `infos[agent]` has the keys of
    `SMEEnv`, 0 at reset, that agent's own; `similarity` is always over its own channels, while
    `step_reward`, `regret` and `accumulated_reward` are those that it is paid for.

    Arguments and errors are as in `SMEEnv`.

    Examples:
      >>> from sme_registry.teams import SMETeamEnv
      >>> team = SMETeamEnv("Team2")
      >>> observations, infos = team.reset(seed=0)
      >>> actions = {agent: team.action_space(agent).sample() for agent in team.agents}
      >>> sorted(team.step(actions)[4])
      ['agent_0', 'agent_1']
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "name": "sme_v1",
        "render_modes": RENDER_MODES,
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        spec: SpecLike = "Team2-v1",
        *,
        action_range: ActionRange = "unit",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self._set_render_mode(render_mode)
        task = arguments.load_team(type(self), spec, overrides)
        self._schedule = Schedule.of(task)
        self._batch = Batch(self._schedule, 1, reuse=True)
        columns = observed_columns(task)
        self._every_column = np.concatenate(columns)
        ends = np.cumsum([len(part) for part in columns]).tolist()
        parts = (slice(*part) for part in pairwise([0, *ends]))
        self._observed_parts = list(zip(task.names, parts, strict=True))
        self.possible_agents = list(task.names)
        self.agents: list[str] = []
        self._begun = False

        self.action_spaces, self.observation_spaces = {}, {}
        for name, owned, part in zip(task.names, task.owned, columns, strict=True):
            width = owned.stop - owned.start
            self.action_spaces[name], self._rescaled = arguments.action_space(action_range, width)
            observed = gymnasium.spaces.Box(0.0, 1.0, (len(part),), np.float32)
            self.observation_spaces[name] = observed
        self._range_warning = arguments.RangeWarning(self.sme_spec, self._rescaled)
        self._allocate()
        self.state_space = gymnasium.spaces.Box(0.0, 1.0, (self.sme_spec.state_dim,), np.float64)

    def _allocate(self) -> None:
        """The joint action `[1, A]`, the values of a step, and each agent's views of both."""
        # Views of no dimension make NumPy's numbers in a third of the time of any other way.
        task, columns = self.task, self._schedule.columns
        self._joint_action = np.zeros((1, task.spec.action_dim))
        self._values = np.zeros((columns.rows, len(task.names)))
        self._more = tuple(columns.numbers)[4:]
        agents = list(enumerate(zip(task.names, task.owned, strict=True)))
        self._slots = [(name, self._joint_action[0, owned]) for _, (name, owned) in agents]
        self._numbers: list[tuple[Any, ...]] = [
            (name, owned, *(self._values[row, agent, ...] for row in columns.numbers.values()))
            for agent, (name, owned) in agents
        ]

    # The copy of a view is no view: the copy allocates both again.
    def __getstate__(self) -> dict[str, Any]:
        dropped = ("_joint_action", "_slots", "_values", "_numbers")
        return {name: value for name, value in vars(self).items() if name not in dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._allocate()

    def observation_space(self, agent: str) -> gymnasium.spaces.Box:
        """The space of an agent's observations, the same object each time."""
        return self.observation_spaces[self._checked_agent(agent)]

    def action_space(self, agent: str) -> gymnasium.spaces.Box:
        """The space of an agent's actions, the same object each time."""
        return self.action_spaces[self._checked_agent(agent)]

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of initial states, which wrappers may draw from."""
        return self._batch.initial_states.generator(0)

    def state(self) -> Array:
        """The state s, `[S]` float64 in [0, 1] (a copy), unobserved channels included."""
        return cast(Array, self._batch.state[0])

    @property
    def noise(self) -> Array:
        """ξ of each agent and ζ of the next step, `[1, n + S]`."""
        return self._batch.noise

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode; each agent's observation, and for each an info of zeros.

        `seed` and the option `state` are as in `SMEEnv.reset`. Other options are ignored, as in
        PettingZoo, except those that look like a mistyped "state".
        """
        states = None
        for name in options or {}:
            if name != "state" and did_you_mean(str(name), ["state"]):
                raise OptionError(f"options={{{name!r}: …}}: unknown option. Did you mean 'state'?")
        if options and "state" in options:
            states = arguments.initial_states(options["state"], (self.sme_spec.state_dim,))[None]
        seed = arguments.checked_seed(seed)
        if seed is not None:
            self._batch.seed(0, seed)
        observation = self._batch.observe()
        self._batch.begin(_ONLY, observation, states)
        self.agents = self.possible_agents[:]
        self._begun = True
        if self.render_mode is not None:
            self._record(self.state())
        at_reset = self._schedule.columns.at_reset
        infos = {name: at_reset(len(part)) for name, part in self._slots}
        return self._by_agent(observation), infos

    def step(
        self, actions: dict[str, npt.NDArray[Any]]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """One step of the whole team, from each agent's action `[a_i]`, finite; clipped.

        Returns observations, rewards (payouts, each in [0, k]), terminations, truncations and
        infos, each by agent; empty ones for no actions after the end, as in PettingZoo. An
        ActionError names the agent, and leaves the state unchanged.
        """
        if self._begun and not self.agents and isinstance(actions, dict) and not actions:
            return {}, {}, {}, {}, {}
        joint = self._joint(actions)
        if self._range_warning.is_due():
            self._range_warning.check(joint)
        try:
            result = self._batch.advance(joint)
        except ActionError as error:
            name = next(name for name, part in self._slots if not np.isfinite(part).all())
            raise ActionError(f"{name}: {error}") from None
        terminated, truncated = result.terminated.item(), result.truncated.item()
        if terminated or truncated:
            self.agents = []
        if self.render_mode is not None:  # as one agent's: all channels, and means over the agents
            self._record(self.state(), joint[0], self._batch.info_of(result, 0, self._rescaled))
        names = self.possible_agents
        np.copyto(self._values, result.values[:, :, 0])
        return (
            self._by_agent(result.observation),
            dict(zip(names, self._values[REWARD].tolist())),  # noqa: B905  # costs a percent
            dict.fromkeys(names, terminated),
            dict.fromkeys(names, truncated),
            self._infos(result.optimal[0].copy()),
        )

    def _infos(self, optimal: Array) -> dict[str, dict[str, Any]]:
        """Each agent's info of the last step, from its joint optimal action `[A]`."""
        optimal = arguments.from_unit(optimal, self._rescaled)
        infos: dict[str, dict[str, Any]] = {
            name: {
                "optimal_action": optimal[owned],
                "similarity": similarity[()],
                "step_reward": step_reward[()],
                "regret": regret[()],
                "accumulated_reward": accumulated_reward[()],
            }
            for name, owned, similarity, step_reward, regret, accumulated_reward, *_ in (
                self._numbers
            )
        }
        for name, _, *values in self._numbers if self._more else ():
            infos[name] |= {k: v[()] for k, v in zip(self._more, values[4:], strict=True)}
        return infos

    def _by_agent(self, observation: Observation) -> dict[str, Observation]:
        """Each agent's part of the joint observation, in fresh arrays."""
        observed = observation.take(self._every_column)  # of the only row
        return {name: observed[part] for name, part in self._observed_parts}

    def _joint(self, actions: dict[str, npt.NDArray[Any]]) -> Array:
        """The joint action `[1, A]`, float64 of the unit range."""
        if not self.agents:
            phase = "has ended" if self._begun else "has not begun"
            raise EpisodeError(f"step: the episode {phase}. Call reset() first.")
        for name, part in self._slots:
            try:
                action = actions[name]
            except (KeyError, TypeError, IndexError):
                raise self._wrong_agents(actions) from None
            # Most actions are valid arrays, and the full check costs as much as the step.
            valid = type(action) is np.ndarray and action.dtype.char in "fd"
            valid = valid and action.shape == part.shape
            part[...] = action if valid else self._checked(name, action)
        if len(actions) != len(self.possible_agents):
            raise self._wrong_agents(actions)
        return (self._joint_action + 1.0) / 2.0 if self._rescaled else self._joint_action

    def _checked(self, name: str, action: Any) -> Array:
        """One agent's action as float64, in the environment's range."""
        try:
            return arguments.to_unit(action, self.action_spaces[name].shape, rescaled=False)
        except ActionError as error:
            raise ActionError(f"{name}: {error}") from None

    def check_action(self, agent: str, action: npt.NDArray[Any]) -> None:
        """Raise what `step` would raise for this action of an agent, `[a_i]`."""
        if not np.isfinite(self._checked(self._checked_agent(agent), action)).all():
            raise ActionError(f"{agent}: {arguments.not_finite_error()}")

    def _wrong_agents(self, actions: Any) -> ActionError:
        if not isinstance(actions, dict):
            return ActionError(
                f"actions={actions!r:.60}: must be a dict from each agent's name to its action."
            )
        problem = arguments.agents_problem(actions, self.possible_agents, "action")
        return ActionError(f"actions: {problem}")

    def _checked_agent(self, agent: str) -> str:
        if agent not in self.action_spaces:
            raise OptionError(
                f"agent={agent!r}: no such agent.{did_you_mean(str(agent), self.possible_agents)} "
                f"Agents: {', '.join(self.possible_agents)}."
            )
        return agent

    def _repr_html_(self) -> str:
        status = "running" if self.agents else "ended" if self._begun else "not begun"
        first = self.possible_agents[0]
        spaces = self.observation_spaces[first], self.action_spaces[first]
        return html_card(self, *spaces, status=status)

    def __repr__(self) -> str:
        return f"SMETeamEnv({title(self.sme_spec)}, {len(self.possible_agents)} agents)"

    __str__ = __repr__


def shared_observation_dim(task: Task) -> int:
    """Entries of a shared observation, S + 2 + n."""
    return task.spec.state_dim + 2 + len(task.observed)


def shared_action_dim(task: Task) -> int:
    """Entries of a shared policy's action: as many as the agent with most channels owns."""
    return int(max(channels.stop - channels.start for channels in task.owned))


def shared_observation(task: Task, joint: Observation) -> Observation:
    """Each agent's, `[B, n, S + 2 + n]` float32, of the joint observation `[B, S + 1 + n]`."""
    S, n = task.spec.state_dim, len(task.observed)
    shared = np.empty((len(joint), n, shared_observation_dim(task)), np.float32)
    single = joint[:, : S + 2].copy()
    for agent, observed in enumerate(task.observed):
        single[:, S + 1] = joint[:, S + 1 + agent]
        shared[:, agent] = shared_observation_of(agent, n, observed, single)
    return shared


def shared_observation_of(
    agent: int, agents: int, observed: Sequence[int], single: Observation
) -> Observation:
    """One agent's, `[B, S + 2 + n]` float32, of s, t/T and its r_cum/k, `[B, S + 2]`."""
    width = single.shape[1]
    visible = [*observed, width - 2, width - 1]
    shared = np.zeros((len(single), width + agents), np.float32)
    shared[:, visible] = single[:, visible]
    shared[:, width + agent] = 1.0
    return shared

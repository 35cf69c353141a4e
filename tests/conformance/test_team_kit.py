"""The conformance kit of teams detects faults: each check fails for a team that has its fault."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, testing
from sme_registry.envs.team import SMETeamEnv
from sme_registry.testing import ConformanceError

TASK = SMESpec(
    horizon=12,
    k=5,
    team={"agents": [{"action_dim": 1, "observes": [0, 1, 2]}, {"action_dim": 3}]},
)


def stepping(change: Any) -> type[SMETeamEnv]:
    """A team whose `step` returns something else: `change(env, *returned)`."""

    class Faulty(SMETeamEnv):
        def step(self, actions: Any) -> Any:
            return change(self, *super().step(actions))

    return Faulty


def random_from_step_two(env: Any, *returned: Any) -> Any:
    if env._batch._t[0] >= 2:
        env._batch._s[:] = np.random.default_rng().random(env._batch._s.shape)
    return returned


def pays_the_other(env: Any, observations: Any, rewards: Any, *rest: Any) -> Any:
    return observations, dict(zip(rewards, reversed(rewards.values()), strict=True)), *rest


def sees_too_much(env: Any, observations: Any, *rest: Any) -> Any:
    """Shows the first agent a channel that is not its own."""
    observations[env.possible_agents[0]][2] = np.float32(env.state()[7])
    return observations, *rest


def ends_one_by_one(env: Any, *returned: Any) -> Any:
    """Tells only the first agent that time is up."""
    *rest, truncated, infos = returned
    return *rest, {**truncated, env.possible_agents[1]: False}, infos


RANDOM_FROM_STEP_TWO = stepping(random_from_step_two)


class NeedsToSeeMore(SMETeamEnv):
    """Wants of the first agent what it can only know from another's channels."""

    def step(self, actions: Any) -> Any:
        first = self.possible_agents[0]
        moved = np.asarray(actions[first]) * (0.9 + 0.1 * self.state()[7])
        return super().step({**actions, first: moved})


class Unseeded(SMETeamEnv):
    """Ignores its seed."""

    def reset(self, seed: Any = None, options: Any = None) -> Any:
        return super().reset(None, options)


class Forgets(SMETeamEnv):
    """A pickled copy has lost what was accumulated."""

    def __getstate__(self) -> Any:
        return {**self.__dict__, "_forgets": True}

    def __setstate__(self, state: Any) -> None:
        self.__dict__.update(state)
        self._batch._accumulated = np.zeros_like(self._batch._accumulated)


class Shares(SMETeamEnv):
    """Its deep copies share their state with it."""

    def __deepcopy__(self, memo: Any) -> Any:
        return self


class NewSpaces(SMETeamEnv):
    """Makes a new space each time, so that seeding one has no effect."""

    def action_space(self, agent: str) -> Any:
        space = super().action_space(agent)
        return type(space)(space.low, space.high, dtype=space.dtype)


class RewardsInTurn(SMETeamEnv):
    """In turns, a second environment would be seen: each is paid by the number of its instance."""

    instances = 0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        RewardsInTurn.instances += 1
        self.number = RewardsInTurn.instances

    def step(self, actions: Any) -> Any:
        observations, rewards, *rest = super().step(actions)
        return observations, {name: r + self.number for name, r in rewards.items()}, *rest


@functools.cache
def passes(check: Any) -> None:
    check(TASK)


@pytest.mark.parametrize(
    ("check", "faulty", "words"),
    [
        (testing.check_team_determinism, RANDOM_FROM_STEP_TWO, "two runs of one seed"),
        (testing.check_team_determinism, Unseeded, "two runs of one seed"),
        (testing.check_team_definition, RANDOM_FROM_STEP_TWO, "the next state"),
        (testing.check_team, stepping(pays_the_other), "agent_0: reward"),
        (testing.check_team_definition, stepping(sees_too_much), "agent_0: the observation"),
        (testing.check_team_definition, stepping(ends_one_by_one), "agent_1: truncated"),
        (testing.check_team_optimum, NeedsToSeeMore, "agent_0: the optimum's regret"),
        (testing.check_team_pickling, Forgets, "a pickled copy"),
        (testing.check_team_pickling, Shares, "the state, after stepping a deep copy of the team"),
        (testing.check_pettingzoo, NewSpaces, "PettingZoo's .*api_test"),
        (testing.check_turns, RewardsInTurn, "AEC"),
    ],
)
def test_a_faulty_team_is_seen(check: Any, faulty: type[SMETeamEnv], words: str) -> None:
    passes(check)
    with pytest.raises(ConformanceError, match=words):
        check(TASK, parallel=faulty)

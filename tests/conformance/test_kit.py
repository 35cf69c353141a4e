"""The conformance kit detects faults: each check fails for an environment that has its fault."""

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.task.task import ACCUMULATED_REWARD, BUFFER_VALUES
from sme_registry.teams import SMETeamEnv
from sme_registry.testing import ConformanceError, check_env, check_team

TASK = SMESpec(horizon=12, k=5, D=0.2, complexity=2)
TEAM = SMESpec(
    horizon=12,
    k=5,
    team={"agents": [{"action_dim": 1, "observes": [0, 1, 2]}, {"action_dim": 3}]},
)


def stepping(change, base=SMEEnv):
    """An environment whose `step` returns something else: `change(env, *returned)`."""

    class Faulty(base):
        def step(self, action):
            return change(self, *super().step(action))

    return Faulty


def changed_info(change):
    """An environment whose `step` has another info: `change(env, info)`."""
    return stepping(lambda env, *returned: (*returned[:4], change(env, returned[4])))


def loses_the_last_payout(env, seen, reward, *rest):
    return seen, 0.0 if rest[1] else reward, *rest


def reuses(env, info):
    """Hands out the same info arrays at each step."""
    env.__dict__.setdefault("kept", info["optimal_action"])[:] = info["optimal_action"]
    return {**info, "optimal_action": env.kept}


class Unseeded(SMEEnv):
    def reset(self, *, seed=None, options=None):
        return super().reset(options=options)


class Outside(SMEEnv):
    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        return observation + np.float32(1.0), info


class Forgets(SMEEnv):
    """Loses what it has accumulated when it is copied."""

    def __setstate__(self, state):
        super().__setstate__(state)
        self._numbers[BUFFER_VALUES + ACCUMULATED_REWARD] = 0.0


class MislaysLast(SMEVectorEnv):
    """Gives the first observation of the next episode as the last of this one."""

    def step(self, actions):
        observations, *rest = super().step(actions)
        for env in np.flatnonzero(rest[-1].get("_final_obs", [])):
            rest[-1]["final_obs"][env] = observations[env].copy()
        return observations, *rest


class CopiesLate(SMEVectorEnv):
    """A copy has lost the time of its lanes."""

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._batch._t = self._batch._t + 1


def random_from_step_two(env, *returned):
    if env._batch._t[0] >= 2:
        env._batch._s[:] = np.random.default_rng().random(env._batch._s.shape)
    return returned


def pays_the_other(env, observations, rewards, *rest):
    return observations, dict(zip(rewards, reversed(rewards.values()), strict=True)), *rest


def sees_too_much(env, observations, *rest):
    """Shows the first agent a channel that is not its own."""
    observations[env.possible_agents[0]][2] = np.float32(env.state()[7])
    return observations, *rest


class NeedsToSeeMore(SMETeamEnv):
    """Wants of the first agent what it can only know from another's channels."""

    def step(self, actions):
        first = self.possible_agents[0]
        moved = np.asarray(actions[first]) * (0.9 + 0.1 * self.state()[7])
        return super().step({**actions, first: moved})


class Shares(SMETeamEnv):
    """Its deep copies share their state with it."""

    def __deepcopy__(self, memo):
        return self


PAYS_TOO_MUCH = stepping(lambda env, seen, reward, *rest: (seen, reward * (1 + 1e-9), *rest))
PYTHON_NUMBERS = changed_info(lambda env, info: {**info, "regret": float(info["regret"])})
RANDOM_FROM_STEP_TWO = stepping(random_from_step_two, SMETeamEnv)


@pytest.mark.parametrize(
    ("place", "faulty", "words"),
    [
        ("single", PAYS_TOO_MUCH, "the reward"),
        ("single", stepping(loses_the_last_payout), "the reward"),
        ("single", changed_info(reuses), "later step reuses an array"),
        ("single", PYTHON_NUMBERS, "regret=.*must be a float64"),
        ("single", Unseeded, "two runs of one seed"),
        ("single", Forgets, "pickled copy of the single"),
        ("single", Outside, "the first observation"),
        ("vector", MislaysLast, "SameStep.*final_obs"),
        ("vector", CopiesLate, "vector"),
        ("parallel", RANDOM_FROM_STEP_TWO, "the next state"),
        ("parallel", stepping(pays_the_other, SMETeamEnv), "agent_0: the reward"),
        ("parallel", stepping(sees_too_much, SMETeamEnv), "agent_0: the observation"),
        ("parallel", NeedsToSeeMore, "agent_0: the optimum's regret|the next state"),
        ("parallel", Shares, "the state, after stepping a deep copy"),
    ],
)
def test_a_fault_is_seen(place, faulty, words):
    # That faultless environments pass is in the other files of this folder.
    check, task = (check_team, TEAM) if place == "parallel" else (check_env, TASK)
    with pytest.raises(ConformanceError, match=words):
        check(task, **{place: faulty})

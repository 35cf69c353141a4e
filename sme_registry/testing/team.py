"""Checks of a team's environment, through PettingZoo."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from pettingzoo.utils.conversions import aec_to_parallel_wrapper, parallel_to_aec
from scipy.special import ndtr

from sme_registry.envs.arguments import from_unit
from sme_registry.envs.team import SMETeamEnv
from sme_registry.spec import ACTION_RANGES, SMESpec, SpecLike
from sme_registry.task import Task, load, materialize, observe, step
from sme_registry.teams import TurnBasedTeam
from sme_registry.testing import episodes
from sme_registry.testing.comparing import (
    TOLERANCE,
    expect_equal,
    expect_near,
    expect_passes,
    expect_same,
)
from sme_registry.testing.episodes import INFO_KEYS, LONGEST_HORIZON, MAX_STEPS, Make, next_action

_UNEQUAL_AGENTS_WARNINGS = {
    "Agents have different observation space sizes",
    "Agents have different action space sizes",
    "Observations are different shapes",
}


def check_team(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """Run every check of a team.

    Args:
      task: an id, a path, a digest, a spec or its fields; without a team it is a team of one.
      parallel: creates the environment as `SMETeamEnv` does: `parallel(spec, action_range=…)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first check that fails.

    Examples:
      >>> from sme_registry.testing import check_team
      >>> check_team(sme_registry.load("Team2").derive(horizon=5))
    """
    check_pettingzoo(task, parallel=parallel)
    for check in (
        check_team_definition,
        check_team_optimum,
        check_team_determinism,
        check_team_pickling,
        check_turns,
    ):
        check(task, parallel=parallel, seed=seed)


def check_pettingzoo(task: SpecLike, *, parallel: Make = SMETeamEnv) -> None:
    """PettingZoo's tests of API, seed and state pass without warnings, parallel and AEC.

    Its warnings that agents' spaces differ in size are ignored if they do differ.

    Examples:
      >>> from sme_registry.testing import check_pettingzoo
      >>> check_pettingzoo(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    definition = materialize(spec)
    widths = {owned.stop - owned.start for owned in definition.owned}
    unequal = len(widths) > 1 or len({len(channels) for channels in definition.observed}) > 1
    ignored = _UNEQUAL_AGENTS_WARNINGS if unequal else set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # importing it raises a deprecation warning of its own
        from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
        from pettingzoo.test.state_test import state_test
    for action_range in ACTION_RANGES:
        make = functools.partial(parallel, spec, action_range=action_range)

        def make_aec(make: Make = make) -> Any:
            return TurnBasedTeam(make())

        tests: dict[str, Callable[[], Any]] = {
            "parallel_api_test": functools.partial(parallel_api_test, make(), num_cycles=MAX_STEPS),
            "api_test": functools.partial(api_test, make_aec(), num_cycles=MAX_STEPS),
            "parallel_seed_test": functools.partial(parallel_seed_test, make),
            "seed_test": functools.partial(seed_test, make_aec),
            "state_test": functools.partial(state_test, make_aec(), make()),
        }
        for name, test in tests.items():
            expect_passes(f"PettingZoo's {name}, {action_range}", test, ignored)


def check_team_definition(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """Each step equals `sme_registry.task.step` for each agent, which observes only its channels.

    States and ends are compared bit for bit, optimal actions and rewards to 1e-12.

    Examples:
      >>> from sme_registry.testing import check_team_definition
      >>> check_team_definition(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    definition, rng = materialize(spec), np.random.default_rng(seed)
    for action_range in ACTION_RANGES:
        symmetric = action_range == "symmetric"
        env = parallel(spec, action_range=action_range)
        observations, infos = env.reset(seed=seed)
        expect_equal("the agents", tuple(env.agents), definition.names)
        expect_equal("the agents of infos at reset", tuple(infos), definition.names)
        for name, owned in zip(definition.names, definition.owned, strict=True):
            width = owned.stop - owned.start
            episodes.expect_info_of_reset(f"{name}: info at reset", infos[name], width)
        s, r_cum = env.state()[None], np.zeros((1, len(definition.names)))
        _check_observations(definition, observations, s, 0, r_cum)
        for t in range(min(spec.horizon, MAX_STEPS)):
            actions = next_action(env, rng)
            joint = np.concatenate([actions[name] for name in definition.names]).astype(np.float64)
            joint = (joint + 1.0) / 2.0 if symmetric else joint
            done = step(definition, s, np.array([t]), r_cum, joint[None])
            observations, rewards, terminated, truncated, infos = env.step(actions)
            expect_equal("the next state", env.state(), done.state[0])
            optimal = from_unit(done.optimal_action[0], symmetric)
            for agent, (name, owned) in enumerate(
                zip(definition.names, definition.owned, strict=True)
            ):
                _check_agent(name, agent, done, optimal[owned], infos[name], rewards[name], spec.k)
                expect_equal(f"{name}: terminated", terminated[name], bool(done.terminated[0]))
                expect_equal(f"{name}: truncated", truncated[name], bool(done.truncated[0]))
            s = done.state
            r_cum = np.array([[infos[name]["accumulated_reward"] for name in definition.names]])
            _check_observations(definition, observations, s, t + 1, r_cum)
            if done.terminated[0] or done.truncated[0]:
                expect_equal("the agents, once the episode has ended", list(env.agents), [])
                break


def _check_agent(
    name: str, agent: int, done: Any, optimal: Any, info: dict[str, Any], reward: float, k: int
) -> None:
    """One agent's reward and info equal those of the definition's step."""
    expect_equal(f"{name}: info's keys", set(info), INFO_KEYS)
    expect_near(f"{name}: optimal_action", info["optimal_action"], optimal)
    for key in ("similarity", "step_reward"):
        expect_near(f"{name}: {key}", info[key], getattr(done, key)[0, agent])
    expect_equal(f"{name}: regret", info["regret"], 1.0 - info["step_reward"])
    for key, got in (("reward", reward), ("accumulated_reward", info["accumulated_reward"])):
        expect_near(f"{name}: {key}", got, getattr(done, key)[0, agent], k * TOLERANCE)


def check_team_optimum(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """An agent that acts by its own layers on only what it observes has return T.

    Examples:
      >>> from sme_registry.testing import check_team_optimum
      >>> check_team_optimum(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    definition = materialize(spec)

    def act(s: Any) -> Any:
        joint = []
        for channels, layers in zip(definition.observed, definition.policies, strict=True):
            x = s[list(channels)]
            for W, b in layers:
                x = ndtr(W @ x + b)
            joint.append(x)
        return np.concatenate(joint)

    spec = spec.derive(horizon=min(spec.horizon, LONGEST_HORIZON))
    for action_range in ACTION_RANGES:
        env = parallel(spec, action_range=action_range)
        episodes.expect_optimum(env, act, spec.horizon, seed)


def check_team_determinism(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """A seed fixes whole consecutive episodes; PettingZoo's own tests compare only one step.

    Examples:
      >>> from sme_registry.testing import check_team_determinism
      >>> check_team_determinism(sme_registry.load("Team2").derive(horizon=5))
    """
    episodes.expect_determinism(functools.partial(parallel, load(task, SMESpec)), seed)


def check_team_pickling(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does.

    Examples:
      >>> from sme_registry.testing import check_team_pickling
      >>> check_team_pickling(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    episodes.expect_same_copies("team", parallel(spec), spec.horizon, seed)


def check_turns(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """PettingZoo's conversions to AEC and back keep every number of a whole episode.

    Examples:
      >>> from sme_registry.testing import check_turns
      >>> check_turns(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    make = functools.partial(parallel, spec)
    direct = episodes.play(make(), seed, seed)
    # Not `aec_to_parallel`, which would return the original environment.
    converted: Any = aec_to_parallel_wrapper(parallel_to_aec(make()))
    converted.task = materialize(spec)
    expect_same("parallel, AEC and back", episodes.play(converted, seed, seed), direct)

    env, aec = make(), parallel_to_aec(make())
    observations, infos = env.reset(seed=seed)
    aec.reset(seed=seed)
    rng = np.random.default_rng(seed)
    rewards = dict.fromkeys(env.agents, 0.0)
    terminated = truncated = dict.fromkeys(env.agents, False)
    playing = True
    while playing:
        playing = bool(env.agents)
        actions = next_action(env, rng) if playing else dict.fromkeys(env.possible_agents)
        for agent in actions:
            name = aec.agent_selection
            if playing:  # after the end, they follow in the order of their names
                expect_equal("the agent to act", name, agent)
            expect_same(f"{name} in an AEC environment", list(aec.last()), [
                observations[name], rewards[name], terminated[name], truncated[name], infos[name]
            ])  # fmt: skip
            aec.step(actions[name])
        if playing:
            observations, rewards, terminated, truncated, infos = env.step(actions)


def _check_observations(definition: Task, got: dict[str, Any], s: Any, t: int, r_cum: Any) -> None:
    """Each agent observes only its state channels, t/T and its own r_cum/k."""
    spec = definition.spec
    joint = observe(spec, s, np.array([t]), r_cum)[0]
    for agent, (name, channels) in enumerate(
        zip(definition.names, definition.observed, strict=True)
    ):
        columns = [*channels, spec.state_dim, spec.state_dim + 1 + agent]
        expect_equal(f"{name}: the observation", got[name], joint[columns])

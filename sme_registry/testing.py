"""What every SME environment guarantees, as checks of classes of your own.

    from sme_registry.testing import check_env, check_stream, check_team
    check_env("SME/Default-v1", single=YourEnv)       # or any spec; and vector=YourVectorEnv
    check_stream("SME/Switch5-v1", single=YourEnv)    # the same for streams
    check_team("SME/Team4-v1", parallel=YourTeam)     # the same for teams, through PettingZoo

A check raises `ConformanceError` with the expected and the actual value. It plays whole episodes
with actions between optimal and random ones, so that some end early if D > 0. Gymnasium's
`check_env` and PettingZoo's `parallel_api_test` test what these leave out.
"""

from __future__ import annotations

import copy
import functools
import itertools
import pickle
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.envs.arguments import from_unit
from sme_registry.envs.schedule import Columns, Schedule
from sme_registry.envs.team import SMETeamEnv, observed_columns
from sme_registry.spec import ACTION_RANGES, SMESpec, SpecLike, StreamLike, StreamSpec
from sme_registry.task import (
    Step,
    Task,
    load,
    materialize,
    materialize_segments,
    observe,
    step,
)

__all__ = ["ConformanceError", "check_env", "check_stream", "check_team"]

TOLERANCE = 1e-12  # of optimal actions and rewards between back-ends; states are equal bit for bit
_FLOAT32_ROUNDING = 2e-7  # of what an agent sees through a mixing, in [0, 1]
_MAX_STEPS = 250  # of one episode: horizons may be long
_LONGEST_HORIZON = 10_000  # that the optimal policy is followed to
_LONGEST_LIFE = 1000  # steps of a stream

Make = Callable[..., Any]  # creates an environment, as the classes of `sme_registry.envs` do


class ConformanceError(AssertionError):
    """An environment violates a guarantee of SME environments.

    Examples:
      >>> from sme_registry.envs import SMEEnv
      >>> from sme_registry.testing import check_env
      >>> class Frozen(SMEEnv):
      ...     def step(self, action):
      ...         return super().step(0 * action)
      >>> check_env(sme_registry.SMESpec(horizon=5), single=Frozen)
      Traceback (most recent call last):
      ...
      sme_registry.testing.ConformanceError: ...
    """


def check_env(
    task: SpecLike, *, single: Make = SMEEnv, vector: Make = SMEVectorEnv, seed: int = 0
) -> None:
    """Check the environments of a single agent's task.

    Each step equals the definition `sme_registry.task.step`: states bit for bit, optimal actions,
    rewards, limits and costs to 1e-12. `info` has its keys, types and ranges, and no array is used
    twice. The optimal policy has return T without regret. A seed fixes consecutive episodes. Copies
    go on as the original does. A batch equals single environments bit for bit in all three
    autoreset modes.

    Args:
      task: an id, a path, a digest, a spec or its fields.
      single: creates the environment as `SMEEnv` does: `single(spec, action_range=…)`.
      vector: creates the batch as `SMEVectorEnv` does: `vector(spec, num_envs, …)`.
      seed: of the episodes and the actions.

    Examples:
      >>> from sme_registry.testing import check_env
      >>> check_env(sme_registry.SMESpec(horizon=5))
    """
    spec = load(task, SMESpec)
    definition = materialize(spec)
    _check_environments(Schedule.of(definition), single, vector, seed)
    shorter = spec.derive(horizon=min(spec.horizon, _LONGEST_HORIZON))
    for action_range in ACTION_RANGES:
        env = single(shorter, action_range=action_range)
        _check_optimum(env, definition.optimal_action, shorter.horizon, seed)


def check_stream(
    stream: StreamLike, *, single: Make = SMEEnv, vector: Make = SMEVectorEnv, seed: int = 0
) -> None:
    """Check the environments of a stream; see `check_env`, for the task in force in each step.

    Tasks change when METHOD, section 7, says. Lives are played up to 1,000 steps: check a short
    stream.

    Examples:
      >>> from sme_registry.testing import check_stream
      >>> task = sme_registry.SMESpec(horizon=5)
      >>> phases = [dict(spec=task, steps=10), dict(spec=task.derive(k=5), steps=10)]
      >>> check_stream(sme_registry.StreamSpec(phases=phases))
    """
    stream = load(stream, StreamSpec)
    _check_environments(Schedule(stream, materialize_segments(stream)), single, vector, seed)


def check_team(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """Check the PettingZoo environment of a team; see `check_env`, for each agent.

    An agent observes only its channels, and acting by its own layers on them has return T. A task
    without a team is a team of one. `parallel` creates the environment as `SMETeamEnv` does.

    Examples:
      >>> from sme_registry.testing import check_team
      >>> check_team(sme_registry.load("Team2").derive(horizon=5))
    """
    spec = load(task, SMESpec)
    definition = materialize(spec)
    shorter = spec.derive(horizon=min(spec.horizon, _LONGEST_HORIZON))

    def act(s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Each agent's layers, over a state of which the others' channels are unknown."""
        joint = []
        for agent, (channels, owned) in enumerate(
            zip(definition.observed, definition.owned, strict=True)
        ):
            known = np.where(np.isin(np.arange(spec.state_dim), channels), s, agent / 7.0)
            joint.append(definition.optimal_action(known)[owned])
        return np.concatenate(joint)

    for action_range in ACTION_RANGES:
        _check_team_steps(parallel(spec, action_range=action_range), definition, seed)
        _check_optimum(parallel(shorter, action_range=action_range), act, shorter.horizon, seed)
    _check_determinism(functools.partial(parallel, spec), seed)
    _check_copies("team", parallel(spec), spec.horizon, seed)


def _check_environments(schedule: Schedule, single: Make, vector: Make, seed: int) -> None:
    document = schedule.document
    for action_range in ACTION_RANGES:
        for life in range(2):
            env = single(document, action_range=action_range)
            _check_life(env, schedule, seed + life)
    _check_determinism(functools.partial(single, document), seed)
    _check_copies("single environment", single(document), document.horizon, seed)
    batch = vector(document, 3, autoreset_mode=AutoresetMode.NEXT_STEP.value)
    _check_copies("vector environment", batch, document.horizon, seed)
    _check_vector(schedule, single, vector, seed)


def _check_life(env: Any, schedule: Schedule, seed: int) -> None:
    """Every step of a life equals `task.step` of the segment's task; a task has such a life, too.

    `info` is flat and numeric, with the documented keys and ranges, and new at each step.
    """
    rng, steps = np.random.default_rng(seed), _steps(schedule)
    lifetime, episode_seed = 0, cast("int | None", seed)
    written: list[npt.NDArray[Any]] = []
    while lifetime < steps:
        segment = schedule.segment(lifetime)
        observation, info = env.reset(seed=episode_seed)
        episode_seed = None
        expect_same("info at reset", info, _info_at_reset(schedule, segment, lifetime))
        s, r_cum, t, ended = env.state[None], np.zeros((1, 1)), 0, False
        _check_observation("the first observation", schedule, segment, env, observation, t, r_cum)
        while not ended and (schedule.is_stream or lifetime < steps):
            task, d = schedule.tasks[segment], env.distractors
            action = next_action(env, rng)
            unit = _as_unit(env, action)
            result = step(task, s, np.array([t]), r_cum, unit[None])
            observation, reward, terminated, truncated, info = env.step(action)
            lifetime, t, ended = lifetime + 1, t + 1, terminated or truncated
            _check_info(info, schedule, segment, lifetime, env)
            _check_step(result, 0, _is_symmetric(env), info, reward, task.spec)
            _check_limits(task, s[0], unit, info, _is_symmetric(env))
            expect_equal("terminated", terminated, bool(result.terminated[0]))
            expect_equal("truncated", truncated, bool(result.truncated[0]))
            expect_equal("the next state", env.state, result.state[0])
            if task.spec.dynamics == "driven":
                expect_equal("distractors", env.distractors, task.distractor_step(d, unit))
            if schedule.switches_within:
                segment = schedule.segment(lifetime)
            s, r_cum = result.state, np.array([[info["accumulated_reward"]]])
            expect_equal("the task in force", env.sme_spec, schedule.tasks[segment].spec)
            _check_observation("the observation", schedule, segment, env, observation, t, r_cum)
            arrays = [observation, *(info[key] for key in schedule.columns.actions)]
            if any(np.shares_memory(*pair) for pair in itertools.product(arrays, written[-9:])):
                raise ConformanceError("A later step reuses an array that `step` returned.")
            for array in arrays:
                array[:] = -7.0  # what was returned is the user's
            written += arrays


def _steps(schedule: Schedule) -> int:
    """How many steps of a life are played."""
    document = schedule.document
    if isinstance(document, StreamSpec):
        return min(document.steps + document.horizon, _LONGEST_LIFE)
    return _MAX_STEPS


def _info_at_reset(schedule: Schedule, segment: int, lifetime: int) -> dict[str, Any]:
    at_reset = schedule.columns.at_reset(schedule.document.action_dim)
    return at_reset | _life(schedule, segment, lifetime)


def _life(schedule: Schedule, segment: int, lifetime: int) -> dict[str, Any]:
    return schedule.life(np.int64(schedule.phases[segment]), np.int64(lifetime))


def _check_info(
    info: dict[str, Any], schedule: Schedule, segment: int, lifetime: int, env: Any
) -> None:
    """The keys, types and ranges of a step's info, and where it is in a life."""
    spec, life = schedule.tasks[segment].spec, _life(schedule, segment, lifetime)
    _, numbers, arrays = schedule.columns
    expect_equal("info's keys", set(info), {*numbers, *arrays, *life})
    for key, value in life.items():
        expect_same(key, info[key], value)
    for key in arrays:
        value = info[key]
        if not (isinstance(value, np.ndarray) and value.dtype == np.float64):
            raise ConformanceError(f"{key}: must be float64, got {value!r:.80}.")
        expect_equal(f"{key}'s shape", value.shape, (spec.action_dim,))
        if not ((value >= env.action_space.low) & (value <= 1.0)).all():
            raise ConformanceError(f"{key}={value}: outside the action range.")
    for key in numbers:
        bottom = -1.0 if key == "safe_regret" else 0.0
        top = np.inf if key == "accumulated_reward" else 1.0
        if not (isinstance(info[key], np.float64) and bottom <= info[key] <= top):
            raise ConformanceError(f"{key}={info[key]!r}: must be a float64 in [{bottom}, {top}].")


def _check_step(
    result: Step, agent: int, symmetric: bool, info: dict[str, Any], reward: float, spec: SMESpec
) -> None:
    """One agent's reward and numbers equal those of the definition's step."""
    owned = materialize(spec).owned[agent]
    name = "" if spec.team is None else f"{materialize(spec).names[agent]}: "
    optimal = from_unit(result.optimal_action[0, owned], symmetric)
    expect_near(f"{name}optimal_action", info["optimal_action"], optimal)
    for key in ("similarity", "step_reward"):
        expect_near(f"{name}{key}", info[key], getattr(result, key)[0, agent])
    expect_equal(f"{name}regret", info["regret"], 1.0 - info["step_reward"])
    for key, got in (("reward", reward), ("accumulated_reward", info["accumulated_reward"])):
        tolerance = spec.horizon * TOLERANCE
        expect_near(f"{name}the {key}", got, getattr(result, key)[0, agent], tolerance)


def _check_limits(task: Task, s: Any, action: Any, info: dict[str, Any], symmetric: bool) -> None:
    """Limits, the safe action, cost and safe regret, where the task has `safety`."""
    if task.spec.safety is None:
        return
    scale = TOLERANCE / min(1.0, task.spec.safety.tightness)
    expect_near("limit", info["limit"], from_unit(task.limit(s), symmetric))
    expect_near("safe_action", info["safe_action"], from_unit(task.safe_action(s), symmetric))
    expect_near("cost", info["cost"], task.cost(s, action), scale)
    safe_reward = task.safe_reward_of(task.optimal_action(s), task.limit(s))
    expect_near("safe_regret", info["safe_regret"], safe_reward - info["step_reward"], 1e-11)


def _check_observation(
    what: str, schedule: Schedule, segment: int, env: Any, observation: Any, t: int, r_cum: Any
) -> None:
    """The agent sees M(s, d), t/T, r_cum/k, and the one-hot of the phase where it is shown."""
    task, d = schedule.tasks[segment], env.distractors
    expect_equal("the shape of the distractors", d.shape, (task.spec.distractors,))
    if not ((d >= 0.0) & (d <= 1.0)).all():
        raise ConformanceError(f"distractors={d}: outside [0, 1].")
    plain = observe(task.spec, env.state[None], np.array([t]), r_cum)[0, task.spec.state_dim :]
    shown = schedule.one_hot(int(schedule.phases[segment]))
    parts = [task.seen(env.state, d).astype(np.float32), plain, shown]
    if task.mixing:
        expect_equal(f"{what}: its shape", observation.shape, np.concatenate(parts).shape)
        expect_near(what, observation, np.concatenate(parts), _FLOAT32_ROUNDING)
    else:
        expect_equal(what, observation, np.concatenate(parts))


def _check_team_steps(env: Any, task: Task, seed: int) -> None:
    """Each step equals `task.step` for each agent, which observes only its own channels."""
    rng, spec = np.random.default_rng(seed), task.spec
    symmetric = bool(env.action_space(task.names[0]).low[0] < 0.0)
    agents = list(zip(task.names, task.owned, observed_columns(task), strict=True))
    observations, info = env.reset(seed=seed)
    expect_equal("the agents", tuple(env.agents), task.names)
    expect_equal("the agents of infos at reset", tuple(info), task.names)
    for name, owned, _ in agents:
        expected = Columns.of(spec).at_reset(owned.stop - owned.start)
        expect_same(f"{name}: info at reset", info[name], expected)
    s, r_cum, ended = env.state()[None], np.zeros((1, len(agents))), False
    for t in range(min(spec.horizon, _MAX_STEPS) + 1):
        joint = observe(spec, s, np.array([t]), r_cum)[0]
        for name, _, columns in agents:
            expect_equal(f"{name}: the observation", observations[name], joint[columns])
        if ended or t == _MAX_STEPS:
            break
        actions = next_action(env, rng)
        result = step(task, s, np.array([t]), r_cum, _as_unit(env, actions)[None])
        observations, rewards, terminated, truncated, info = env.step(actions)
        expect_equal("the next state", env.state(), result.state[0])
        for agent, (name, _, _) in enumerate(agents):
            keys = Columns.of(spec).at_reset(1).keys()
            expect_equal(f"{name}: info's keys", info[name].keys(), keys)
            _check_step(result, agent, symmetric, info[name], rewards[name], spec)
            expect_equal(f"{name}: terminated", terminated[name], bool(result.terminated[0]))
            expect_equal(f"{name}: truncated", truncated[name], bool(result.truncated[0]))
        ended = bool(result.terminated[0] or result.truncated[0])
        s = result.state
        r_cum = np.array([[info[name]["accumulated_reward"] for name, _, _ in agents]])
    expect_equal("the agents, once the episode has ended", list(env.agents) == [], ended)


def _check_optimum(env: Any, act: Callable[[Any], Any], horizon: int, seed: int) -> None:
    """A policy from states to joint actions reaches the horizon T without regret, with return T."""
    env.reset(seed=seed)
    returns: dict[str, float] = {}
    steps, ended = 0, False
    while not ended:
        returned = env.step(_as_action(env, act(_state(env))))
        steps, ended = steps + 1, has_ended(returned)
        _, rewards, _, _, info = returned
        if not _is_team(env):
            rewards, info = {"": rewards}, {"": info}
        for name, reward in rewards.items():
            agent = name and f"{name}: "
            expect_near(f"{agent}the optimum's regret", info[name]["regret"], 0.0, 1e-9)
            returns[agent] = returns.get(agent, 0.0) + float(reward)
    expect_equal("the optimum's steps", steps, horizon)
    for agent, total in returns.items():
        expect_near(f"{agent}the optimum's return", total, horizon, 1e-9 * horizon)


def _check_determinism(make: Callable[[], Any], seed: int) -> None:
    """A seed fixes the episode and the following one; another seed gives another episode."""
    first, second, other = (play(make(), start, seed) for start in (seed, seed, seed + 1))
    expect_same("two runs of one seed", first, second)
    if all(map(np.array_equal, *(_values(played[0]) for played in (first, other)))):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} start at the same observation.")


def _check_copies(kind: str, env: Any, horizon: int, seed: int) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does."""
    env.reset(seed=seed)
    if horizon > 1:
        env.step(_as_action(env, _optimal(env)))
    before = np.copy(_state(env))
    copies = {"a pickled copy": pickle.loads(pickle.dumps(env)), "a deep copy": copy.deepcopy(env)}
    played = {}
    for how, twin in copies.items():
        played[how] = play(twin, None, seed, in_progress=True)
        expect_equal(f"the state, after stepping {how} of the {kind}", _state(env), before)
    original = play(env, None, seed, in_progress=True)
    for how, returned in played.items():
        expect_same(f"{how} of the {kind}", returned, original)


def _check_vector(schedule: Schedule, single: Make, vector: Make, seed: int) -> None:
    """A batch equals what Gymnasium's `SyncVectorEnv` of single environments returns."""
    document, num_envs = schedule.document, 3
    steps = _steps(schedule) if schedule.is_stream else min(document.horizon + 5, _MAX_STEPS)
    for mode, action_range in itertools.product(AutoresetMode, ACTION_RANGES):
        batch = vector(document, num_envs, action_range=action_range, autoreset_mode=mode.value)
        make = functools.partial(single, document, action_range=action_range)
        singles: Any = SyncVectorEnv([make] * num_envs, autoreset_mode=mode)
        rng = np.random.default_rng(seed)
        where = f"autoreset mode {mode.value}, {action_range}"
        expect_same(f"{where}: reset", batch.reset(seed=seed), singles.reset(seed=seed))
        for t in range(1, steps + 1):
            action = next_action(batch, rng)
            returned = batch.step(action)
            expect_same(f"{where}: step {t}", returned, singles.step(action))
            ended = returned[2] | returned[3]
            if mode is AutoresetMode.DISABLED and ended.any():
                # Each is passed its own dictionary, since Gymnasium removes the mask from it.
                first, second = (
                    envs.reset(options={"reset_mask": ended}) for envs in (batch, singles)
                )
                expect_same(f"{where}: reset after step {t}", first, second)


def play(env: Any, reset_seed: int | None, seed: int, *, in_progress: bool = False) -> list[Any]:
    """Everything that two whole episodes return; the second continues the environment's stream.

    With `in_progress`, the first is the current episode, played to its end.
    """
    rng = np.random.default_rng(seed)
    returned: list[Any] = []
    for episode_seed in (reset_seed, None):
        if not in_progress:
            returned += env.reset(seed=episode_seed)
        in_progress = False
        for _ in range(_MAX_STEPS):
            one_step = env.step(next_action(env, rng))
            returned += [*one_step, _state(env)]
            if has_ended(one_step):
                break
    return returned


def has_ended(returned: Any) -> bool:
    """Whether a step ended the episode, a team's if for all agents; a batch goes on."""
    terminated, truncated = returned[2:4]
    if isinstance(terminated, dict):
        return all(terminated[name] or truncated[name] for name in terminated)
    return not isinstance(terminated, np.ndarray) and bool(terminated or truncated)


def mixed_actions(optimal: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Actions of the unit range between optimal and random ones, some slightly outside of it."""
    shape = optimal.shape
    share = rng.uniform(0.0, 0.5, (*shape[:-1], 1))
    mixed: npt.NDArray[np.float64] = (1 - share) * optimal + share * rng.uniform(-0.1, 1.1, shape)
    return mixed.astype(np.float32)


def next_action(env: Any, rng: np.random.Generator) -> Any:
    """`mixed_actions` in the current state, in the form that the environment's `step` takes."""
    return _as_action(env, mixed_actions(_optimal(env), rng))


def _as_action(env: Any, unit: npt.NDArray[Any]) -> Any:
    """Joint actions of the unit range in the environment's range, for a team by agent."""
    joint = from_unit(unit, _is_symmetric(env))
    if not _is_team(env):
        return joint
    return {name: joint[owned] for name, owned in zip(env.task.names, env.task.owned, strict=True)}


def _as_unit(env: Any, action: Any) -> npt.NDArray[np.float64]:
    """The other way round, as an environment rescales its actions."""
    joint = np.concatenate([action[name] for name in env.task.names]) if _is_team(env) else action
    unit = joint.astype(np.float64)
    return (unit + 1.0) / 2.0 if _is_symmetric(env) else unit


def _is_symmetric(env: Any) -> bool:
    space = env.action_space(env.task.names[0]) if _is_team(env) else env.action_space
    return bool(space.low.flat[0] < 0.0)


def _is_team(env: Any) -> bool:
    return hasattr(env, "possible_agents")


def _optimal(env: Any) -> npt.NDArray[np.float64]:
    """π* in the current state; in a batch, of the task in force in each environment."""
    if hasattr(env, "num_envs"):
        pairs = zip(env.get_attr("task"), env.state, strict=True)
        return np.stack([task.optimal_action(s) for task, s in pairs])
    optimal: npt.NDArray[np.float64] = env.task.optimal_action(_state(env))
    return optimal


def _state(env: Any) -> npt.NDArray[np.float64]:
    return env.state() if _is_team(env) else env.state  # type: ignore[no-any-return]


def _values(observation: Any) -> Sequence[Any]:
    return list(observation.values()) if isinstance(observation, dict) else [observation]


def expect_equal(what: str, got: Any, expected: Any) -> None:
    """Check that two values are equal, arrays in every entry; NaN equals NaN."""
    if isinstance(got, np.ndarray | np.generic):
        same = np.array_equal(got, expected, equal_nan=True)
    else:
        same = got == expected
    if not same:
        raise ConformanceError(f"{what}: expected {expected!r:.200}, got {got!r:.200}.")


def expect_near(what: str, got: Any, expected: Any, tolerance: float = TOLERANCE) -> None:
    """Check that numbers differ by at most a tolerance."""
    difference = float(np.max(np.abs(np.asarray(got) - np.asarray(expected))))
    if not difference <= tolerance:
        raise ConformanceError(
            f"{what}: expected {expected!r:.200} to {tolerance:.0e}, got {got!r:.200}."
        )


def expect_same(what: str, got: Any, expected: Any) -> None:
    """Check equality in every bit, type and key; NaN equals NaN."""
    if isinstance(got, dict) and isinstance(expected, dict):
        expect_equal(f"{what}: the keys", sorted(got), sorted(expected))
        for key in got:
            expect_same(f"{what}: {key}", got[key], expected[key])
    elif isinstance(got, list | tuple) and isinstance(expected, list | tuple):
        expect_equal(f"{what}: the number of values", len(got), len(expected))
        for ours, theirs in zip(got, expected, strict=True):
            expect_same(what, ours, theirs)
    elif isinstance(got, np.ndarray) and got.dtype == object:
        expect_same(what, list(got), list(expected))
    elif isinstance(got, np.ndarray | np.generic):
        expect_equal(f"{what}: type", type(got), type(expected))
        expect_equal(f"{what}: dtype", got.dtype, expected.dtype)
        expect_equal(what, got, expected)
    else:
        expect_equal(what, got, expected)

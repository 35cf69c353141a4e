"""Checks of a single agent's environment and of its batch."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.registration import env_spec
from sme_registry.spec import ACTION_RANGES, SMESpec, SpecLike, StreamLike, StreamSpec
from sme_registry.task import Task, load, materialize
from sme_registry.testing import episodes
from sme_registry.testing.comparing import (
    TOLERANCE,
    ConformanceError,
    expect_equal,
    expect_near,
    expect_passes,
    expect_same,
)
from sme_registry.testing.episodes import (
    ACTION_KEYS,
    LONGEST_HORIZON,
    LONGEST_LIFE,
    MAX_STEPS,
    Make,
    info_keys,
    next_action,
)

_FLOAT32_ROUNDING = 2e-7  # of what an agent sees, in [0, 1]


def check_sme(
    task: SpecLike, *, single: Make = SMEEnv, vector: Make = SMEVectorEnv, seed: int = 0
) -> None:
    """Run every check of a single agent's task.

    Args:
      task: an id, a path, a digest, a spec or its fields.
      single: creates the environment as `SMEEnv` does: `single(spec, action_range=…)`.
      vector: creates the batch as `SMEVectorEnv` does: `vector(spec, num_envs, …)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first check that fails.

    Examples:
      >>> from sme_registry.testing import check_sme
      >>> check_sme(sme_registry.SMESpec(horizon=5))
    """
    check_gymnasium(task, single=single)
    for check in (check_info, check_definition, check_optimum, check_determinism):
        check(task, single=single, seed=seed)
    check_pickling(task, single=single, vector=vector, seed=seed)
    check_vector(task, single=single, vector=vector, seed=seed)
    check_env_spec(task)


def check_gymnasium(task: SpecLike | StreamLike, *, single: Make = SMEEnv) -> None:
    """Gymnasium's own `check_env` passes without warnings in both action ranges.

    It treats an episode of one step as an error, so tasks of horizon 1 are skipped.

    Examples:
      >>> from sme_registry.testing import check_gymnasium
      >>> check_gymnasium(sme_registry.SMESpec(horizon=5))
    """
    document = load(task)
    if document.horizon == 1:
        return
    for action_range in ACTION_RANGES:
        make = functools.partial(single, document, action_range=action_range)
        test = functools.partial(_create_and_check, make)
        expect_passes(f"Gymnasium's check_env, {action_range}", test)


def _create_and_check(make: Make) -> None:
    check_env(make(), skip_render_check=True)  # without an EnvSpec it cannot test render modes


def check_info(task: SpecLike, *, single: Make = SMEEnv, seed: int = 0) -> None:
    """`info` is flat and numeric, has the documented keys and ranges, and is new at each step.

    At reset it has the same keys, with NaN of the same type.

    Examples:
      >>> from sme_registry.testing import check_info
      >>> check_info(sme_registry.SMESpec(horizon=5))
    """
    spec = load(task, SMESpec)
    for action_range in ACTION_RANGES:
        env, untouched = (single(spec, action_range=action_range) for _ in range(2))
        for each in (env, untouched):
            reset_info = each.reset(seed=seed)[1]
            keys = info_keys(spec)
            episodes.expect_info_of_reset("info at reset", reset_info, spec.action_dim, keys)
        rng = np.random.default_rng(seed)
        overwritten: list[npt.NDArray[Any]] = []
        for _ in range(min(spec.horizon, 5)):
            action = next_action(env, rng)
            (observation, *_, info), expected = env.step(action), untouched.step(action)
            _check_info_entries(info, spec, env.action_space.low)
            arrays = sorted(ACTION_KEYS & keys)
            returned = {"observation": observation, **{key: info[key] for key in arrays}}
            original = {"observation": expected[0], **expected[-1]}
            before = np.copy(env.state)
            for name, array in returned.items():
                expect_equal(f"{name}, after writing into an earlier one", array, original[name])
                if any(np.shares_memory(array, earlier) for earlier in overwritten):
                    raise ConformanceError("A later step reuses an array that `step` returned.")
                array[:] = -7.0
                overwritten.append(array)
            expect_equal("the state, after writing into what `step` returned", env.state, before)
            if episodes.has_ended(expected):
                break


def _check_info_entries(info: dict[str, Any], spec: SMESpec, low: npt.NDArray[Any]) -> None:
    keys = info_keys(spec)
    expect_equal("info's keys", set(info), keys)
    for key in sorted(ACTION_KEYS & keys):
        value = info[key]
        if not (isinstance(value, np.ndarray) and value.dtype == np.float64):
            raise ConformanceError(f"{key}: must be float64, got {value!r:.80}.")
        expect_equal(f"{key}'s shape", value.shape, (spec.action_dim,))
        if not ((value >= low) & (value <= 1.0)).all():
            raise ConformanceError(f"{key}={value}: outside the action range.")
    for key in sorted(keys - ACTION_KEYS):
        bottom = -1.0 if key == "safe_regret" else 0.0
        top = spec.k if key == "accumulated_reward" else 1.0
        if not (isinstance(info[key], np.float64) and bottom <= info[key] <= top):
            raise ConformanceError(f"{key}={info[key]!r}: must be a float64 in [{bottom}, {top}].")


def check_definition(task: SpecLike, *, single: Make = SMEEnv, seed: int = 0) -> None:
    """Each step equals that of the spec's `Task`, and rewards are paid as METHOD defines.

    States are compared bit for bit, optimal actions, rewards, limits and costs to 1e-12, and what
    the agent sees of a mixing to the rounding of float32. Distractors stay in [0, 1]; driven ones
    move by their own transition.

    Examples:
      >>> from sme_registry.testing import check_definition
      >>> check_definition(sme_registry.SMESpec(horizon=5))
    """
    spec = load(task, SMESpec)
    definition, rng = materialize(spec), np.random.default_rng(seed)
    for episode in range(3):
        env = single(spec)
        observation, _ = env.reset(seed=seed + episode)
        s, accumulated, tolerance = env.state, 0.0, spec.k * TOLERANCE
        _check_observation("the first observation", definition, env, observation, 0, 0.0)
        for t in range(1, min(spec.horizon, MAX_STEPS) + 1):
            action, d = next_action(env, rng), _distractors(definition, env)
            observation, reward, terminated, truncated, info = env.step(action)
            similarity, step_reward = info["similarity"], info["step_reward"]
            expect_near("optimal_action", info["optimal_action"], definition.optimal_action(s))
            expect_near("similarity", similarity, definition.similarity(s, action))
            expect_near("step_reward", step_reward, definition.reward_of(similarity))
            expect_equal("regret", info["regret"], 1.0 - step_reward)
            _check_limits(definition, s, action, info)
            s = definition.transition(s, action)
            expect_equal("the next state", env.state, s)

            accumulated += step_reward
            pays = t % spec.k == 0 or t == spec.horizon
            expect_near("the reward", reward, accumulated if pays else 0.0, tolerance)
            accumulated = 0.0 if pays else accumulated
            expect_near("accumulated_reward", info["accumulated_reward"], accumulated, tolerance)
            expect_equal("terminated", terminated, step_reward < spec.D)
            expect_equal("truncated", truncated, t == spec.horizon)
            driven = spec.observation is not None and spec.observation.dynamics == "driven"
            if d is not None and driven:
                d = definition.distractor_step(d, action)
                expect_equal("the next distractors", env.distractors, d)
            waiting = info["accumulated_reward"]
            _check_observation("the observation", definition, env, observation, t, waiting)
            if terminated or truncated:
                break


def check_optimum(task: SpecLike, *, single: Make = SMEEnv, seed: int = 0) -> None:
    """The optimal policy reaches the horizon T with return T, in both action ranges.

    Examples:
      >>> from sme_registry.testing import check_optimum
      >>> check_optimum(sme_registry.SMESpec(horizon=5))
    """
    spec = load(task, SMESpec)
    optimal = materialize(spec).optimal_action
    spec = spec.derive(horizon=min(spec.horizon, LONGEST_HORIZON))
    for action_range in ACTION_RANGES:
        env = single(spec, action_range=action_range)
        episodes.expect_optimum(env, optimal, spec.horizon, seed)


def check_determinism(task: SpecLike | StreamLike, *, single: Make = SMEEnv, seed: int = 0) -> None:
    """A seed fixes the episode and the following ones; another seed gives another episode.

    Examples:
      >>> from sme_registry.testing import check_determinism
      >>> check_determinism(sme_registry.SMESpec(horizon=5))
    """
    episodes.expect_determinism(functools.partial(single, load(task)), seed)


def check_pickling(
    task: SpecLike | StreamLike,
    *,
    single: Make = SMEEnv,
    vector: Make = SMEVectorEnv,
    seed: int = 0,
) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does.

    Examples:
      >>> from sme_registry.testing import check_pickling
      >>> check_pickling(sme_registry.SMESpec(horizon=5))
    """
    document = load(task)
    batch = vector(document, 3, autoreset_mode=AutoresetMode.NEXT_STEP.value)
    episodes.expect_same_copies("single environment", single(document), document.horizon, seed)
    episodes.expect_same_copies("vector environment", batch, document.horizon, seed)


def check_vector(
    task: SpecLike | StreamLike,
    *,
    single: Make = SMEEnv,
    vector: Make = SMEVectorEnv,
    seed: int = 0,
) -> None:
    """A batch equals single environments bit for bit, in all three autoreset modes.

    Gymnasium's `SyncVectorEnv` steps the single environments, for more than one episode each.

    Examples:
      >>> from sme_registry.testing import check_vector
      >>> check_vector(sme_registry.SMESpec(horizon=5))
    """
    document, lanes = load(task), 3
    steps = min(document.horizon + 5, MAX_STEPS)
    if isinstance(document, StreamSpec):
        steps = min(document.steps + document.horizon, LONGEST_LIFE)
    for mode, action_range in itertools.product(AutoresetMode, ACTION_RANGES):
        batch = vector(document, lanes, action_range=action_range, autoreset_mode=mode.value)
        singles: Any = SyncVectorEnv(
            [functools.partial(single, document, action_range=action_range)] * lanes,
            autoreset_mode=mode,
        )
        rng = np.random.default_rng(seed)
        where = f"autoreset mode {mode.value}, {action_range}"
        expect_same(f"{where}: reset", batch.reset(seed=seed), singles.reset(seed=seed))
        for t in range(1, steps + 1):
            action = next_action(batch, rng)
            step = batch.step(action)
            expect_same(f"{where}: step {t}", step, singles.step(action))
            ended = step[2] | step[3]
            if mode is AutoresetMode.DISABLED and ended.any():
                # Each is passed its own dictionary, since Gymnasium removes the mask from it.
                first, second = (
                    envs.reset(options={"reset_mask": ended}) for envs in (batch, singles)
                )
                expect_same(f"{where}: reset after step {t}", first, second)


def check_env_spec(task: SpecLike | StreamLike) -> None:
    """`gymnasium.make` recreates the task or stream from its `EnvSpec` as JSON.

    Examples:
      >>> from sme_registry.testing import check_env_spec
      >>> check_env_spec(sme_registry.SMESpec(horizon=5))
    """
    expected = load(task)
    for action_range in ACTION_RANGES:
        env = _recreated(env_spec(expected, action_range=action_range))
        digest = env.unwrapped.document.digest
        expect_equal("the digest after EnvSpec.to_json", digest, expected.digest)
        again = _recreated(env.spec)
        digest = again.unwrapped.document.digest
        expect_equal("the digest after a second EnvSpec.to_json", digest, expected.digest)
        expect_equal("the action space after EnvSpec.to_json", again.action_space, env.action_space)
        expect_equal("the id after EnvSpec.to_json", again.spec.id, env.spec.id)


def _recreated(created_from: EnvSpec) -> Any:
    return gymnasium.make(EnvSpec.from_json(created_from.to_json()))


def _distractors(definition: Task, env: Any) -> npt.NDArray[np.float64] | None:
    """The distractors, in [0, 1]; None where the task has none."""
    m = definition.spec.distractors
    if m == 0:
        return None
    d: npt.NDArray[np.float64] = env.distractors
    expect_equal("the shape of the distractors", d.shape, (m,))
    if not ((d >= 0.0) & (d <= 1.0)).all():
        raise ConformanceError(f"distractors={d}: outside [0, 1].")
    return d


def _check_observation(
    what: str, definition: Task, env: Any, observation: Any, t: int, accumulated: float
) -> None:
    """The agent sees M(s, d), t/T and r_cum/k."""
    spec, s, d = definition.spec, env.state, _distractors(definition, env)
    expected = np.array(
        [*definition.seen(s, d), t / spec.horizon, accumulated / spec.k], np.float32
    )
    if definition.mixing:
        expect_equal(f"{what}: its shape", observation.shape, expected.shape)
        expect_near(what, observation, expected, _FLOAT32_ROUNDING)
    else:
        expect_equal(what, observation, expected)


def _check_limits(definition: Task, s: Any, action: Any, info: dict[str, Any]) -> None:
    """Limits, the safe action, cost and safe regret, where the task has `safety`."""
    if definition.spec.safety is None:
        return
    expect_near("limit", info["limit"], definition.limit(s))
    expect_near("safe_action", info["safe_action"], definition.safe_action(s))
    expect_near("cost", info["cost"], definition.cost(s, action))
    similarity = definition.similarity_of(info["safe_action"], info["optimal_action"])
    safe_regret = definition.reward_of(similarity) - info["step_reward"]
    expect_near("safe_regret", info["safe_regret"], safe_regret)

"""Checks of a single agent's environment and of its batch."""

from __future__ import annotations

import copy
import functools
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.envs.arguments import from_unit
from sme_registry.registration import env_spec
from sme_registry.spec import ACTION_RANGES, SMESpec, SpecLike
from sme_registry.task import load_spec, materialize
from sme_registry.testing.comparing import (
    TOLERANCE,
    ConformanceError,
    expect_equal,
    expect_near,
    expect_same,
)
from sme_registry.testing.episodes import INFO_KEYS, LONGEST_HORIZON, MAX_STEPS, mixed_actions

MakeSingle = Callable[..., Any]
MakeVector = Callable[..., Any]


def check_sme(
    task: SpecLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """Run every check of a single agent's task.

    Args:
      task: an id, a path, a digest, a spec or its fields.
      single: creates the environment as `SMEEnv` does: `single(spec, action_range=…)`.
      vector: creates the batch as `SMEVectorEnv` does: `vector(spec, num_envs, …)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first check that fails.
    """
    check_gymnasium(task, single=single)
    check_info(task, single=single, seed=seed)
    check_definition(task, single=single, seed=seed)
    check_optimum(task, single=single, seed=seed)
    check_determinism(task, single=single, seed=seed)
    check_pickling(task, single=single, vector=vector, seed=seed)
    check_vector(task, single=single, vector=vector, seed=seed)
    check_env_spec(task)


def check_gymnasium(task: SpecLike, *, single: MakeSingle = SMEEnv) -> None:
    """Gymnasium's own `check_env` passes without warnings in both action ranges.

    It treats an episode of one step as an error, so tasks of horizon 1 are skipped.
    """
    spec = load_spec(task)
    if spec.horizon == 1:
        return
    for action_range in ACTION_RANGES:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                # Without an EnvSpec it cannot test the render modes.
                env = single(spec, action_range=action_range)
                check_env(env, skip_render_check=True)
            except Exception as error:
                raise ConformanceError(f"Gymnasium's check_env, {action_range}: {error}") from error
        if caught:
            raise ConformanceError(
                f"Gymnasium's check_env, {action_range}, warns: {caught[0].message}"
            )


def check_info(task: SpecLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """`info` is flat and numeric, has the documented keys and ranges, and is new at each step."""
    spec = load_spec(task)
    for action_range in ACTION_RANGES:
        make = functools.partial(single, spec, action_range=action_range)
        env, returned = make(), _ReturnedArrays()
        _, info = env.reset(seed=seed)
        expect_equal("info at reset", info, {})
        rng = np.random.default_rng(seed)
        for _ in range(min(spec.horizon, 5)):
            observation, _, terminated, truncated, info = env.step(_next_action(env, rng))
            _check_info_entries(info, spec, env.action_space.low)
            returned.overwrite(env, observation, info["optimal_action"])
            if terminated or truncated:
                break
        returned.check_replay(make(), seed)


def _check_info_entries(info: dict[str, Any], spec: SMESpec, low: npt.NDArray[Any]) -> None:
    expect_equal("info's keys", set(info), INFO_KEYS)
    optimal = info["optimal_action"]
    if not (isinstance(optimal, np.ndarray) and optimal.dtype == np.float64):
        raise ConformanceError(f"optimal_action: must be float64, got {optimal!r:.80}.")
    expect_equal("optimal_action's shape", optimal.shape, (spec.action_dim,))
    if not ((optimal >= low) & (optimal <= 1.0)).all():
        raise ConformanceError(f"optimal_action={optimal}: outside the action range.")
    for key in sorted(INFO_KEYS - {"optimal_action"}):
        top = spec.k if key == "accumulated_reward" else 1.0
        if not (isinstance(info[key], float) and 0.0 <= info[key] <= top):
            raise ConformanceError(f"{key}={info[key]!r}: must be a float in [0, {top}].")


class _ReturnedArrays:
    """The arrays that `step` returned, to check that writing into them has no effect."""

    def __init__(self) -> None:
        self._originals: list[tuple[Any, Any]] = []
        self._overwritten: list[npt.NDArray[Any]] = []

    def overwrite(self, env: Any, observation: Any, optimal: Any) -> None:
        """Keep copies of a step's arrays, and overwrite the arrays themselves."""
        self._originals.append((observation.copy(), optimal.copy()))
        before = env.state
        observation[:], optimal[:] = -7.0, -7.0
        for array in (observation, optimal):
            if any(np.shares_memory(array, earlier) for earlier in self._overwritten):
                raise ConformanceError("A later step reuses an array that `step` returned.")
            self._overwritten.append(array)
        if not np.array_equal(env.state, before):
            raise ConformanceError("Writing into an array that `step` returned moved the state.")

    def check_replay(self, env: Any, seed: int) -> None:
        """The same episode without overwriting returns the same arrays."""
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for observation, optimal in self._originals:
            replayed, _, _, _, info = env.step(_next_action(env, rng))
            expect_equal("an observation, after writing into an earlier one", replayed, observation)
            expect_equal(
                "optimal_action, after writing into an earlier one",
                info["optimal_action"],
                optimal,
            )


def check_definition(task: SpecLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """Each step equals that of the spec's `Task`, and rewards are paid as METHOD defines.

    States are compared bit for bit, optimal actions and rewards to 1e-12.
    """
    spec = load_spec(task)
    definition, rng = materialize(spec), np.random.default_rng(seed)
    for episode in range(3):
        env = single(spec)
        observation, _ = env.reset(seed=seed + episode)
        s, accumulated, terminated, truncated = env.state, 0.0, False, False
        expect_equal("the first observation", observation, _expected_observation(spec, s, 0, 0.0))
        for t in range(1, min(spec.horizon, MAX_STEPS) + 1):
            action = _next_action(env, rng)
            observation, reward, terminated, truncated, info = env.step(action)
            expect_near("optimal_action", info["optimal_action"], definition.optimal_action(s))
            expect_near("similarity", info["similarity"], definition.similarity(s, action))
            expect_near(
                "step_reward", info["step_reward"], definition.reward_of(info["similarity"])
            )
            expect_equal("regret", info["regret"], 1.0 - info["step_reward"])
            s = definition.transition(s, action)
            expect_equal("the next state", env.state, s)

            accumulated += info["step_reward"]
            pays = t % spec.k == 0 or t == spec.horizon
            expect_near("the reward", reward, accumulated if pays else 0.0, spec.k * TOLERANCE)
            accumulated = 0.0 if pays else accumulated
            expect_near(
                "accumulated_reward",
                info["accumulated_reward"],
                accumulated,
                spec.k * TOLERANCE,
            )
            expect_equal("terminated", terminated, info["step_reward"] < spec.D)
            expect_equal("truncated", truncated, t == spec.horizon)
            expect_equal("the observation", observation, _expected_observation(
                spec, s, t, info["accumulated_reward"]))  # fmt: skip
            if terminated or truncated:
                break


def check_optimum(task: SpecLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """The optimal policy reaches the horizon T with return T, in both action ranges."""
    spec = load_spec(task)
    definition = materialize(spec)
    spec = spec.derive(horizon=min(spec.horizon, LONGEST_HORIZON))
    for action_range in ACTION_RANGES:
        env = single(spec, action_range=action_range)
        env.reset(seed=seed)
        returned, steps, ended = 0.0, 0, False
        while not ended:
            action = from_unit(definition.optimal_action(env.state), action_range == "symmetric")
            _, reward, terminated, truncated, info = env.step(action)
            returned, steps, ended = returned + float(reward), steps + 1, terminated or truncated
            expect_near("the optimum's regret", info["regret"], 0.0, 1e-9)
        expect_equal("the optimum's steps", steps, spec.horizon)
        expect_near("the optimum's return", returned, spec.horizon, 1e-9 * spec.horizon)


def check_determinism(task: SpecLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """A seed fixes the episode and the following ones; another seed gives another episode."""
    spec = load_spec(task)
    first, second, other = (
        _play(single(spec), reset_seed, seed) for reset_seed in (seed, seed, seed + 1)
    )
    expect_same("two runs of one seed", first, second)
    if np.array_equal(first[0], other[0]):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} start at the same observation.")


def check_pickling(
    task: SpecLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does."""
    spec = load_spec(task)
    copies: dict[str, Callable[[Any], Any]] = {
        "a deep copy": copy.deepcopy,
        "a pickled copy": lambda env: pickle.loads(pickle.dumps(env)),
    }
    envs = {
        "single": single(spec),
        "vector": vector(spec, 3, autoreset_mode=AutoresetMode.NEXT_STEP.value),
    }
    definition = materialize(spec)
    for kind, env in envs.items():
        env.reset(seed=seed)
        if spec.horizon > 1:
            env.step(definition.optimal_action(env.state))
        before = env.state
        for how, copied in copies.items():
            twins, rng = [copied(env), copied(env)], np.random.default_rng(seed)
            ended = False
            for _ in range(min(spec.horizon + 2, MAX_STEPS)):
                if ended:
                    first, second = (twin.reset() for twin in twins)
                    ended = False
                else:
                    action = mixed_actions(definition.optimal_action(twins[0].state), rng)
                    first, second = (twin.step(action) for twin in twins)
                    ended = kind == "single" and (first[2] or first[3])
                expect_same(f"{how} of the {kind} environment", first, second)
        expect_equal(
            f"the {kind} environment's state, after stepping its copies", env.state, before
        )
        action = mixed_actions(definition.optimal_action(before), np.random.default_rng(seed))
        twin = copies["a pickled copy"](env)
        expect_same(
            f"a pickled copy of the {kind} environment", twin.step(action), env.step(action)
        )


def check_vector(
    task: SpecLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """A batch equals single environments bit for bit, in all three autoreset modes.

    Gymnasium's `SyncVectorEnv` steps the single environments, for more than one episode each.
    """
    spec = load_spec(task)
    definition, lanes = materialize(spec), 3
    for mode in AutoresetMode:
        for action_range in ACTION_RANGES:
            batch = vector(spec, lanes, action_range=action_range, autoreset_mode=mode.value)
            singles: Any = SyncVectorEnv(
                [functools.partial(single, spec, action_range=action_range)] * lanes,
                autoreset_mode=mode,
            )
            rng = np.random.default_rng(seed)
            where = f"autoreset mode {mode.value}, {action_range}"
            expect_same(f"{where}: reset", batch.reset(seed=seed), singles.reset(seed=seed))
            for t in range(min(spec.horizon + 5, MAX_STEPS)):
                action = mixed_actions(definition.optimal_action(batch.state), rng)
                action = from_unit(action, action_range == "symmetric")
                got, expected = batch.step(action), singles.step(action)
                expect_same(f"{where}: step {t + 1}", got, expected)
                ended = got[2] | got[3]
                if mode is AutoresetMode.DISABLED and ended.any():
                    options = {"reset_mask": ended}
                    expect_same(f"{where}: reset after step {t + 1}",
                          batch.reset(options=dict(options)),
                          singles.reset(options=dict(options)))  # fmt: skip


def check_env_spec(task: SpecLike) -> None:
    """`gymnasium.make` recreates the task from its `EnvSpec` as JSON."""
    spec = load_spec(task)
    for action_range in ACTION_RANGES:
        text = env_spec(spec, action_range=action_range).to_json()
        env: Any = gymnasium.make(EnvSpec.from_json(text))
        expect_equal("the digest after EnvSpec.to_json", env.unwrapped.sme_spec.digest, spec.digest)
        again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        expect_equal(
            "the digest after a second EnvSpec.to_json",
            again.unwrapped.sme_spec.digest,
            spec.digest,
        )
        expect_equal("the action space after EnvSpec.to_json", again.action_space, env.action_space)
        expect_equal("the id after EnvSpec.to_json", again.spec.id, env.spec.id)


def _next_action(env: Any, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    action = mixed_actions(env.task.optimal_action(env.state), rng)
    return from_unit(action, bool(env.action_space.low[0] < 0.0)).astype(np.float32)


def _play(env: Any, reset_seed: int, seed: int) -> list[Any]:
    """Everything that two short episodes return; the second continues the environment's stream."""
    rng = np.random.default_rng(seed)
    returns: list[Any] = []
    for episode_seed in (reset_seed, None):
        returns += env.reset(seed=episode_seed)
        for _ in range(min(env.sme_spec.horizon, 20)):
            step = env.step(_next_action(env, rng))
            returns += step
            if step[2] or step[3]:
                break
    return returns


def _expected_observation(
    spec: SMESpec, s: Any, t: int, accumulated: float
) -> npt.NDArray[np.float32]:
    return np.array([*s, t / spec.horizon, accumulated / spec.k], np.float32)

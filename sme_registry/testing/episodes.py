"""The episodes that the checks play, of a single environment, a batch or a team."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import from_unit
from sme_registry.spec import SMESpec
from sme_registry.testing.comparing import ConformanceError, expect_equal, expect_near, expect_same

Make = Callable[..., Any]  # creates an environment, as the classes of `sme_registry.envs` do

MAX_STEPS = 250  # of one episode: horizons may be long
LONGEST_HORIZON = 10_000  # that the optimal policy is followed to
LONGEST_LIFE = 1000  # steps of a stream
INFO_KEYS = {"optimal_action", "similarity", "step_reward", "regret", "accumulated_reward"}
SAFETY_KEYS = {"cost", "limit", "safe_action", "safe_regret"}
ACTION_KEYS = {"optimal_action", "limit", "safe_action"}  # of INFO_KEYS and SAFETY_KEYS


def info_keys(spec: SMESpec) -> set[str]:
    """The keys of a single agent's info."""
    return INFO_KEYS if spec.safety is None else INFO_KEYS | SAFETY_KEYS


def expect_info_of_reset(
    what: str, info: dict[str, Any], action_dim: int, keys: set[str] = INFO_KEYS
) -> None:
    """The info of a reset has the keys, shapes and types of a step's, and is NaN."""
    expect_equal(f"{what}: the keys", set(info), keys)
    for key in sorted(keys):
        nan = np.full(action_dim, np.nan) if key in ACTION_KEYS else np.float64(np.nan)
        expect_same(f"{what}: {key}", info[key], nan)


def mixed_actions(optimal: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Actions of the unit range between optimal and random ones, some slightly outside of it."""
    shape = optimal.shape
    share = rng.uniform(0.0, 0.5, (*shape[:-1], 1))
    mixed: npt.NDArray[np.float64] = (1 - share) * optimal + share * rng.uniform(-0.1, 1.1, shape)
    return mixed.astype(np.float32)


def next_action(env: Any, rng: np.random.Generator) -> Any:
    """`mixed_actions` in the current state, in the form that the environment's `step` takes."""
    return as_action(env, mixed_actions(_optimal(env), rng))


def _optimal(env: Any) -> npt.NDArray[np.float64]:
    """π* in the current state; in a batch of a stream, of the task in force in each lane."""
    if hasattr(env, "stream") and hasattr(env, "num_envs"):
        lanes = zip(env.get_attr("task"), env.state, strict=True)
        return np.stack([task.optimal_action(s) for task, s in lanes])
    optimal: npt.NDArray[np.float64] = env.task.optimal_action(_state(env))
    return optimal


def as_action(env: Any, unit: npt.NDArray[Any]) -> Any:
    """Joint actions of the unit range in the environment's range, for a team by agent."""
    if not _is_team(env):
        return from_unit(unit, bool(env.action_space.low.flat[0] < 0.0))
    joint = from_unit(unit, bool(env.action_space(env.task.names[0]).low[0] < 0.0))
    return {name: joint[owned] for name, owned in zip(env.task.names, env.task.owned, strict=True)}


def has_ended(step: Any) -> bool:
    """Whether a step ended the episode, a team's if for all agents; a batch resets its lanes."""
    terminated, truncated = step[2:4]
    if isinstance(terminated, dict):
        return all(terminated[name] or truncated[name] for name in terminated)
    return not isinstance(terminated, np.ndarray) and bool(terminated or truncated)


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
        for _ in range(MAX_STEPS):
            step = env.step(next_action(env, rng))
            returned += [*step, _state(env)]
            if has_ended(step):
                break
    return returned


def expect_optimum(env: Any, act: Callable[[Any], Any], horizon: int, seed: int) -> None:
    """A policy from states to joint actions reaches the horizon T without regret, with return T."""
    env.reset(seed=seed)
    returns: dict[str, float] = {}
    steps, ended = 0, False
    while not ended:
        step = env.step(as_action(env, act(_state(env))))
        steps, ended = steps + 1, has_ended(step)
        _, rewards, _, _, infos = step
        if not _is_team(env):
            rewards, infos = {"": rewards}, {"": infos}
        for name, reward in rewards.items():
            agent = name and f"{name}: "
            expect_near(f"{agent}the optimum's regret", infos[name]["regret"], 0.0, 1e-9)
            returns[agent] = returns.get(agent, 0.0) + float(reward)
    expect_equal("the optimum's steps", steps, horizon)
    for agent, total in returns.items():
        expect_near(f"{agent}the optimum's return", total, horizon, 1e-9 * horizon)


def expect_determinism(make: Callable[[], Any], seed: int) -> None:
    """A seed fixes the episode and the following one; another seed gives another episode."""
    first, second, other = (play(make(), start, seed) for start in (seed, seed, seed + 1))
    expect_same("two runs of one seed", first, second)
    if all(map(np.array_equal, *(_values(played[0]) for played in (first, other)))):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} start at the same observation.")


def expect_same_copies(kind: str, env: Any, horizon: int, seed: int) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does."""
    env.reset(seed=seed)
    if horizon > 1:
        env.step(as_action(env, _optimal(env)))
    before = np.copy(_state(env))
    copies = {"a pickled copy": pickle.loads(pickle.dumps(env)), "a deep copy": copy.deepcopy(env)}
    played = {}
    for how, twin in copies.items():
        played[how] = play(twin, None, seed, in_progress=True)
        expect_equal(f"the state, after stepping {how} of the {kind}", _state(env), before)
    original = play(env, None, seed, in_progress=True)
    for how, returned in played.items():
        expect_same(f"{how} of the {kind}", returned, original)


def _is_team(env: Any) -> bool:
    return hasattr(env, "possible_agents")


def _state(env: Any) -> npt.NDArray[np.float64]:
    return env.state() if _is_team(env) else env.state  # type: ignore[no-any-return]


def _values(observation: Any) -> list[Any]:
    return list(observation.values()) if isinstance(observation, dict) else [observation]

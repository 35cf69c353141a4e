"""The conformance kit: what every SME environment promises, as checks that any test may call.

    from sme_registry.testing import check_sme
    check_sme("SME/Default-v1")                       # or your own spec, or your own classes
    check_team("SME/Team4-v1")                        # the same for teams, through PettingZoo

Each check raises `ConformanceError` with what was expected and what came. They play real episodes
with actions between the optimal and the random, so that some end early where D > 0.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import os
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
from pettingzoo.utils.conversions import aec_to_parallel_wrapper, parallel_to_aec
from scipy.special import ndtr

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.envs.team import SMETeamEnv
from sme_registry.registration import env_spec, load
from sme_registry.spec import SMESpec
from sme_registry.spec.sme_spec import as_spec
from sme_registry.task import Task, materialize, observe, step

__all__ = [
    "ConformanceError",
    "check_definition",
    "check_determinism",
    "check_env_spec",
    "check_gymnasium",
    "check_info",
    "check_optimum",
    "check_pettingzoo",
    "check_pickling",
    "check_sme",
    "check_team",
    "check_team_definition",
    "check_team_determinism",
    "check_team_optimum",
    "check_team_pickling",
    "check_turns",
    "check_vector",
]

TaskLike = SMESpec | dict[str, Any] | str | os.PathLike[str]
MakeSingle = Callable[..., Any]
MakeVector = Callable[..., Any]
MakeParallel = Callable[..., Any]

INFO_KEYS = {"optimal_action", "similarity", "step_reward", "regret", "accumulated_reward"}
RANGES = ("unit", "symmetric")
TOLERANCE = 1e-12  # of oracle and reward between back-ends; states are equal bit for bit
_SAID_OF_UNEQUAL_AGENTS = {
    "Agents have different observation space sizes",
    "Agents have different action space sizes",
    "Observations are different shapes",
}
_STEPS = 250  # of an episode, at most: horizons may be long


class ConformanceError(AssertionError):
    """An environment does not keep what every SME environment promises."""


def check_sme(
    task: TaskLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """Run every check.

    Args:
      task: an id, a path, a digest, a spec or its fields.
      single: makes the environment, as `SMEEnv` does: `single(spec, action_range=…)`.
      vector: makes the batch, as `SMEVectorEnv` does: `vector(spec, num_envs, …)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first promise that is not kept.
    """
    check_gymnasium(task, single=single)
    check_info(task, single=single, seed=seed)
    check_definition(task, single=single, seed=seed)
    check_optimum(task, single=single, seed=seed)
    check_determinism(task, single=single, seed=seed)
    check_pickling(task, single=single, vector=vector, seed=seed)
    check_vector(task, single=single, vector=vector, seed=seed)
    check_env_spec(task)


def check_gymnasium(task: TaskLike, *, single: MakeSingle = SMEEnv) -> None:
    """Gymnasium's own `check_env` passes in both action ranges, and has nothing to warn of.

    It takes an episode of one step for a fault, so tasks of horizon 1 are left out.
    """
    spec = _spec(task)
    if spec.horizon == 1:
        return
    for action_range in RANGES:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                # Without an EnvSpec it cannot try the render modes, and says so.
                env = single(spec, action_range=action_range)
                check_env(env, skip_render_check=True)
            except Exception as error:
                raise ConformanceError(f"Gymnasium's check_env, {action_range}: {error}") from error
        if caught:
            raise ConformanceError(
                f"Gymnasium's check_env, {action_range}, warns: {caught[0].message}"
            )


def check_info(task: TaskLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """`info` is flat and numeric, has the promised keys and ranges, and is fresh at each step."""
    spec = _spec(task)
    for action_range in RANGES:
        env = single(spec, action_range=action_range)
        low = env.action_space.low
        _, info = env.reset(seed=seed)
        _expect("info at reset", info, {})
        rng = np.random.default_rng(seed)
        kept: list[tuple[Any, Any]] = []
        handed_out: list[npt.NDArray[Any]] = []
        for _ in range(min(spec.horizon, 5)):
            observation, _, terminated, truncated, info = env.step(_action(env, rng))
            _expect("info's keys", set(info), INFO_KEYS)
            optimal = info["optimal_action"]
            if not (isinstance(optimal, np.ndarray) and optimal.dtype == np.float64):
                raise ConformanceError(f"optimal_action: must be float64, got {optimal!r:.80}.")
            _expect("optimal_action's shape", optimal.shape, (spec.action_dim,))
            if not ((optimal >= low) & (optimal <= 1.0)).all():
                raise ConformanceError(f"optimal_action={optimal}: outside the action range.")
            for key in sorted(INFO_KEYS - {"optimal_action"}):
                top = spec.k if key == "accumulated_reward" else 1.0
                if not (isinstance(info[key], float) and 0.0 <= info[key] <= top):
                    raise ConformanceError(f"{key}={info[key]!r}: must be a float in [0, {top}].")
            # Whoever writes into what is handed out must not move the environment.
            kept.append((observation.copy(), optimal.copy()))
            before = env.state
            observation[:], optimal[:] = -7.0, -7.0
            for array in (observation, optimal):
                if any(np.shares_memory(array, earlier) for earlier in handed_out):
                    raise ConformanceError("An array of `step` is used again by a later step.")
                handed_out.append(array)
            if not np.array_equal(env.state, before):
                raise ConformanceError("Writing into what `step` returned has moved the state.")
            if terminated or truncated:
                break
        again = single(spec, action_range=action_range)
        again.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for observation, optimal in kept:
            now, _, _, _, info = again.step(_action(again, rng))
            _expect("an observation, after writing into an earlier one", now, observation)
            _expect("optimal_action, after writing into an earlier one",
                    info["optimal_action"], optimal)  # fmt: skip


def check_definition(task: TaskLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """Each step is that of the `Task` of this spec, and the rewards are paid as METHOD says.

    States are compared bit for bit, oracle and rewards to 1e-12.
    """
    spec = _spec(task)
    drawn, rng = materialize(spec), np.random.default_rng(seed)
    for episode in range(3):
        env = single(spec)
        observation, _ = env.reset(seed=seed + episode)
        s, cumulated, terminated, truncated = env.state, 0.0, False, False
        _expect("the first observation", observation, _observation(spec, s, 0, 0.0))
        for t in range(1, min(spec.horizon, _STEPS) + 1):
            action = _action(env, rng)
            observation, reward, terminated, truncated, info = env.step(action)
            _near("optimal_action", info["optimal_action"], drawn.optimal_action(s))
            _near("similarity", info["similarity"], drawn.similarity(s, action))
            _near("step_reward", info["step_reward"], drawn.reward_of(info["similarity"]))
            _expect("regret", info["regret"], 1.0 - info["step_reward"])
            s = drawn.transition(s, action)
            _expect("the next state", env.state, s)

            cumulated += info["step_reward"]
            pays = t % spec.k == 0 or t == spec.horizon
            _near("the reward", reward, cumulated if pays else 0.0, spec.k * TOLERANCE)
            cumulated = 0.0 if pays else cumulated
            _near("accumulated_reward", info["accumulated_reward"], cumulated, spec.k * TOLERANCE)
            _expect("terminated", terminated, info["step_reward"] < spec.D)
            _expect("truncated", truncated, t == spec.horizon)
            _expect("the observation", observation, _observation(
                spec, s, t, info["accumulated_reward"]))  # fmt: skip
            if terminated or truncated:
                break


def check_optimum(task: TaskLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """The optimal policy survives to the horizon T and is paid T, in either action range."""
    spec = _spec(task)
    drawn = materialize(spec)
    if spec.horizon > 10_000:
        spec = spec.derive(horizon=10_000)
    for action_range in RANGES:
        env = single(spec, action_range=action_range)
        env.reset(seed=seed)
        returned, steps, ended = 0.0, 0, False
        while not ended:
            action = drawn.optimal_action(env.state)
            action = 2.0 * action - 1.0 if action_range == "symmetric" else action
            _, reward, terminated, truncated, info = env.step(action)
            returned, steps, ended = returned + float(reward), steps + 1, terminated or truncated
            _near("the optimum's regret", info["regret"], 0.0, 1e-9)
        _expect("the optimum's steps", steps, spec.horizon)
        _near("the optimum's return", returned, spec.horizon, 1e-9 * spec.horizon)


def check_determinism(task: TaskLike, *, single: MakeSingle = SMEEnv, seed: int = 0) -> None:
    """A seed fixes the episode and the ones after it; another seed gives another episode."""
    spec = _spec(task)
    first, second, other = (
        _record(single(spec), reset_seed, seed) for reset_seed in (seed, seed, seed + 1)
    )
    _same("two runs of one seed", first, second)
    if np.array_equal(first[0], other[0]):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} begin at the same observation.")


def check_pickling(
    task: TaskLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """Pickled and deep copies, taken in the middle of an episode, go on as the original does."""
    spec = _spec(task)
    copies: dict[str, Callable[[Any], Any]] = {
        "a deep copy": copy.deepcopy,
        "a pickled copy": lambda env: pickle.loads(pickle.dumps(env)),
    }
    envs = {
        "single": single(spec),
        "vector": vector(spec, 3, autoreset_mode=AutoresetMode.NEXT_STEP.value),
    }
    drawn = materialize(spec)
    for kind, env in envs.items():
        env.reset(seed=seed)
        if spec.horizon > 1:
            env.step(drawn.optimal_action(env.state))
        before = env.state
        for how, copied in copies.items():
            twins, rng = [copied(env), copied(env)], np.random.default_rng(seed)
            ended = False
            for _ in range(min(spec.horizon + 2, _STEPS)):
                if ended:
                    first, second = (twin.reset() for twin in twins)
                    ended = False
                else:
                    action = _mixed(drawn.optimal_action(twins[0].state), rng)
                    first, second = (twin.step(action) for twin in twins)
                    ended = kind == "single" and (first[2] or first[3])
                _same(f"{how} of the {kind} environment", first, second)
        _expect(f"the {kind} environment's state, once its copies are stepped", env.state, before)
        action = _mixed(drawn.optimal_action(before), np.random.default_rng(seed))
        twin = copies["a pickled copy"](env)
        _same(f"a pickled copy of the {kind} environment", twin.step(action), env.step(action))


def check_vector(
    task: TaskLike, *, single: MakeSingle = SMEEnv, vector: MakeVector = SMEVectorEnv, seed: int = 0
) -> None:
    """A batch equals as many single environments bit for bit, in all three autoreset modes.

    The singles are stepped by Gymnasium's `SyncVectorEnv`, over more than one episode of each.
    """
    spec = _spec(task)
    drawn, lanes = materialize(spec), 3
    for mode in AutoresetMode:
        for action_range in RANGES:
            batch = vector(spec, lanes, action_range=action_range, autoreset_mode=mode.value)
            singles: Any = SyncVectorEnv(
                [functools.partial(single, spec, action_range=action_range)] * lanes,
                autoreset_mode=mode,
            )
            rng = np.random.default_rng(seed)
            where = f"autoreset mode {mode.value}, {action_range}"
            _same(f"{where}: reset", batch.reset(seed=seed), singles.reset(seed=seed))
            for t in range(min(spec.horizon + 5, _STEPS)):
                action = _mixed(drawn.optimal_action(batch.state), rng)
                action = 2.0 * action - 1.0 if action_range == "symmetric" else action
                got, expected = batch.step(action), singles.step(action)
                _same(f"{where}: step {t + 1}", got, expected)
                ended = got[2] | got[3]
                if mode is AutoresetMode.DISABLED and ended.any():
                    options = {"reset_mask": ended}
                    _same(f"{where}: reset after step {t + 1}",
                          batch.reset(options=dict(options)),
                          singles.reset(options=dict(options)))  # fmt: skip


def check_env_spec(task: TaskLike) -> None:
    """`gymnasium.make` of the task's `EnvSpec`, sent as JSON, gives this very task."""
    spec = _spec(task)
    for action_range in RANGES:
        sent = env_spec(spec, action_range=action_range).to_json()
        env: Any = gymnasium.make(EnvSpec.from_json(sent))
        _expect("the digest after EnvSpec.to_json", env.unwrapped.sme_spec.digest, spec.digest)
        again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        _expect("the digest after a second time", again.unwrapped.sme_spec.digest, spec.digest)
        _expect("the action space after EnvSpec.to_json", again.action_space, env.action_space)
        _expect("the id after EnvSpec.to_json", again.spec.id, env.spec.id)


def check_team(task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0) -> None:
    """Run every check of a team.

    Args:
      task: an id, a path, a digest, a spec or its fields; without a team it is a team of one.
      parallel: makes the environment, as `SMETeamEnv` does: `parallel(spec, action_range=…)`.
      seed: of the episodes and the actions.

    Raises:
      ConformanceError: the first promise that is not kept.
    """
    check_pettingzoo(task, parallel=parallel)
    check_team_definition(task, parallel=parallel, seed=seed)
    check_team_optimum(task, parallel=parallel, seed=seed)
    check_team_determinism(task, parallel=parallel, seed=seed)
    check_team_pickling(task, parallel=parallel, seed=seed)
    check_turns(task, parallel=parallel, seed=seed)


def check_pettingzoo(task: TaskLike, *, parallel: MakeParallel = SMETeamEnv) -> None:
    """PettingZoo's own tests of API, seed and state pass, parallel and in turns, without warnings.

    It warns of agents whose spaces differ in size, which is what such a team is; that is let pass.
    """
    spec = _spec(task)
    drawn = materialize(spec)
    widths = {own.stop - own.start for own in drawn.owned}
    unequal = len(widths) > 1 or len({len(channels) for channels in drawn.observed}) > 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its import warns of its own module's age
        from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
        from pettingzoo.test.state_test import state_test
    for action_range in RANGES:
        make = functools.partial(parallel, spec, action_range=action_range)
        in_turns: Callable[[], Any] = functools.partial(_in_turns, make)
        tests: dict[str, Callable[[], Any]] = {
            "parallel_api_test": functools.partial(parallel_api_test, make(), num_cycles=_STEPS),
            "api_test": functools.partial(api_test, in_turns(), num_cycles=_STEPS),
            "parallel_seed_test": functools.partial(parallel_seed_test, make),
            "seed_test": functools.partial(seed_test, in_turns),
            "state_test": functools.partial(state_test, in_turns(), make()),
        }
        for name, run in tests.items():
            silence = contextlib.redirect_stdout(io.StringIO())
            with warnings.catch_warnings(record=True) as caught, silence:
                warnings.simplefilter("always")
                try:
                    run()
                except Exception as error:
                    raise ConformanceError(
                        f"PettingZoo's {name}, {action_range}: {error}"
                    ) from error
            told = [str(warning.message) for warning in caught]
            told = [said for said in told if not (unequal and said in _SAID_OF_UNEQUAL_AGENTS)]
            if told:
                raise ConformanceError(f"PettingZoo's {name}, {action_range}, warns: {told[0]}")


def check_team_definition(
    task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0
) -> None:
    """Each step is that of `sme_registry.task.step`, agent by agent, and each sees what it may.

    States and ends are compared bit for bit, oracle and rewards to 1e-12.
    """
    spec = _spec(task)
    drawn, rng = materialize(spec), np.random.default_rng(seed)
    for action_range in RANGES:
        env = parallel(spec, action_range=action_range)
        observations, infos = env.reset(seed=seed)
        _expect("the agents", tuple(env.agents), drawn.names)
        _expect("infos at reset", infos, {name: {} for name in drawn.names})
        s, r_cum = env.state()[None], np.zeros((1, len(drawn.names)))
        _observed(drawn, observations, s, 0, r_cum)
        for t in range(min(spec.horizon, _STEPS)):
            actions = _team_actions(env, rng)
            joint = np.concatenate([actions[name] for name in drawn.names]).astype(np.float64)
            joint = (joint + 1.0) / 2.0 if action_range == "symmetric" else joint
            done = step(drawn, s, np.array([t]), r_cum, joint[None])
            observations, rewards, terminated, truncated, infos = env.step(actions)
            _expect("the next state", env.state(), done.state[0])
            optimal = done.optimal_action[0]
            optimal = 2.0 * optimal - 1.0 if action_range == "symmetric" else optimal
            for agent, (name, own) in enumerate(zip(drawn.names, drawn.owned, strict=True)):
                info = infos[name]
                _expect(f"{name}: info's keys", set(info), INFO_KEYS)
                _near(f"{name}: optimal_action", info["optimal_action"], optimal[own])
                for key in ("similarity", "step_reward"):
                    _near(f"{name}: {key}", info[key], getattr(done, key)[0, agent])
                _expect(f"{name}: regret", info["regret"], 1.0 - info["step_reward"])
                for key, got in (
                    ("reward", rewards[name]), ("accumulated_reward", info["accumulated_reward"])
                ):  # fmt: skip
                    _near(f"{name}: {key}", got, getattr(done, key)[0, agent], spec.k * TOLERANCE)
                _expect(f"{name}: terminated", terminated[name], bool(done.terminated[0]))
                _expect(f"{name}: truncated", truncated[name], bool(done.truncated[0]))
            s = done.state
            r_cum = np.array([[infos[name]["accumulated_reward"] for name in drawn.names]])
            _observed(drawn, observations, s, t + 1, r_cum)
            if done.terminated[0] or done.truncated[0]:
                _expect("the agents, once the episode has ended", list(env.agents), [])
                break


def check_team_optimum(
    task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0
) -> None:
    """Every agent that acts by its own layers on what it observes alone is paid the horizon T."""
    spec = _spec(task)
    drawn = materialize(spec)
    if spec.horizon > 10_000:
        spec = spec.derive(horizon=10_000)
    for action_range in RANGES:
        env = parallel(spec, action_range=action_range)
        env.reset(seed=seed)
        returned, steps = dict.fromkeys(drawn.names, 0.0), 0
        while env.agents:
            actions = {}
            s = env.state()
            for name, channels, layers in zip(
                drawn.names, drawn.observed, drawn.policies, strict=True
            ):
                x = s[list(channels)]
                for W, b in layers:
                    x = ndtr(W @ x + b)
                actions[name] = 2.0 * x - 1.0 if action_range == "symmetric" else x
            _, rewards, _, _, infos = env.step(actions)
            steps += 1
            for name, reward in rewards.items():
                _near(f"{name}: the optimum's regret", infos[name]["regret"], 0.0, 1e-9)
                returned[name] += reward
        _expect("the optimum's steps", steps, spec.horizon)
        for name, total in returned.items():
            _near(f"{name}: the optimum's return", total, spec.horizon, 1e-9 * spec.horizon)


def check_team_determinism(
    task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0
) -> None:
    """A seed fixes whole episodes, one after the other; PettingZoo's tests compare one step."""
    spec = _spec(task)
    first, second, other = (
        _team_record(parallel(spec), reset_seed, seed) for reset_seed in (seed, seed, seed + 1)
    )
    _same("two runs of one seed", first, second)
    name = next(iter(first[0]))
    if np.array_equal(first[0][name], other[0][name]):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} begin at the same observation.")


def check_team_pickling(
    task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0
) -> None:
    """Pickled and deep copies, taken in the middle of an episode, go on as the original does."""
    spec = _spec(task)
    env = parallel(spec)
    env.reset(seed=seed)
    if spec.horizon > 1:
        best = env.task.optimal_action(env.state())
        env.step({
            name: best[own] for name, own in zip(env.task.names, env.task.owned, strict=True)
        })  # fmt: skip
    before = env.state()
    copies = {"a pickled copy": pickle.loads(pickle.dumps(env)), "a deep copy": copy.deepcopy(env)}
    played = {how: _team_record(twin, None, seed, begun=True) for how, twin in copies.items()}
    _expect("the state, once a copy is stepped", env.state(), before)
    original = _team_record(env, None, seed, begun=True)
    for how, record in played.items():
        _same(how, record, original)


def check_turns(task: TaskLike, *, parallel: MakeParallel = SMETeamEnv, seed: int = 0) -> None:
    """PettingZoo's conversions, to turns and back, keep every number of a whole episode."""
    spec = _spec(task)
    make = functools.partial(parallel, spec)
    direct = _team_record(make(), seed, seed)
    # Not `aec_to_parallel`: it would hand out the environment that is inside.
    there_and_back: Any = aec_to_parallel_wrapper(parallel_to_aec(make()))
    there_and_back.task = materialize(spec)
    _same("parallel, in turns, and back", _team_record(there_and_back, seed, seed), direct)

    env, turns = make(), parallel_to_aec(make())
    observations, _ = env.reset(seed=seed)
    turns.reset(seed=seed)
    rng = np.random.default_rng(seed)
    rewards = dict.fromkeys(env.agents, 0.0)
    terminated = truncated = dict.fromkeys(env.agents, False)
    infos: dict[str, Any] = {name: {} for name in env.agents}
    while env.agents:
        actions = _team_actions(env, rng)
        for name in env.agents:
            _expect("whose turn it is", turns.agent_selection, name)
            _same(f"{name} in turns", list(turns.last()), [
                observations[name], rewards[name], terminated[name], truncated[name], infos[name]
            ])  # fmt: skip
            turns.step(actions[name])
        observations, rewards, terminated, truncated, infos = env.step(actions)
    for _ in env.possible_agents:
        name = turns.agent_selection  # once they have ended, in the order of their names
        _same(f"{name} in turns, at the end", list(turns.last()), [
            observations[name], rewards[name], terminated[name], truncated[name], infos[name]
        ])  # fmt: skip
        turns.step(None)


def _spec(task: TaskLike) -> SMESpec:
    return as_spec(task) if isinstance(task, SMESpec | dict) else load(task)


def _mixed(optimal: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Actions of the unit range between the optimal and the random, some a little outside."""
    shape = optimal.shape
    share = rng.uniform(0.0, 0.5, (*shape[:-1], 1))
    mixed: npt.NDArray[np.float64] = (1 - share) * optimal + share * rng.uniform(-0.1, 1.1, shape)
    return mixed.astype(np.float32)


def _action(env: Any, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    action = _mixed(env.task.optimal_action(env.state), rng)
    symmetric = bool(env.action_space.low[0] < 0.0)
    return (2.0 * action - 1.0).astype(np.float32) if symmetric else action


def _record(env: Any, reset_seed: int, seed: int) -> list[Any]:
    """Everything that two short episodes return; the second goes on with the generator."""
    rng = np.random.default_rng(seed)
    seen: list[Any] = []
    for given in (reset_seed, None):
        seen += env.reset(seed=given)
        for _ in range(min(env.sme_spec.horizon, 20)):
            returned = env.step(_action(env, rng))
            seen += returned
            if returned[2] or returned[3]:
                break
    return seen


def _in_turns(make: MakeParallel) -> Any:
    return parallel_to_aec(make())


def _team_actions(env: Any, rng: np.random.Generator) -> dict[str, npt.NDArray[np.float32]]:
    """`_mixed` actions, for each agent its own, in the environment's range."""
    joint = _mixed(env.task.optimal_action(env.state()), rng)
    if env.action_space(env.task.names[0]).low[0] < 0.0:
        joint = (2.0 * joint - 1.0).astype(np.float32)
    return {name: joint[own] for name, own in zip(env.task.names, env.task.owned, strict=True)}


def _team_record(env: Any, reset_seed: int | None, seed: int, begun: bool = False) -> list[Any]:
    """All that two whole episodes return, the second going on with the generator.

    An episode that is `begun` is played to its end, and is the first.
    """
    rng = np.random.default_rng(seed)
    seen: list[Any] = []
    for given in (reset_seed, None):
        if not begun:
            seen += env.reset(seed=given)
        begun = False
        for _ in range(_STEPS):
            if not env.agents:
                break
            seen += [*env.step(_team_actions(env, rng)), env.state()]
    return seen


def _observed(drawn: Task, got: dict[str, Any], s: Any, t: int, r_cum: Any) -> None:
    """Each agent observes its own state channels, t/T and its own r_cum/k, and no more."""
    spec = drawn.spec
    joint = observe(spec, s, np.array([t]), r_cum)[0]
    for agent, (name, channels) in enumerate(zip(drawn.names, drawn.observed, strict=True)):
        columns = [*channels, spec.state_dim, spec.state_dim + 1 + agent]
        _expect(f"{name}: the observation", got[name], joint[columns])


def _observation(spec: SMESpec, s: Any, t: int, cumulated: float) -> npt.NDArray[np.float32]:
    return np.array([*s, t / spec.horizon, cumulated / spec.k], np.float32)


def _expect(what: str, got: Any, expected: Any) -> None:
    same = np.array_equal(got, expected) if isinstance(got, np.ndarray) else got == expected
    if not same:
        raise ConformanceError(f"{what}: expected {expected!r:.200}, got {got!r:.200}.")


def _near(what: str, got: Any, expected: Any, tolerance: float = TOLERANCE) -> None:
    difference = float(np.max(np.abs(np.asarray(got) - np.asarray(expected))))
    if not difference <= tolerance:
        raise ConformanceError(
            f"{what}: expected {expected!r:.200} to {tolerance:.0e}, got {got!r:.200}."
        )


def _same(what: str, got: Any, expected: Any) -> None:
    """Equal in every bit, type and key; a batched info's masked-out entries do not count."""
    if isinstance(got, dict) and isinstance(expected, dict):
        for key in got.keys() | expected.keys():
            if not key.startswith("_"):
                _same_entries(f"{what}: {key}", key, got, expected)
    elif isinstance(got, list | tuple) and isinstance(expected, list | tuple):
        _expect(f"{what}: the number of values", len(got), len(expected))
        for ours, theirs in zip(got, expected, strict=True):
            _same(what, ours, theirs)
    elif isinstance(got, np.ndarray) and got.dtype != object:
        _expect(f"{what}: dtype", got.dtype, np.asarray(expected).dtype)
        _expect(what, got, expected)
    elif isinstance(got, np.ndarray):
        _same(what, list(got), list(expected))
    else:
        _expect(what, got, expected)


def _same_entries(what: str, key: str, got: dict[str, Any], expected: dict[str, Any]) -> None:
    """One key of two infos, single or batched."""
    mask, other = got.get(f"_{key}"), expected.get(f"_{key}")
    if mask is None and other is None:
        _same(what, got.get(key), expected.get(key))
        return
    # A key that is absent is the same as one whose mask is False in every lane.
    lanes = len(mask if mask is not None else other)  # type: ignore[arg-type]
    masks = [np.zeros(lanes, bool) if m is None else np.asarray(m) for m in (mask, other)]
    _expect(f"{what}: mask", masks[0], masks[1])
    if not masks[0].any():
        return
    if isinstance(got[key], dict):
        _same(what, got[key], expected[key])
    else:
        _same(what, got[key][masks[0]], expected[key][masks[0]])

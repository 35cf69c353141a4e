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
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.envs.arguments import from_unit
from sme_registry.envs.schedule import Schedule
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.sme_spec import ACTION_RANGES, SpecLike
from sme_registry.spec.stream import StreamLike
from sme_registry.task import Task, load, materialize, observe, step
from sme_registry.task.episode import Step, shaping_at_switch
from sme_registry.task.loading import materialize_segments
from sme_registry.task.task import NUMBERS, ON_TOP, Array
from sme_registry.teams import SMETeamEnv, observed_columns

__all__ = ["ConformanceError", "check_env", "check_stream", "check_team"]

TOLERANCE = 1e-12  # of optimal actions and rewards between back-ends; states are equal bit for bit
_FLOAT32_ROUNDING = 2e-7  # of what an agent sees through a mixing, in [0, 1]
_MAX_STEPS = 250  # of one episode: horizons may be long
_LONGEST_HORIZON = 10_000  # that the optimal policy is followed to
_LONGEST_LIFE = 1000  # steps of a stream
_NONE = np.empty(0)  # the distractors of a team

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

    `single(spec, action_range=…)` and `vector(spec, num_envs, …)` create the environments as
    `SMEEnv` and `SMEVectorEnv` do; `seed` is of the episodes and the actions.

    Examples:
      >>> from sme_registry.testing import check_env
      >>> check_env(sme_registry.SMESpec(horizon=5))
    """
    definition = materialize(load(task, SMESpec))
    _check_one(Schedule.of(definition), single, seed)
    _check_batch(Schedule.of(definition), single, vector, seed)
    _check_optimum(definition, single, definition.optimal_action, seed)


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
    schedule = Schedule(stream, materialize_segments(stream))
    _check_one(schedule, single, seed)
    _check_batch(schedule, single, vector, seed)


def check_team(task: SpecLike, *, parallel: Make = SMETeamEnv, seed: int = 0) -> None:
    """Check the PettingZoo environment of a team; see `check_env`, for each agent.

    An agent observes only its channels, and acting by its own layers on them has return T. A task
    without a team is a team of one. `parallel` creates the environment as `SMETeamEnv` does.

    Examples:
      >>> from sme_registry.testing import check_team
      >>> check_team(sme_registry.load("Team2").derive(horizon=5))
    """
    definition = materialize(load(task, SMESpec))

    def act(s: Array) -> Array:
        """Each agent's layers, over a state of which the others' channels are unknown."""
        joint, channel = [], np.arange(len(s))
        for agent, observed in enumerate(definition.observed):
            known = np.where(np.isin(channel, observed), s, agent / 7.0)
            joint.append(definition.optimal_action(known)[definition.owned[agent]])
        return np.concatenate(joint)

    _check_one(Schedule.of(definition), parallel, seed)
    _check_optimum(definition, parallel, act, seed)


class _Agents:
    """An environment as one of a team: a single agent is a team of one, without a name."""

    def __init__(self, env: Any) -> None:
        self.env, self.is_team = env, hasattr(env, "possible_agents")
        self.names = tuple(env.possible_agents) if self.is_team else ("",)
        space = env.action_space(self.names[0]) if self.is_team else env.action_space
        self.symmetric = bool(space.low.flat[0] < 0.0)

    @property
    def state(self) -> Array:
        return cast(Array, self.env.state() if self.is_team else self.env.state)

    def optimal(self) -> Array:
        """π* in the current state; in a batch, of the task in force in each environment."""
        if hasattr(self.env, "num_envs"):
            pairs = zip(self.env.get_attr("task"), self.env.state, strict=True)
            return np.stack([task.optimal_action(s) for task, s in pairs])
        return cast(Array, self.env.task.optimal_action(self.state))

    def action(self, unit: npt.NDArray[Any]) -> Any:
        """Joint actions of the unit range as the environment's `step` takes them."""
        joint = from_unit(unit, self.symmetric)
        if not self.is_team:
            return joint
        owned = zip(self.names, self.env.task.owned, strict=True)
        return {name: joint[channels] for name, channels in owned}

    def unit(self, action: Any) -> Array:
        """The other way round, as the environment rescales them."""
        joint = np.concatenate([*action.values()]) if self.is_team else action
        unit: Array = joint.astype(np.float64)
        return (unit + 1.0) / 2.0 if self.symmetric else unit

    def by_agent(self, returned: Any) -> Any:
        """What a reset or a step returned, each part by agent."""
        return returned if self.is_team else [{"": part} for part in returned]


def _check_one(schedule: Schedule, make: Make, seed: int) -> None:
    """Lives, determinism and copies of a single environment, or of a team's."""
    document = schedule.document
    for action_range, life in itertools.product(ACTION_RANGES, range(2)):
        _Life(make(document, action_range=action_range), schedule, seed + life)
    first, second, other = (play(make(document), start, seed) for start in (seed, seed, seed + 1))
    expect_same("two runs of one seed", first, second)
    if all(map(np.array_equal, *map(_arrays, (first[0], other[0])))):
        raise ConformanceError(f"Seeds {seed} and {seed + 1} start at the same observation.")
    env = make(document)
    kind = "team" if _Agents(env).is_team else "single environment"
    _check_copies(kind, env, document.horizon, seed)


class _Life:
    """A life of an environment, or of a task, each step of which must equal `task.step`."""

    def __init__(self, env: Any, schedule: Schedule, seed: int) -> None:
        self.agents, self.env, self.schedule = _Agents(env), env, schedule
        self.rng, self.lifetime, self.segment = np.random.default_rng(seed), 0, 0
        self.at_switch = 0.0  # what a switch added to the last step's shaping
        self.written: list[npt.NDArray[Any]] = []
        episode_seed: int | None = seed
        while self.lifetime < _steps(schedule):
            self._begin(episode_seed)
            episode_seed, ended = None, False
            while not ended and (schedule.is_stream or self.lifetime < _steps(schedule)):
                ended = self._step()

    @property
    def task(self) -> Task:
        return self.schedule.tasks[self.segment]

    def _of_life(self) -> dict[str, Any]:
        phase = np.int64(self.schedule.phases[self.segment])
        return self.schedule.life(phase, np.int64(self.lifetime))

    def _begin(self, seed: int | None) -> None:
        self.segment, self.t = self.schedule.times.segment_at(self.lifetime), 0
        observations, info = self.agents.by_agent(self.env.reset(seed=seed))
        expect_equal("the agents of infos at reset", tuple(info), self.agents.names)
        for name, owned in zip(info, self.task.owned, strict=True):
            at_reset = self.schedule.columns.at_reset(owned.stop - owned.start)
            expect_same(f"{_of(name)}info at reset", info[name], at_reset | self._of_life())
        self.r_cum = np.zeros((1, len(info)))
        self._check_observations("first observation", observations)

    def _step(self) -> bool:
        task, s, d = self.task, self.agents.state, getattr(self.env, "distractors", _NONE)
        action = next_action(self.env, self.rng)
        unit = self.agents.unit(action)
        noise = self.env.noise if task.spec.noise is not None else None
        noise = None if noise is None else np.atleast_2d(noise)
        result = step(task, s[None], np.array([self.t]), self.r_cum, unit[None], noise)
        returned = self.agents.by_agent(self.env.step(action))
        self.lifetime, self.t = self.lifetime + 1, self.t + 1
        expect_equal("the next state", self.agents.state, result.state[0])
        within = self.schedule.switches_within
        later = self.schedule.times.segment_at(self.lifetime) if within else self.segment
        after = self.schedule.tasks[later]
        self.at_switch = shaping_at_switch(task, after, self.agents.state, self.t)
        for agent, name in enumerate(self.agents.names):
            self._check_agent(agent, result, *(part[name] for part in returned[1:]))
        observations, info, ended = returned[0], returned[4], has_ended(returned)
        if task.spec.dynamics == "driven":
            expect_equal("distractors", self.env.distractors, task.distractor_step(d, unit))
        self.segment = later
        expect_equal("the task in force", self.env.sme_spec, self.task.spec)
        self.r_cum = np.array([[one["accumulated_reward"] for one in info.values()]])
        self._check_observations("observation", observations)
        if self.agents.is_team:
            expect_equal("the agents, once the episode has ended", not self.env.agents, ended)
        keys = itertools.product(info.values(), self.schedule.columns.actions)
        self._write([*observations.values(), *(one[key] for one, key in keys)])
        return ended

    def _write(self, arrays: list[npt.NDArray[Any]]) -> None:
        """Overwrite what was returned: it is the user's."""
        before = self.written[-3 * len(arrays) :]
        if any(np.shares_memory(*pair) for pair in itertools.product(arrays, before)):
            raise ConformanceError("A later step reuses an array that `step` returned.")
        for array in arrays:
            array[:] = -7.0
        self.written += arrays

    def _check_agent(
        self,
        agent: int,
        result: Step,
        reward: float,
        terminated: bool,
        truncated: bool,
        info: dict[str, Any],
    ) -> None:
        owned, where = self.task.owned[agent], _of(self.agents.names[agent])
        self._check_info(where, info, owned.stop - owned.start)
        for key in self.schedule.columns.actions:
            action = from_unit(getattr(result, key)[0, owned], self.agents.symmetric)
            expect_near(f"{where}{key}", info[key], action)
        expect_equal(f"{where}regret", info["regret"], 1.0 - info["step_reward"])
        spec = self.task.spec
        summed = spec.horizon * TOLERANCE
        tolerances = {"reward": summed, "accumulated_reward": summed, "safe_regret": 1e-11}
        tolerances["cost"] = TOLERANCE / max(spec.tightness, TOLERANCE)
        for key, value in {"reward": reward, **info}.items():
            if key in NUMBERS:
                number = getattr(result, key)[0, agent]
                if key in ("reward", "shaping") and not (terminated or truncated):
                    number = number + self.at_switch
                expect_near(f"{where}the {key}", value, number, tolerances.get(key, TOLERANCE))
        expect_equal(f"{where}terminated", terminated, bool(result.terminated[0]))
        expect_equal(f"{where}truncated", truncated, bool(result.truncated[0]))

    def _check_info(self, where: str, info: dict[str, Any], width: int) -> None:
        """The keys, types and ranges of a step's info, and where it is in a life."""
        _, numbers, arrays = self.schedule.columns
        life, low = self._of_life(), -1.0 if self.agents.symmetric else 0.0
        expect_equal(f"{where}info's keys", set(info), {*numbers, *arrays, *life})
        expect_same(f"{where}where in a life", {key: info[key] for key in life}, life)
        for key in arrays:
            value = info[key]
            expect_same(f"{where}{key}'s type", np.zeros_like(value), np.zeros(width))
            if not ((value >= low) & (value <= 1.0)).all():
                raise ConformanceError(f"{where}{key}={value}: outside the action range.")
        for key in numbers:
            paid = key in ("shaping", "reward_noise")
            bottom = -np.inf if paid else -1.0 if key == "safe_regret" else 0.0
            top = np.inf if paid or key == "accumulated_reward" else 1.0
            if not (isinstance(info[key], np.float64) and bottom <= info[key] <= top):
                raise ConformanceError(
                    f"{where}{key}={info[key]!r}: must be a float64 in [{bottom}, {top}]."
                )

    def _check_observations(self, what: str, observations: dict[str, Any]) -> None:
        """Agents see their part of M(s, d), t/T, r_cum/k, and a shown phase's one-hot."""
        task, s = self.task, self.agents.state
        d = getattr(self.env, "distractors", _NONE)
        expect_equal("the shape of the distractors", d.shape, (task.spec.distractors,))
        if not ((d >= 0.0) & (d <= 1.0)).all():
            raise ConformanceError(f"distractors={d}: outside [0, 1].")
        rest = observe(task.spec, s[None], np.array([self.t]), self.r_cum)[0, len(s) :]
        one_hot = self.schedule.one_hot(int(self.schedule.phases[self.segment]))
        joint = np.concatenate([task.seen(s, d).astype(np.float32), rest, one_hot])
        columns: Any = observed_columns(task) if self.agents.is_team else [slice(None)]
        for name, part in zip(self.agents.names, columns, strict=True):
            tolerance = _FLOAT32_ROUNDING if task.mixing else 0.0
            expect_near(f"{_of(name)}the {what}", observations[name], joint[part], tolerance)


def _steps(schedule: Schedule) -> int:
    document = schedule.document
    if isinstance(document, StreamSpec):
        return min(document.steps + document.horizon, _LONGEST_LIFE)
    return _MAX_STEPS


def _of(name: str) -> str:
    return name and f"{name}: "


def _check_optimum(task: Task, make: Make, act: Callable[[Array], Array], seed: int) -> None:
    """A policy from states to joint actions reaches the horizon T without regret, with return T."""
    spec = task.spec.derive(horizon=min(task.spec.horizon, _LONGEST_HORIZON))
    for action_range in ACTION_RANGES:
        agents = _Agents(make(spec, action_range=action_range))
        agents.env.reset(seed=seed)
        returns, steps, ended = dict.fromkeys(agents.names, 0.0), 0, False
        while not ended:
            returned = agents.env.step(agents.action(act(agents.state)))
            steps, ended = steps + 1, has_ended(returned)
            _, rewards, _, _, info = agents.by_agent(returned)
            for name, reward in rewards.items():
                expect_near(f"{_of(name)}the optimum's regret", info[name]["regret"], 0.0, 1e-9)
                on_top = sum(info[name].get(key, 0.0) for key in ON_TOP)
                returns[name] += float(reward) - on_top
        expect_equal("the optimum's steps", steps, spec.horizon)
        for name, total in returns.items():
            what = f"{_of(name)}the optimum's return"
            expect_near(what, total, spec.horizon, 1e-9 * spec.horizon)


def _check_copies(kind: str, env: Any, horizon: int, seed: int) -> None:
    """Pickled and deep copies taken in mid-episode continue as the original does."""
    agents = _Agents(env)
    env.reset(seed=seed)
    if horizon > 1:
        env.step(agents.action(agents.optimal()))
    before = np.copy(agents.state)
    copies = {"a pickled copy": pickle.loads(pickle.dumps(env)), "a deep copy": copy.deepcopy(env)}
    played = {}
    for how, twin in copies.items():
        played[how] = play(twin, None, seed, in_progress=True)
        expect_equal(f"the state, after stepping {how} of the {kind}", agents.state, before)
    original = play(env, None, seed, in_progress=True)
    for how, returned in played.items():
        expect_same(f"{how} of the {kind}", returned, original)


def _check_batch(schedule: Schedule, single: Make, vector: Make, seed: int) -> None:
    """A batch equals what Gymnasium's `SyncVectorEnv` of single environments returns."""
    document, num_envs = schedule.document, 3
    batch = vector(document, num_envs, autoreset_mode=AutoresetMode.NEXT_STEP.value)
    _check_copies("vector environment", batch, document.horizon, seed)
    steps = _steps(schedule) if schedule.is_stream else min(document.horizon + 5, _MAX_STEPS)
    for mode, action_range in itertools.product(AutoresetMode, ACTION_RANGES):
        batch = vector(document, num_envs, action_range=action_range, autoreset_mode=mode.value)
        make = functools.partial(single, document, action_range=action_range)
        singles: Any = SyncVectorEnv([make] * num_envs, autoreset_mode=mode)
        rng = np.random.default_rng(seed)
        where = f"autoreset mode {mode.value}, {action_range}"
        expect_same_values(f"{where}: reset", batch.reset(seed=seed), singles.reset(seed=seed))
        resting = np.zeros(num_envs, bool)
        for t in range(1, steps + 1):
            action = next_action(batch, rng)
            returned = batch.step(action)
            expect_same_values(f"{where}: step {t}", returned, singles.step(action))
            ended = returned[2] | returned[3]
            began = {"NextStep": resting, "SameStep": ended}.get(mode.value, resting & False)
            expect_equal(f"{where}: step {t}: _regret", returned[4]["_regret"], ~began)
            resting = ended
            if mode is AutoresetMode.DISABLED and ended.any():
                # Each is passed its own dictionary, since Gymnasium removes the mask from it.
                first, second = (
                    envs.reset(options={"reset_mask": ended}) for envs in (batch, singles)
                )
                expect_same_values(f"{where}: reset after step {t}", first, second)


def expect_same_values(what: str, got: Any, expected: Any) -> None:
    """`expect_same` of two vectors, whose masks differ: singles cannot say that a value is none."""
    both = [
        (*rest, {key: info[key] for key in info if key[0] != "_" or key.startswith("_final")})
        for *rest, info in (got, expected)
    ]
    expect_same(what, *both)


def play(env: Any, reset_seed: int | None, seed: int, *, in_progress: bool = False) -> list[Any]:
    """Everything that two whole episodes return; the second continues the environment's stream.

    With `in_progress`, the first is the current episode, played to its end.
    """
    rng, agents = np.random.default_rng(seed), _Agents(env)
    returned: list[Any] = []
    for episode_seed in (reset_seed, None):
        if not in_progress:
            returned += env.reset(seed=episode_seed)
        in_progress = False
        for _ in range(_MAX_STEPS):
            one_step = env.step(next_action(env, rng))
            returned += [*one_step, agents.state]
            if has_ended(one_step):
                break
    return returned


def _arrays(observation: Any) -> list[Any]:
    return list(observation.values()) if isinstance(observation, dict) else [observation]


def has_ended(returned: Any) -> bool:
    """Whether a step ended the episode, a team's if for all agents; a batch goes on."""
    terminated, truncated = map(_arrays, returned[2:4])
    ended = np.logical_or(terminated, truncated)  # `[1]`, of a team `[n]`, of a batch `[1, B]`
    return ended.ndim == 1 and bool(ended.all())


def mixed_actions(optimal: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Actions of the unit range between optimal and random ones, some slightly outside of it."""
    shape = optimal.shape
    share = rng.uniform(0.0, 0.5, (*shape[:-1], 1))
    mixed: Array = (1 - share) * optimal + share * rng.uniform(-0.1, 1.1, shape)
    return mixed.astype(np.float32)


def next_action(env: Any, rng: np.random.Generator) -> Any:
    """`mixed_actions` in the current state, in the form that the environment's `step` takes."""
    agents = _Agents(env)
    return agents.action(mixed_actions(agents.optimal(), rng))


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
    expect_equal(f"{what}: its shape", np.shape(got), np.shape(expected))
    difference = float(np.max(np.abs(np.asarray(got) - np.asarray(expected)), initial=0.0))
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
    else:
        if isinstance(got, np.ndarray | np.generic):
            expect_equal(f"{what}: type", type(got), type(expected))
            expect_equal(f"{what}: dtype", got.dtype, expected.dtype)
        expect_equal(what, got, expected)

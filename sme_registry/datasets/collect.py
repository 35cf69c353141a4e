"""`collect`: generate the `Transitions` of a recipe, many episodes at once.

    mixture of ν:  a = (1 − α) π*(s) + α ã(s),   α ~ U(0, ν), one draw for each step
    random:        a ~ U([0, 1]^A)
    policy:        the user's, deterministic

Source: METHOD, section 4. ã is a second Deep Uniform Network of the same shape as π* (for a team
one for each agent, on what it observes), drawn from the data's seed; one α mixes all channels.

Episode e of a behaviour does not depend on what runs next to it: its start, each α and its actions
come from its own part of named streams, and π* and ã are evaluated by the compiled step, whose bits
do not depend on the number of lanes. A user's policy is called in blocks of one size, so that its
network always multiplies matrices of the same shape. A data set is the first N rows of episodes
0, 1, 2, …. `B` lanes, `S` state_dim, `A` action_dim, `n` agents, `m` distractors, T horizon.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.arrays import (
    COST,
    REGRET,
    REWARD,
    SAFE_REGRET,
    SIMILARITY,
    STEP_REWARD,
    Array,
    Indices,
    Mask,
    Observation,
)
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.transitions import Transitions
from sme_registry.envs.batch import Batch
from sme_registry.errors import OptionError
from sme_registry.evaluation import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.regions import expansion
from sme_registry.evaluation.rollouts import play
from sme_registry.spec import SMESpec
from sme_registry.task import Task, draw
from sme_registry.task.draw import bit_generator, to_uniform
from sme_registry.task.loading import check_memory

ReportProgress = Callable[[int, int], None]

NOISE_STREAM = "dataset/noise"
_AHEAD = 64  # steps whose random numbers an episode reads at once
_BLOCK = 64  # observations in one call of a user's policy


def noise_task(task: Task, seed: int | str) -> Task:
    """The task whose optimal policy is ã: of the same shape, drawn from the data's seed."""
    policies = draw.optimal_policies(task.spec.derive(seed=seed), NOISE_STREAM)
    return replace(task, policies=policies)


class OptimalPolicy:
    """π* as a function from states `[B, S]` to `[B, A]`, with the same bits in any batch."""

    def __init__(self, task: Task, lanes: int) -> None:
        # The same π* without limits and distractors, which take time.
        spec = task.spec.derive(safety=None, observation=None)
        plain = replace(task, spec=spec, limiting=(), distractor_transition=None, mixing=())
        self._batch = Batch(plain, lanes, reuse=True)
        self._lanes = np.arange(lanes)
        self._observation = self._batch.observe()
        self._no_action = np.zeros((lanes, task.spec.action_dim))

    def __call__(self, s: Array) -> Array:
        """π*(s); the next call but one overwrites it."""
        self._batch.begin(self._lanes, self._observation, s)
        return self._batch.advance(self._no_action).optimal


class EpisodeStream:
    """Uniform numbers of a named stream, `width` a step, a separate part of it for each episode.

    Episode e reads from word 4 · 2¹²⁸ e onwards, so its numbers do not depend on its lane or on the
    other episodes. Each lane reads those of `ahead` steps at once.
    """

    def __init__(
        self, seed: int | str, name: str, lanes: int, width: int, ahead: int = _AHEAD
    ) -> None:
        self._seed, self._name = seed, name
        self._generators: list[np.random.Philox | None] = [None] * lanes
        self._drawn = np.zeros((lanes, ahead, width))
        self._used = np.full(lanes, ahead)
        self._lanes = np.arange(lanes)

    def begin(self, lane: int, episode: int) -> None:
        generator = bit_generator(self._seed, self._name)
        generator.advance(episode << 128)
        self._generators[lane] = generator
        self._used[lane] = self._drawn.shape[1]

    def next(self, lanes: npt.NDArray[np.int64] | None = None) -> Array:
        """The next numbers of these lanes (None: all), `[len(lanes), width]` in (0, 1)."""
        lanes = self._lanes if lanes is None else lanes
        _, ahead, width = self._drawn.shape
        for lane in lanes[self._used[lanes] == ahead].tolist():
            generator = self._generators[lane]
            assert generator is not None  # `begin` comes first
            self._drawn[lane] = to_uniform(generator.random_raw(ahead * width)).reshape(ahead, -1)
            self._used[lane] = 0
        numbers: Array = self._drawn[lanes, self._used[lanes]]
        self._used[lanes] += 1
        return numbers


@dataclass(frozen=True)
class BehaviourPolicy:
    """A policy that acts in all lanes: actions `[B, A]` for states `[B, S]` and joint observations.

    `stream` has the random numbers that it uses; it is None if the policy is deterministic.
    """

    act: Callable[[Array, Observation], Array]
    stream: EpisodeStream | None = None

    def begin(self, lane: int, episode: int) -> None:
        if self.stream is not None:
            self.stream.begin(lane, episode)


def behaviour_policy(
    recipe: DatasetRecipe,
    index: int,
    task: Task,
    lanes: int,
    policy: Any = None,
    stream: str = "dataset",
) -> BehaviourPolicy:
    """The policy of a recipe's behaviour with this index; `policy` is the user's, for its kind."""
    behaviour, name = recipe.behaviours[index], f"{stream}/{index}"
    if behaviour.nu is not None:
        return _mixture(task, recipe.seed, behaviour.nu, name, lanes)
    if behaviour.kind == "random":
        actions = EpisodeStream(recipe.seed, f"{name}/action", lanes, task.spec.action_dim)
        return BehaviourPolicy(lambda s, observation: actions.next(), actions)
    prepared = as_policy(
        policy, recipe.spec, action_range=behaviour.action_range, name=behaviour.policy
    )
    return BehaviourPolicy(lambda s, observation: _actions(prepared, observation))


def constant_policy(task: Task) -> BehaviourPolicy:
    """a = ½ in every channel."""
    return BehaviourPolicy(lambda s, observation: np.full((len(s), task.spec.action_dim), 0.5))


def _mixture(task: Task, seed: int | str, nu: float, name: str, lanes: int) -> BehaviourPolicy:
    optimal = OptimalPolicy(task, lanes)
    noise = OptimalPolicy(noise_task(task, seed), lanes) if nu > 0.0 else None
    stream = EpisodeStream(seed, f"{name}/alpha", lanes, 1)

    def act(s: Array, observation: Observation) -> Array:
        if noise is None:
            return optimal(s)
        alpha = nu * stream.next()
        return (1.0 - alpha) * optimal(s) + alpha * noise(s)

    return BehaviourPolicy(act, stream)


def _actions(policy: Policy | TeamPolicy, observation: Observation) -> Array:
    """A user's actions `[B, A]` for joint observations, clipped as the environment clips them."""
    if isinstance(policy, Policy):
        return np.clip(_in_blocks(policy, observation), 0.0, 1.0)
    shared = observation.shape[1] - len(policy.members)  # s and t/T; then each agent's r_cum/k
    joint = []
    for agent, member in enumerate(policy.members):
        single = observation[:, [*range(shared), shared + agent]]
        acted = _in_blocks(member.policy, member.observe(single))
        joint.append(acted[:, : member.action_dim])
    return np.clip(np.concatenate(joint, axis=1), 0.0, 1.0)


def _in_blocks(policy: Callable[[Observation], Array], observation: Observation) -> Array:
    """The policy's actions, in calls of one size; the last row pads the last block."""
    rows = len(observation)
    missing = -rows % _BLOCK
    filled = np.concatenate([observation, np.repeat(observation[-1:], missing, axis=0)])
    blocks = [policy(filled[first : first + _BLOCK]) for first in range(0, len(filled), _BLOCK)]
    return np.concatenate(blocks)[:rows]


_LANES = 512
_MAX_STEPS = 10**8  # of the environment; a sub-cube that needs more is too small


class Rows(NamedTuple):
    """`M` transitions as arrays."""

    episode: npt.NDArray[np.int64]  # `[M]` index of the episode of its behaviour
    t: npt.NDArray[np.int64]  # `[M]` steps of the episode before this one
    state: Array  # `[M, S]`
    next_state: Array
    observation: Observation  # `[M, S + m + 1 + n]`
    next_observation: Observation
    action: npt.NDArray[np.float32]  # `[M, A]`
    optimal: Array  # `[M, A]`
    values: Array  # `[M, 5, n]` the rows of `compiled.arrays`; with `safety` 7
    limits: Array  # `[M, 2, A]` the limits and the safe action; without `safety` `[M, 2, 0]`
    distractors: Array  # `[M, m]`
    next_distractors: Array
    terminated: Mask  # `[M]` as the task ends episodes
    truncated: Mask


def collect(
    recipe: DatasetRecipe,
    task: Task,
    policies: dict[int, Any] | None = None,
    *,
    lanes: int | None = None,
    progress: ReportProgress | None = None,
) -> Transitions:
    """Generate the transitions of a recipe, one behaviour after another.

    `task` is the recipe's, materialised; `policies` are the user's by the index of their behaviour.
    `lanes` episodes run at once (at most 512 by default); the numbers do not depend on it.
    `progress` is called after each step with the transitions collected and their total.

    Examples:
      >>> from sme_registry.datasets import DatasetRecipe, collect
      >>> recipe = DatasetRecipe(
      ...     spec=sme_registry.load("Default"),
      ...     behaviours=[{"kind": "mixture", "nu": 0.5}],
      ...     transitions=100,
      ... )
      >>> collect(recipe, sme_registry.materialize(recipe.spec)).actions.shape
      (100, 4)
    """
    spec = recipe.spec
    S, A, n, m = spec.state_dim, spec.action_dim, len(task.policies), spec.distractors
    row = 24 * (S + m) + 12 * A + 48 * n + 64
    if spec.safety is not None:
        row += 16 * A + 16
    with_distractors = f", {m} distractors" if m else ""
    check_memory(
        3 * recipe.transitions * row,
        f"transitions={recipe.transitions}: a data set of state_dim={S}, action_dim={A}"
        f"{with_distractors}",
        "Collect fewer, or several data sets with different seeds.",
    )
    kept_share = max(1e-300, (1.0 + (recipe.coverage or 0.0)) ** S)  # of uniform states
    done = 0
    parts = []
    for index, share in enumerate(recipe.shares):
        expected = share / kept_share
        if expected > _MAX_STEPS and recipe.coverage:
            raise _too_small(recipe, f"{share:,} transitions need about {expected:.1g} steps")
        num_lanes = lanes or min(_LANES, math.ceil(expected / spec.horizon))
        policy = behaviour_policy(recipe, index, task, num_lanes, (policies or {}).get(index))

        def report(count: int, before: int = done) -> None:
            if progress is not None:
                progress(before + count, recipe.transitions)

        starts = EpisodeStream(recipe.seed, f"dataset/{index}/start", num_lanes, S, ahead=1)
        steps = BehaviourEpisodes(task, policy, starts, num_lanes).rows()
        parts.append(_first_rows(steps, recipe, share, max(10**6, 20 * expected), report))
        done += share
    return _concatenate(parts, spec)


class BehaviourEpisodes:
    """Episodes 0, 1, 2, … of a behaviour in a batch, each in the first lane that is free.

    The first numbers of an episode in `starts` are its initial state, which determines its
    distractors, too.
    """

    def __init__(
        self, task: Task, policy: BehaviourPolicy, starts: EpisodeStream, lanes: int
    ) -> None:
        self._policy, self._starts, self._numbers = policy, starts, itertools.count()
        self.batch = Batch(task, lanes)
        self.episode, self.t = np.zeros((2, lanes), np.int64)
        self.begin(np.arange(lanes), self.batch.observe())

    def begin(self, lanes: Indices, observation: Observation) -> None:
        """Begin the next episodes in these lanes."""
        for lane in lanes.tolist():
            number = self.episode[lane] = next(self._numbers)
            self._starts.begin(lane, number)
            self._policy.begin(lane, number)
        self.t[lanes] = 0
        initial = self._starts.next(lanes)
        self.batch.seed_by_states(lanes, initial)
        self.batch.begin(lanes, observation, initial)

    def act(self, s: Array, observation: Observation) -> npt.NDArray[np.float32]:
        """The behaviour's actions, exactly as the data set stores them: float32 in [0, 1]."""
        return np.clip(self._policy.act(s, observation), 0.0, 1.0).astype(np.float32)

    def rows(self) -> Iterator[Rows]:
        """Steps of all lanes without end, whose arrays are valid until the next one."""
        for step in play(self.batch, self.act, self.begin):
            done = step.result
            yield Rows(
                self.episode, self.t, step.state, self.batch.state, step.observation,
                done.observation, step.action, done.optimal, done.values.transpose(2, 0, 1),
                done.limits.transpose(1, 0, 2), step.distractors, self.batch.distractors,
                done.terminated, done.truncated,
            )  # fmt: skip
            self.t += 1


def _first_rows(
    steps: Iterator[Rows],
    recipe: DatasetRecipe,
    rows: int,
    patience: float,
    progress: Callable[[int], None],
) -> Rows:
    """The first `rows` transitions by episode and step whose states are in the sub-cube."""
    collected, taken, coverage = _Collected(rows), 0, recipe.coverage
    for step in steps:
        lanes = len(step.t)
        kept = np.ones(lanes, bool) if coverage is None else expansion(step.state) <= coverage
        collected.add(Rows._make(column[kept] for column in step))
        taken += lanes
        progress(min(rows, collected.count))
        running = step.episode[~(step.terminated | step.truncated)]
        if collected.complete(int(running.min(initial=step.episode.max() + 1))):
            break
        if taken > patience and collected.count < rows:
            raise _too_small(recipe, f"{taken:,} steps gave {collected.count:,} transitions")
    return collected.rows()


def _too_small(recipe: DatasetRecipe, reason: str) -> OptionError:
    return OptionError(
        f"coverage={recipe.coverage}: {reason}: must be closer to 0 for this state_dim (it keeps a "
        "fraction (1 + ε)^S of uniform states). Give a larger value, or fewer transitions."
    )


class _Collected:
    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._parts: list[Rows] = []
        self._rows_of = np.zeros(1024, np.int64)  # by episode
        self._first_running, self._settled = 0, 0
        self.count = 0

    def add(self, rows: Rows) -> None:
        self._parts.append(rows)
        last = int(rows.episode.max(initial=0))
        if last >= len(self._rows_of):
            self._rows_of = np.pad(self._rows_of, (0, last))
        self._rows_of[rows.episode] += 1
        self.count += len(rows.t)

    def complete(self, first_running: int) -> bool:
        """Whether no later episode than the first running one can contribute a wanted row."""
        self._settled += int(self._rows_of[self._first_running : first_running].sum())
        self._first_running = first_running
        running = int(self._rows_of[first_running : first_running + 1].sum())
        return self._settled + running >= self._wanted

    def rows(self) -> Rows:
        episode = np.concatenate([part.episode for part in self._parts])
        t = np.concatenate([part.t for part in self._parts])
        first = np.lexsort((t, episode))[: self._wanted]
        return Rows._make(
            np.concatenate(columns)[first] for columns in zip(*self._parts, strict=True)
        )


def _concatenate(parts: list[Rows], spec: SMESpec) -> Transitions:
    """The rows of all behaviours as one data set, its trajectories numbered from 0."""
    rows = Rows._make(np.concatenate(columns) for columns in zip(*parts, strict=True))
    component = np.repeat(np.arange(len(parts)), [len(part.t) for part in parts])
    # A trajectory ends where the next row is not its next step.
    ends = np.ones(len(rows.t), bool)
    ends[:-1] = (
        (component[1:] != component[:-1])
        | (rows.episode[1:] != rows.episode[:-1])
        | (rows.t[1:] != rows.t[:-1] + 1)
    )
    team = spec.team is not None

    def of_row(row: int) -> Array:
        values = rows.values[:, row]
        return values.copy() if team else values[:, 0].copy()

    reward = rows.values[:, REWARD]
    extension: dict[str, Array] = {}
    if spec.safety is not None:
        limits, safe_actions = np.moveaxis(rows.limits, 1, 0)
        extension |= {"costs": of_row(COST), "safe_regrets": of_row(SAFE_REGRET)}
        extension |= {"limits": limits.copy(), "safe_actions": safe_actions.copy()}
    if spec.distractors:
        extension["distractors"] = rows.distractors
        extension["next_distractors"] = rows.next_distractors
    return Transitions(
        observations=rows.observation,
        actions=rows.action,
        rewards=reward.mean(axis=1),
        next_observations=rows.next_observation,
        terminations=rows.terminated,
        timeouts=ends & ~rows.terminated,
        optimal_actions=rows.optimal,
        regrets=of_row(REGRET),
        similarities=of_row(SIMILARITY),
        step_rewards=of_row(STEP_REWARD),
        states=rows.state,
        next_states=rows.next_state,
        episodes=np.concatenate([[0], np.cumsum(ends)[:-1]]).astype(np.int64),
        components=component.astype(np.int64),
        agent_rewards=reward.copy() if team else None,
        **extension,
    )

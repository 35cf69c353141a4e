"""From a recipe to `Transitions`: many episodes of one task side by side, on the native batch.

Episode e of a behaviour is the same whatever runs beside it: its start, each α and its actions are
of its own part of named streams, and lanes are bit-equal to single environments. So the number of
lanes changes the time and not the numbers. A set is the first N rows of episodes 0, 1, 2, …, cut
where N is reached. `B` lanes, `S` state_dim, `A` action_dim, `n` agents, T horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import Transitions, agents_of
from sme_registry.datasets.behaviour import Actor, EpisodeStream, actor
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.envs.batch import Batch
from sme_registry.errors import OptionError
from sme_registry.evaluation.regions import expansion
from sme_registry.task import Task
from sme_registry.task.draw import Array
from sme_registry.task.memory import refuse_above_limit

Progress = Callable[[int, int], None]

_LANES = 512
_STEPS = 10**8  # of the environment, beyond which a sub-cube is too small to be collected in


class Rows(NamedTuple):
    """Transitions as they were made, `M` of them; `[M]` where no shape is given.

    Attributes:
      episode, t: which episode of its behaviour, and steps done before this one.
      state, next_state: `[M, S]`.
      observation, next_observation: `[M, S + 1 + n]` float32.
      action: `[M, A]` float32.
      optimal: `[M, A]`.
      values: `[M, 4, n]` similarity, step reward, regret, reward.
      terminated, truncated: by the task.
    """

    episode: npt.NDArray[np.int64]
    t: npt.NDArray[np.int64]
    state: npt.NDArray[np.float64]
    next_state: npt.NDArray[np.float64]
    observation: npt.NDArray[np.float32]
    next_observation: npt.NDArray[np.float32]
    action: npt.NDArray[np.float32]
    optimal: npt.NDArray[np.float64]
    values: npt.NDArray[np.float64]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]


def lanes_for(recipe: DatasetRecipe, share: int) -> int:
    """How many episodes to run at once: as many as there are to run, within reason."""
    per_episode = recipe.spec.horizon * _kept_share(recipe)
    return int(max(1, min(_LANES, -(-share // max(per_episode, 1e-6)))))


def _kept_share(recipe: DatasetRecipe) -> float:
    """The share of uniform states that lies in the recipe's sub-cube."""
    return float((1.0 + (recipe.coverage or 0.0)) ** recipe.spec.state_dim)


def collect(
    recipe: DatasetRecipe,
    task: Task,
    policies: dict[int, Any] | None = None,
    *,
    lanes: int | None = None,
    progress: Progress | None = None,
) -> Transitions:
    """Make the transitions of a recipe.

    Args:
      recipe: the recipe.
      task: its task, drawn.
      policies: by the index of their behaviour, those that are the user's.
      lanes: episodes at once; None takes `lanes_for`. The numbers do not depend on it.
      progress: called after each step with the transitions made and those wanted.

    Returns:
      Exactly `recipe.transitions` of them, behaviour after behaviour.

    Raises:
      OptionError: hardly any state lies in the sub-cube.
      ResourceLimitError: the set would not fit in memory.
      PolicyError, MissingDependencyError: a policy cannot be used.
    """
    spec = recipe.spec
    S, A, n = spec.state_dim, spec.action_dim, agents_of(spec)
    refuse_above_limit(
        3 * recipe.transitions * (24 * S + 12 * A + 48 * n + 64),
        f"transitions={recipe.transitions}: a set of state_dim={S}, action_dim={A}",
        "Make fewer, or several sets under different seeds.",
    )
    done = 0
    parts = []
    for index, share in enumerate(recipe.shares):
        wide = lanes or lanes_for(recipe, share)
        acting = actor(recipe, index, task, wide, (policies or {}).get(index))

        def made(count: int, before: int = done) -> None:
            if progress is not None:
                progress(before + count, recipe.transitions)

        rows = rollout(
            task,
            acting,
            EpisodeStream(recipe.seed, f"dataset/{index}/start", wide, S, ahead=1),
            wide,
            rows=share,
            coverage=recipe.coverage,
            made=made,
        )
        parts.append(rows)
        done += share
    return _joined(parts, spec.team is not None)


def rollout(
    task: Task,
    acting: Actor,
    starts: EpisodeStream,
    lanes: int,
    *,
    rows: int,
    coverage: float | None = None,
    made: Callable[[int], None] | None = None,
) -> Rows:
    """The first `rows` transitions of episodes 0, 1, 2, … that are acted in the sub-cube.

    Args:
      task: the task.
      acting: who acts.
      starts: a state of each episode, as its first numbers.
      lanes: episodes at once.
      rows: how many to keep.
      coverage: ε of the sub-cube; None keeps all.
      made: called after each step with the rows that are there.

    Raises:
      OptionError: hardly any state lies in the sub-cube.
      PolicyError: who acts fails.
    """
    expected = rows / (1.0 + (coverage or 0.0)) ** task.spec.state_dim
    if expected > _STEPS and expected > rows:
        raise _too_small(coverage, f"of {rows:,} transitions, about {expected:.1g} steps are due")
    patience = max(10**6, 20 * expected)

    batch = Batch(task, lanes)
    every = np.arange(lanes)
    episode = np.zeros(lanes, np.int64)
    t = np.zeros(lanes, np.int64)
    observation = batch.observe()
    kept = _Kept(rows)

    def begin(ended: npt.NDArray[np.int64]) -> None:
        for lane in ended.tolist():
            episode[lane] = kept.new_episode()
            starts.begin(lane, int(episode[lane]))
            acting.begin(lane, int(episode[lane]))
        t[ended] = 0
        batch.begin(ended, observation, starts.next(ended))

    begin(every)
    s = batch.state
    steps = 0
    while not kept.enough:
        # What the environment is given is what the set holds: float32, in the unit range.
        action = np.clip(acting.act(s, observation), 0.0, 1.0).astype(np.float32)
        given = batch.advance(action.astype(np.float64))
        moved = batch.state
        inside = every if coverage is None else np.flatnonzero(expansion(s) <= coverage)
        kept.add(
            Rows(
                episode[inside],
                t[inside],
                s[inside],
                moved[inside],
                observation[inside],
                given.observation[inside],
                action[inside],
                given.optimal[inside],
                given.values[:4, :, inside].transpose(2, 0, 1),
                given.terminated[inside],
                given.truncated[inside],
            )
        )
        t += 1
        steps += lanes
        observation = given.observation
        ended = np.flatnonzero(given.terminated | given.truncated)
        if len(ended):
            kept.finish(episode[ended])
            begin(ended)
            s = batch.state
        else:
            s = moved
        if made is not None:
            made(min(rows, kept.count))
        if steps > patience and kept.count < rows:
            raise _too_small(coverage, f"{steps:,} steps gave {kept.count:,} transitions")
    return kept.rows()


def _too_small(coverage: float | None, found: str) -> OptionError:
    return OptionError(
        f"coverage={coverage}: {found}: must leave states that episodes pass through. Give one "
        "nearer to 0 (the share of uniform states that is kept is (1 + ε)^S), or fewer transitions."
    )


class _Kept:
    """The rows so far, and whether the first `wanted` of them, by episode and step, are there."""

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._parts: list[Rows] = []
        self._of_episode = np.zeros(1024, np.int64)
        self._finished = np.zeros(1024, bool)
        self._begun = 0
        self._first_running, self._settled = 0, 0
        self.count = 0

    def new_episode(self) -> int:
        """The number of the next episode."""
        if self._begun + 1 == len(self._finished):  # one more than has begun, never finished
            self._of_episode = np.concatenate([self._of_episode, np.zeros_like(self._of_episode)])
            self._finished = np.concatenate([self._finished, np.zeros_like(self._finished)])
        self._begun += 1
        return self._begun - 1

    def add(self, rows: Rows) -> None:
        """One step of the lanes that are kept; no episode twice."""
        self._parts.append(rows)
        self._of_episode[rows.episode] += 1
        self.count += len(rows.t)

    def finish(self, episodes: npt.NDArray[np.int64]) -> None:
        """These episodes are over."""
        self._finished[episodes] = True
        while self._finished[self._first_running]:
            self._settled += int(self._of_episode[self._first_running])
            self._first_running += 1

    @property
    def enough(self) -> bool:
        """Whether no episode that runs on, or is yet to come, can give one of the first rows."""
        return self._settled + int(self._of_episode[self._first_running]) >= self._wanted

    def rows(self) -> Rows:
        """The first `wanted` rows in order."""
        episode = np.concatenate([part.episode for part in self._parts])
        t = np.concatenate([part.t for part in self._parts])
        first = np.lexsort((t, episode))[: self._wanted]
        return Rows._make(
            np.concatenate(columns)[first] for columns in zip(*self._parts, strict=True)
        )


def _joined(parts: list[Rows], team: bool) -> Transitions:
    """The parts of all behaviours, their trajectories numbered through."""
    rows = Rows._make(np.concatenate(columns) for columns in zip(*parts, strict=True))
    component = np.repeat(np.arange(len(parts)), [len(part.t) for part in parts])
    # A trajectory ends where the next row is not its next step.
    ends = np.ones(len(rows.t), bool)
    ends[:-1] = (
        (component[1:] != component[:-1])
        | (rows.episode[1:] != rows.episode[:-1])
        | (rows.t[1:] != rows.t[:-1] + 1)
    )
    similarity, step_reward, regret, reward = np.moveaxis(rows.values, 1, 0)

    def own(values: Array) -> Array:
        return values.copy() if team else values[:, 0].copy()

    return Transitions(
        observations=rows.observation,
        actions=rows.action,
        rewards=reward.mean(axis=1),
        next_observations=rows.next_observation,
        terminations=rows.terminated,
        timeouts=ends & ~rows.terminated,
        optimal_actions=rows.optimal,
        regrets=own(regret),
        similarities=own(similarity),
        step_rewards=own(step_reward),
        states=rows.state,
        next_states=rows.next_state,
        episodes=np.concatenate([[0], np.cumsum(ends)[:-1]]).astype(np.int64),
        components=component.astype(np.int64),
        agent_rewards=reward.copy() if team else None,
    )

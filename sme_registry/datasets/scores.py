"""What a set's behaviour is worth, beside the policies that know nothing and everything.

On the set's own states the numbers are exact: π* is known there. By rollout they are means over
episodes of their own starts, with standard errors; the optimum's return is T, by construction. Of a
team every number is the mean over its agents.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.behaviour import Actor, Constant, EpisodeStream, actor
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.envs.batch import Batch
from sme_registry.spec import Integer, Real, StrictModel
from sme_registry.task import Task
from sme_registry.task.draw import Array

EPISODES = 100
_MAX_STEPS = 10**5  # of one reference's rollouts, over all its episodes

Share = Annotated[Real, Field(ge=0, le=1)]


class Rollouts(StrictModel):
    """Whole episodes of a policy.

    Attributes:
      episodes: how many; 0 where the number is exact without them.
      mean_return: mean sum of rewards, in [0, T].
      standard_error: of that mean, over episodes.
      similarity: mean r̃ over their steps.
    """

    episodes: Integer
    mean_return: Real
    standard_error: Real
    similarity: Share


class PolicyScore(StrictModel):
    """What one policy scores.

    Attributes:
      similarity, step_reward: mean r̃ and r over the set's own states.
      rollouts: over episodes of its own; null where the horizon is too long for them.
    """

    similarity: Share
    step_reward: Share
    rollouts: Rollouts | None


class ReferenceScores(StrictModel):
    """The references of a set.

    Attributes:
      constant: a = ½, the floor.
      behaviour: what acted in the set.
      behaviours: each of the recipe's behaviours, over the rows in which it acted.
      optimum: π*.
    """

    constant: PolicyScore
    behaviour: PolicyScore
    behaviours: Annotated[tuple[PolicyScore, ...], Field(strict=False)]
    optimum: PolicyScore


def reference_scores(
    recipe: DatasetRecipe,
    task: Task,
    transitions: Transitions,
    policies: dict[int, object] | None = None,
) -> ReferenceScores:
    """The scores of the set's behaviour, of a = ½, and of π*.

    Args:
      recipe: what the set was made from.
      task: its task.
      transitions: the set.
      policies: by the index of their behaviour, those that are the user's.
    """
    T = recipe.spec.horizon
    episodes = min(EPISODES, _MAX_STEPS // T)

    def rolled_out(acting: Actor, index: int) -> Rollouts | None:
        if episodes == 0:
            return None
        starts = EpisodeStream(
            recipe.seed, f"dataset/reference/{index}/start", episodes, task.spec.state_dim, ahead=1
        )
        return _rollouts(*play(task, acting, starts, episodes))

    behaviours = []
    for index in range(len(recipe.behaviours)):
        own = transitions.components == index
        acting = actor(
            recipe, index, task, max(1, episodes), (policies or {}).get(index), "dataset/reference"
        )
        behaviours.append(
            PolicyScore(
                similarity=_mean(transitions.similarities[own]),
                step_reward=_mean(transitions.step_rewards[own]),
                rollouts=rolled_out(acting, index),
            )
        )
    optimal = transitions.optimal_actions
    half = task.similarities_of(np.full_like(optimal, 0.5), optimal)
    paid_for = half
    if task.pays_the_team:  # for the mean over all channels, of which agents own unequal numbers
        paid_for = half @ np.array([own.stop - own.start for own in task.owned])
        paid_for = paid_for / recipe.spec.action_dim
    weights = [behaviour.weight for behaviour in recipe.behaviours]
    return ReferenceScores(
        constant=PolicyScore(
            similarity=_mean(half),
            step_reward=_mean(task.reward_of(paid_for)),
            rollouts=rolled_out(Constant(task, max(1, episodes)), 0),
        ),
        behaviour=PolicyScore(
            similarity=_mean(transitions.similarities),
            step_reward=_mean(transitions.step_rewards),
            rollouts=_weighted(weights, [score.rollouts for score in behaviours]),
        ),
        behaviours=tuple(behaviours),
        optimum=PolicyScore(
            similarity=1.0,
            step_reward=1.0,
            rollouts=Rollouts(episodes=0, mean_return=float(T), standard_error=0.0, similarity=1.0),
        ),
    )


def play(
    task: Task, acting: Actor, starts: EpisodeStream, lanes: int
) -> tuple[Array, Array, Array]:
    """One whole episode in each lane.

    Args:
      task: the task.
      acting: who acts.
      starts: a state of each episode.
      lanes: B, the episodes.

    Returns:
      `[B]` each: the return, the sum of r̃, and the steps; of a team the mean over its agents.
    """
    batch, every = Batch(task, lanes), np.arange(lanes)
    for lane in every.tolist():
        starts.begin(lane, lane)
        acting.begin(lane, lane)
    observation = batch.observe()
    batch.begin(every, observation, starts.next())
    running = np.ones(lanes, bool)
    sums = np.zeros((3, lanes))
    while running.any():
        action = np.clip(acting.act(batch.state, observation), 0.0, 1.0).astype(np.float32)
        given = batch.advance(action.astype(np.float64))
        similarity, reward = given.values[0].mean(axis=0), given.values[3].mean(axis=0)
        sums += running * np.stack([reward, similarity, np.ones(lanes)])
        running &= ~(given.terminated | given.truncated)
        observation = given.observation
    returns, similarities, steps = sums
    return returns, similarities, steps


def _rollouts(returns: Array, similarities: Array, steps: Array) -> Rollouts:
    count = len(returns)
    error = float(returns.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    return Rollouts(
        episodes=count,
        mean_return=_mean(returns),
        standard_error=error,
        similarity=min(1.0, float(similarities.sum() / steps.sum())),
    )


def _weighted(weights: list[float], scores: list[Rollouts | None]) -> Rollouts | None:
    """The mean over behaviours by their weights, as if each were a policy of its own."""
    known = [score for score in scores if score is not None]
    if len(known) < len(scores):
        return None
    if len(known) == 1:
        return known[0]
    pairs = list(zip(weights, known, strict=True))
    return Rollouts(
        episodes=sum(score.episodes for score in known),
        mean_return=math.fsum(w * score.mean_return for w, score in pairs),
        standard_error=math.sqrt(math.fsum((w * s.standard_error) ** 2 for w, s in pairs)),
        similarity=min(1.0, math.fsum(w * score.similarity for w, score in pairs)),
    )


def _mean(values: Array) -> float:
    return float(np.mean(values))

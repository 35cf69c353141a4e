"""Reference scores of a data set: of its behaviour, of the constant ½, and of the optimum.

On the data set's own states they are exact, because π* is known there. By rollouts they are means
over whole episodes with their own starts, with standard errors; the optimum's return is T by
construction. For a team every number is the mean over its agents.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from sme_registry.compiled.values import REWARD, SIMILARITY
from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.behaviour import (
    BehaviourPolicy,
    ConstantPolicy,
    EpisodeStream,
    behaviour_policy,
)
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.envs.batch import Batch
from sme_registry.spec import Integer, Real, StrictModel
from sme_registry.task import Task
from sme_registry.task.draw import Array

EPISODES = 100
_MAX_STEPS = 10**5  # of the rollouts of one policy, over all episodes

Share = Annotated[Real, Field(ge=0, le=1)]


class Rollouts(StrictModel):
    """Whole episodes of a policy.

    Attributes:
      episodes: their number; 0 if the values are exact without rollouts.
      mean_return: mean sum of rewards, in [0, T].
      standard_error: of that mean, over episodes.
      similarity: mean r̃ over all steps.
    """

    episodes: Integer
    mean_return: Real
    standard_error: Real
    similarity: Share


class PolicyScore(StrictModel):
    """The scores of one policy.

    Attributes:
      similarity, step_reward: mean r̃ and r over the data set's states.
      rollouts: over whole episodes; null if the horizon is too long for them.
    """

    similarity: Share
    step_reward: Share
    rollouts: Rollouts | None


class ReferenceScores(StrictModel):
    """The reference scores of a data set.

    Attributes:
      constant: of a = ½, the lower reference.
      behaviour: of the policies that collected the data set.
      behaviours: of each of the recipe's behaviours, over the rows in which it acted.
      optimum: of π*.
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
    """The scores of the data set's behaviour, of a = ½ and of π*.

    Args:
      recipe: of the data set.
      task: its task.
      transitions: the data set.
      policies: the user's policies, by the index of their behaviour.
    """
    T = recipe.spec.horizon
    episodes = min(EPISODES, _MAX_STEPS // T)

    def rollouts(policy: BehaviourPolicy, index: int) -> Rollouts | None:
        if episodes == 0:
            return None
        starts = EpisodeStream(
            recipe.seed, f"dataset/reference/{index}/start", episodes, task.spec.state_dim, ahead=1
        )
        return _rollouts(*play(task, policy, starts, episodes))

    behaviours = []
    for index in range(len(recipe.behaviours)):
        rows = transitions.components == index
        policy = behaviour_policy(
            recipe, index, task, max(1, episodes), (policies or {}).get(index), "dataset/reference"
        )
        behaviours.append(
            PolicyScore(
                similarity=_mean(transitions.similarities[rows]),
                step_reward=_mean(transitions.step_rewards[rows]),
                rollouts=rollouts(policy, index),
            )
        )
    similarity, step_reward = _constant_similarity_and_reward(task, transitions)
    weights = [behaviour.weight for behaviour in recipe.behaviours]
    return ReferenceScores(
        constant=PolicyScore(
            similarity=similarity,
            step_reward=step_reward,
            rollouts=rollouts(ConstantPolicy(task, max(1, episodes)), 0),
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


def _constant_similarity_and_reward(task: Task, transitions: Transitions) -> tuple[float, float]:
    """Mean r̃ and r of a = ½ on the data set's states."""
    optimal = transitions.optimal_actions
    similarity = task.similarities_of(np.full_like(optimal, 0.5), optimal)
    rewarded = similarity
    if task.pays_the_team:  # the mean over all channels, of which agents own unequal numbers
        channels = np.array([owned.stop - owned.start for owned in task.owned])
        rewarded = (similarity @ channels) / task.spec.action_dim
    return _mean(similarity), _mean(task.reward_of(rewarded))


def play(
    task: Task, policy: BehaviourPolicy, starts: EpisodeStream, lanes: int
) -> tuple[Array, Array, Array]:
    """Play one whole episode in each lane.

    Args:
      task: the task.
      policy: the policy that acts.
      starts: the first numbers of each episode are its initial state.
      lanes: B, the number of episodes.

    Returns:
      `[B]` each: return, sum of r̃, and number of steps; for a team the means over its agents.
    """
    batch, every = Batch(task, lanes), np.arange(lanes)
    for lane in every.tolist():
        starts.begin(lane, lane)
        policy.begin(lane, lane)
    observation = batch.observe()
    batch.begin(every, observation, starts.next())
    running = np.ones(lanes, bool)
    sums = np.zeros((3, lanes))
    while running.any():
        action = np.clip(policy.act(batch.state, observation), 0.0, 1.0).astype(np.float32)
        step = batch.advance(action.astype(np.float64))
        similarity = step.values[SIMILARITY].mean(axis=0)
        reward = step.values[REWARD].mean(axis=0)
        sums += running * np.stack([reward, similarity, np.ones(lanes)])
        running &= ~(step.terminated | step.truncated)
        observation = step.observation
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
    """The mean over behaviours by their weights; None if one is None."""
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

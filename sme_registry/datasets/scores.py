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
    EpisodeStream,
    behaviour_policy,
    constant_policy,
)
from sme_registry.datasets.collect import BehaviourEpisodes
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.evaluation.rollouts import play
from sme_registry.spec import Integer, Real, StrictModel, TupleOf
from sme_registry.task import Task
from sme_registry.task.draw import Array

EPISODES = 100
_MAX_STEPS = 10**5  # of the rollouts of one policy, over all episodes

Share = Annotated[Real, Field(ge=0, le=1)]


class Rollouts(StrictModel):
    """Whole episodes of a policy; 0 of them if the values are exact without rollouts.

    Attributes:
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
      similarity: mean r̃ over the data set's states.
      step_reward: mean r over them.
      rollouts: null if the horizon is too long for whole episodes.
    """

    similarity: Share
    step_reward: Share
    rollouts: Rollouts | None


class ReferenceScores(StrictModel):
    """The scores of a = ½, of the behaviour, of each of its policies on its rows, and of π*."""

    constant: PolicyScore
    behaviour: PolicyScore
    behaviours: TupleOf[PolicyScore]
    optimum: PolicyScore


def reference_scores(
    recipe: DatasetRecipe,
    task: Task,
    transitions: Transitions,
    policies: dict[int, object] | None = None,
) -> ReferenceScores:
    """The reference scores of a data set; `policies` as in `collect`."""
    T = recipe.spec.horizon
    episodes = min(EPISODES, _MAX_STEPS // T)

    def rollouts(policy: BehaviourPolicy, index: int) -> Rollouts | None:
        if episodes == 0:
            return None
        stream = f"dataset/reference/{index}/start"
        starts = EpisodeStream(recipe.seed, stream, episodes, recipe.spec.state_dim, ahead=1)
        return _rollouts(*whole_episodes(task, policy, starts, episodes))

    behaviours = []
    for index in range(len(recipe.behaviours)):
        rows = transitions.components == index
        policy = behaviour_policy(
            recipe, index, task, max(1, episodes), (policies or {}).get(index), "dataset/reference"
        )
        behaviours.append(
            _score(
                transitions.similarities[rows],
                transitions.step_rewards[rows],
                rollouts(policy, index),
            )
        )
    weights = [behaviour.weight for behaviour in recipe.behaviours]
    weighted = _weighted(weights, [score.rollouts for score in behaviours])
    return ReferenceScores(
        constant=_score(*_constant_values(task, transitions), rollouts(constant_policy(task), 0)),
        behaviour=_score(transitions.similarities, transitions.step_rewards, weighted),
        behaviours=tuple(behaviours),
        optimum=PolicyScore(
            similarity=1.0,
            step_reward=1.0,
            rollouts=Rollouts(episodes=0, mean_return=float(T), standard_error=0.0, similarity=1.0),
        ),
    )


def _score(similarity: Array, step_reward: Array, rollouts: Rollouts | None) -> PolicyScore:
    means = {"similarity": similarity.mean(), "step_reward": step_reward.mean()}
    return PolicyScore(**means, rollouts=rollouts)


def _constant_values(task: Task, transitions: Transitions) -> tuple[Array, Array]:
    """r̃ and r of a = ½ on the data set's states."""
    optimal = transitions.optimal_actions
    similarity = task.similarities_of(np.full_like(optimal, 0.5), optimal)
    rewarded = similarity
    if task.pays_the_team:  # the mean over all channels, of which agents own unequal numbers
        channels = np.array([owned.stop - owned.start for owned in task.owned])
        rewarded = (similarity @ channels) / task.spec.action_dim
    return similarity, task.reward_of(rewarded)


def whole_episodes(
    task: Task, policy: BehaviourPolicy, starts: EpisodeStream, count: int
) -> tuple[Array, Array, Array]:
    """Return, sum of r̃ and steps `[count]` of the first episodes; means over agents."""
    episodes, sums = BehaviourEpisodes(task, policy, starts, count), np.zeros((3, count))
    for step in play(episodes.batch, episodes.act):
        similarity, reward = step.result.values[[SIMILARITY, REWARD]].mean(axis=1)
        sums += step.running * np.stack([reward, similarity, np.ones(count)])
    returns, similarities, steps = sums
    return returns, similarities, steps


def _rollouts(returns: Array, similarities: Array, steps: Array) -> Rollouts:
    count = len(returns)
    return Rollouts(
        episodes=count,
        mean_return=returns.mean(),
        standard_error=returns.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0,
        similarity=min(1.0, similarities.sum() / steps.sum()),
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

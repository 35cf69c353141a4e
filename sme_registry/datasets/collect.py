"""`collect`: generate the `Transitions` of a recipe, many episodes at once, and score its policies.

    mixture of ν:  a = (1 − α) π*(s) + α ã(s),   α ~ U(0, ν), one draw for each step
    random:        a ~ U([0, 1]^A)
    policy:        the user's, deterministic

Source: METHOD, section 4. ã is a second Deep Uniform Network of the same shape as π* (for a team
one for each agent, on what it observes), drawn from the data's seed; one α mixes all channels.

Episode e of a behaviour does not depend on what runs next to it: its start, each α and its actions
come from its own part of named streams, and π* and ã are evaluated by the compiled step, whose bits
do not depend on the size of a batch. A user's policy is called in blocks of one size, so that its
network always multiplies matrices of the same shape. A data set is the first N rows of episodes
0, 1, 2, …. `B` environments, `S` state_dim, `A` action_dim, `n` agents, `m` distractors, T horizon.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.documents import (
    DatasetRecipe,
    EpisodeScores,
    PolicyScore,
    ReferenceScores,
)
from sme_registry.datasets.transitions import Arrays, Transitions
from sme_registry.envs.batch import Batch
from sme_registry.errors import DigestMismatchError, OptionError
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.evaluation.regions import expansion
from sme_registry.evaluation.rollouts import PlayStep, play
from sme_registry.spec import SMESpec
from sme_registry.task import Task, draw
from sme_registry.task.draw import bit_generator, to_uniform
from sme_registry.task.loading import check_memory
from sme_registry.task.task import (
    NUMBERS,
    REGRET,
    REWARD,
    SIMILARITY,
    STEP_REWARD,
    Array,
    Indices,
    Mask,
    Observation,
)

ReportProgress = Callable[[int, int], None]
Act = Callable[[Array, Observation], Array]
"""Actions `[B, A]` for states `[B, S]` and joint observations `[B, O]`."""
BehaviourPolicy = Callable[[range], Act]
"""How to act in new episodes with these numbers, one in each environment."""

_AHEAD = 64  # steps whose random numbers an episode reads at once
_BLOCK = 64  # observations in one call of a user's policy
_ENVS = 512
_MAX_STEPS = 10**8  # of the environment; a sub-cube that needs more is too small
_SCORED_EPISODES, _MAX_SCORED_STEPS = 100, 10**5  # of one policy; the steps are over its episodes


def noise_task(task: Task, seed: int | str) -> Task:
    """The task whose optimal policy is ã: of the same shape, drawn from the data's seed."""
    policies = draw.optimal_policies(task.spec.derive(seed=seed), "dataset/noise")
    return replace(task, policies=policies)


def _plain(task: Task) -> Task:
    """The same π* without all else, which takes time."""
    spec = task.spec.derive(safety=None, observation=None, shaping=None, noise=None)
    return replace(task, spec=spec, limiting=(), distractor_transition=None, mixing=(), shaping=())


def _optimal_policy(plain: Task, num_envs: int) -> Callable[[Array], Array]:
    """π* `[B, A]`, with the same bits in any batch; the next call but one overwrites it."""
    batch, envs = Batch(plain, num_envs, reuse=True), np.arange(num_envs)
    observation, no_action = batch.observe(), np.zeros((num_envs, plain.spec.action_dim))

    def act(s: Array) -> Array:
        batch.begin(envs, observation, s)
        return batch.advance(no_action).optimal

    return act


def episode_numbers(
    seed: int | str, stream: str, episodes: range, width: int, ahead: int = _AHEAD
) -> Iterator[Array]:
    """Uniform numbers `[len(episodes), width]` in (0, 1) for each step of episodes, without end.

    Episode e reads a named stream from word 4 · 2¹²⁸ e onwards, `ahead` steps at once.
    """
    generators = [bit_generator(seed, stream) for _ in episodes]
    for generator, episode in zip(generators, episodes, strict=True):
        generator.advance(episode << 128)
    while True:
        bits = [generator.random_raw(ahead * width) for generator in generators]
        yield from to_uniform(np.array(bits)).reshape(-1, ahead, width).swapaxes(0, 1)


def behaviour_policy(
    recipe: DatasetRecipe, index: int, task: Task, policy: Any = None, stream: str = "dataset"
) -> BehaviourPolicy:
    """The policy of a recipe's behaviour with this index; `policy` is the user's, for its kind."""
    behaviour, name = recipe.behaviours[index], f"{stream}/{index}"
    if behaviour.nu is not None:
        return _mixture(task, recipe.seed, behaviour.nu, f"{name}/alpha")
    if behaviour.kind == "random":
        return partial(_random_actions, recipe.seed, f"{name}/action", task.spec.action_dim)
    prepared = as_policy(
        policy, recipe.spec, action_range=behaviour.action_range, name=behaviour.policy
    )
    act = prepared.act_in if isinstance(prepared, TeamPolicy) else prepared
    return lambda episodes: lambda s, observation: _in_blocks(act, observation)


def constant_policy(task: Task) -> BehaviourPolicy:
    return lambda episodes: lambda s, observation: np.full((len(s), task.spec.action_dim), 0.5)


def _random_actions(seed: int | str, stream: str, action_dim: int, episodes: range) -> Act:
    numbers = episode_numbers(seed, stream, episodes, action_dim)
    return lambda s, observation: next(numbers)


def _mixture(task: Task, seed: int | str, nu: float, stream: str) -> BehaviourPolicy:
    plain, plain_noise = _plain(task), _plain(noise_task(task, seed))

    def begin(episodes: range) -> Act:
        optimal = _optimal_policy(plain, len(episodes))
        noise = _optimal_policy(plain_noise, len(episodes))
        numbers = episode_numbers(seed, stream, episodes, 1)

        def act(s: Array, observation: Observation) -> Array:
            alpha = nu * next(numbers)
            return (1.0 - alpha) * optimal(s) + alpha * noise(s)

        return act

    return begin


def _in_blocks(policy: Callable[[Observation], Array], observation: Observation) -> Array:
    """The policy's actions, in calls of one size; the last row pads the last block."""
    rows = len(observation)
    missing = -rows % _BLOCK
    filled = np.concatenate([observation, np.repeat(observation[-1:], missing, axis=0)])
    blocks = [policy(filled[first : first + _BLOCK]) for first in range(0, len(filled), _BLOCK)]
    return np.concatenate(blocks)[:rows]


def play_episodes(
    task: Task, policy: BehaviourPolicy, seed: int | str, stream: str, episodes: range
) -> Iterator[tuple[PlayStep, Batch]]:
    """Whole episodes and the batch after each step; their first numbers are the initial states."""
    batch, envs = Batch(task, len(episodes)), np.arange(len(episodes))
    states = next(episode_numbers(seed, stream, episodes, task.spec.state_dim, ahead=1))
    batch.seed_by_states(envs, states)
    batch.begin(envs, batch.observe(), states)
    act = policy(episodes)

    def stored(s: Array, observation: Observation) -> npt.NDArray[np.float32]:
        return np.clip(act(s, observation), 0.0, 1.0).astype(np.float32)

    for step in play(batch, stored):
        yield step, batch


def collect(
    recipe: DatasetRecipe,
    task: Task,
    policies: dict[int, Any] | None = None,
    *,
    num_envs: int | None = None,
    progress: ReportProgress | None = None,
) -> Transitions:
    """Generate the transitions of a recipe, one behaviour after another.

    `policies` are the user's by the index of their behaviour. `num_envs` episodes run at once (at
    most 512 by default); the numbers do not depend on it. `progress` is called with the transitions
    collected and their total.

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
    row = 24 * (S + m) + 12 * A + 56 * n + 64 + 8 * S * (spec.noise is not None)
    if spec.safety is not None:
        row += 16 * A + 16
    check_memory(
        3 * recipe.transitions * row,
        f"transitions={recipe.transitions}: a data set of this task",
        "Collect fewer, or several data sets with different seeds.",
    )
    parts: list[Arrays] = []
    for index in range(len(recipe.behaviours)):
        policy = behaviour_policy(recipe, index, task, (policies or {}).get(index))

        def report(count: int, before: int = sum(recipe.shares[:index])) -> None:
            if progress is not None:
                progress(before + count, recipe.transitions)

        parts.append(_first_rows(recipe, index, task, policy, num_envs or _ENVS, report))
    return _join(parts, spec)


def _first_rows(
    recipe: DatasetRecipe,
    index: int,
    task: Task,
    policy: BehaviourPolicy,
    num_envs: int,
    progress: Callable[[int], None],
) -> Arrays:
    """A behaviour's first transitions by episode and step whose states are in the sub-cube."""
    wanted, coverage, T = recipe.shares[index], recipe.coverage, recipe.spec.horizon
    kept_share = max(1e-300, (1.0 + (coverage or 0.0)) ** recipe.spec.state_dim)
    expected = wanted / kept_share  # steps, of uniform states
    if expected > _MAX_STEPS and coverage:
        raise _too_small(recipe, f"{wanted:,} transitions need about {expected:.1g} steps")
    parts: list[Arrays] = []
    first = count = taken = 0
    while count < wanted:
        # As many as are needed, by the mean of those so far.
        rows_of_one = max(1, count) / first if first else T * kept_share
        missing = wanted - count
        episodes = range(first, first + min(num_envs, math.ceil(missing / rows_of_one)))
        rows_of = np.zeros(len(episodes), np.int64)
        steps = play_episodes(task, policy, recipe.seed, f"dataset/{index}/start", episodes)
        for t, (step, batch) in enumerate(steps):
            kept = step.running
            if coverage is not None:
                kept = kept & (expansion(step.state) <= coverage)
            parts.append(_rows(kept, np.array(episodes), t, step, batch))
            rows_of += kept
            count += int(kept.sum())
            taken += int(step.running.sum())
            progress(min(wanted, count))
            # No episode later than the first that goes on can contribute a wanted row.
            going_on = step.running & ~(step.result.terminated | step.result.truncated)
            if going_on.any() and rows_of[: going_on.argmax() + 1].sum() >= missing:
                break
        first = episodes.stop
        if taken > max(10**6, 20 * expected) and count < wanted:
            raise _too_small(recipe, f"{taken:,} steps gave {count:,} transitions")
    rows = _concatenate(parts)
    order = np.lexsort((rows["t"], rows["episode"]))[:wanted]
    return {name: column[order] for name, column in rows.items()}


def _rows(kept: Mask, episodes: Indices, t: int, step: PlayStep, batch: Batch) -> Arrays:
    result = step.result
    columns: Arrays = {
        "episode": episodes,
        "t": np.full(len(kept), t),
        "values": result.values.transpose(2, 0, 1),  # `[B, 5 … 10, n]`
        "limits": result.actions[1:].transpose(1, 0, 2),  # with safety `[B, 2, A]`
        "states": step.state,
        "next_states": batch.state,
        "observations": step.observation,
        "next_observations": result.observation,
        "actions": step.action,
        "optimal_actions": result.optimal,
        "terminations": result.terminated,
        "noise": step.noise[:, result.values.shape[1] :],
        "distractors": step.distractors,
        "next_distractors": batch.distractors,
    }
    return {name: column[kept] for name, column in columns.items()}


def _too_small(recipe: DatasetRecipe, reason: str) -> OptionError:
    return OptionError(
        f"coverage={recipe.coverage}: {reason}: must be closer to 0 for this state_dim (it keeps a "
        "fraction (1 + ε)^S of uniform states). Give a larger value, or fewer transitions."
    )


def _concatenate(parts: list[Arrays]) -> Arrays:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _join(parts: list[Arrays], spec: SMESpec) -> Transitions:
    """The rows of all behaviours as one data set."""
    columns = _concatenate(parts)
    episode, t = columns.pop("episode"), columns.pop("t")
    values, limits = columns.pop("values"), columns.pop("limits")
    component = np.repeat(np.arange(len(parts)), [len(part["t"]) for part in parts])
    # A trajectory ends where the next row is not its next step.
    ends = np.ones(len(t), bool)
    ends[:-1] = (np.diff(component) != 0) | (np.diff(episode) != 0) | (np.diff(t) != 1)

    def of_row(row: int) -> Array:
        """`[N]`; of a team `[N, n]`."""
        agents = values[:, row]
        return agents.copy() if spec.team is not None else agents[:, 0].copy()

    if spec.safety is not None:
        columns |= {"limits": limits[:, 0].copy(), "safe_actions": limits[:, 1].copy()}
    for row, (name, field) in enumerate(NUMBERS.items()):
        if field and getattr(spec, field):
            columns[f"{name}s"] = of_row(row)
    noise = columns.pop("noise")
    if task_noise := spec.noise:
        columns |= {"transition_noises": noise} if task_noise.transition else {}
    if not spec.distractors:
        del columns["distractors"], columns["next_distractors"]
    if spec.team is not None:
        columns["agent_rewards"] = of_row(REWARD)
    return Transitions(
        **columns,
        rewards=values[:, REWARD].mean(axis=1),
        timeouts=ends & ~columns["terminations"],
        regrets=of_row(REGRET),
        similarities=of_row(SIMILARITY),
        step_rewards=of_row(STEP_REWARD),
        episodes=np.cumsum(ends) - ends,
        components=component,
    )


def reference_scores(
    recipe: DatasetRecipe,
    task: Task,
    transitions: Transitions,
    policies: dict[int, Any] | None = None,
) -> ReferenceScores:
    """The scores of behaviour, constant ½ and optimum: exact in the states of the data set."""
    stream, T = "dataset/reference", recipe.spec.horizon
    count = min(_SCORED_EPISODES, _MAX_SCORED_STEPS // T)

    def rollouts(policy: BehaviourPolicy, index: int) -> EpisodeScores | None:
        if count == 0:
            return None
        start = f"{stream}/{index}/start"
        returns, similarities, steps = whole_episodes(task, policy, recipe.seed, start, count)
        return EpisodeScores(
            episodes=count,
            mean_return=returns.mean(),
            standard_error=returns.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0,
            similarity=min(1.0, similarities.sum() / steps.sum()),
        )

    behaviours = []
    for index in range(len(recipe.behaviours)):
        rows, user = transitions.components == index, (policies or {}).get(index)
        policy = behaviour_policy(recipe, index, task, user, stream)
        similarity, step_reward = transitions.similarities[rows], transitions.step_rewards[rows]
        behaviours.append(_score(similarity, step_reward, rollouts(policy, index)))
    optimum: EpisodeScores | None = EpisodeScores(
        episodes=0, mean_return=float(T), standard_error=0.0, similarity=1.0
    )
    if recipe.spec.shaping is not None or recipe.spec.compensated:
        optimum = rollouts(_mixture(task, recipe.seed, 0.0, f"{stream}/alpha"), len(behaviours))
    return ReferenceScores(
        constant=_score(*_constant_values(task, transitions), rollouts(constant_policy(task), 0)),
        behaviour=_score(
            transitions.similarities, transitions.step_rewards, _weighted(recipe, behaviours)
        ),
        behaviours=tuple(behaviours),
        optimum=PolicyScore(similarity=1.0, step_reward=1.0, rollouts=optimum),
    )


def check_scores(scores: ReferenceScores, task: Task, transitions: Transitions) -> None:
    """Compare the scores in the states of a data set, which are exact, with its transitions."""
    behaviour = transitions.similarities, transitions.step_rewards
    for name, values in ("constant", _constant_values(task, transitions)), ("behaviour", behaviour):
        for field, exact in _score(*values, None).model_dump(exclude={"rollouts"}).items():
            if abs((stored := getattr(getattr(scores, name), field)) - exact) > 1e-9:
                raise DigestMismatchError(
                    f"scores.{name}.{field}={stored:.10g}: must be {exact:.10g}, the mean of the "
                    "transitions. Download the data set again, or generate it again (--force)."
                )


def _score(similarity: Array, step_reward: Array, rollouts: EpisodeScores | None) -> PolicyScore:
    means = {"similarity": similarity.mean(), "step_reward": step_reward.mean()}
    return PolicyScore(**means, rollouts=rollouts)


def _constant_values(task: Task, transitions: Transitions) -> tuple[Array, Array]:
    optimal = transitions.optimal_actions
    similarity = task.similarities_of(np.full_like(optimal, 0.5), optimal)
    rewarded = similarity
    if task.pays_the_team:  # the mean over all channels, of which agents own unequal numbers
        channels = np.array([owned.stop - owned.start for owned in task.owned])
        rewarded = (similarity @ channels) / task.spec.action_dim
    return similarity, task.reward_of(rewarded)


def whole_episodes(
    task: Task, policy: BehaviourPolicy, seed: int | str, stream: str, count: int
) -> tuple[Array, Array, Array]:
    """Return, sum of r̃ and steps `[count]` of the first episodes; means over agents."""
    sums = np.zeros((3, count))
    for step, _ in play_episodes(task, policy, seed, stream, range(count)):
        similarity, reward = step.result.values[[SIMILARITY, REWARD]].mean(axis=1)
        sums += step.running * np.stack([reward, similarity, np.ones(count)])
    returns, similarities, steps = sums
    return returns, similarities, steps


def _weighted(recipe: DatasetRecipe, scores: list[PolicyScore]) -> EpisodeScores | None:
    """The mean over behaviours by their weights; None if they have no episodes."""
    if len(scores) == 1:
        return scores[0].rollouts
    pairs = [
        (behaviour.weight, score.rollouts)
        for behaviour, score in zip(recipe.behaviours, scores, strict=True)
        if score.rollouts is not None
    ]
    if not pairs:
        return None
    return EpisodeScores(
        episodes=sum(score.episodes for _, score in pairs),
        mean_return=math.fsum(w * score.mean_return for w, score in pairs),
        standard_error=math.sqrt(math.fsum((w * s.standard_error) ** 2 for w, s in pairs)),
        similarity=min(1.0, math.fsum(w * score.similarity for w, score in pairs)),
    )

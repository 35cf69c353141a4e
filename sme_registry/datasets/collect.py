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

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

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
    Observation,
)
from sme_registry.datasets.documents import (
    DatasetRecipe,
    EpisodeScores,
    PolicyScore,
    ReferenceScores,
)
from sme_registry.datasets.transitions import Arrays, Transitions
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

_AHEAD = 64  # steps whose random numbers an episode reads at once
_BLOCK = 64  # observations in one call of a user's policy
_ENVS = 512
_MAX_STEPS = 10**8  # of the environment; a sub-cube that needs more is too small
_SCORED_EPISODES, _MAX_SCORED_STEPS = 100, 10**5  # of one policy; the steps are over its episodes


def noise_task(task: Task, seed: int | str) -> Task:
    """The task whose optimal policy is ã: of the same shape, drawn from the data's seed."""
    policies = draw.optimal_policies(task.spec.derive(seed=seed), "dataset/noise")
    return replace(task, policies=policies)


def _optimal_policy(task: Task, num_envs: int) -> Callable[[Array], Array]:
    """π* from states `[B, S]` to `[B, A]`, with the same bits in any batch.

    The next call but one overwrites its actions.
    """
    # The same π* without limits and distractors, which take time.
    spec = task.spec.derive(safety=None, observation=None)
    plain = replace(task, spec=spec, limiting=(), distractor_transition=None, mixing=())
    batch, envs = Batch(plain, num_envs, reuse=True), np.arange(num_envs)
    observation, no_action = batch.observe(), np.zeros((num_envs, spec.action_dim))

    def act(s: Array) -> Array:
        batch.begin(envs, observation, s)
        return batch.advance(no_action).optimal

    return act


def episode_numbers(
    seed: int | str, name: str, episode: int, width: int, ahead: int = _AHEAD
) -> Iterator[Array]:
    """Uniform numbers `[width]` in (0, 1) for each step of an episode, without end.

    Episode e reads a named stream from word 4 · 2¹²⁸ e onwards, `ahead` steps at once.
    """
    generator = bit_generator(seed, name)
    generator.advance(episode << 128)
    while True:
        yield from to_uniform(generator.random_raw(ahead * width)).reshape(ahead, width)


class EpisodeNumbers:
    """The numbers of a stream's present episodes, one in each environment of a batch."""

    def __init__(self, seed: int | str, name: str, num_envs: int, width: int) -> None:
        self._stream, self._width = (seed, name), width
        self._numbers: list[Iterator[Array]] = [iter(())] * num_envs

    def begin(self, env: int, episode: int) -> None:
        self._numbers[env] = episode_numbers(*self._stream, episode, self._width)

    def next(self) -> Array:
        """Those of the next step, `[B, width]`."""
        return np.concatenate([next(one) for one in self._numbers]).reshape(-1, self._width)


@dataclass(frozen=True)
class BehaviourPolicy:
    """Actions `[B, A]` for states `[B, S]` and joint observations `[B, O]` of a batch."""

    act: Callable[[Array, Observation], Array]
    numbers: EpisodeNumbers | None = None  # that it uses; None if it is deterministic


def behaviour_policy(
    recipe: DatasetRecipe,
    index: int,
    task: Task,
    num_envs: int,
    policy: Any = None,
    stream: str = "dataset",
) -> BehaviourPolicy:
    """The policy of a recipe's behaviour with this index; `policy` is the user's, for its kind."""
    behaviour, name = recipe.behaviours[index], f"{stream}/{index}"
    if behaviour.nu is not None:
        return _mixture(task, recipe.seed, behaviour.nu, f"{name}/alpha", num_envs)
    if behaviour.kind == "random":
        numbers = EpisodeNumbers(recipe.seed, f"{name}/action", num_envs, task.spec.action_dim)
        return BehaviourPolicy(lambda s, observation: numbers.next(), numbers)
    prepared = as_policy(
        policy, recipe.spec, action_range=behaviour.action_range, name=behaviour.policy
    )
    return BehaviourPolicy(lambda s, observation: _actions(prepared, observation))


def constant_policy(task: Task) -> BehaviourPolicy:
    """a = ½ in every channel."""
    return BehaviourPolicy(lambda s, observation: np.full((len(s), task.spec.action_dim), 0.5))


def _mixture(task: Task, seed: int | str, nu: float, name: str, num_envs: int) -> BehaviourPolicy:
    optimal = _optimal_policy(task, num_envs)
    if nu == 0.0:
        return BehaviourPolicy(lambda s, observation: optimal(s))
    noise = _optimal_policy(noise_task(task, seed), num_envs)
    numbers = EpisodeNumbers(seed, name, num_envs, 1)

    def act(s: Array, observation: Observation) -> Array:
        alpha = nu * numbers.next()
        return (1.0 - alpha) * optimal(s) + alpha * noise(s)

    return BehaviourPolicy(act, numbers)


def _actions(policy: Policy | TeamPolicy, observation: Observation) -> Array:
    """A user's actions `[B, A]` for joint observations."""
    if isinstance(policy, Policy):
        return _in_blocks(policy, observation)
    shared = observation.shape[1] - len(policy.members)  # s and t/T; then each agent's r_cum/k
    joint = []
    for agent, member in enumerate(policy.members):
        single = observation[:, [*range(shared), shared + agent]]
        acted = _in_blocks(member.policy, member.observe(single))
        joint.append(acted[:, : member.action_dim])
    return np.concatenate(joint, axis=1)


def _in_blocks(policy: Callable[[Observation], Array], observation: Observation) -> Array:
    """The policy's actions, in calls of one size; the last row pads the last block."""
    rows = len(observation)
    missing = -rows % _BLOCK
    filled = np.concatenate([observation, np.repeat(observation[-1:], missing, axis=0)])
    blocks = [policy(filled[first : first + _BLOCK]) for first in range(0, len(filled), _BLOCK)]
    return np.concatenate(blocks)[:rows]


def collect(
    recipe: DatasetRecipe,
    task: Task,
    policies: dict[int, Any] | None = None,
    *,
    num_envs: int | None = None,
    progress: ReportProgress | None = None,
) -> Transitions:
    """Generate the transitions of a recipe, one behaviour after another.

    `task` is the recipe's, materialised; `policies` are the user's by the index of their behaviour.
    `num_envs` episodes run at once (at most 512 by default); the numbers do not depend on it.
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
    check_memory(
        3 * recipe.transitions * row,
        f"transitions={recipe.transitions}: a data set of this task",
        "Collect fewer, or several data sets with different seeds.",
    )
    kept_share = max(1e-300, (1.0 + (recipe.coverage or 0.0)) ** S)  # of uniform states
    parts, total = [], 0
    for index, share in enumerate(recipe.shares):
        expected = share / kept_share
        if expected > _MAX_STEPS and recipe.coverage:
            raise _too_small(recipe, f"{share:,} transitions need about {expected:.1g} steps")
        envs = num_envs or min(_ENVS, math.ceil(expected / spec.horizon))
        policy = behaviour_policy(recipe, index, task, envs, (policies or {}).get(index))

        def report(count: int, before: int = total) -> None:
            if progress is not None:
                progress(before + count, recipe.transitions)

        episodes = _Episodes(task, policy, recipe.seed, f"dataset/{index}/start", envs)
        patience = max(10**6, 20 * expected)
        parts.append(_first_rows(episodes.rows(), recipe, share, patience, report))
        total += share
    return _join(parts, spec)


class _Episodes:
    """Episodes 0, 1, 2, … of a policy in a batch, each in the first environment that is free.

    The first numbers of an episode in the stream are its initial state, which determines its
    distractors, too.
    """

    def __init__(
        self, task: Task, policy: BehaviourPolicy, seed: int | str, stream: str, num_envs: int
    ) -> None:
        self._policy, self._stream, self._unused = policy, (seed, stream), itertools.count()
        self.batch = Batch(task, num_envs)
        self.episode, self.t = np.zeros((2, num_envs), np.int64)
        self.begin(np.arange(num_envs), self.batch.observe())

    def begin(self, envs: Indices, observation: Observation) -> None:
        """Begin the next episodes in these environments."""
        S, initial = self.batch.task.spec.state_dim, []
        for env in envs.tolist():
            episode = self.episode[env] = next(self._unused)
            initial.append(next(episode_numbers(*self._stream, episode, S, ahead=1)))
            if self._policy.numbers is not None:
                self._policy.numbers.begin(env, episode)
        self.t[envs] = 0
        states = np.array(initial)
        self.batch.seed_by_states(envs, states)
        self.batch.begin(envs, observation, states)

    def act(self, s: Array, observation: Observation) -> npt.NDArray[np.float32]:
        """The behaviour's actions, exactly as the data set stores them: float32 in [0, 1]."""
        return np.clip(self._policy.act(s, observation), 0.0, 1.0).astype(np.float32)

    def rows(self) -> Iterator[Arrays]:
        """The steps of all environments without end, as columns that are valid until the next."""
        for step in play(self.batch, self.act, self.begin):
            result = step.result
            yield {
                "episode": self.episode,
                "t": self.t,
                "truncated": result.truncated,
                "values": result.values.transpose(2, 0, 1),  # `[B, 5, n]`; with safety 7
                "limits": result.limits.transpose(1, 0, 2),  # `[B, 2, A]`: also safe actions
                "states": step.state,
                "next_states": self.batch.state,
                "observations": step.observation,
                "next_observations": result.observation,
                "actions": step.action,
                "optimal_actions": result.optimal,
                "terminations": result.terminated,
                "distractors": step.distractors,
                "next_distractors": self.batch.distractors,
            }
            self.t += 1


def _first_rows(
    steps: Iterator[Arrays],
    recipe: DatasetRecipe,
    wanted: int,
    patience: float,
    progress: Callable[[int], None],
) -> Arrays:
    """The first transitions by episode and step whose states are in the sub-cube."""
    parts: list[Arrays] = []
    rows_of = np.zeros(1024, np.int64)  # by episode
    count = taken = 0
    for step in steps:
        episode, coverage = step["episode"], recipe.coverage
        kept = np.ones(len(episode), bool)
        if coverage is not None:
            kept = expansion(step["states"]) <= coverage
        parts.append({name: column[kept] for name, column in step.items()})
        if episode.max() >= len(rows_of):
            rows_of = np.pad(rows_of, (0, int(episode.max())))
        rows_of[episode[kept]] += 1
        count += int(kept.sum())
        taken += len(kept)
        progress(min(wanted, count))
        # No later episode than the first running one can contribute a wanted row.
        running = episode[~(step["terminations"] | step["truncated"])]
        first = int(running.min(initial=episode.max() + 1))
        if count >= wanted and rows_of[: first + 1].sum() >= wanted:
            break
        if taken > patience and count < wanted:
            raise _too_small(recipe, f"{taken:,} steps gave {count:,} transitions")
    rows = _concatenate(parts)
    order = np.lexsort((rows["t"], rows["episode"]))[:wanted]
    return {name: column[order] for name, column in rows.items()}


def _too_small(recipe: DatasetRecipe, reason: str) -> OptionError:
    return OptionError(
        f"coverage={recipe.coverage}: {reason}: must be closer to 0 for this state_dim (it keeps a "
        "fraction (1 + ε)^S of uniform states). Give a larger value, or fewer transitions."
    )


def _concatenate(parts: list[Arrays]) -> Arrays:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _join(parts: list[Arrays], spec: SMESpec) -> Transitions:
    """The rows of all behaviours as one data set, its trajectories numbered from 0."""
    columns = _concatenate(parts)
    episode, t = columns.pop("episode"), columns.pop("t")
    values, limits = columns.pop("values"), columns.pop("limits")
    del columns["truncated"]
    component = np.repeat(np.arange(len(parts)), [len(part["t"]) for part in parts])
    # A trajectory ends where the next row is not its next step.
    ends = np.ones(len(t), bool)
    ends[:-1] = (np.diff(component) != 0) | (np.diff(episode) != 0) | (np.diff(t) != 1)

    def of_row(row: int) -> Array:
        """`[N]`; of a team `[N, n]`."""
        agents = values[:, row]
        return agents.copy() if spec.team is not None else agents[:, 0].copy()

    if spec.safety is not None:
        columns |= {"costs": of_row(COST), "safe_regrets": of_row(SAFE_REGRET)}
        columns |= {"limits": limits[:, 0].copy(), "safe_actions": limits[:, 1].copy()}
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
    """The scores of a data set's behaviour, of the constant ½ and of the optimum.

    In the data set's own states they are exact, because π* is known there. By rollouts they are
    means over whole episodes with their own starts, with standard errors; the optimum's return is
    T. Numbers of a team are means over its agents. `policies` as in `collect`.
    """
    stream, T = "dataset/reference", recipe.spec.horizon
    count = min(_SCORED_EPISODES, _MAX_SCORED_STEPS // T)

    def rollouts(policy: BehaviourPolicy, index: int) -> EpisodeScores | None:
        if count == 0:
            return None
        return _scores(*whole_episodes(task, policy, recipe.seed, f"{stream}/{index}/start", count))

    behaviours = []
    for index in range(len(recipe.behaviours)):
        rows, user = transitions.components == index, (policies or {}).get(index)
        policy = behaviour_policy(recipe, index, task, max(1, count), user, stream)
        similarity, step_reward = transitions.similarities[rows], transitions.step_rewards[rows]
        behaviours.append(_score(similarity, step_reward, rollouts(policy, index)))
    optimum = EpisodeScores(episodes=0, mean_return=float(T), standard_error=0.0, similarity=1.0)
    return ReferenceScores(
        constant=_score(*_constant_values(task, transitions), rollouts(constant_policy(task), 0)),
        behaviour=_score(
            transitions.similarities, transitions.step_rewards, _weighted(recipe, behaviours)
        ),
        behaviours=tuple(behaviours),
        optimum=PolicyScore(similarity=1.0, step_reward=1.0, rollouts=optimum),
    )


def _score(similarity: Array, step_reward: Array, rollouts: EpisodeScores | None) -> PolicyScore:
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
    task: Task, policy: BehaviourPolicy, seed: int | str, stream: str, count: int
) -> tuple[Array, Array, Array]:
    """Return, sum of r̃ and steps `[count]` of the first episodes; means over agents."""
    episodes, sums = _Episodes(task, policy, seed, stream, count), np.zeros((3, count))
    for step in play(episodes.batch, episodes.act):
        similarity, reward = step.result.values[[SIMILARITY, REWARD]].mean(axis=1)
        sums += step.running * np.stack([reward, similarity, np.ones(count)])
    returns, similarities, steps = sums
    return returns, similarities, steps


def _scores(returns: Array, similarities: Array, steps: Array) -> EpisodeScores:
    count = len(returns)
    return EpisodeScores(
        episodes=count,
        mean_return=returns.mean(),
        standard_error=returns.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0,
        similarity=min(1.0, similarities.sum() / steps.sum()),
    )


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

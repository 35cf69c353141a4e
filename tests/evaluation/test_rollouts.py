"""Episodes side by side: the scores of single environments, and of SB3's own evaluation."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec, make_parallel, materialize
from sme_registry.errors import ActionError, SpecError, StateError
from sme_registry.evaluation import Perceptron, as_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.training.algorithms import one_thread
from sme_registry.training.numpy_policy import numpy_policy

PLAIN = SMESpec(state_dim=3, action_dim=2)
# Payouts every 7 steps, a threshold, and an end at the first bad step.
HARD = PLAIN.derive(k=7, r_min=0.1, D=0.05, horizon=40)


def nearly_optimal(spec: SMESpec) -> Any:
    """Acts row by row, so that neither its batch nor its neighbours change an action's bits."""
    task = materialize(spec)

    def act(observations: Any) -> Any:
        s = observations[:, : spec.state_dim].astype(np.float64)
        optimal = np.stack([task.optimal_action(row) for row in s])
        return np.clip(optimal + 0.75 * (s[:, :1] - 0.5), 0.0, 1.0).astype(np.float32)

    return act


@pytest.fixture(autouse=True, scope="module")
def single_thread() -> Iterator[None]:
    if importlib.util.find_spec("torch") is None:
        yield
    else:
        with one_thread():
            yield


class StartingAt(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Begins its episodes at the given states, one after another."""

    def __init__(self, env: Any, states: Any) -> None:
        super().__init__(env)
        self.states = iter(states)

    def reset(self, **kwargs: Any) -> Any:
        # SB3's evaluation begins one episode more than it counts.
        return self.env.reset(options={"state": next(self.states, np.full(3, 0.5))})


def evaluated_by_sb3(model: Any, spec: SMESpec, states: Any) -> tuple[Any, Any]:
    """Returns and lengths of `evaluate_policy`, on one environment."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(StartingAt(sme_registry.make(spec, action_range="symmetric"), states))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scores = evaluate_policy(model, env, len(states), return_episode_rewards=True)
    return np.array(scores[0]), np.array(scores[1])


def trained(algorithm: str, spec: SMESpec) -> Any:
    sb3 = pytest.importorskip("stable_baselines3")
    from sme_registry.sb3 import SMEVecEnv

    settings = {"TD3": {"buffer_size": 500}, "PPO": {"n_steps": 128}}[algorithm]
    env = SMEVecEnv(spec)
    return sb3.__dict__[algorithm]("MlpPolicy", env, seed=1, device="cpu", **settings).learn(150)


def test_a_recurrent_model_keeps_its_state_during_an_episode() -> None:
    contrib = pytest.importorskip("sb3_contrib")
    from sme_registry.sb3 import SMEVecEnv

    spec = PLAIN.derive(horizon=8)  # rounding errors grow from step to step
    model = contrib.RecurrentPPO("MlpLstmPolicy", SMEVecEnv(spec), seed=1, n_steps=16, device="cpu")
    model.policy.action_net.weight.data *= 100.0  # so that its memory matters
    states = start_states(0, 0, 3, 3)
    expected, _ = evaluated_by_sb3(model, spec, states)
    policy, task = as_policy(model, spec), materialize(spec)
    for _ in range(2):  # the second batch starts anew
        done = rollouts(policy, task, states)
        np.testing.assert_allclose(done.episode_return, expected, atol=2e-3)
    without_memory = rollouts(policy.__call__, task, states)
    assert np.abs(without_memory.episode_return - expected).max() > 0.02


@pytest.mark.parametrize("spec", [PLAIN, HARD], ids=["plain", "hard"])
def test_an_episode_has_the_scores_of_a_single_environment(spec: SMESpec) -> None:
    policy, states = nearly_optimal(spec), start_states(0, 0, 12, 3)
    done = rollouts(policy, materialize(spec), states)
    env = sme_registry.make(spec)
    for lane, state in enumerate(states):
        observation, _ = env.reset(options={"state": state})
        rewards, regrets, similarities, ended = [], [], [], False
        while not ended:
            observation, reward, terminated, truncated, info = env.step(
                policy(observation[None])[0]
            )
            ended = terminated or truncated
            rewards.append(reward)
            regrets.append(info["regret"])
            similarities.append(info["similarity"])
        assert done.length[lane] == len(rewards)
        assert done.episode_return[lane] == pytest.approx(
            np.sum(np.array(rewards, float)), abs=1e-9
        )
        assert done.regret[lane] == pytest.approx(np.mean(regrets), abs=1e-9)
        assert done.similarity[lane] == pytest.approx(np.mean(similarities), abs=1e-9)
    if spec is HARD:
        assert len(set(done.length)) > 3
        assert done.length.max() == spec.horizon


@pytest.mark.parametrize("algorithm", ["PPO", "TD3"])
@pytest.mark.parametrize("spec", [PLAIN, HARD], ids=["plain", "hard"])
def test_the_scores_are_those_of_evaluate_policy(spec: SMESpec, algorithm: str) -> None:
    model, states = trained(algorithm, spec), start_states(0, 0, 3, 3)

    def act(observations: Any) -> Any:
        # Row by row, as SB3 asks: these tasks double a difference in an action's last bit at each
        # step, and a batch of another size has other last bits.
        rows = [model.predict(row[None], deterministic=True)[0] for row in observations]
        return (np.concatenate(rows).astype(np.float64) + 1.0) / 2.0

    done = rollouts(act, materialize(spec), states)
    returns, lengths = evaluated_by_sb3(model, spec, states)
    np.testing.assert_allclose(done.episode_return, returns, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(done.length, lengths)


@pytest.mark.parametrize("algorithm", ["PPO", "TD3"])
def test_the_copied_actor_has_the_scores_of_evaluate_policy_until_chaos_parts_them(
    algorithm: str,
) -> None:
    model, brief = trained(algorithm, PLAIN), PLAIN.derive(horizon=6)
    states = start_states(0, 1, 20, 3)
    fast = numpy_policy(model, PLAIN)
    assert isinstance(fast.act, Perceptron)
    done = rollouts(fast, materialize(brief), states)
    returns, _ = evaluated_by_sb3(model, brief, states)
    np.testing.assert_allclose(done.episode_return, returns, rtol=0, atol=1e-5)
    # And over whole episodes, which are others then, on average: within 4 standard errors.
    states, task = start_states(0, 2, 500, 3), materialize(PLAIN)
    ours = rollouts(fast, task, states).episode_return
    own = rollouts(as_policy(model, PLAIN), task, states).episode_return
    assert np.abs(ours - own).max() > 1e-3
    error = np.sqrt((ours.var() + own.var()) / len(states))
    assert abs(ours.mean() - own.mean()) < 4 * error


def test_per_step_means_weigh_an_episode_by_its_length() -> None:
    done = rollouts(nearly_optimal(HARD), materialize(HARD), start_states(0, 0, 12, 3))
    expected = (done.regret * done.length).sum() / done.length.sum()
    assert done.per_step(done.regret) == pytest.approx(expected)
    assert done.per_step(done.regret) != pytest.approx(done.regret.mean())


def test_start_states_are_new_at_each_evaluation_and_the_same_when_asked_again() -> None:
    first = start_states(3, 0, 5, 8)
    assert first.shape == (5, 8)
    assert np.all((first > 0) & (first < 1))
    np.testing.assert_array_equal(first, start_states(3, 0, 5, 8))
    for other in (start_states(3, 1, 5, 8), start_states(4, 0, 5, 8)):
        assert np.abs(first - other).min() > 0


def test_what_cannot_be_rolled_out_is_refused() -> None:
    task, states = materialize(PLAIN), start_states(0, 0, 2, 3)
    with pytest.raises(StateError, match=r"outside \[0, 1\]"):
        rollouts(nearly_optimal(PLAIN), task, states + 1.0)
    with pytest.raises(StateError, match="must be of shape"):
        rollouts(nearly_optimal(PLAIN), task, states[:, :2])
    with pytest.raises(ActionError, match="must be of shape"):
        rollouts(lambda observations: observations[:, :1], task, states)
    with pytest.raises(ActionError, match="NaN"):
        rollouts(lambda observations: observations[:, :2] * np.nan, task, states)
    team = PLAIN.derive(team={"agents": [{"action_dim": 1}, {"action_dim": 1}]})
    with pytest.raises(SpecError, match="for 2 agents"):
        rollouts(nearly_optimal(PLAIN), materialize(team), states)


def test_a_policy_may_keep_what_it_observed() -> None:
    kept: list[Any] = []

    def remembering(observations: Any) -> Any:
        kept.append(observations)
        return observations[:, :2]

    rollouts(remembering, materialize(PLAIN), start_states(0, 0, 2, 3))
    times = [observations[0, 3] for observations in kept]
    np.testing.assert_allclose(times, np.arange(100) / 100, atol=1e-6)


def test_limits_change_no_return() -> None:
    limited = HARD.derive(D=0.0, safety={"tightness": 0.2})
    act, states = nearly_optimal(limited), start_states(0, 0, 5, 3)
    plain = rollouts(act, materialize(limited.derive(safety=None)), states)
    for one, other in zip(rollouts(act, materialize(limited), states), plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_distractors_depend_on_the_state_of_the_start_and_the_seed() -> None:
    spec = PLAIN.derive(observation={"distractors": 2, "dynamics": "autonomous"}, horizon=20)
    states, task = start_states(0, 0, 5, 3), materialize(spec)

    def seen(rows: Any, seed: int = 0) -> Any:
        kept: list[Any] = []
        rollouts(lambda o: kept.append(o) or np.full((len(o), 2), 0.5), task, rows, seed=seed)  # type: ignore[func-returns-value]
        return np.array(kept)

    all_at_once = seen(states)
    np.testing.assert_array_equal(all_at_once[:, 3:], seen(states[3:]))
    np.testing.assert_array_equal(all_at_once, seen(states))
    distractors = all_at_once[:, :, 3:5]
    assert len(np.unique(distractors)) == distractors.size
    assert not (distractors == seen(states, seed=1)[:, :, 3:5]).any()


def test_a_team_is_rolled_out_as_its_environment_steps_it() -> None:
    spec = PLAIN.derive(
        k=3, horizon=7, team={"agents": [{"action_dim": 1, "observes": [0]}, {"action_dim": 1}]}
    )
    policies = {
        "agent_0": lambda observations: 0.5 * observations[:, :1] + 0.1 * observations[:, -1:],
        "agent_1": lambda observations: 0.3 + 0.4 * observations[:, 1:2] * observations[:, -1:],
    }
    states = start_states(0, 0, 3, spec.state_dim)
    team = as_policy(policies, spec)
    done = rollouts(team, materialize(spec), states)
    env = make_parallel(spec)
    for episode, state in enumerate(states):
        observations, _ = env.reset(options={"state": state})
        regrets, rewards = [], []
        while env.agents:
            actions = {
                name: policies[name](observation[None])[0].astype(np.float32)
                for name, observation in observations.items()
            }
            observations, reward, _, _, infos = env.step(actions)
            regrets.append([info["regret"] for info in infos.values()])
            rewards.append(list(reward.values()))
        assert np.allclose(done.agents_regret[:, episode], np.mean(regrets, axis=0), atol=1e-6)
        assert done.episode_return[episode] == pytest.approx(np.sum(np.mean(rewards, axis=1)))
        assert done.length[episode] == len(regrets)

"""Episodes side by side: the scores of single environments, and of SB3's own evaluation."""

import importlib.util
import itertools
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec, load, make_parallel, materialize
from sme_registry.errors import ActionError
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.training.algorithms import one_thread

PLAIN = SMESpec(state_dim=3, action_dim=2)
# Payouts every 7 steps, a threshold, and an end at the first bad step.
HARD = PLAIN.derive(k=7, r_min=0.1, D=0.05, horizon=40)
both_tasks = pytest.mark.parametrize("spec", [PLAIN, HARD], ids=["plain", "hard"])


def nearly_optimal(spec):
    """Acts row by row, so that neither its batch nor its neighbours change an action's bits."""
    task = materialize(spec)

    def act(observations):
        s = observations[:, : spec.state_dim].astype(np.float64)
        optimal = np.stack([task.optimal_action(row) for row in s])
        return np.clip(optimal + 0.75 * (s[:, :1] - 0.5), 0.0, 1.0).astype(np.float32)

    return act


@pytest.fixture(autouse=True, scope="module")
def single_thread():
    if importlib.util.find_spec("torch") is None:
        yield
    else:
        with one_thread():
            yield


class StartingAt(gymnasium.Wrapper):
    """Begins its episodes at the given states, one after another."""

    def __init__(self, env, states):
        super().__init__(env)
        self.states = iter(states)

    def reset(self, **kwargs):
        # SB3's evaluation begins one episode more than it counts.
        return self.env.reset(options={"state": next(self.states, np.full(3, 0.5))})


def evaluated_by_sb3(model, spec, states):
    """Returns and lengths of `evaluate_policy`, on one environment."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(StartingAt(sme_registry.make(spec, action_range="symmetric"), states))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scores = evaluate_policy(model, env, len(states), return_episode_rewards=True)
    return np.array(scores[0]), np.array(scores[1])


def test_a_recurrent_model_keeps_its_state_during_an_episode():
    contrib = pytest.importorskip("sb3_contrib")
    from sme_registry.sb3 import SMEVecEnv

    spec = PLAIN.derive(horizon=8)  # rounding errors grow from step to step
    model = contrib.RecurrentPPO("MlpLstmPolicy", SMEVecEnv(spec), seed=1, n_steps=16, device="cpu")
    model.policy.action_net.weight.data *= 100.0  # so that its memory matters
    states = start_states(0, 0, 3, 3)
    expected, _ = evaluated_by_sb3(model, spec, states)
    policy, task = as_policy(model, spec), materialize(spec)
    for _ in range(2):  # the second batch starts anew
        found = rollouts(policy, task, states)
        np.testing.assert_allclose(found.episode_return, expected, atol=2e-3)
    without_memory = rollouts(policy.__call__, task, states)
    assert np.abs(without_memory.episode_return - expected).max() > 0.02


def test_a_recurrent_agent_of_a_team_keeps_its_state_during_an_episode():
    def calls():
        numbers = itertools.count()
        return lambda o: np.full((len(o), 2), 0.1 * next(numbers))

    team = as_policy("constant", load("Team2"))
    members = [m._replace(policy=replace(m.policy, episodes=calls)) for m in team.members]
    recurrent = replace(team, members=tuple(members))
    for _ in range(2):  # the second batch starts anew
        act = recurrent.start()
        actions = [act(np.full((3, 11), 0.5, np.float32)) for _ in range(3)]
        np.testing.assert_allclose(np.mean(actions, axis=(1, 2)), [0.0, 0.1, 0.2])


@both_tasks
def test_an_episode_has_the_scores_of_a_single_environment(spec):
    policy, states = nearly_optimal(spec), start_states(0, 0, 12, 3)
    found = rollouts(policy, materialize(spec), states)
    env = sme_registry.make(spec)
    for lane, state in enumerate(states):
        observation, _ = env.reset(options={"state": state})
        steps, ended = [], False
        while not ended:
            action = policy(observation[None])[0]
            observation, reward, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            steps.append((reward, info["regret"], info["similarity"]))
        rewards, regrets, similarities = np.array(steps, float).T
        assert found.length[lane] == len(steps)
        assert found.episode_return[lane] == pytest.approx(rewards.sum(), abs=1e-9)
        assert found.regret[lane] == pytest.approx(regrets.mean(), abs=1e-9)
        assert found.similarity[lane] == pytest.approx(similarities.mean(), abs=1e-9)
    if spec is HARD:
        assert len(set(found.length)) > 3
        assert found.length.max() == spec.horizon
    per_step = (found.regret * found.length).sum() / found.length.sum()
    assert found.per_step(found.regret) == pytest.approx(per_step)
    assert (per_step != pytest.approx(found.regret.mean())) == (spec is HARD)


def test_start_states_are_new_at_each_evaluation_and_the_same_when_asked_again():
    first = start_states(3, 0, 5, 8)
    assert first.shape == (5, 8)
    assert np.all((first > 0) & (first < 1))
    np.testing.assert_array_equal(first, start_states(3, 0, 5, 8))
    for other in (start_states(3, 1, 5, 8), start_states(4, 0, 5, 8)):
        assert np.abs(first - other).min() > 0


@pytest.mark.parametrize(
    ("policy", "message"),
    [(lambda o: o[:, :1], "must be of shape"), (lambda o: o[:, :2] * np.nan, "NaN")],
)
def test_what_cannot_be_rolled_out_is_refused(policy, message):
    with pytest.raises(ActionError, match=message):
        rollouts(policy, materialize(PLAIN), start_states(0, 0, 2, 3))


def shown(spec, states, seed=0):
    """Everything that a policy observes, which it may keep: `[T, B, S + m + 2]`."""
    kept = []

    def half(observations):
        kept.append(observations)
        return np.full((len(observations), 2), 0.5)

    rollouts(half, materialize(spec), states, seed=seed)
    return np.array(kept)


def test_a_policy_may_keep_what_it_observed():
    times = shown(PLAIN, start_states(0, 0, 2, 3))[:, 0, 3]
    np.testing.assert_allclose(times, np.arange(100) / 100, atol=1e-6)


def test_distractors_depend_on_the_state_of_the_start_and_the_seed():
    spec = PLAIN.derive(observation={"distractors": 2, "dynamics": "autonomous"}, horizon=20)
    states = start_states(0, 0, 5, 3)
    together = shown(spec, states)
    np.testing.assert_array_equal(together[:, 3:], shown(spec, states[3:]))
    np.testing.assert_array_equal(together, shown(spec, states))
    distractors = together[:, :, 3:5]
    assert len(np.unique(distractors)) == distractors.size
    assert not (distractors == shown(spec, states, seed=1)[:, :, 3:5]).any()


def test_a_team_is_rolled_out_as_its_environment_steps_it():
    spec = PLAIN.derive(
        k=3, horizon=7, team={"agents": [{"action_dim": 1, "observes": [0]}, {"action_dim": 1}]}
    )
    policies = {
        "agent_0": lambda observations: 0.5 * observations[:, :1] + 0.1 * observations[:, -1:],
        "agent_1": lambda observations: 0.3 + 0.4 * observations[:, 1:2] * observations[:, -1:],
    }
    states = start_states(0, 0, 3, spec.state_dim)
    found = rollouts(as_policy(policies, spec), materialize(spec), states)
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
        assert np.allclose(found.agents_regret[:, episode], np.mean(regrets, axis=0), atol=1e-6)
        assert found.episode_return[episode] == pytest.approx(np.sum(np.mean(rewards, axis=1)))
        assert found.length[episode] == len(regrets)

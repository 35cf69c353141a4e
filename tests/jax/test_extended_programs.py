"""Programs of PPO, TD3 and SAC on tasks with limits, distractors and mixed observations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.errors import UnknownNameError
from sme_registry.evaluation.rollouts import start_states
from sme_registry.jax import task as functions
from sme_registry.jax.off_policy import ReplayRows
from sme_registry.jax.program import _key_of
from sme_registry.jax.run import hidden_of, new_program, policy_of
from sme_registry.jax.task import task_params

pytestmark = pytest.mark.usefixtures("quickly_compiled")

STEPS, S, A, M, T = 48, 3, 2, 4, 7
SMALL = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
SETTINGS = {
    "PPO": {**SMALL, "n_steps": 16, "n_epochs": 2},
    "TD3": {**SMALL, "learning_starts": 6},
    "SAC": {**SMALL, "learning_starts": 6},
}
MIXED = {  # of the algorithms that are trained
    "PPO": {"distractors": M, "dynamics": "autonomous", "mixing": "nonlinear"},
    "TD3": {"distractors": M, "dynamics": "driven", "mixing": "nonlinear"},
}


def spec(observation, **fields):
    base = {"state_dim": S, "action_dim": A, "horizon": T, "safety": {"tightness": 0.3}}
    return SMESpec.from_dict({**base, "observation": observation, **fields})


def new(algorithm, observation, **options):
    """Two runs."""
    specs = [spec(observation), spec(observation, seed=1)]
    settings = SETTINGS[algorithm]
    return new_program(
        f"jax:{algorithm}", specs, [3, 4], hyperparameters=settings, steps=STEPS, **options
    )


@pytest.fixture(scope="module", params=MIXED)
def trained(request):
    program = new(request.param, MIXED[request.param])
    log = program.advance(STEPS)
    program.finish()
    return request.param, program, log


def seen_and_chosen(program):
    """Observations `[steps, runs, O]` and actions `[steps, runs, A]` of the last steps."""
    arrays = program.save()
    if ".steps.observation" in arrays:
        observed, action = arrays[".steps.observation"], arrays[".steps.action"]
        return np.swapaxes(observed, 0, 1), np.swapaxes(action, 0, 1)
    width = S + M + 2
    stored = ReplayRows(*np.split(arrays[".buffer"], [width, width + A], axis=-1), *[None] * 2)
    return stored.observation, stored.action


def test_costs_in_the_log_are_those_of_the_states_behind_the_observations(trained):
    _, program, log = trained
    assert log.cost is not None
    assert log.safe_regret is not None
    assert log.cost.shape == log.safe_regret.shape == (STEPS, 2)
    observed, actions = seen_and_chosen(program)
    for run, task in enumerate(map(materialize, program.specs)):
        s = task.unmixed(observed[:, run, : S + M])[:, :S]
        a = (actions[:, run] + 1.0) / 2.0
        n = len(s)
        np.testing.assert_allclose(log.cost[-n:, run], task.cost(s, a), atol=1e-4)
        np.testing.assert_allclose(log.similarity[-n:, run], task.similarity(s, a), atol=1e-4)
        safe = task.step_reward(s, task.safe_action(s)) - task.step_reward(s, a)
        np.testing.assert_allclose(log.safe_regret[-n:, run], safe, atol=1e-3)
    assert log.cost.max() > 0.01


@pytest.mark.parametrize("algorithm", SETTINGS)
def test_weights_and_hidden_layers_have_the_widths_of_the_agents_observation(algorithm):
    program, uses, settings = new(algorithm, MIXED["PPO"]), f"jax:{algorithm}", SETTINGS[algorithm]
    for run, task in enumerate(program.specs):
        weights = program.weights(run)
        assert isinstance(task, SMESpec)
        observations = np.random.default_rng(0).random((5, task.observation_dim), np.float32)
        actions = policy_of(uses, weights, hyperparameters=settings)(observations)
        assert actions.shape == (5, A)
        (hidden,) = hidden_of(uses, weights, settings)(observations)
        assert hidden.shape == (5, 8)
        mean = {"PPO": "action_net", "TD3": "actor.mu.2", "SAC": "actor.mu"}[algorithm]
        expected = hidden @ weights[f"{mean}.weight"].T + weights[f"{mean}.bias"]
        squashed = expected if algorithm == "PPO" else np.tanh(expected)
        np.testing.assert_allclose(actions, squashed, atol=1e-6)


@pytest.mark.parametrize(("dynamics", "k"), [("noise", 1), ("driven", 2)])
def test_evaluations_are_episodes_of_numpys_task(dynamics, k):
    """From the distractors and with the random numbers that follow from their initial states."""
    observation = {"distractors": M, "dynamics": dynamics, "mixing": "orthogonal"}
    task = spec(observation, k=k)
    program = new_program("jax:PPO", [task], [3], hyperparameters=SETTINGS["PPO"], steps=1)
    weights = dict(program.state.weights)
    weights["action_net.weight"] *= 100.0  # so that actions depend on the observation
    program.state = program.state._replace(weights=weights)
    act = policy_of("jax:PPO", program.weights(0), hyperparameters=SETTINGS["PPO"])
    states = start_states(0, 0, 3, S)
    evaluation = program.evaluate(states[None])
    assert np.unique(np.round(evaluation.similarity, 6)).size == 3
    for episode, s in enumerate(states):
        params, numpy_task = task_params(task), materialize(task)
        key = _key_of(jnp.asarray(s))
        d = np.asarray(functions.first_distractors(key, params))
        similarity, regret, accumulated = 0.0, 0.0, 0.0
        for t in range(T):
            seen = [*numpy_task.seen(s, d), t / T, accumulated / k]
            a = (act(np.array([seen], np.float32))[0] + 1.0) / 2.0
            similarity += numpy_task.similarity(s, a)
            regret += numpy_task.regret(s, a)
            accumulated = 0.0 if (t + 1) % k == 0 else accumulated + numpy_task.step_reward(s, a)
            u = functions.random_numbers(jax.random.fold_in(key, t), params).distractors
            d = numpy_task.distractor_step(d, a) if dynamics == "driven" else np.asarray(u)
            s = numpy_task.transition(s, a)
        assert evaluation.similarity[0, episode] == pytest.approx(similarity, abs=1e-3)
        assert evaluation.regret[0, episode] == pytest.approx(regret, abs=1e-3)


def test_algorithms_for_limits_are_not_in_jax():
    with pytest.raises(UnknownNameError, match=r"uses='PPOLAGRANGIAN': must be 'PPO', 'TD3' or "):
        new_program("jax:PPOLagrangian", [spec(MIXED["PPO"])], [0], steps=1)

"""What all programs have: evaluation, saving, runs that failed."""

from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("jax")

import jax.numpy as jnp

from sme_registry import SMESpec
from sme_registry.errors import OptionError
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.jax.networks import Weights, initial_linear, linear
from sme_registry.jax.program import Program
from sme_registry.task import materialize

BASE = SMESpec(state_dim=3, action_dim=2, horizon=30, seed=1)
COUPLED = (BASE, BASE.derive(k=7, r_min=0.3), BASE.derive(seed=3, D=0.1))
SEPARABLE = (BASE, BASE.derive(seed=2, horizon=33), BASE.derive(seed=3))
BASE_TWICE = (BASE, BASE)


class LinearState(NamedTuple):
    weights: Weights
    count: Any
    buffer: Any


class Linear(Program):
    """The smallest program: a linear policy that does not learn, and critic that nothing reads."""

    buffer = "buffer"

    @staticmethod
    def initial_weights(settings, rng, observation_dim, action_dim):
        both = observation_dim + action_dim
        return {
            **initial_linear(rng, "actor", observation_dim, action_dim),
            **initial_linear(rng, "critic", both, 1),
            "log_std": np.full(action_dim, 0.5, np.float32),
        }

    def initial_state(self, weights, keys):
        return LinearState(weights, jnp.zeros((), jnp.int32), jnp.zeros((self.budget, self.runs)))

    @staticmethod
    def act(settings, weights, observations, symmetric):
        # Rounded, so that another order of its sums does not start another trajectory.
        return jnp.round(32 * linear(weights, "actor", observations)) / 32

    def advance(self, limit):
        raise NotImplementedError

    def finish(self):
        raise NotImplementedError


def program(specs, first_seed=0, **changes):
    seeds = range(first_seed, first_seed + len(specs))
    return Linear((), specs, seeds, **{"steps": 4, "runs": 4, **changes})


CASES = {"coupled": (COUPLED, "symmetric"), "separable": (SEPARABLE, "unit")}


@pytest.mark.parametrize(("specs", "action_range"), CASES.values(), ids=CASES.keys())
def test_evaluations_are_those_of_numpy(specs, action_range):
    """Also beside copies that fill the program up."""
    linear_program = program(specs, action_range=action_range)
    states = np.stack([start_states(run, 0, 5, 3) for run in range(4)])
    evaluation = linear_program.evaluate(states)
    assert evaluation.regret.shape == (4, 5)
    for run, spec in enumerate(specs):
        weights = linear_program.weights(run)

        def policy(observations, weights=weights):
            actions = observations @ weights["actor.weight"].T + weights["actor.bias"]
            actions = np.round(32 * actions) / 32
            return (actions + 1) / 2 if action_range == "symmetric" else actions

        expected = rollouts(policy, materialize(spec), states[run])
        length = evaluation.length[run]
        assert (length == expected.length).all()
        assert evaluation.regret[run] / length == pytest.approx(expected.regret, abs=1e-12)
        assert evaluation.similarity[run] / length == pytest.approx(expected.similarity, abs=1e-12)
        assert evaluation.episode_return[run] == pytest.approx(expected.episode_return, abs=1e-11)


def test_weights_depend_on_their_seed_alone():
    together, alone = program(COUPLED), Linear((), COUPLED[2:], [2], steps=4)
    assert alone.weights(0)["critic.weight"].shape == (1, 3 + 2 + 2)
    for name, weight in alone.weights(0).items():
        assert np.array_equal(together.weights(2)[name], weight)
    assert (together.weights(0)["critic.weight"] != together.weights(1)["critic.weight"]).any()


def test_state_is_restored_whole_also_for_more_steps():
    one, other = program(BASE_TWICE), program(BASE_TWICE, first_seed=7, steps=6)
    one.steps = 3
    one.state = one.state._replace(count=jnp.int32(7), buffer=jnp.ones((4, 4)))
    other.restore(one.save())
    assert other.steps == 3
    assert int(other.state.count) == 7
    assert np.asarray(other.state.buffer).sum(axis=1).tolist() == [4, 4, 4, 4, 0, 0]
    for name, weight in one.state.weights.items():
        assert np.array_equal(other.state.weights[name], weight)


def test_the_state_of_another_program_is_refused():
    two = program(BASE_TWICE)
    with pytest.raises(OptionError, match=r"actor.*float32 of shape \(3, .*must be .*\(4, "):
        two.restore(program(BASE_TWICE, runs=3).save())
    with pytest.raises(OptionError, match=r"buffer.*shape \(6, 4\): must be .*\(4, 4\)"):
        two.restore(program(BASE_TWICE, steps=6).save())
    with pytest.raises(OptionError, match="another program"):
        two.restore({"steps": np.asarray(0)})
    for steps in (np.zeros(2, int), np.asarray(np.nan)):
        with pytest.raises(OptionError, match=r"^arrays\['steps'\]: is .*: must be int64 of shape"):
            two.restore({**program(BASE_TWICE, first_seed=7).save(), "steps": steps})
    np.testing.assert_equal(two.save(), program(BASE_TWICE).save())

"""Programs of TD3 and SAC: the order of steps, updates and evaluations, replay, resuming, NaN."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry.errors import OptionError
from sme_registry.jax.off_policy import read_rows
from sme_registry.jax.program import StepLog
from sme_registry.jax.run import settings_of
from sme_registry.jax.td3_sac import SAC, TD3, SACProgram, TD3Program
from sme_registry.spec import SMESpec
from sme_registry.training.algorithms import nested_hyperparameters

pytestmark = pytest.mark.usefixtures("quickly_compiled")

STARTS, BUDGET = 6, 30
TINY = {"learning_starts": STARTS, "batch_size": 8, "policy_kwargs": {"net_arch": (8,)}}
# As many updates as steps before them; targets move at the first and every second one.
RARE = {
    "train_freq": 3,
    "gradient_steps": -1,
    "target_update_interval": 2,
    "tau": 1.0,
}
KINDS = [(TD3Program, TD3(**TINY)), (SACProgram, SAC(**TINY, **RARE))]
SPECS = [SMESpec(seed=i, state_dim=3, action_dim=2, horizon=7, D=0.2 * i) for i in range(2)]


@pytest.fixture(params=KINDS, ids=["TD3", "SAC"])
def new(request):
    """Makes a program of two runs; all of an algorithm share their compiled code."""
    kind, settings = request.param
    return partial(kind, settings, SPECS, [3, 4], steps=BUDGET)


def test_pieces_of_any_length_give_the_same_bits(new):
    whole, pieces = new(), new()
    log = whole.advance(BUDGET)
    parts = [pieces.advance(limit) for limit in (1, STARTS + 1, STARTS + 2, BUDGET)]
    whole.finish()
    pieces.finish()
    assert pieces.steps == BUDGET
    for own, joined in zip(log, StepLog.joined(parts), strict=True):
        np.testing.assert_array_equal(own, joined)
    assert_equal(whole.save(), pieces.save())


def test_updates_begin_after_the_learning_starts_and_the_last_one_waits(new):
    program = new()
    initial = program.weights(0)
    program.advance(STARTS)
    program.finish()
    assert_equal(program.weights(0), initial)
    program.advance(STARTS + 1)
    assert_equal(program.weights(0), initial)
    program.finish()
    assert not np.array_equal(program.weights(0)[CRITIC], initial[CRITIC])
    finished = program.save()
    program.finish()
    assert_equal(program.save(), finished)


def test_a_finished_program_can_go_on(new):
    whole, continued = new(), new()
    whole.advance(BUDGET)
    continued.advance(STARTS + 5)
    continued.finish()
    continued.advance(BUDGET)
    assert_equal(continued.save(), whole.save())
    continued.finish()  # at the end, the row after the last one is the first
    assert np.array_equal(continued.save()[".buffer"], whole.save()[".buffer"])


def test_td3_moves_its_policy_at_every_second_update():
    kind, settings = KINDS[0]
    program = kind(settings, SPECS, [3, 4], steps=BUDGET)
    program.advance(STARTS + 1)
    initial = program.weights(0)
    changed = []
    for steps in range(STARTS + 2, STARTS + 6):
        program.advance(steps)  # with the updates up to that after the step before
        weights = program.weights(0)
        changed.append({name for name in weights if (weights[name] != initial[name]).any()})
        initial = weights
    critic = {name for name in initial if name.startswith("critic.")}
    assert changed == [critic, set(initial), critic, set(initial)]


def test_updates_of_one_step_count_from_its_first():
    kind, settings = KINDS[1]
    program = kind(settings, SPECS, [3, 4], steps=BUDGET)
    program.advance(STARTS + 3)
    program.finish()
    assert program.state.learner.critic.updates.tolist() == [3, 3]
    weights = program.weights(0)
    assert np.array_equal(weights[CRITIC.replace("critic", "critic_target")], weights[CRITIC])


def test_td3_acts_at_random_until_the_learning_starts():
    kind, settings = KINDS[0]
    program = kind(settings, SPECS, [3, 4], steps=BUDGET)
    program.advance(STARTS + 1)
    act = jax.jit(jax.vmap(partial(kind.act, settings, symmetric=True), (0, 1), 1))
    stored = rows(program)
    policy = np.asarray(act(program.state.weights, jnp.asarray(stored.observation)))
    assert np.allclose(stored.action[STARTS], policy[STARTS], atol=1e-6)
    assert not np.isclose(stored.action[:STARTS], policy[:STARTS], atol=1e-3).any()
    assert 0.2 < np.abs(stored.action[:STARTS]).mean() < 0.8


def test_an_episode_that_was_truncated_is_not_done(new):
    program = new()
    log = program.advance(BUDGET)
    stored = rows(program)
    assert log.truncated.any()
    assert log.terminated.any()
    assert np.array_equal(stored.done, log.terminated)
    assert np.array_equal(stored.reward, log.reward.astype(np.float32))
    ended = log.terminated | log.truncated
    joined = (stored.next_observation[:-1] == stored.observation[1:]).all(axis=-1)
    assert np.array_equal(joined, ~ended[:-1])
    time = stored.next_observation[..., -2]
    assert (time[log.truncated] == 1.0).all()


def test_a_restored_program_goes_on_with_the_same_bits(new):
    program = new()
    program.advance(STARTS + 5)
    saved = program.save()
    assert len(saved[".buffer"]) == program.steps
    copies = {name: array.copy() for name, array in saved.items()}
    log = program.advance(BUDGET)
    assert_equal(saved, copies)
    resumed = new()
    resumed.restore(copies)
    assert_equal(resumed.advance(BUDGET)._asdict(), log._asdict())
    assert_equal(resumed.save(), program.save())


def test_a_run_that_fails_leaves_the_others_alone(new):
    program, failing = new(), new()
    weights = failing.state.weights
    first = next(iter(weights))
    broken = weights | {first: weights[first].at[1].set(jnp.nan)}
    failing.state = failing.state._replace(learner=failing.state.learner._replace(weights=broken))
    log, other = program.advance(BUDGET), failing.advance(BUDGET)
    assert failing.failed().tolist() == [False, True]
    assert np.array_equal(log.regret[:, 0], other.regret[:, 0])
    assert_equal(program.weights(0), failing.weights(0))


@pytest.mark.parametrize(
    ("uses", "name", "value"),
    [
        ("jax:TD3", "batch_size", 0),
        ("jax:TD3", "gradient_steps", -2),
        ("jax:TD3", "train_freq", [1, "episode"]),
        ("jax:SAC", "ent_coef", "auto_0"),
        ("jax:SAC", "target_entropy", "auto_1"),
        ("jax:SAC", "policy_kwargs.net_arch", []),
    ],
)
def test_hyperparameters_out_of_range_are_refused_by_name(uses, name, value):
    with pytest.raises(OptionError, match=rf"^hyperparameters: {name}="):
        settings_of(uses, nested_hyperparameters({name: value}))


CRITIC = "critic.qf0.0.weight"


def rows(program):
    """The buffer, `[steps, runs, ...]`."""
    stored = program.state.buffer[: program.steps]
    each = jnp.arange(program.steps)[None].repeat(stored.shape[1], axis=0)
    read = read_rows(stored, each, program.state.observation.shape[-1])
    return jax.tree.map(lambda array: np.asarray(array).swapaxes(0, 1), read)


def assert_equal(arrays, others):
    assert arrays.keys() == others.keys()
    for name, array in arrays.items():
        assert np.array_equal(array, others[name]), name

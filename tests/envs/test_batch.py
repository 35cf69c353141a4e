"""A batch of teams is the loop of its single teams, bit for bit, over whole episodes."""

import copy
import pickle
import weakref

import numpy as np
import pytest

from sme_registry.envs.batch import Batch, BatchStep
from sme_registry.errors import ActionError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize
from sme_registry.teams import SMETeamEnv, observed_columns

UNEQUAL = {
    "agents": [
        {"name": "scout_0", "action_dim": 1, "observes": [0, 2]},
        {"name": "driver_0", "action_dim": 2},
        {"name": "scout_1", "action_dim": 1, "observes": [1]},
    ]
}
SPECS = {
    "individual": SMESpec(k=3, complexity=2, horizon=25, team=UNEQUAL),
    "shared": SMESpec(k=7, r_min=0.1, horizon=25, team={**UNEQUAL, "reward": "team"}),
    "fragile": SMESpec(D=0.2, k=4, horizon=25, team={**UNEQUAL, "reward": "team"}),
    "one": SMESpec(k=3, horizon=25),
}


def mixed(task, s, rng):
    """Actions between the optimum and noise, some a little outside the range."""
    share = rng.uniform(0.0, 0.6, (len(s), 1))
    best = task.optimal_action(s)
    return (1.0 - share) * best + share * rng.uniform(-0.1, 1.1, best.shape)


@pytest.mark.parametrize("lanes", [1, 131])
@pytest.mark.parametrize("name", SPECS)
def test_a_batch_is_the_loop_of_its_teams_over_whole_episodes(name, lanes, backend):
    task, rng = materialize(SPECS[name]), np.random.default_rng(lanes)
    batch, teams = Batch(task, lanes), [SMETeamEnv(SPECS[name]) for _ in range(min(lanes, 20))]
    # Of large batches some lanes are looked at: the first, the last, and those about a block's end.
    watched = dict(zip([*range(lanes)][-10:] + [*range(lanes)][:10], teams, strict=False))
    observation = batch.observe()
    for lane in range(lanes):
        batch.initial_states.seed(lane, 100 + lane)
    batch.begin(np.arange(lanes), observation)
    columns = observed_columns(task)
    for lane, team in watched.items():
        shown, _ = team.reset(seed=100 + lane)
        for agent, seen in zip(task.names, columns, strict=True):
            np.testing.assert_array_equal(observation[lane, seen], shown[agent])
    episodes = 0
    for _ in range(60):
        actions = mixed(task, batch.state, rng)
        done = batch.advance(actions)
        ended = done.terminated | done.truncated
        for lane, team in watched.items():
            joint = {a: actions[lane, o] for a, o in zip(task.names, task.owned, strict=True)}
            shown, rewards, terminated, truncated, infos = team.step(joint)
            np.testing.assert_array_equal(team.state(), batch.state[lane])
            for agent, (who, own) in enumerate(zip(task.names, task.owned, strict=True)):
                np.testing.assert_array_equal(done.observation[lane, columns[agent]], shown[who])
                info = infos[who]
                np.testing.assert_array_equal(done.optimal[lane, own], info["optimal_action"])
                expected = [
                    info["similarity"], info["step_reward"], info["regret"], rewards[who],
                    info["accumulated_reward"],
                ]  # fmt: skip
                assert done.values[:, agent, lane].tolist() == expected
                assert terminated[who] == done.terminated[lane]
                assert truncated[who] == done.truncated[lane]
            if ended[lane]:
                team.reset()
                episodes += 1
        if ended.any():
            batch.begin(np.flatnonzero(ended), done.observation)
    assert episodes >= 2 * len(watched)


def test_a_refused_step_moves_nothing_and_copies_go_on_as_the_original(backend):
    task = materialize(SPECS["individual"])
    batch = Batch(task, 70)
    batch.begin(np.arange(70), batch.observe())
    good = np.full((70, 4), 0.4)
    batch.advance(good)
    before, broken = batch.observe(), good.copy()
    broken[68, 1] = np.nan
    # Other shapes are refused before machine code reads them.
    for bad in (broken, good[:, :3], good[:69], good[0], np.full((70, 8), 0.4)):
        with pytest.raises(ActionError, match=r"NaN or infinite|must be of shape"):
            batch.advance(bad)
        np.testing.assert_array_equal(batch.observe(), before)
    copies = pickle.loads(pickle.dumps(batch)), copy.deepcopy(batch)
    expected = batch.advance(good)
    for twin in copies:
        for one, other in zip(twin.advance(good), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def torch_tensor(array):
    return pytest.importorskip("torch").from_numpy(array)


HOLDERS = {
    "itself": lambda array: array,
    "a view of a slice": lambda array: array[..., 1:].T[:],
    "strides": lambda array: np.lib.stride_tricks.as_strided(array),
    "an array of a memoryview": lambda array: np.asarray(memoryview(array)),
    "pickle's buffer": pickle.PickleBuffer,
    "DLPack": np.from_dlpack,
    "a row of torch.from_numpy": lambda array: torch_tensor(array)[0],
}


@pytest.mark.parametrize("holder", HOLDERS)
def test_no_step_writes_to_a_result_that_is_held(holder):
    for field in BatchStep._fields:
        spec = SPECS["fragile"].derive(horizon=2)
        if field == "limits":  # which teams have not
            spec = SMESpec(safety={"tightness": 0.2})
        batch, rng = Batch(materialize(spec), 5), np.random.default_rng(0)
        accounts = np.zeros((5, len(batch.task.names)))
        held, kept = [], []
        for _ in range(8):
            for keep in (False, True):  # some are dropped, so that arrays are recycled
                batch.place(rng.random((5, 8)), rng.integers(0, 2, 5), accounts)
                result = getattr(batch.advance(rng.random((5, 4))), field)
                if keep:
                    held.append(HOLDERS[holder](result))
                    kept.append(bytes(np.asarray(held[-1])))
            del result
        assert [bytes(np.asarray(one)) for one in held] == kept, field
        assert len(set(kept)) > 1


def test_a_result_that_nobody_holds_is_written_again_whatever_was_done_to_it():
    batch = Batch(materialize(SPECS["individual"]), 3)
    batch.begin(np.arange(3), batch.observe())
    action = np.full((3, 4), 0.4)
    first = batch.advance(action)
    arrays = [weakref.ref(value.base) for value in first]
    for value in first:
        value.flags.writeable = False
    del first, value
    again = batch.advance(action)
    assert [value.base for value in again] == [array() for array in arrays]
    assert all(value.flags.writeable for value in again)
    held = [batch.advance(action) for _ in range(20)]
    arrays = [weakref.ref(step.observation.base) for step in held]
    del held
    assert sum(array() is not None for array in arrays) == 3  # few are kept of many


def test_the_state_that_is_handed_out_is_a_copy():
    for lanes, state_dim in ((1, 8), (5, 1), (1, 1), (5, 8)):
        batch = Batch(materialize(SMESpec(state_dim=state_dim)), lanes)
        batch.begin(np.arange(lanes), batch.observe())
        before = batch.state.copy()
        batch.state[:] = -7.0
        np.testing.assert_array_equal(batch.state, before)


def test_actions_laid_out_otherwise_are_read_as_they_mean(backend):
    batches = [Batch(materialize(SPECS["one"]), 3) for _ in range(3)]
    for batch in batches:
        batch.begin(np.arange(3), batch.observe(), np.full((3, 8), 0.3))
    a = np.random.default_rng(0).random((3, 4))
    strided = np.repeat(a, 2, axis=1)[:, ::2]
    for batch, actions in zip(batches, (a, np.asfortranarray(a), strided), strict=True):
        batch.advance(actions)
        np.testing.assert_array_equal(batch.state, batches[0].state)

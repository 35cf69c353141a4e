"""A batch of teams is the loop of its single teams, bit for bit, over whole episodes."""

from __future__ import annotations

import copy
import pickle
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sme_registry.envs.batch import Batch, BatchStep
from sme_registry.envs.team import SMETeamEnv, observed_columns
from sme_registry.errors import ActionError, ResourceLimitError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize

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


def mixed(task: Any, s: Any, rng: Any) -> Any:
    """Actions between the optimum and noise, some a little outside the range."""
    share = rng.uniform(0.0, 0.6, (len(s), 1))
    best = task.optimal_action(s)
    return (1.0 - share) * best + share * rng.uniform(-0.1, 1.1, best.shape)


@pytest.fixture(params=["numba", "numpy"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", request.param)
    return str(request.param)


@pytest.mark.parametrize("lanes", [1, 7, 65, 131])
@pytest.mark.parametrize("name", SPECS)
def test_a_batch_is_the_loop_of_its_teams_over_whole_episodes(
    name: str, lanes: int, backend: str
) -> None:
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


def test_a_refused_step_moves_nothing(backend: str) -> None:
    task = materialize(SPECS["individual"])
    batch = Batch(task, 70)
    batch.begin(np.arange(70), batch.observe())
    good = np.full((70, 4), 0.4)
    batch.advance(good)
    before = batch.observe()
    for bad in (np.nan, np.inf, -np.inf):
        actions = good.copy()
        actions[68, 1] = bad
        with pytest.raises(ActionError, match="NaN or infinite"):
            batch.advance(actions)
        np.testing.assert_array_equal(batch.observe(), before)
    twin = Batch(task, 70)
    twin.__setstate__(copy.deepcopy(batch.__getstate__()))
    np.testing.assert_array_equal(batch.advance(good).observation, twin.advance(good).observation)


def test_copies_go_on_as_the_original_does() -> None:
    task = materialize(SPECS["individual"])
    batch = Batch(task, 5)
    batch.begin(np.arange(5), batch.observe())
    batch.advance(np.full((5, 4), 0.4))
    copies = pickle.loads(pickle.dumps(batch)), copy.deepcopy(batch)
    actions = np.full((5, 4), 0.6)
    expected = batch.advance(actions)
    for twin in copies:
        got = twin.advance(actions)
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def torch_tensor(array: Any) -> Any:
    return pytest.importorskip("torch").from_numpy(array)


HOLDERS: dict[str, Callable[[Any], Any]] = {
    "itself": lambda array: array,
    "a slice": lambda array: array[..., 1:],
    "a view of a view": lambda array: array.T[::2].reshape(-1, order="A")[:],
    "other bytes": lambda array: array.view(np.uint8),
    "strides": lambda array: np.lib.stride_tricks.as_strided(array),
    "memoryview": memoryview,
    "an array of a memoryview": lambda array: np.asarray(memoryview(array)),
    "pickle's buffer": pickle.PickleBuffer,
    "DLPack": np.from_dlpack,
    "torch.from_numpy": torch_tensor,
    "a row of torch.from_numpy": lambda array: torch_tensor(array)[0],
}


@pytest.mark.parametrize("field", BatchStep._fields)
@pytest.mark.parametrize("holder", HOLDERS)
def test_no_step_writes_to_a_result_that_is_held(holder: str, field: str) -> None:
    spec = SPECS["fragile"].derive(horizon=2)
    if field == "limits":  # which teams have not
        spec = SMESpec(safety={"tightness": 0.2})
    batch, rng = Batch(materialize(spec), 5), np.random.default_rng(0)
    agents = len(batch.task.names)

    def step() -> Any:
        batch.place(rng.random((5, 8)), rng.integers(0, 2, 5), np.zeros((5, agents)))
        return getattr(batch.advance(rng.random((5, 4))), field)

    held, kept = [], []
    for _ in range(8):
        step()  # dropped, so that arrays are recycled all the while
        held.append(HOLDERS[holder](step()))
        kept.append(bytes(np.asarray(held[-1])))
    assert [bytes(np.asarray(one)) for one in held] == kept
    assert len(set(kept)) > 1


def test_a_result_that_nobody_holds_is_written_again() -> None:
    batch = Batch(materialize(SPECS["individual"]), 3)
    batch.begin(np.arange(3), batch.observe())
    action = np.full((3, 4), 0.4)
    first = batch.advance(action)
    arrays = [weakref.ref(value.base) for value in first]
    del first
    again = batch.advance(action)
    assert [value.base for value in again] == [array() for array in arrays]


def test_few_results_are_kept_of_many_that_were_held() -> None:
    batch = Batch(materialize(SPECS["individual"]), 3)
    batch.begin(np.arange(3), batch.observe())
    held = [batch.advance(np.full((3, 4), 0.4)) for _ in range(20)]
    arrays = [weakref.ref(step.observation.base) for step in held]
    del held
    assert sum(array() is not None for array in arrays) == 3


def test_what_is_done_to_a_result_ends_with_it() -> None:
    batch = Batch(materialize(SPECS["individual"]), 3)
    batch.begin(np.arange(3), batch.observe())
    for _ in range(4):
        step = batch.advance(np.full((3, 4), 0.4))
        assert all(value.flags.writeable for value in step)
        for value in step:
            value.flags.writeable = False


@pytest.mark.parametrize(("lanes", "state_dim"), [(1, 8), (5, 1), (1, 1), (5, 8)])
def test_the_state_that_is_handed_out_is_a_copy(lanes: int, state_dim: int) -> None:
    batch = Batch(materialize(SMESpec(state_dim=state_dim)), lanes)
    batch.begin(np.arange(lanes), batch.observe())
    before = batch.state
    batch.state[:] = -7.0
    np.testing.assert_array_equal(batch.state, before)


def test_a_batch_too_large_for_memory_is_refused() -> None:
    with pytest.raises(ResourceLimitError, match="num_envs=1000000000"):
        Batch(materialize(SPECS["individual"]), 10**9)


@pytest.mark.parametrize("shape", [(2, 3), (3, 4), (2, 8), (8,)])
def test_actions_of_another_shape_are_refused_before_machine_code_reads_them(
    backend: str, shape: tuple[int, ...]
) -> None:
    batch = Batch(materialize(SPECS["one"]), 2)
    batch.begin(np.arange(2), batch.observe())
    before = batch.state
    with pytest.raises(ActionError, match="must be of shape"):
        batch.advance(np.full(shape, 0.5))
    np.testing.assert_array_equal(batch.state, before)


def test_actions_laid_out_otherwise_are_read_as_they_mean(backend: str) -> None:
    batches = [Batch(materialize(SPECS["one"]), 3) for _ in range(3)]
    for batch in batches:
        batch.begin(np.arange(3), batch.observe(), np.full((3, 8), 0.3))
    a = np.random.default_rng(0).random((3, 4))
    strided = np.repeat(a, 2, axis=1)[:, ::2]
    for batch, actions in zip(batches, (a, np.asfortranarray(a), strided), strict=True):
        batch.advance(actions)
        np.testing.assert_array_equal(batch.state, batches[0].state)

"""Learning in hidden tasks over the network: the numbers of local tasks, and no step is lost."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sme_registry import envs, sealed
from sme_registry.errors import (
    ActionError,
    BudgetSpentError,
    EpisodeError,
    OptionError,
    PolicyError,
    SealedError,
)
from sme_registry.sealed import Instance, Ticket, actions_in, connection
from tests.sealed.server import TICKET, Server, challenge_of, serving, spec_of

WAYS_TO_FAIL = ["lose request", "lose answer", "cut answer", "503", "507"]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(connection.time, "sleep", lambda _: None)
    with serving() as server:
        yield server


def random_actions(lanes: int, count: int, low: float = 0.0) -> np.ndarray:
    shape = count, lanes, spec_of(0).action_dim
    return np.random.default_rng(0).uniform(low - 0.1, 1.1, shape).astype(np.float32)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
def test_a_hidden_task_is_stepped_as_the_same_task_is_here(server, action_range):
    here = envs.SMEVectorEnv(spec_of(1), 3, action_range=action_range, autoreset_mode="SameStep")
    hidden = sealed.make_vec(server.url, TICKET, 1, 3, action_range=action_range)
    for name in ("action_space", "observation_space", "single_action_space", "num_envs"):
        assert getattr(hidden, name) == getattr(here, name)
    observation, info = hidden.reset(seed=5)
    assert info == {}
    assert np.array_equal(observation, here.reset(seed=0)[0])
    for actions in random_actions(3, 20, low=hidden.action_space.low.min()):
        # Actions travel as float32 of the unit range.
        unit = actions if action_range == "unit" else ((actions + 1.0) / 2.0)
        sent = unit.astype(np.float32).astype(np.float64)
        local = here.step(sent if action_range == "unit" else 2.0 * sent - 1.0)
        remote = hidden.step(actions)
        for ours, theirs in zip(local[:4], remote[:4], strict=True):
            assert np.array_equal(ours.astype(theirs.dtype), theirs)
        assert set(remote[4]) <= {"final_obs", "_final_obs", "final_info", "_final_info"}
        assert remote[4].get("final_info", {}) == {}
        if "final_obs" in local[4]:
            for ours, theirs in zip(local[4]["final_obs"], remote[4]["final_obs"], strict=True):
                assert np.array_equal(ours, theirs)
    assert hidden.instance.steps_left == 4096 - 60


def test_a_single_environment_has_episodes(server):
    here, hidden = envs.SMEEnv(spec_of(0)), sealed.make(server.url, TICKET)
    assert np.array_equal(hidden.reset()[0], here.reset(seed=0)[0])
    for actions in random_actions(1, 20):
        local, remote = here.step(actions[0].astype(np.float64)), hidden.step(actions[0])
        assert np.array_equal(local[0], remote[0])
        assert np.float32(local[1]) == remote[1]
        assert local[2:4] == remote[2:4]
        assert remote[4] == {}
        if remote[2] or remote[3]:
            with pytest.raises(EpisodeError, match="has ended"):
                hidden.step(actions[0])
            assert np.array_equal(here.reset()[0], hidden.reset()[0])
    assert server.requests.count("POST start?lanes=1") == 1  # a new episode needs no request


def test_a_single_environment_passes_gymnasium_s_checks(server):
    hidden = sealed.make(server.url, TICKET)
    # Gymnasium's checker seeds resets and expects the same states, which the server draws.
    with pytest.raises(AssertionError, match="seed"):
        check_env(hidden, skip_render_check=True)
    wrapped = gymnasium.wrappers.PassiveEnvChecker(hidden)
    wrapped.reset(seed=1)
    wrapped.step(wrapped.action_space.sample())


@pytest.mark.parametrize("fault", WAYS_TO_FAIL)
def test_no_step_is_lost_or_taken_twice(server, fault):
    here = sealed.make_vec(server.url, TICKET, 0, 2)
    here.reset()
    undisturbed = [here.step(actions) for actions in random_actions(2, 10)]
    with serving() as other:
        hidden = sealed.make_vec(other.url, TICKET, 0, 2)
        hidden.reset()
        for expected, actions in zip(undisturbed, random_actions(2, 10), strict=True):
            other.faults = [fault, fault]
            for ours, theirs in zip(expected[:4], hidden.step(actions)[:4], strict=True):
                assert np.array_equal(ours, theirs)
        assert other.hidden[0].number == 10
        assert hidden.instance.number == 10


def test_another_process_goes_on_where_one_was_killed(server):
    whole, parts = Instance(server.url, TICKET, 0, 2), random_actions(2, 12)
    whole.begin()
    expected = [whole.step(actions) for actions in parts]
    with serving() as other:
        killed = Instance(other.url, TICKET, 0, 2)
        killed.begin()
        for actions in parts[:5]:
            last = killed.step(actions)
        resumed = Instance(other.url, TICKET, 0, 2)
        assert np.array_equal(resumed.begin(), last.observation)
        assert resumed.number == 5
        for after, actions in zip(expected[5:], parts[5:], strict=True):
            for ours, theirs in zip(after, resumed.step(actions), strict=True):
                assert np.array_equal(ours, theirs)


def test_reset_does_not_cut_an_episode_short(server):
    hidden = sealed.make(server.url, TICKET)
    hidden.reset()
    observation = hidden.step(np.zeros(2))[0]
    assert np.array_equal(hidden.reset(seed=3)[0], observation)


def test_the_lanes_of_an_instance_stay_the_same(server):
    Instance(server.url, TICKET, 0, 2).begin()
    with pytest.raises(SealedError, match="step_conflict") as caught:
        Instance(server.url, TICKET, 0, 3).begin()
    assert caught.value.code == "step_conflict"
    with pytest.raises(OptionError, match=r"lanes=17: must be an integer in \[1, 16\]"):
        Instance(server.url, TICKET, 0, 17)


def test_a_spent_budget_has_an_error_of_its_own(server):
    server.hidden[0].budget = 5
    hidden = sealed.make_vec(server.url, TICKET, 0, 2)
    hidden.reset()
    for _ in range(2):
        hidden.step(np.zeros((2, 2)))
    with pytest.raises(BudgetSpentError) as caught:
        hidden.step(np.zeros((2, 2)))
    assert pickle.loads(pickle.dumps(caught.value)).code == "budget_spent"
    assert hidden.instance.number == 2


@pytest.mark.parametrize(
    "actions", [np.zeros((3, 2)), np.zeros(2), np.full((2, 2), np.nan), [["a", "b"]] * 2]
)
def test_invalid_actions_are_not_sent(server, actions):
    hidden = sealed.make_vec(server.url, TICKET, 0, 2)
    hidden.reset()
    before = len(server.requests)
    with pytest.raises(ActionError):
        hidden.step(actions)
    assert len(server.requests) == before


def test_steps_need_a_reset_and_resets_have_no_options(server):
    hidden = sealed.make(server.url, TICKET)
    with pytest.raises(EpisodeError, match="Call reset"):
        hidden.step(np.zeros(2))
    with pytest.raises(OptionError, match="the server draws the states"):
        hidden.reset(options={"state": np.zeros(3)})
    assert server.requests == []


def test_another_s_token_is_refused(server):
    stranger = Ticket.from_dict({**TICKET.to_dict(), "token": "cd" * 32})
    with pytest.raises(SealedError, match="token_wrong"):
        sealed.make(server.url, stranger).reset()


def test_a_server_that_does_not_exist_is_reported_soon(monkeypatch):
    waited: list[float] = []
    clock = iter(range(1000))
    monkeypatch.setattr(connection.time, "sleep", waited.append)
    monkeypatch.setattr(connection.time, "monotonic", lambda: float(next(clock)))
    with serving() as server:
        url = server.url
    with pytest.raises(SealedError, match=r"unreachable: .* no step is lost"):
        sealed.make(url, TICKET).reset()
    assert 2 <= len(waited) <= 6


def test_a_server_that_stops_is_waited_for(monkeypatch):
    waited: list[float] = []
    monkeypatch.setattr(connection.time, "sleep", waited.append)
    with serving() as server:
        hidden = sealed.make(server.url, TICKET, patience=60.0)
        hidden.reset()
        server.faults = ["503"] * 20
        hidden.step(np.zeros(2))
    assert len(waited) == 20
    assert waited[0] <= 0.1
    assert 7.5 <= waited[-1] <= 15.0


@pytest.mark.parametrize("form", ["callable", "file"])
def test_answers_are_the_policy_s_actions_in_the_challenge_states(server, tmp_path: Path, form):
    path = TICKET.write(tmp_path / "ticket.json")

    def policy(observations: np.ndarray) -> np.ndarray:
        actions = 2.0 * observations[:, :2] - 1.0
        observations[:] = 0.0  # a policy may write into what it is given
        return actions

    ticket = path if form == "file" else TICKET
    for _ in range(2):  # answers may be repeated
        sealed.answer(server.url, ticket, policy, 1, action_range="symmetric")
    assert np.allclose(server.hidden[1].answers, challenge_of(1)[:, :2], atol=1e-7)
    with Instance(server.url, TICKET) as first:
        status = first.status()
    assert [each.phase for each in status.instances] == ["waiting", "answered"]


def test_a_policy_that_cannot_be_used_does_not_end_the_stepping(server):
    with pytest.raises(PolicyError):
        sealed.answer(server.url, TICKET, "missing.zip")
    assert server.requests == []


def test_actions_are_asked_for_in_every_form_that_evaluate_takes():
    setting = TICKET.place(0).member.setting
    half = actions_in(challenge_of(0), "constant_half", setting)
    assert half.dtype == np.float32
    assert (half == 0.5).all()
    assert actions_in(challenge_of(0)[:0], "random", setting).shape == (0, 2)
    with pytest.raises(PolicyError, match="hidden"):
        actions_in(challenge_of(0), "linear", setting)
    with pytest.raises(PolicyError, match="finite"):
        actions_in(challenge_of(0), lambda o: np.full((len(o), 2), np.nan), setting)


def test_nothing_of_the_token_is_in_an_error_or_a_repr(server):
    server.faults = ["418"]
    hidden = sealed.make(server.url, TICKET)
    with pytest.raises(SealedError) as caught:
        hidden.reset()
    for text in (str(caught.value), repr(hidden), repr(hidden.instance), repr(TICKET)):
        assert TICKET.token not in text

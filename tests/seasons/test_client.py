"""Learning in hidden tasks over the network: the numbers of local tasks, and no step is lost."""

import http.client
import json
import pickle
import ssl
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from leaderboard.seasons.store import SeasonStore
from sme_registry import seasons
from sme_registry.errors import (
    ActionError,
    BudgetSpentError,
    EpisodeError,
    OptionError,
    PolicyError,
    SealedError,
)
from sme_registry.evaluation.references import NAMES, OLD_NAMES
from sme_registry.seasons import Instance, Ticket, wire
from sme_registry.seasons.client import actions_in
from sme_registry.seasons.wire import StepFormat, unpack_table
from sme_registry.spec import Setting
from tests.leaderboard.seasons.playing import ROWS
from tests.seasons.server import BUDGET, serving_season

WAYS_TO_FAIL = ["lose request", "lose answer", "cut answer", "503", "507"]


@pytest.fixture
def waits(monkeypatch):
    """How long the client would have waited between attempts."""
    waited = []
    monkeypatch.setattr(wire, "_sleep", waited.append)
    return waited


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    with serving_season(tmp_path_factory.mktemp("season")) as server:
        yield server


@pytest.fixture
def server(season, waits):
    season.start()
    return season


def random_actions(lanes, count, low=0.0):
    return np.random.default_rng(0).uniform(low - 0.1, 1.1, (count, lanes, 2)).astype(np.float32)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
def test_a_hidden_task_is_stepped_as_the_same_task_is_here(server, action_range):
    here = server.local(1, 3, action_range)
    hidden = seasons.make_vec(server.url, server.ticket, 1, 3, action_range=action_range)
    for name in ("action_space", "observation_space", "single_action_space", "num_envs"):
        assert getattr(hidden, name) == getattr(here, name)
    assert hidden.metadata["autoreset_mode"] == here.metadata["autoreset_mode"]
    observation, info = hidden.reset(seed=5)
    assert info == {}
    assert hidden.np_random.random() == np.random.default_rng(5).random()
    assert np.array_equal(observation, here._batch.observe())
    for actions in random_actions(3, 20, low=hidden.action_space.low.min()):
        # Actions travel as float32 of the unit range.
        unit = actions if action_range == "unit" else (actions.astype(float) + 1.0) / 2.0
        sent = unit.astype(np.float32).astype(float)
        local = here.step(sent if action_range == "unit" else 2.0 * sent - 1.0)
        remote = hidden.step(actions)
        for ours, theirs in zip(local[:4], remote[:4], strict=True):
            assert np.array_equal(ours.astype(theirs.dtype), theirs)
        assert set(remote[4]) <= {"final_obs", "_final_obs", "final_info", "_final_info"}
        assert remote[4].get("final_info", {}) == {}
        if "final_obs" in local[4]:
            for ours, theirs in zip(local[4]["final_obs"], remote[4]["final_obs"], strict=True):
                assert np.array_equal(ours, theirs)
    assert hidden.instance.steps_left == BUDGET - 60


def test_a_single_environment_has_episodes(server):
    here, hidden = server.local(0, 1), seasons.make(server.url, server.ticket)
    assert np.array_equal(hidden.reset()[0], here._batch.observe()[0])
    ended = 0
    for actions in random_actions(1, 20):
        local, remote = here.step(actions), hidden.step(actions[0])
        assert np.float32(local[1][0]) == remote[1]
        assert (local[2][0], local[3][0]) == remote[2:4]
        assert remote[4] == {}
        if remote[2] or remote[3]:
            ended += 1
            assert np.array_equal(local[4]["final_obs"][0], remote[0])
            with pytest.raises(EpisodeError, match="has ended"):
                hidden.step(actions[0])
            assert np.array_equal(local[0][0], hidden.reset()[0])
        else:
            assert np.array_equal(local[0][0], remote[0])
    assert ended == 2
    assert server.requests.count("POST start?lanes=1") == 1  # a new episode needs no request


def test_a_single_environment_passes_gymnasium_s_checks(server):
    hidden = seasons.make(server.url, server.ticket)
    # Gymnasium's checker seeds resets and expects the same states, which the server draws.
    with pytest.raises(AssertionError, match="seed"):
        check_env(hidden, skip_render_check=True)
    wrapped = gymnasium.wrappers.PassiveEnvChecker(hidden)
    wrapped.reset(seed=1)
    observation = wrapped.step(wrapped.action_space.sample())[0]
    assert np.array_equal(wrapped.reset(seed=3)[0], observation)  # the episode goes on
    assert hidden.np_random.random() == np.random.default_rng(3).random()


@pytest.mark.parametrize("fault", WAYS_TO_FAIL)
def test_no_step_is_lost_or_taken_twice(server, fault):
    here, hidden = server.local(0, 2), seasons.make_vec(server.url, server.ticket, 0, 2)
    hidden.reset()
    for actions in random_actions(2, 10):
        server.faults = [fault, fault]
        for ours, theirs in zip(here.step(actions)[:4], hidden.step(actions)[:4], strict=True):
            assert np.array_equal(ours.astype(theirs.dtype), theirs)
    status = hidden.instance.status().instances[0]
    assert (status.requests, status.used) == (hidden.instance.number, 20) == (10, 20)


def test_another_process_goes_on_where_one_was_killed(server):
    here, killed = server.local(0, 2), Instance(server.url, server.ticket, 0, 2)
    parts = random_actions(2, 12)
    killed.begin()
    for actions in parts[:5]:
        here.step(actions)
        last = killed.step(actions)
    server.faults = ["lose answer"]
    resumed = Instance(server.url, server.ticket, 0, 2)
    assert np.array_equal(resumed.begin(), last.observation)
    assert resumed.number == 5
    for actions in parts[5:]:
        local, remote = here.step(actions), resumed.step(actions)
        assert np.array_equal(local[0], remote.observation)
        assert np.array_equal(local[1].astype(np.float32), remote.reward)
    with pytest.raises(SealedError, match="step_conflict"):  # only one at a time can step it
        killed.step(parts[0])


def test_a_ticket_is_shown_only_to_the_server_that_gave_it(server):
    with pytest.raises(OptionError, match=f"url='{server.behind}': must be {server.url}"):
        seasons.make(server.behind, server.ticket)
    assert server.requests == []


def test_after_an_interrupted_step_a_reset_goes_on(server, monkeypatch):
    signer = server.ticket.signer.model_copy(update={"address": None})
    ticket = server.ticket.model_copy(update={"signer": signer})
    hidden = seasons.make_vec(server.behind, ticket, 0, 2)  # the relay is a client, too
    hidden.reset()
    first, second, third = random_actions(2, 3)
    read = http.client.HTTPResponse.read

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(http.client.HTTPResponse, "read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        hidden.step(first)
    monkeypatch.setattr(http.client.HTTPResponse, "read", read)
    with pytest.raises(SealedError, match=r"step_conflict: .* Call `begin` \(.* `reset`\)"):
        hidden.step(second)
    here = server.local(0, 2)
    assert np.array_equal(hidden.reset()[0], here.step(first)[0])
    assert np.array_equal(hidden.step(third)[0], here.step(third)[0])


@pytest.mark.parametrize("code", ["http", "internal"])
def test_a_step_that_a_failing_server_has_taken_is_kept(server, monkeypatch, code):
    hidden = Instance(server.url, server.ticket, lanes=2)
    hidden.begin()
    request = hidden._connection.request

    def failing(*arguments, **options):
        request(*arguments, **options)
        raise SealedError(code, "the server failed")

    monkeypatch.setattr(hidden._connection, "request", failing)
    [first, second] = random_actions(2, 2)
    with pytest.raises(SealedError, match="the server failed"):
        hidden.step(first)
    hidden.close()
    resumed = Instance(server.url, server.ticket, lanes=2)
    resumed.begin()
    assert resumed.number == 1
    resumed.step(second)


def test_refusals_have_the_server_s_codes(server):
    Instance(server.url, server.ticket, 0, 2).begin()
    with pytest.raises(SealedError, match="start_conflict") as caught:  # its lanes stay the same
        Instance(server.url, server.ticket, 0, 3).begin()
    assert caught.value.code == "start_conflict"
    with pytest.raises(OptionError, match=r"lanes=257: must be an integer in \[1, 256\]"):
        Instance(server.url, server.ticket, 0, 257)
    another_s = Ticket.from_dict({**server.ticket.to_dict(), "token": "cd" * 32})
    with pytest.raises(OptionError, match="is in no file"):
        seasons.make(server.url, another_s)
    hidden = seasons.make_vec(server.url, server.ticket, 2, 2)
    hidden.reset()
    for _ in range(4):
        hidden.step(np.zeros((2, 2)))
    with pytest.raises(BudgetSpentError) as caught:
        hidden.step(np.zeros((2, 2)))
    assert pickle.loads(pickle.dumps(caught.value)).code == "budget_spent"
    assert (hidden.instance.number, hidden.instance.steps_left) == (4, 1)


def test_invalid_actions_are_not_sent(server):
    hidden = seasons.make_vec(server.url, server.ticket, 0, 2)
    hidden.reset()
    before = len(server.requests)
    for actions in (np.zeros((3, 2)), np.zeros(2), np.full((2, 2), np.nan), [["a", "b"]] * 2):
        with pytest.raises(ActionError):
            hidden.step(actions)
    assert len(server.requests) == before


def test_steps_need_a_reset_and_resets_have_no_options(server):
    hidden = seasons.make(server.url, server.ticket)
    with pytest.raises(EpisodeError, match="Call reset"):
        hidden.step(np.zeros(2))
    with pytest.raises(OptionError, match="the server draws the states"):
        hidden.reset(options={"state": np.zeros(3)})
    with pytest.raises(PolicyError):  # nor does a policy that cannot be used end the stepping
        seasons.answer(server.url, server.ticket, "missing.zip")
    assert server.requests == []


@pytest.mark.parametrize(
    ("error", "message", "least", "most"),
    [
        (ConnectionRefusedError("refused"), r"unreachable: .* nothing is lost", 2, 6),
        (ssl.SSLCertVerificationError("self-signed"), r"unreachable: .*self-signed", 0, 0),
    ],
)
def test_a_server_that_cannot_be_reached_is_reported_soon(
    server, waits, monkeypatch, error, message, least, most
):
    def fails(_):
        raise error

    clock = iter(range(1000))
    monkeypatch.setattr(wire, "_now", lambda: float(next(clock)))
    monkeypatch.setattr(http.client.HTTPConnection, "connect", fails)
    with pytest.raises(SealedError, match=message):
        seasons.make(server.url, server.ticket).reset()
    assert least <= len(waits) <= most


def test_a_server_that_stops_is_waited_for_until_patience_ends(server, waits, monkeypatch):
    hidden = seasons.make(server.url, server.ticket)
    hidden.reset()
    server.faults = ["lose request"]
    hidden.step(np.zeros(2))
    assert waits == []  # a connection that the server has closed is replaced at once
    server.faults = ["503"] * 10
    hidden.step(np.zeros(2))
    assert len(waits) == 10
    assert waits[0] <= 0.1
    assert 7.5 <= waits[-1] <= 15.0
    assert len(set(waits[-2:])) == 2  # clients of one server do not come back together
    hidden = seasons.make(server.url, server.ticket, patience=3.0)
    hidden.reset()
    clock = iter(range(1000))
    monkeypatch.setattr(wire, "_now", lambda: float(next(clock)))
    server.faults = ["503"] * 20
    with pytest.raises(SealedError, match="unreachable"):
        hidden.step(np.zeros(2))
    server.faults = []
    hidden.step(np.zeros(2))  # nothing is lost
    assert hidden.instance.number == 3


def test_an_answer_that_is_too_long_is_not_read_to_its_end(server, monkeypatch):
    monkeypatch.setattr(wire, "_JSON_BYTES", 10)
    path = wire.ticket_path(server.ticket.season, server.ticket.ticket)
    with pytest.raises(SealedError, match=r"wire: .* answered with more than 20 bytes"):
        wire.Connection(server.url, server.ticket.token).request("GET", path, most=20)


def test_answers_are_the_policy_s_actions_in_the_challenge_states(server):
    def policy(observations):
        actions = 2.0 * observations[:, :2] - 1.0
        observations[:] = 0.0  # a policy may write into what it is given
        return actions

    for ticket in (server.ticket.path, server.ticket):  # answers may be repeated
        seasons.answer(server.url, ticket, policy, 1, action_range="symmetric")
    assert server.answers(1).shape == (ROWS, 2)
    with Instance(server.url, server.ticket) as first:
        status = first.status()
    hidden = server.hidden(1)
    states = unpack_table(hidden.challenge, 5)
    assert np.allclose(server.answers(1), states[:, :2], atol=1e-7)
    assert [each.phase for each in status.instances] == ["waiting", "answered", "waiting"]


def played(server, steps=2):
    """An instance after some steps in two lanes."""
    hidden = Instance(server.url, server.ticket, lanes=2)
    hidden.begin()
    for actions in random_actions(2, steps):
        hidden.step(actions)
    return hidden


def signed_head(server):
    """What the board has of the entrant's last signature; None without any."""
    with SeasonStore.open(server.board.path, read_only=True) as store:
        folder = store.ticket_folder(server.board.season.digest, server.ticket.ticket)
    path = folder / "0.json"
    return json.loads(path.read_bytes())["head"] if path.exists() else None


def test_steps_that_a_server_has_made_up_are_signed_by_nobody(server):
    """It has the ticket's token; a program that goes on has never seen what was answered."""
    played(server).close()
    path = wire.instance_path(server.ticket.season, server.ticket.ticket, 0, "steps")
    body = StepFormat(2, 3, 2).pack(3, np.ones((2, 2)))
    wire.Connection(server.behind, server.ticket.token).request("POST", path, body)
    for goes_on in (
        lambda: Instance(server.url, server.ticket, lanes=2).begin(),
        lambda: seasons.answer(server.url, server.ticket, "constant"),
    ):
        with pytest.raises(SealedError, match=r"transcript: .* has 2 requests .* the server has 3"):
            goes_on()
    assert "POST finish" not in server.requests
    assert signed_head(server) is None


def test_a_ticket_without_its_transcripts_signs_nothing(server, tmp_path):
    played(server).close()
    copy = server.ticket.model_copy()
    copy.write(tmp_path / "ticket.json")
    with pytest.raises(SealedError, match="has 0 requests"):
        seasons.answer(server.url, copy, "constant")
    seasons.answer(server.url, server.ticket, "constant")
    assert signed_head(server)["hashes"] == 4


def test_answers_that_were_altered_on_their_way_get_no_signature_that_fits(server):
    hidden = played(server)
    server.faults = ["alter answer"]
    hidden.step(np.zeros((2, 2)))
    with pytest.raises(SealedError, match="bad_signature"):
        hidden.challenge()
    with pytest.raises(SealedError, match="has shown another answer to request 3 before"):
        Instance(server.url, server.ticket, lanes=2).begin()
    assert signed_head(server) is None


def test_challenge_states_are_shown_once(server):
    hidden = played(server)
    server.faults = ["", "alter answer"]
    hidden.challenge()
    with pytest.raises(SealedError, match="has shown other challenge states before"):
        hidden.challenge()
    with pytest.raises(SealedError, match="bad_signature"):
        hidden.send_answers(np.zeros((ROWS, 2)))
    with pytest.raises(SealedError, match="Ask for them first"):
        Instance(server.url, server.ticket, 1).send_answers(np.zeros((ROWS, 2)))


def test_transcripts_are_signed_as_they_grow(server, monkeypatch):
    for module in ("sme_registry.seasons.client", "leaderboard.seasons.instance"):
        monkeypatch.setattr(f"{module}.EVERY", 4)
    monkeypatch.setattr("sme_registry.seasons.transcript.EVERY", 4)
    numbers = []
    hidden = played(server, 0)
    for actions in random_actions(2, 10):
        hidden.step(actions)
        head = signed_head(server)
        numbers.append(0 if head is None else head["hashes"])
    assert numbers == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]


def test_requests_that_a_server_has_lost_are_taken_again(server):
    """As after a loss of power, but for those that were signed."""
    hidden = played(server, 5)
    hidden._transcript.receive(5, hidden._transcript.head(5))
    hidden._transcript.send(6, bytes(16))  # which never arrived
    hidden.close()
    again = Instance(server.url, server.ticket, lanes=2)
    again.begin()
    assert again.number == 5
    again.step(np.ones((2, 2)))
    again.challenge()


def test_the_last_answers_may_be_repeated_after_they_have_ended_the_ticket(server):
    answers = np.zeros((ROWS, 2))
    for number in range(3):
        with Instance(server.url, server.ticket, number) as hidden:
            assert hidden.challenge().shape == (ROWS, 5)
            hidden.send_answers(answers)
    with Instance(server.url, server.ticket, 2) as hidden:
        deadline = time.monotonic() + 300
        while not has_ended(hidden):
            assert time.monotonic() < deadline, "the server closes no ticket"
            time.sleep(0.05)
        hidden.send_answers(answers)
        with pytest.raises(SealedError, match="ticket_ended"):
            hidden.send_answers(answers + 1)


def has_ended(instance):
    """Whether the server has closed the ticket."""
    try:
        instance.begin()
    except SealedError as error:
        return error.code == "ticket_ended"
    return False


def test_a_policy_in_any_form_that_evaluate_takes_answers_unless_it_needs_the_task():
    setting = Setting(state_dim=3, action_dim=2)
    states = np.random.default_rng(0).random((40, 5), dtype=np.float32)
    for name in (*NAMES, *OLD_NAMES):
        if ("constant" in name and "best" not in name) or "random" in name:
            actions = actions_in(states, name, setting)
            assert (actions.shape, actions.dtype) == ((40, 2), np.float32)
        else:
            with pytest.raises(PolicyError, match="follows from the task, which is hidden"):
                actions_in(states, name, setting)
    assert (actions_in(states, "constant", setting) == 0.5).all()
    assert actions_in(states[:0], "random", setting).shape == (0, 2)
    with pytest.raises(PolicyError, match="finite"):
        actions_in(states, lambda o: np.full((len(o), 2), np.nan), setting)


def test_nothing_of_the_token_is_in_an_error_or_a_repr(server):
    server.faults = ["418"]
    hidden = seasons.make(server.url, server.ticket)
    with pytest.raises(SealedError) as caught:
        hidden.reset()
    for text in (str(caught.value), repr(hidden), repr(hidden.instance), repr(server.ticket)):
        assert server.ticket.token not in text

"""The commands of online seasons, as an entrant types them: a ticket, then its answers."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError
from leaderboard.seasons import entrant
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.web import SeasonRoutes
from sme_registry.seasons import Instance, Ticket
from tests.leaderboard.seasons.playing import online_board
from tests.leaderboard.serving import serving
from tests.leaderboard.test_cli import board_command, fails
from tests.leaderboard.web.test_client import scripted


@pytest.fixture
def board(home):
    SigningKey.generate().write("my.key")
    return online_board(home)


@pytest.fixture
def url(board, monkeypatch):
    monkeypatch.setattr(SeasonRoutes, "job", None)  # nothing is scored
    with serving(board.path, season_secrets=[board.secret]) as url:
        yield url


def start(code, url, *more, season="sealed-online"):
    """What the command writes that starts a ticket."""
    names = "--method", "PPO", "--submitter", "A Lab"
    return command(code, "ticket", url, season, *names, *more)


def command(code, *arguments):
    """What a command writes that ends with this exit code."""
    if code:
        return fails(code, *arguments)
    result = board_command(*arguments)
    assert result.exit_code == 0, result.output
    return result.output


def policy(observations):
    """A policy as `module:function` names it."""
    return observations[:, :1]


def test_a_ticket_is_started_stepped_and_answered(url, board):
    shown = start(0, url, "--knowledge", "family")
    assert "keep it secret" in shown
    ticket = Ticket.read("ticket.json")
    assert ticket.token not in shown
    assert os.stat("ticket.json").st_mode & 0o777 == 0o600
    assert not Path("ticket.json.request").exists()
    with SeasonStore.open(board.path) as store:
        row = store.ticket(board.season.digest, ticket.ticket)
        assert store.request_of(row).content.method.knowledge == "family"
    with Instance(url, ticket, 0, 4) as hidden:
        hidden.begin()
        hidden.step(np.zeros((4, 1)))

    name = f"{__name__}:policy"
    assert "must contain {name}" in command(2, "answer", url, "ticket.json", name)
    shown = command(0, "answer", url, "ticket.json", name, "--instance", "deep-0")
    assert "1 instance without answers" in shown
    assert "error:" in command(2, "answer", url, "ticket.json", "runs/{name}/model.zip")
    assert "must be 'deep-0' or" in command(2, "answer", url, "ticket.json", name, "-i", "deep-2")
    assert "has ended" in command(0, "answer", url, "ticket.json", name)  # of the one that is left
    with Instance(url, ticket) as hidden:
        assert [each.phase for each in hidden.status().instances] == ["answered", "answered"]


def test_files_of_actions_answer_challenges_that_were_fetched(url, board):
    start(0, url)
    ticket = Ticket.read("ticket.json")
    with Instance(url, ticket, 0, 4) as hidden:
        hidden.begin()
    answer = "answer", url, "ticket.json"
    np.save("deep-0.npy", np.full((300, 1), 0.5, "<f4"))
    assert "one of the two" in command(2, *answer)
    assert "one of the two" in command(2, *answer, "{name}.npy", "--challenges", "shown")
    assert "deep-0: steps are left" in command(2, *answer, "deep-0.npy", "-i", "deep-0")
    refused = command(2, *answer, "--challenges", "shown")
    assert "deep-0, deep-1: steps are left" in refused
    assert not Path("shown").exists()
    with Instance(url, ticket) as hidden:
        assert [each.phase for each in hidden.status().instances] == ["stepping", "waiting"]

    command(0, *answer, "--challenges", "shown", "--end-steps", "-i", "deep-0")
    command(0, *answer, "--challenges", "shown", "-i", "deep-0")  # again: no steps are left
    assert [path.name for path in Path("shown").iterdir()] == ["deep-0.npy"]
    states = np.load("shown/deep-0.npy", allow_pickle=False)
    assert states.shape == (300, 4)
    np.save("wide.npy", np.full((300, 2), 0.5, "<f4"))
    assert "must be of shape (300, 1)" in command(2, *answer, "wide.npy", "-i", "deep-0")
    assert "cannot be read" in command(2, *answer, "none.npy", "-i", "deep-0")
    np.save("deep-0.npy", states[:, :1])
    command(0, *answer, "{name}.npy", "-i", "deep-0")
    with SeasonStore.open(board.path, read_only=True) as store:
        folder = store.ticket_folder(board.season.digest, ticket.ticket)
    np.testing.assert_array_equal(np.load(folder / "0.npy", allow_pickle=False), states[:, :1])


def test_an_interrupted_request_gets_the_same_ticket(url, monkeypatch):
    request = entrant.request_ticket

    def interrupted(*arguments):
        request(*arguments)  # type: ignore[arg-type]
        raise BoardError("the answer was lost")

    monkeypatch.setattr(entrant, "request_ticket", interrupted)
    start(2, url)
    assert not Path("ticket.json").exists()
    monkeypatch.setattr(entrant, "request_ticket", request)
    other = SigningKey.generate().write(Path("other.key"))
    assert "bad_signature" in start(1, url, "--key", other)  # and the request is kept
    assert "Repeating ticket.json.request." in start(0, url)
    assert Ticket.read("ticket.json").ticket == 1
    assert "already exists" in start(2, url)
    start(0, url, "--out", "second.json")
    assert Ticket.read("second.json").ticket == 2
    assert "ticket_limit" in start(1, url, "--out", "third.json")
    assert not Path("third.json.request").exists()


def test_refusals_have_stable_codes(url):
    assert "season_unknown" in start(1, url, season="summer")
    assert not Path("ticket.json.request").exists()
    assert "season=" in start(2, url, season="../x")
    start(0, url)
    plain = Ticket.read("ticket.json").to_dict() | {"token": "00" * 32}
    Ticket.from_dict(plain).write("other.json")
    assert "token_wrong" in command(1, "answer", url, "other.json", "constant", "-i", "deep-0")


@pytest.mark.parametrize(
    ("count", "lanes", "message"),
    [(1, None, "has 1 instances: must have 2"), (2, 10**12, "lanes=1000000000000: must be")],
)
def test_a_status_that_is_not_the_ticket_s_is_refused(url, count, lanes, message):
    start(0, url)
    instance = {"phase": "waiting", "lanes": None, "requests": 0, "used": 0}
    instances = [{**instance, "lanes": lanes}, instance][:count]
    status = {"ticket": 1, "phase": "running", "deadline": "x", "instances": instances}
    with scripted(lambda *_: (200, json.dumps(status).encode())) as (liar, asked):
        held = json.loads(Path("ticket.json").read_text())
        held["signer"]["address"] = liar
        Path("ticket.json").write_text(json.dumps(held))
        shown = command(1 if lanes is None else 2, "answer", liar, "ticket.json", "constant")
    assert message in shown
    assert len(asked) == 1

"""Seasons over HTTP, with the client that entrants use, and what follows a ticket that is over."""

import threading
import time

import httpx
import numpy as np
import pytest

from leaderboard.admission import upload_header
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.seasons.season import TicketRequest
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.web import SeasonRoutes
from sme_registry import seasons
from sme_registry.seasons import wire
from tests.leaderboard.seasons.killing import step_through_kills
from tests.leaderboard.seasons.playing import LANES, online_board, request, scored
from tests.leaderboard.seasons.sealing import SETTING, manifest, moment, tiny_season
from tests.leaderboard.serving import serving

OTHER = SigningKey.generate()
MORE_SEASONS = {"second": {}, "few": {"tickets": 1}, "coming": {"opens": moment(0.5)}}


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """Several seasons of one master, in which each test plays with a key of its own."""
    board = online_board(tmp_path_factory.mktemp("online"))
    with SeasonStore.open(board.path) as store:
        for name, fields in MORE_SEASONS.items():
            store.announce(tiny_season("sealed-online", id=name, **fields))
        store.announce(tiny_season("sealed-offline"))
        ada = {"name": "Ada", "key": OTHER.public}
        store.add(board.request(OTHER, submitter=ada))
    return board


@pytest.fixture(scope="module")
def url(board):
    with serving(board.path, season_secrets=[board.secret]) as url:
        yield url


def another(board, name):
    """The same board, and another of its seasons."""
    with SeasonStore.open(board.path, read_only=True) as store:
        return board._replace(season=store.season(name))


def outcome(answer):
    return answer.status_code, answer.json().get("code", "")


def played(url, ticket, number, steps):
    """Random steps on an instance, then the constant ½ as answers."""
    with seasons.Instance(url, ticket, number, lanes=LANES) as instance:
        instance.begin()
        random = np.random.default_rng(number)
        for _ in range(steps):
            instance.step(random.random((LANES, 1), dtype=np.float32))
        states = instance.challenge()
        instance.send_answers(np.full((len(states), 1), 0.5, np.float32))


def test_a_ticket_of_any_season_is_played_and_then_scored_and_logged(url, board, key):
    second = another(board, "second")
    ticket = second.ticket(url, key)
    assert (ticket.season, ticket.ticket) == ("second", 1)
    played(url, ticket, 0, 16)
    with seasons.Instance(url, ticket, 1) as instance:
        assert instance.status().phase == "running"
        files = f"{url}/api/seasons/second/files"
        assert httpx.get(files, trust_env=False).json() == {"files": [], "next": None}
        for path in ("tickets/1/0.journal", ".stepping"):  # secret until the reveal
            assert httpx.get(f"{files}/{path}", trust_env=False).status_code == 404
        played(url, ticket, 1, 5)
        assert instance.status().phase == "ended"
    with SeasonStore.open(board.path, read_only=True) as store:
        deadline = time.monotonic() + 300
        while (result := store.sealed_result(store.ticket(second.season.digest, 1))) is None:
            assert time.monotonic() < deadline, "the server has scored no ticket"
            time.sleep(0.1)
    assert [run.wd_regret for run in result.runs] == [1.0, 1.0]
    assert [each.steps for each in result.stepping] == [64, 20]


def test_a_season_that_is_open_and_a_key_have_only_so_many_tickets(url, board, key):
    few = another(board, "few")
    few.ticket(url, OTHER)
    assert outcome(few.send(url, few.request(key), key)) == (429, "ticket_limit")
    first = board.request(key)
    started, again = (board.send(url, first, key) for _ in range(2))
    second = board.send(url, board.request(key, 1), key)
    assert [started.status_code, again.status_code, second.status_code] == [201, 200, 201]
    assert started.json() == again.json()
    assert second.json()["ticket"] > started.json()["ticket"]
    assert second.json()["token"] != started.json()["token"]
    assert outcome(board.send(url, board.request(key, 2), key)) == (429, "ticket_limit")
    coming = another(board, "coming")
    assert outcome(coming.send(url, coming.request(key), key)) == (422, "season_not_open")


def test_a_request_that_others_read_is_no_password(url, board, key):
    request = board.request(key)
    started = board.send(url, request, key)
    assert started.status_code == 201
    path = url + wire.tickets_path(board.season.id)
    with SeasonStore.open(board.path, read_only=True) as store:
        row = store.ticket(board.season.digest, started.json()["ticket"])
        stored = store.objects.read(row.document)
    without = httpx.post(path, content=stored)
    request = request.content.signed(key, Receiver(request.board, url))
    stale = upload_header(key, request.id, request.receiver, moment(-0.1))
    late = httpx.post(path, content=request.to_bytes(), headers={"Authorization": stale})
    others = board.send(url, request, OTHER)
    assert [outcome(each) for each in (without, late, others)] == [
        (403, "bad_signature"),
        (403, "stale_time"),
        (403, "bad_signature"),
    ]


def test_a_request_that_a_server_in_the_middle_passes_on_starts_no_ticket(url, board, key):
    """Of an entrant who signs for this board's key, which the server tells, and its address."""
    honest, middle = board.request(key), "https://middle.example"
    path = url + wire.tickets_path(board.season.id)
    here, there = (Receiver(honest.board, address) for address in (url, middle))
    unaddressed = Receiver(honest.board)
    for of_request, of_header in (
        (there, there),
        (there, here),
        (here, there),
        (unaddressed, here),
    ):
        signed = honest.content.signed(key, of_request)
        header = {"Authorization": upload_header(key, signed.id, of_header)}
        answer = httpx.post(path, content=signed.to_bytes(), headers=header)
        assert outcome(answer) == (403, "wrong_board")
    with SeasonStore.open(board.path, read_only=True) as store:
        assert store.entrant(honest.id) is None


def test_the_ranking_grows_as_tickets_end(url, board, key):
    season = tiny_season("sealed-online", id="ranked")
    ranked = board._replace(season=season)
    address = f"{url}/api/seasons/ranked/ranking"
    with SeasonStore.open(board.path) as store:
        store.announce(season)
        store.add(ranked.request(key))
        empty = httpx.get(address).json()
        store.finish(scored(store, season, 1))
    grown = httpx.get(address, params={"metric": "ood_regret"}).json()
    assert (empty["metric"], empty["ranking"]) == ("wd_regret", {"generic": [], "family": []})
    [row] = grown["ranking"]["generic"]
    assert (row["method"], row["rank_value"], row["entries_of_key"]) == ("Test", 1.0, 1)
    assert (grown["id"], grown["metric"]) == ("ranked", "ood_regret")
    assert outcome(httpx.get(address, params={"metric": "luck"})) == (400, "bad_request")
    unknown = httpx.get(f"{url}/api/seasons/none/ranking")
    assert outcome(unknown) == (404, "season_unknown")


def test_long_lists_of_files_keep_no_ticket_waiting(url, board, key, monkeypatch):
    ticket, go_on, listing = board.ticket(url, key), threading.Event(), threading.Semaphore(0)
    parts = SeasonRoutes._public_parts

    def slow(*arguments):
        listing.release()
        assert go_on.wait(60)
        return parts(*arguments)

    monkeypatch.setattr(SeasonRoutes, "_public_parts", slow)
    path = f"{url}/api/seasons/{board.season.id}/files"
    get = {"target": httpx.get, "args": (path,), "kwargs": {"timeout": 60, "trust_env": False}}
    threads = [threading.Thread(**get) for _ in range(8)]
    for each in threads:
        each.start()
    assert listing.acquire(timeout=60)
    try:
        with seasons.Instance(url, ticket, patience=5.0) as instance:
            monkeypatch.setattr(wire, "_TIMEOUT", 5.0)
            assert instance.status().phase == "running"
    finally:
        go_on.set()
        for each in threads:
            each.join()


@pytest.mark.parametrize(
    ("changes", "board_key", "status", "code"),
    [
        ({"nonce": "0" * 63}, True, 422, "schema"),
        ({"nonce": "0" * 63 + "G"}, True, 422, "schema"),
        ({"answers_key": None}, True, 422, "schema"),
        ({"transcript": None}, True, 422, "schema"),
        ({"season": "sha256:" + "0" * 64}, True, 404, "season_unknown"),
        ({"created": moment(-30)}, True, 403, "stale_time"),
        ({"created": moment(1)}, True, 403, "stale_time"),
        ({"submitter": {"name": "the board"}}, True, 400, "unsafe_name"),
        ({"submitter": {"name": "ADA"}}, True, 422, "name_taken"),
        ({}, False, 403, "wrong_board"),
    ],
)
def test_requests_for_tickets_are_checked(url, board, key, changes, board_key, status, code):
    with SeasonStore.open(board.path, read_only=True) as store:
        before = len(store.entrants(board.season.digest))
        board_name = store.document.key if board_key else None
    plain = {**manifest(board.season, key), "nonce": "0" * 64, "answers_key": OTHER.public}
    plain["transcript"] = 1
    plain["submitter"] |= changes.get("submitter", {})
    plain |= {name: value for name, value in changes.items() if name != "submitter"}
    signed = TicketRequest.from_dict({**plain, "nonce": "0" * 64}).signed(key, Receiver(board_name))
    if "nonce" in changes:  # which no document of ours can have
        ticket = TicketRequest.model_construct(**{**dict(signed.content), **changes})
        signed = signed.model_copy(update={"content": ticket})
    assert outcome(board.send(url, signed, key)) == (status, code)
    with SeasonStore.open(board.path, read_only=True) as store:
        assert len(store.entrants(board.season.digest)) == before


def test_a_request_opens_no_ticket_of_another_season(url, board, key):
    second, request = another(board, "second"), board.request(key)
    assert board.send(url, request, key).status_code == 201
    for each in (request, board.request(key, 1)):
        assert outcome(second.send(url, each, key)) == (404, "season_unknown")


def test_a_server_steps_only_online_seasons_whose_master_it_has(url, board, key):
    offline = httpx.post(url + wire.tickets_path("sealed-offline"), content=b"{}")
    assert outcome(offline) == (422, "season_track")
    with serving(board.path) as without:
        answer = board.send(without, board.request(key), key)
        unknown = httpx.post(f"{without}/api/seasons/none/tickets", content=b"{}")
        listed = httpx.get(f"{without}/api/seasons").json()["seasons"]
    assert outcome(answer) == (503, "season_not_served")
    assert outcome(unknown) == (404, "season_unknown")
    assert not any(each["served"] for each in listed)
    served = {
        each["id"] for each in httpx.get(f"{url}/api/seasons").json()["seasons"] if each["served"]
    }
    assert served == {board.season.id, *MORE_SEASONS}
    season = httpx.get(f"{url}/api/seasons/{board.season.id}").json()
    assert season["document"] == board.season.to_dict()
    assert season["master"] is None


def test_large_bodies_numbers_and_other_methods_are_refused(url, board, key):
    ticket = board.ticket(url, key)
    number = ticket.ticket
    at = url + wire.instance_path(board.season.id, number, 0, "")
    token = {"Authorization": f"Bearer {ticket.token}"}
    with httpx.Client(trust_env=False, headers=token) as client:
        client.post(at + "start?lanes=4")
        answers = [
            client.post(at + "steps", content=bytes(2000)),
            client.put(at + "answers", content=bytes(2**16)),
            client.post(at + "start?lanes=" + "9" * 30),
            client.post(at.replace("/0/", f"/{10**30}/") + "steps"),
            client.post(at.replace(f"/{number}/", f"/{10**30}/") + "finish"),
            client.post(at.replace(f"/{number}/", f"/{'9' * 5000}/") + "steps"),
            client.post(at.replace(f"/{number}/", "/one/") + "steps"),
        ]
        assert client.put(at + "steps", content=request(1)).status_code == 405
        status = client.get(url + wire.ticket_path(board.season.id, number)).json()
    assert [outcome(each) for each in answers] == [
        (413, "too_large"),
        (413, "too_large"),
        (400, "bad_request"),
        (404, "instance_unknown"),
        (404, "ticket_unknown"),
        (404, "ticket_unknown"),
        (404, "not_found"),
    ]
    assert status["instances"][0]["used"] == 0


def test_entrants_go_on_when_their_server_is_killed(tmp_path):
    member = {"name": "deep", "setting": SETTING, "instances": 1, "budget": 60 * LANES}
    board = online_board(tmp_path, classes=[member])
    step_through_kills(board, tickets=3, requests=60, kills=1)

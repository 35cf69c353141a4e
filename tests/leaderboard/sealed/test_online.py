"""Seasons over HTTP, with the client that entrants use, and what follows a ticket that is over."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from leaderboard.documents.entry import SignedTicketRequest, TicketRequest
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.submission import Envelope
from leaderboard.errors import Rejection
from leaderboard.intake import start_ticket, upload_header
from leaderboard.sealed import Tickets
from leaderboard.sealed.attendant import Attendant
from leaderboard.sealed.scores import score_ticket
from leaderboard.store import Store
from sme_registry import sealed
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.sealed.playing import online_board
from tests.leaderboard.sealing import MASTER, manifest, moment, signed_request, tiny_season
from tests.leaderboard.serving import serving

KEY = SigningKey.generate()
OTHER = SigningKey.generate()


def played(url: str, ticket: sealed.Ticket, number: int, steps: int) -> None:
    """Random steps on an instance, then the constant ½ as answers."""
    instance = sealed.Instance(url, ticket, number, lanes=4)
    instance.begin()
    random = np.random.default_rng(number)
    for _ in range(steps):
        instance.step(random.random((4, 1), dtype=np.float32))
    states = instance.challenge()
    instance.send_answers(np.full((len(states), 1), 0.5, np.float32))
    instance.close()


def attend(attendant: Attendant, times: int) -> None:
    """Attend to a season so often, each time when the last ticket is scored."""
    for _ in range(times):
        attendant.attend()
        for process in multiprocessing.active_children():
            process.join()


def test_a_ticket_that_cannot_be_scored_holds_up_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = online_board(tmp_path)
    with serving(board.path, season_secrets=[board.secret]) as url:
        for nonce in range(2):
            ticket = board.ticket(url, KEY, nonce)
            with sealed.Instance(url, ticket, 0, lanes=4) as instance:
                instance.begin()
                instance.step(np.zeros((4, 1), np.float32))
    clock = time.time
    monkeypatch.setattr("leaderboard.sealed.tickets.time.time", lambda: clock() + 25 * 3600)
    with Store.open(board.path) as store:
        broken = store.season_folder(board.season.digest).ticket(1) / "0.journal"
        broken.write_bytes(b"no journal")
        tickets = Tickets(store, board.secret)
        attendant = Attendant(tickets)
        attend(attendant, times=3)
        assert tickets.over() == [1]
        broken.unlink()
        monkeypatch.setattr("leaderboard.sealed.attendant.time.monotonic", lambda: 1e9)
        attend(attendant, times=2)
        assert tickets.over() == []
        tickets.close()


def test_tickets_that_nobody_played_score_one_without_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = online_board(tmp_path)
    with serving(board.path, season_secrets=[board.secret]) as url:
        for nonce in range(2):
            ticket = board.ticket(url, KEY, nonce)
        with sealed.Instance(url, ticket, 0, lanes=48) as instance:
            instance.begin()
    clock = time.time
    monkeypatch.setattr("leaderboard.sealed.tickets.time.time", lambda: clock() + 25 * 3600)
    monkeypatch.delattr(Attendant, "_start")
    with Store.open(board.path) as store:
        tickets = Tickets(store, board.secret)
        evaluated = [score_ticket(store, board.season, MASTER, number) for number in (1, 2)]
        Attendant(tickets).attend()
        assert tickets.over() == []
        assert [
            store.sealed_result(row) for row in store.entrants(board.season.digest)
        ] == evaluated
        # Nor does such a ticket keep its name from others.
        assert store.holder_of_name(f"Tester {KEY.public[:8]}") is None
        tickets.close()


def test_a_season_and_a_key_have_only_so_many_tickets(tmp_path: Path) -> None:
    board = online_board(tmp_path, tickets=1)
    with serving(board.path, season_secrets=[board.secret]) as url:
        board.ticket(url, KEY)
        answer = board.send(url, board.request(OTHER), OTHER)
    assert (answer.status_code, answer.json()["code"]) == (429, "ticket_limit")


def test_tickets_count_towards_the_quota_of_a_day(tmp_path: Path) -> None:
    board = online_board(tmp_path, tickets_per_key=100)
    with Store.open(board.path) as store:
        limit = store.document.limits.submissions_per_day
        for nonce in range(limit):
            store.start_ticket(board.request(KEY, nonce))
    with serving(board.path, season_secrets=[board.secret]) as url:
        answer = board.send(url, board.request(KEY, limit), KEY)
    assert (answer.status_code, answer.json()["code"]) == (429, "quota")


def test_a_full_board_starts_no_ticket(tmp_path: Path) -> None:
    season = tiny_season("sealed-online")
    with tiny_board(tmp_path / "board", limits={"total_bytes": 100}) as store:
        store.announce(season)
        envelope = Envelope.read(signed_request(store, season, KEY).to_bytes(), SignedTicketRequest)
        with pytest.raises(Rejection, match="quota"):
            start_ticket(store, envelope, season.digest)
        assert store.entrants(season.digest) == []


def test_a_request_that_others_read_is_no_password(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    request = board.request(KEY)
    with (
        serving(board.path, season_secrets=[board.secret]) as url,
        httpx.Client(trust_env=False) as client,
    ):
        assert board.send(url, request, KEY).status_code == 201
        path = url + sealed.tickets_path(board.season.id)
        stored = board.path.glob("seasons/*/tickets/1/ticket.json")
        without = client.post(path, content=next(stored).read_bytes())
        stale = upload_header(KEY, request.id, moment(-0.1), board=request.board)
        late = client.post(path, content=request.to_bytes(), headers={"Authorization": stale})
        others = board.send(url, request, OTHER)
    answers = [(each.status_code, each.json()["code"]) for each in (without, late, others)]
    assert answers == [(403, "bad_signature"), (403, "stale_time"), (403, "bad_signature")]


def test_a_ticket_is_played_and_then_scored_and_logged(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with serving(board.path, season_secrets=[board.secret]) as url:
        ticket = board.ticket(url, KEY)
        played(url, ticket, 0, 16)
        instance = sealed.Instance(url, ticket, 1, lanes=4)
        assert instance.status().phase == "running"
        played(url, ticket, 1, 5)
        assert instance.status().phase == "ended"
        instance.close()
    with Store.open(board.path) as store:
        tickets = Tickets(store, board.secret)
        attend(Attendant(tickets), times=2)
        assert tickets.over() == []
        tickets.close()
        result = store.sealed_result(store.ticket(board.season.digest, 1))
    assert result is not None
    assert [run.wd_regret for run in result.runs] == [1.0, 1.0]
    assert [each.steps for each in result.stepping] == [64, 20]


def test_the_ranking_grows_as_tickets_end(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with Store.open(board.path) as store:
        store.start_ticket(board.request(KEY))
    with serving(board.path) as url:
        address = f"{url}/api/seasons/{board.season.id}/ranking"
        empty = httpx.get(address).json()
        with Store.open(board.path) as store:
            result = score_ticket(store, board.season, MASTER, 1)
            store.end_ticket(board.season.digest, 1, result)
        ranked = httpx.get(address, params={"metric": "ood_regret"}).json()
        other = httpx.get(address, params={"metric": "luck"})
        unknown = httpx.get(f"{url}/api/seasons/none/ranking")
    assert (empty["metric"], empty["ranking"]) == ("wd_regret", {"generic": [], "family": []})
    [row] = ranked["ranking"]["generic"]
    assert (row["method"], row["value"], row["entrants_of_key"]) == ("Test", 1.0, 1)
    assert (ranked["id"], ranked["metric"]) == (board.season.id, "ood_regret")
    assert (other.status_code, other.json()["code"]) == (400, "bad_request")
    assert (unknown.status_code, unknown.json()["code"]) == (404, "season_unknown")


def test_all_seasons_of_a_master_are_served(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    second = board._replace(season=tiny_season("sealed-online", id="second"))
    with Store.open(board.path) as store:
        store.announce(second.season)
    with serving(board.path, season_secrets=[board.secret]) as url:
        for each in (board, second):
            ticket = each.ticket(url, KEY)
            assert (ticket.season, ticket.ticket) == (each.season.id, 1)
            played(url, ticket, 0, 2)


def test_the_same_request_has_the_same_ticket_and_another_one_a_new_ticket(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    request = board.request(KEY)
    with serving(board.path, season_secrets=[board.secret]) as url:
        first, again = (board.send(url, request, KEY) for _ in range(2))
        other = board.send(url, board.request(KEY, 1), KEY)
        limited = board.send(url, board.request(KEY, 2), KEY)
    assert [first.status_code, again.status_code, other.status_code] == [201, 200, 201]
    assert first.json() == again.json()
    assert [first.json()["ticket"], other.json()["ticket"]] == [1, 2]
    assert first.json()["token"] != other.json()["token"]
    assert (limited.status_code, limited.json()["code"]) == (429, "ticket_limit")


@pytest.mark.parametrize(
    ("changes", "board_key", "status", "code"),
    [
        ({"nonce": "0" * 63}, True, 422, "schema"),
        ({"nonce": "0" * 63 + "G"}, True, 422, "schema"),
        ({"answers_key": None}, True, 422, "schema"),
        ({"season": "sha256:" + "0" * 64}, True, 404, "season_unknown"),
        ({"created": moment(-30)}, True, 403, "stale_time"),
        ({"created": moment(1)}, True, 403, "stale_time"),
        ({"submitter": {"name": "the board", "key": KEY.public}}, True, 400, "unsafe_name"),
        ({}, False, 403, "wrong_board"),
    ],
)
def test_requests_for_tickets_are_checked(
    tmp_path: Path, changes: dict[str, Any], board_key: bool, status: int, code: str
) -> None:
    board = online_board(tmp_path)
    plain = {**manifest(board.season, KEY), "nonce": "0" * 64, "answers_key": OTHER.public}
    plain |= changes
    valid = TicketRequest.from_dict({**plain, "nonce": "0" * 64})
    with Store.open(board.path) as store:
        signed = valid.signed(KEY, store.document.key if board_key else None)
    if plain["nonce"] != "0" * 64:
        request = TicketRequest.model_construct(**{**dict(valid), "nonce": plain["nonce"]})
        signed = signed.model_copy(
            update={
                "ticket": request,
                "signature": KEY.sign("ticket", request.digest, signed.board),
            }
        )
    with serving(board.path, season_secrets=[board.secret]) as url:
        answer = board.send(url, signed, KEY)
        assert (answer.status_code, answer.json()["code"]) == (status, code)
        names = [each["id"] for each in httpx.get(f"{url}/api/seasons").json()["seasons"]]
    assert names == [board.season.id]
    with Store.open(board.path) as store:
        assert store.entrants(board.season.digest) == []


def test_a_request_of_one_season_opens_no_ticket_of_another(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    other = tiny_season("sealed-online", id="other")
    with Store.open(board.path) as store:
        store.announce(other)
        envelope = Envelope.read(board.request(KEY).to_bytes(), SignedTicketRequest)
        assert start_ticket(store, envelope, board.season.digest) == (1, True)
        new = Envelope.read(board.request(KEY, 1).to_bytes(), SignedTicketRequest)
        for each in (envelope, new):
            with pytest.raises(Rejection, match="season_unknown"):
                start_ticket(store, each, other.digest)
        assert start_ticket(store, envelope, board.season.digest) == (1, False)
        assert len(store.entrants(board.season.digest)) == 1


def test_a_request_for_another_board_starts_no_ticket(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with Store.open(board.path) as store:
        elsewhere = board.request(KEY).ticket.signed(KEY, "ab" * 32)
        envelope = Envelope.read(elsewhere.to_bytes(), SignedTicketRequest)
        with pytest.raises(Rejection, match="wrong_board"):
            start_ticket(store, envelope, board.season.digest)


def test_a_name_belongs_to_one_key(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with serving(board.path, season_secrets=[board.secret]) as url:
        board.ticket(url, KEY)
        name = {"name": f"Tester {KEY.public[:8]}", "key": OTHER.public}
        answer = board.send(url, board.request(OTHER, submitter=name), OTHER)
    assert (answer.status_code, answer.json()["code"]) == (422, "name_taken")


@pytest.mark.parametrize(
    ("times", "code"),
    [((moment(0.5), moment(1)), "season_not_open"), ((moment(-1), moment(0.5)), "season_closed")],
)
def test_tickets_start_while_the_season_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: tuple[str, str], code: str
) -> None:
    board = online_board(tmp_path, opens=times[0], closes=times[1])
    if code == "season_closed":
        monkeypatch.setattr("leaderboard.store.sealed.now", lambda: moment(0.6))
    with serving(board.path, season_secrets=[board.secret]) as url:
        answer = board.send(url, board.request(KEY), KEY)
    assert (answer.status_code, answer.json()["code"]) == (422, code)


def test_a_server_without_the_master_steps_nothing(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with serving(board.path) as url:
        answer = board.send(url, board.request(KEY), KEY)
        unknown = httpx.post(f"{url}/api/seasons/none/tickets", content=b"{}")
        [listed] = httpx.get(f"{url}/api/seasons").json()["seasons"]
        season = httpx.get(f"{url}/api/seasons/{board.season.id}").json()
    assert (answer.status_code, answer.json()["code"]) == (503, "season_not_served")
    assert (unknown.status_code, unknown.json()["code"]) == (404, "season_unknown")
    assert not listed["served"]
    assert season["document"] == board.season.to_dict()
    assert season["master"] is None


def test_large_bodies_and_numbers_are_refused(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with (
        serving(board.path, season_secrets=[board.secret]) as url,
        httpx.Client(trust_env=False) as client,
    ):
        ticket = board.ticket(url, KEY)
        token = {"Authorization": sealed.bearer(ticket.token)}
        at = url + sealed.instance_path(board.season.id, 1, 0, "")
        client.post(at + "start?lanes=4", headers=token)
        answers = [
            client.post(at + "steps", content=bytes(2000), headers=token),
            client.put(at + "answers", content=bytes(2**16), headers=token),
            client.post(at + "start?lanes=" + "9" * 30, headers=token),
            client.post(at.replace("/0/", f"/{10**30}/") + "steps", headers=token),
            client.post(at.replace("/1/", f"/{10**30}/") + "finish", headers=token),
            client.post(at.replace("/1/", f"/{'9' * 5000}/") + "steps", headers=token),
            client.post(at.replace("/1/", "/one/") + "steps", headers=token),
        ]
    codes = [(each.status_code, each.json()["code"]) for each in answers]
    assert codes == [
        (413, "too_large"),
        (413, "too_large"),
        (400, "bad_request"),
        (404, "instance_unknown"),
        (404, "ticket_unknown"),
        (404, "ticket_unknown"),
        (404, "not_found"),
    ]


def test_steps_are_posted(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with (
        serving(board.path, season_secrets=[board.secret]) as url,
        httpx.Client(trust_env=False) as client,
    ):
        ticket = board.ticket(url, KEY)
        token = {"Authorization": sealed.bearer(ticket.token)}
        at = url + sealed.instance_path(board.season.id, 1, 0, "")
        client.post(at + "start?lanes=4", headers=token)
        body = sealed.StepFormat(4, 2, 1).pack_request(1, np.zeros((4, 1)))
        assert client.put(at + "steps", content=body, headers=token).status_code == 405
        status = client.get(url + sealed.ticket_path(board.season.id, 1), headers=token).json()
    assert status["instances"][0]["used"] == 0


def test_an_offline_season_starts_no_ticket(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    offline = tiny_season("sealed-offline")
    with Store.open(board.path) as store:
        store.announce(offline)
    with serving(board.path, season_secrets=[board.secret]) as url:
        answer = httpx.post(url + sealed.tickets_path(offline.id), content=b"{}")
    assert (answer.status_code, answer.json()["code"]) == (422, "season_track")

"""Before the reveal nothing that a server writes or answers holds what only the master tells."""

import http.client
import logging
import pickle

import httpx
import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.scoring.worker import Work, run_scorer
from leaderboard.seasons.scoring import instances
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import Sessions
from sme_registry import SMEError, materialize, seasons
from sme_registry.errors import SealedError
from sme_registry.seasons import wire
from tests.leaderboard.seasons.playing import LANES, online_board, playing, request, scored
from tests.leaderboard.seasons.sealing import MASTER
from tests.leaderboard.serving import serving

KEY = SigningKey.generate()


def secrets_of(board, store):
    """What must not be found: master, seeds and digests as texts and bytes, the task's numbers."""
    nonce = store.request_of(store.ticket(board.season.digest, 1)).content.nonce
    texts = [MASTER.raw.hex()]
    raw = [MASTER.raw]
    for hidden in instances(board.season, MASTER, "1", nonce):
        digits = str(hidden.spec.seed)[2:]
        texts += [digits, str(int(digits, 16)), hidden.spec.digest.removeprefix("sha256:")]
        texts += [str(hidden.starts), f"{hidden.starts:x}", str(hidden.protocol.seed)]
        raw += [hidden.starts.to_bytes(32), bytes.fromhex(digits.zfill(64))]
        task = materialize(hidden.spec)
        raw += [task.W[0].tobytes(), task.layers[0][0][0].tobytes()]
        texts += [repr(float(task.W[0, 0])), repr(float(task.layers[0][0][0, 0]))]
    return [*(text.encode() for text in texts), *raw]


def play(url, board):
    """Every request of an entrant, and a refused one of each kind."""
    ticket = board.ticket(url, KEY)
    at = wire.ticket_path(board.season.id, ticket.ticket)
    connection = wire.Connection(url, ticket.token)

    def refused(method, action, body=b""):
        with pytest.raises(SealedError):
            connection.request(method, f"{at}/{action}", body)

    with seasons.Instance(url, ticket, lanes=LANES) as instance:
        instance.begin()
        for _ in range(16):
            instance.step(np.full((LANES, 1), 0.5, np.float32))
        for body in (request(1), request(18), request(17), request(16, np.nan), b"x"):
            refused("POST", "instances/0/steps", body)
        for lanes in ("5", "x"):
            refused("POST", f"instances/0/start?lanes={lanes}")
        refused("GET", "instances/0/challenge")
        refused("POST", "instances/0/finish")
        answers = np.full((len(instance.challenge()), 1), 0.5)
        for body in (b"x", wire.pack_table(answers)):
            refused("PUT", "instances/0/answers", body)
        refused("POST", "end")
        instance.send_answers(answers)
        instance.status()
    for path in ("", f"/{board.season.id}", f"/{board.season.id}/ranking"):
        connection.request("GET", f"/api/seasons{path}")
    connection.request("GET", "/api/log")


def test_no_answer_file_or_log_holds_a_secret(tmp_path, caplog, monkeypatch):
    board = online_board(tmp_path)
    answered, statuses, read = [], set(), http.client.HTTPResponse.read

    def recorded(answer, *arguments):
        data = read(answer, *arguments)
        answered.extend([data, str(answer.headers).encode()])
        statuses.add(answer.status)
        return data

    monkeypatch.setattr(http.client.HTTPResponse, "read", recorded)
    with (
        caplog.at_level(logging.DEBUG),
        serving(board.path, season_secrets=[board.secret]) as url,
    ):
        play(url, board)
    assert statuses == {200, 201, 400, 403, 409, 422}
    with SeasonStore.open(board.path) as store:
        store.finish(scored(store, board.season, 1))
        searched = secrets_of(board, store)
    parts = {f"answer {i}": part for i, part in enumerate(answered)}
    parts["log"] = caplog.text.encode()
    files = [path for path in board.path.rglob("*") if path.is_file()]
    assert {"index.sqlite", "0.journal", "0.npy", "0.npz"} <= {path.name for path in files}
    parts |= {path.name: path.read_bytes() for path in files}
    found = [name for name, part in parts.items() for each in searched if each in part]
    assert found == []
    assert any(each in board.secret.read_bytes() for each in searched)  # the search can find


def test_answers_to_steps_have_one_form(tmp_path):
    """The same head and size, whether episodes end or not, in any task."""
    board = online_board(tmp_path)
    size, heads = wire.StepFormat(LANES, 2, 1).answer_bytes, set()
    with serving(board.path, season_secrets=[board.secret]) as url, httpx.Client() as client:
        for nonce in range(2):
            ticket = board.ticket(url, KEY, nonce)
            token = {"Authorization": f"Bearer {ticket.token}"}
            at = url + wire.instance_path(board.season.id, ticket.ticket, 0, "")
            client.post(at + "start?lanes=4", headers=token)
            for number in range(1, 17):
                body = request(number, number / 16)
                answer = client.post(at + "steps", content=body, headers=token)
                assert len(answer.content) == size
                heads.add(tuple((k, v) for k, v in answer.headers.raw if k.lower() != b"date"))
    assert len(heads) == 1


def test_a_fault_is_logged_without_its_text(tmp_path, caplog, monkeypatch):
    def fails(*_):
        raise SMEError("the seed is 0x5eed")

    monkeypatch.setattr("leaderboard.scoring.worker.log_to_terminal", lambda: None)
    with playing(online_board(tmp_path)) as played:
        monkeypatch.setattr(Sessions, "sync", fails)
        played.sessions.attend()
        played.store.queue.add_jobs([played.request.id])
        stop = iter((False, True))
        run_scorer(
            played.board.path,
            work=Work(job=fails, board=SeasonStore),
            until_empty=False,
            stop=stop.__next__,
        )
        assert played.store.queue.count("faults") == 1
    assert caplog.text.count("SMEError") == 2
    assert "5eed" not in caplog.text


def test_what_holds_a_secret_shows_none(tmp_path):
    with playing(online_board(tmp_path)) as played:
        searched = secrets_of(played.board, played.store)
        ticket = played.ticket
        holders = (MASTER, ticket, ticket.hidden(0), ticket.instance(0))
        shown = [repr(each).encode() for each in (*holders, ticket.document)]
    assert not any(each in text for text in shown for each in searched)
    with pytest.raises((TypeError, pickle.PicklingError)):
        pickle.dumps(ticket)

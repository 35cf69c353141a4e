"""Before the reveal nothing that a server writes or answers holds what only the master tells."""

import logging
import pickle

import httpx
import numpy as np
import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.scoring.worker import Work, run_scorer
from leaderboard.seasons.entrant import signer_of
from leaderboard.seasons.scoring import instances
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import Sessions
from sme_registry import SMEError, materialize, seasons
from sme_registry.seasons import wire
from sme_registry.seasons.transcript import Chain, answers_head, challenge_head, next_head
from tests.leaderboard.seasons.playing import LANES, online_board, playing, request, scored
from tests.leaderboard.seasons.sealing import MASTER
from tests.leaderboard.serving import receiver, serving

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


def everything(url, board, client):
    """The answers to every request of an entrant, and to a refused one of each kind."""
    signed = board.request(KEY).for_receiver(receiver(url), KEY)
    started = board.send(url, signed, KEY)
    yield started
    ticket = seasons.Ticket.from_dict(started.json())
    signer = signer_of(signed, KEY)
    assert signer is not None
    token = {"Authorization": f"Bearer {ticket.token}"}

    def at(action):
        return url + wire.instance_path(board.season.id, 1, 0, action)

    def step(number, value=0.5):
        return client.post(at("steps"), content=request(number, value), headers=token)

    yield client.get(f"{url}/api/seasons")
    yield client.get(f"{url}/api/seasons/{board.season.id}")
    yield client.get(f"{url}/api/log")
    yield client.get(url + wire.ticket_path(board.season.id, 1))
    chain = Chain(request=signed.id, ticket=1, instance=0)
    started = client.post(at("start?lanes=4"), headers=token)
    yield started
    head = chain.first_head(4, started.content)
    for number in range(1, 17):
        answer = step(number)
        yield answer
        head = next_head(head, request(number, 0.5), answer.content)
    yield from (step(1), step(18), step(17), step(16, np.nan), step(16, 0.1))
    yield client.post(at("steps"), content=b"x", headers=token)
    yield client.post(at("start?lanes=5"), headers=token)
    yield client.post(at("start?lanes=x"), headers=token)
    yield client.get(at("challenge"), headers=token)
    yield client.post(at("finish"), headers=token)
    yield client.post(at(f"finish?signature={signer.sign(chain.at(16, head))}"), headers=token)
    challenge = client.get(at("challenge"), headers=token)
    yield challenge
    yield client.put(at("answers"), content=b"x", headers=token)
    answers = wire.pack_table(np.full((300, 1), 0.5))
    yield client.put(at("answers"), content=answers, headers=token)
    head = answers_head(challenge_head(head, challenge.content), answers)
    last = f"answers?signature={signer.sign(chain.at(18, head))}"
    yield client.put(at(last), content=answers, headers=token)
    yield client.post(url + wire.ticket_path(board.season.id, 1) + "/end", headers=token)
    yield client.get(url + wire.ticket_path(board.season.id, 1), headers=token)


def test_no_answer_file_or_log_holds_a_secret(tmp_path, caplog):
    board = online_board(tmp_path)
    answered = []

    def record(answer):
        answered.append(answer.read())
        answered.extend(b": ".join(header) for header in answer.headers.raw)

    with (
        caplog.at_level(logging.DEBUG),
        serving(board.path, season_secrets=[board.secret]) as url,
        httpx.Client(event_hooks={"response": [record]}, timeout=60.0) as client,
    ):
        statuses = [each.status_code for each in everything(url, board, client)]
    assert set(statuses) == {200, 201, 400, 403, 409, 422}
    with SeasonStore.open(board.path) as store:
        result = scored(store, board.season, 1)
        store.finish(result)
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

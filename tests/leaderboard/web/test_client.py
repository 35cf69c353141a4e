import gzip
import http.server
import json
import threading
from contextlib import contextmanager

import httpx
import pytest

from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.entrant import request_ticket
from leaderboard.web import client
from sme_registry.errors import OptionError
from sme_registry.seasons import wire
from sme_registry.spec import Setting
from tests.leaderboard.conftest import tiny_submission, write_bundle
from tests.leaderboard.seasons.sealing import signed_request, tiny_season


@pytest.fixture(autouse=True)
def waits(monkeypatch):
    """Seconds for which the client has waited, which takes no time here."""
    waits = []
    monkeypatch.setattr(wire, "_sleep", waits.append)
    monkeypatch.setattr(wire, "_now", lambda: sum(waits))
    return waits


def bundle_of(folder, store, key, number=0, **fields):
    """A bundle's folder of a tiny submission."""
    signed, artefacts = tiny_submission(store, key, number, **fields)
    return write_bundle(folder, signed, artefacts), signed


@contextmanager
def scripted(script, bodies=False):
    """A server with scripted answers (None: it hangs up); yields its URL and its requests.

    An answer is a status, a body, and headers. With `bodies`, the script gets body and headers.
    """
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def answer(self):
            asked.append(f"{self.command} {self.path}")
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            more = (body, self.headers) if bodies else ()
            answer = script(self.command, self.path, *more)
            if answer is None:
                self.close_connection = True
                return
            status, body, *headers = answer
            self.send_response(status)
            for header in headers:
                self.send_header(*header)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_HEAD = do_PUT = do_POST = answer

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", asked
        finally:
            server.shutdown()
            thread.join()


def test_bytes_are_sent_even_if_the_board_has_them_and_lost_requests_are_repeated(
    tmp_path, store, key
):
    folder, signed = bundle_of(tmp_path / "bundle", store, key)
    posted = 202, json.dumps({"id": signed.id}).encode()
    counts = []
    for get, put, post in (
        ([definition(store)], [(200, b"{}")], [posted]),
        ([None, definition(store)], [None, (503, b"<html>"), (201, b"{}")], [None, posted]),
    ):
        answers = {"GET": iter(get), "PUT": iter(put), "POST": iter(post)}
        with scripted(lambda method, _, answers=answers: next(answers[method])) as (url, asked):
            sent = client.submit(url, folder, key, progress=lambda *each: counts.append(each))
            assert sent == signed.id
        assert counts.pop() == (1, 1)
        assert not counts
        methods = [line.split()[0] for line in asked]
        assert methods == ["GET"] * len(get) + ["PUT"] * len(put) + ["POST"] * len(post)


def definition(store):
    """A board's answer for its definition."""
    return 200, json.dumps(store.document.to_dict()).encode()


def test_an_unreachable_board_is_reported(tmp_path, store, key, waits):
    folder, _ = bundle_of(tmp_path / "bundle", store, key)
    with scripted(lambda *_: None) as (url, asked), pytest.raises(BoardError, match="answer"):
        client.submit(url, folder, key)
    assert len(asked) > 3
    assert sum(waits) < 6  # a mistyped URL shall not be waited for
    with pytest.raises(BoardError, match="answer"):  # nothing listens there any more
        client.status(url, "0" * 64)


def test_a_rejected_request_is_not_repeated(store, key):
    no = json.dumps({"code": "quota", "message": "none left"}).encode()
    with (
        scripted(lambda method, _: definition(store) if method == "GET" else (429, no)) as (
            url,
            asked,
        ),
        pytest.raises(Rejection, match="none left"),
    ):
        client.withdraw(url, "0" * 64, key)
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("status", "body"),
    [
        (200, b"<html>a login page</html>"),
        (200, b'{"id": "sha256:1"}'),
        (302, b""),
        (418, b'{"code": ["quota"], "message": {}}'),
        (500, b'{"code": "internal", "message": "\\u001b[2J"}'),
        (200, b"[" * 100_000),
    ],
)
def test_a_server_that_is_no_board_is_reported(status, body):
    with scripted(lambda *_: (status, body)) as (url, _), pytest.raises(BoardError) as caught:
        client.status(url, "0" * 64)
    assert len(str(caught.value)) < 1000
    assert str(caught.value).count(url) == 1


def test_an_answer_is_raw_bytes_up_to_a_limit():
    """Bytes within gzip within gzip are not unpacked, and redirects are not followed."""
    bomb = gzip.compress(gzip.compress(bytes(10**7)))
    coded = ("Content-Encoding", "gzip, gzip")
    moved = ("Location", "http://127.0.0.1:1/elsewhere")
    for answer in ((200, bomb, coded), (200, gzip.compress(b"{}"), coded), (302, b"", moved)):
        with scripted(lambda *_, answer=answer: answer) as (url, asked):
            with pytest.raises(BoardError):
                client.status(url, "0" * 64)
            assert len(asked) == 1
    with (
        scripted(lambda *_: (200, b" " * (2**24 + 1))) as (url, _),
        pytest.raises(BoardError, match="more than 16,777,216 bytes"),
    ):
        client.status(url, "0" * 64)


@pytest.mark.parametrize(
    ("field", "value"),
    [("instances", 10**12), ("name", "x" * 10**5), ("name", "x" * 10**7)],
)
def test_a_ticket_that_is_too_large_is_refused_by_its_size(store, key, field, value):
    member = {"name": "deep", "setting": Setting().to_dict(), "instances": 1, "budget": 9}
    ticket = {
        "season": "autumn",
        "ticket": 1,
        "token": "0" * 64,
        "deadline": "x",
        "lanes": 1,
        "classes": [{**member, field: value}],
    }
    signed = signed_request(store, tiny_season("sealed-online"), key)
    with (
        scripted(lambda *_: (201, json.dumps(ticket).encode())) as (url, _),
        pytest.raises(BoardError) as caught,
    ):
        request_ticket(url, "autumn", signed, key)
    assert len(str(caught.value)) < 1000


def test_an_invalid_url_or_id_is_rejected(key):
    with pytest.raises(OptionError, match="url="):
        client.status("http://board.example", "0" * 64)
    for id in ("", "x", "sha256:" + "0" * 63, "../" * 30):
        with pytest.raises(OptionError, match="id="):
            client.status("http://127.0.0.1:1", id)
        with pytest.raises(OptionError, match="id="):
            client.withdraw("http://127.0.0.1:1", id, key)


# A server in the middle, which passes everything on to a board that its visitors do not know.


@pytest.fixture
def relay(url):
    def forward(method, path, body, headers):
        sent = {"Authorization": headers["Authorization"].strip()}
        answer = httpx.request(method, url + path, content=body, headers=sent, trust_env=False)
        return answer.status_code, answer.content

    with scripted(forward, bodies=True) as (middle, _):
        yield middle


def test_a_server_in_the_middle_passes_on_no_submission(tmp_path, url, relay, store, key):
    folder, signed = bundle_of(tmp_path / "bundle", store, key)
    with pytest.raises(Rejection, match=rf"wrong_board: address={relay}: .* {url}\. Send it there"):
        client.submit(relay, folder, key)
    assert not store.objects.has(next(iter(artefacts_of(signed))))

    receiver = Receiver(store.document.key, relay)
    for digest in artefacts_of(signed):  # as if the board had them
        store.put_object(
            digest, (folder / "artefacts" / f"{hex_of(digest)}.onnx").read_bytes(), by=key.public
        )
    relayed = signed.content.signed(key, receiver)
    for each in (relayed, signed, relayed.model_copy(update={"address": url})):
        answer = httpx.post(f"{url}/api/submissions", content=each.to_bytes(), trust_env=False)
        assert answer.status_code == 403
        assert answer.json()["code"] in ("wrong_board", "bad_signature")
    assert store.entries() == []

    assert client.submit(url, folder, key) == signed.id
    with pytest.raises(Rejection, match="wrong_board"):
        client.withdraw(relay, signed.id, key)
    assert store.withdrawal(signed.id) is None


def test_what_is_signed_for_one_board_is_not_sent_to_another(tmp_path, store, key):
    """Which could pass it on, with its uploads."""
    folder, _ = bundle_of(tmp_path / "bundle", store, key)
    other = store.document.model_copy(update={"key": SigningKey.generate().public})
    answer = 200, json.dumps(other.to_dict()).encode()
    with (
        scripted(lambda *_: answer) as (url, asked),
        pytest.raises(Rejection, match=f"wrong_board: board={other.key}: must be "),
    ):
        client.submit(url, folder, key)
    assert asked == ["GET /definition.json"]


def artefacts_of(signed):
    return {run.artefact.sha256 for run in signed.content.runs}

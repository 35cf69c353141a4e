import contextlib
import datetime
import hashlib
import http.client
import json
import os
import re
import signal
import socket
import stat
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from leaderboard import admission
from leaderboard.cli.admin import serve
from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.documents.submission import utc
from leaderboard.errors import BoardError
from leaderboard.gate import isolation
from leaderboard.web import app
from leaderboard.web.client import PublicView
from leaderboard.web.server import HTTP_CODES, STATUSES
from sme_registry.errors import OptionError
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import (
    document_path,
    linear_onnx,
    put_submission,
    signed_withdrawal,
    tiny_board,
    tiny_submission,
)
from tests.leaderboard.serving import alive, authorization, serving, serving_process
from tests.leaderboard.web import boards

# More patient than httpx, for busy machines; a connection for each request, as `httpx.get` has.
HTTP = httpx.Client(timeout=60, limits=httpx.Limits(max_keepalive_connections=0))

# A refusal takes about 0.01 s of the process. The bound tells it from work that an attacker buys,
# on a machine that does much else.
CPU_SECONDS = 10.0

JSON = {"Accept": "application/json"}
URL = "https://board.example"
BROWSER = {"Accept": "text/html,application/xhtml+xml"}


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """The URL of a board with entries of every kind, and their ids. Tests only read it."""
    path = tmp_path_factory.mktemp("published") / "board"
    with boards.create(path) as store:
        ids = boards.furnish(store)
    with serving(path) as url:
        yield url, ids


@pytest.fixture(scope="module")
def refusing(tmp_path_factory):
    """The URL of a tiny board for requests that are refused, and the board."""
    path = tmp_path_factory.mktemp("refusing") / "board"
    with tiny_board(path) as store, serving(path) as url:
        yield url, store


def refusal(answer):
    assert answer.headers["Content-Type"] == "application/json"
    body = answer.json()
    assert set(body) == {"code", "message"}
    assert body["message"]
    assert "Traceback" not in body["message"]
    return answer.status_code, body["code"]


def put(url, key, data, digest=None, **more):
    digest = digest or sha256_of(data)
    headers = {"Authorization": authorization(url, key, digest), **more}
    return HTTP.put(f"{url}/api/objects/{hex_of(digest)}", content=data, headers=headers)


def put_head(url, key, data, length, more=""):
    """The head of an upload that states a length."""
    header = authorization(url, key, sha256_of(data))
    return (
        f"PUT /api/objects/{hex_of(sha256_of(data))} HTTP/1.1\r\nHost: x\r\n{more}"
        f"Authorization: {header}\r\nContent-Length: {length}\r\n\r\n"
    ).encode()


def connected(url):
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), 60)


def raw(url, request):
    """Status and text of what a server answers to these bytes."""
    with connected(url) as connection:
        connection.sendall(request)
        with http.client.HTTPResponse(connection) as answer:
            answer.begin()
            return answer.status, answer.read().decode(), answer.headers


def files_of(store):
    """Everything under the board's folder but the index, which SQLite keeps busy."""
    return sorted(
        str(path.relative_to(store.folder.path))
        for path in store.folder.path.rglob("*")
        if path.is_file() and not path.name.startswith("index.sqlite")
    )


# Pages.


def test_pages_and_what_they_link_are_served(published):
    paths = ("/index.html", "/ood_regret", "/ood_decay.html", "/compare", "/log", "/method")
    with httpx.Client(base_url=published[0], timeout=60) as client:
        for path in (*paths, "/board.csv", "/"):
            answer = client.get(path, headers=BROWSER)
            assert answer.status_code == 200
            assert len(answer.content) > 500
        links = set(re.findall(r'(?:href|src)="([^"#?]+)', answer.text))
        local = {link for link in links if "://" not in link}
        assert len(local) > 10
        assert [link for link in local if client.get(link).status_code != 200] == []


def test_every_answer_has_the_security_headers(published):
    for path in ("/", "/nowhere", "/api/board", "/api/nowhere", "/%2e%2e/board.key", "/healthz"):
        headers = HTTP.get(published[0] + path).headers
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert "Set-Cookie" not in headers


def test_an_unchanged_board_is_not_sent_twice(tmp_path):
    with (
        boards.create(tmp_path / "board", classes=1) as store,
        serving(store.folder.path) as url,
        httpx.Client(base_url=url, timeout=60) as client,
    ):
        first = client.get("/")
        known = {"If-None-Match": f'"x", {first.headers["ETag"]}'}
        same = client.get("/", headers=known)
        boards.submit(store, SigningKey.generate(), "New", [0.3] * 6)
        grown = client.get("/", headers=known)
    assert (first.status_code, same.status_code, grown.status_code) == (200, 304, 200)
    assert same.content == b""
    assert "New" not in first.text
    assert "New" in grown.text


def test_a_board_without_references_shows_nothing(url):
    for path in ("/", "/ood_regret", "/log", "/api/board"):
        answer = HTTP.get(url + path, headers=JSON)
        assert refusal(answer) == (503, "not_publishable")
        assert "'optimal'" in answer.json()["message"]
    page = HTTP.get(url, headers=BROWSER)
    assert page.status_code == 503
    assert page.headers["Content-Type"].startswith("text/html")
    assert "&#x27;optimal&#x27;" in page.text
    assert HTTP.get(f"{url}/static/board.css").status_code == 200


def test_a_new_board_says_that_it_prepares_and_how_to_submit(store):
    admission.submit_references(store)
    key = SigningKey.generate()
    waiting = boards.submit(store, key, "Early", None)
    with serving(store.folder.path) as url:
        for path in ("/", "/ood_regret", "/compare"):
            page = HTTP.get(url + path, headers=BROWSER)
            assert page.status_code == 200
            assert '<meta http-equiv="refresh" content="5">' in page.text
            assert "<strong>Preparing.</strong>" in page.text
            assert 'id="submit"' in page.text
            assert ">Early<" in page.text
        entry = HTTP.get(f"{url}/submissions/{hex_of(waiting)}.html")
        assert "Waiting to be scored" in entry.text
        for path in ("/method", "/log", "/suite.json"):
            answer = HTTP.get(url + path)
            assert (answer.status_code, "Preparing" in answer.text) == (200, False)
        for path in ("/api/board", "/board.csv", "/board-data.js"):
            assert refusal(HTTP.get(url + path)) == (503, "not_publishable")
        assert HTTP.get(f"{url}/submissions/x").status_code == 404


def test_a_waiting_entry_shows_the_faults_that_postponed_it(tmp_path):
    with boards.create(tmp_path / "board", classes=1) as store:
        id = boards.submit(store, SigningKey.generate(), "Unlucky", None)
        paths = ("/", f"/submissions/{hex_of(id)}.html")
        with serving(store.folder.path) as url:
            before = [HTTP.get(url + path).text for path in paths]  # the server keeps them
            claim = store.queue.claim("scorer")
            store.queue.release(claim, "no space left <on> device")
            after = [HTTP.get(url + path).text for path in paths]
            view = HTTP.get(f"{url}/api/submissions/{hex_of(id)}").json()
    assert not any("no space left" in text for text in before)
    assert all("no space left &lt;on&gt; device" in text for text in after)
    assert (view["faults"], view["fault"]) == (1, "no space left <on> device")
    assert PublicView.from_dict(view).to_dict() == view


def test_who_waits_sees_a_place_in_the_queue(tmp_path):
    with boards.create(tmp_path / "board", classes=1) as store:
        scored = boards.submit(store, SigningKey.generate(), "Done", [0.2] * 6)
        ids = [boards.submit(store, SigningKey.generate(), name, None) for name in "AB"]
        with serving(store.folder.path) as url:
            assert "place 2 of 2" in HTTP.get(f"{url}/submissions/{hex_of(ids[1])}.html").text
            store.queue.add_jobs(["a ticket that is over"])  # and which the log does not know of
            views = [
                HTTP.get(f"{url}/api/submissions/{hex_of(id)}").json() for id in (scored, *ids)
            ]
            page = HTTP.get(f"{url}/submissions/{hex_of(ids[1])}.html").text
            board = HTTP.get(url).text
        assert [view["place"] for view in views] == [0, 2, 3]
        assert [view["queue"] for view in views] == [0, 3, 3]
        assert "place 3 of 3 in the queue" in page
        assert re.findall(r'data-label="Place">([^<]+)<', board) == ["2 of 3", "3 of 3"]
        assert store.queue.claim("scorer").id == ids[0]


def test_the_pages_say_how_to_submit_at_the_configured_address(tmp_path):
    """Never at the address that a request's Host header claims."""
    forged = {**BROWSER, "Host": "evil.example"}
    with boards.create(tmp_path / "board", classes=1) as store:
        with serving(store.folder.path, url="https://board.example/sme") as url:
            known = HTTP.get(url, headers=forged).text
        with serving(store.folder.path) as url:
            default = HTTP.get(url, headers=forged).text
            where = url
            assert 'href="index.html#submit"' in HTTP.get(f"{url}/method").text
        store.folder.key.unlink()
        with serving(store.folder.path, url="https://board.example") as url:
            copy = HTTP.get(url, headers=forged).text
    assert "curl -O https://board.example/sme/suite.json" in known
    assert "sme-leaderboard submit runs/mine https://board.example/sme \\\n" in known
    assert "ADDRESS" not in known
    assert f"curl -O {where}/suite.json" in default
    assert "accepts no submissions" in copy
    assert "curl" not in copy
    assert "evil" not in known + default + copy


def test_serve_refuses_what_it_cannot_do(store):
    path = store.folder.path
    for host in ("0.0.0.0", "::", "192.0.2.1", "board.example", ""):
        with pytest.raises(OptionError, match="host="):
            serve(path, host=host, port=0, workers=0)
    with pytest.raises(BoardError, match="cannot listen here"):  # an address of others
        serve(path, "192.0.2.1", 0, workers=0, behind_proxy=True, url="https://board.example")
    for url in ("board.example", "ftp://x", "https://x/$(id)", 'https://x"', "https://"):
        with pytest.raises(OptionError, match="url="):
            serve(path, port=0, workers=0, url=url)
    with pytest.raises(OptionError, match="url=''"):  # of the proxy, which nothing here tells
        serve(path, port=0, workers=0, behind_proxy=True)
    with pytest.raises(OptionError, match="--unsafe-no-sandbox"):  # policies could read it
        serve(path, port=0, unsafe_no_sandbox=True, season_secret=[Path("a.master")])
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(BoardError, match="cannot listen here"),
    ):
        serve(path, port=taken.getsockname()[1], workers=0)


# Reading by the API.


def test_the_health_check_says_whether_scoring_works(url, store):
    def scoring():
        answer = HTTP.get(f"{url}/healthz")
        assert answer.status_code == 200
        assert answer.json()["status"] == "ok"
        return str(answer.json()["scoring"])

    assert scoring() == "ok"
    put_submission(store, SigningKey.generate())
    assert scoring() == "waiting"
    claim = store.queue.claim("worker")
    store.queue.release(claim, "the sandbox does not start")
    assert scoring() == "fault"
    store.folder.log_entry(1).write_bytes(b"rotten")
    assert scoring() == "fault"


def test_a_board_is_not_served_without_bubblewrap_unless_told(store, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    isolation._bwrap.cache_clear()
    with pytest.raises(BoardError, match=r"bubblewrap is .*--unsafe-no-sandbox"):
        serve(store.folder.path, port=0)
    with pytest.raises(BoardError, match="bubblewrap is not installed"):
        app.create_app(store.folder.path, URL, score_workers=0)
    app.create_app(store.folder.path, URL, isolation="process")
    app.create_app(store.folder.path, URL, score_workers=1, isolation="process")


def test_the_ranking_as_json_is_sorted(published):
    for metric in ("wd_regret", "ood_regret", "ood_decay"):
        board = HTTP.get(f"{published[0]}/api/board", params={"metric": metric}).json()
        values = [row["scores"][metric]["value"] for row in board["rows"]]
        assert board["metric"] == metric
        assert values == sorted(values)
        assert len(values) > 5


DIGITS = ("0" * 63, "A" * 64, "sha256:" + "0" * 64, "٠" * 64)
ZEROS = "0" * 64


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/nowhere", 404, "not_found"),
        ("/api/nowhere", 404, "not_found"),
        *((path, 404, "not_found") for path in ("/board.key", "/index.sqlite")),
        *((path, 404, "not_found") for path in ("/log/00000000.json", "/static/../board.key")),
        ("/api/board?metric=reward", 400, "bad_request"),
        *((f"/api/log?start={x}", 400, "bad_request") for x in ("-1", "x", "1e3", "9" * 400, "١")),
        (f"/api/submissions/{ZEROS}", 404, "unknown_submission"),
        *((f"/api/objects/{digits}", 400, "unsafe_name") for digits in DIGITS),
        *((f"/api/submissions/{digits}", 400, "unsafe_name") for digits in DIGITS),
        ("POST /api/board", 405, "method_not_allowed"),
        (f"DELETE /api/objects/{ZEROS}", 405, "method_not_allowed"),
    ],
)
def test_what_cannot_be_answered_has_its_code(published, path, status, code):
    method, _, path = path.rpartition(" ")
    accept = BROWSER if path.startswith("/api/") else {}
    answer = HTTP.request(method or "GET", published[0] + path, headers=accept)
    assert refusal(answer) == (status, code)


def test_scores_are_withheld_until_the_references_are_right(url, store):
    """Several scorers may finish an entry before the reference rows."""
    key = SigningKey.generate()
    scored = boards.submit(store, key, "PPO", [0.123] * 6, spread=0.0)
    code = ("onnx_op", "node 3: op_type='Loop': must be one of the list.")
    rejected = boards.submit(store, key, "Broken", None, rejected=code)

    def view(id=scored):
        return dict(HTTP.get(f"{url}/api/submissions/{hex_of(id)}").json())

    assert refusal(HTTP.get(url, headers=JSON)) == (503, "not_publishable")
    assert (view()["status"], view()["result"]) == ("scored", None)
    assert "reference row 'optimal': missing" in view()["withheld"]
    assert "0.123" not in json.dumps(view())
    assert (view(rejected)["status"], view(rejected)["result"]["code"]) == ("rejected", "onnx_op")

    admission.submit_references(store)
    page = HTTP.get(f"{url}/submissions/{hex_of(scored)}.html").text
    assert "the scores are withheld" in page
    assert "0.123" not in page

    for level in (0.0, 1.0):
        boards.score(store, [level] * 6)
    assert view()["result"]["scores"]["normalised_regret"][0]["value"] == pytest.approx(0.123)
    assert view()["withheld"] == ""


# Paths.


def test_a_path_that_leaves_the_folder_is_rejected(published):
    for path in (
        "/static/../../board.key",
        "/static/..%2f..%2fboard.key",
        "/%2e%2e/board.key",
        "/..%5cboard.key",
        "/api/objects/../../board.key",
        "/static/board.css%00.html",
        "/\\..\\board.key",
        "/%0d%0aSet-Cookie:x",
    ):
        request = f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n"
        status, text, headers = raw(published[0], request.encode())
        assert (status, '"code":"unsafe_name"' in text) == (400, True), path
        assert "frame-ancestors" in headers["Content-Security-Policy"]


# Uploads.


def test_an_artefact_is_public_once_it_is_scored(tmp_path, key):
    """Until then, and if it is never scored, it might as well not exist."""
    with boards.create(tmp_path / "board", classes=1) as store, serving(store.folder.path) as url:

        def downloads(digest):
            path = f"{url}/api/objects/{hex_of(digest)}"
            head, get = HTTP.head(path, headers=JSON), HTTP.get(path, headers=JSON)
            assert head.headers["Content-Length"] == get.headers["Content-Length"]
            return {(head.status_code, ""), (get.status_code, get.text.replace(digest, "DIGEST"))}

        unknown = downloads(sha256_of(b"unknown"))
        assert {status for status, _ in unknown} == {404}

        assert put(url, key, b"uploaded").status_code == 201
        assert downloads(sha256_of(b"uploaded")) == unknown

        waiting = uploaded(url, store, key, 1)
        assert post(url, waiting.to_bytes()).status_code == 202
        assert downloads(sha256_of(linear_onnx(1))) == unknown

        claim = boards.claimed(store)
        boards.finish(store, claim, status="rejected", code="run_time", message="took too long")
        assert downloads(sha256_of(linear_onnx(1))) == unknown

        withdrawn = uploaded(url, store, key, 2)
        assert post(url, withdrawn.to_bytes()).status_code == 202
        store.withdraw(signed_withdrawal(store, withdrawn.id, key))
        assert downloads(sha256_of(linear_onnx(2))) == unknown

        scored = boards.submit(store, key, "PPO", [0.2] * 6)
        policy = b"PPO 1.0 plane1 0"  # whose digest the submission names
        store.put_object(sha256_of(policy), policy, by=key.public)
        assert downloads(sha256_of(policy)) == {(200, ""), (200, policy.decode())}
        store.withdraw(signed_withdrawal(store, scored, key))
        assert downloads(sha256_of(policy)) == {(200, ""), (200, policy.decode())}


def test_policies_of_reference_rows_are_public_and_verified_if_their_file_changes(url, store):
    (optimal, _) = admission.submit_references(store)
    (run,) = store.submission(optimal).content.runs
    digest = run.artefact.sha256
    path, file = f"{url}/api/objects/{hex_of(digest)}", store.folder.object(digest)
    with ThreadPoolExecutor(8) as pool:  # as many readers at once
        contents = [answer.content for answer in pool.map(HTTP.get, [path] * 8)]
    assert {sha256_of(content) for content in contents} == {digest}
    file.chmod(0o644)
    file.write_bytes(b"rotten")
    assert refusal(HTTP.get(path)) == (500, "internal")


def test_an_upload_without_a_signature_or_signed_at_another_time_is_refused(refusing, key):
    url, _ = refusing
    digest = sha256_of(b"x")
    for header in ("", "Bearer x", "SME-Ed25519 " + "x" * 10_000):
        assert refusal(put(url, key, b"x", Authorization=header)) == (403, "bad_signature")

    now = datetime.datetime.now(datetime.UTC)
    for minutes in (-9, 9):
        header = authorization(url, key, digest, utc(now + datetime.timedelta(minutes=minutes)))
        assert put(url, key, b"x", Authorization=header).status_code in (200, 201)
    times = [utc(now + datetime.timedelta(minutes=minutes)) for minutes in (-11, 11, 10**6)]
    for time_ in (*times, "2026-02-31T00:00:00Z"):
        header = authorization(url, key, digest, time_)
        assert refusal(put(url, key, b"x", Authorization=header)) == (403, "stale_time")


def test_what_is_too_large_is_refused_by_its_length_or_as_soon_as_it_is(refusing, key):
    url, store = refusing
    limit = store.document.limits.artefact_bytes
    head = b"POST /api/submissions HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000000\r\n\r\n"
    for request in (
        put_head(url, key, b"x", limit + 1),
        head + b" " * (64 * 2**10 + 1),  # the rest never comes
    ):
        start = time.process_time()  # the server is a thread of this process
        status, text, _ = raw(url, request)
        assert time.process_time() - start < CPU_SECONDS
        assert (status, '"code":"too_large"' in text) == (413, True)


def test_an_upload_without_a_length_is_stopped_at_the_limit(tmp_path, key):
    with tiny_board(tmp_path / "b", limits={"artefact_bytes": 100_000}) as store:
        before = files_of(store)
        small, large = b"y" * 5000, b"x" * 200_000
        with serving(store.folder.path) as url:
            for data, status in ((large, 413), (small, 201)):
                headers = {"Authorization": authorization(url, key, sha256_of(data))}
                pieces = (data[start : start + 5000] for start in range(0, len(data), 5000))
                path = f"{url}/api/objects/{hex_of(sha256_of(data))}"
                answer = HTTP.put(path, content=pieces, headers=headers)
                assert answer.status_code == status
                assert status == 201 or refusal(answer) == (413, "too_large")
        store.folder.object(sha256_of(small)).unlink()
        assert files_of(store) == before


def test_a_false_length_or_digest_leaves_nothing_behind(url, store, key):
    before = files_of(store)
    data = b"z" * 1000
    for length in (999, 1001):
        head = put_head(url, key, data, length, "Connection: close\r\n")
        with connected(url) as connection:
            connection.sendall(head + data)
            connection.shutdown(socket.SHUT_WR)
            answer = connection.recv(2**16)
        assert answer.startswith(b"HTTP/1.1 4") or answer == b""
    assert not store.objects.has(sha256_of(data))
    answer = put(url, key, b"these", digest=sha256_of(b"others"))
    assert refusal(answer) == (422, "artefact_digest")
    assert files_of(store) == before


def test_a_refused_client_reads_why_while_it_still_sends(refusing, key):
    url, store = refusing
    limit = store.document.limits.artefact_bytes
    with connected(url) as connection:
        connection.sendall(put_head(url, key, b"x", 2 * limit))
        with http.client.HTTPResponse(connection) as answer:
            answer.begin()
            assert (answer.status, answer.read().count(b"too_large")) == (413, 1)
        for _ in range(16):  # a connection that is closed would be reset by the first
            connection.sendall(bytes(limit // 8))
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert connection.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 200"


def test_quotas_of_keys_and_of_the_board_in_bytes(tmp_path, key):
    limits = {"upload_bytes_per_day": 1000, "artefact_bytes": 600, "total_bytes": 1700}
    with tiny_board(tmp_path / "b", limits=limits) as store, serving(store.folder.path) as url:
        with ThreadPoolExecutor(4) as pool:  # no two share the last room
            at_once = list(pool.map(lambda n: put(url, key, bytes(400 + n)), range(4)))
        assert sorted(each.status_code for each in at_once) == [201, 201, 429, 429]
        assert refusal(put(url, key, bytes(300))) == (429, "quota")
        other = SigningKey.generate()
        assert put(url, other, bytes(500)).status_code == 201
        third = SigningKey.generate()
        assert refusal(put(url, third, bytes(550))) == (429, "quota")
        assert put(url, third, bytes(200)).status_code == 201


# Submissions and withdrawals.


def post(url, text):
    return HTTP.post(f"{url}/api/submissions", content=text)


def uploaded(url, store, key, number=0):
    """A tiny submission whose policy is uploaded."""
    signed, artefacts = tiny_submission(store, key, number)
    for data in artefacts.values():
        assert put(url, key, data).status_code == 201
    return signed.for_receiver(Receiver(signed.board, url), key)


def test_a_policy_is_stored_and_its_submission_accepted_once(url, store, key):
    signed = uploaded(url, store, key)
    data = linear_onnx(0)
    assert put(url, key, data).status_code == 200
    assert store.objects.read(sha256_of(data)) == data
    assert stat.S_IMODE(store.folder.object(sha256_of(data)).stat().st_mode) == 0o644
    assert store.uploaded_bytes(key.public, "2000-01-01T00:00:00Z") == len(data)
    first, second = post(url, signed.to_bytes()), post(url, signed.to_bytes())
    assert (first.status_code, second.status_code) == (202, 200)
    assert first.json() == second.json()
    assert first.json()["id"] == signed.id
    view = HTTP.get(url + first.json()["url"]).json()
    assert (view["id"], view["status"]) == (signed.id, "waiting")
    assert [entry.id for entry in store.entries()] == [signed.id]


NEVER = "sha256:" + "1" * 64


def changed(plain, path, value):
    """Set what is at a path, such as `runs.0.spec`."""
    *names, last = path.split(".")
    for name in names:
        plain = plain[int(name)] if name.isdigit() else plain[name]
    plain[last] = value


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        ("score", 0.0, "schema"),
        ("created", "2020-01-01T00:00:00Z", "stale_time"),
        ("suite", {"name": "other-v1", "digest": NEVER}, "unknown_suite"),
        ("runs.0.spec", NEVER, "unknown_spec"),
        ("method.name", "<script>alert(1)</script>", "unsafe_name"),
        ("runs.0.artefact.sha256", NEVER, "artefact_missing"),
        ("runs.0.artefact.size", 1, "artefact_digest"),
    ],
)
def test_an_invalid_submission_has_its_code(refusing, key, path, value, code):
    url, store = refusing
    plain = uploaded(url, store, key).content.to_dict()
    changed(plain, path, value)
    answer = post(url, _signed_anyway(plain, key, Receiver(store.document.key, url)))
    assert (answer.json()["code"], 400 <= answer.status_code < 500) == (code, True)
    assert set(answer.json()) == {"code", "message"}
    assert store.entries() == []


def _signed_anyway(plain, key, receiver):
    """A submission signed rightly, whatever it holds."""
    import rfc8785

    digest = "sha256:" + hashlib.sha256(rfc8785.dumps(plain)).hexdigest()
    signature = key.sign("submission", digest, receiver)
    return json.dumps({"submission": plain, "signature": signature, **receiver._asdict()}).encode()


@pytest.mark.parametrize(
    ("text", "status", "code"),
    [
        (b"", 400, "not_json"),
        (b"[" * 30_000, 400, "not_json"),
        (b"1" * 60_000, 400, "not_json"),
        (b"[]", 422, "schema"),
        (b"{}", 403, "bad_signature"),
        (b" " * (64 * 2**10 + 1), 413, "too_large"),
        (b'{"runs": [' + b"{}," * 10**6 + b"{}]}", 413, "too_large"),
    ],
)
def test_a_body_that_is_no_submission_has_its_code(refusing, text, status, code):
    url, store = refusing
    start = time.process_time()  # the server is a thread of this process
    answer = post(url, text)
    assert time.process_time() - start < CPU_SECONDS
    assert refusal(answer) == (status, code)
    assert store.entries() == []


def test_a_withdrawal_by_the_submitter_is_final(url, store, key):
    signed = uploaded(url, store, key)
    post(url, signed.to_bytes())
    path = f"{url}/api/withdrawals"
    by_another_key = signed_withdrawal(store, signed.id, SigningKey.generate(), address=url)
    answer = HTTP.post(path, json=by_another_key.to_dict())
    assert refusal(answer) == (403, "bad_signature")
    unknown = signed_withdrawal(store, "sha256:" + "0" * 64, key, address=url)
    assert refusal(HTTP.post(path, json=unknown.to_dict())) == (404, "unknown_submission")
    valid = signed_withdrawal(store, signed.id, key, "a bug", url)
    for _ in range(2):
        answer = HTTP.post(path, json=valid.to_dict())
        assert (answer.status_code, answer.json()["status"]) == (200, "withdrawn")
    assert refusal(post(url, signed.to_bytes())) == (410, "withdrawn")
    view = HTTP.get(f"{url}/api/submissions/{hex_of(signed.id)}").json()
    assert view["withdrawal"] == valid.to_dict()


def test_a_body_that_is_no_withdrawal_has_its_code(refusing):
    for text, expected in {
        b"{": (400, "not_json"),
        b"{}": (422, "schema"),
        b"[" * 60_000: (400, "not_json"),
        b" " * 70_000: (413, "too_large"),
    }.items():
        answer = HTTP.post(f"{refusing[0]}/api/withdrawals", content=text)
        assert refusal(answer) == expected


# Faults, and `serve`.


def test_an_internal_fault_is_logged_and_not_shown(url, store, key, caplog):
    signed = put_submission(store, key)
    document_path(store.folder.path, signed.id).write_bytes(b"rotten")
    answer = HTTP.get(f"{url}/api/submissions/{hex_of(signed.id)}")
    assert refusal(answer) == (500, "internal")
    assert str(store.folder.path) not in answer.text
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert any("failed" in record.message and record.exc_info for record in caplog.records)


def test_every_code_of_the_server_is_explained():
    from leaderboard import web
    from leaderboard.errors import CODES

    source = "".join(path.read_text() for path in Path(web.__file__).parent.glob("*.py"))
    used = set(re.findall(r'RequestError\(\s*"(\w+)"', source)) | set(STATUSES)
    assert used > set(STATUSES)
    assert used <= set(HTTP_CODES) | set(CODES)
    assert not set(HTTP_CODES) & set(CODES)


def test_serving_outlives_its_scorers_and_stops_cleanly(tmp_path):
    with tiny_board(tmp_path / "board") as store:
        admission.submit_references(store)
        with serving_process(store.folder.path, workers=1) as (url, process):
            killed, deadline = [], time.monotonic() + 300
            while store.queue.count("waiting"):
                assert time.monotonic() < deadline
                if not killed and store.queue.count("claimed"):
                    killed = [child for child in _children(process.pid) if _may_be_killed(child)]
                    for child in killed:
                        with contextlib.suppress(ProcessLookupError):
                            os.kill(child, signal.SIGKILL)
                health = HTTP.get(f"{url}/healthz")
                assert health.status_code == 200
                assert health.json()["scoring"] in ("waiting", "fault", "ok")
                time.sleep(0.2)
            assert killed
            assert HTTP.get(f"{url}/healthz").json()["scoring"] == "ok"
            assert HTTP.get(url).status_code == 200
            children = _children(process.pid)
            assert len(children) >= 2
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (0, "")
        # Multiprocessing's own tracker ends by itself, a moment after those that it watched.
        while [child for child in children if alive(child)]:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def _children(pid):
    """All processes under this one."""
    descendants = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in map(int, (task / "children").read_text().split()):
            descendants += [child, *_children(child)]
    return descendants


def _may_be_killed(pid):
    """A scorer, or what it started; without its tracker, `multiprocessing` writes warnings."""
    try:
        return b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False

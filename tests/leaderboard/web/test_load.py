"""What a served board bears. The figures are printed: `pytest -rP` shows them."""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from leaderboard.documents.keys import SigningKey
from leaderboard.intake import upload_header
from leaderboard.store import Store
from tests.leaderboard.serving import serving_process
from tests.leaderboard.web.site import boards

UPLOADS = 100
UPLOAD_BYTES = 8 * 2**20
ENTRIES = 1000
RUNS = 30
REQUESTS = 50


def percentile_95(seconds: list[float]) -> float:
    return sorted(seconds)[int(0.95 * len(seconds))]


def peak_bytes(pid: int) -> int:
    match = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert match is not None
    return int(match[1]) * 1024


def processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_hundred_large_uploads_at_once_take_little_memory(store: Store, key: SigningKey) -> None:
    body = memoryview(os.urandom(2**20) * (UPLOAD_BYTES // 2**20))
    half = UPLOAD_BYTES // 2
    all_are_half_way = threading.Barrier(UPLOADS, timeout=120)
    statuses: list[int] = []
    digests: list[str] = []
    board = store.document.key

    def upload(number: int, address: str) -> None:
        head = number.to_bytes(8, "big")  # each is another object
        sha256 = hashlib.sha256(head)
        sha256.update(body[8:])
        digest = "sha256:" + sha256.hexdigest()
        connection = http.client.HTTPConnection(address, timeout=120)
        connection.putrequest("PUT", f"/api/objects/{sha256.hexdigest()}")
        connection.putheader("Content-Length", str(UPLOAD_BYTES))
        connection.putheader("Authorization", upload_header(key, digest, board=board))
        connection.endheaders(head)
        connection.send(body[8:half])
        all_are_half_way.wait()
        connection.send(body[half:])
        statuses.append(connection.getresponse().status)
        connection.close()
        digests.append(digest)

    with serving_process(store.folder.path) as (url, process):
        httpx.get(url)
        before = peak_bytes(process.pid)
        start = time.perf_counter()
        threads = [
            threading.Thread(target=upload, args=(number, urlsplit(url).netloc))
            for number in range(UPLOADS)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seconds = time.perf_counter() - start
        peak = peak_bytes(process.pid)
    print(
        f"{UPLOADS} uploads of {UPLOAD_BYTES // 2**20} MiB at once: {seconds:.1f} s, "
        f"peak {peak / 2**20:.0f} MiB, {before / 2**20:.0f} MiB before"
    )
    assert statuses == [201] * UPLOADS
    assert peak < 10**9
    assert peak - before < UPLOADS * UPLOAD_BYTES / 4
    stored = [store.folder.object(digest).stat().st_size for digest in digests]
    assert stored == [UPLOAD_BYTES] * UPLOADS
    assert store.uploaded_bytes(key.public, "2000-01-01T00:00:00Z") == UPLOADS * UPLOAD_BYTES
    assert len(store.objects.read(digests[0])) == UPLOAD_BYTES  # which verifies its digest
    shutil.rmtree(store.folder.objects)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A board of a thousand entries of thirty runs each, made as boards are made."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # a loss of power is not what this is about
        store = boards.create(tmp_path_factory.mktemp("large") / "board")
        key = SigningKey.generate()
        for number in range(ENTRIES):
            profile = [0.05 + 0.0008 * number + 0.03 * region for region in range(6)]
            boards.submit(store, key, f"Method {number}", profile, spread=0.02, runs=RUNS // 3)
    with store:
        yield store


def test_a_board_of_a_thousand_entries_is_served(large: Store) -> None:
    assert sum(entry.runs == RUNS for entry in large.entries()) >= ENTRIES
    key = SigningKey.generate()

    def fetch(client: httpx.Client) -> float:
        start = time.perf_counter()
        page = client.get("/")
        seconds = time.perf_counter() - start
        assert page.status_code == 200
        assert page.text.count("Method 9") >= 111
        return seconds

    with (
        serving_process(large.folder.path) as (url, process),
        httpx.Client(base_url=url, timeout=60) as client,
    ):
        fetch(client)
        warm = [fetch(client) for _ in range(REQUESTS)]
        cold, worked = [], []
        for number in range(REQUESTS):
            boards.submit(large, key, f"Late {number}", None)  # the log grows: nothing is kept
            before = processor_seconds(process.pid)
            cold.append(fetch(client))
            worked.append(processor_seconds(process.pid) - before)
        unchanged = client.get("/", headers={"If-None-Match": client.get("/").headers["ETag"]})
    print(
        f"board of {ENTRIES} entries × {RUNS} runs, p95 of {REQUESTS}: "
        f"{1000 * percentile_95(warm):.1f} ms as it was, {1000 * percentile_95(cold):.0f} ms just "
        f"after it grew, of which {1000 * percentile_95(worked):.0f} ms of processor time"
    )
    assert unchanged.status_code == 304

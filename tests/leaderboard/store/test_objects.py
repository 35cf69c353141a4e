from __future__ import annotations

import os
import stat
import threading
from collections.abc import Iterator

import pytest

from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store import Store
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import tiny_board

KEY = "ab" * 32


def files(store: Store) -> list[str]:
    return [path.name for path in store.folder.objects.rglob("*") if path.is_file()]


def test_an_object_is_stored_once_and_read_back_unchanged(store):
    data = os.urandom(100_000)
    pieces = [data[start : start + 4096] for start in range(0, len(data), 4096)]
    assert store.put_object(sha256_of(data), pieces, by=KEY)
    assert not store.put_object(sha256_of(data), pieces, by=KEY)
    assert store.objects.has(sha256_of(data))
    assert store.objects.read(sha256_of(data)) == data
    assert stat.S_IMODE(store.folder.object(sha256_of(data)).stat().st_mode) == 0o644


def test_an_upload_of_other_bytes_or_that_breaks_off_leaves_nothing(store):
    def broken() -> Iterator[bytes]:
        yield b"half"
        raise ConnectionAbortedError

    with pytest.raises(Rejection) as refused:
        store.put_object(sha256_of(b"one"), [b"another"], by=KEY)
    assert refused.value.code == "artefact_digest"
    with pytest.raises((BoardError, ConnectionAbortedError)):
        store.put_object(sha256_of(b"half and half"), broken(), by=KEY)
    assert files(store) == []


def test_a_stream_is_stopped_at_the_limit_and_leaves_nothing(tmp_path):
    with tiny_board(tmp_path / "board", limits={"artefact_bytes": 1000}) as store:
        read = 0

        def endless() -> Iterator[bytes]:
            nonlocal read
            while True:
                read += 100
                yield bytes(100)

        with pytest.raises(Rejection) as refused:
            store.put_object(sha256_of(b""), endless(), by=KEY)
        assert refused.value.code == "too_large"
        assert read == 1100
        assert files(store) == []


def test_altered_missing_and_misnamed_objects_are_not_returned(store):
    store.put_object(sha256_of(b"policy"), [b"policy"], by=KEY)
    store.folder.object(sha256_of(b"policy")).write_bytes(b"Policy")
    with pytest.raises(TamperedError, match="objects/"):
        store.objects.read(sha256_of(b"policy"))
    with pytest.raises(BoardError, match="cannot be read"):
        store.objects.read(sha256_of(b"never seen"))
    for name in ("../../board.key", "sha256:../board.key", "sha256:" + "A" * 64):
        with pytest.raises(ValueError, match="not a digest"):
            store.objects.has(name)


def test_bytes_count_for_their_uploader_before_and_after_submission(store, key, submit):
    since = "2000-01-01T00:00:00Z"
    store.put_object(sha256_of(b"12345"), [b"12345"], by=key.public)
    assert store.uploaded_bytes(key.public, since) == store.total_bytes() == 5
    signed = submit()
    size = 5 + signed.submission.runs[0].artefact.size + len(signed.to_bytes())
    assert store.uploaded_bytes(key.public, since) == store.total_bytes() == size
    assert store.uploaded_bytes(key.public, "2999-01-01T00:00:00Z") == 0
    assert store.uploaded_bytes(KEY, since) == 0
    store.reindex()  # forgets who uploaded what was not submitted, but not its size
    assert store.total_bytes() == size


def test_many_threads_upload_the_same_object_once(store):
    data = os.urandom(50_000)
    new: list[bool] = []

    def upload() -> None:
        new.append(store.put_object(sha256_of(data), [data], by=KEY))

    threads = [threading.Thread(target=upload) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(new) == 8
    assert any(new)
    assert files(store) == [store.folder.object(sha256_of(data)).name]
    assert store.total_bytes() == len(data)

import os
import time

import pytest

from leaderboard import admission
from leaderboard.errors import BoardError, Rejection
from leaderboard.store import Store
from leaderboard.store.log import collect_garbage
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import tiny_submission

HOUR, DAY = 3600.0, 86400.0


def put(store, key, data):
    digest = sha256_of(data)
    store.put_object(digest, data, by=key.public)
    return digest


def age(path, seconds):
    then = time.time() - seconds
    os.utime(path, (then, then))


@pytest.fixture
def litter(store, key, submit):
    """Old and young files of each kind; the objects of a submission are old."""
    old, young = put(store, key, b"old and not submitted"), put(store, key, b"young")
    named = submit().content.runs[0].artefact.sha256
    for digest in (old, named):
        age(store.folder.object(digest), DAY + 60)
    for folder in (store.folder.log, store.folder.path, store.folder.object(old).parent):
        (folder / ".dead.12345678.tmp").write_bytes(b"half")
        age(folder / ".dead.12345678.tmp", HOUR + 60)
    (store.folder.log / ".alive.12345678.tmp").write_bytes(b"being written")
    return old, young, named


def test_garbage_is_temporary_files_and_unnamed_artefacts(store, litter):
    old, young, named = litter
    before = store.total_bytes()
    garbage = collect_garbage(store)
    assert (garbage.temporary, garbage.objects) == (3, 1)
    assert garbage.temporary + garbage.objects == 4
    assert garbage.bytes == 3 * len(b"half") + len(b"old and not submitted")
    assert not store.objects.has(old)
    assert store.objects.has(young)
    assert store.objects.has(named)
    assert [path.name for path in store.folder.path.rglob(".*.tmp")] == [".alive.12345678.tmp"]
    assert store.total_bytes() == before - len(b"old and not submitted")
    assert collect_garbage(store)[:2] == (0, 0)


def test_an_upload_that_gc_removes_while_it_is_stored_is_refused(store, key, monkeypatch):
    data, put = b"policy", store.objects.put

    def put_then_collected(*arguments):
        put(*arguments)
        assert collect_garbage(store, objects_older_than=0).objects == 1

    with monkeypatch.context() as patch:
        patch.setattr(store.objects, "put", put_then_collected)
        with pytest.raises(BoardError, match="removed meanwhile"):
            store.put_object(sha256_of(data), data, by=key.public)
    assert store.put_object(sha256_of(data), data, by=key.public)


def test_gc_between_check_and_log_entry_refuses_the_submission(store, key, monkeypatch):
    signed, artefacts = tiny_submission(store, key)
    for digest, data in artefacts.items():
        store.put_object(digest, data, by=key.public)
        age(store.folder.object(digest), DAY + 60)
    real = admission._check_files

    def checked_then_collected(*arguments):
        real(*arguments)
        with Store.open(store.folder.path) as other:
            assert collect_garbage(other).objects == len(artefacts)

    with monkeypatch.context() as patch:
        patch.setattr(admission, "_check_files", checked_then_collected)
        with pytest.raises(Rejection) as refused:
            admission.admit(store, signed)
    assert refused.value.code == "artefact_missing"
    assert store.entries() == []
    for digest, data in artefacts.items():
        assert store.put_object(digest, data, by=key.public)
    assert admission.admit(store, signed)
    assert collect_garbage(store, objects_older_than=0).objects == 0

from __future__ import annotations

import pytest

from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.errors import BoardError, TamperedError
from leaderboard.store import EMPTY, Store
from tests.leaderboard.conftest import put_submission, signed_withdrawal, tiny_board


def test_each_entry_has_the_previous_digest_and_the_boards_signature(store, key, submit):
    signed = submit()
    store.withdraw(signed_withdrawal(signed.id, key))
    entries = store.log()
    assert [entry.event for entry in entries] == ["opened", "received", "withdrawn"]
    assert [entry.sequence for entry in entries] == [0, 1, 2]
    assert entries[0].previous == EMPTY.digest
    assert [entry.previous for entry in entries[1:]] == [entry.digest for entry in entries[:2]]
    for entry in entries:
        assert verifies(store.document.key, entry.signature, "log", entry.signed_digest)
    assert store.head[:2] == (2, entries[2].digest)


def test_the_signature_covers_every_other_field(store):
    (entry,) = store.log()
    others = {
        "sequence": 1,
        "previous": "sha256:" + "1" * 64,
        "time": "2001-01-01T00:00:00Z",
        "event": "result",
        "subject": "sha256:" + "2" * 64,
        "document": "sha256:" + "3" * 64,
    }
    assert others.keys() | {"schema_version", "signature"} == entry.to_dict().keys()
    for name, value in others.items():
        altered = entry.model_copy(update={name: value})
        assert altered.signed_digest != entry.signed_digest


def test_a_range_of_the_log_stops_at_its_end(store, submit):
    for number in range(3):
        submit(number)
    assert [entry.sequence for entry in store.log(1, 2)] == [1, 2]
    assert [entry.sequence for entry in store.log(3, 100)] == [3]
    assert store.log(4, 100) == []


def test_times_stand_still_while_the_clock_is_set_back(store, submit, monkeypatch):
    times = iter(["2030-01-01T00:00:00Z", "2020-01-01T00:00:00Z", "2031-01-01T00:00:00Z"])
    monkeypatch.setattr("leaderboard.store.log.now", lambda: next(times))
    for number in range(3):
        submit(number)
    assert [entry.time for entry in store.log(1)] == [
        "2030-01-01T00:00:00Z",
        "2030-01-01T00:00:00Z",
        "2031-01-01T00:00:00Z",
    ]


def test_a_board_without_its_key_can_be_read_but_not_written(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        put_submission(store, key)
        store.folder.key.unlink()
    with Store.open(tmp_path / "board") as store:
        assert len(store.entries()) == 1
        with pytest.raises(BoardError, match=r"board\.key"):
            put_submission(store, key, 1)
        assert len(store.entries()) == 1


def test_another_boards_key_cannot_write_to_the_log(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        store.folder.key.unlink()
        SigningKey.generate().write(store.folder.key)
        with pytest.raises(BoardError, match=r"board\.key"):
            put_submission(store, key)
    with Store.open(tmp_path / "board") as store:
        assert store.head.sequence == 0


def test_opening_a_board_detects_a_truncated_log(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        for number in range(2):
            put_submission(store, key, number)
        last = store.folder.log_entry(2)
    last.unlink()
    for read_only in (True, False):
        with pytest.raises(TamperedError) as tampered:
            Store.open(tmp_path / "board", read_only=read_only)
        assert tampered.value.where == "log/00000002.json"
    with Store.open(tmp_path / "board", reindex=True) as store:  # accepted as it is
        assert len(store.entries()) == 1
    Store.open(tmp_path / "board").close()

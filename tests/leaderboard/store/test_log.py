import pytest

from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.verify import verify
from leaderboard.store import EMPTY, LogEntry, Store
from sme_registry.errors import SpecError
from tests.leaderboard.conftest import put_submission, signed_withdrawal, tiny_board


def test_each_entry_has_the_previous_digest_and_the_boards_signature(store, key, submit):
    signed = submit()
    store.withdraw(signed_withdrawal(store, signed.id, key))
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
    with pytest.raises(SpecError, match="time"):  # which does not exist
        LogEntry.from_dict({**entry.to_dict(), "time": "2026-02-30T00:00:00Z"})


def test_a_range_of_the_log_stops_at_its_end(store, submit):
    for number in range(3):
        submit(number)
    assert [entry.sequence for entry in store.log(1, 2)] == [1, 2]
    assert [entry.sequence for entry in store.log(3, 100)] == [3]
    assert store.log(4, 100) == []


@pytest.fixture
def clock(monkeypatch):
    """The board's clock, a list of one time."""
    time = ["2030-01-01T00:00:00Z"]
    monkeypatch.setattr("leaderboard.store.log.now", lambda: time[0])
    monkeypatch.setattr("leaderboard.store.store.now", lambda: time[0])
    return time


def test_entries_have_the_clocks_own_time_which_may_go_back(tmp_path, key, clock):
    times = ["2030-01-01T00:00:00Z", "2039-12-31T23:59:59Z", "2030-01-01T00:00:01Z"]
    with tiny_board(tmp_path / "board") as store:
        for number, time in enumerate(times):
            clock[0] = time
            put_submission(store, key, number)
        assert [entry.time for entry in store.log(1)] == times
        assert [row.received for row in store.entries()] == times
        store.reindex()
        assert [row.received for row in store.entries()] == times
    verify(tmp_path / "board")
    with Store.open(tmp_path / "board", read_only=True) as store:
        assert store.head.time == times[-1]


def test_a_clock_that_is_plainly_wrong_writes_nothing(tmp_path, key, clock):
    with tiny_board(tmp_path / "board") as store:
        for wrong in ("2029-12-31T23:59:59Z", "2040-01-03T00:00:00Z", "9999-12-31T23:59:59Z"):
            clock[0] = wrong
            with pytest.raises(BoardError, match=f"clock={wrong}"):
                put_submission(store, key)
            assert store.entries() == []
        clock[0] = "2030-01-02T00:00:00Z"
        put_submission(store, key)
    assert verify(tmp_path / "board").entries == 2


def test_a_board_without_its_own_key_can_be_read_but_not_written(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        put_submission(store, key)
        store.folder.key.unlink()
    with Store.open(tmp_path / "board") as store:
        with pytest.raises(BoardError, match=r"board\.key"):
            put_submission(store, key, 1)
        SigningKey.generate().write(store.folder.key)  # another board's
    with Store.open(tmp_path / "board") as store:
        with pytest.raises(BoardError, match=r"board\.key"):
            put_submission(store, key, 1)
        assert len(store.entries()) == 1
        assert store.head.sequence == 1


def test_opening_a_board_detects_a_truncated_log(tmp_path, key):
    with tiny_board(tmp_path / "board") as store:
        for number in range(2):
            put_submission(store, key, number)
        last = store.folder.log_entry(2)
    last.unlink()
    for read in (Store.open, verify):
        with pytest.raises(TamperedError) as tampered:
            read(tmp_path / "board")
        assert tampered.value.where == "log/00000002.json"
    with Store.open(tmp_path / "board", reindex=True) as store:  # accepted as it is
        assert len(store.entries()) == 1
    Store.open(tmp_path / "board").close()

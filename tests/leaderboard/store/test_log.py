import pytest

from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.verify import verify
from leaderboard.store import Store
from leaderboard.store.log import LogEntry
from sme_registry.errors import SpecError
from tests.leaderboard.clocks import move_clock
from tests.leaderboard.conftest import put_submission, tiny_board


def test_entries_are_dated_by_the_clock_and_never_before_the_last(tmp_path, key, monkeypatch):
    move_clock(monkeypatch, "2030-01-01T00:00:00Z")
    with tiny_board(tmp_path / "board") as store:
        put_submission(store, key, 0)
        move_clock(monkeypatch, "2029-12-31T23:59:00Z")  # a minute is no fault
        put_submission(store, key, 1)
        move_clock(monkeypatch, "2029-12-31T23:58:59Z")
        with pytest.raises(BoardError, match=r"clock=2029-12-31T23:58:59Z: is behind .*\. Set"):
            put_submission(store, key, 2)
        assert {entry.time for entry in store.log()} == {"2030-01-01T00:00:00Z"}
        assert {row.received for row in store.entries()} == {"2030-01-01T00:00:00Z"}
        with pytest.raises(SpecError, match="time"):  # which does not exist
            LogEntry.from_dict({**store.log()[0].to_dict(), "time": "2026-02-30T00:00:00Z"})
    assert verify(tmp_path / "board").log_sequence == 2


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
    with pytest.raises(TamperedError) as tampered:
        Store.open(tmp_path / "board")
    assert tampered.value.where == "log/00000002.json"
    with Store.open(tmp_path / "board", reindex=True) as store:  # accepted as it is
        assert len(store.entries()) == 1
    Store.open(tmp_path / "board").close()

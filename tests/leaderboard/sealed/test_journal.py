"""The journal: whole records, whatever ends its writer."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from leaderboard.errors import BoardError, TamperedError
from leaderboard.sealed.journal import Journal

LANES, A = 3, 2
HEADER, RECORD = 28, 8 + 4 * LANES * A + 4


def actions(number: int) -> bytes:
    return bytes([number]) * (4 * LANES * A)


def contents(journal: Journal) -> list[bytes]:
    for each in journal.actions():
        assert each.shape == (LANES, A)
    return [each.tobytes() for each in journal.actions()]


def written(path: Path, count: int) -> None:
    journal = Journal.create(path, LANES, A)
    for number in range(1, count + 1):
        journal.append(actions(number))


def test_a_journal_gives_back_what_was_added(tmp_path: Path) -> None:
    written(tmp_path / "0", 5)
    journal = Journal.open(tmp_path / "0")
    assert (journal.lanes, journal.action_dim) == (LANES, A)
    assert (journal.requests, journal.steps, journal.ended) == (5, 15, False)
    assert contents(journal) == [actions(number) for number in range(1, 6)]


@pytest.mark.parametrize("extra", range(RECORD))
def test_a_torn_record_is_cut_off_and_the_next_one_takes_its_place(
    tmp_path: Path, extra: int
) -> None:
    path = tmp_path / "0"
    written(path, 3)
    os.truncate(path, HEADER + 2 * RECORD + extra)
    journal = Journal.open(path)
    journal.append(actions(9))
    assert contents(Journal.open(path)) == [actions(1), actions(2), actions(9)]


def test_a_record_that_never_reached_the_disk_ends_the_journal(tmp_path: Path) -> None:
    path = tmp_path / "0"
    written(path, 3)
    with path.open("r+b") as stream:  # as a loss of power leaves a page that was not written
        stream.seek(HEADER + RECORD)
        stream.write(bytes(RECORD - 1))
    journal = Journal.open(path)
    assert journal.requests == 1
    journal.append(actions(9))
    assert contents(Journal.open(path)) == [actions(1), actions(9)]
    assert path.stat().st_size == HEADER + 2 * RECORD


def test_a_record_out_of_order_ends_the_journal(tmp_path: Path) -> None:
    path = tmp_path / "0"
    written(path, 3)
    whole = path.read_bytes()
    path.write_bytes(whole[: HEADER + RECORD] + whole[HEADER + 2 * RECORD :])
    assert contents(Journal.open(path)) == [actions(1)]


def test_an_ended_journal_stays_ended_and_accepts_nothing(tmp_path: Path) -> None:
    path = tmp_path / "0"
    written(path, 2)
    journal = Journal.open(path)
    journal.end()
    journal.end()
    size = path.stat().st_size
    with pytest.raises(BoardError, match="accepts no such record"):
        journal.append(actions(3))
    journal = Journal.open(path)
    assert journal.ended
    assert path.stat().st_size == size == HEADER + 3 * RECORD
    assert contents(journal) == [actions(1), actions(2)]


@pytest.mark.parametrize("written_before", [0, 1, RECORD - 1])
def test_a_full_disk_adds_nothing_and_the_journal_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written_before: int
) -> None:
    path = tmp_path / "0"
    journal = Journal.create(path, LANES, A)
    journal.append(actions(1))
    write = os.write
    left = written_before

    def fills_up(handle: int, data: bytes) -> int:
        nonlocal left
        if not left:
            raise OSError(errno.ENOSPC, "No space left on device")
        count, left = min(left, len(data)), 0
        return write(handle, data[:count])

    monkeypatch.setattr(os, "write", fills_up)
    with pytest.raises(OSError, match="No space"):
        journal.append(actions(2))
    assert (journal.requests, path.stat().st_size) == (1, HEADER + RECORD)
    monkeypatch.undo()
    journal.append(actions(3))
    assert contents(journal) == [actions(1), actions(3)]


def test_a_write_that_could_not_be_undone_is_undone_before_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "0"
    journal = Journal.create(path, LANES, A)
    write = os.write

    def breaks_off(handle: int, data: bytes) -> int:
        if len(data) < RECORD:
            raise OSError(errno.EIO, "Input/output error")
        return write(handle, data[:5])

    def fails(handle: int, size: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "write", breaks_off)
    monkeypatch.setattr(os, "ftruncate", fails)
    for _ in range(2):
        with pytest.raises(OSError, match="Input"):
            journal.append(actions(1))
    assert path.stat().st_size == HEADER + 5
    assert Journal.open(path).requests == 0
    monkeypatch.undo()
    journal.append(actions(2))
    assert contents(Journal.open(path)) == [actions(2)]


def test_what_was_added_is_flushed_to_the_disk_once_and_again_if_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []
    flushed: list[int] = []  # sizes of the file
    failing = False

    def flush(handle: int) -> None:
        if failing:
            raise OSError(errno.EIO, "Input/output error")
        flushed.append(os.fstat(handle).st_size)

    monkeypatch.setattr("leaderboard.sealed.journal.io.sync_folder", folders.append)
    monkeypatch.setattr(os, "fdatasync", flush)
    journal = Journal.create(tmp_path / "0", LANES, A)
    assert folders == [tmp_path]
    journal.sync()
    assert flushed == []
    journal.append(actions(1))
    journal.append(actions(2))
    failing = True
    with pytest.raises(OSError, match="Input"):
        journal.sync()
    failing = False
    journal.sync()
    journal.sync()
    assert flushed == [HEADER + 2 * RECORD]
    journal.end()
    assert flushed == [HEADER + 2 * RECORD, HEADER + 3 * RECORD]


def test_another_file_is_no_journal(tmp_path: Path) -> None:
    path = tmp_path / "0"
    for content in (b"", b"x" * 20, b"x" * 100):
        path.write_bytes(content)
        with pytest.raises(TamperedError, match="is not a journal"):
            Journal.open(path)


def test_a_journal_is_never_replaced(tmp_path: Path) -> None:
    written(tmp_path / "0", 1)
    with pytest.raises(FileExistsError):
        Journal.create(tmp_path / "0", LANES, A)
    assert Journal.open(tmp_path / "0").requests == 1

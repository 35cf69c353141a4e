"""The journal: whole records, whatever ends its writer."""

import errno
import io
import os

import numpy as np
import pytest

from leaderboard.errors import TamperedError
from leaderboard.seasons.journal import Journal, Play, no_steps
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv
from sme_registry.seasons.transcript import Chain
from sme_registry.seasons.wire import StepFormat

LANES, A = 3, 2
HEADER, RECORD = 28, 8 + 4 * LANES * A + 4


def actions(number):
    return bytes([number]) * (4 * LANES * A)


def contents(journal):
    bodies = list(journal.bodies())
    assert [int.from_bytes(each[:8], "little") for each in bodies] == [
        *range(1, journal.requests + 1)
    ]
    return [each[8:] for each in bodies]


def written(path, count):
    journal = Journal.create(path, LANES, A)
    for number in range(1, count + 1):
        journal.append(actions(number))


def test_a_torn_record_is_cut_off_and_the_next_one_takes_its_place(tmp_path):
    for extra in range(RECORD):
        path = tmp_path / str(extra)
        written(path, 3)
        os.truncate(path, HEADER + 2 * RECORD + extra)
        journal = Journal.open(path, A)
        journal.append(actions(9))
        assert contents(Journal.open(path, A)) == [actions(1), actions(2), actions(9)]


def lose_a_page(data):
    """As a loss of power leaves a page that was not written."""
    return data[: HEADER + RECORD] + bytes(RECORD - 1) + data[HEADER + 2 * RECORD - 1 :]


def lose_a_record(data):
    return data[: HEADER + RECORD] + data[HEADER + 2 * RECORD :]


@pytest.mark.parametrize("fault", [lose_a_page, lose_a_record])
def test_a_journal_ends_before_a_record_that_is_not_whole_or_out_of_order(tmp_path, fault):
    path = tmp_path / "0"
    written(path, 3)
    path.write_bytes(fault(path.read_bytes()))
    journal = Journal.open(path, A)
    assert contents(journal) == [actions(1)]
    journal.append(actions(9))
    assert contents(Journal.open(path, A)) == [actions(1), actions(9)]
    assert path.stat().st_size == HEADER + 2 * RECORD


@pytest.mark.parametrize("known", [1, 2, 3, 4])
def test_what_is_known_to_be_whole_is_not_read_again_unless_it_was_lost(tmp_path, known):
    written(tmp_path / "0", 3)
    journal = Journal.open(tmp_path / "0", A, known)
    assert contents(journal) == [actions(1), actions(2), actions(3)]
    journal.append(actions(4))
    assert list(journal.bodies(2, 3)) == [(3).to_bytes(8, "little") + actions(3)]
    assert contents(Journal.open(tmp_path / "0", A)) == [actions(n) for n in range(1, 5)]


@pytest.mark.parametrize("written_before", [0, 1, RECORD - 1])
@pytest.mark.parametrize("is_undone", [True, False])
def test_a_full_disk_adds_nothing(tmp_path, monkeypatch, written_before, is_undone):
    """Also where what was written could not be removed: the next record replaces it."""
    path = tmp_path / "0"
    journal = Journal.create(path, LANES, A)
    journal.append(actions(1))
    write, left = os.write, written_before

    def fills_up(handle, data):
        nonlocal left
        if not left:
            raise OSError(errno.ENOSPC, "No space left on device")
        count, left = min(left, len(data)), 0
        return write(handle, data[:count])

    def fails(handle, size):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "write", fills_up)
    if not is_undone:
        monkeypatch.setattr(os, "ftruncate", fails)
    for _ in range(2):
        with pytest.raises(OSError, match=r"No space|Input"):
            journal.append(actions(2))
    assert journal.requests == Journal.open(path, A).requests == 1
    assert path.stat().st_size == HEADER + RECORD + (0 if is_undone else written_before)
    monkeypatch.undo()
    journal.append(actions(3))
    assert contents(journal) == contents(Journal.open(path, A)) == [actions(1), actions(3)]


def test_the_name_of_a_journal_and_its_end_reach_the_disk(tmp_path, monkeypatch):
    folders, flushed = [], []  # sizes of the file
    monkeypatch.setattr("leaderboard.seasons.journal.io.sync_folder", folders.append)
    monkeypatch.setattr(os, "fdatasync", lambda handle: flushed.append(os.fstat(handle).st_size))
    journal = Journal.create(tmp_path / "0", LANES, A)
    assert folders == [tmp_path]
    journal.sync()
    assert flushed == []
    journal.append(actions(1))
    journal.end()
    assert flushed == [HEADER + 2 * RECORD]


def test_another_file_is_no_journal_and_a_journal_is_never_replaced(tmp_path):
    path = tmp_path / "0"
    for content in (b"", b"x" * 20, b"x" * 100):
        path.write_bytes(content)
        with pytest.raises(TamperedError, match="is not a journal"):
            Journal.open(path, A)
    written(tmp_path / "1", 1)
    with pytest.raises(FileExistsError):
        Journal.create(tmp_path / "1", LANES, A)
    assert Journal.open(tmp_path / "1", A).requests == 1


SPEC = SMESpec(state_dim=3, action_dim=2, complexity=5, horizon=3, k=2, D=0.1, seed=12)
START = (SPEC, 5, Chain(request="sha256:" + "0" * 64, ticket=1, instance=0))


def measured(actions, budget):
    """The regret of actions `[requests, L, A]`; what goes on from a snapshot answers alike."""
    lanes = actions.shape[1]
    form = StepFormat(lanes, SPEC.state_dim, SPEC.action_dim)
    play, other = (Play(*START, lanes, budget) for _ in range(2))
    for number, each in enumerate(actions, start=1):
        answer = play.take(form.pack(number, each))
        if number > len(actions) // 2:
            assert other.take(form.pack(number, each)) == answer
            assert other.head == play.head
        elif number == len(actions) // 2:
            other.restore(np.load(io.BytesIO(play.snapshot()), allow_pickle=False))
    return play.stepping


def regrets(actions):
    """The regret of the actions of all lanes, and of ½ in the same states, `[requests, 2]`."""
    rows, ends = np.zeros((len(actions), 2)), set()
    for lane in range(actions.shape[1]):
        env = SMEEnv(SPEC)
        env.reset(seed=START[1] + lane)
        for row, each in zip(rows, actions[:, lane], strict=True):
            half = env.task.regret(env.state, np.full(2, 0.5))
            *_, terminated, truncated, info = env.step(each)
            row += info["regret"], half
            ends.add((terminated, truncated))
            if terminated or truncated:
                env.reset()
    return rows, ends


@pytest.mark.parametrize(
    ("taken", "budget", "lanes"), [(120, 120, 1), (110, 120, 1), (5, 8, 1), (110, 120, 3)]
)
def test_the_curve_has_the_regret_of_each_part_relative_to_the_constant(taken, budget, lanes):
    """As in single environments; steps that were not taken count like the constant's."""
    actions = np.random.default_rng(1).random((taken, lanes, 2), dtype=np.float32) * 1.2 - 0.1
    result = measured(actions, budget * lanes)
    (rows, ends), parts = regrets(actions), min(budget, 100)
    assert taken < 100 or {(False, False), (True, False), (False, True)} <= ends
    part = np.arange(budget) * parts // budget
    curve = np.ones(parts)
    for number in range(parts):
        own = rows[part[:taken] == number]
        if len(own):
            share = len(own) / (part == number).sum()
            curve[number] = share * own[:, 0].sum() / own[:, 1].sum() + 1.0 - share
    np.testing.assert_allclose(result.learning_curve, curve, rtol=1e-12)
    ratio = rows[:, 0].sum() / rows[:, 1].sum()
    expected = (taken * ratio + budget - taken) / budget
    assert result.normalised_online_regret == pytest.approx(expected, rel=1e-12)
    assert result.steps == taken * lanes


def test_the_constant_has_a_regret_of_one_with_any_lanes_and_without_a_start():
    half = np.full((6, 3, 2), 0.5, np.float32)
    result = measured(half, 20)  # 18 of them can be taken
    np.testing.assert_allclose(result.learning_curve, [1.0] * 6, rtol=1e-12)
    assert result.steps == 18
    never = no_steps(1000)
    assert (never.steps, never.normalised_online_regret) == (0, 1.0)
    assert never.learning_curve == (1.0,) * 100

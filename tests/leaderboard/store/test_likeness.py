"""Copies across entries and keys, from the scored sketches of their policies to ranks."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from leaderboard.documents import sketch
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import Result
from leaderboard.scoring.ranking import ranking
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import Store
from tests.leaderboard.conftest import put_submission, signed_withdrawal, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result

AUTHOR, THIEF, THIRD = (SigningKey.generate() for _ in range(3))


def sketch_of(policy: int, sample: int) -> str:
    """The sketch of a policy, on the random states of a sample."""
    moments = np.random.default_rng(policy).normal(size=(2, sketch.FEATURES)) * 0.05
    moments += np.random.default_rng([1, sample]).normal(size=moments.shape) * 1e-4
    return sketch.to_text(moments, np.full(2, 1e-8), np.full(2, 0.1))


class Board:
    """A board of four instances, on which entries have policies by number."""

    def __init__(self, store: Store, first: int = 0) -> None:
        self.store = store
        self.ids: list[str] = []
        self._numbers = itertools.count(first)

    def receive(self, key: SigningKey) -> str:
        """A submission of a new method of a key; it waits."""
        number = next(self._numbers)
        method = {"name": f"Method {number}", "version": "1", "family": "x", "knowledge": "generic"}
        self.ids.append(put_submission(self.store, key, number, method=method).id)
        return self.ids[-1]

    def score(self, id: str, *policies: int) -> None:
        """Score a submission, whose runs have these policies, one on each instance."""
        sample = len(self.ids) + self.ids.index(id)
        result = synthetic_result(self.store, id)
        runs = [
            run.model_copy(update={"sketch": sketch_of(100 * number + policy, sample)})
            for number, (run, policy) in enumerate(zip(result.runs, policies, strict=True))
        ]
        finish(self.store, result.model_copy(update={"runs": tuple(runs)}))

    def add(self, key: SigningKey, *policies: int) -> str:
        id = self.receive(key)
        self.score(id, *policies)
        return id

    def reasons(self) -> list[str]:
        """Why each entry has no rank, in the order of submission."""
        rows = {row.entry.id: row.reason for row in ranking(self.store.entries(), "wd_regret")}
        return [rows.get(id, "not scored") for id in self.ids]

    def copies(self, id: str) -> list[tuple[str, int]]:
        entry = self.store.entry(id)
        assert entry is not None
        return [(each.id, each.runs) for each in entry.copy_of]


def finish(store: Store, result: Result) -> None:
    """Record a result as a scorer does, whatever waits before it."""
    with store.transaction():
        store.record("result", result.submission, result, store.folder.result(result.submission))


@pytest.fixture
def board(tmp_path):
    with tiny_board(tmp_path / "board", instances=4) as store:
        yield Board(store)


def test_an_entry_half_of_whose_policies_are_copied_has_no_rank(board):
    original = board.add(AUTHOR, 1, 2, 3, 4)
    half = board.add(THIEF, 1, 2, 8, 9)
    less = board.add(THIEF, 1, 5, 6, 7)
    other_instances = board.add(THIRD, 4, 3, 2, 1)
    without = board.receive(SigningKey.generate())
    finish(board.store, synthetic_result(board.store, without))

    assert board.reasons() == ["", "copy", "", "", ""]
    assert board.copies(half) == [(original, 2)]
    assert board.copies(less) == [(original, 1)]
    assert board.copies(other_instances) == board.copies(without) == []
    board.store.withdraw(signed_withdrawal(board.store, original, AUTHOR))
    assert board.reasons() == ["not scored", "copy", "", "", ""]


def test_a_policy_counts_for_the_first_entry_that_had_it(board):
    original = board.add(AUTHOR, 1, 2, 3, 4)
    board.add(THIEF, 1, 2, 3, 4)
    third = board.add(THIRD, 1, 2, 3, 4)
    again = board.add(AUTHOR, 1, 2, 3, 4)
    other = board.add(SigningKey.generate(), 5, 6, 7, 8)
    mixed = board.add(THIRD, 1, 6, 3, 9)

    assert board.copies(third) == [(original, 4)]
    assert board.copies(again) == []
    assert board.copies(mixed) == [(original, 2), (other, 1)]
    assert board.reasons() == ["superseded", "copy", "copy", "", "", "copy"]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_the_likenesses_do_not_depend_on_the_order_of_scoring(board, order):
    ids = [board.receive(key) for key in (AUTHOR, THIEF, AUTHOR)]
    policies = [(1, 2, 3, 4), (1, 2, 7, 8), (1, 2, 7, 8)]
    for index in order:
        board.score(ids[index], *policies[index])

    assert board.copies(ids[1]) == [(ids[0], 2)]
    assert board.copies(ids[2]) == [(ids[1], 2)]
    with board.store.reading() as index:
        grown = list(index.derived_rows())
    board.store.reindex()
    with board.store.reading() as index:
        assert list(index.derived_rows()) == grown


def test_another_process_and_a_failed_transaction_leave_no_stale_sketches(board):
    first = board.add(AUTHOR, 1, 2, 3, 4)
    runs = [
        run.model_copy(update={"sketch": sketch_of(7, 0)})
        for run in synthetic_result(board.store, first).runs
    ]

    def fails() -> None:
        with board.store.transaction() as index:
            for number in (90, 91):
                index._runs.add(f"sha256:{number:064}", number, runs)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    with Store.open(board.store.folder.path) as other:
        Board(other, first=50).add(THIRD, 5, 6, 7, 8)
    copy = board.add(THIEF, 5, 6, 3, 4)

    assert [runs for _, runs in board.copies(copy)] == [2, 2]


def test_the_board_scores_sketches_by_which_a_copied_policy_is_found(tmp_path):
    with tiny_board(tmp_path / "board") as store:
        first = put_submission(store, AUTHOR, 300)
        method = {"name": "Other", "version": "1", "family": "x", "knowledge": "generic"}
        copy = put_submission(store, THIEF, 300, method=method)
        own = put_submission(store, THIEF, 700)
        assert run_scorer(store.folder.path) == 3
        rows = {row.entry.id: row.reason for row in ranking(store.entries(), "ood_regret")}

    assert rows == {first.id: "", copy.id: "copy", own.id: ""}

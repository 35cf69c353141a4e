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

INSTANCES = 4


def sketch_of(policy: int, sample: int) -> str:
    """The sketch of a policy, on the random states of a sample."""
    moments = np.random.default_rng(policy).normal(size=(2, sketch.FEATURES)) * 0.05
    moments += np.random.default_rng([1, sample]).normal(size=moments.shape) * 1e-4
    return sketch.to_text(moments, np.full(2, 1e-8), np.full(2, 0.1))


class Board:
    """A board of four instances, on which entries have policies by number."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.ids: list[str] = []
        self._numbers = itertools.count()

    def receive(self, key: SigningKey, **method: str) -> str:
        """A submission of a new method of a key; it waits."""
        number = next(self._numbers)
        fields = {"name": f"Method {number}", "version": "1", "family": "x", "knowledge": "generic"}
        signed = put_submission(self.store, key, number, method={**fields, **method})
        self.ids.append(signed.id)
        return signed.id

    def score(self, id: str, *policies: int) -> None:
        """Score a submission, whose runs have these policies, one on each instance."""
        sample = len(self.ids) + self.ids.index(id)
        result = synthetic_result(self.store, id)
        runs = [
            run.model_copy(update={"sketch": sketch_of(100 * number + policy, sample)})
            for number, (run, policy) in enumerate(zip(result.runs, policies, strict=True))
        ]
        finish(self.store, result.model_copy(update={"runs": tuple(runs)}))

    def add(self, key: SigningKey, *policies: int, **method: str) -> str:
        id = self.receive(key, **method)
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
    with tiny_board(tmp_path / "board", instances=INSTANCES) as store:
        yield Board(store)


@pytest.fixture
def author() -> SigningKey:
    return SigningKey.generate()


@pytest.fixture
def thief() -> SigningKey:
    return SigningKey.generate()


def test_an_entry_half_of_whose_policies_are_copied_has_no_rank(board, author, thief):
    original = board.add(author, 1, 2, 3, 4)
    half = board.add(thief, 1, 2, 8, 9)
    less = board.add(thief, 1, 5, 6, 7)

    assert board.reasons() == ["", "copy", ""]
    assert board.copies(half) == [(original, 2)]
    assert board.copies(less) == [(original, 1)]


def test_whoever_was_received_first_is_no_copy_though_scored_later(board, author, thief):
    original, copy = board.receive(author), board.receive(thief)
    board.score(copy, 1, 2, 3, 4)
    assert board.reasons() == ["not scored", ""]
    board.score(original, 1, 2, 3, 4)

    assert board.reasons() == ["", "copy"]


def test_a_policy_counts_for_the_first_entry_that_had_it(board, author, thief):
    original = board.add(author, 1, 2, 3, 4)
    board.add(thief, 1, 2, 3, 4)
    third = board.add(SigningKey.generate(), 1, 2, 3, 4)
    again = board.add(author, 1, 2, 3, 4)

    assert board.copies(third) == [(original, 4)]
    assert board.copies(again) == []
    assert board.reasons() == ["superseded", "copy", "copy", ""]


def test_policies_of_several_entries_are_counted_together(board, thief):
    first, second = (
        board.add(SigningKey.generate(), *policies) for policies in ((1,) * 4, (2,) * 4)
    )
    mixed = board.add(thief, 1, 2, 3, 4)

    assert board.copies(mixed) == [(first, 1), (second, 1)]
    assert board.reasons() == ["", "", "copy"]


def test_twenty_entries_of_a_key_with_the_same_policies_have_one_rank(board, author):
    for number in range(20):
        board.add(author, 1, 2, 3, 4, name=f"Brand {number}", version=str(number))

    assert board.reasons() == ["superseded"] * 19 + [""]


def test_withdrawing_the_original_frees_no_copy(board, author, thief):
    original = board.add(author, 1, 2, 3, 4)
    board.add(thief, 1, 2, 3, 4)
    board.store.withdraw(signed_withdrawal(board.store, original, author))

    assert board.reasons() == ["not scored", "copy"]


def test_policies_of_other_instances_and_without_a_sketch_are_no_copies(board, author, thief):
    board.add(author, 1, 2, 3, 4)
    board.add(thief, 4, 3, 2, 1)
    id = board.receive(thief)
    finish(board.store, synthetic_result(board.store, id))

    assert board.reasons() == ["", "", ""]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3)))[::2])
def test_the_likenesses_do_not_depend_on_the_order_of_scoring(board, author, thief, order):
    ids = [board.receive(key) for key in (author, thief, author)]
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


def test_another_process_and_a_failed_transaction_leave_no_stale_sketches(board, author, thief):
    first = board.add(author, 1, 2, 3, 4)
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
        second = Board(other)
        second._numbers = itertools.count(50)
        second.add(SigningKey.generate(), 5, 6, 7, 8)
    copy = board.add(thief, 5, 6, 3, 4)

    assert [runs for _, runs in board.copies(copy)] == [2, 2]


def test_the_board_scores_sketches_by_which_a_copied_policy_is_found(tmp_path, author, thief):
    with tiny_board(tmp_path / "board") as store:
        first = put_submission(store, author, 300)
        method = {"name": "Other", "version": "1", "family": "x", "knowledge": "generic"}
        copy = put_submission(store, thief, 300, method=method)
        own = put_submission(store, thief, 700)
        assert run_scorer(store.folder.path) == 3
        rows = {row.entry.id: row.reason for row in ranking(store.entries(), "ood_regret")}

    assert rows == {first.id: "", copy.id: "copy", own.id: ""}

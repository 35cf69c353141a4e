"""Copies across entries and keys, from the scored actions of their policies to ranks."""

import base64

import numpy as np
import pytest

from leaderboard.documents.result import Result
from leaderboard.documents.signed import SigningKey
from leaderboard.scoring.ranking import ranking
from leaderboard.scoring.worker import run_scorer
from tests.leaderboard.conftest import put_submission, signed_withdrawal, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result

AUTHOR, THIEF, THIRD = (SigningKey.generate() for _ in range(3))


def sketch_of(policy, sample):
    """What earlier versions stored of a policy, on the random states of a sample."""
    moments = np.random.default_rng(policy).normal(size=64) * 0.05
    moments += np.random.default_rng([1, sample]).normal(size=64) * 1e-4
    numbers = np.concatenate([moments, np.full(2, 1e-8), np.full(2, 0.1)])
    return {"sketch": base64.b64encode(numbers.astype("<f4").tobytes()).decode()}


def digest_of(policy, sample):
    """What is stored of a policy now."""
    return {"actions": f"sha256:{policy:064x}"}


def receive(store, key, number):
    """A submission of a method of its own; it waits."""
    method = {"name": f"Method {number}", "version": "1", "family": "x", "knowledge": "generic"}
    return put_submission(store, key, number, method=method).id


def score(store, id, sample, policies, facts=digest_of):
    """Record a result as a scorer does: runs with these policies, one on each instance."""
    result = synthetic_result(store, id)
    runs = [
        run.model_copy(update=facts(100 * number + policy, sample))
        for number, (run, policy) in enumerate(zip(result.runs, policies, strict=True))
    ]
    result = result.model_copy(update={"runs": tuple(runs)})
    with store.transaction():
        store.record("result", id, result)


POLICIES = [
    (AUTHOR, (1, 2, 3, 4)),
    (THIEF, (1, 2, 8, 9)),  # half of them copied
    (THIEF, (1, 5, 6, 7)),
    (THIRD, (4, 3, 2, 1)),  # of other instances
    (AUTHOR, (1, 2, 8, 9)),
]


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 1, 3, 2, 0)])
@pytest.mark.parametrize("facts", [digest_of, sketch_of])
def test_an_entry_half_of_whose_policies_are_copied_has_no_rank(tmp_path, order, facts):
    with tiny_board(tmp_path / "board", instances=4) as store:
        ids = [receive(store, key, number) for number, (key, _) in enumerate(POLICIES)]
        for number in order:
            score(store, ids[number], number, POLICIES[number][1], facts)
        for rebuilt in (False, True):
            if rebuilt:
                store.reindex()
            copies = [[(each.id, each.runs) for each in store.entry(id).copy_of] for id in ids]
            assert copies == [[], [(ids[0], 2)], [(ids[0], 1)], [], [(ids[1], 2)]]
            rows = {row.entry.id: row.reason for row in ranking(store.entries(), "wd_regret")}
            assert [rows[id] for id in ids] == ["", "copy", "", "", "copy"]
        store.withdraw(signed_withdrawal(store, ids[0], AUTHOR))
        assert store.entry(ids[1]).copy_of


def test_the_board_scores_actions_by_which_a_copied_policy_is_found(tmp_path):
    with tiny_board(tmp_path / "board") as store:
        first = put_submission(store, AUTHOR, 300)
        method = {"name": "Other", "version": "1", "family": "x", "knowledge": "generic"}
        copy = put_submission(store, THIEF, 300, method=method)
        own = put_submission(store, THIEF, 700)
        assert run_scorer(store.folder.path) == 3
        rows = {row.entry.id: row.reason for row in ranking(store.entries(), "ood_regret")}

    assert rows == {first.id: "", copy.id: "copy", own.id: ""}


def test_a_result_of_an_earlier_version_is_written_as_it_was_read(tmp_path):
    with tiny_board(tmp_path / "board") as store:
        id = receive(store, AUTHOR, 0)
        plain = synthetic_result(store, id).to_dict()
        for run, rounding in zip(plain["runs"], (0.0, 3e-7), strict=False):
            run |= {"rounding": rounding, **sketch_of(1, 1)}
        assert Result.from_dict(plain).to_dict() == plain
        for run in plain["runs"]:
            del run["sketch"], run["rounding"]
        assert "actions" not in Result.from_dict(plain).to_dict()["runs"][0]

"""A large board, whose rows are read from its index."""

import os

from leaderboard.documents.signed import Receiver
from tests.leaderboard.conftest import put_submission, tiny_board
from tests.leaderboard.store.synthetic import synthetic_result


def test_rows_of_many_entries_are_read_from_the_index_alone(tmp_path, key, monkeypatch):
    """A page of a thousand entries reads none of their files."""
    entries, runs = 20, 30
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    with tiny_board(tmp_path / "board", instances=runs) as store:
        with store.transaction():
            first = put_submission(store, key).content
            result = synthetic_result(store, first.digest)
            for number in range(entries):
                if number > 0:
                    method = first.method.model_copy(update={"name": f"Method {number}"})
                    other = first.model_copy(update={"method": method})
                    store.receive(other.signed(key, Receiver(store.document.key)))
                claim = store.queue.claim("filler")
                update = {"submission": claim.id}
                assert store.queue.finish(claim, result.model_copy(update=update))
        store.reindex()
        rows = store.entries()
        assert len(rows) == entries
        assert all((row.runs, row.scores) == (runs, result.scores) for row in rows)
        store.folder.objects.rename(tmp_path / "objects")
        assert store.entries() == rows
        assert store.entry(rows[5].id) == rows[5]

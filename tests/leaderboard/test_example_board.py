"""The small board in `examples/board`: intact, ranked, and open to anyone."""

from pathlib import Path

from leaderboard.scoring.ranking import ranking, refuse_unpublishable
from leaderboard.scoring.verify import verify
from leaderboard.store import Store

BOARD = Path(__file__).resolve().parents[2] / "examples" / "board"


def test_the_example_board_is_small_and_verifies_down_to_its_policies():
    report = verify(BOARD, rescore=1)
    assert (report.submissions, report.results, report.unlogged) == (4, 4, 0)
    assert not (BOARD / "board.key").exists()
    assert sum(path.stat().st_size for path in BOARD.rglob("*") if path.is_file()) < 300_000


def test_two_methods_are_ranked_with_ten_runs():
    with Store.open(BOARD, read_only=True) as store:
        entries = store.entries()
        refuse_unpublishable(entries)
        ranked = [row for row in ranking(entries, "ood_regret") if row.first is not None]
        assert [row.entry.method for row in ranked] == ["Hill climbing", "Random search"]
        for row in ranked:
            result = store.result(row.entry.id)
            assert result is not None
            assert [member.runs for member in result.classes] == [10]
            assert 0.0 < result.scores.ood_regret.low <= result.scores.ood_regret.high < 1.5

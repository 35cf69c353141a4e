"""The published baselines under `examples/board`: whole, ranked, and open to anyone."""

from __future__ import annotations

from pathlib import Path

from leaderboard.scoring.ranking import ranking, refuse_unpublishable
from leaderboard.scoring.verify import verify
from leaderboard.store import Store
from sme_registry.spec import SuiteFile, catalogue

BOARD = Path(__file__).resolve().parents[2] / "examples" / "board"


def test_the_example_board_is_as_it_was_signed() -> None:
    report = verify(BOARD)
    assert (report.submissions, report.results, report.unlogged) == (5, 5, 0)
    assert not (BOARD / "board.key").exists()


def test_three_algorithms_are_ranked_between_the_references_with_ten_runs_a_class() -> None:
    with Store.open(BOARD, read_only=True) as store:
        assert store.document.suite == catalogue.find(SuiteFile, "smoke-v1").suite
        entries = store.entries()
        refuse_unpublishable(entries)
        ranked = [row for row in ranking(entries, "wd_regret") if row.first is not None]
        assert {row.entry.method for row in ranked} == {"PPO", "SAC", "TD3"}
        for row in ranked:
            result = store.result(row.entry.id)
            assert result is not None
            assert [member.runs for member in result.classes] == [10, 10, 10]
            assert 0.0 < result.scores.wd_regret.low <= result.scores.wd_regret.high < 1.0
